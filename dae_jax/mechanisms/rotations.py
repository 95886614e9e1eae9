"""Rotations by unit quaternions e = (e₀, e₁, e₂, e₃), e₀ the scalar part, which turn body axes into world axes.

Source: P. E. Nikravesh, *Computer-Aided Analysis of Mechanical Systems*, ch. 6 (Euler parameters); its L is E here.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float


# Signs of entries of e in E(e) of `rates`, and in E₊(e). One product of arrays, of all bodies at once, is a program of a third of the
# size of twelve products of entries.
_SIGNS = np.array([[-1, 1, 1, -1], [-1, -1, 1, 1], [-1, 1, -1, 1]])
_SIGNS_PLUS = np.array([[-1, 1, -1, 1], [-1, 1, 1, -1], [-1, -1, 1, 1]])


def matrix(e: Float[Array, "4"]) -> Float[Array, "3 3"]:
    """R(e) = E₊ Eᵀ, homogeneous of degree 2 in e: a rotation where |e| = 1 (Nikravesh, eq. 6.19)."""
    entries = _entries(e)
    plus, minus = (entries * signs.astype(e.dtype) for signs in (_SIGNS_PLUS, _SIGNS))
    return jnp.sum(plus[:, None, :] * minus, 2)


def rates(e: Float[Array, "4"]) -> Float[Array, "3 4"]:
    """E(e): ω = 2 E ė in body axes, ė = Eᵀω/2; E Eᵀ = 1 and E e = 0 where |e| = 1 (Nikravesh, eq. 6.48)."""
    return _entries(e) * _SIGNS.astype(e.dtype)


def _entries(e: Float[Array, "4"]) -> Float[Array, "3 4"]:
    """Those of E(e) without signs: (x, w, z, y), (y, z, w, x), (z, y, x, w)."""
    pairs = e.reshape(2, 2)
    return jnp.stack([lax.rev(pairs, axes) for axes in ((1,), (0,), (0, 1))]).reshape(3, 4)


def rotate(r: Float[Array, "d d"], p: Float[Array, " d"]) -> Float[Array, " d"]:
    """R p, as a sum, which becomes part of a kernel."""
    return jnp.sum(r * p, 1)


def rotate_back(r: Float[Array, "d d"], p: Float[Array, " d"]) -> Float[Array, " d"]:
    """Rᵀ p."""
    return jnp.sum(r * p[:, None], 0)


def plane(angle: Float[Array, ""]) -> Float[Array, "2 2"]:
    """The rotation of the plane by an angle."""
    c, s = jnp.cos(angle), jnp.sin(angle)
    return jnp.stack([jnp.stack([c, -s]), jnp.stack([s, c])])


@functools.partial(jax.jit, inline=True)
def frame(axis: Float[Array, "3"]) -> Float[Array, "3 3"]:
    """Columns x, y, z of a right-handed orthonormal frame with z along `axis`; the unit matrix for the z axis.

    Source: T. Duff et al., *Building an Orthonormal Basis, Revisited*, JCGT 6 (2017).
    """
    x, y, z = axis / jnp.sqrt(jnp.sum(axis**2))
    sign = jnp.where(z >= 0, 1.0, -1.0)
    a = -1 / (sign + z)
    b = x * y * a
    first = jnp.stack([1 + sign * x * x * a, sign * b, -sign * x])
    second = jnp.stack([b, sign + y * y * a, -y])
    return jnp.stack([first, second, jnp.stack([x, y, z])], 1)


def cross(spin: Float[Array, "..."], arm: Float[Array, " d"]) -> Float[Array, " d"]:
    """ω × p, in space or in the plane, where ω is a number."""
    if spin.ndim == 0:
        return spin * jnp.stack([-arm[1], arm[0]])
    (a, b, c), (x, y, z) = spin, arm
    return jnp.stack([b * z - c * y, c * x - a * z, a * y - b * x])


def moment(arm: Float[Array, " d"], force: Float[Array, " d"]) -> Float[Array, "..."]:
    """p × F, a number in the plane."""
    return cross(arm, force) if arm.shape[0] == 3 else arm[0] * force[1] - arm[1] * force[0]


def quaternion(axis: Float[Array, "3"], angle: Float[Array, ""]) -> Float[Array, "4"]:
    """The unit quaternion of a turn by an angle in rad about an axis."""
    unit = axis / jnp.sqrt(jnp.sum(axis**2))
    return jnp.concatenate([jnp.cos(angle / 2)[None], jnp.sin(angle / 2) * unit])


def conjugate(e: Float[Array, "4"]) -> Float[Array, "4"]:
    """The quaternion of the turn back."""
    return jnp.concatenate([e[:1], -e[1:]])


def product(a: Float[Array, "4"], b: Float[Array, "4"]) -> Float[Array, "4"]:
    """The quaternion of the turn a after the turn b."""
    back = conjugate(a)
    return jnp.concatenate([jnp.sum(back * b)[None], rotate(rates(back), b)])
