"""The matplotlib artists of a scene, each created once."""

from typing import Any, NamedTuple

import numpy as np
from matplotlib import rc_context
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.collections import EllipseCollection, LineCollection
from matplotlib.colors import to_rgba
from matplotlib.figure import Figure
from matplotlib.legend_handler import HandlerPatch
from matplotlib.lines import Line2D
from matplotlib.patches import Ellipse, Polygon
from matplotlib.text import Text

from ...arrays import Array
from ...sim_configs import Scenario
from .clock import Clock
from .ellipses import covariance_ellipses

INK, GREY, WALL = "#1b1f24", "#8a9199", "#6b5a4e"
RAY, ALARM, POSE, MAP = "#e69f00", "#d55e00", "#0072b2", "#009e73"  # Okabe and Ito
AXES_BOX = (0.105, 0.165, 0.87, 0.775)  # left, bottom, width, height of the figure
_TITLE_HEIGHT = 0.957  # of the figure
NO_POINT = np.full((1, 2), np.nan)
_PLAIN: dict[Any, Any] = {"text.usetex": False}


class PlainTextFigure(Figure):
    """A figure that never needs LaTeX, even where matplotlibrc sets text.usetex."""

    def draw(self, renderer: Any) -> None:
        """Draw the figure."""
        for text in self.findobj(Text):
            text.set_usetex(False)
        with rc_context(_PLAIN):  # for the labels that matplotlib makes meanwhile
            super().draw(renderer)

    def savefig(self, *args: Any, **kwargs: Any) -> None:
        """Write the figure to a file."""
        with rc_context(_PLAIN):
            super().savefig(*args, **kwargs)


class MovingArtists(NamedTuple):
    """The artists that change between frames, from back to front."""

    view: Polygon
    rays: LineCollection
    readings: Line2D
    clutter: Line2D
    path: Line2D
    map_ellipses: EllipseCollection
    map: Line2D
    pose_ellipse: EllipseCollection
    body: EllipseCollection
    halo: EllipseCollection
    arrow: Polygon
    estimate: Polygon
    alarm: Text
    clock: Clock


def add_axes(figure: Figure, name: str) -> Axes:
    """Add axes in metres at a fixed place, with a title at the left."""
    axes = figure.add_axes(AXES_BOX)
    axes.set(aspect="equal", xlabel="x [m]", ylabel="y [m]")
    axes.grid(color="#e8eaed", linewidth=0.8)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
    axes.spines[["left", "bottom"]].set_color(GREY)
    axes.tick_params(color=GREY, labelsize=9)
    figure.add_artist(_title(AXES_BOX[0], "left", name))
    return axes


def add_still(axes: Axes, scenario: Scenario, landmarks: Array) -> list[Artist]:
    """Draw landmarks and walls, and return the artists for the legend."""
    size = 8 if len(landmarks) <= 60 else 5
    (crosses,) = axes.plot(
        *landmarks.T, "+", color=INK, ms=size, mew=size / 6, label="landmark"
    )
    if not scenario.walls:
        return [crosses]
    walls = LineCollection(
        list(np.reshape(scenario.walls, (-1, 2, 2))),
        colors=WALL,
        linewidths=2.5,
        capstyle="round",
        label="wall",
    )
    axes.add_collection(walls)
    return [crosses, walls]


def add_moving(axes: Axes, radius: float) -> MovingArtists:
    """Create the moving artists without data; `radius` is that of the robot [m]."""
    moving = MovingArtists(
        view=Polygon(
            NO_POINT,
            fc=(*to_rgba(RAY)[:3], 0.07),
            ec=RAY,
            lw=0.6,
            label="field of view",
        ),
        rays=LineCollection([], colors=RAY, linewidths=0.9, alpha=0.6),
        readings=_points("o", RAY, "reading"),
        clutter=_points("x", ALARM, "clutter"),
        path=Line2D([], [], color=INK, linewidth=1.4, alpha=0.8, label="true path"),
        map_ellipses=_ellipses(axes, MAP, fill=0.13),
        map=_points(".", MAP, ""),
        pose_ellipse=_ellipses(axes, POSE, fill=0.15),
        body=_ellipses(axes, INK, fill=0.12),
        halo=_ellipses(axes, ALARM, fill=0.2),
        arrow=Polygon(NO_POINT, fc=INK, ec="white", lw=0.7),
        estimate=Polygon(NO_POINT, fc="none", ec=POSE, lw=1.5),
        alarm=_title(0.64, "right", "collision", ALARM),
        clock=Clock(sum(AXES_BOX[::2]), _TITLE_HEIGHT, INK),
    )
    moving.body.set(widths=[2 * radius], heights=[2 * radius], angles=[0.0])
    moving.halo.set(angles=[0.0], linewidth=2.0)
    for artist in moving:
        home = axes.figure if isinstance(artist, Text | Clock) else axes
        home.add_artist(artist)
    return moving


def _title(x: float, align: str, text: str, colour: str = INK) -> Text:
    title = Text(x, _TITLE_HEIGHT, text, fontsize=11, ha=align, color=colour)
    title.set_parse_math(False)  # a name with a $ is no formula
    return title


def _ellipses(axes: Axes, colour: str, fill: float) -> EllipseCollection:
    return EllipseCollection(
        [],
        [],
        [],
        units="xy",
        offsets=np.empty((0, 2)),
        offset_transform=axes.transData,
        facecolors=[(*to_rgba(colour)[:3], fill)],
        edgecolors=colour,
        linewidths=1.2,
        antialiaseds=[
            True,
            True,
        ],  # two: a single ellipse is not measured first, slowly
    )


def set_ellipses(shown: EllipseCollection, means: Array, covariances: Array) -> None:
    """Show the 3σ ellipses of n positions: means (n, 2) [m], covariances (n, 2, 2)."""
    outline = covariance_ellipses(covariances)
    shown.set(
        offsets=means,
        widths=outline.widths,
        heights=outline.heights,
        angles=np.degrees(outline.angles),  # matplotlib's unit
    )


def _points(marker: str, colour: str, label: str) -> Line2D:
    return Line2D([], [], ls="", marker=marker, ms=4, color=colour, label=label)


def arrow_key(face: str, edge: str, label: str) -> Line2D:
    """Return the legend entry of an arrow-shaped robot."""
    return Line2D([], [], ls="", marker=">", mfc=face, mec=edge, ms=7, label=label)


def ellipse_key(colour: str, label: str, fill: float = 0.14) -> Ellipse:
    """Return the legend entry of an ellipse, to be drawn with `ELLIPSE_HANDLER`."""
    face = to_rgba(colour, fill)
    return Ellipse((0, 0), 1, 1, fc=face, ec=colour, lw=1.2, label=label)


def _lying_ellipse(  # noqa: PLR0917 (matplotlib's signature)
    legend: object,
    orig_handle: object,
    xdescent: float,
    ydescent: float,
    width: float,
    height: float,
    fontsize: float,
) -> Ellipse:
    centre = (width / 2 - xdescent, height / 2 - ydescent)
    return Ellipse(centre, width=width, height=height + ydescent + 2)


ELLIPSE_HANDLER = {Ellipse: HandlerPatch(patch_func=_lying_ellipse)}
