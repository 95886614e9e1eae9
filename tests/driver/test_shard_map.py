"""Solves within `jax.shard_map`, whose results vary from device to device as what they are given does."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.sharding import Mesh, PartitionSpec

from dae_jax import DOP853, ConstrainedSystem, OrthogonalProjection, compiler, daesolve


MESH = Mesh(np.array(jax.devices()), ("x",))
EACH, WHOLE = PartitionSpec("x"), PartitionSpec()
SYSTEM = ConstrainedSystem(lambda t, q, v, a: jnp.array([0.0, -a]), lambda t, q, a: (q @ q - 1) / 2)
GRAVITY = jnp.linspace(9.0, 10.0, 4)


def end(gravity):
    y0 = jnp.array([1.0, 0.0]), jnp.zeros(2)
    return daesolve(SYSTEM, OrthogonalProjection(DOP853()), 0.0, 0.5, None, y0, gravity).ys[0][-1, 0]


def sharded(fn, out=EACH):
    return jax.jit(jax.shard_map(fn, mesh=MESH, in_specs=EACH, out_specs=out))


@pytest.mark.parametrize("of", [lambda fn: fn, jax.grad, jax.jacfwd], ids=["values", "reverse", "forward"])
def test_each_device_has_its_part(of):
    np.testing.assert_array_equal(sharded(jax.vmap(of(end)))(GRAVITY), jax.vmap(of(end))(GRAVITY))


def test_the_gradient_of_what_all_devices_add_to():
    mean = lambda gravity: jnp.mean(jax.vmap(end)(gravity))
    all_of_it = sharded(lambda gravity: jax.lax.pmean(mean(gravity), "x"), WHOLE)
    np.testing.assert_allclose(jax.grad(all_of_it)(GRAVITY), jax.grad(mean)(GRAVITY), rtol=1e-14)


@pytest.mark.parametrize("fn", [end, compiler.jit(jnp.sin)], ids=["a solve", "a kernel"])
def test_what_one_device_has_never_passes_for_all(fn):
    """Of a sum over a device's own part, JAX would show that of the first device."""
    total = sharded(lambda gravity: jnp.sum(jax.vmap(fn)(gravity)), WHOLE)
    with pytest.raises(ValueError, match="out_specs"):
        total(GRAVITY)
