"""Systems of many unknowns for the peers: `dae_jax.scenes` as vectors and sparse matrices, written once for numpy and CasADi.

`ode(t, x, z, p, m)` and `algebraic(...)` are f and g of ẋ = f, 0 = g in vectors; `m` has sin, cos and
    join(vectors)         one below the other
    matrix(a)             of a scipy matrix in rows, what can be multiplied with `@`
The start is consistent, with its slope, so that no peer has to find one.
"""

import functools
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import sparse

from dae_jax.scenes import food_web, heat, power_grid, robertson_copies, stokes
from dae_jax.scenes.flow import VISCOSITY, operators
from dae_jax.scenes.power_grid import STEP, VOLTAGE, grid, power_flow
from dae_jax.scenes.reaction_diffusion import EATEN, FED, SPREADS, growth, neumann_laplacian


# How many states are compared; how often a gradient looks at the solution.
TIMES, SAMPLES = 5, 40


@dataclass(frozen=True)
class Problem:
    """`scene` with a start at `t0`, `y0` where it is not the scene's own; the same as `x0`, `z0` for the peers, who number the
    unknowns as `order` says: unknown i of (x, z) is the scene's `order[i]`. `p`: parameters, `args` of the scene.
    """

    name: str
    n: int
    scene: Any
    ode: Any
    algebraic: Any
    x0: np.ndarray
    z0: np.ndarray
    t0: float = 0.0
    p: np.ndarray | None = None
    order: np.ndarray | None = None
    y0: Any = None

    @property
    def start(self):
        """Of the scene, where it is not another."""
        return self.scene.y0 if self.y0 is None else self.y0

    @property
    def unknowns(self):
        return self.x0.size + self.z0.size

    @property
    def dx0(self):
        return self.ode(self.t0, self.x0, self.z0, self.p, Numpy)

    @property
    def times(self):
        """When states are compared: geometric, until the end."""
        span = self.scene.t1 - self.t0
        return self.t0 + np.geomspace(self.scene.first or span / 100, span, TIMES)

    def in_order(self, x, z):
        """States of the peers, a row for each time, as the scene numbers them."""
        states = np.concatenate([x, z], 1)
        if self.order is None:
            return states
        found = np.empty_like(states)
        found[:, self.order] = states
        return found

    def known(self):
        """The states as the scene knows them, NaN where it does not."""
        parts = self.scene.reference(self.times)
        parts = parts if isinstance(parts, tuple) else (parts,)
        return np.concatenate([part.reshape(TIMES, -1) for part in parts], 1)

    def error(self, states, exact):
        """The largest error, relative where the solution is larger than the scene's scale; None if nothing is known."""
        off = np.abs(states - exact) / np.maximum(np.abs(exact), self.scene.scale)
        return None if np.isnan(off).all() else float(np.nanmax(off))


class Numpy:
    """Of numbers."""

    sin, cos, join = np.sin, np.cos, np.concatenate
    matrix = staticmethod(lambda a: a)


class CasADi:
    """Of symbols."""

    @staticmethod
    def sin(x):
        import casadi

        return casadi.sin(x)

    @staticmethod
    def cos(x):
        import casadi

        return casadi.cos(x)

    @staticmethod
    def join(vectors):
        import casadi

        return casadi.vertcat(*vectors)

    @staticmethod
    def matrix(a):
        import casadi

        return casadi.DM(sparse.csc_matrix(a))


def robertson(n):
    k1, k2, k3 = 0.04, 1e4, 3e7

    def ode(t, x, z, p, m):
        back, twice = k1 * x[:n] - k2 * x[n:] * z, k3 * x[n:] * x[n:]
        return m.join([-back, back - twice])

    scene = robertson_copies(n)
    start = (part.ravel() for part in scene.y0)
    return Problem("robertson", n, scene, ode, lambda t, x, z, p, m: x[:n] + x[n:] + z - 1, *start)


def heated(n):
    scene = heat(n)
    edge = np.ones((n, n), bool)
    edge[1:-1, 1:-1] = False
    inner, outer = np.flatnonzero(~edge), np.flatnonzero(edge)
    line = sparse.diags_array([1.0, -2.0, 1.0], offsets=[-1, 0, 1], shape=(n, n)) * (n - 1) ** 2
    own = sparse.eye_array(n)
    laplacian = sparse.csr_array(sparse.kron(own, line) + sparse.kron(line, own))[inner]
    within, across = laplacian[:, inner], laplacian[:, outer]

    def ode(t, x, z, p, m):
        return m.matrix(within) @ x + m.matrix(across) @ z

    u0 = scene.y0.ravel()
    order = np.concatenate([inner, outer])
    return Problem("heat", n, scene, ode, lambda t, x, z, p, m: z, u0[inner], u0[outer], order=order)


def prey(n):
    scene = food_web(n)
    b = growth(n).ravel()
    of_prey, of_predators = (spread * neumann_laplacian(n) for spread in SPREADS)

    def ode(t, x, z, p, m):
        return m.matrix(of_prey) @ x + x * (b - x - EATEN * z)

    def algebraic(t, x, z, p, m):
        return m.matrix(of_predators) @ z + z * (FED * x - b - z)

    return Problem("food web", n, scene, ode, algebraic, *(part.ravel() for part in scene.y0))


def flow(n):
    scene, of = stokes(n), operators(n)
    last = sparse.coo_array(([1.0], ([n * n - 1], [n * n - 1])), (n * n, n * n))
    divergence = sparse.lil_array(of.divergence)
    divergence[-1] = 0.0
    divergence, last = divergence.tocsr(), last.tocsr()

    def ode(t, x, z, p, m):
        return VISCOSITY * (m.matrix(of.laplacian) @ x + of.lid) - m.matrix(of.gradient) @ z

    def algebraic(t, x, z, p, m):
        return m.matrix(divergence) @ x + m.matrix(last) @ z

    return Problem("stokes", n, scene, ode, algebraic, *scene.y0)


def swing(n):
    """From the instant after the load has stepped, with the voltages that belong to it; p are the inertias."""
    scene, of = power_grid(n), grid(n)
    machines, loads, count = of.generators, of.loads, of.generators.size
    injected = np.zeros(n, complex)
    injected[loads] = -of.stepped - 1j * of.reactive
    z0 = np.array(power_flow(of.admittance, of.angle, of.voltage, injected, loads, loads))[:, loads]
    x0 = scene.y0[0].ravel()
    one = sparse.eye_array(n, format="csr")
    of_machines, of_loads = one[machines], one[loads]
    from_machines, from_loads = of_machines.T.tocsr(), of_loads.T.tocsr()
    ends = [one[end] for end in of.lines]
    sums = [end.T.tocsr() for end in ends]
    held = VOLTAGE * from_machines.sum(1)

    def flows(x, z, m):
        """Active and reactive power out of each bus, as in the scene."""
        angle = m.matrix(from_machines) @ x[:count] + m.matrix(from_loads) @ z[: loads.size]
        voltage = held + m.matrix(from_loads) @ z[loads.size :]
        (first, second), (v, w) = (tuple(m.matrix(end) @ y for end in ends) for y in (angle, voltage))
        across, product = first - second, of.susceptance * v * w
        active, aligned = product * m.sin(across), product * m.cos(across)
        at_first, at_second = map(m.matrix, sums)
        reactive = at_first @ (of.susceptance * v * v - aligned) + at_second @ (of.susceptance * w * w - aligned)
        return at_first @ active - at_second @ active, reactive

    def ode(t, x, z, p, m):
        active, _ = flows(x, z, m)
        return m.join([x[count:], (of.mechanical - m.matrix(of_machines) @ active - of.damping * x[count:]) / p])

    def algebraic(t, x, z, p, m):
        active, reactive = flows(x, z, m)
        take = m.matrix(of_loads)
        return m.join([take @ active + of.stepped, take @ reactive + of.reactive])

    y0 = scene.y0[0], z0
    return Problem("power grid", n, scene, ode, algebraic, x0, z0.ravel(), STEP, of.inertia, y0=y0)


PROBLEMS = {"robertson": robertson, "heat": heated, "food web": prey, "stokes": flow, "power grid": swing}


def samples(problem):
    """Evenly spaced, after the start."""
    return np.linspace(problem.t0, problem.scene.t1, SAMPLES + 1)[1:]


@functools.cache
def problem(name, n):
    return PROBLEMS[name](n)
