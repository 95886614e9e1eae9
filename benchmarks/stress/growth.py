"""The law by which errors, drift and energy grow over a long time."""

import numpy as np

from .cases import METHODS


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


def laws(series):
    """{name of a column: number} of one solve."""
    times, energy = np.array(series["t"]), np.array(series["energy"]) - series["energy"][0]
    found = {}
    for name, values in {"error": series["error"], "drift": series["drift"], "energy": energy}.items():
        found |= {name: float(np.abs(values).max()), f"{name} ∝ t^": exponent(times, np.array(values))}
    return found | {"trend of the energy": trend(energy)}


def table(grown):
    """A markdown table for each stressor; empty without any."""
    if not grown:
        return ""
    lines = [
        "## Over long times",
        "",
        "The largest value, and the exponent of the power of t that it follows over the last two decades. The trend of the energy is "
        "how far its mean over the last fifth is off that over the first, as a part of its largest deviation: near 1 it moves, near "
        "0 it swings.",
    ]
    for stressor, by in grown.items():
        names = list(next(iter(by.values())))
        lines += ["", f"| {stressor} | {' | '.join(names)} |", "|---|" + "---:|" * len(names)]
        for method, law in sorted(by.items(), key=lambda row: list(METHODS).index(row[0])):
            numbers = [f"{x:.0e}" if name in ("error", "drift", "energy") else f"{x:.2f}" for name, x in law.items()]
            lines.append(f"| {method} | {' | '.join(numbers)} |")
    return "\n".join([*lines, ""])
