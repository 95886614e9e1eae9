"""Tables that a notebook shows in place of a text: legible in light and in dark, with nothing from outside."""

import html
from collections.abc import Mapping


# Colours are left to the notebook: lines are those of its text, faint.
_LINE = "border-top:1px solid color-mix(in srgb,currentColor 15%,transparent)"
_CELL = f"text-align:left;vertical-align:top;padding:2px 14px 2px 0;{_LINE}"


def table(title: str, rows: Mapping[str, str], more: str = "") -> str:
    """Names and what is said of them, below a title, and a longer text whose columns are kept, to be unfolded. All of it is
    text: what looks like html is shown as it is written.
    """
    cells = "".join(
        f'<tr style="background:none"><th style="{_CELL};font-weight:normal;opacity:.7;white-space:nowrap">'
        f'{html.escape(name)}</th><td style="{_CELL};white-space:pre-wrap">{html.escape(text)}</td></tr>'
        for name, text in rows.items()
    )
    return (
        f'<div><b>{html.escape(title)}</b><table style="border-collapse:collapse;border:none;margin:2px 0">{cells}</table>'
        + (
            f'<details><summary>more</summary><pre style="overflow-x:auto">{html.escape(more)}</pre></details>'
            if more
            else ""
        )
        + "</div>"
    )
