"""The stressors by family: {name: module}; each module has `cases(quick)` and says in its docstring what it is about; one
with `figures(folder, quick, cells)` draws, and gives the names and what they show.
"""

import functools

from ..cases import METHODS
from . import any_scene, baumgarte, broken, extremes, horizons, loops, precision, scales, singular, steps


FAMILIES = {
    "horizons": horizons,
    "steps": steps,
    "baumgarte": baumgarte,
    "scales": scales,
    "singular": singular,
    "loops": loops,
    "extremes": extremes,
    "precision": precision,
    "broken": broken,
}
# Before the name of a scene, in place of a family's.
SCENE = "scene "


def cases_of(family, quick):
    """The cases of a family, or of a scene of the library."""
    if family.startswith(SCENE):
        return any_scene.cases(family.removeprefix(SCENE), quick)
    return FAMILIES[family].cases(quick)


def cells_of(family, methods, quick):
    """(stressor, method) of a family, method by method: those of a method share programs."""
    cases = cases_of(family, quick)
    return [(case.name, name) for name in methods for case in cases if case.applies(name)]


def order(family, stressor, method):
    """Families, stressors and methods as they are listed; scenes and what is no more listed come last."""
    families, methods = list(FAMILIES), list(METHODS)
    stressors = _stressors(family)
    place = lambda x, known: known.index(x) if x in known else len(known)
    return place(family, families), family, place(stressor, stressors), stressor, place(method, methods)


@functools.cache
def _stressors(family):
    return list(dict.fromkeys(case.name for case in cases_of(family, False)))
