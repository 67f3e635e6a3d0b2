"""The scene of a frame: the world, the robot, its readings and a belief."""

import numpy as np
from matplotlib.artist import Artist
from matplotlib.figure import Figure

from ...arrays import Array, BoolArray
from ...sim_configs import Scenario
from .artists import (
    ALARM,
    AXES_BOX,
    ELLIPSE_HANDLER,
    INK,
    MAP,
    NO_POINT,
    POSE,
    add_axes,
    add_moving,
    add_still,
    arrow_key,
    ellipse_key,
    set_ellipses,
)
from .axes_limits import AxesLimits
from .render_state import BeliefLike, RenderState
from .visible_area import visible_area

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
        self._show_clock(state)
        return resized or renamed

    def _show_robot(self, pose: Array, collision: bool) -> None:
        moving, colour = self._moving, ALARM if collision else INK
        moving.arrow.set_xy(self._arrow_at(pose))
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
        moving = self._moving
        for artist in (
            moving.map_ellipses,
            moving.map,
            moving.pose_ellipse,
            moving.estimate,
        ):
            artist.set_visible(belief is not None)
        if belief is None:
            return
        landmarks = np.reshape(belief.landmarks, (-1, 2))
        n = len(landmarks)
        blocks = np.reshape(np.asarray(belief.covariance)[3:, 3:], (n, 2, n, 2))
        spread = np.einsum("iaib->iab", blocks)  # marginal covariance of each landmark
        moving.map.set_data(*landmarks.T)
        set_ellipses(moving.map_ellipses, landmarks, spread)
        moving.estimate.set_xy(self._arrow_at(belief.pose))
        spread = np.asarray(belief.pose_covariance)[None, :2, :2]
        set_ellipses(moving.pose_ellipse, belief.pose[None, :2], spread)

    def _show_clock(self, state: RenderState) -> None:
        """Show step and time."""
        self._moving.clock.set_text(
            f"step {state.step}/{self._scenario.steps}   {state.time:.1f} s"
        )

    def _show_limits(self) -> None:
        self._axes.set(xlim=self._limits.x, ylim=self._limits.y)

    def _show_legend(self) -> None:
        """Draw the legend below the axes."""
        for legend in self._figure.legends[:]:
            legend.remove()
        moving = self._moving
        named: list[Artist] = [arrow_key(INK, INK, "robot"), moving.path, *self._still]
        named.append(moving.readings)
        if self._scenario.sensor.clutter > 0:
            named.append(moving.clutter)
        if self._view_is_limited():
            named.append(moving.view)
        if self._legend_has_belief:
            named.append(ellipse_key(POSE, "pose belief, 3σ"))
            named.append(ellipse_key(MAP, "landmark belief, 3σ"))
        self._figure.legend(
            handles=named,
            handler_map=ELLIPSE_HANDLER,
            loc="lower center",
            bbox_to_anchor=(0.52, 0.0),
            ncols=4,
            fontsize=8.5,
            frameon=False,
            columnspacing=1.4,
            handletextpad=0.5,
        )

    def _arrow_length(self) -> float:
        left, right = self._limits.x
        return max(_ARROW_SHARE * (right - left), 0.8 * self._scenario.robot.radius)

    def _arrow_at(self, pose: Array) -> Array:
        cos, sin = np.cos(pose[2]), np.sin(pose[2])
        shape = self._arrow_length() * _ARROW @ np.array([[cos, sin], [-sin, cos]])
        return np.asarray(pose[:2] + shape)

    def _view_is_limited(self) -> bool:
        sensor = self._scenario.sensor
        return bool(sensor.field_of_view < 2 * np.pi or np.isfinite(sensor.max_range))

    def _area_in_view(self, pose: Array) -> Array:
        """Return the outline of what the sensor sees: a sector or disc, less walls."""
        if not self._view_is_limited():
            return NO_POINT
        sensor = self._scenario.sensor
        (left, right), (low, high) = self._limits.x, self._limits.y
        reach = float(min(sensor.max_range, np.hypot(right - left, high - low)))
        return visible_area(pose, sensor.field_of_view, reach, self._hiding)
