"""Figures as SVG inside a web page, in its fonts and colours."""

import io
import re
from html import escape

from matplotlib import rc_context
from matplotlib.figure import Figure

from ...figures.style import ALARM, BLUE, GREY, INK, ORANGE, PALE, TEAL
from .estimator_lines import PURPLE, SKY

COLOUR_VARIABLES = {
    INK: "--ink",
    "#000000": "--ink",
    GREY: "--grey",
    PALE: "--pale",
    "#ffffff": "--paper",
    BLUE: "--blue",
    ORANGE: "--orange",
    TEAL: "--teal",
    PURPLE: "--purple",
    SKY: "--sky",
    ALARM: "--alarm",
}
"""CSS variables that the page must define, by the colours of the figures."""


def inline_svg(figure: Figure, name: str, description: str) -> str:
    """Return a figure as an ``<svg>`` element without size, font or colour of its own.

    It fills the available width and keeps text as text; the same figure gives the same
    bytes.

    Parameters
    ----------
    figure : Figure
        A figure in the colours of `COLOUR_VARIABLES`.
    name : str
        Prefix of all ids, unique on the page.
    description : str
        Text for screen readers.
    """
    buffer = io.StringIO()
    figure.draw_without_rendering()
    with rc_context({"svg.fonttype": "none", "svg.hashsalt": name}):
        figure.savefig(buffer, format="svg", transparent=True, metadata={"Date": None})
    svg = buffer.getvalue()
    svg = svg[svg.index("<svg") :].strip()
    svg = re.sub(r"<metadata>.*?</metadata>", "", svg, flags=re.DOTALL)
    svg = re.sub(r"<style[^>]*>.*?</style>", "", svg, flags=re.DOTALL)
    svg = re.sub(r"<!--.*?-->", "", svg, flags=re.DOTALL)
    svg = _use_page_style(_short_numbers(_own_ids(svg, name)))
    box = re.search(r'viewBox="[^"]*"', svg)
    attributes = (
        f'{box[0] if box else ""} role="img" aria-label="{escape(description)}"'
    )
    return re.sub(r"<svg\b[^>]*>", lambda _: f"<svg {attributes}>", svg, count=1)


def _own_ids(svg: str, name: str) -> str:
    """Keep only ids that are referenced, and prefix them with the figure's name."""
    used = set(re.findall(r'(?:url\(#|href="#)([^)"]+)', svg))

    def renamed(match: re.Match[str]) -> str:
        return f' id="{name}-{match[1]}"' if match[1] in used else ""

    svg = re.sub(r'\s+id="([^"]*)"', renamed, svg)
    svg = re.sub(r"url\(#", f"url(#{name}-", svg)
    return re.sub(r'(?:xlink:)?href="#', f'href="#{name}-', svg)


def _short_numbers(svg: str) -> str:
    """Round coordinates to a hundredth of a point."""

    def shortened(match: re.Match[str]) -> str:
        return re.sub(r"(\.\d\d)\d+", r"\1", match[0])

    svg = re.sub(r'\b(?:d|x|y|transform)="[^"]*"', shortened, svg)
    return re.sub(r"\s*\n\s*", "\n", svg)


def _use_page_style(svg: str) -> str:
    """Remove fonts, and take colours from the page's variables."""
    svg = re.sub(r"\bfont: ([\d.]+px) [^;\"]*", r"font-size: \1", svg)
    svg = re.sub(r"font-family: [^;\"]*;?", "", svg)
    for colour, variable in COLOUR_VARIABLES.items():
        svg = re.sub(rf"\b(fill|stroke): {colour}\b", rf"\1: var({variable})", svg)
    return svg
