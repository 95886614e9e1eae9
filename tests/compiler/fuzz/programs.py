"""Programs: one operation in control flow or differentiated, and many operations after one another."""

import dataclasses
import functools
import zlib
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from dae_jax.compiler.jaxprs.special_functions import SPECIAL
from dae_jax.compiler.lower.registry import RULES

from . import arrays as arrays
from .numbers import Draw, Operand
from .operations import RECIPES, Operation


# What the compiler says that it takes: by a rule, or by simpler primitives.
CLAIMED = sorted(
    (name, dtype)
    for name, dtype in RECIPES
    if name in SPECIAL or (name in RULES and dtype in frozenset().union(*RULES[name].dtypes))
)


@dataclasses.dataclass(frozen=True)
class Program:
    """`shared`: which operands are the same for all elements of a batch; `ulps`, `scale`: how far the results may be off, in
    units in the last place of themselves and of the largest of them.
    """

    name: str
    fn: Callable[..., Sequence[Any]]
    operands: tuple[Operand, ...]
    shared: tuple[bool, ...]
    ulps: float = 0
    scale: float = 0
    copies: bool = False


def _turned(x: Any) -> Any:
    """The entries in another order."""
    return jnp.roll(x, 1) if x.size > 1 and x.ndim else x


def _in_scan(fn: Any, k: Any, xs: Any) -> Any:
    reverse = len(xs) % 2 == 0
    return lax.scan(
        lambda c, _: (tuple(map(_turned, c)), fn(*c)), tuple(xs), None, 3, reverse=reverse, unroll=1 + reverse
    )[1]


def _in_while(fn: Any, k: Any, xs: Any) -> Any:
    turn = lambda c: (c[0] + 1, tuple(map(_turned, c[1])), fn(*c[1]))
    return lax.while_loop(lambda c: c[0] < k % 3 + 1, turn, (jnp.int32(0), tuple(xs), fn(*xs)))[2]


def _in_few_turns(fn: Any, k: Any, xs: Any) -> Any:
    turn = lambda c: (c[0] + 1, tuple(map(_turned, c[1])), fn(*c[1]))
    first = jnp.where(k % 2 == 0, 0, 1)
    return lax.while_loop(lambda c: c[0] < 3, turn, (first, tuple(xs), fn(*xs)))[2]


def _in_cond(fn: Any, k: Any, xs: Any) -> Any:
    return lax.cond(k % 2 == 0, fn, lambda *xs: fn(*map(_turned, xs)), *xs)


def _in_switch(fn: Any, k: Any, xs: Any) -> Any:
    zeros = lambda *xs: jax.tree.map(jnp.zeros_like, fn(*xs))
    return lax.switch(k - 1, [fn, zeros, lambda *xs: fn(*map(_turned, xs))], *xs)


def _in_vmap(fn: Any, k: Any, xs: Any) -> Any:
    return jax.vmap(fn)(*(jnp.stack([x, _turned(x)]) for x in xs)) if xs else fn()


def called_twice(program: "Program") -> "Program":
    """The same, and the same of operands in another order, by one function; and by one that is equal to it, with its arguments in another
    order, one that is handed through, and results that are there twice.
    """
    call = jax.jit(lambda *xs: tuple(program.fn(*xs)))

    @jax.jit
    def equal(k: Any, *xs: Any) -> Any:
        found = tuple(program.fn(*xs, k))
        return found, k, found

    def fn(*xs: Any) -> list[Any]:
        return [*call(*xs), *call(*map(_turned, xs[:-1]), xs[-1]), *jax.tree.leaves(equal(xs[-1], *xs[:-1]))]

    return dataclasses.replace(program, name=f"{program.name} twice", fn=fn)


NESTS = {
    "scan": _in_scan, "while": _in_while, "few turns": _in_few_turns, "cond": _in_cond, "switch": _in_switch,
    "vmap": _in_vmap,
}  # fmt: skip


def _pushed(fn: Any, xs: Any) -> Any:
    """The results and their derivative along a direction of the same kind."""
    smooth = [jnp.issubdtype(x.dtype, jnp.floating) for x in xs]
    merged = lambda ys: [y if s else x for x, y, s in zip(xs, ys, smooth, strict=True)]
    return jax.jvp(lambda *ys: fn(*merged(ys)), _inexact(xs, smooth), _inexact(list(map(_turned, xs)), smooth))


def _pulled(fn: Any, xs: Any) -> Any:
    smooth = [jnp.issubdtype(x.dtype, jnp.floating) for x in xs]

    def of_smooth(*ys: Any) -> Any:
        rest = iter(ys)
        return fn(*(next(rest) if s else x for x, s in zip(xs, smooth, strict=True)))

    out, pull = jax.vjp(of_smooth, *(x for x, s in zip(xs, smooth, strict=True) if s))
    return out, pull(jax.tree.map(lambda y: jnp.full_like(y, 0.5), out))


def _inexact(xs: Any, smooth: Any) -> tuple[Any, ...]:
    return (
        tuple(xs)
        if all(smooth)
        else tuple(x if s else np.zeros(x.shape, jax.dtypes.float0) for x, s in zip(xs, smooth, strict=True))
    )


def single(name: str, dtype: str, seed: int) -> Program:
    """One primitive on one type of numbers, as it is, in control flow or differentiated."""
    draw = Draw(zlib.crc32(f"{name} {dtype}".encode()), seed)
    operation = RECIPES[name, dtype](name, dtype, draw)
    operands, fn, ulps, scale = operation.operands, operation.fn, operation.ulps, 0.0
    nest = draw.one_of([None, None, None, *NESTS])
    how = draw.one_of([None, None, _pushed, _pulled]) if operation.smooth and dtype != "complex128" else None
    if how:
        operands = tuple(o._replace(domain="smooth") if o.domain in ("edges", "plain", "grid") else o for o in operands)
        fn, ulps, scale = (lambda *xs, fn=fn: how(fn, xs)), max(ulps, 64), 256
    if draw.chance(0.12) and name != "clz":  # some or all of them are known
        known = {i: draw.numbers(o) for i, o in enumerate(operands) if draw.chance(0.6)}
        fn = functools.partial(_with_known, fn, known)
        operands = tuple(o for i, o in enumerate(operands) if i not in known)
    operands = (*operands, Operand("int32", (), 4))
    run = functools.partial(NESTS[nest] if nest else (lambda fn, k, xs: fn(*xs)), fn)
    shared = tuple(draw.chance(0.15) for _ in operands)
    title = " ".join(filter(None, [name, dtype, nest, how and how.__name__, str(seed)]))
    return Program(title, lambda *xs: jax.tree.leaves(run(xs[-1], xs[:-1])), operands, shared, ulps, scale)


def _with_known(fn: Any, known: dict[int, Any], *xs: Any) -> Any:
    rest = iter(xs)
    return fn(*(jnp.asarray(known[i]) if i in known else next(rest) for i in range(len(known) + len(xs))))


# Compositions


def _shaped(x: Any, shape: Any, draw: Draw) -> Any:
    """The entries of an array in another shape, again and again where they are too few."""
    size = int(np.prod(shape))
    if x.shape == tuple(shape):
        return x
    if not x.size:
        return jnp.ones(shape, x.dtype)
    x = x.reshape(-1)
    if size == x.size:
        return x.reshape(shape)
    match draw.below(3):
        case 0 if size < x.size:
            return x[draw.below(x.size - size + 1) :][:size].reshape(shape)
        case 1:
            return jnp.broadcast_to(x[draw.below(x.size)], shape)
        case _:
            return x[np.arange(size) * (1 + draw.below(5)) % x.size].reshape(shape)


def _typed(x: Any, dtype: Any) -> Any:
    dtype = np.dtype(dtype)
    if x.dtype.kind == "c" and dtype.kind != "c":
        x = lax.real(x)
    if x.dtype.kind == "f" and dtype.kind in "iu":
        x = jnp.clip(jnp.nan_to_num(x), -60, 60)
    return x.astype(dtype)


def _tame(x: Any, ulps: float) -> Any:
    """Eighths of no great size; what is not exact at steps that no result is at the edge of."""
    if x.dtype.kind == "c":
        return lax.complex(_tame(lax.real(x), ulps), _tame(lax.imag(x), ulps))
    if x.dtype.kind != "f":
        return x
    x = jnp.clip(x, -8, 8)
    return jnp.floor(x * 1.9 + 0.317) if ulps else jnp.floor(x * 8) / 8


class Composition:
    """Operations on what was found before, and control flow around such."""

    def __init__(self, seed: int, copies: bool) -> None:
        self.seed, self.inexact = seed, []
        updates = "scatter scatter-add dynamic_update_slice gather dynamic_slice concatenate rev select_n add".split()
        self.choices = [key for key in CLAIMED if not copies or key[0] in updates]

    def operand(self, pool: list[Any], o: Operand, draw: Draw) -> Any:
        near = [x for x in pool if x.dtype == o.dtype and x.shape == o.shape]
        x = draw.one_of(near if near and draw.chance(0.7) else pool[-5:] if draw.chance(0.6) else pool)
        if isinstance(o.domain, int):
            x = _typed(_shaped(x, o.shape, draw), "int32") % (o.domain + 5) - (2 if o.dtype[0] == "i" else 0)
            return x.astype(o.dtype)
        x = _shaped(_typed(x, o.dtype), o.shape, draw)
        if o.domain == "units" and x.dtype.kind == "f":
            return jnp.where(x > 1, jnp.ones_like(x), -jnp.ones_like(x))
        return jnp.nan_to_num(x, posinf=3, neginf=-3) if o.domain == "plain" and x.dtype.kind in "fc" else x

    def steps(self, pool: list[Any], seed: Sequence[int], count: int, depth: int) -> list[Any]:
        pool = list(pool)
        for k in range(count):
            draw = Draw(*seed, k)
            if depth and draw.chance(0.4):
                pool += self.nested(pool, [*seed, k], draw, depth - 1)
            else:
                pool += self.applied(pool, draw)
        return pool

    def applied(self, pool: list[Any], draw: Draw) -> list[Any]:
        name, dtype = draw.one_of(self.choices)
        there = str(draw.one_of(pool).dtype)
        if draw.chance(0.5) and (name, there) in RECIPES:
            dtype = there
        operation: Operation = RECIPES[name, dtype](name, dtype, draw)
        out = jax.tree.leaves(operation.fn(*(self.operand(pool, o, draw) for o in operation.operands)))
        return [_tame(x, operation.ulps or operation.name in INEXACT) for x in out if 0 < x.size < 1000]

    def nested(self, pool: list[Any], seed: Sequence[int], draw: Draw, depth: int) -> list[Any]:
        """A loop or branch that gives values like some that there are."""
        carry = [draw.one_of(pool) for _ in range(1 + draw.below(3))]
        if draw.chance(0.5):
            carry[0] = _shaped(carry[0], (draw.one_of([25, 30, 60]),), draw)
        others, k = [draw.one_of(pool)], _shaped(_typed(draw.one_of(pool), "int32"), (), draw)

        def block(which: int) -> Any:
            def run(*xs: Any) -> tuple[Any, ...]:
                found = self.steps([*others, *xs], [*seed, which], 1 + which % 3, depth)
                again = Draw(*seed, which, 99)
                pick = lambda x: again.one_of(
                    [y for y in found[-4:] if (y.shape, y.dtype) == (x.shape, x.dtype)] or found[-3:]
                )
                return tuple(_shaped(_typed(pick(x), x.dtype), x.shape, again) for x in xs)

            return run

        match draw.below(7):
            case 0:
                return list(lax.cond(k % 2 == 0, block(0), block(1), *carry))
            case 1:
                return list(lax.switch(k % 5 - 1, [block(0), block(1), block(2)], *carry))
            case 2:
                return list(lax.fori_loop(0, 1 + k % 4, lambda _, c: block(1)(*c), tuple(carry)))
            case 3:
                turn = lambda c: (c[0] + 1, *block(2)(*c[1:]))
                return list(lax.while_loop(lambda c: (c[0] < 4) & (c[0] < k % 6), turn, (jnp.int32(0), *carry)))
            case 4 if carry[0].ndim and 0 < carry[0].shape[0] < 70:
                turn = lambda c, row: (block(0)(*c), _shaped(block(1)(row)[0], (2,), draw))
                last, rows = lax.scan(turn, tuple(carry), carry[0], reverse=draw.chance(0.3))
                return [*last, rows]
            case 5:
                out = jax.vmap(lambda *xs: block(1)(*xs))(*(jnp.stack([x, _turned(x)]) for x in carry))
                return [x for x in out if x.size < 1000]
            case _:
                rows = lambda c: lax.scan(lambda c, _: (block(0)(*c), None), c, None, draw.one_of([2, 5, 60]))[0]
                return list(rows(tuple(carry)))

    def __call__(self, *xs: Any) -> list[Any]:
        draw = Draw(self.seed, 1)
        return self.steps(list(xs), [self.seed, 2], 3 + draw.below(7), 2)[-5:]


# Exact on numbers at the edges, but not so that eighths give eighths.
INEXACT = frozenset("div rem nextafter sqrt integer_pow reduce_prod cumprod".split())


def composed(seed: int, copies: bool = False) -> Program:
    """Many operations; with `copies` such as write into memory."""
    draw = Draw(seed, 3)
    dtypes = [
        "float64",
        draw.one_of(["int32", "uint8", "int64"]),
        draw.one_of(["float32", "bool", "uint32", "complex128"]),
    ]
    size = draw.one_of([(3,), (24,), (25,), (60,), (5, 6)])
    operands = (*(Operand(d, size if i != 1 else (9,), "grid") for i, d in enumerate(dtypes)), Operand("int32", (), 8))
    shared = tuple(draw.chance(0.15) for _ in operands)
    return Program(f"composed {seed}", Composition(seed, copies), operands, shared, copies=copies)
