"""The plan says what was found, what is left out, and whether the loop is one kernel."""

import dataclasses
import functools

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dae_jax
from dae_jax.compiler import equations, kernel_call
from dae_jax.compiler.lower import module
from dae_jax.scenes import SCENES, chain
from tests.methods import METHODS, Method


MECHANISMS = [name for name in SCENES if isinstance(SCENES[name]().system, dae_jax.ConstrainedSystem)]
PROJECTED = dae_jax.OrthogonalProjection(dae_jax.DOP853())


def plan(scene, solver=PROJECTED, **options):
    return dae_jax.explain(scene.system, solver, 0.0, scene.y0, scene.args, **options)


@pytest.mark.parametrize("name", [name for name in MECHANISMS if name != "four-bar-redundant"])
def test_every_scene_is_one_kernel(name):
    found = plan(SCENES[name]())
    assert found.one_kernel, found.unsupported
    assert found.unsupported == ()


RESIDUAL_METHODS = [
    Method("bdf", dae_jax.BDF(), 5, adaptive=True),
    Method("ggl", dae_jax.RadauIIA5(), 5, formulation=dae_jax.GGL(), adaptive=True),
]


@pytest.mark.parametrize("method", [*METHODS, *RESIDUAL_METHODS], ids=lambda m: m.name)
def test_every_method_is_compiled_by_our_compiler(method, monkeypatch):
    """A kernel of which our compiler finds out only while writing it that it cannot is left to XLA without a word. No machine code
    is made.
    """
    scene = SCENES["pendulum"]()
    monkeypatch.setattr(kernel_call, "_by_xla", lambda *_: pytest.fail("left to XLA"))
    monkeypatch.setattr(module, "register", lambda *_: "dae_jax_none")
    controller = diffrax.PIDController(rtol=1e-6, atol=1e-6) if method.adaptive else diffrax.ConstantStepSize()

    def solve(y):
        return dae_jax.daesolve(
            scene.system, method.solver, 0.0, 1.0, None if method.adaptive else 0.1, y, scene.args,
            formulation=method.formulation, stepsize_controller=controller,
        ).ys  # fmt: skip

    jax.jit(solve).lower(scene.y0)
    jax.jit(jax.vmap(solve)).lower(jax.tree.map(lambda x: jnp.stack([x] * 9), scene.y0))


PAIRS = {
    "pendulum, projected": (lambda: SCENES["pendulum"](), PROJECTED, {}),
    "pendulum, plain": (lambda: SCENES["pendulum"](), diffrax.Tsit5(), {}),
    "pendulum, tangent space": (lambda: SCENES["pendulum"](), dae_jax.TangentSpace(dae_jax.DOP853()), {}),
    "pendulum, Baumgarte": (
        lambda: SCENES["pendulum"](), diffrax.Dopri5(), {"formulation": dae_jax.Baumgarte(alpha=5.0, beta=5.0)},
    ),
    "pendulum, dummy derivatives": (
        lambda: SCENES["pendulum"](), dae_jax.BDF(), {"formulation": dae_jax.DummyDerivatives()},
    ),
    "double pendulum, BDF": (lambda: SCENES["double-pendulum"](), dae_jax.BDF(), {}),
    "four bars": (lambda: SCENES["four-bar-redundant"](), PROJECTED, {}),
    "robertson, Radau": (lambda: SCENES["robertson"](), dae_jax.RadauIIA5(), {}),
    "robertson, Kvaerno": (lambda: SCENES["robertson"](), diffrax.Kvaerno5(), {}),
    "car axis, Radau": (lambda: SCENES["car-axis"](), dae_jax.RadauIIA5(), {}),
    "robertson, Kvaerno3": (lambda: SCENES["robertson"](), diffrax.Kvaerno3(), {}),
    "amplifier, BDF": (lambda: SCENES["amplifier"](), dae_jax.BDF(), {}),
    "pendulum, event": (
        lambda: SCENES["pendulum"](), PROJECTED, {"event": diffrax.Event(lambda t, y, args, **_: y[0][0])},
    ),
    "pendulum, reset": (
        lambda: SCENES["pendulum"](), PROJECTED,
        {"event": dae_jax.Reset(lambda t, y, args, **_: y[0][0], lambda t, y, args: (y, args))},
    ),
    "robertson, reset": (
        lambda: SCENES["robertson"](), dae_jax.BDF(),
        {"event": dae_jax.Reset(lambda t, y, args, **_: y[0][0] - 0.9, lambda t, y, args: (y, args))},
    ),
    "pendulum, forward derivatives": (
        lambda: SCENES["pendulum"](), PROJECTED, {"adjoint": diffrax.ForwardMode()},
    ),
    "pendulum, derivatives through the loop": (
        lambda: SCENES["pendulum"](), PROJECTED, {"adjoint": diffrax.DirectAdjoint()},
    ),
}  # fmt: skip


def who_compiles(monkeypatch, fn, *args):
    """Which compiler the kernel with the loop went to; "xla" where there is none. No machine code is made."""
    found = []
    by_llvm = kernel_call._by_llvm

    def noted(jaxpr, lanes, args, *more):
        out = by_llvm(jaxpr, lanes, args, *more)
        if any(eqn.primitive.name == "while" and eqn.params["body_nconsts"] for eqn in equations(jaxpr)):
            found.append("llvm" if out is not None else "xla")
        return out

    monkeypatch.setattr(kernel_call, "_by_llvm", noted)
    monkeypatch.setattr(module, "register", lambda *_: "dae_jax_none")
    jax.jit(fn).lower(*args)
    return found[0] if found else "xla"


@pytest.mark.parametrize("name", PAIRS)
def test_what_is_predicted_is_what_happens(name, monkeypatch):
    make, solver, options = PAIRS[name]
    scene = make()
    plans = []

    def solve(y):
        plans.append(dae_jax.explain(scene.system, solver, 0.0, y, scene.args, **options))
        return dae_jax.daesolve(scene.system, solver, 0.0, 1.0, None, y, scene.args, **options).ys

    y0 = jax.tree.map(jnp.asarray, scene.y0)
    alone = who_compiles(monkeypatch, solve, y0)
    found = plans[0]
    assert alone == ("llvm" if found.compiler == "llvm" else "xla")
    batch = jax.tree.map(lambda x: jnp.stack([x] * 9), y0)
    lanes = who_compiles(monkeypatch, jax.vmap(solve), batch)
    assert lanes == found.batch_compiler
    assert (found.compiler != "llvm" or found.batch_compiler != "llvm") == bool(found.reasons)


def test_a_mesh_does_not_hinder(monkeypatch):
    """Under a mesh JAX writes down for each number how it is spread out, which is no arithmetic."""
    system = dae_jax.SemiExplicitDAE(lambda t, x, z, k: -k * x * z, lambda t, x, z, k: z - jnp.ones_like(x))
    monkeypatch.setattr(kernel_call, "_by_xla", lambda *_: pytest.fail("left to XLA"))

    def end(k):
        return dae_jax.daesolve(system, dae_jax.RadauIIA5(), 0.0, 1.0, None, (jnp.ones(2), jnp.ones(2)), k).ys[0][-1]

    mesh = jax.sharding.Mesh(np.array(jax.devices()[:1]), ("lanes",))
    spread = jax.sharding.NamedSharding(mesh, jax.sharding.PartitionSpec("lanes"))
    values = jax.jit(jax.vmap(end))(jax.device_put(jnp.linspace(1.0, 2.0, 6), spread))
    np.testing.assert_allclose(values[:, 0], np.exp(-np.linspace(1, 2, 6)), rtol=1e-4)


def test_names_the_primitive_that_prevents_it():
    scene = SCENES["pendulum"]()
    weight = lambda t, q, v, args: jnp.array([0.0, -9.81]) * jnp.linalg.norm(jnp.eye(2) * (1 + q[0] ** 2), 2)
    found = plan(dataclasses.replace(scene, system=dataclasses.replace(scene.system, force=weight)))
    assert not found.one_kernel
    assert found.unsupported == ("svd",)
    with pytest.warns(DeprecationWarning, match="is called `unsupported`"):
        assert found.hindrances == found.unsupported
    assert "no, XLA as it is; `svd` has no rule" in str(found)


def test_redundant_constraints_are_one_kernel():
    found = plan(SCENES["four-bar-redundant"]())
    assert found.one_kernel
    assert (found.constraints, found.independent) == (4, 3)
    assert found.linear_solver == "dense elimination of the 3 that are independent of 4 constraints, straight-line"


def test_switched_off():
    with dae_jax.configure(one_kernel=False):
        found = plan(SCENES["pendulum"]())
    assert not found.one_kernel
    assert found.unsupported == ()


def test_says_what_a_scene_has_and_has_not():
    unit = plan(SCENES["double-pendulum"]())
    assert unit.mass == "unit masses"
    assert "mass solve" in unit.left_out
    assert not unit.constraints_depend_on_time
    moving = plan(SCENES["moving-pivot-pendulum"]())
    assert moving.constraints_depend_on_time
    assert "time derivatives of the constraints" not in moving.left_out
    dense = plan(SCENES["pendulum"](), saveat=diffrax.SaveAt(dense=True))
    assert "dense output" not in dense.left_out


def test_steps_that_are_fixed_are_said():
    """`explain` had no `dt0`, and spoke of tolerances that the solve has not."""
    assert plan(SCENES["pendulum"](), diffrax.Tsit5(), dt0=0.05).precision == "float64, fixed steps"
    constant = plan(SCENES["pendulum"](), diffrax.Tsit5(), stepsize_controller=diffrax.ConstantStepSize())
    assert constant.precision == "float64, fixed steps"


def test_rates_may_be_given():
    roots = dae_jax.ImplicitDAE(lambda t, y, yd, args: yd**2 - 1 - y**2)
    found = dae_jax.explain(roots, dae_jax.RadauIIA5(), 0.0, jnp.zeros(1), yd0=jnp.ones(1))
    assert found.method == "Residual, RadauIIA5"


def test_the_form_of_the_equations_is_said():
    scene = SCENES["pendulum"]()
    assert plan(scene, dae_jax.RadauIIA5()).method == 'Residual("GGL"), RadauIIA5'
    assert dae_jax.Residual("index-3").named(scene.system) == 'Residual("index-3")'
    assert dae_jax.Residual().named(SCENES["robertson"]().system) == "Residual"


def test_operations_are_those_of_the_formulation():
    """What Baumgarte feeds back was not counted, and of a chart the multipliers were that it has not."""
    scene = SCENES["pendulum"]()
    with dae_jax.configure(one_kernel=False):
        plain = plan(scene, diffrax.Tsit5())
        fed_back = plan(scene, diffrax.Tsit5(), formulation=dae_jax.Baumgarte(1.0, 2.0))
        in_chart = plan(scene, diffrax.Tsit5(), formulation=dae_jax.StateSpace(scene.chart))
    assert fed_back.operations > plain.operations
    assert in_chart.operations != plain.operations
    assert in_chart.chart == 1
    assert in_chart.linear_solver == "none, dense elimination of 1 coordinate, straight-line"
    assert "none, that of the chart by 1 directional derivative" in str(in_chart)


def test_of_redundant_constraints_as_many_are_counted_as_the_method_takes():
    """Two coordinates, one of two constraints."""
    scene = SCENES["pendulum"]()
    twice = lambda t, q, args: jnp.stack([q @ q - 1, 2 * (q @ q - 1)])
    scene = dataclasses.replace(scene, system=dae_jax.ConstrainedSystem(scene.system.force, twice))
    with dae_jax.configure(one_kernel=False):
        implicit = plan(scene, dae_jax.RadauIIA5(), formulation=dae_jax.Residual("index-3"))
        explicit = plan(scene, diffrax.Tsit5(), formulation=dae_jax.DummyDerivatives())
    assert implicit.unknowns == 2 * 2 + 1
    assert (explicit.unknowns, explicit.invariants) == (2 * 2 + 1, 2 + 2 * 1)


def test_a_matrix_depends_and_masses_depend():
    system = SCENES["pendulum"]().system
    for mass, said in (
        (lambda q, args: jnp.diag(1 + q**2), "a full mass matrix that depends on q"),
        (lambda q, args: 1 + q**2, "diagonal masses that depend on q"),
    ):
        heavy = dataclasses.replace(SCENES["pendulum"](), system=dataclasses.replace(system, mass=mass))
        assert plan(heavy, diffrax.Euler()).mass == said


def test_a_long_chain_is_sparse():
    found = plan(chain(64), dae_jax.DOP853())
    assert found.colours == 4
    assert found.nonzeros == 4 * 64 - 2
    assert found.linear_solver.startswith("sparse elimination")
    assert found.one_kernel


@pytest.mark.parametrize("make", [functools.partial(chain, 10)])
def test_sparse_and_dense_give_the_same_numbers(make, monkeypatch):
    scene = make()
    assert plan(scene).colours == 4
    solve = lambda: dae_jax.daesolve(
        scene.system, PROJECTED, 0.0, 0.5, None, scene.y0, formulation=dae_jax.Baumgarte(1.0, 2.0)
    )
    sparse = solve()
    monkeypatch.setattr("dae_jax.equations.mechanical.SPARSE_FROM", 1000)
    system = dae_jax.ConstrainedSystem(lambda *a: scene.system.force(*a), scene.system.constraint)
    dense = dae_jax.daesolve(system, PROJECTED, 0.0, 0.5, None, scene.y0, formulation=dae_jax.Baumgarte(1.0, 2.0))
    for a, b in zip(sparse.ys, dense.ys, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-8, atol=1e-9)
    assert dae_jax.drift(scene.system, sparse).position.max() < 1e-13


def test_diagonal_masses_keep_a_chain_sparse():
    scene = chain(6)
    masses = np.linspace(1, 2, 12)
    system = dae_jax.ConstrainedSystem(scene.system.force, scene.system.constraint, mass=masses)
    full = dae_jax.ConstrainedSystem(scene.system.force, scene.system.constraint, mass=np.diag(masses))
    assert dae_jax.explain(system, PROJECTED, 0.0, scene.y0).colours == 4
    assert dae_jax.explain(full, PROJECTED, 0.0, scene.y0).colours is None
    ends = [dae_jax.daesolve(s, PROJECTED, 0.0, 0.3, None, scene.y0).ys for s in (system, full)]
    for a, b in zip(*ends, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-8, atol=1e-9)


def test_the_plan_is_found_inside_jit_too():
    scene = SCENES["pendulum"]()
    plans = []

    def solve(gravity):
        system = dae_jax.ConstrainedSystem(lambda t, q, v, g: jnp.stack([0 * g, g]), scene.system.constraint)
        plans.append(dae_jax.explain(system, PROJECTED, 0.0, scene.y0, gravity))
        return gravity

    jax.jit(solve)(9.81)
    assert plans[0].independent is None
    assert plans[0].one_kernel


@pytest.mark.parametrize("name", ["robertson", "akzo-nobel", "car-axis", "andrews", "amplifier", "double-pendulum"])
def test_residuals_are_one_kernel(name):
    found = plan(SCENES[name](), dae_jax.RadauIIA5())
    assert found.one_kernel, found.unsupported
    assert "plain arithmetic" in found.linear_solver


@pytest.mark.parametrize("n", [100, 300])
def test_a_large_residual_has_sparse_factors_and_few_directional_derivatives(n):
    def diffusion(t, y, yd, args):
        return yd - n**2 * (jnp.concatenate([y[1:], y[:1] * 0]) - 2 * y + jnp.concatenate([y[:1] * 0, y[:-1]]))

    found = dae_jax.explain(dae_jax.ImplicitDAE(diffusion), dae_jax.RadauIIA5(), 0.0, jnp.ones(n))
    assert found.colours == (3, 1)
    entries = 3 * n - 2
    assert found.linear_solver.startswith(f"sparse, {n} unknowns, {entries} entries, {entries} in the factors")
    assert found.one_kernel
    assert found.indices == (0,) * n


def test_where_constraints_are_hidden_a_band_is_eliminated_with_pivoting():
    found = plan(chain(16), dae_jax.RadauIIA5())
    assert found.linear_solver.startswith("a band of 11 diagonals below and 11 above")
    assert found.one_kernel


def test_any_system_by_its_underlying_ode():
    found = plan(SCENES["akzo-nobel"]())
    assert (found.unknowns, found.state, found.invariants) == (6, 11, 6)
    assert "none needs pivoting" in str(found)
    assert found.one_kernel
    jay = plan(SCENES["jay"]())
    assert "5 with pivoting, in a loop over columns" in jay.linear_solver
    dummy = plan(SCENES["pendulum"](), dae_jax.BDF(), formulation=dae_jax.DummyDerivatives())
    assert dummy.method == "DummyDerivatives, BDF"
    explicit = plan(SCENES["pendulum"](), dae_jax.DOP853(), formulation=dae_jax.DummyDerivatives())
    assert isinstance(explicit, dae_jax.StructuralPlan)
