"""Self-contained HTML pages: styles, scripts and pictures inside the one file, nothing loaded from elsewhere."""

from __future__ import annotations

import io
import json
import re
from base64 import b64encode
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from html import escape
from importlib.resources import files
from typing import Any

import matplotlib as mpl
from matplotlib.figure import Figure

# Okabe and Ito, "Color universal design": told apart with any colour vision; yellow left out, it vanishes on paper.
OKABE_ITO = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000", "#7F7F7F")
MARKERS = ("o", "s", "^", "D", "v", "P", "X", "*")
DASHES: tuple[str | tuple[float, tuple[float, ...]], ...] = (
    "-",
    (0, (5, 2)),
    (0, (1, 1.4)),
    (0, (5, 1.5, 1, 1.5)),
    (0, (3, 1, 1, 1, 1, 1)),
    (0, (7, 3)),
    (0, (2, 2)),
    (0, (4, 1)),
)

PIXELS_PER_INCH = 108
"""A figure's 9 pt letters are then 13.5 px high, somewhat smaller than the page's own."""

STYLE: dict[Any, Any] = {
    "font.size": 9,
    "axes.titlesize": 9.5,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.labelsize": 9,
    "axes.edgecolor": "#8a95a1",
    "axes.linewidth": 0.7,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.color": "#e4e8ec",
    "grid.linewidth": 0.6,
    "axes.axisbelow": True,
    "lines.linewidth": 1.5,
    "lines.markersize": 4.2,
    "legend.frameon": False,
    "legend.fontsize": 8.5,
    "xtick.color": "#3a4552",
    "ytick.color": "#3a4552",
    "xtick.labelsize": 8,
    "ytick.labelsize": 8,
    "figure.constrained_layout.use": True,
    "svg.fonttype": "none",
    "svg.hashsalt": "surfacelink",
}


def line_style(k: int) -> dict[str, Any]:
    """Colour, dashes and marker of the `k`-th line of a plot, as matplotlib's keywords; a colour that comes again has
    other dashes and another marker.
    """
    other = k + k // len(OKABE_ITO)
    return {
        "color": OKABE_ITO[k % len(OKABE_ITO)],
        "linestyle": DASHES[other % len(DASHES)],
        "marker": MARKERS[other % len(MARKERS)],
    }


def page(title: str, body: str, *, script: str = "") -> str:
    """A whole HTML page; `body` is HTML, `title` is text, `script` the name of a script in assets."""
    assets = files("simulator") / "assets"
    code = f"<script>\n{(assets / script).read_text('utf-8')}</script>\n" if script else ""
    return (
        '<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{escape(title)}</title>\n<style>\n{(assets / 'page.css').read_text('utf-8')}</style>\n</head>\n"
        f"<body>\n<main>\n{body}\n</main>\n{code}</body>\n</html>\n"
    )


def svg(figure: Figure) -> str:
    """The figure as an SVG element to stand in a page; the same figure gives the same text."""
    buffer = io.StringIO()
    with mpl.rc_context(STYLE):
        figure.savefig(buffer, format="svg", metadata={"Date": None, "Creator": None})
    element = buffer.getvalue()[buffer.getvalue().index("<svg") :]
    # matplotlib's metadata carries addresses that nobody needs; the size in points gives way to the page's width.
    element = re.sub(r"<metadata>.*?</metadata>", "", element, count=1, flags=re.DOTALL)
    element = re.sub(r' (width|height)="[^"]*pt"', "", element, count=2)
    width = round(figure.get_figwidth() * PIXELS_PER_INCH)
    return element.replace("<svg ", f'<svg style="max-width: {width}px" ', 1).replace(
        "'DejaVu Sans'", "'DejaVu Sans', Verdana, sans-serif"
    )


def png(figure: Figure, *, dpi: int = 150) -> bytes:
    """The figure as a PNG file."""
    buffer = io.BytesIO()
    with mpl.rc_context(STYLE):
        figure.savefig(buffer, format="png", dpi=dpi, metadata={"Software": None})
    return buffer.getvalue()


def image(data: bytes, alt: str) -> str:
    """An <img> that holds a PNG."""
    return f'<img alt="{escape(alt, quote=True)}" src="data:image/png;base64,{b64encode(data).decode()}">'


def illustration(picture: str, caption: str) -> str:
    """A <figure>; `picture` and `caption` are HTML."""
    return f"<figure>\n{picture}\n<figcaption>{caption}</figcaption>\n</figure>"


@dataclass(frozen=True)
class TableCell:
    """A cell of a table with its CSS classes; `html` is HTML."""

    html: str
    classes: str = ""


def table(head: Sequence[str], rows: Iterable[Sequence[TableCell | str]], *, caption: str = "", names: int = 1) -> str:
    """A <table>; strings are text, `caption` is HTML, the first `names` columns are aligned to the left."""

    def cell(column: int, value: TableCell | str, tag: str) -> str:
        content = value if isinstance(value, TableCell) else TableCell(escape(value))
        classes = " ".join(filter(None, ["name" if column < names else "", content.classes]))
        return f"<{tag}{f' class={chr(34)}{classes}{chr(34)}' if classes else ''}>{content.html}</{tag}>"

    body = [list(row) for row in rows]
    lines = ["<tr>" + "".join(cell(k, value, "td") for k, value in enumerate(row)) + "</tr>" for row in body]
    # A heading is aligned as the first cell below it.
    below = [value.classes.split() if isinstance(value, TableCell) else [] for value in (body[0] if body else head)]
    left = ["name" if "wrap" in classes or "name" in classes else "" for classes in below]
    top = "".join(cell(k, TableCell(escape(text), left[k]), "th") for k, text in enumerate(head))
    title = f"<caption>{caption}</caption>" if caption else ""
    content = f"<thead><tr>{top}</tr></thead><tbody>\n" + "\n".join(lines) + "\n</tbody>"
    return f'<div class="scroll"><table>{title}{content}</table></div>'


def data_script(identifier: str, value: object) -> str:
    """JSON for a script of the page to read; safe wherever it stands."""
    text = json.dumps(value, separators=(",", ":"), allow_nan=False).replace("<", "\\u003c")
    return f'<script type="application/json" id="{escape(identifier, quote=True)}">{text}</script>'
