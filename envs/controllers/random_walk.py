"""A correlated random walk: speed and turn rate change slowly and at random."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Self

import numpy as np
from numpy.typing import ArrayLike

from ...arrays import Array
from ...sim_configs import Robot, Scenario
from ..angles import wrap_angle
from .interface import each, finite_pose, finite_poses, positive
from .planned_path import planned_path

_BLOCK = 128  # steps of noise drawn ahead


class RandomWalk:
    """Drives with a speed and a turn rate that drift slowly.

    Both follow an Ornstein-Uhlenbeck process s, sampled exactly at the steps::

        s' = ρ s + √(1 - ρ²) n,    ρ = exp(-dt / correlation_time),  n ~ N(0, 1)
        v = max_speed (1/2 + s_v / 4),      clipped to [0, max_speed]
        ω = max_turn_rate (s_ω / 3 + e),    clipped to ± max_turn_rate

    with e = 0 within `reach` of `home`, else the angle from the heading to `home`.

    Parameters
    ----------
    rng : numpy.random.Generator
        Source of the random numbers.
    robot : Robot
        Source of the limits.
    dt : float
        Duration of one step [s].
    correlation_time : float, optional
        Time constant of the process [s].
    home : (float, float), optional
        Position to which the robot turns when it is too far away (x, y) [m].
    reach : float, optional
        Distance from `home` beyond which it turns [m]; by default infinite.

    Examples
    --------
    >>> controller = RandomWalk(np.random.default_rng(1), Robot(), dt=0.1)
    >>> controller.act((0.0, 0.0, 0.0), step=0).round(3).tolist()
    [0.586, 0.274]
    """

    def __init__(
        self,
        rng: np.random.Generator,
        robot: Robot,
        *,
        dt: float,
        correlation_time: float = 5.0,
        home: tuple[float, float] = (0.0, 0.0),
        reach: float = math.inf,
    ) -> None:
        self._rng = rng
        self.robot = robot
        self.correlation = math.exp(
            -positive(dt, "dt") / positive(correlation_time, "correlation_time")
        )
        self.home = home
        self.reach = reach
        self._state = np.zeros(2)

    @classmethod
    def for_scenario(cls, scenario: Scenario, rng: np.random.Generator) -> Self:
        """Make a random walk within the circle around a scenario's planned path."""
        positions = planned_path(scenario)[:, :2]
        low, high = positions.min(axis=0), positions.max(axis=0)
        x, y = (low + high) / 2
        reach = max(math.dist(low, high) / 2, scenario.robot.radius)
        home = float(x), float(y)
        return cls(rng, scenario.robot, dt=scenario.dt, home=home, reach=reach)

    def act(self, pose: ArrayLike, step: int) -> Array:
        """Continue the walk; see `Controller.act`."""
        correlation = self.correlation if step > 0 else 0.0
        noise = math.sqrt(1 - correlation**2) * self._rng.standard_normal(2)
        self._state = correlation * self._state + noise
        speed = 0.5 + self._state[0] / 4
        turn = self._state[1] / 3 + self._angle_to_home(*finite_pose(pose))
        return np.array(
            [
                self.robot.max_speed * np.clip(speed, 0.0, 1.0),
                self.robot.max_turn_rate * np.clip(turn, -1.0, 1.0),
            ]
        )

    def _angle_to_home(self, x: float, y: float, heading: float) -> float:
        dx, dy = self.home[0] - x, self.home[1] - y
        if math.hypot(dx, dy) <= self.reach:
            return 0.0
        return wrap_angle(math.atan2(dy, dx) - heading)


class VectorRandomWalk:
    """Drives every robot on its own random walk; the vector form of `RandomWalk`.

    Parameters
    ----------
    controllers : sequence of RandomWalk, length B
        Source of the limits, correlations and homes; their generators are not used.
    generators : sequence of numpy.random.Generator, length B
        Source of the random numbers of each robot. The walk draws ahead from them.
    """

    def __init__(
        self,
        controllers: Sequence[RandomWalk],
        generators: Sequence[np.random.Generator],
    ) -> None:
        self._generators = generators
        self._limits = np.array(
            [(one.robot.max_speed, one.robot.max_turn_rate) for one in controllers]
        )
        self._correlation = np.array([[one.correlation] for one in controllers])
        self._noise_std = np.array(
            [[math.sqrt(1 - one.correlation**2)] for one in controllers]
        )
        self._homes = np.array([one.home for one in controllers])
        self._reach = np.array([one.reach for one in controllers])
        self._state = np.zeros((len(controllers), 2))
        self._noise: list[Array] = []  # (B, 2) of the steps to come, the next one last

    def act(self, poses: ArrayLike, step: int) -> Array:
        """Continue the walks; see `VectorController.act`."""
        array = finite_poses(poses, len(self._state))
        if step > 0:
            noise = self._noise_std * self._next_noise()
            self._state = self._correlation * self._state + noise
        else:
            self._state = 0.0 * self._state + self._next_noise()
        speed = np.clip(0.5 + self._state[:, 0] / 4, 0.0, 1.0)
        turn = np.clip(self._state[:, 1] / 3 + self._angles_to_home(array), -1.0, 1.0)
        return self._limits * np.column_stack([speed, turn])

    def _next_noise(self) -> Array:
        if not self._noise:
            drawn = [rng.standard_normal((_BLOCK, 2)) for rng in self._generators]
            self._noise = list(np.stack(drawn, axis=1))[::-1]
        return self._noise.pop()

    def _angles_to_home(self, poses: Array) -> Array:
        """Return the angles from the headings to the homes, 0 within reach of them."""
        dx, dy = (self._homes - poses[:, :2]).T
        angles = wrap_angle(each(math.atan2, dy, dx) - poses[:, 2])
        angles[each(math.hypot, dx, dy) <= self._reach] = 0.0
        return angles
