"""Index, offsets and degrees of freedom against the published ones, and verdicts on systems that mislead."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dae_jax
from dae_jax.app.cli import main
from dae_jax.equations.derivative_orders import find_offsets
from dae_jax.equations.residual_form import ResidualForm
from dae_jax.scenes import SCENES, chain


def of_scene(name):
    scene = SCENES[name]()
    return dae_jax.analyse(scene.system, 0.0, scene.y0, scene.args)


def test_pendulum_has_the_published_offsets():
    found = of_scene("pendulum")
    assert found.equation_offsets == (1, 1, 0, 0, 2)
    assert found.pantelides_offsets == found.equation_offsets
    assert (found.index, found.degrees_of_freedom, found.regular) == (3, 2, True)
    assert found.variables == ("q[0]", "q[1]", "v[0]", "v[1]", "multiplier[0]")


@pytest.mark.parametrize(
    ("name", "index", "freedom"),
    [
        ("double-pendulum", 3, 4),
        ("spherical-pendulum", 3, 4),
        ("moving-pivot-pendulum", 3, 2),
        ("four-bar", 3, 2),
        ("slider-crank", 3, 2),
        ("bead-on-torus", 3, 4),
        ("knife-edge", 2, 5),
    ],
)
def test_scenes(name, index, freedom):
    found = of_scene(name)
    assert (found.index, found.degrees_of_freedom, found.regular) == (index, freedom, True)


def hessenberg(depth):
    """x1' = x2, …, x_{k-1}' = x_k, 0 = x1 − sin t: index k."""

    def residual(t, y, yd, args):
        return jnp.concatenate([yd[:-1] - y[1:], jnp.stack([y[0] - jnp.sin(t)])])

    return dae_jax.ImplicitDAE(residual)


@pytest.mark.parametrize(
    ("name", "index"), [("pendulum", 3), ("knife-edge", 2), ("amplifier", 1), ("capacitor-loop", 2), ("jay", 3)]
)
def test_differential_index(name, index):
    assert of_scene(name).differential_index == index


def test_a_differential_index_below_the_structural_one():
    """A family of Reißig, Martinson and Barton: linear, of index 1 and structural index 3."""
    a = np.array([[0.0, 1, 1, 0, 0], [0, 1, 1, 0, 0], [0, 0, 0, 1, 1], [0, 0, 0, 1, 1], [0, 0, 0, 0, 0]])
    found = dae_jax.analyse(implicit(lambda t, y, yd, args: a @ yd + y), 0.0, jnp.ones(5))
    assert (found.index, found.differential_index, found.regular) == (3, 1, True)


def test_what_is_singular_on_the_solution_has_no_differential_index():
    assert of_scene("four-bar-redundant").differential_index is None


@pytest.mark.parametrize("index", [1, 2, 3, 4, 5])
def test_a_chain_of_integrators_has_any_index(index):
    found = dae_jax.analyse(hessenberg(index), 0.0, jnp.zeros(index))
    assert found.index == index
    assert found.degrees_of_freedom == 0
    assert found.equation_offsets[-1] == index - 1


def test_semi_explicit_index_1_and_2():
    first = dae_jax.SemiExplicitDAE(lambda t, x, z, a: -x + z, lambda t, x, z, a: z**3 + x - 1)
    second = dae_jax.SemiExplicitDAE(lambda t, x, z, a: -x + z, lambda t, x, z, a: x - jnp.sin(t))
    state = (jnp.ones(1), jnp.zeros(1))
    assert (dae_jax.analyse(first, 0.0, state).index, dae_jax.analyse(second, 0.0, state).index) == (1, 2)
    # z³ has no slope at z = 0, where the state is: the Jacobian is singular there and says so.
    assert not dae_jax.analyse(first, 0.0, state).regular
    assert dae_jax.analyse(first, 0.0, (jnp.ones(1), jnp.ones(1))).regular


def test_an_ode_has_index_0():
    found = dae_jax.analyse(dae_jax.ImplicitDAE(lambda t, y, yd, a: yd + y), 0.0, jnp.ones(3))
    assert (found.index, found.degrees_of_freedom, len(found.blocks)) == (0, 3, 3)


def test_a_zero_at_the_start_hides_no_dependence():
    system = dae_jax.ImplicitDAE(lambda t, y, yd, a: jnp.stack([yd[0] - t * y[1], y[1] - y[0] * t]))
    assert dae_jax.analyse(system, 0.0, jnp.zeros(2)).signature == ({0: 1, 1: 0}, {1: 0, 0: 0})


@pytest.mark.parametrize("name", ["robertson", "akzo-nobel", "amplifier", "capacitor-loop", "car-axis", "jay"])
def test_problems_have_their_published_index(name):
    assert (of_scene(name).index, of_scene(name).regular) == (SCENES[name]().index, True)


def hidden(t, y, yd, args):
    """y₂ · first − y₁ · second has no derivative."""
    rate = yd[0] + jnp.cos(y[1]) * yd[1]
    return jnp.stack([y[0] * rate + y[0], y[1] * rate + y[1] ** 2])


def implicit(residual):
    return dae_jax.ImplicitDAE(lambda t, y, yd, args: residual(t, y, yd, args))


def test_what_cancels_between_equations_is_taken_out():
    """Capacitors of the amplifier: their currents leave one node and enter the other."""
    found = of_scene("amplifier")
    assert found.degrees_of_freedom == 5
    names = [name for name, _ in found.hidden_constraints()]
    assert names == [f"residual[{i}] + residual[{i + 1}]" for i in (0, 3, 6)]
    sums = implicit(lambda t, y, yd, a: jnp.stack([yd[0] + yd[1] + y[0], yd[0] + yd[1] + y[1]]))
    assert dae_jax.analyse(sums, 0.0, jnp.ones(2)).index == 1


@pytest.mark.parametrize("capacitance", [lambda c, y: c, lambda c, y: c * (1 + jnp.exp(y[0]) ** 2)], ids=["c", "c(y)"])
def test_what_cancels_may_be_a_parameter_or_depend_on_the_state(capacitance):
    def residual(t, y, yd, args):
        current = capacitance(args["c"], y) * (yd[0] - yd[1])
        stamped = jnp.zeros(3).at[0].add(current).at[1].add(-current)
        return stamped.at[0].add(args["g"] * y[0] - jnp.sin(t)).at[1].add(args["g"] * y[1]).at[2].set(yd[2] - y[1])

    system, args = implicit(residual), {"c": 1.0, "g": 2.0}
    found = dae_jax.analyse(system, 0.0, jnp.zeros(3), args)
    assert (found.index, found.degrees_of_freedom, found.regular) == (1, 2, True)
    # Traced, as in a solve.
    while_tracing = []
    look = lambda args: while_tracing.append(find_offsets(ResidualForm.of(system, 0.0, jnp.zeros(3), args), float))
    jax.eval_shape(look, args)
    assert while_tracing[0].combination == found.offsets.combination


def test_what_cancels_with_a_derivative_of_another_equation():
    """y₁' + y₂' is fixed by y₁ + y₂ = sin t: y₃ = a − cos t needs one derivative, its own derivative two."""
    residual = lambda t, y, yd, a: jnp.stack([yd[0] + yd[1] + y[2] - t, y[0] + y[1] - jnp.sin(t), yd[2] + yd[0] - y[1]])
    found = dae_jax.analyse(implicit(residual), 0.0, jnp.ones(3))
    assert found.equations[0] == "residual[0] − d/dt residual[1]"
    assert (found.index, found.degrees_of_freedom, found.regular) == (2, 1, True)


def test_combinations_of_more_than_two_and_in_turns():
    """Index by the matrices: A ẏ + B y has the index at which the pencil's nilpotent part vanishes."""
    a = np.array([[1.0, 2, 3, 0], [0.1, 0.2, 0.3, 0.0], [4, 5, 6, 1], [5, 7, 9, 1]])
    b = np.array([[1.0, 0, 2, 0], [0, 1, 0, 1], [1, 1, 0, 0], [0, 3, 1, 1]])
    found = dae_jax.analyse(implicit(lambda t, y, yd, args: a @ yd + b @ y), 0.0, jnp.ones(4))
    reduced = np.linalg.solve(a + 0.37 * b, a)
    ranks = [np.linalg.matrix_rank(np.linalg.matrix_power(reduced, k), tol=1e-9) for k in range(4)]
    assert found.regular
    assert found.degrees_of_freedom == ranks[-1]
    assert found.index == ranks.index(ranks[-1])


def test_a_circuit_of_200_nodes():
    """A capacitor joins each second node to the next, a resistor the others."""

    def residual(t, y, yd, args):
        current = yd[::2] - yd[1::2]
        stamped = jnp.zeros(200).at[::2].add(current).at[1::2].add(-current)
        return stamped + y + jnp.concatenate([y[:1] - jnp.sin(t), y[1:] - y[:-1]])

    found = dae_jax.analyse(implicit(residual), 0.0, jnp.zeros(200))
    assert (found.index, found.degrees_of_freedom, found.regular) == (1, 100, True)


def test_redundant_constraints_leave_more_freedom_than_the_count_says():
    """A pendulum whose constraint is there twice: by the count it cannot move."""
    force, twice = (
        lambda t, q, v, args: jnp.array([0.0, -9.81]),
        lambda t, q, args: jnp.stack([q @ q - 1, 2 * (q @ q - 1)]),
    )
    found = dae_jax.analyse(dae_jax.ConstrainedSystem(force, twice), 0.0, (jnp.array([1.0, 0.0]), jnp.zeros(2)))
    assert "index 3 or higher, 0 degrees of freedom of the mechanism (0 initial values to choose) by the count" in str(
        found
    )
    assert "`explain` says how many are independent" in str(found)
    table = found._repr_html_().partition("<details")[0]
    assert "3 or higher" in table
    assert "0, of the mechanism, by the count of equations" in table


def test_a_singular_jacobian_behind_a_regular_structure_is_found():
    """The multiple is the state's: y₂ · first − y₁ · second has no derivative, so that the index is 1 and not 0."""
    found = dae_jax.analyse(implicit(hidden), 0.0, jnp.ones(2))
    assert not found.regular
    assert "Replace an equation by a combination" in str(found)


def test_what_is_singular_at_the_rates_of_the_equations_is_found():
    """ẏ₀ = y₁ and ẏ₀² = y₁² are one equation at each solution, and two for other ẏ."""
    twice = implicit(lambda t, y, yd, args: jnp.stack([yd[0] - y[1], yd[0] ** 2 - y[1] ** 2]))
    assert not dae_jax.analyse(twice, 0.0, jnp.array([1.0, 0.5])).regular
    crossing = implicit(lambda t, y, yd, args: jnp.stack([yd[0] - y[1], yd[0] ** 2 - y[1]]))
    assert dae_jax.analyse(crossing, 0.0, jnp.array([1.0, 0.5])).regular


@pytest.mark.parametrize(("t0", "y0"), [(0.0, np.array([np.nan, 1.0])), (np.inf, np.ones(2)), (np.nan, np.ones(2))])
def test_a_state_and_a_time_must_be_finite(t0, y0):
    """It was said that the system Jacobian is singular, and the index may be higher."""
    with pytest.raises(ValueError, match="must be finite"):
        dae_jax.analyse(implicit(lambda t, y, yd, args: yd - t * y), t0, y0)


def test_slopes_that_are_infinite_are_not_called_singular_alone():
    found = dae_jax.analyse(
        implicit(lambda t, y, yd, args: jnp.stack([yd[0] - y[1], jnp.sqrt(y[1]) - y[0]])), 0.0, jnp.zeros(2)
    )
    assert not found.regular
    assert "singular, or not finite, near the given state" in str(found)


def test_an_equation_given_twice_is_no_equation():
    found = dae_jax.analyse(
        implicit(lambda t, y, yd, a: jnp.stack([yd[0] + y[1], 2 * yd[0] + 2 * y[1]])), 0.0, jnp.ones(2)
    )
    assert not found.regular


def test_redundant_constraints_are_singular():
    assert not of_scene("four-bar-redundant").regular
    twice = dae_jax.ConstrainedSystem(lambda t, q, v, a: -q, lambda t, q, a: jnp.stack([q @ q - 1] * 3))
    with pytest.raises(ValueError, match=r"constraint\[0\].*constraints that follow from others"):
        dae_jax.analyse(twice, 0.0, (jnp.array([1.0, 0.0]), jnp.zeros(2)))


def test_structurally_singular_systems_are_named():
    system = dae_jax.ImplicitDAE(lambda t, y, yd, a: {"rate": yd["p"] + y["p"], "level": y["p"] - 1})
    with pytest.raises(ValueError, match=r"residual\['level'\].*y\['q'\]"):
        dae_jax.analyse(system, 0.0, {"p": 1.0, "q": 2.0})
    with pytest.raises(ValueError, match="as many equations as y has unknowns, 2, but returns 1"):
        dae_jax.analyse(dae_jax.ImplicitDAE(lambda t, y, yd, a: y[:1]), 0.0, jnp.ones(2))


@pytest.mark.parametrize("times", [0, 1, 2, 3])
def test_differentiated_equations_along_a_solution_vanish(times):
    """Along x1 = sin t, every derivative of the chain of integrators is 0, and off it is not."""
    found = dae_jax.analyse(hessenberg(3), 0.0, jnp.zeros(3))
    t = 0.7
    sine = lambda k: np.sin(t + k * np.pi / 2)
    derivatives = jnp.array([[sine(j + k) for j in range(3)] for k in range(times + 2)])
    np.testing.assert_allclose(found.derivative(times)(t, derivatives), 0, atol=1e-14)
    off = derivatives.at[times, 0].add(1.0)
    np.testing.assert_allclose(found.derivative(times)(t, off)[-1], 1, atol=1e-14)


def test_a_system_of_200_equations():
    scene = chain(40)
    found = dae_jax.analyse(scene.system, 0.0, scene.y0)
    assert len(found.equations) == 200
    assert (found.index, found.degrees_of_freedom, found.regular) == (3, 80, True)
    assert "·" not in str(found)  # too large to draw


def test_command(capsys):
    assert main(["analyse", "pendulum"]) == 0
    assert "index 3, 1 degree of freedom of the mechanism (2 initial values to choose)" in capsys.readouterr().out
    assert main(["analyse", "dae_jax.scenes:knife_edge"]) == 0
    assert "index 2" in capsys.readouterr().out
    for wrong in ("pendulums", "dae_jax.scenes:nothing", "math:pi"):
        with pytest.raises(SystemExit):
            main(["analyse", wrong])
    assert "math:pi' is no Scene, (system, y0) or (system, y0, args)" in capsys.readouterr().err
