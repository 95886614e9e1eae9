"""The tables of `which_method.md`, measured: `python notebooks/which_method/write.py [SCENE ...]` writes them into the page.

They are those of `dae-jax compare SCENE` without its figures. All else on the page is written by hand.
"""

import os
import platform
import re
import sys
from pathlib import Path

import jax
import numpy as np

import dae_jax
from dae_jax.app.compare import Row, measure, methods


PAGE = Path(__file__).parents[1] / "which_method.md"
RTOL = 1e-8
HEAD = (
    "| method | steps | run, ms | compile, s | error | off the constraints | off the hidden ones | change of energy |"
)
# A table on the page: between these two lines.
BLOCK = r"<!-- measured: ([\w-]+) -->\n(.*?)<!-- end -->"


def tables(page: str) -> dict[str, str]:
    """{scene: its table} of a page."""
    return dict(re.findall(BLOCK, page, re.DOTALL))


def table(name: str) -> str:
    """A scene by every method that applies, as markdown; a method that fails or is refused has the reason in its row."""
    scene = dae_jax.scenes.SCENES[name]()
    times = scene.times(scene.t1, 501)
    rows = []
    for method, how in methods(scene).items():
        print(f"{name}: {method}", file=sys.stderr, flush=True)
        row, _ = measure(scene, method, how, times, RTOL)
        rows.append(_cells(row, f", h = {how.step:g} s" if how.step else ""))
    said = f"To {scene.t1:g} s, tolerance {RTOL:g}; {os.cpu_count()} cores, {platform.machine()}, "
    said += f"JAX {jax.__version__}, dae_jax {dae_jax.__version__}."
    return "\n".join([HEAD, "|---|" + "---:|" * 7, *rows, "", said, ""])


def _cells(row: Row, step: str) -> str:
    if row.reason:
        return f"| `{row.method}`{step} | " + row.reason.replace("|", r"\|") + " |" * 7
    measured = (row.error, row.position_drift, row.velocity_drift, row.energy_drift)
    numbers = ["–" if np.isnan(x) else f"{x:.0e}" for x in measured]
    times = [f"{1e3 * row.run_seconds:.2g}", f"{row.compile_seconds:.1f}"]
    return f"| `{row.method}`{step} | " + " | ".join([str(row.steps), *times, *numbers]) + " |"


def main() -> None:
    """Measures the scenes named, by default all of the page, and writes each table when it is there."""
    jax.config.update("jax_enable_x64", True)
    for name in sys.argv[1:] or tables(PAGE.read_text()):
        new = f"<!-- measured: {name} -->\n{table(name)}<!-- end -->"
        old = BLOCK.replace(r"([\w-]+)", name)
        PAGE.write_text(re.sub(old, lambda _, new=new: new, PAGE.read_text(), flags=re.DOTALL))


if __name__ == "__main__":
    main()
