"""The stressors by family: {name: module}; each module has `cases(quick)` and says in its docstring what it is about; one
with `figures(folder, quick, cells)` draws, and gives the names and what they show.
"""

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
