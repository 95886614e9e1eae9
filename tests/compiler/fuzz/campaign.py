"""Which programs are run, many compiled together."""

from collections.abc import Iterable, Iterator, Sequence

from dae_jax.compiler.jaxprs.scalar_interpreter import Unsupported

from .check import differences
from .numbers import Draw
from .programs import CLAIMED, Program, composed, single
from .shrink import shrunk


# As many compile together; more take LLVM longer than each by itself.
TOGETHER = 32
COMPOSED = 100


def of_seed(seed: int) -> Iterator[Program]:
    """One for each primitive on each type of numbers, and compositions."""
    order = Draw(seed).order(len(CLAIMED))
    yield from (single(*CLAIMED[k], seed) for k in order)
    yield from (composed(COMPOSED * seed + k, copies=k % 3 == 0) for k in range(COMPOSED))


def fixed() -> Iterator[Program]:
    """Those that are always the same: 485 with one primitive, evenly over the table, and 15 compositions."""
    order = Draw(0).order(len(CLAIMED))
    yield from (single(*CLAIMED[k], 0) for k in order[:485])
    yield from (composed(k, copies=k % 3 == 0) for k in range(15))


def new(seed: int) -> Iterator[Program]:
    """94 with one primitive and 6 compositions."""
    draw = Draw(seed)
    yield from (single(*draw.one_of(CLAIMED), seed) for _ in range(94))
    yield from (composed(seed + k, copies=k % 3 == 0) for k in range(6))


def bundles(programs: Iterable[Program]) -> Iterator[list[Program]]:
    """Such as take copies by themselves, of compositions a few."""
    waiting: dict[tuple[bool, bool], list[Program]] = {}
    for program in programs:
        kind = program.copies, len(program.operands) == 4 and program.name.startswith("composed")
        waiting.setdefault(kind, []).append(program)
        if len(waiting[kind]) == (TOGETHER // 4 if kind[1] else TOGETHER):
            yield waiting.pop(kind)
    yield from waiting.values()


def report(programs: Sequence[Program]) -> list[str]:
    """What is wrong with them: of each program the smallest part that differs, or why it cannot be compiled."""
    try:
        found = differences(programs)
    except Exception as error:
        if len(programs) > 1:
            return [line for half in (programs[::2], programs[1::2]) for line in report(half)]
        what = f"{type(error).__name__} {error}".splitlines()[0][:300]
        return [f"{programs[0].name}: {'refused' if isinstance(error, Unsupported) else 'fails'}: {what}"]
    return [f"{d}\n{shrunk(d) or 'By itself it is right.'}" for d in {d.program.name: d for d in found[::-1]}.values()]
