"""Examples of other libraries whose answers are published, done here. A printed number is compared to half a unit of its last
digit; where the peer's own tolerance shows in its digits, that is added, and said.
"""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest
from jax.numpy import cos, sin

import dae_jax
from dae_jax.scenes import akzo_nobel, food_web
from tests.peers import BDF, DUMMY, DUMMY_BDF, GGL, PROJECTION, RADAU, solve


def agrees(found, printed: str, rtol=0.0, atol=0.0):
    """Whether numbers are those printed, row by row, to half a unit of the last digit and the peer's tolerance."""
    words = np.array([line.split() for line in printed.strip().splitlines()])
    values = words.astype(float)
    after_point = np.vectorize(lambda word: len(word.lower().split("e")[0].split(".")[1]))(words)
    power = np.vectorize(lambda word: int((word.lower() + "e0").split("e")[1]))(words)
    half = 0.5 * 10.0 ** (power - after_point)
    off = np.abs(np.reshape(found, values.shape) - values)
    assert np.all(off <= half + atol + rtol * np.abs(values)), off / half


# Of SUNDIALS: a crank of length A, a rod of length 1 and a slider, q = (angle, slider, angle of the rod), a spring and a damper
# between crank and rod.
A, MASSES = 0.5, np.array([1.0, 1.0, 2.0])


def spring(q):
    return jnp.sqrt(q[1] ** 2 - q[1] * (cos(q[2]) + A * cos(q[0])) + (1 + A**2) / 4 + A * cos(q[2] - q[0]) / 2)


def crank_force(t, q, v, args):
    (length, rate), (stiffness, damping) = jax.jvp(spring, (q,), (v,)), args
    pull = stiffness * (length - 1) + damping * rate
    return jnp.stack([0 * rate, 1 + 0 * rate, -sin(q[2])]) - pull * jax.grad(spring)(q)


CRANK = dae_jax.ConstrainedSystem(
    crank_force,
    lambda t, q, args: jnp.stack([q[1] - cos(q[2]) - A * cos(q[0]), -sin(q[2]) - A * sin(q[0])]),
    mass=MASSES,
)
CRANK_START = np.array([np.pi / 2, np.sqrt(0.75), -np.pi / 6]), np.zeros(3)


@pytest.mark.parametrize("method", [PROJECTION, GGL, DUMMY_BDF], ids=["projection", "ggl", "dummy-bdf"])
def test_slider_crank_of_ida(method):
    """SUNDIALS `idaSlCrank_dns.c`, rows of its .out file; IDA's steps had a tolerance of 1e-6."""
    times = np.array([0.25, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0, 9.0, 10.0])
    sol = solve(CRANK, method, 0.0, 10.0, CRANK_START, (1.0, 1.0), saveat=diffrax.SaveAt(ts=times))
    printed = """1.5548e+00   8.7406e-01  -5.2352e-01
        1.3154e+00   1.0015e+00  -5.0497e-01
        5.7904e-01   1.3803e+00  -2.7715e-01
        -4.4711e-01   1.4272e+00   2.1790e-01
        -1.2064e+00   1.0623e+00   4.8609e-01
        -1.4300e+00   9.3903e-01   5.1790e-01
        -1.1080e+00   1.1176e+00   4.6386e-01
        -3.1828e-01   1.4626e+00   1.5711e-01
        6.4422e-01   1.3536e+00  -3.0500e-01
        1.2363e+00   1.0456e+00  -4.9189e-01
        1.2757e+00   1.0236e+00  -4.9881e-01"""
    agrees(sol.ys[0], printed, atol=1e-5)


@pytest.mark.parametrize("method", [PROJECTION, GGL], ids=["projection", "ggl"])
def test_sensitivities_of_the_slider_crank_of_idas(method):
    """SUNDIALS `idasSlCrank_FSA_dns.c`: G = ∫ kinetic energy, ∂G/∂(stiffness, damping) by central differences, the most accurate of
    its ways; G in the digits that its two programs share.
    """
    nodes, weights = np.polynomial.legendre.leggauss(80)

    def integral(args):
        at = diffrax.SaveAt(ts=5 * (1 + nodes))
        v = solve(CRANK, method, 0.0, 10.0, CRANK_START, args, saveat=at).ys[1]
        return 5 * weights @ (v**2 @ MASSES) / 2

    value, by_args = jax.value_and_grad(integral)((1.0, 1.0))
    agrees(value, "3.33661", atol=1e-5)
    agrees(by_args, "3.3345e-01  -3.6375e-01")


def robertson(extra):
    """With ∫ extra(y) dt as a third differential unknown."""

    def f(t, x, z, p):
        flow = p[0] * x[0] - p[1] * x[1] * z[0]
        return jnp.stack([-flow, flow - p[2] * x[1] ** 2, extra(x[0], x[1], z[0])])

    return dae_jax.SemiExplicitDAE(f, lambda t, x, z, p: jnp.stack([x[0] + x[1] + z[0] - 1]))


RATES = jnp.array([0.04, 1e4, 3e7])
REACTION = {"atol": (jnp.array([1e-12, 1e-16, 1e-9]), 1e-12)}
PURE = (np.array([1.0, 0.0, 0.0]), np.zeros(1))
PRODUCT = robertson(lambda y1, y2, y3: y3)


def test_states_and_sensitivities_of_robertson_of_idas():
    """SUNDIALS `idasRoberts_FSA_dns.c`, `-sensi stg t`: y, and by each rate, in all digits until t = 4·10⁵; IDAS' error shows after."""

    def states(p):
        times = diffrax.SaveAt(ts=0.4 * 10.0 ** np.arange(7))
        x, z = solve(PRODUCT, RADAU, 0.0, 4e5, PURE, p, **REACTION, saveat=times).ys
        return jnp.concatenate([x[:, :2], z], 1)

    (y, by_rates) = states(RATES), jnp.moveaxis(jax.jacfwd(states)(RATES), 2, 1)
    printed = """9.8517e-01   3.3864e-05   1.4794e-02  -3.5595e-01   3.9025e-04   3.5556e-01
        9.5424e-08  -2.1310e-10  -9.5211e-08  -1.5832e-11  -5.2900e-13   1.6361e-11
        9.0552e-01   2.2405e-05   9.4459e-02  -1.8761e+00   1.7922e-04   1.8759e+00
        2.9614e-06  -5.8305e-10  -2.9608e-06  -4.9334e-10  -2.7626e-13   4.9362e-10
        7.1583e-01   9.1855e-06   2.8416e-01  -4.2476e+00   4.5912e-05   4.2475e+00
        1.3731e-05  -2.3572e-10  -1.3731e-05  -2.2884e-09  -1.1381e-13   2.2885e-09
        4.5052e-01   3.2229e-06   5.4948e-01  -5.9584e+00   3.5427e-06   5.9584e+00
        2.2738e-05  -2.2601e-11  -2.2738e-05  -3.7897e-09  -4.9948e-14   3.7897e-09
        1.8320e-01   8.9424e-07   8.1680e-01  -4.7501e+00  -5.9937e-06   4.7501e+00
        1.8809e-05   2.3127e-11  -1.8809e-05  -3.1348e-09  -1.8758e-14   3.1348e-09
        3.8983e-02   1.6218e-07   9.6102e-01  -1.5750e+00  -2.7620e-06   1.5750e+00
        6.2875e-06   1.1002e-11  -6.2875e-06  -1.0479e-09  -4.5367e-15   1.0479e-09
        4.9383e-03   1.9850e-08   9.9506e-01  -2.3633e-01  -4.5841e-07   2.3633e-01
        9.4503e-07   1.8325e-12  -9.4503e-07  -1.5750e-10  -6.3625e-16   1.5751e-10"""
    agrees(jnp.concatenate([y[:, None], by_rates], 1), printed)


@pytest.mark.parametrize("method", [RADAU, BDF], ids=["radau", "bdf"])
def test_events_of_robertson_of_ida(method):
    """SUNDIALS `idaRoberts_dns.c`: y₃ = 0.01 in all digits; y₁ = 1e-4 at 2.0788e7 s, by IDA with a tolerance of 1e-4, and the state."""

    def first(condition, t1):
        event = diffrax.Event(lambda t, y, args, **_: condition(*y), optx.Newton(1e-12, 1e-12))
        sol = solve(PRODUCT, method, 0.0, t1, PURE, RATES, **REACTION, event=event)
        return jnp.array([sol.ts[0], *sol.ys[0][0, :2], *sol.ys[1][0]])

    agrees(first(lambda x, z: z[0] - 0.01, 1.0), "2.6402e-01   9.8997e-01   3.4706e-05   1.0000e-02")
    found = first(lambda x, z: x[0] - 1e-4, 1e9)
    agrees(found[1:], "1.0000e-04   4.0004e-10   9.9990e-01")
    agrees(found[0], "2.0788e+07", rtol=4e-4)


def test_adjoint_gradient_of_robertson_of_idas():
    """SUNDIALS `idasRoberts_ASAi_dns.c`: G = ∫ y₃ until t = 50, ∂G/∂(rates)."""
    integral = lambda p: solve(PRODUCT, RADAU, 0.0, 50.0, PURE, p, **REACTION).ys[0][-1, 2]
    agrees(jax.grad(integral)(RATES), "1.7341e+02  -5.0592e-04   8.4323e-08")


def test_hessian_of_robertson_of_idas():
    """SUNDIALS `idasHessian_ASA_FSA.c`, after D. B. Özyurt, P. I. Barton, SIAM J. Sci. Comput. 26 (2005), 1725: G = ∫ |y|²/2 until
    t = 80, by two of the rates. Its ways to ∂²G/∂p₁² differ by 1e-4.
    """
    system = robertson(lambda *y: sum(x**2 for x in y) / 2)
    integral = lambda p: solve(system, RADAU, 0.0, 80.0, PURE, jnp.append(p, RATES[2]), **REACTION).ys[0][-1, 2]
    value, gradient = jax.value_and_grad(integral)(RATES[:2])
    agrees(jnp.append(value, gradient), "2.5042e+01  -1.3753e+02   4.1552e-04")
    hessian = jax.jacfwd(jax.grad(integral))(RATES[:2])
    agrees(hessian, "4.4242e+03   -2.7779e-03\n -2.7779e-03   -2.4173e-08", rtol=1e-4)


def test_adjoint_gradient_of_akzo_nobel_of_idas():
    """SUNDIALS `idasAkzoNob_ASAi_dns.c`: G = ∫ y₁ until t = 180 in the digits that its two programs share, ∂G/∂y₀."""
    scene = akzo_nobel()

    def residual(t, y, yd, args):
        return jnp.append(scene.system.residual(t, y[:6], yd[:6], args), yd[6] - y[0])

    def integral(y0):
        start = jnp.concatenate([y0, jnp.stack([115.83 * y0[0] * y0[3], 0.0])])
        return solve(dae_jax.ImplicitDAE(residual), RADAU, 0.0, 180.0, start, atol=1e-11).ys[-1, 6]

    value, gradient = jax.value_and_grad(integral)(jnp.asarray(scene.y0[:5]))
    agrees(value, "31.264216")
    agrees(gradient, "2.2207e+01  -6.2695e+01  -2.5114e+00  9.1837e+01  3.5176e+00")


@pytest.mark.parametrize("method", [RADAU, BDF], ids=["radau", "bdf"])
def test_food_web_of_ida(method):
    """SUNDIALS `idaFoodWeb_bnd.c`, 800 unknowns: prey and predators in two corners; IDA's steps had a tolerance of 1e-5."""
    scene, times = food_web(20), diffrax.SaveAt(ts=[1e-3, 1e-2, 0.1, 1.0])
    sol = solve(scene.system, method, 0.0, 1.0, scene.y0, rtol=1e-7, saveat=times)
    printed = """1.0318e+01   1.0827e+01   1.0319e+05   1.0822e+05
        1.6188e+02   1.9735e+02   1.6189e+06   1.9734e+06
        2.4019e+02   2.7072e+02   2.4019e+06   2.7072e+06
        2.4019e+02   2.7072e+02   2.4019e+06   2.7072e+06"""
    agrees(np.stack([x[:, i, i] for x in sol.ys for i in (0, -1)], 1), printed, rtol=2e-5)


# Twice the inertias of exudyn's top about its fixed point.
INERTIA = np.array([15.234375, 0.46875, 15.234375])


def body_rates(p):
    """G of ω = 2 G ṗ in the axes of the body, p a unit quaternion."""
    return jnp.array([[-p[1], p[0], p[3], -p[2]], [-p[2], -p[3], p[0], p[1]], [-p[3], p[2], -p[1], p[0]]])


def lagrangian(p, v):
    height = 2 * (p[2] * p[3] + p[0] * p[1])
    return jnp.sum(INERTIA * (2 * body_rates(p) @ v) ** 2) / 2 - 15 * 9.81 * height


@pytest.mark.parametrize("method", [PROJECTION, GGL], ids=["projection", "ggl"])
def test_heavy_top_of_exudyn(method):
    """exudyn `TestModels/heavyTop.py`, after Z. Terze, A. Müller, D. Zlatar, Multibody Syst. Dyn. 38 (2016), 201: the quaternion at
    t = 0.2 by the reference solution with a Runge-Kutta method that stands there.
    """
    by_rate = jax.grad(lagrangian, 1)

    def force(t, p, v, args):
        return jax.grad(lagrangian)(p, v) - jax.jvp(lambda p: by_rate(p, v), (p,), (v,))[1]

    # Any mass along p will do: G p = 0.
    mass = lambda p, args: 4 * body_rates(p).T @ jnp.diag(INERTIA) @ body_rates(p) + jnp.outer(p, p)
    p = jnp.array([1.0, 0.0, 0.0, 0.0])
    v = body_rates(p).T @ jnp.array([0.0, 150.0, -4.61538]) / 2
    top = dae_jax.ConstrainedSystem(force, lambda t, p, args: (p @ p - 1) / 2, mass=mass)
    agrees(solve(top, method, 0.0, 0.2, (p, v)).ys[0], "-0.70828  0.43878  0.54573  0.0894")


# The tip of the first bar and its velocity at t = 10 by the second-order method of exudyn, with steps of 1/2000, 1/4000 and 1/8000.
TIP = [
    [0.3284465114, 0.9445225721, 1.423028497, -0.494841072],
    [0.3284552113, 0.9445195467, 1.423045728, -0.4948619021],
    [0.3284573768, 0.9445187937, 1.423050003, -0.4948670827],
]


def test_a_double_four_bar_of_exudyn_passes_where_all_its_bars_are_level():
    """exudyn `TestModels/fourBarMechanismIftomm.py`, a benchmark of IFToMM: two loops whose constraints lose rank by two at once.
    What exudyn prints for three steps is extrapolated to none, which leaves 2e-8.
    """
    coarse, middle, fine = np.array(TIP)
    once = middle + (middle - coarse) / 3, fine + (fine - middle) / 3
    exact = once[1] + (once[1] - once[0]) / 15
    assert np.abs(exact - once[1]).max() < 2e-8

    def closed(t, q, args):
        centre, angle = q.reshape(5, 3)[:, :2], q[2::3]
        half = jnp.stack([cos(angle), sin(angle)], 1) / 2
        a, b = centre - half, centre + half
        fixed = a[::2] - jnp.array([[0.0, 0.0], [1.0, 0.0], [2.0, 0.0]])
        return jnp.concatenate([*fixed, b[0] - a[1], b[1] - a[3], b[2] - a[3], b[3] - b[4]])

    weight = jnp.tile(jnp.array([0.0, -9.81, 0.0]), 5)
    system = dae_jax.ConstrainedSystem(lambda t, q, v, args: weight, closed, mass=np.tile([1, 1, 1 / 12], 5))
    upright, level = [0, 0.5, np.pi / 2], [0.5, 1, 0]
    q = np.array([*upright, *level, 1, *upright[1:], 1.5, *level[1:], 2, *upright[1:]])
    v = np.array([0.5, 0, -1, 1, 0, 0] * 2 + [0.5, 0, -1.0])
    sol = solve(system, DUMMY, 0.0, 10.0, (q, v), rtol=1e-10)
    found = 2 * np.concatenate([sol.ys[0][0, :2], sol.ys[1][0, :2]])
    np.testing.assert_allclose(found, exact, atol=1e-6)
    with pytest.raises(RuntimeError, match="constraints become dependent"):
        solve(system, PROJECTION, 0.0, 10.0, (q, v), rtol=1e-10)
