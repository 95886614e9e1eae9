"""What each method can take: `python -m benchmarks.stress` or `dae-jax stress`."""

import argparse
import sys
from pathlib import Path

from dae_jax.app import options

from . import growth, page
from .cases import METHODS
from .families import FAMILIES, SCENE, cells_of
from .record import Record
from .runner import LIMIT, run


# A part of the methods and of each family that shows within two minutes whether all is in order.
QUICK_METHODS = ("projection-dop853", "baumgarte", "radau-ggl", "rattle")
QUICK_FAMILIES = ("scales", "broken")


def main(argv=None):
    """Solve, print a line a cell, and write table, page and figures."""
    parser = argparse.ArgumentParser(prog="dae-jax stress", description=__doc__)
    parser.add_argument(
        "scenes", nargs="*", metavar="SCENE",
        help="mechanisms of the library, for stressors that fit all; by default the families with systems of their own",
    )  # fmt: skip
    parser.add_argument("--methods", help=f"names, separated by commas; by default all: {', '.join(METHODS)}")
    parser.add_argument("--stressors", help=f"families, separated by commas; by default all: {', '.join(FAMILIES)}")
    parser.add_argument(
        "--quick", action="store_true", help="a smoke test: few methods and stressors, under two minutes"
    )
    parser.add_argument(
        "--limit", type=float, default=LIMIT, help=f"seconds of processor time for a cell; by default {LIMIT}"
    )
    parser.add_argument(
        "--out",
        type=Path,
        default=Path("stress"),
        help="folder for table, page and figures; what it has of other stressors and methods stays",
    )
    arguments = parser.parse_args(argv)
    options.refuse_not_positive(parser, **{"--limit": arguments.limit})
    if arguments.scenes and arguments.stressors:
        parser.error("--stressors is not for scenes: they have stressors that fit all")
    for scene in arguments.scenes:
        options.mechanism(parser, scene)
    methods = _names(parser, "method", arguments.methods, METHODS, QUICK_METHODS if arguments.quick else METHODS)
    families = _names(parser, "family", arguments.stressors, FAMILIES, QUICK_FAMILIES if arguments.quick else FAMILIES)
    families = [SCENE + scene for scene in arguments.scenes] or families
    options.writable(parser, arguments.out)
    record, count = Record.read(arguments.out), 0
    try:
        for family in families:
            for cell, series in run(
                family, cells_of(family, methods, arguments.quick), arguments.quick, arguments.limit
            ):
                print(_line(cell), flush=True)
                count += 1
                record.add(cell, growth.laws(series) if series else None)
            if hasattr(FAMILIES.get(family), "figures"):
                record.figures |= FAMILIES[family].figures(arguments.out, arguments.quick, record.of(family))
            record.write(arguments.out)
            page.write(record, arguments.out)
    except KeyboardInterrupt:
        record.write(arguments.out)
        raise KeyboardInterrupt(f"{count} cells are done and kept in {arguments.out}") from None
    print(page.counts(record.cells), *(arguments.out / name for name in page.NAMES), sep="\n")
    return int(any(cell.verdict == "WRONG" for cell in record.cells))


def _names(parser, kind, given, known, default):
    names = list(default) if given is None else [name.strip() for name in given.split(",")]
    for name in names:
        if name not in known:
            parser.error(f"unknown {kind} {name!r}; choose from {', '.join(known)}")
    return names


def _line(cell):
    lost = f" by {cell.lost:.1f} digits" if cell.verdict == "degraded" else ""
    said = (
        cell.words
        if cell.ended != "answer" or cell.verdict == "warned"
        else f"error {cell.error:.1e} of {cell.allowed:.0e} allowed, drift {cell.drift:.0e}"
    )
    return f"{cell.family:10s} {cell.stressor:28s} {cell.method:20s} {cell.verdict}{lost}: {said[:110]}"


if __name__ == "__main__":
    sys.exit(main())
