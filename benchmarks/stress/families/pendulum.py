"""The pendulum of the long, fast, exact and broken stressors, with its truth by elliptic functions."""

import jax.numpy as jnp
import numpy as np
from scipy.special import ellipj, ellipkinc

import dae_jax as dj


def force(t, q, v, a):
    """The weight, y pointing down; not a number after a time, infinite after another, beyond a height."""
    weight = jnp.stack([0 * a["gravity"], a["gravity"]])
    bad = jnp.where(t > a["nan after"], jnp.nan, jnp.where(t > a["infinite after"], jnp.inf, 0.0))
    return weight + jnp.where(q[1] < a["nan above"], jnp.nan, bad)


def constraint(t, q, a):
    return (q @ q - 1) / 2


def chart(t, z, a):
    return jnp.stack([jnp.sin(z[0]), jnp.cos(z[0])])


SYSTEM = dj.ConstrainedSystem(force, constraint)
NEVER = {"nan after": np.asarray(np.inf), "infinite after": np.asarray(np.inf), "nan above": np.asarray(-np.inf)}


def start(angle, rate):
    """(q, v) at an angle from the downward vertical in rad, with an angular velocity in 1/s."""
    return np.array([np.sin(angle), np.cos(angle)]), rate * np.array([np.cos(angle), -np.sin(angle)])


def exact(angle, rate, gravity):
    """times → (q, v) of θ̈ = −g sin θ: sin(θ/2) = k sn(ωt + u₀ | k²) where it swings, ± sn(ωkt + u₀ | 1/k²) where it turns over.

    k² comes from 1 − cos θ₀ = 2 sin²(θ₀/2), which keeps its digits.
    """
    omega = np.sqrt(gravity)
    k = np.hypot(rate / (2 * omega), np.sin(angle / 2))

    def truth(times):
        t = np.asarray(times, float)
        if k < 1:
            u0 = ellipkinc(np.arctan2(np.sin(angle / 2) / k, rate / (2 * omega * k)), k**2)
            sn, cn, dn, _ = ellipj(omega * t + u0, k**2)
            half, whole, rates = k * sn, dn, 2 * omega * k * cn
        else:
            u0 = ellipkinc(np.sign(rate) * angle / 2, 1 / k**2)
            sn, cn, dn, _ = ellipj(omega * k * t + u0, 1 / k**2)
            half, whole, rates = np.sign(rate) * sn, cn, np.sign(rate) * 2 * omega * k * dn
        sine, cosine = 2 * half * whole, 1 - 2 * half**2
        return np.stack([sine, cosine], -1), rates[:, None] * np.stack([cosine, -sine], -1)

    return truth
