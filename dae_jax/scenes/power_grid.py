"""A transmission grid after a load step: machines swing, voltages follow at once; index 1."""

from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ..systems import SemiExplicitDAE
from ..types import Args, Time
from .scene import Scene, minimal


# When the load steps, in s; one bus of so many has a generator; its voltage per unit; 2 π times 50 Hz.
STEP, EVERY, VOLTAGE, NOMINAL = 1.0, 4, 1.02, 2 * np.pi * 50
# More buses are too much for the dense Jacobians of the reference.
KNOWN = 40


def power_grid(n: int = 8) -> Scene[SemiExplicitDAE]:
    """n buses, every fourth with a generator, the others with loads; one load steps after 1 s; index 1, 2 n unknowns:

        δ̇ = ω,   M ω̇ = P_m − P(θ, V) − D ω,   at generators, V = 1.02,
        0 = P(θ, V) + P_L,   0 = Q(θ, V) + Q_L,   at loads,

        P_i = Σⱼ bᵢⱼ Vᵢ Vⱼ sin(θᵢ − θⱼ),   Q_i = Σⱼ bᵢⱼ (Vᵢ² − Vᵢ Vⱼ cos(θᵢ − θⱼ)),   over its lines.

    x = (δ, ω) of the generators, in rad and rad/s off 50 Hz; z = (θ, V) of the loads, in rad and per unit; `args` are the
    inertias M in s²/rad, in per unit of power, one for each generator. The lines are a ring with chords to buses nearby, the
    same for every n.

    It starts in equilibrium. The reference finds (θ, V) for each (δ, ω) by Newton's method, in small grids; it is NaN in others.

    Source: A. R. Bergen, D. J. Hill, *IEEE Transactions on Power Apparatus and Systems* 100 (1981), 25, lossless lines and loads
    as buses; P. Kundur, *Power System Stability and Control*, sections 3.9 and 6.4.
    """
    of = grid(n)
    place = np.empty(n, int)
    place[np.concatenate([of.generators, of.loads])] = np.arange(n)

    def flows(x: Array, z: Array) -> tuple[Array, Array]:
        """Active and reactive power out of each bus into its lines."""
        angle = jnp.concatenate([x[0], z[0]])[place]
        voltage = jnp.concatenate([jnp.full(of.generators.size, VOLTAGE), z[1]])[place]
        i, j = of.lines
        across, product = angle[i] - angle[j], of.susceptance * voltage[i] * voltage[j]
        active, aligned = product * jnp.sin(across), product * jnp.cos(across)
        at = lambda bus, value: jax.ops.segment_sum(value, bus, n)
        reactive = at(i, of.susceptance * voltage[i] ** 2 - aligned) + at(j, of.susceptance * voltage[j] ** 2 - aligned)
        return at(i, active) - at(j, active), reactive

    def f(t: Time, x: Array, z: Array, args: Args):
        active, _ = flows(x, z)
        return jnp.stack([x[1], (of.mechanical - active[of.generators] - of.damping * x[1]) / args])

    def g(t: Time, x: Array, z: Array, args: Args):
        active, reactive = flows(x, z)
        active_load = jnp.where(t < STEP, of.active, of.stepped)
        return jnp.stack([active[of.loads] + active_load, reactive[of.loads] + of.reactive])

    start = (
        np.array([of.angle[of.generators], np.zeros(of.generators.size)]),
        np.array([of.angle, of.voltage])[:, of.loads],
    )
    return Scene(
        f"power-grid-{n}", SemiExplicitDAE(f, g), start, 20.0, _reference(of, start[0]), args=of.inertia, index=1,
        kinks=(STEP,),
    )  # fmt: skip


def grid(n: int) -> Any:
    """The data of `power_grid`: `generators`, `loads`, the two ends of `lines` and their `susceptance`; what generators take in,
    `mechanical`, and their `inertia` and `damping`; what loads take out, `active` before and `stepped` after the step, and
    `reactive`; `angle` and `voltage` of all buses in equilibrium. Powers are per unit.
    """
    random = np.random.default_rng(n)
    bus = np.arange(n)
    generators, loads = bus[::EVERY], bus[bus % EVERY > 0]
    chords = random.choice(n, n // 2, replace=False)
    lines = np.array([np.append(bus, chords), np.append(bus + 1, chords + random.integers(2, 6, n // 2)) % n])
    susceptance = random.uniform(5.0, 15.0, lines.shape[1])
    active = random.uniform(0.2, 0.8, loads.size)
    reactive = 0.2 * active
    # Each generator feeds the loads up to the next, so that no power has to go far.
    rating = np.bincount(loads // EVERY, active)
    rating = np.where(rating > 0, rating, 0.5)
    inertia = 2 * random.uniform(2.0, 6.0, generators.size) * rating / NOMINAL
    angle, voltage = np.zeros(n), np.where(bus % EVERY > 0, 1.0, VOLTAGE)
    injected = np.zeros(n, complex)
    injected[generators] = rating * active.sum() / rating.sum()
    injected[loads] = -active - 1j * reactive
    admittance = bus_admittance(n, lines, susceptance)
    angle, voltage = power_flow(admittance, angle, voltage, injected, bus[1:], loads)
    sent = voltage * np.exp(1j * angle) * (admittance @ (voltage * np.exp(1j * angle))).conj()
    stepped = active.copy()
    stepped[loads.size // 2] *= 2
    return SimpleNamespace(
        generators=generators, loads=loads, lines=lines, susceptance=susceptance, admittance=admittance,
        mechanical=sent.real[generators], inertia=inertia, damping=2.0 * inertia, active=active, stepped=stepped,
        reactive=reactive, angle=angle, voltage=voltage,
    )  # fmt: skip


def bus_admittance(n: int, lines: np.ndarray, susceptance: np.ndarray) -> Any:
    """The matrix Y with I = Y V of the currents into lines of these susceptances, 1/(j X)."""
    from scipy import sparse

    ends = sparse.coo_array((np.ones(lines.shape[1]), (np.arange(lines.shape[1]), lines[0])), (lines.shape[1], n))
    ends -= sparse.coo_array((np.ones(lines.shape[1]), (np.arange(lines.shape[1]), lines[1])), (lines.shape[1], n))
    return sparse.csr_array(ends.T @ sparse.diags_array(-1j * susceptance) @ ends)


def power_flow(
    admittance: Any,
    angle: np.ndarray,
    voltage: np.ndarray,
    injected: np.ndarray,
    free_angles: Any,
    free_voltages: Any,
    dense: bool = False,
) -> tuple[np.ndarray, np.ndarray]:
    """Angles and voltages at which the free buses send what is `injected`, P + j Q, into their lines: Newton's method.

    Source: R. D. Zimmerman, *AC Power Flows, Generalized OPF Costs and their Derivatives using Complex Matrix Notation*,
    MATPOWER Technical Note 2 (2010), for the Jacobian.
    """
    from scipy import sparse
    from scipy.sparse.linalg import spsolve

    diagonal: Any = np.diag if dense else lambda x: sparse.csr_array(sparse.diags_array(x))
    block: Any = np.block if dense else lambda rows: sparse.block_array(rows, format="csc")
    solve: Any = np.linalg.solve if dense else spsolve
    angle, voltage = angle.copy(), voltage.copy()
    for _ in range(20):
        phasors = diagonal(voltage * np.exp(1j * angle))
        between = phasors @ (admittance @ phasors).conj()
        sent = between.sum(1)
        by_angle = 1j * (diagonal(sent) - between)
        by_voltage = (between + diagonal(sent)) @ diagonal(1 / voltage)
        jacobian = block(
            [
                [by_angle.real[free_angles][:, free_angles], by_voltage.real[free_angles][:, free_voltages]],
                [by_angle.imag[free_voltages][:, free_angles], by_voltage.imag[free_voltages][:, free_voltages]],
            ]
        )
        off = sent - injected
        change = solve(jacobian, np.concatenate([off.real[free_angles], off.imag[free_voltages]]))
        angle[free_angles] -= change[: len(free_angles)]
        voltage[free_voltages] -= change[len(free_angles) :]
        # What is left is about the square of it.
        if np.abs(change).max() < 1e-8:
            return angle, voltage
    raise RuntimeError("the power flow has no solution near 1 per unit")


def _reference(of: Any, x0: np.ndarray):
    generators, loads, count = of.generators, of.loads, of.generators.size
    if of.angle.size > KNOWN:
        return lambda times: tuple(np.full((len(times), 2, size), np.nan) for size in (count, loads.size))
    admittance = of.admittance.toarray()

    def balanced(t: float, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Angles and voltages of all buses. Newton's method begins with each load turned as far as its generator."""
        injected = np.zeros(of.angle.size, complex)
        injected[loads] = -np.where(t < STEP, of.active, of.stepped) - 1j * of.reactive
        angle = of.angle + np.repeat(x[:count] - of.angle[generators], EVERY)[: of.angle.size]
        return power_flow(admittance, angle, of.voltage, injected, loads, loads, dense=True)

    def field(t: float, x: np.ndarray) -> np.ndarray:
        angle, voltage = balanced(t, x)
        phasors, speed = voltage * np.exp(1j * angle), x[count:]
        sent = (phasors * (admittance @ phasors).conj()).real[generators]
        return np.concatenate([speed, (of.mechanical - sent - of.damping * speed) / of.inertia])

    def embed(t: float, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return x.reshape(2, -1), np.array(balanced(t, x))[:, loads]

    return minimal(field, x0.ravel(), embed, kinks=(STEP,), max_step=np.inf)
