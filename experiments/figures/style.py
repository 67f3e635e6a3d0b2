"""The common style of all figures and web pages, and their files."""

from collections.abc import Callable, Sequence
from contextlib import nullcontext
from pathlib import Path
from string import ascii_uppercase
from typing import Any, Literal

import numpy as np
from jinja2 import Environment, FileSystemLoader, StrictUndefined
from matplotlib import rc_context
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.text import Text

from ...arrays import Array
from ...envs.rendering.scene import ELLIPSE_HANDLER, PlainTextFigure
from ...sim_configs.scenario_files import replace_when_written

INK, GREY, PALE = "#1b1f24", "#6b737c", "#e8eaed"
BLUE, ORANGE, ALARM, TEAL = "#0072b2", "#e69f00", "#d55e00", "#009e73"  # Okabe, Ito

_METADATA = {"svg": {"Date": None}, "pdf": {"CreationDate": None}}


def new_figure(width: float, height: float) -> Figure:
    """Return an empty figure [inches] with constrained layout, outside pyplot."""
    figure = PlainTextFigure(figsize=(width, height), dpi=100, layout="constrained")
    FigureCanvasAgg(figure)
    layout = figure.get_layout_engine()
    if layout is not None:
        layout.set(w_pad=0.1, h_pad=0.1, wspace=0.02, hspace=0.02)  # type: ignore[call-arg]
    return figure


def lay_out(figure: Figure, dpi: float) -> None:
    """Lay a figure out for good: with its engine, each drawing would do so anew."""
    figure.set_dpi(dpi)
    if (layout := figure.get_layout_engine()) is None:
        return
    with figure.plain() if isinstance(figure, PlainTextFigure) else nullcontext():
        for _ in range(2):  # equal axes need a second time
            layout.execute(figure)
    figure.set_layout_engine("none")


def save_figure(figure: Figure, path: str | Path, dpi: float = 200) -> None:
    """Write a figure to a file, which appears complete or not at all.

    The same figure gives the same bytes.

    Parameters
    ----------
    figure : Figure
        Any matplotlib figure.
    path : str or Path
        The file; its suffix selects the format: .png, .pdf, .svg, …
    dpi : float, default 200
        Pixels per inch of raster formats.

    Raises
    ------
    ValueError
        If the suffix names no format.
    """
    target = Path(path)
    formats = figure.canvas.get_supported_filetypes()
    if target.suffix.lower().removeprefix(".") not in formats:
        raise ValueError(
            f"path must end in one of {', '.join(f'.{f}' for f in sorted(formats))}, "
            f"got {str(path)!r}"
        )
    with replace_when_written(target) as partial:
        draw_file(figure, partial, target.suffix.lower(), dpi)


def draw_file(figure: Figure, path: Path, suffix: str, dpi: float = 300) -> None:
    """Write a figure in the format of a suffix, with the fonts in the file."""
    lay_out(figure, dpi)
    form = suffix.removeprefix(".")
    # The salt makes ids reproducible; type 42 is what publishers accept.
    with rc_context({"svg.hashsalt": "slamgym", "pdf.fonttype": 42}):
        figure.savefig(path, dpi=dpi, format=form, metadata=_METADATA.get(form))


def dress(axes: Axes, *, size: float = 10.0) -> None:
    """Apply the common style to axes: two spines, a pale grid, small grey ticks."""
    axes.spines[["top", "right"]].set_visible(False)
    axes.spines[["left", "bottom"]].set_color(GREY)
    axes.set_axisbelow(True)
    axes.grid(color=PALE, linewidth=0.8)
    axes.tick_params(color=GREY, labelcolor=INK, labelsize=size - 1)
    for label in (axes.xaxis.label, axes.yaxis.label):
        label.set(fontsize=size, color=INK)


def dress_map(
    axes: Axes,
    limits: Array,
    *,
    size: float = 10.0,
    labels: tuple[str, str] = ("x [m]", "y [m]"),
) -> None:
    """Apply the common style to axes of a map with limits, shape (2, 2) [m]."""
    dress(axes, size=size)
    axes.set(aspect="equal", xlim=limits[:, 0], ylim=limits[:, 1])
    axes.set(xlabel=labels[0], ylabel=labels[1])


def write_title(
    axes: Axes, title: str, subtitle: str = "", *, size: float = 11.0
) -> tuple[Text, Text]:
    """Write a bold title and a grey subtitle above the axes."""
    small = size - 1.5
    lift = 1.6 * small + 5 if subtitle else 5  # [points]
    above = axes.set_title(
        title, loc="left", fontsize=size, fontweight="bold", color=INK, pad=lift
    )
    below = axes.annotate(
        subtitle, (0, 1), (0, 6), xycoords="axes fraction", textcoords="offset points"
    )
    below.set(fontsize=small, color=GREY)
    return above, below


_LONGEST = 28  # characters of a filter in a subtitle


def short_name(label: str) -> str:
    """Return the name of a filter for a subtitle, without long options.

    Examples
    --------
    >>> short_name("invariant[iterations=3]")
    'invariant[iterations=3]'
    >>> short_name('invariant[management={association="nearest"}]')
    'invariant[…]'
    """
    if len(label) <= _LONGEST:
        return label
    name, bracket, _ = label.partition("[")
    short = name if len(name) <= _LONGEST else f"{name[:_LONGEST]}…"
    return f"{short}[…]" if bracket else short


def sign(figure: Figure, text: str) -> Figure:
    """Write what a figure is of into its lower right corner, and return it."""
    figure.text(0.995, 0.004, text, ha="right", va="bottom", fontsize=7, color=GREY)
    return figure


def deviations(covariances: Array) -> Array:
    """Return the standard deviations (..., n) of covariances (..., n, n)."""
    variances = np.diagonal(covariances, axis1=-2, axis2=-1)
    return np.asarray(np.sqrt(np.maximum(variances, 0.0)))


_Place = Literal["outside lower center", "outside upper left"]


def legend(
    figure: Figure,
    keys: Sequence[Artist],
    columns: int,
    *,
    place: _Place = "outside lower center",
    size: float = 9.0,
) -> None:
    """Put a legend of lines and ellipses outside the axes, by default below."""
    figure.legend(
        handles=list(keys),
        handler_map=ELLIPSE_HANDLER,
        loc=place,
        borderaxespad=1.5,  # above the signature
        ncols=columns,
        frameon=False,
        fontsize=size,
    )


_ROOM = 36  # characters for all columns of a terminal of 80
_GAP = 2


def headings_and_key(labels: Sequence[str]) -> tuple[list[str], str]:
    r"""Return the headings of columns, and the key that explains short ones.

    Labels that fit beside each other are headings themselves, and the key is empty.
    Else the headings are letters, and the key has a line for each.

    Examples
    --------
    >>> headings_and_key(["ekf", "invariant"])
    (['ekf', 'invariant'], '')
    >>> headings, key = headings_and_key(["ekf", "invariant[iterations=3]", "iterated"])
    >>> print(headings, key, sep="\n")
    ['A', 'B', 'C']
    A  ekf
    B  invariant[iterations=3]
    C  iterated
    """
    fits = sum(len(label) + _GAP for label in labels) <= _ROOM
    if fits or len(labels) > len(ascii_uppercase):
        return list(labels), ""
    letters = ascii_uppercase[: len(labels)]
    lines = [
        f"{letter}  {label}" for letter, label in zip(letters, labels, strict=True)
    ]
    return list(letters), "\n".join(lines)


# --------------------------------------------------------------------------------------
# Web pages: their colours, and how templates are filled.

_SHARED = Path(__file__).parent


def page_environment(
    folder: Path, finalize: Callable[[Any], Any] | None = None
) -> Environment:
    """Return an environment that escapes every value and refuses unknown ones.

    Its templates may include ``web_head.html``, the head of a page, which allows the
    script of ``script_hash`` alone, if any, and ``web_style.css``, the colours and
    fonts in light and dark.

    Parameters
    ----------
    folder : Path
        Where the templates are.
    finalize : callable, optional
        Applied to every value before it is written.
    """
    return Environment(
        loader=FileSystemLoader([folder, _SHARED]),
        autoescape=True,
        finalize=finalize,
        trim_blocks=True,
        keep_trailing_newline=True,
        undefined=StrictUndefined,
    )
