"""From points in space to points in a picture."""

import itertools

import numpy as np
from jaxtyping import Float


# From where a scene is seen, in degrees, and from how far, in half diagonals of the box around it.
AZIMUTH, ELEVATION, DISTANCE = -55.0, 18.0, 4.0


class Camera:
    """Central perspective of what is in a box; the third coordinate points up, or `down`.

    - `box`: (2, 3), the lowest and the highest coordinates of all that is to be seen, in m.
    """

    def __init__(self, box: Float[np.ndarray, "2 3"], down: bool = False) -> None:
        self.box, self.middle = box, box.mean(0)
        self.radius = extent(box) / 2
        azimuth, elevation = np.radians((AZIMUTH, ELEVATION))
        (sa, ca), (se, ce) = ((np.sin(x), np.cos(x)) for x in (azimuth, elevation))
        axes = np.array([[-sa, ca, 0.0], [-se * ca, -se * sa, ce], [ce * ca, ce * sa, se]])
        # Down is made up by half a turn about x, not by a mirror: right-handed coordinates stay so.
        self.axes = axes * (np.array([1.0, -1.0, -1.0]) if down else 1.0)
        self.ground = float(box[1, 2] if down else box[0, 2])

    @classmethod
    def around_motion(cls, points: Float[np.ndarray, "frames points 3"], down: bool) -> "Camera":
        """With all that points reach in the picture."""
        flat = points.reshape(-1, 3)
        return cls(np.stack([flat.min(0), flat.max(0)]), down)

    def __call__(self, points: Float[np.ndarray, "*frames 3"]) -> Float[np.ndarray, "*frames 3"]:
        """To the right, upwards and towards the eye, in m at the middle of the box; what is nearer is larger."""
        right, up, near = np.moveaxis((points - self.middle) @ self.axes.T, -1, 0)
        size = DISTANCE * self.radius / (DISTANCE * self.radius - near)
        return np.stack([size * right, size * up, near], -1)

    def shadow(self, points: Float[np.ndarray, "*frames 3"]) -> Float[np.ndarray, "*frames 3"]:
        """The points below, or above where `down`, on the ground."""
        return np.concatenate([points[..., :2], np.full_like(points[..., 2:], self.ground)], -1)

    def around(self) -> Float[np.ndarray, "around 2"]:
        """What has to be in the picture: the corners of the box, and the ground."""
        corners = self(np.array(list(itertools.product(*self.box.T))))
        return np.concatenate([corners[:, :2], self.grid()[1][..., :2].reshape(-1, 2)])

    def grid(self, cells: int = 8) -> tuple[float, Float[np.ndarray, "lines 2 3"]]:
        """Lines on the ground, in the picture, and how far apart they are, in m: 1, 2 or 5 times a power of ten."""
        half = np.maximum(np.ptp(self.box[:, :2], axis=0) / 2, 0.3 * self.radius)
        step = nice(2 * half.max() / cells)
        (x, y), (right, far) = (
            step * np.floor((self.middle[:2] - half) / step),
            step * np.ceil((self.middle[:2] + half) / step),
        )
        along = [[(u, y), (u, far)] for u in np.arange(x, right + step / 2, step)]
        across = [[(x, v), (right, v)] for v in np.arange(y, far + step / 2, step)]
        flat = np.array(along + across)
        return step, self(self.shadow(np.concatenate([flat, np.zeros((*flat.shape[:2], 1))], -1)))


def extent(points: Float[np.ndarray, "*points dimensions"]) -> float:
    """The diagonal of the box around points; where they do not move, how far off the origin they are, or 1 m."""
    flat = points.reshape(-1, points.shape[-1])
    diagonal, far = float(np.linalg.norm(np.ptp(flat, axis=0))), float(np.abs(flat).max())
    return diagonal if diagonal > 2e-6 * far else 2 * far or 1.0


def nice(step: float) -> float:
    """The next of 1, 2, 5, 10, … times a power of ten."""
    power = 10.0 ** np.floor(np.log10(step))
    return float(power * next(k for k in (1, 2, 5, 10) if k * power >= step * (1 - 1e-12)))
