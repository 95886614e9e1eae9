"""Ready mechanisms of bodies and joints, and scenes of them, each with a reference that is independent of the library."""

from collections.abc import Callable

from ...scenes.scene import Scene
from ...systems import ConstrainedSystem
from .delta import delta as delta, delta_robot as delta_robot
from .engine import engine as engine, engine_with_four_cylinders as engine_with_four_cylinders
from .five_bar import five_bar as five_bar, five_bar_linkage as five_bar_linkage
from .rolling_disc import disc as disc, rolling_disc as rolling_disc
from .stewart import stewart as stewart, stewart_platform as stewart_platform


# By their names on the command line, as `scenes.SCENES`.
EXAMPLES: dict[str, Callable[[], Scene[ConstrainedSystem]]] = {
    "delta": delta,
    "engine": engine,
    "five-bar": five_bar,
    "rolling-disc": disc,
    "stewart": stewart,
}
