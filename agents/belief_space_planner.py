"""Planning in belief space: imagine many plans, and take the first step of the best.

The value of a plan, in the units of the task's reward, is what it is expected to gain:

* the decrease of ½ log det of the map's covariance, per landmark;
* for every landmark that the robot is expected to find, this decrease for the
  landmark alone: its uncertainty is then that of the pose and of the reading;
* a bonus for every landmark that becomes known.

The first and the last are means over a quarter, a half and the whole of the plan, so
that gaining early is worth more.

A missing landmark is equally likely in any unseen cell, and less so in cells seen.

A horizon of a few steps does not reach what is far away. Attractors [1]_ therefore
stand for it: a plan also gains by ending near a goal that it leaves for later.

References
----------
.. [1] C. Leung, S. Huang, G. Dissanayake, Active SLAM using model predictive control
   and attractor based exploration, IROS 2006.
"""

import math
from functools import cache
from typing import Any, NamedTuple

import numpy as np

from ..arrays import Array, BoolArray, IndexArray
from ..envs.robot import wrap_angle
from ..estimator.filters.imagine import imagine
from ..estimator.kernels.imagine import Imagined
from ..jit import jit, njit_internal
from ..sim_configs import Robot
from .belief_features import largest_variances
from .wall_routes import AgentKnowledge, as_points

_CLEARANCE = 0.5  # of arcs, distance kept from walls beyond the robot's radius [m]
_ALIGNED = 0.5  # heading error below which a robot drives while it turns [rad]
_wrap_angle_jit = njit_internal(wrap_angle)
_TURNS = (-1.0, -0.5, -0.2, 0.0, 0.2, 0.5, 1.0)  # of the largest turn rate


class PlannerSettings(NamedTuple):
    """What a planner considers, and how it values plans."""

    horizon: int  # steps of a plan
    straight: tuple[int, ...]  # steps that a robot drives straight on after a turn
    goals: int  # unseen cells to drive to, at most; 0 leaves arcs alone
    known_bonus: float  # for every landmark that becomes known
    discount: float  # of landmarks found a step later
    overlooked: float  # probability that a landmark in a cell in view is not seen
    # For the rest of the tour chosen before, so that the robot does not dither.
    persistence: float
    attraction: float  # per metre nearer to a goal that is left for later


MPC = PlannerSettings(
    horizon=40,
    straight=(40,),
    goals=6,
    known_bonus=3.0,
    discount=0.9,
    overlooked=0.3,
    persistence=0.3,
    attraction=0.06,
)
# Looks ahead along motions that turn and then drive straight on.
GREEDY = MPC._replace(horizon=20, straight=(2, 5, 10), goals=0)


class BeliefSpacePlanner:
    """Takes the first step of the plan with the largest expected gain.

    The plans turn and then drive straight on, and with goals also drive to one goal
    and then to another: unseen cells, mapped landmarks not yet known, and the
    landmark known best.

    Parameters
    ----------
    settings : PlannerSettings
        `GREEDY` or `MPC`.
    """

    def __init__(self, settings: PlannerSettings) -> None:
        self._settings = settings
        self._tour: Array | None = None
        self._chance: Array = np.empty(0)

    def act(self, knowledge: AgentKnowledge) -> Array:
        """Choose (v, ω) [m/s, rad/s]; see `Baseline.act`."""
        settings = self._settings
        self._look(knowledge)
        plans = _arcs(knowledge.scenario.robot, knowledge.scenario.dt, settings)
        arcs, tours = len(plans), np.empty((0, 2, 2))
        if settings.goals:
            tours = _tours(knowledge, self._chance, settings.goals)
        rest = _rest(knowledge, self._tour)
        tours = np.concatenate([tours, rest])
        plans = np.concatenate([plans, _driven(knowledge, tours, settings.horizon)])
        values = plan_values(knowledge, plans, self._chance, settings)
        values[-1] += settings.persistence * len(rest)
        best = int(np.argmax(values))
        self._tour = tours[best - arcs] if best >= arcs else None
        return np.asarray(plans[best, 0] / knowledge.scenario.dt)

    def _look(self, knowledge: AgentKnowledge) -> None:
        """Lower the chance of a missing landmark in the cells in view."""
        explored, overlooked = knowledge.explored, self._settings.overlooked
        if knowledge.step == 0 or len(self._chance) != len(explored):
            self._tour, self._chance = None, np.where(explored, overlooked, 1.0)
            self._chance *= knowledge.grid.routes.reachable
            return
        seen = knowledge.grid.visible_from(knowledge.belief.pose[None])[0]
        self._chance[seen] *= overlooked


def _rest(knowledge: AgentKnowledge, tour: Array | None) -> Array:
    """Return what is left of a tour, (1, 2, 2) [m], or nothing, (0, 2, 2)."""
    if tour is None:
        return np.empty((0, 2, 2))
    longest = knowledge.scenario.robot.max_speed * knowledge.scenario.dt
    near = np.hypot(*(tour - knowledge.belief.pose[:2]).T) < 0.5 * longest
    if not near[0]:
        return tour[None]
    return tour[None, [1, 1]] if not near[1] else np.empty((0, 2, 2))


def plan_values(
    knowledge: AgentKnowledge, plans: Array, chance: Array, settings: PlannerSettings
) -> Array:
    """Return the expected gain of plans (K, T, 2), (K,); -inf where one hits a wall.

    Parameters
    ----------
    chance : ndarray, shape (C,)
        How likely a missing landmark is in a cell, up to a factor.
    """
    scenario, size = knowledge.scenario, len(knowledge.known)
    slam: Any = knowledge.estimator
    points = as_points(knowledge.grid.cells)
    total = chance.sum()  # 0 where no landmark can be missing
    counts = knowledge.missing * chance / (total if total > 0 else 1.0)
    kept = counts > 0.02 * counts.max() if knowledge.missing else counts > 0
    now = np.linalg.slogdet(knowledge.belief.covariance[3:, 3:])[1]
    steps = plans.shape[1]
    after = imagine(
        slam,
        plans,
        scenario.sensor,
        walls=scenario.walls,
        density=(points[kept], counts[kept]),
        horizons=(steps // 4, steps // 2, steps),
    )
    known = after.worst_variances[0] <= knowledge.accuracy**2
    values: Array = ((now - after.log_det[0]) / (6.0 * size)).sum(axis=1)
    values += settings.known_bonus * known.sum(axis=(1, 2)) / 3.0
    found = np.diff(after.new_landmarks[0], axis=1, prepend=0.0)
    values += (_worth(knowledge, after, settings) * found) @ (
        settings.discount ** np.arange(steps)
    )
    values -= settings.attraction * _distance_to_rest(knowledge, after, known[:, -1])
    values[~_is_free(knowledge, after.poses[0])] = -math.inf
    return values


def _worth(
    knowledge: AgentKnowledge, after: Imagined, settings: PlannerSettings
) -> Array:
    """Return the value of a landmark found at each step of plans, (K, T).

    Its uncertainty is that of the pose it is seen from, and of the reading.
    """
    sensor, P = knowledge.scenario.sensor, after.pose_covariances[0]
    distance = 0.6 * min(sensor.max_range, knowledge.grid.diagonal)
    variance = largest_variances(P[..., :2, :2]) + sensor.std[1] ** 2
    std = np.sqrt(variance + distance**2 * (P[..., 2, 2] + sensor.std[0] ** 2))
    size = len(knowledge.known)
    gain = sum(np.log(prior / std) for prior in knowledge.prior_std) / size
    certain = 1.0 / (1.0 + (std / knowledge.accuracy) ** 8)
    return np.asarray(gain + settings.known_bonus * certain)


def _distance_to_rest(
    knowledge: AgentKnowledge, after: Imagined, known: BoolArray
) -> Array:
    """Return the distance from the end of plans to the nearest goal left, (K,) [m]."""
    ends = after.poses[0, :, -1, :2]
    landmarks = knowledge.belief.landmarks
    away = np.hypot(*(landmarks - ends[:, None]).transpose(2, 0, 1))
    away[known] = math.inf
    if knowledge.missing:
        unseen = ~knowledge.explored
        found = knowledge.grid.visible_from(after.poses[0], unseen)
        cells = knowledge.grid.routes.to_cells(ends)[:, unseen]
        away = np.concatenate([away, np.where(found, math.inf, cells)], axis=1)
    nearest = away.min(axis=1, initial=math.inf)
    return np.where(np.isfinite(nearest), nearest, 0.0)


def _is_free(knowledge: AgentKnowledge, poses: Array) -> BoolArray:
    """Return which plans keep clear of walls, or turn on the spot."""
    clearance = knowledge.scenario.robot.radius + _CLEARANCE
    places = poses[..., :2]
    between = 0.5 * (places[:, 1:] + places[:, :-1])  # a wall may be that thin
    gap = knowledge.grid.clearance(np.concatenate([places, between], axis=1))
    here = knowledge.grid.clearance(knowledge.belief.pose[None, :2])[0]
    return np.asarray((gap >= min(clearance, here - 1e-9)).all(axis=1))


@cache
def _arcs(robot: Robot, dt: float, settings: PlannerSettings) -> Array:
    """Return plans that turn, drive straight on, and turn on the spot, (K, T, 2)."""
    longest, turning = robot.max_speed * dt, robot.max_turn_rate * dt
    plans = []
    for drive, steps in ((1.0, 1), (1.0, 4), (0.0, 3), (0.0, settings.horizon)):
        for straight in settings.straight if steps < settings.horizon else (0,):
            for turn in _TURNS:
                plan = np.tile((0.0, turning), (settings.horizon, 1))
                plan[: steps + straight] = longest, 0.0
                plan[:steps] = drive * longest, turn * turning
                plans.append(plan)
    return np.array(plans)


def _tours(knowledge: AgentKnowledge, chance: Array, cells: int) -> Array:
    """Return pairs of goals to drive to one after the other, (K, 2, 2) [m]."""
    belief, grid = knowledge.belief, knowledge.grid
    position = belief.pose[:2]
    unknown = belief.landmarks[~knowledge.known_in_map]
    first, second = [unknown], [position[None]]
    if belief.landmark_ids:
        blocks = belief.covariance[3:, 3:].diagonal().reshape(-1, 2).sum(axis=1)
        best = belief.landmarks[[int(np.argmin(blocks))]]
        first.append(best)
        second.append(best)
    if len(unknown):
        second.append(unknown[[int(_distances(unknown, position).argmin())]])
    if knowledge.missing:
        unseen = as_points(grid.cells[chance >= chance.max()])
        spread = unseen[_spread_out(unseen, position, cells)]
        first.append(spread)
        second.append(spread[:1])
    starts, ends = np.concatenate(first), np.concatenate(second)
    pairs = np.empty((len(starts), len(ends), 2, 2))
    pairs[:, :, 0], pairs[:, :, 1] = starts[:, None], ends
    return grid.routes.kept_clear(pairs.reshape(-1, 2)).reshape(-1, 2, 2)


def _spread_out(points: Array, position: Array, most: int) -> IndexArray:
    """Return the nearest of points, then those farthest from all chosen before."""
    if not len(points):
        return np.empty(0, dtype=np.intp)
    chosen = [int(_distances(points, position).argmin())]
    gap = _distances(points, points[chosen[0]])
    while len(chosen) < min(most, len(points)):
        chosen.append(int(gap.argmax()))
        gap = np.minimum(gap, _distances(points, points[chosen[-1]]))
    return np.array(chosen)


def _driven(knowledge: AgentKnowledge, tours: Array, steps: int) -> Array:
    """Return plans that drive to the goals of tours (K, 2, 2), (K, T, 2).

    The plans lead around inner walls.
    """
    pose, scenario = knowledge.belief.pose, knowledge.scenario
    robot, dt = scenario.robot, scenario.dt
    longest, turning = robot.max_speed * dt, robot.max_turn_rate * dt
    routes = np.ascontiguousarray(knowledge.grid.routes.tours(pose[:2], tours))
    plans = np.empty((len(tours), steps, 2))
    drive_routes(pose.copy(), routes, longest, turning, plans)
    return plans


@jit
def drive_routes(
    pose: Array, routes: Array, longest: float, turning: float, plans: Array
) -> None:
    """Fill plans (K, T, 2) that drive from a pose along routes (K, L, 2) of points.

    A robot at its last point turns on the spot and looks around.
    """
    for k in range(len(routes)):
        x, y, heading = pose[0], pose[1], pose[2]
        leg = 0
        for t in range(plans.shape[1]):
            goal = routes[k, min(leg, routes.shape[1] - 1)]
            dx, dy = goal[0] - x, goal[1] - y
            distance, drive, turn = math.hypot(dx, dy), 0.0, turning
            if distance < 0.5 * longest:
                leg += 1
            else:
                error = _wrap_angle_jit(math.atan2(dy, dx) - heading)
                turn = min(max(error, -turning), turning)
                drive = min(distance, longest) if abs(error) < _ALIGNED else 0.0
            plans[k, t, 0], plans[k, t, 1] = drive, turn
            x, y = x + drive * math.cos(heading), y + drive * math.sin(heading)
            heading += turn


def _distances(points: Array, position: Array) -> Array:
    return np.asarray(np.hypot(*(points - position).T))
