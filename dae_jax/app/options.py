"""What the command line finds out about its options before any work is done; all end with the status 2 and one line."""

import argparse
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any


# What float64 can do.
TIGHTEST = 1e-14


def scenes() -> dict[str, Callable[[], Any]]:
    """The ready scenes by name, those of bodies and joints too."""
    from ..mechanisms import EXAMPLES
    from ..scenes import SCENES

    return {**SCENES, **EXAMPLES}


def scene(parser: argparse.ArgumentParser, name: str, advice: str = "") -> Any:
    """The ready scene of this name; `advice`: what else there is."""
    if name not in scenes():
        parser.error(f"unknown scene {name!r}; choose from {', '.join(scenes())}{advice}")
    return scenes()[name]()


def mechanism(parser: argparse.ArgumentParser, name: str) -> Any:
    """The same, of a mechanism."""
    from ..systems import is_mechanism

    found = scene(parser, name)
    if not is_mechanism(found.system):
        parser.error(f"{name} is no mechanism: Baumgarte's parameters are for a ConstrainedSystem")
    return found


def drawn(parser: argparse.ArgumentParser, name: str) -> Any:
    """The same, of a scene that has a drawing."""
    found = scene(parser, name)
    if found.drawing is None:
        others = [other for other, make in scenes().items() if make().drawing is not None]
        parser.error(f"{name} has no drawing; choose from {', '.join(others)}")
    return found


def refuse_not_positive(parser: argparse.ArgumentParser, **options: float) -> None:
    """Of --option=value, those that no time, step or count can be."""
    for option, value in options.items():
        if not 0 < value < float("inf"):
            parser.error(f"{option} must be positive and finite, but is {value}")


def refuse_bad_tolerance(parser: argparse.ArgumentParser, rtol: float) -> None:
    """What no solve in float64 can keep, or what is no tolerance."""
    if not TIGHTEST <= rtol < 1:
        parser.error(f"--rtol must be between {TIGHTEST:g}, which float64 can do, and 1, but is {rtol:g}")


def writable(parser: argparse.ArgumentParser, folder: Path) -> Path:
    """The folder, made where it was not there. Found out before hours of work, not after."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            return folder
    except OSError as refusal:
        parser.error(f"--out {str(folder)!r} cannot be written: {refusal.strerror}")


def refuse_unwritable_picture(parser: argparse.ArgumentParser, path: Path) -> None:
    """A file of an unknown type, or where none can be written."""
    from .plotting import FILE_TYPES

    if path.suffix not in FILE_TYPES:
        parser.error(f"--out {str(path)!r} must end in {', '.join(FILE_TYPES)}")
    _refuse_no_place(parser, path)


def refuse_unwritable_film(parser: argparse.ArgumentParser, path: Path) -> None:
    """A file that no animation can be saved as, or where none can be written."""
    from .plotting.animation import refuse_film_type

    try:
        refuse_film_type(path)
    except (RuntimeError, ValueError) as refusal:
        parser.error(f"--out {str(path)!r}: {refusal}")
    _refuse_no_place(parser, path)


def _refuse_no_place(parser: argparse.ArgumentParser, path: Path) -> None:
    if not path.parent.is_dir() or path.is_dir():
        parser.error(f"--out {str(path)!r} cannot be written: {path.parent} is no folder, or it is one itself")
    writable(parser, path.parent)
