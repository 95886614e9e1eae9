"""python -m tests.compiler.fuzz.break_rules [NAME ...]: breaks the compiler at one place after the other, and says which of the
programs that are always the same finds it.
"""

import contextlib
import dataclasses
import importlib
import inspect
import os
import sys
import textwrap
from collections.abc import Iterable, Iterator
from typing import Any


os.environ.setdefault("JAX_PLATFORMS", "cpu")

import jax


@dataclasses.dataclass(frozen=True)
class Break:
    """A function of the compiler, one piece of its text, and what stands there instead; `primitives`: where it shows."""

    where: str
    old: str
    new: str
    primitives: frozenset[str]

    @contextlib.contextmanager
    def done(self) -> Iterator[None]:
        """The function, broken: also where it has been entered in a table."""
        module, _, name = self.where.partition(":")
        function = importlib.import_module(f"dae_jax.compiler.lower.{module}")
        for part in name.split("."):
            function = getattr(function, part)
        function: Any = inspect.unwrap(function)
        text = textwrap.dedent(inspect.getsource(function))
        assert text.count(self.old) == 1, f"{self.where} has {self.old!r} {text.count(self.old)} times"
        space: dict[str, Any] = {}
        body = text[text.index("def ") :].replace(self.old, self.new)
        exec(compile(body, self.where, "exec"), function.__globals__, space)
        whole, function.__code__ = function.__code__, space[function.__name__].__code__
        try:
            yield
        finally:
            function.__code__ = whole


def _break(where: str, old: str, new: str, primitives: str) -> Break:
    return Break(where, old, new, frozenset(primitives.split()))


BREAKS = {
    "unsigned as signed": _break(
        "arithmetic:applied", '"s" if is_signed(dtype) else "u"', '"s"', "max min reduce_max reduce_min cummax cummin clamp"
    ),
    "extended with the sign": _break(
        "arithmetic:convert", '"sext" if is_signed(dtype) else "zext"', '"sext"', "convert_element_type"
    ),
    "shifts without a limit": _break(
        "rules.integers:shift", 'code.op("icmp ule", kind, by, last, result="i1")', "True", "shift_left shift_right_logical"
    ),
    "division by zero": _break("arithmetic:_quotient", '-1 if name == "div" else a', "0", "div rem"),
    "the sign of a product": _break(
        "complex_arithmetic:multiplied", 'code.op("fsub contract"', 'code.op("fadd contract"', "mul integer_pow square"
    ),
    "windows one short": _break(
        "indices:window_start", 'code.intrinsic("smin", "i64", i, n - size)', 'code.intrinsic("smin", "i64", i, n - size - 1)',
        "dynamic_slice dynamic_update_slice",
    ),
    "writes outside": _break("rules.indexing:_scattered", "if inside is not None:", "if False:", "scatter scatter-add"),
    "reads outside": _break(
        "indices:places_of", "if checked and not (is_number(fits) and fits):", "if False:", "gather"
    ),
    "not a number passed over": _break(
        "arithmetic:better", 'code.op("or", "i1", undefined, wins)', "wins", "argmax argmin"
    ),
    "lanes that are done": _break("carry:_chosen", "y if y == z else", "y if True else", "while"),
    "memory that is shared": _break(
        "rules.indexing:_owned", "if shared(x, y) else y", "if False else y", "scatter scatter-add dynamic_update_slice"
    ),
    "loops that overwrite": _break(
        "carry:kept_apart", "isinstance(own, View) and overwritten(x, own)", "False", "scan while"
    ),
    "backwards": _break("rules.loops:_scanned", 'if p["reverse"] else i', "if False else i", "scan"),
}  # fmt: skip


def found(broken: Break, programs: Iterable[Any]) -> tuple[int, str] | None:
    """After how many programs the break is found, and what says so."""
    from . import campaign

    count = 0
    with broken.done():
        for bundle in campaign.bundles(programs):
            said = campaign.report(bundle)
            count += len(bundle)
            jax.clear_caches()
            if said:
                return count, said[0]
    return None


def main(names: list[str]) -> int:
    from . import campaign

    jax.config.update("jax_enable_x64", True)
    missed = 0
    for name in names or BREAKS:
        seen = found(BREAKS[name], campaign.fixed())
        missed += seen is None
        print(f"{name}: {'NOT FOUND' if seen is None else f'found within {seen[0]} programs'}", flush=True)
        print(textwrap.indent(seen[1] if seen else "", "    "), flush=True)
    return missed


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
