"""The command line: `dae-jax`, also `python -m dae_jax`."""

import argparse
import importlib
import importlib.metadata
import sys
from pathlib import Path
from typing import Any


def main(argv: list[str] | None = None) -> int:
    """Runs one command; the exit status is 2 for wrong arguments."""
    import jax

    jax.config.update("jax_enable_x64", True)
    parser = argparse.ArgumentParser(prog="dae-jax", description="Differential-algebraic equations in JAX.")
    parser.add_argument("--version", action="version", version=importlib.metadata.version("dae_jax"))
    commands = parser.add_subparsers(dest="command", required=True)
    _add_compare(commands)
    _add_analyse(commands)
    _add_sweep(commands)
    _add_tune(commands)
    commands.add_parser(
        "bench", help="run the benchmarks of a source checkout; `bench --help` lists them", add_help=False
    )
    arguments, rest = parser.parse_known_args(argv)
    if arguments.command == "bench":
        return _bench(parser, rest)
    if rest:
        parser.error(f"unrecognized arguments: {' '.join(rest)}")
    return arguments.run(parser, arguments)


def _add_compare(commands: argparse._SubParsersAction) -> None:
    from .scenes import SCENES

    parser = commands.add_parser("compare", help="solve a scene by every method; print a table and draw the figures")
    parser.add_argument("scene", metavar="SCENE", help=", ".join(SCENES))
    parser.add_argument("--methods", help="names, separated by commas; by default all")
    parser.add_argument("--t1", type=float, help="end time in s; by default the scene's own")
    parser.add_argument("--rtol", type=float, default=1e-8, help="tolerance, relative and absolute; by default 1e-8")
    parser.add_argument("--out", type=Path, help="folder for table, data and figures; by default compare-SCENE")
    parser.set_defaults(run=_compare)


def _compare(parser: argparse.ArgumentParser, arguments: argparse.Namespace) -> int:
    from .compare import compare, table, write
    from .scenes import SCENES

    if arguments.scene not in SCENES:
        parser.error(f"unknown scene {arguments.scene!r}; choose from {', '.join(SCENES)}")
    scene = SCENES[arguments.scene]()
    t1 = scene.t1 if arguments.t1 is None else arguments.t1
    _refuse_not_positive(parser, **{"--t1": t1, "--rtol": arguments.rtol})
    names = arguments.methods.split(",") if arguments.methods else None
    try:
        results = list(compare(scene, names, t1, arguments.rtol))
    except ValueError as refusal:
        parser.error(str(refusal))
    rows = [row for row, _ in results]
    print(
        f"{scene.name}, {t1:g} s, tolerance {arguments.rtol:g}; error and drifts are the largest over 501 times, errors "
        f"relative where the solution is larger than {scene.scale:g}"
    )
    print(table(rows))
    solutions = {row.method: sol for row, sol in results if sol is not None}
    folder = arguments.out or Path(f"compare-{arguments.scene}")
    for path in write(scene, rows, solutions, arguments.rtol, folder):
        print(path)
    return 0


def _add_analyse(commands: argparse._SubParsersAction) -> None:
    parser = commands.add_parser("analyse", help="print index, offsets, degrees of freedom and hidden constraints")
    parser.add_argument(
        "system",
        metavar="SCENE | MODULE:NAME",
        help="a ready scene, or a name in a module: a Scene, (system, y0) or (system, y0, args), or a function that makes one",
    )
    parser.add_argument("--out", type=Path, help="file for a drawing of the incidence matrix, such as incidence.png")
    parser.set_defaults(run=_analyse)


def _analyse(parser: argparse.ArgumentParser, arguments: argparse.Namespace) -> int:
    from .analyse import DRAWN, analyse
    from .scenes import SCENES, Scene

    module, colon, name = arguments.system.partition(":")
    if not colon and module not in SCENES:
        parser.error(f"unknown scene {module!r}; choose from {', '.join(SCENES)}, or give MODULE:NAME")
    try:
        if colon:
            sys.path.insert(0, "")
        found = getattr(importlib.import_module(module), name) if colon else SCENES[module]
    except (ImportError, AttributeError) as failure:
        parser.error(f"{arguments.system!r} cannot be imported: {failure}")
    found = found() if callable(found) else found
    if isinstance(found, Scene):
        found = found.system, found.y0, found.args
    if not isinstance(found, tuple) or len(found) not in (2, 3):
        parser.error(
            f"{arguments.system!r} is no Scene, (system, y0) or (system, y0, args), but a {type(found).__name__}"
        )
    system, y0, *args = found
    try:
        structure = analyse(system, 0.0, y0, *args)
    except (TypeError, ValueError) as refusal:
        parser.error(str(refusal))
    print(structure)
    if len(structure.equations) <= DRAWN:
        by_ranks = structure.differential_index
        print(f"differential index, by ranks at the start: {'not to be had' if by_ranks is None else by_ranks}")
    if arguments.out is not None:
        from .plotting import incidence

        try:
            incidence(structure, arguments.system).savefig(arguments.out)
        except (OSError, ValueError) as refusal:
            parser.error(str(refusal))
    return 0


def _add_sweep(commands: argparse._SubParsersAction) -> None:
    parser = commands.add_parser(
        "sweep", help="draw a map of Baumgarte's parameters, or of the double pendulum's initial angles"
    )
    parser.add_argument(
        "map",
        metavar="SCENE | angles",
        help="a mechanism, for the map of its α and β; or `angles`, for flips and chaos",
    )
    parser.add_argument("--points", type=int, default=100, help="along each axis; by default 100")
    parser.add_argument("--t1", type=float, help="end time in s; by default 10 s, for α and β 5 s")
    parser.add_argument("--dt0", type=float, default=0.05, help="step in s, of the α, β map; by default 0.05")
    parser.add_argument("--rtol", type=float, default=1e-6, help="tolerance, of the angle map; by default 1e-6")
    parser.add_argument(
        "--out", type=Path, help="folder for figure, data and what can be resumed; by default sweep-MAP"
    )
    parser.set_defaults(run=_sweep)


def _sweep(parser: argparse.ArgumentParser, arguments: argparse.Namespace) -> int:
    from .maps import write_angle_map, write_baumgarte_map

    angles = arguments.map == "angles"
    t1 = arguments.t1 if arguments.t1 is not None else 10.0 if angles else 5.0
    _refuse_not_positive(
        parser, **{"--points": arguments.points, "--t1": t1, "--dt0": arguments.dt0, "--rtol": arguments.rtol}
    )
    folder = arguments.out or Path(f"sweep-{arguments.map}")
    try:
        if angles:
            paths = write_angle_map(t1, arguments.rtol, arguments.points, folder, True)
        else:
            paths = write_baumgarte_map(
                _mechanism(parser, arguments.map), t1, arguments.dt0, arguments.points, folder, True
            )
    except (OSError, ValueError) as refusal:
        parser.error(str(refusal))
    print(*paths, sep="\n")
    return 0


def _add_tune(commands: argparse._SubParsersAction) -> None:
    parser = commands.add_parser("tune", help="find the best of Baumgarte's parameters for a mechanism by descent")
    parser.add_argument("scene", metavar="SCENE", help="a mechanism, such as pendulum")
    parser.add_argument("--t1", type=float, default=5.0, help="end time in s; by default 5")
    parser.add_argument("--dt0", type=float, default=0.05, help="step in s; by default 0.05")
    parser.add_argument("--steps", type=int, default=60, help="of the descent, at most; by default 60")
    parser.add_argument("--starts", type=int, default=1, help="descents at once; by default 1, from α = β = 1")
    parser.add_argument("--out", type=Path, help="folder for figure and data; by default tune-SCENE")
    parser.set_defaults(run=_tune)


def _tune(parser: argparse.ArgumentParser, arguments: argparse.Namespace) -> int:
    from .maps import write_tuned

    names = ("t1", "dt0", "steps", "starts")
    _refuse_not_positive(parser, **{f"--{name}": getattr(arguments, name) for name in names})
    scene = _mechanism(parser, arguments.scene)
    folder = arguments.out or Path(f"tune-{arguments.scene}")
    try:
        tuned, verified, paths = write_tuned(
            scene, arguments.t1, arguments.dt0, arguments.steps, arguments.starts, folder, True
        )
    except (OSError, ValueError) as refusal:
        parser.error(str(refusal))
    alpha, beta = (float(tuned.params[name]) for name in ("alpha", "beta"))
    print(
        f"{scene.name}: α = {alpha:.4g}, β = {beta:.4g}, loss {float(tuned.loss):.4g} after {tuned.evaluations} evaluations"
    )
    for label, found in zip(("rtol 1e-11", f"dt0 = {arguments.dt0:g} s", "dt0 / 2"), verified, strict=True):
        print(f"  verified with {label:14s} error {found.error:.2e}  drift {found.drift:.2e}")
    print(*paths, sep="\n")
    return 0


def _mechanism(parser: argparse.ArgumentParser, name: str) -> Any:
    from .scenes import SCENES
    from .systems import ConstrainedSystem

    if name not in SCENES:
        parser.error(f"unknown scene {name!r}; choose from {', '.join(SCENES)}")
    scene = SCENES[name]()
    if not isinstance(scene.system, ConstrainedSystem):
        parser.error(f"{name} is no mechanism: Baumgarte's parameters are for a ConstrainedSystem")
    return scene


def _refuse_not_positive(parser: argparse.ArgumentParser, **options: float) -> None:
    for option, value in options.items():
        if not 0 < value < float("inf"):
            parser.error(f"{option} must be positive and finite, but is {value}")


def _bench(parser: argparse.ArgumentParser, arguments: list[str]) -> int:
    root = Path(__file__).parent.parent
    if not (root / "benchmarks" / "__main__.py").exists():
        parser.error(
            "the benchmarks are part of the source repository, not of the installed package; run it from a checkout"
        )
    sys.path.insert(0, str(root))
    return importlib.import_module("benchmarks.__main__").main(arguments)


if __name__ == "__main__":
    sys.exit(main())
