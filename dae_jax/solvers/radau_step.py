"""The equations of a step of a Radau IIA method, and their iteration matrices."""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import diffrax
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from ..compiler import is_large
from .radau_coefficients import Coefficients, coefficients
from .residual_steps import Tolerances, is_smallest, within


# Stages up to which sums over them are written out. With more, a first gradient is ready 8 % sooner by products, and takes as long.
WRITTEN_OUT = 3


class CollocationPolynomial(diffrax.AbstractLocalInterpolation):
    """The polynomial of degree s through the step's start and its s stages y₀ + zᵢ."""

    t0: Any
    t1: Any
    y0: Any
    z: Any

    def evaluate(self, t0: Any, t1: Any = None, left: bool = True) -> Any:
        """The value at `t0`, or the increment from there to `t1`."""
        if t1 is not None:
            return self.evaluate(t1) - self.evaluate(t0)
        h = self.t1 - self.t0
        # After a jump in time diffrax asks for a point that is before the step by round-off.
        part = (within(t0, self.t0, self.t1) - self.t0) / jnp.where(h == 0, 1, h)
        # In a step that a jump may be in, the value is that after it.
        return self.y0 + jnp.where(is_smallest(self.t0, self.t1), self.z[-1], along(self.z, part))


def along(z: Float[Array, "s n"], x: Any) -> Float[Array, " n"]:
    """The collocation polynomial at x h, less y₀."""
    *lower, value = _combined(coefficients(len(z)).polynomial, z)
    for c in reversed(lower):
        value = c + x * value
    return x * value


def _combined(a: Any, x: Any) -> list[Any]:
    """A x for a matrix of numbers and the rows of x: written out, or where that is longer to compile as a product."""
    if len(a) > WRITTEN_OUT:
        x = jnp.stack(list(x))
        return list(jnp.asarray(a, x.dtype) @ x)
    return [sum(float(c) * x[k] for k, c in enumerate(row)) for row in a]


def _looped(fn: Callable[[Any], Any], items: list[Any]) -> list[Any]:
    """fn of each, compiled at one place."""
    found = lax.map(fn, jax.tree.map(lambda *x: jnp.stack(x), *items))
    return [jax.tree.map(lambda x, i=i: x[i], found) for i in range(len(items))]


class Factors(NamedTuple):
    """The factors of the `real` and the `complex` iteration matrices, what may be `round_off` of each equation and what is `enough`."""

    real: Any
    complex: tuple[Any, ...]
    round_off: Float[Array, " n"]
    enough: Float[Array, " n"]
    probe: Any


class Step(NamedTuple):
    """The equations of a step: a pytree, so that they can be differentiated.

    In the smallest step that time resolves all stages are one, that of the implicit Euler method: where a variable
    jumps, equations of both sides of the jump need have no solution together, those of one side have.
    """

    method: Coefficients
    linearised: Any
    sign: Any
    t0: Any
    t1: Any
    y0: Float[Array, " n"]

    @property
    def smallest(self) -> Any:
        """Whether time resolves no smaller step."""
        return is_smallest(self.t0, self.t1)

    @property
    def rates(self) -> Float[Array, "s s"]:
        """h times ẏ at the stages by zⱼ."""
        inverse = jnp.asarray(self.method.inverse, self.y0.dtype)
        return jnp.where(self.smallest, jnp.eye(self.method.stages, dtype=inverse.dtype), inverse)

    @property
    def h(self) -> Any:
        # A lane of a batch that has ended goes on with steps of length 0, whose derivatives are multiplied by 0.
        return jnp.where(self.t1 == self.t0, 1, self.t1 - self.t0)

    def stages(self, z: Float[Array, "s n"]) -> Any:
        """(tᵢ, Yᵢ, ẏ at tᵢ) of each stage."""
        rates = [jnp.where(self.smallest, z[i], rate) for i, rate in enumerate(_combined(self.method.inverse, z))]
        inner = [jnp.where(self.smallest, self.t1, self.t0 + float(c) * self.h) for c in self.method.nodes[:-1]]
        times = [*inner, self.t1]
        return [(self.sign * t, self.y0 + z[i], rates[i] * (self.sign / self.h)) for i, t in enumerate(times)]

    def at_stages(self, fn: Callable[..., Any], z: Float[Array, "s n"]) -> list[Any]:
        """fn(t, y, ẏ) at each stage: in a loop where it is large."""
        stages = self.stages(z)
        if not is_large(fn, *stages[0]):
            return [fn(*stage) for stage in stages]
        return _looped(lambda stage: fn(*stage), stages)

    def residuals(self, z: Float[Array, "s n"]) -> Float[Array, "s n"]:
        """F at the stages."""
        return jnp.stack(self.at_stages(self.linearised.residual, z))

    def jacobians(self, t: Any, y: Any, yd: Any) -> tuple[Any, Any]:
        """∂F/∂y and ∂F/∂(dy/dτ) for the loop's own time τ = ± t."""
        j, m = self.linearised.jacobians(t, y, yd)
        return j, self.sign * m

    def factor(self, jacobians: Any, tol: Tolerances) -> Factors:
        """The factors of γ/h M + J, in the smallest step of M/h + J, and of each (αₖ + iβₖ)/h M + J."""
        j, m = jacobians
        real = self.linearised.factor(j, m, jnp.where(self.smallest, 1, self.method.gamma) / self.h, self.h)
        pairs = [lax.complex(pair.real / self.h, pair.imag / self.h) for pair in self.method.pairs]
        eliminated = lambda c: self.linearised.factor(j, m, c, self.h)
        # The elimination is the larger part of what there is to compile.
        both = map(eliminated, pairs) if len(pairs) == 1 else _looped(eliminated, pairs)
        round_off = tol.round_off(self.linearised, j, m, 1 / self.h, self.y0)
        enough = tol.enough(self.linearised, j, m, 1 / self.h, self.y0)
        return Factors(real, tuple(both), round_off, enough, self.linearised.probe(j, m, real))

    def determines(self, factors: Factors, z: Float[Array, "s n"]) -> Bool[Array, ""]:
        """Whether the matrix that was factorised serves to solve the equations at the end of the step."""
        t, y, yd = self.stages(z)[-1]
        _, _, c = factors.real
        residual = lambda x: self.linearised.residual(t, y + x, yd + self.sign * c * x)
        return factors.probe.determines(
            functools.partial(self.linearised.solve, factors.real), residual, jnp.zeros_like(y)
        )

    def correction(self, factors: Factors, residuals: Float[Array, "s n"]) -> Float[Array, "s n"]:
        """Δz of simplified Newton, decoupled into a real and (s − 1)/2 complex systems."""
        first, *others = _combined(self.method.back, residuals)
        w = self.linearised.solve(factors.real, jnp.where(self.smallest, residuals[-1], first))
        pairs = zip(factors.complex, map(lax.complex, others[::2], others[1::2]), strict=True)
        found = [self.linearised.solve(*pair) for pair in pairs]
        stages = _combined(self.method.transform, [w, *(part for v in found for part in (jnp.real(v), jnp.imag(v)))])
        return -jnp.stack([jnp.where(self.smallest, w, stage) for stage in stages])


def coupled(step: Step, z: Float[Array, "s n"]) -> Any:
    """The Jacobian of all stages at the solution, in the storage of their unknowns interleaved."""
    found = step.at_stages(step.jacobians, z)
    storage, matrix = step.linearised.storage.coupled([j for j, _ in found], [m for _, m in found], step.rates / step.h)
    return storage, matrix, jnp.repeat(step.linearised.column_scale(step.h), step.method.stages)


def linear_solve(jacobian: Any, b: Float[Array, " sn"]) -> Float[Array, " sn"]:
    """x with A x = b for what `coupled` gives."""
    storage, matrix, scale = jacobian
    factors = storage.factor(storage.scale_columns(matrix, scale))
    return scale * storage.solve(factors, b)
