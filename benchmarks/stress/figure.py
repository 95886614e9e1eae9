"""The map: stressors down, methods across; the colour is how many digits were lost, the symbol how the solve ended."""

from .cases import METHODS


LOST = 8
GOOD, SILENT, WRONG = "#3E8E7E", "#C9CDD2", "#5B0A1E"


def table(cells):
    """A figure of all cells, family by family."""
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import LinearSegmentedColormap, Normalize
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    methods = [name for name in METHODS if any(cell.method == name for cell in cells)]
    rows = list(dict.fromkeys((cell.family, cell.stressor) for cell in cells))
    families = [family for family, _ in rows]
    # A gap between families.
    place, at = {}, 0.0
    for i, row in enumerate(rows):
        at += 0 if i == 0 else 1.6 if families[i] != families[i - 1] else 1
        place[row] = at
    height = 0.21 * (at + 1) + 2.6
    shown = Figure(figsize=(max(3.9 + 0.36 * len(methods), 6.4), height), layout="constrained", dpi=160)
    axes = shown.subplots()
    colours = LinearSegmentedColormap.from_list("lost", ["#DDE5B0", "#EFC75E", "#E8871E", "#AE2012"])
    norm = Normalize(0, LOST)
    for cell in cells:
        x, y = methods.index(cell.method), place[cell.family, cell.stressor]
        undue = cell.ended != "answer" and cell.verdict in ("refused", "failed")
        colour = GOOD if cell.lost == 0 else colours(norm(cell.lost))
        colour = WRONG if cell.verdict == "WRONG" else SILENT if undue else colour
        axes.add_patch(_square(x, y, colour))
        marker = {"WRONG": "x", "warned": "D"}.get(cell.verdict, {"refused": "s", "failed": "^"}.get(cell.ended))
        if marker:
            ink = "white" if cell.verdict == "WRONG" or not undue else "#3A3F45"
            axes.plot(
                x,
                y,
                marker,
                color=ink,
                markersize=4,
                markeredgewidth=1.4,
                markerfacecolor="none" if marker != "x" else ink,
            )
    for family in dict.fromkeys(families):
        top = min(place[row] for row in rows if row[0] == family)
        axes.text(len(methods) - 0.35, top, family, fontsize=7.5, fontweight="bold", va="center", color="#3A3F45")
    axes.set(xlim=(-0.55, len(methods) - 0.45), ylim=(at + 0.6, -0.6))
    axes.set_xticks(range(len(methods)), methods, rotation=55, ha="left", fontsize=7.5)
    axes.xaxis.tick_top()
    axes.set_yticks([place[row] for row in rows], [stressor for _, stressor in rows], fontsize=7)
    axes.tick_params(length=0)
    for side in axes.spines.values():
        side.set_visible(False)
    bar = shown.colorbar(ScalarMappable(norm, colours), ax=axes, location="bottom", aspect=40, shrink=0.6, pad=0.01)
    bar.set_label("digits lost beyond what is allowed", fontsize=7.5)
    bar.ax.tick_params(labelsize=7)
    bar.outline.set_visible(False)
    ink = {"linestyle": "none", "markersize": 5, "markeredgewidth": 1.4}
    handles = [
        Patch(color=GOOD, label="all digits that were asked for"),
        Line2D([], [], marker="s", color="#3A3F45", markerfacecolor="none", label="refused in words", **ink),
        Line2D([], [], marker="^", color="#3A3F45", markerfacecolor="none", label="failed in words", **ink),
        Line2D(
            [], [], marker="D", color="#3A3F45", markerfacecolor="none", label="no two digits, and a warning", **ink
        ),
        Patch(color=SILENT, label="no answer, where there is one"),
        Line2D([], [], marker="x", color=WRONG, label="WRONG: no two digits, no word", **ink),
    ]
    shown.legend(handles=handles, loc="outside lower center", ncols=3, frameon=False, fontsize=7.5)
    return shown


def _square(x, y, colour):
    from matplotlib.patches import FancyBboxPatch

    size = 0.86
    style = "round,pad=0,rounding_size=0.12"
    return FancyBboxPatch((x - size / 2, y - size / 2), size, size, boxstyle=style, facecolor=colour, edgecolor="none")
