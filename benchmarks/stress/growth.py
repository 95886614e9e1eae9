"""The law by which errors, drift and energy grow over a long time."""

import numpy as np


def exponent(times, values):
    """p of the best fit of c t^p to the running maximum over the last two decades of time."""
    top = np.maximum.accumulate(np.abs(values))
    late = (times >= times[-1] / 100) & (top > 0)
    return float(np.polyfit(np.log(times[late]), np.log(top[late]), 1)[0]) if late.sum() > 2 else 0.0


def trend(values):
    """By how much the mean of the last fifth is off that of the first, as a part of the largest deviation from the start."""
    part = max(len(values) // 5, 1)
    moved = abs(np.mean(values[-part:]) - np.mean(values[:part]))
    return float(moved / max(np.abs(values - values[0]).max(), 1e-300))


def table(grown):
    """A markdown table of the laws; empty without anything that grew."""
    if not grown:
        return ""
    lines = [
        "## Over long times",
        "",
        "The largest value, and the exponent p of the law t^p that it follows over the last two decades. The trend of the energy is "
        "how far its mean over the last fifth is off that over the first, as a part of its largest deviation: near 1 it moves, near "
        "0 it swings.",
        "",
        "| method | error | p | drift | p | energy | p | trend of the energy |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for (_, method), series in grown.items():
        times = np.array(series["t"])
        energy = np.array(series["energy"]) - series["energy"][0]
        errors, drifts = np.array(series["error"]), np.array(series["drift"])
        parts = [f"{np.abs(x).max():.0e} | {exponent(times, x):.1f}" for x in (errors, drifts, energy)]
        lines.append(f"| {method} | {' | '.join(parts)} | {trend(energy):.2f} |")
    return "\n".join([*lines, ""])
