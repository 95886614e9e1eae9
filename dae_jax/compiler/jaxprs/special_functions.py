"""Primitives that are written with simpler ones, entry by entry: special functions, and bits from a counter."""

import functools
import math
from collections.abc import Callable, Hashable, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jax.extend.core import ClosedJaxpr
from jaxtyping import Array

from ..types import DType, Equation


def _polynomial(coefficients: Sequence[float], x: Array) -> Any:
    return functools.reduce(lambda p, c: p * x + jnp.asarray(c, x.dtype), coefficients, jnp.zeros_like(x))


# M. Giles, "Approximating the erfinv function", in GPU Computing Gems: in w = −log(1 − x²), or its square root.
_ERF_INV_32 = (
    (2.81022636e-08, 3.43273939e-07, -3.5233877e-06, -4.39150654e-06, 0.00021858087, -0.00125372503, -0.00417768164,
     0.246640727, 1.50140941),
    (-0.000200214257, 0.000100950558, 0.00134934322, -0.00367342844, 0.00573950773, -0.0076224613, 0.00943887047,
     1.00167406, 2.83297682),
)  # fmt: skip
_ERF_INV_64 = (
    (-3.6444120640178196996e-21, -1.685059138182016589e-19, 1.2858480715256400167e-18, 1.115787767802518096e-17,
     -1.333171662854620906e-16, 2.0972767875968561637e-17, 6.6376381343583238325e-15, -4.0545662729752068639e-14,
     -8.1519341976054721522e-14, 2.6335093153082322977e-12, -1.2975133253453532498e-11, -5.4154120542946279317e-11,
     1.051212273321532285e-09, -4.1126339803469836976e-09, -2.9070369957882005086e-08, 4.2347877827932403518e-07,
     -1.3654692000834678645e-06, -1.3882523362786468719e-05, 0.0001867342080340571352, -0.00074070253416626697512,
     -0.0060336708714301490533, 0.24015818242558961693, 1.6536545626831027356),
    (2.2137376921775787049e-09, 9.0756561938885390979e-08, -2.7517406297064545428e-07, 1.8239629214389227755e-08,
     1.5027403968909827627e-06, -4.013867526981545969e-06, 2.9234449089955446044e-06, 1.2475304481671778723e-05,
     -4.7318229009055733981e-05, 6.8284851459573175448e-05, 2.4031110387097893999e-05, -0.0003550375203628474796,
     0.00095328937973738049703, -0.0016882755560235047313, 0.0024914420961078508066, -0.0037512085075692412107,
     0.005370914553590063617, 1.0052589676941592334, 3.0838856104922207635),
    (-2.7109920616438573243e-11, -2.5556418169965252055e-10, 1.5076572693500548083e-09, -3.7894654401267369937e-09,
     7.6157012080783393804e-09, -1.4960026627149240478e-08, 2.9147953450901080826e-08, -6.7711997758452339498e-08,
     2.2900482228026654717e-07, -9.9298272942317002539e-07, 4.5260625972231537039e-06, -1.9681778105531670567e-05,
     7.5995277030017761139e-05, -0.00021503011930044477347, -0.00013871931833623122026, 1.0103004648645343977,
     4.8499064014085844221),
)  # fmt: skip


def erf_inv(x: Array, **_: object) -> Any:
    """y with erf(y) = x."""
    w = -jnp.log1p(-x * x)
    root = jnp.sqrt(w)
    if x.dtype == jnp.float64:
        central, middle, tail = _ERF_INV_64
        far = jnp.where(w < 16, _polynomial(middle, root - 3.25), _polynomial(tail, root - 5))
        found = jnp.where(w < 6.25, _polynomial(central, w - 3.125), far)
    else:
        central, tail = _ERF_INV_32
        found = jnp.where(w < 5, _polynomial(central, w - 2.5), _polynomial(tail, root - 3))
    return jnp.where(jnp.abs(x) == 1, x * jnp.inf, found * x)


_LANCZOS = (
    676.520368121885098567009190444019, -1259.13921672240287047156078755283, 771.3234287776530788486528258894,
    -176.61502916214059906584551354, 12.507343278686904814458936853, -0.13857109526572011689554707,
    9.984369578019570859563e-6, 1.50563273514931155834e-7,
)  # fmt: skip


# From JAX 0.11 on.
AT_ZERO = -math.inf if jax.__version_info__ >= (0, 11) else math.nan


def digamma(x: Array, **_: object) -> Any:
    """The derivative of log Γ(x), by Lanczos' approximation; below 1/2 by reflection."""
    reflected = x < 0.5
    z = jnp.where(reflected, -x, x - 1)
    top, bottom = jnp.zeros_like(x), jnp.full_like(x, 0.99999999999980993227684700473478)
    for k, c in enumerate(_LANCZOS):
        term = c / (z + (k + 1))
        top, bottom = top - term / (z + (k + 1)), bottom + term
    t = z + 7.5
    found = math.log(7.5) + jnp.log1p(z / 7.5) + top / bottom - 7 / t
    # The cotangent of what is left of x: x itself would lose digits.
    rest = math.pi * (x + jnp.abs(jnp.floor(x + 0.5)))
    found = jnp.where(reflected, found - math.pi * jnp.cos(rest) / jnp.sin(rest), found)
    found = jnp.where((x <= 0) & (x == jnp.floor(x)), jnp.nan, found)
    return jnp.where(x == 0, AT_ZERO, found)


_ROTATIONS = ((13, 15, 26, 6), (17, 29, 16, 24))


def threefry2x32(key1: Array, key2: Array, x1: Array, x2: Array) -> tuple[Any, Any]:
    """Threefry with 20 rounds: random bits from a key and a counter."""
    keys = [key1, key2, key1 ^ key2 ^ jnp.uint32(0x1BD11BDA)]
    x1, x2 = x1 + keys[0], x2 + keys[1]
    for turn in range(5):
        for r in _ROTATIONS[turn % 2]:
            x1 = x1 + x2
            x2 = x1 ^ ((x2 << jnp.uint32(r)) | (x2 >> jnp.uint32(32 - r)))
        x1, x2 = x1 + keys[(turn + 1) % 3], x2 + keys[(turn + 2) % 3] + jnp.uint32(turn + 1)
    return x1, x2


def iota_2x32_shape(*, shape: tuple[int, ...]) -> tuple[Any, Any]:
    """The places of an array's entries in row-major order, in two halves of 64 bits."""
    low = jnp.arange(math.prod(shape), dtype=jnp.uint32).reshape(shape)
    return jnp.zeros_like(low), low


SPECIAL: dict[str, Callable[..., Any]] = {
    "digamma": digamma,
    "erf_inv": erf_inv,
    "threefry2x32": threefry2x32,
    "iota_2x32_shape": iota_2x32_shape,
}


def by_simpler_ones(eqn: Equation, table: Mapping[str, Callable[..., Any]] = SPECIAL) -> ClosedJaxpr:
    """A jaxpr that computes what an equation does whose primitive is in a table, from its name to a function."""
    structs = tuple((v.aval.shape, v.aval.dtype) for v in eqn.invars)
    params = tuple(eqn.primitive.get_bind_params(eqn.params).items())
    found = _traced(table[eqn.primitive.name], structs, params)
    assert [(a.shape, a.dtype) for a in found.out_avals] == [(v.aval.shape, v.aval.dtype) for v in eqn.outvars]
    return found


@functools.lru_cache(maxsize=256)
def _traced(
    fn: Callable[..., Any], structs: tuple[tuple[tuple[int, ...], DType], ...], params: tuple[tuple[str, Hashable], ...]
) -> ClosedJaxpr:
    return jax.make_jaxpr(functools.partial(fn, **dict(params)))(*(jax.ShapeDtypeStruct(*s) for s in structs))
