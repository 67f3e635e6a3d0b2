"""Open-loop control: a sequence of actions, whatever the pose."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Self

import numpy as np
from numpy.typing import ArrayLike

from ...arrays import Array
from ...sim_configs import Robot, Scenario, action_sequence
from .interface import finite_poses, finite_rows


class OpenLoop:
    """Repeats a sequence of actions.

    Parameters
    ----------
    actions : array_like, shape (K, 2)
        Rows (v, ω) [m/s, rad/s], for example from `action_sequence`.
    robot : Robot
        Source of the limits; faster actions are clipped.

    Examples
    --------
    >>> from slamgym.sim_configs import load_scenario
    >>> scenario = load_scenario("loop")
    >>> controller = OpenLoop(action_sequence(scenario), scenario.robot)
    >>> controller.act((0.0, 0.0, 0.0), step=0).tolist()
    [0.25, 0.025]
    """

    def __init__(self, actions: ArrayLike, robot: Robot) -> None:
        limits = np.array([robot.max_speed, robot.max_turn_rate])
        self.actions = np.clip(finite_rows(actions, "actions"), -limits, limits)

    @classmethod
    def for_scenario(cls, scenario: Scenario) -> Self:
        """Make the controller that executes a scenario's controls."""
        return cls(action_sequence(scenario), scenario.robot)

    def act(self, pose: ArrayLike, step: int) -> Array:
        """Return the action of this step; see `Controller.act`."""
        return np.array(self.actions[step % len(self.actions)])


class VectorOpenLoop:
    """Repeats one sequence of actions per robot; the vector form of `OpenLoop`.

    Parameters
    ----------
    controllers : sequence of OpenLoop, length B
        One per robot, all with equally many actions.
    """

    def __init__(self, controllers: Sequence[OpenLoop]) -> None:
        self._actions = np.array([each.actions for each in controllers])

    def act(self, poses: ArrayLike, step: int) -> Array:
        """Return the actions of this step; see `VectorController.act`."""
        finite_poses(poses, len(self._actions))
        return np.array(self._actions[:, step % self._actions.shape[1]])
