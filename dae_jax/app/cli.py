"""The command line: `dae-jax`, also `python -m dae_jax`."""

import argparse
import importlib
import importlib.metadata
import os
import sys
from pathlib import Path
from typing import Any

from . import options
from .interrupts import interruptible


class _Parser(argparse.ArgumentParser):
    def error(self, message: str) -> Any:
        """One line, and the status 2."""
        self.exit(2, f"{self.prog}: {message} (see `{self.prog} --help`)\n")


def main(argv: list[str] | None = None) -> int:
    """Runs one command; the exit status is 2 for wrong arguments, 130 after an interruption."""
    try:
        with interruptible():
            status = _main(argv)
            sys.stdout.flush()
            return status
    except KeyboardInterrupt as interruption:
        kept = str(interruption)
        print(f"\ndae-jax: interrupted{kept and '; ' + kept}", file=sys.stderr)
        return 130
    except BrokenPipeError:
        # Who reads the output, such as `head`, has seen enough; Python must not try to write the rest at the end.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 141
    except (MemoryError, OSError) as failure:  # a disk that is full, say
        print(f"dae-jax: {failure}", file=sys.stderr)
        return 2


def _main(argv: list[str] | None) -> int:
    import jax

    jax.config.update("jax_enable_x64", True)
    parser = _Parser(prog="dae-jax", description="Differential-algebraic equations in JAX.")
    parser.add_argument("--version", action="version", version=importlib.metadata.version("dae_jax"))
    commands = parser.add_subparsers(dest="command", required=True)
    _add_compare(commands)
    _add_analyse(commands)
    _add_sweep(commands)
    _add_tune(commands)
    _add_animate(commands)
    bench = commands.add_parser(
        "bench", help="run the benchmarks of a source checkout; `bench --help` lists them", add_help=False
    )
    stress = commands.add_parser(
        "stress",
        help="a table of what each method can take, from a source checkout; see `stress --help`",
        add_help=False,
    )
    arguments, rest = parser.parse_known_args(argv)
    if arguments.command == "bench":
        return _of_a_checkout(bench, "benchmarks", rest)
    if arguments.command == "stress":
        return _of_a_checkout(stress, "benchmarks.stress", rest)
    parser = commands.choices[arguments.command]
    if rest:
        parser.error(f"unrecognized arguments: {' '.join(rest)}")
    return arguments.run(parser, arguments)


def _add_compare(commands: argparse._SubParsersAction) -> None:
    parser = commands.add_parser("compare", help="solve a scene by every method; print a table and draw the figures")
    parser.add_argument("scene", metavar="SCENE", help=", ".join(options.scenes()))
    parser.add_argument("--methods", help="names, separated by commas; by default all")
    parser.add_argument("--t1", type=float, help="end time in s; by default the scene's own")
    parser.add_argument("--rtol", type=float, help="tolerance, relative and absolute; by default 1e-8")
    parser.add_argument(
        "--out",
        type=Path,
        help="folder for table, data and figures, by default compare-SCENE; the paper's figures are of all methods, to the "
        "scene's own end time, and left out with --methods or --t1",
    )
    parser.set_defaults(run=_compare)


def _compare(parser: argparse.ArgumentParser, arguments: argparse.Namespace) -> int:
    from .compare import chosen, compare, largest, table
    from .figures import figures, write_data, write_figures

    scene = options.scene(parser, arguments.scene)
    t1 = scene.t1 if arguments.t1 is None else arguments.t1
    rtol = 1e-8 if arguments.rtol is None else arguments.rtol
    options.refuse_not_positive(parser, **{"--t1": t1})
    options.refuse_bad_tolerance(parser, rtol)
    names = None if arguments.methods is None else [x.strip() for x in arguments.methods.split(",")]
    try:
        by = chosen(scene, names)
    except ValueError as refusal:
        parser.error(str(refusal))
    if arguments.rtol is not None and all(method.step for method in by.values()):
        parser.error(f"--rtol is for methods that choose their steps; {', '.join(by)} has fixed ones")
    folder = options.writable(parser, arguments.out or Path(f"compare-{arguments.scene}"))
    rows, points, solutions = [], [], {}
    try:
        for row, sol, efforts in compare(scene, by, t1, rtol):
            rows.append(row)
            points += efforts
            if sol is not None:
                solutions[row.method] = sol
            written = write_data(scene, rows, points, solutions, folder)
        print(f"{scene.name}, {t1:g} s, tolerance {rtol:g}; {largest(scene, t1)}")
        print(table(rows))
        if solutions and not points:
            print(f"– no error: the reference is known at {scene.t1:g} s only")
        paper = arguments.methods is None and arguments.t1 is None
        print(*written, *write_figures(figures(scene, rows, points, solutions, rtol, paper), folder), sep="\n")
    except KeyboardInterrupt:
        raise KeyboardInterrupt(f"{len(rows)} of {len(by)} methods are done and kept in {folder}") from None
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
    from ..analyse import DRAWN, analyse

    if arguments.out is not None:
        options.refuse_unwritable_picture(parser, arguments.out)
    system, y0, *args = _system(parser, arguments.system)
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

        incidence(structure, arguments.system).savefig(arguments.out)
        print(arguments.out)
    return 0


def _system(parser: argparse.ArgumentParser, name: str) -> tuple[Any, ...]:
    """(system, y0) or (system, y0, args) of a scene, or of what a user's module has or makes under this name."""
    from ..scenes import Scene
    from ..systems import System

    module, colon, attribute = name.partition(":")
    if not colon:
        found = options.scene(parser, name, ", or give MODULE:NAME")
    else:
        sys.path.insert(0, "")
        try:
            found = getattr(importlib.import_module(module), attribute)
            found = found() if callable(found) else found
        except Exception as failure:  # of the user's module: anything
            parser.error(f"{name!r} cannot be had: {type(failure).__name__}: {failure}")
    if isinstance(found, Scene):
        return found.system, found.y0, found.args
    if not isinstance(found, tuple) or len(found) not in (2, 3) or not isinstance(found[0], System):
        parser.error(f"{name!r} is no Scene, (system, y0) or (system, y0, args), but a {type(found).__name__}")
    return found


def _add_sweep(commands: argparse._SubParsersAction) -> None:
    from ..scenes import ANGLES

    parser = commands.add_parser("sweep", help="draw a map of Baumgarte's parameters, or of initial angles")
    parser.add_argument(
        "map",
        metavar="SCENE | angles",
        help=f"a mechanism, for the map of its α and β; or `angles`, for flips and chaos of the {ANGLES}",
    )
    parser.add_argument("--points", type=int, default=100, help="along each axis; by default 100")
    parser.add_argument("--t1", type=float, help="end time in s; by default 10 s, for α and β 5 s")
    parser.add_argument("--dt0", type=float, help="step in s, for α and β only; by default 0.05")
    parser.add_argument("--rtol", type=float, help="tolerance, for `angles` only; by default 1e-6")
    parser.add_argument(
        "--out", type=Path, help="folder for figure, data and what can be resumed; by default sweep-MAP"
    )
    parser.set_defaults(run=_sweep)


def _sweep(parser: argparse.ArgumentParser, arguments: argparse.Namespace) -> int:
    from ..scenes import ANGLES, SCENES
    from .maps import write_angle_map, write_baumgarte_map

    angles = arguments.map == "angles"
    other = ("--dt0", arguments.dt0) if angles else ("--rtol", arguments.rtol)
    if other[1] is not None:
        taken = "steps are chosen by --rtol" if angles else "the loss of α and β is for fixed steps, --dt0"
        parser.error(f"{other[0]} is not for `sweep {arguments.map}`: {taken}")
    if arguments.points < 2:
        parser.error(f"--points must be at least 2, but is {arguments.points}")
    t1 = arguments.t1 if arguments.t1 is not None else 10.0 if angles else 5.0
    dt0 = 0.05 if arguments.dt0 is None else arguments.dt0
    rtol = 1e-6 if arguments.rtol is None else arguments.rtol
    options.refuse_not_positive(parser, **{"--t1": t1, "--dt0": dt0})
    options.refuse_bad_tolerance(parser, rtol)
    scene = SCENES[ANGLES]() if angles else options.mechanism(parser, arguments.map)
    folder = options.writable(parser, arguments.out or Path(f"sweep-{arguments.map}"))
    try:
        if angles:
            paths = write_angle_map(scene, t1, rtol, arguments.points, folder, True)
        else:
            paths = write_baumgarte_map(scene, t1, dt0, arguments.points, folder, True)
    except (RuntimeError, ValueError) as refusal:
        parser.error(str(refusal))
    except KeyboardInterrupt:
        raise KeyboardInterrupt(f"what is done is kept in {folder}; the same command goes on from there") from None
    print(*paths, sep="\n")
    return 0


def _add_tune(commands: argparse._SubParsersAction) -> None:
    parser = commands.add_parser("tune", help="find the best of Baumgarte's parameters for a mechanism by descent")
    parser.add_argument("scene", metavar="SCENE", help="a mechanism, such as four-bar")
    parser.add_argument("--t1", type=float, default=5.0, help="end time in s; by default 5")
    parser.add_argument("--dt0", type=float, default=0.05, help="step in s; by default 0.05")
    parser.add_argument("--steps", type=int, default=60, help="of the descent, at most; by default 60")
    parser.add_argument("--starts", type=int, default=1, help="descents at once; by default 1, from α = β = 20")
    parser.add_argument("--out", type=Path, help="folder for figure and data; by default tune-SCENE")
    parser.set_defaults(run=_tune)


def _tune(parser: argparse.ArgumentParser, arguments: argparse.Namespace) -> int:
    from .maps import FAILED, write_tuned

    names = ("t1", "dt0", "steps", "starts")
    options.refuse_not_positive(parser, **{f"--{name}": getattr(arguments, name) for name in names})
    scene = options.mechanism(parser, arguments.scene)
    folder = options.writable(parser, arguments.out or Path(f"tune-{arguments.scene}"))
    try:
        before, after, paths = write_tuned(
            scene, arguments.t1, arguments.dt0, arguments.steps, arguments.starts, folder, True
        )
    except (RuntimeError, ValueError) as refusal:
        parser.error(str(refusal))
    except KeyboardInterrupt:
        kept = [str(path) for path in folder.glob("*.npz")]
        raise KeyboardInterrupt("".join(f"the descent so far is in {path}" for path in kept)) from None
    print(f"{scene.name:32s}{'α':>8s}{'β':>8s}{'loss':>9s}{'error':>10s}{'drift':>10s}")
    for label, point in (("before", before), ("after", after)):
        print(f"{label:32s}{point.alpha:8.4g}{point.beta:8.4g}{point.loss:9.2f}")
        solves = ("rtol 1e-11", f"dt0 = {arguments.dt0:g} s", "dt0 / 2")
        for solve, found in zip(solves, point.verification, strict=True):
            print(f"  verified with {solve:41s}{found.error:10.1e}{found.drift:10.1e}")
    print(*paths, sep="\n")
    if after.loss >= FAILED:
        print(
            "No α and β were found with which all solves reach their end: there is nothing to choose among. Steps of "
            f"{arguments.dt0:g} s may be too long for this mechanism; try a smaller --dt0, or a shorter --t1.",
            file=sys.stderr,
        )
        return 1
    return 0


def _add_animate(commands: argparse._SubParsersAction) -> None:
    parser = commands.add_parser("animate", help="show a mechanism as it moves, with its drift beside")
    parser.add_argument("scene", metavar="SCENE", help="one with a drawing, such as double-pendulum")
    parser.add_argument("--t1", type=float, help="end time in s; by default the scene's own")
    parser.add_argument(
        "--speed",
        type=float,
        help="seconds of the motion in a second; by default 1, but 10 s for what is very short or long",
    )
    parser.add_argument(
        "--method", default="projection-dop853", help="by which it is solved; by default projection-dop853"
    )
    parser.add_argument("--out", type=Path, help="file, .html, .gif or .mp4; by default animate-SCENE.html")
    parser.set_defaults(run=_animate)


def _animate(parser: argparse.ArgumentParser, arguments: argparse.Namespace) -> int:
    from .compare import chosen, solve
    from .plotting import animate
    from .plotting.motion import FPS, frame_times

    scene = options.drawn(parser, arguments.scene)
    t1 = scene.t1 if arguments.t1 is None else arguments.t1
    options.refuse_not_positive(parser, **{"--t1": t1})
    if arguments.speed is not None:
        options.refuse_not_positive(parser, **{"--speed": arguments.speed})
    path = arguments.out or Path(f"animate-{arguments.scene}.html")
    options.refuse_unwritable_film(parser, path)
    try:
        (method,) = chosen(scene, [arguments.method]).values()
        speed, times = frame_times((0.0, t1), FPS, arguments.speed)
        film = animate(
            scene, solve(scene, method, times, 1e-8), speed=speed, title=f"{scene.name} by {arguments.method}"
        )
    except (RuntimeError, TypeError, ValueError) as refusal:
        parser.error(str(refusal))
    print(f"{scene.name}, {t1:g} s by {arguments.method}, {film.pace}")
    print(film.save(path))
    return 0


def _of_a_checkout(parser: argparse.ArgumentParser, package: str, arguments: list[str]) -> int:
    root = Path(__file__).parents[2]
    if root.joinpath(*package.split("."), "__main__.py").exists():
        sys.path.insert(0, str(root))
        return importlib.import_module(f"{package}.__main__").main(arguments)
    absent = (
        "the benchmarks are part of the source repository, not of the installed package: in a checkout, `pip install -e .` and run "
        "this again"
    )
    if {"-h", "--help"} & set(arguments):
        print(f"usage: {parser.prog} [-h] ...\n\n{absent}")
        return 0
    return parser.error(absent)


if __name__ == "__main__":
    sys.exit(main())
