"""The common style of all figures and web pages, and their files."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jinja2 import Environment, FileSystemLoader, StrictUndefined, Template
from matplotlib import rc_context
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import EllipseCollection
from matplotlib.colors import to_rgba
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse
from matplotlib.text import Text

from ...arrays import Array
from ...envs.rendering import covariance_ellipses
from ...envs.rendering.scene import ELLIPSE_HANDLER, PlainTextFigure
from ...sim_configs.atomic_file import replace_when_written

INK, GREY, PALE = "#1b1f24", "#6b737c", "#e8eaed"
BLUE, ORANGE, ALARM, TEAL = "#0072b2", "#e69f00", "#d55e00", "#009e73"  # Okabe, Ito

_METADATA = {".svg": {"Date": None}, ".pdf": {"CreationDate": None}}


def new_figure(width: float, height: float) -> Figure:
    """Return an empty figure [inches] with constrained layout, outside pyplot."""
    figure = PlainTextFigure(figsize=(width, height), dpi=100, layout="constrained")
    FigureCanvasAgg(figure)
    layout = figure.get_layout_engine()
    if layout is not None:
        layout.set(w_pad=0.1, h_pad=0.1, wspace=0.02, hspace=0.02)  # type: ignore[call-arg]
    return figure


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
    figure.draw_without_rendering()  # equal axes need a second layout
    with replace_when_written(target) as partial:
        metadata = _METADATA.get(target.suffix.lower())
        with rc_context({"svg.hashsalt": "slamgym"}):  # makes its ids reproducible
            figure.savefig(partial, dpi=dpi, metadata=metadata)


def dress(axes: Axes, *, size: float = 10.0) -> None:
    """Apply the common style to axes: two spines, a pale grid, small grey ticks."""
    axes.spines[["top", "right"]].set_visible(False)
    axes.spines[["left", "bottom"]].set_color(GREY)
    axes.set_axisbelow(True)
    axes.grid(color=PALE, linewidth=0.8)
    axes.tick_params(color=GREY, labelcolor=INK, labelsize=size - 1)
    for label in (axes.xaxis.label, axes.yaxis.label):
        label.set(fontsize=size, color=INK)


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
        subtitle,
        (0, 1),
        (0, 6),
        xycoords="axes fraction",
        textcoords="offset points",
        fontsize=small,
        color=GREY,
    )
    return above, below


class EllipseKind(NamedTuple):
    """The style of one kind of ellipses in the picture and in the legend."""

    label: str
    colour: str
    line: str | tuple[float, tuple[float, ...]] = "-"
    fill: float = 0.0
    width: float = 1.2
    alpha: float = 1.0

    def add_to(self, axes: Axes, scale: float = 1.0) -> EllipseCollection:
        """Add an empty collection in data coordinates."""
        shown = EllipseCollection(
            [],
            [],
            [],
            units="xy",
            offsets=np.empty((0, 2)),
            offset_transform=axes.transData,
            facecolors=[to_rgba(self.colour, self.fill)],
            edgecolors=[to_rgba(self.colour, self.alpha)],
            linestyles=[self.line],
            linewidths=self.width * scale,
            label=self.label,
        )
        axes.add_collection(shown, autolim=False)
        return shown

    def legend_key(self) -> Ellipse:
        """Return the key for a legend drawn with `ELLIPSE_HANDLER`."""
        return Ellipse(
            (0, 0),
            1,
            1,
            facecolor=to_rgba(self.colour, self.fill),
            edgecolor=to_rgba(self.colour, self.alpha),
            linestyle=self.line,
            linewidth=self.width,
            label=self.label,
        )


def set_ellipses(shown: EllipseCollection, means: Array, covariances: Array) -> None:
    """Set the 3σ ellipses of n positions: means (n, 2) [m], covariances (n, 2, 2)."""
    outline = covariance_ellipses(np.reshape(covariances, (-1, 2, 2)))
    shown.set(
        offsets=np.reshape(means, (-1, 2)),
        widths=outline.widths,
        heights=outline.heights,
        angles=np.degrees(outline.angles),  # matplotlib's unit
    )


def legend_below(figure: Figure, keys: Sequence[Artist], columns: int) -> None:
    """Put a legend of lines and ellipses below the axes."""
    figure.legend(
        handles=list(keys),
        handler_map=ELLIPSE_HANDLER,
        loc="outside lower center",
        ncols=columns,
        frameon=False,
        fontsize=9,
    )


# --------------------------------------------------------------------------------------
# Web pages: their colours, and how templates are filled.

_SHARED = Path(__file__).parent


def page_environment(
    folder: Path, finalize: Callable[[Any], Any] | None = None
) -> Environment:
    """Return an environment that escapes every value and refuses unknown ones.

    Its templates may include ``web_style.css``, the colours and fonts in light and
    dark.

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


def page_template(folder: Path, name: str) -> Template:
    """Return a template of a folder; see :func:`page_environment`."""
    return page_environment(folder).get_template(name)
