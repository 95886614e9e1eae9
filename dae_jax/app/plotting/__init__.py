"""Figures. The only part that imports matplotlib, and only when a figure is drawn.

Every function returns a `matplotlib.figure.Figure` and leaves pyplot's state alone, `animate` an `Animation`. `curves` maps a
label to (x, y).
"""

from .animation import FILM_TYPES as FILM_TYPES, Animation as Animation, animate as animate
from .common import FILE_TYPES as FILE_TYPES, METHODS as METHODS, look as look
from .curves import (
    drift as drift,
    drift_growth as drift_growth,
    energy as energy,
    over_time as over_time,
    phase_portrait as phase_portrait,
    scaling as scaling,
    tuning as tuning,
    work_precision as work_precision,
)
from .grids import incidence as incidence, sweep_map as sweep_map
from .plane import mechanism as mechanism, trajectory as trajectory
