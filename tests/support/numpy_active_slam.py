"""Active SLAM once more, in numpy: the slow twin of the compiled pass."""

from typing import NamedTuple

import numpy as np
from numpy_belief_features import belief_features, marginals_of

from slamgym.agents.information_reward import effort, landmark_prior_std, uncertainty
from slamgym.agents.wall_routes import SECTORS, CoverageGrid
from slamgym.envs.bearing_range import BearingRangeSensor

DIRECTIONS = np.exp(2j * np.pi * np.arange(SECTORS) / SECTORS)
TIE = 1e-9  # distances [m] and variances [m²] no farther apart count as equal


class Progress(NamedTuple):
    """How far the episodes of B worlds are."""

    beliefs: object
    explored: np.ndarray
    steps: np.ndarray
    uncertainty: np.ndarray
    variances: np.ndarray
    known: np.ndarray


class SlowTask:
    """Observations, rewards and ends of `ActiveSlamTask`, one definition at a time."""

    def __init__(self, scenario, weights):
        self.scenario, self.weights = scenario, weights
        self.grid = CoverageGrid(scenario)
        self.prior_std = landmark_prior_std(scenario)

    def begin(self, beliefs):
        steps = np.zeros(len(beliefs.means), dtype=np.int64)
        seen = visible_cells(self.scenario, self.grid.cells, beliefs.poses)
        return self.progress(beliefs, seen, steps)

    def proceed(self, before, beliefs):
        seen = visible_cells(self.scenario, self.grid.cells, beliefs.poses)
        return self.progress(beliefs, before.explored | seen, before.steps + 1)

    def progress(self, beliefs, explored, steps):
        variances = np.linalg.eigvalsh(beliefs.landmark_covariances)[..., -1]
        known = beliefs.mapped & (variances <= self.weights.accuracy**2)
        measure = uncertainty(beliefs, self.weights.criterion, self.prior_std)
        return Progress(beliefs, explored, steps, measure, variances, known)

    def reward(self, before, after, actions, collisions):
        """Return rewards, terminated, truncated and success."""
        weights, robot = self.weights, self.scenario.robot
        left = 1.0 - after.steps / self.scenario.steps
        success = after.known.all(axis=1) & ~collisions
        limits = robot.max_speed, robot.max_turn_rate
        rewards = before.uncertainty - after.uncertainty - weights.step_cost
        rewards -= weights.effort_cost * effort(actions, limits)
        rewards -= weights.crash_cost * collisions
        rewards += weights.success_reward * (1.0 + left) * success
        terminated = success | collisions
        truncated = ~terminated & (after.steps >= self.scenario.steps)
        return rewards, terminated, truncated, success

    def observe(self, progress):
        beliefs, cells, known = progress.beliefs, self.grid.cells, progress.known
        belief = belief_features(marginals_of(beliefs), self.grid.bounds)
        position = beliefs.poses[:, :1] + 1j * beliefs.poses[:, 1:2]
        places = as_complex(beliefs.landmarks)
        unknown = beliefs.mapped & ~known
        left = 1.0 - np.minimum(progress.steps / self.scenario.steps, 1.0)
        shares = [mask.mean(axis=1) for mask in (progress.explored, beliefs.mapped)]
        costs = [
            np.where(progress.explored, np.inf, np.abs(cells - position)),
            np.where(unknown, np.abs(places - position), np.inf),
            np.where(beliefs.mapped, progress.variances, np.inf),
        ]
        goals = [
            self.direction_to_cheapest(beliefs.poses, points, cost)
            for points, cost in zip((cells, places, places), costs, strict=True)
        ]
        walls = wall_distances(self.scenario.walls, self.grid.diagonal, beliefs.poses)
        longest = self.scenario.robot.max_speed * self.scenario.dt
        return {
            **{key: rows.reshape(len(rows), -1) for key, rows in belief.items()},
            "goals": np.concatenate(goals, axis=1),
            "progress": np.stack([*shares, known.mean(axis=1), left], axis=1),
            "uncertain": self.densities(beliefs.poses, places, unknown, 1.0),
            "unexplored": self.densities(beliefs.poses, cells, ~progress.explored, 8.0),
            "walls": walls / (walls + longest),
        }

    def direction_to_cheapest(self, poses, points, costs):
        """Return cosine, sine and distance of the first point of least cost, (B, 3)."""
        position, inverse_heading = complex_poses(poses)
        world = np.arange(len(poses))
        least = costs.min(axis=1, keepdims=True)
        cheapest = np.argmax(costs <= least + TIE, axis=1)
        target = np.broadcast_to(points, costs.shape)[world, cheapest]
        relative = (target - position[:, 0]) * inverse_heading[:, 0]
        distance = np.abs(relative)
        unit = relative / np.maximum(distance, 1e-9)
        far = np.minimum(distance / self.grid.diagonal, 1.0)
        there = np.isfinite(costs[world, cheapest])
        direction = np.stack([unit.real, unit.imag, far], axis=1)
        return np.clip(direction * there[:, None], -1.0, 1.0)

    def densities(self, poses, points, weights, unit):
        """Scale near and far sums s to s / (s + unit) in [0, 1), (B, 16)."""
        reaches = 0.1 * self.grid.diagonal, 0.4 * self.grid.diagonal
        sums = [sector_sums(poses, points, weights, reach) for reach in reaches]
        near_and_far = np.concatenate(sums, axis=1)
        return near_and_far / (near_and_far + unit)


def visible_cells(scenario, cells, poses):
    """Return which cells the world's own sensor would see from poses, (B, C)."""
    longer = np.ones((len(poses), 2 * len(cells))), np.empty((1, 0)), None, None
    sensor = BearingRangeSensor(scenario.with_changes(sensor={"min_range": 0.0}))
    frame = np.array([*poses.T, np.cos(poses[:, 2]), np.sin(poses[:, 2])])
    return sensor.scan(np.tile(cells, (len(poses), 1)), frame, longer)[1]


def sector_sums(poses, points, weights, reach):
    """Compute Σ w e^{-|δ| / reach} max(0, cos(arg δ - φ))² / 2 in 8 directions φ."""
    position, inverse_heading = complex_poses(poses)
    relative = (points - position) * inverse_heading
    distance = np.abs(relative)
    unit = relative / np.maximum(distance, 1e-9)
    share = weights * np.exp(-distance / reach)
    lobes = [np.maximum((unit * np.conj(way)).real, 0.0) ** 2 for way in DIRECTIONS]
    return 0.5 * np.stack([np.sum(share * lobe, axis=-1) for lobe in lobes], axis=-1)


def wall_distances(walls, diagonal, poses):
    """Return the distance to the wall in 8 directions, at most the diagonal, (B, 8)."""
    position, inverse_heading = complex_poses(poses)
    ends = np.reshape(walls, (-1, 2, 2)) @ [1.0, 1j]
    ray = np.conj(inverse_heading) * DIRECTIONS  # (B, 8)
    start, along = ends[:, 0] - position, ends[:, 1] - ends[:, 0]
    across = cross(ray[:, :, None], along)  # (B, 8, W)
    parallel = np.abs(across) < 1e-12
    safe = np.where(parallel, 1.0, across)
    distance = cross(start, along)[:, None] / safe
    share = cross(start[:, None], ray[:, :, None]) / safe
    hits = ~parallel & (distance >= 0) & (share >= -1e-9) & (share <= 1 + 1e-9)
    return np.minimum(np.where(hits, distance, diagonal).min(axis=2), diagonal)


def complex_poses(poses):
    """Return x + iy and cos θ - i sin θ, each of shape (B, 1)."""
    heading = poses[:, 2:3]
    return poses[:, 0:1] + 1j * poses[:, 1:2], np.cos(heading) - 1j * np.sin(heading)


def as_complex(points):
    return points[..., 0] + 1j * points[..., 1]


def cross(u, v):
    return u.real * v.imag - u.imag * v.real
