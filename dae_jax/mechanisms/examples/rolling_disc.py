"""A disc that rolls on a plane."""

import numpy as np

from ...scenes.scene import Scene, minimal
from ...systems import ConstrainedSystem
from ..bodies import Body, ground
from ..contacts import rolling
from ..loads import gravity
from ..mechanism import Mechanism
from .minimal_coordinates import at_start, named, rotated, turn


RADIUS, MASS, GRAVITY = 0.3, 2.0, np.array([0.0, 0.0, -9.81])
INERTIA = MASS * RADIUS**2 * np.array([0.25, 0.25, 0.5])
# Its axis leans from the horizontal; it rolls ahead, along x, and turns.
LEAN, SPIN = 0.3, np.array([0.1, 5.0, 0.8])
TURN = turn((1, 0, 0), np.asarray(LEAN - np.pi / 2))


def rolling_disc() -> Mechanism:
    """A thin disc on its edge on a plane that is level: one equation of positions, two of velocities, which are not holonomic."""
    axis = _axis(TURN)
    arm = _contact(axis)
    disc = Body("disc", MASS, INERTIA, at=-arm, orientation=TURN, velocity=-np.cross(SPIN, arm), spin=SPIN)
    rolls = rolling(ground, disc, radius=RADIUS, at=(0, 0, 0), normal=(0, 0, 1), axis=axis, name="ground")
    return Mechanism([disc], [rolls], [gravity(GRAVITY)])


def disc() -> Scene[ConstrainedSystem]:
    """A disc that rolls on its edge, `rolling_disc`, in space; against Newton's and Euler's equations about its point of contact,

        I ω̇ + ω × I ω = ρ × m (v̇ − g),   v = −ω × ρ,   ρ = −R (n − (n·u) u)/|n − (n·u) u|,

    for the plane's normal n and the disc's axis u: three equations for ω̇, without multipliers.
    """
    mechanism = rolling_disc()

    def field(t: float, state: np.ndarray) -> np.ndarray:
        e, spin = state[3:7], state[7:]
        axes = np.stack([rotated(e, unit) for unit in np.eye(3)], 1)
        inertia = axes @ np.diag(INERTIA) @ axes.T
        arm, change = _contact(axes[:, 2]), _contact_rate(axes[:, 2], np.cross(spin, axes[:, 2]))
        # ρ × (ω̇ × ρ) = (|ρ|² − ρ ρᵀ) ω̇.
        about = inertia + MASS * (arm @ arm * np.eye(3) - np.outer(arm, arm))
        moment = -np.cross(spin, inertia @ spin) - MASS * np.cross(arm, np.cross(spin, change) + GRAVITY)
        return np.concatenate([-np.cross(spin, arm), _quaternion_rate(e, spin), np.linalg.solve(about, moment)])

    def embed(t: float, state: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        place, e, spin = state[:3], state[3:7], state[7:]
        arm = _contact(_axis(e))
        velocity = np.concatenate([-np.cross(spin, arm), _quaternion_rate(e, spin)])
        return np.concatenate([place, e])[None], velocity[None]

    start = np.concatenate([-_contact(_axis(TURN)), TURN, SPIN])
    reference = named(mechanism.bodies, minimal(field, start, embed))
    return Scene("rolling-disc", mechanism.system(), at_start(reference), 3.0, reference, drawing=mechanism.drawing())


def _axis(e: np.ndarray) -> np.ndarray:
    """u."""
    return rotated(e, np.array([0.0, 0.0, 1.0]))


def _contact(axis: np.ndarray) -> np.ndarray:
    """ρ."""
    up = np.array([0.0, 0.0, 1.0]) - axis[2] * axis
    return -RADIUS * up / np.sqrt(up @ up)


def _contact_rate(axis: np.ndarray, rate: np.ndarray) -> np.ndarray:
    """ρ̇, by a complex step."""
    return np.imag(_contact(axis + 1e-30j * rate)) / 1e-30


def _quaternion_rate(e: np.ndarray, spin: np.ndarray) -> np.ndarray:
    """ė of an angular velocity in world axes."""
    return np.concatenate([[-e[1:] @ spin], e[0] * spin + np.cross(spin, e[1:])]) / 2
