"""What is said of arguments that are none, and what is printed of batches and warnings."""

import diffrax
import jax
import jax.numpy as jnp
import pytest

import dae_jax


DECAY = dae_jax.ImplicitDAE(lambda t, y, yd, rate: yd + rate * y)


def solve(rate, dt0=None, **options):
    return dae_jax.daesolve(DECAY, diffrax.Tsit5(), 0.0, 1.0, dt0, jnp.ones(1), rate, **options)


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("rtol", r"`daesolve` has no argument `rtol`: .* `stepsize_controller=diffrax\.PIDController\(rtol=1e-6, atol=1e-6\)`"),
        ("atol", r"no argument `atol`: .*PIDController"),
        ("t_eval", r"no argument `t_eval`: .*`saveat=diffrax\.SaveAt\(ts=\.\.\.\)`"),
        ("steps", r"no argument `steps`: there are `system`, .*`max_steps`"),
    ],
)  # fmt: skip
def test_an_argument_that_is_none_says_which_is_meant(name, said):
    with pytest.raises(TypeError, match=said):
        solve(1.0, **{name: 1e-6})


def test_a_batch_is_printed_as_how_many_were_successful():
    """Not as a sentence for each."""
    sol = jax.vmap(lambda rate: solve(rate, throw=False, max_steps=12))(jnp.linspace(1.0, 1000.0, 50))
    assert "result=<1 of 50 successful>" in repr(sol)
    assert len(repr(sol)) < 1000
    assert "result=dae_jax.solution.RESULTS<successful>" in repr(solve(1.0))


def test_a_warning_is_where_the_solve_was_asked_for():
    with pytest.warns(dae_jax.AccuracyWarning) as caught:
        solve(100.0, dt0=0.05)
    assert caught[0].filename == __file__
