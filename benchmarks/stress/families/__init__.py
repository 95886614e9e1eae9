"""The stressors by family: {name: module}; each module has `cases(quick)` and says in its docstring what it is about."""

from . import any_scene, broken, scales


FAMILIES = {
    "scales": scales,
    "broken": broken,
}
# Before the name of a scene, in place of a family's.
SCENE = "scene "


def cases_of(family, quick):
    """The cases of a family, or of a scene of the library."""
    if family.startswith(SCENE):
        return any_scene.cases(family.removeprefix(SCENE), quick)
    return FAMILIES[family].cases(quick)
