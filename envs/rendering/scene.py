"""The scene of a frame: the world, the robot, its readings and a belief."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from io import BytesIO
from typing import Any, NamedTuple

import numpy as np
from matplotlib import rc_context
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.collections import EllipseCollection, LineCollection
from matplotlib.colors import to_rgb, to_rgba
from matplotlib.figure import Figure
from matplotlib.font_manager import FontProperties, findfont
from matplotlib.legend_handler import HandlerPatch
from matplotlib.lines import Line2D
from matplotlib.patches import Ellipse, Polygon
from matplotlib.text import Text
from matplotlib.transforms import Bbox
from numpy.typing import ArrayLike
from PIL import ImageFont

from ...arrays import Array, BoolArray
from ...sim_configs import Scenario
from ..noise_streams import field_of_view
from .render_state import (
    AxesLimits,
    BeliefLike,
    RenderState,
    covariance_ellipses,
    visible_area,
)

_ARROW = np.array([[1.0, 0.0], [-0.75, 0.7], [-0.35, 0.0], [-0.75, -0.7]])
_ARROW_SHARE = 0.024  # of the width of the axes, so that small robots stay visible


class Scene:
    """The artists of one world on one figure, created once and then moved.

    Parameters
    ----------
    figure : Figure
        Square and empty.
    scenario : Scenario
        Source of walls, robot, sensor and the length of the episode.
    landmarks : ndarray, shape (N, 2)
        True positions [m].
    """

    def __init__(self, figure: Figure, scenario: Scenario, landmarks: Array) -> None:
        self._scenario = scenario
        hiding = scenario.walls if scenario.sensor.occlusion else ()
        self._hiding = np.reshape(hiding, (-1, 2, 2))
        self._field_of_view = field_of_view(scenario.sensor)
        self._figure = figure
        self._axes = add_axes(figure, scenario.name)
        width, height = figure.get_size_inches() * AXES_BOX[2:]
        self._limits = AxesLimits(scenario, landmarks, aspect=width / height)
        self._still = add_still(self._axes, scenario, landmarks)
        self._moving = add_moving(self._axes, scenario.robot.radius)
        self._legend_has_belief = False
        self._show_limits()
        self._show_legend()

    @property
    def moving(self) -> tuple[Artist, ...]:
        """The artists that `show` moves, from back to front."""
        return tuple(self._moving)

    def show(self, state: RenderState) -> bool:
        """Move the artists; return whether the still part has changed."""
        resized = self._limits.follow(state)
        if resized:
            self._show_limits()
        renamed = state.belief is not None and not self._legend_has_belief
        if renamed:
            self._legend_has_belief = True
            self._show_legend()
        self._show_robot(state.pose, state.collision)
        self._moving.path.set_data(*np.transpose(state.path))
        self._show_readings(state.pose, state.measurements, state.clutter)
        self._show_belief(state.belief)
        clock = f"step {state.step}/{self._scenario.steps}   {state.time:.1f} s"
        self._moving.clock.set_text(clock)
        return resized or renamed

    def _show_robot(self, pose: Array, collision: bool) -> None:
        moving, colour = self._moving, ALARM if collision else INK
        moving.arrow.set_xy(arrow_at(pose, self._arrow_length()))
        moving.arrow.set_facecolor(colour)
        moving.body.set_offsets(pose[:2])
        moving.body.set_edgecolor(colour)
        moving.halo.set_offsets(pose[:2])
        moving.halo.set_visible(collision)
        moving.alarm.set_visible(collision)
        diameter = 2.6 * max(self._scenario.robot.radius, self._arrow_length())
        moving.halo.set(widths=[diameter], heights=[diameter])
        moving.view.set_xy(self._area_in_view(pose))

    def _show_readings(
        self, pose: Array, measurements: Array, clutter: BoolArray | None
    ) -> None:
        direction, distance = pose[2] + measurements[:, 0], measurements[:, 1]
        along = np.stack([np.cos(direction), np.sin(direction)], axis=1)
        ends = pose[:2] + distance[:, None] * along
        starts = np.broadcast_to(pose[:2], ends.shape)
        self._moving.rays.set_segments(list(np.stack([starts, ends], axis=1)))
        false = np.zeros(len(ends), dtype=bool) if clutter is None else clutter
        self._moving.readings.set_data(*ends[~false].T)
        self._moving.clutter.set_data(*ends[false].T)

    def _show_belief(self, belief: BeliefLike | None) -> None:
        parts = self._moving
        for each in (parts.map_ellipses, parts.map, parts.pose_ellipse, parts.estimate):
            each.set_visible(belief is not None)
        if belief is None:
            return
        landmarks = np.reshape(belief.landmarks, (-1, 2))
        n = len(landmarks)
        blocks = np.reshape(np.asarray(belief.covariance)[3:, 3:], (n, 2, n, 2))
        spread = np.einsum("iaib->iab", blocks)  # marginal covariance of each landmark
        parts.map.set_data(*landmarks.T)
        set_ellipses(parts.map_ellipses, landmarks, spread)
        parts.estimate.set_xy(arrow_at(belief.pose, self._arrow_length()))
        spread = np.asarray(belief.pose_covariance)[None, :2, :2]
        set_ellipses(parts.pose_ellipse, belief.pose[None, :2], spread)

    def _show_limits(self) -> None:
        self._axes.set(xlim=self._limits.x, ylim=self._limits.y)

    def _show_legend(self) -> None:
        """Draw the legend below the axes."""
        for legend in self._figure.legends[:]:
            legend.remove()
        moving = self._moving
        robot = Line2D([], [], ls="", marker=">", color=INK, ms=7, label="robot")
        keys: list[Artist] = [robot, moving.path, *self._still]
        keys.append(moving.readings)
        if self._scenario.sensor.clutter > 0:
            keys.append(moving.clutter)
        if self._view_is_limited():
            keys.append(moving.view)
        if self._legend_has_belief:
            keys.append(EllipseKind("pose belief, 3σ", POSE, fill=0.14).legend_key())
            keys.append(EllipseKind("landmark belief, 3σ", MAP, fill=0.14).legend_key())
        columns = max(4, -(-len(keys) // 2))  # two rows fit below the axes
        self._figure.legend(
            handles=keys,
            handler_map=ELLIPSE_HANDLER,
            loc="lower center",
            bbox_to_anchor=(0.52, 0.0),
            ncols=columns,
            fontsize=8.5,
            frameon=False,
            columnspacing=1.4 if columns == 4 else 0.8,
            handletextpad=0.5,
        )

    def _arrow_length(self) -> float:
        left, right = self._limits.x
        return max(_ARROW_SHARE * (right - left), 0.8 * self._scenario.robot.radius)

    def _view_is_limited(self) -> bool:
        is_finite = np.isfinite(self._scenario.sensor.max_range)
        return bool(self._field_of_view < 2 * np.pi or is_finite)

    def _area_in_view(self, pose: Array) -> Array:
        """Return the outline of what the sensor sees: a sector or disc, less walls."""
        if not self._view_is_limited():
            return NO_POINT
        (left, right), (low, high) = self._limits.x, self._limits.y
        diagonal = np.hypot(right - left, high - low)
        reach = float(min(self._scenario.sensor.max_range, diagonal))
        return visible_area(pose, self._field_of_view, reach, self._hiding)


# --------------------------------------------------------------------------------------
# The matplotlib artists of a scene, each created once.

INK, GREY, WALL = "#1b1f24", "#8a9199", "#6b5a4e"
RAY, ALARM, POSE, MAP = "#e69f00", "#d55e00", "#0072b2", "#009e73"  # Okabe and Ito
AXES_BOX = (0.105, 0.165, 0.87, 0.775)  # left, bottom, width, height of the figure
_TITLE_HEIGHT = 0.957  # of the figure
NO_POINT = np.full((1, 2), np.nan)
_PLAIN: dict[Any, Any] = {"text.usetex": False}


class PlainTextFigure(Figure):
    """A figure that never needs LaTeX, even where matplotlibrc sets text.usetex."""

    @contextmanager
    def plain(self) -> Iterator[None]:
        """Make no text by LaTeX during the block, where text is drawn or measured."""
        for text in self.findobj(Text):
            text.set_usetex(False)
        with rc_context(_PLAIN):  # for the labels that matplotlib makes meanwhile
            yield

    def draw(self, renderer: Any) -> None:
        """Draw the figure."""
        with self.plain():
            super().draw(renderer)

    def savefig(self, *args: Any, **kwargs: Any) -> None:
        """Write the figure to a file."""
        with self.plain():
            super().savefig(*args, **kwargs)

    def _repr_png_(self) -> bytes:
        """Return the picture that a notebook shows."""
        picture = BytesIO()
        self.savefig(picture, format="png")
        return picture.getvalue()


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
    walls = wall_lines(scenario.walls, 2.5)
    axes.add_collection(walls)
    return [crosses, walls]


def add_moving(axes: Axes, radius: float) -> MovingArtists:
    """Create the moving artists without data; `radius` is that of the robot [m]."""

    def ellipses(colour: str, fill: float) -> EllipseCollection:
        twice = [True, True]  # a single ellipse is not measured first, slowly
        return EllipseKind("", colour, fill=fill).empty(axes, antialiaseds=twice)

    moving = MovingArtists(
        view=Polygon(
            NO_POINT, fc=to_rgba(RAY, 0.07), ec=RAY, lw=0.6, label="field of view"
        ),
        rays=LineCollection([], colors=RAY, linewidths=0.9, alpha=0.6),
        readings=_points("o", RAY, "reading"),
        clutter=_points("x", ALARM, "clutter"),
        path=Line2D([], [], color=INK, linewidth=1.4, alpha=0.8, label="true path"),
        map_ellipses=ellipses(MAP, 0.13),
        map=_points(".", MAP, ""),
        pose_ellipse=ellipses(POSE, 0.15),
        body=ellipses(INK, 0.12),
        halo=ellipses(ALARM, 0.2),
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


class EllipseKind(NamedTuple):
    """The style of one kind of ellipses in the picture and in the legend."""

    label: str
    colour: str
    line: str | tuple[float, tuple[float, ...]] = "-"
    fill: float = 0.0
    width: float = 1.2
    alpha: float = 1.0

    def empty(self, axes: Axes, scale: float = 1.0, **style: Any) -> EllipseCollection:
        """Return an empty collection in data coordinates of axes, not added to them."""
        return EllipseCollection(
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
            **style,
        )

    def add_to(self, axes: Axes, scale: float = 1.0) -> EllipseCollection:
        """Add an empty collection."""
        shown = self.empty(axes, scale)
        axes.add_collection(shown, autolim=False)
        return shown

    def draw(self, axes: Axes, means: Array, covariances: Array) -> None:
        """Add 3σ ellipses: means (n, 2) [m], covariances (n, 2, 2)."""
        set_ellipses(self.add_to(axes), means, covariances)

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


def arrow_at(pose: Array, size: float) -> Array:
    """Return the outline of an arrow-shaped robot, shape (4, 2) [m]."""
    cos, sin = np.cos(pose[2]), np.sin(pose[2])
    turn = np.array([[cos, sin], [-sin, cos]])
    return np.asarray(pose[:2] + size * _ARROW @ turn)


def wall_lines(walls: ArrayLike, width: float, **style: Any) -> LineCollection:
    """Return the lines of walls, rows (x0, y0, x1, y1) [m]."""
    return LineCollection(
        list(np.reshape(walls, (-1, 2, 2))),
        colors=WALL,
        linewidths=width,
        capstyle="round",
        label="wall",
        **style,
    )


def _points(marker: str, colour: str, label: str) -> Line2D:
    return Line2D([], [], ls="", marker=marker, ms=4, color=colour, label=label)


def _lying_ellipse(
    *, xdescent: float, ydescent: float, width: float, height: float, **_: object
) -> Ellipse:
    centre = (width / 2 - xdescent, height / 2 - ydescent)
    return Ellipse(centre, width=width, height=height + ydescent + 2)


ELLIPSE_HANDLER = {Ellipse: HandlerPatch(patch_func=_lying_ellipse)}


_POINTS = 11.0


class Clock(Artist):
    """Right-aligned text in matplotlib's font.

    Matplotlib lays text out anew in every frame, which takes half of the time of a
    frame. Here FreeType draws the line at once, through Pillow.

    Parameters
    ----------
    right, baseline : float
        End of the text, and its baseline, as parts of the figure.
    colour : str
        Colour of the text.
    """

    def __init__(self, right: float, baseline: float, colour: str) -> None:
        super().__init__()
        self._place = right, baseline
        self._colour = np.multiply(to_rgb(colour), 255).round().astype(np.uint8)
        self._fonts: dict[float, Any] = {}
        self._text = ""

    def set_text(self, text: str) -> None:
        """Show another text."""
        self._text = text
        self.stale = True

    def get_text(self) -> str:
        """Return the text."""
        return self._text

    def get_window_extent(self, renderer: Any = None) -> Bbox:
        """Return the box of the text [pixels]."""
        left, top, right, bottom = self._font().getbbox(self._text, anchor="ls")
        x, y = np.multiply(self._place, self._figure().bbox.size).round()
        return Bbox([[x - right + left, y - bottom], [x, y - top]])

    def draw(self, renderer: Any) -> None:
        """Draw the text as an image."""
        if not self.get_visible() or not self._text:
            return
        mask = self._font().getmask(self._text, anchor="ls")
        image = np.empty((mask.size[1], mask.size[0], 4), dtype=np.uint8)
        image[..., :3] = self._colour
        image[..., 3] = np.asarray(mask, dtype=np.uint8).reshape(image.shape[:2])
        context = renderer.new_gc()
        renderer.draw_image(context, *self.get_window_extent().min, image[::-1])
        context.restore()

    def _figure(self) -> Any:
        return self.get_figure()

    def _font(self) -> Any:
        """Return the font for the resolution of the figure."""
        pixels = _POINTS * self._figure().dpi / 72
        if pixels not in self._fonts:
            path = findfont(FontProperties())
            self._fonts = {pixels: ImageFont.truetype(path, pixels)}
        return self._fonts[pixels]
