"""Drivers for many robots side by side: from their poses to their next actions.

Robot i gets, bit for bit, the actions of a single controller of the same name
(:mod:`.single`).  For that, sines and roots are taken by `math` one by one, as there,
since those of numpy differ from them in the last bit.
"""

import math
from collections.abc import Callable, Sequence
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ...sim_configs import Scenario
from .single import (
    _ALIGNED,
    Controller,
    OpenLoop,
    RandomSmooth,
    Waypoints,
    make_controller,
)

Array = NDArray[np.float64]

_BLOCK = 128  # steps of noise drawn ahead


class ControllerBatch(Protocol):
    """What drives B robots."""

    def act(self, poses: ArrayLike, step: int) -> Array:
        """Choose the next action of every robot.

        Parameters
        ----------
        poses : array_like, shape (B, 3)
            (x, y, θ) of the robots, true or estimated [m, m, rad].
        step : int
            Steps of the episode done so far, the same for all. Step 0 starts anew.

        Returns
        -------
        ndarray of float64, shape (B, 2)
            (v, ω) [m/s, rad/s], a fresh array.
        """
        ...


class OpenLoopBatch:
    """Let every robot follow its sequence of actions; see `OpenLoop`.

    Parameters
    ----------
    drivers : sequence of OpenLoop, length B
        The single controllers whose actions are meant, equally many.
    """

    def __init__(self, drivers: Sequence[OpenLoop]) -> None:
        self._actions = np.array([driver._actions for driver in drivers])

    def act(self, poses: ArrayLike, step: int) -> Array:
        """Give the actions of this step; see `ControllerBatch.act`."""
        _finite_poses(poses, len(self._actions))
        return np.array(self._actions[:, step % self._actions.shape[1]])


class WaypointsBatch:
    """Let every robot visit its points in turn; see `Waypoints`.

    Parameters
    ----------
    drivers : sequence of Waypoints, length B
        The single controllers whose points, limits and tolerances are meant. They have
        equally many points.
    """

    def __init__(self, drivers: Sequence[Waypoints]) -> None:
        self._robots = np.arange(len(drivers))
        self._points = np.array([driver._points for driver in drivers])
        self._max_speed = np.array([driver._robot.max_speed for driver in drivers])
        self._max_turn = np.array([driver._robot.max_turn_rate for driver in drivers])
        self._dt = np.array([driver._dt for driver in drivers])
        self._tolerance = np.array([driver._tolerance for driver in drivers])
        self._loops = np.array([driver._loop for driver in drivers])
        self._next = np.zeros(len(drivers), dtype=np.intp)

    def act(self, poses: ArrayLike, step: int) -> Array:
        """Head for the next waypoints; see `ControllerBatch.act`."""
        array = _finite_poses(poses, len(self._robots))
        if step == 0:
            self._next[:] = 0
        (ahead, aside), distance = self._pass_reached(array[:, :2])
        error = _wrap(_each(math.atan2, aside, ahead) - array[:, 2])
        speed = distance * _each(math.cos, error) / self._dt
        speed[~(np.abs(error) < _ALIGNED)] = 0.0
        turn_rate = np.minimum(
            np.maximum(error / self._dt, -self._max_turn), self._max_turn
        )
        actions = np.column_stack([np.minimum(speed, self._max_speed), turn_rate])
        actions[self._next >= self._points.shape[1]] = 0.0
        return actions

    def _pass_reached(self, positions: Array) -> tuple[Array, Array]:
        """Advance past the waypoints within reach.

        Returns the ways to the next ones, (ahead, aside) (2, B), and their lengths.
        """
        count = self._points.shape[1]
        for _ in range(count):
            ways, distance = self._ways(positions)
            passed = (distance <= self._tolerance) & (self._next < count)
            if not passed.any():
                return ways, distance
            self._next += passed
            self._next[self._loops] %= count
        return self._ways(positions)

    def _ways(self, positions: Array) -> tuple[Array, Array]:
        places = np.minimum(self._next, self._points.shape[1] - 1)
        ahead, aside = (self._points[self._robots, places] - positions).T
        return np.stack([ahead, aside]), _each(math.hypot, ahead, aside)


class RandomSmoothBatch:
    """Let every robot wander by itself; see `RandomSmooth`.

    Parameters
    ----------
    drivers : sequence of RandomSmooth, length B
        The single controllers whose limits, memories and homes are meant.
    generators : sequence of numpy.random.Generator, length B
        Where the wandering of each robot comes from.
    """

    def __init__(
        self,
        drivers: Sequence[RandomSmooth],
        generators: Sequence[np.random.Generator],
    ) -> None:
        self._generators = generators
        self._max_speed = np.array([driver._robot.max_speed for driver in drivers])
        self._max_turn = np.array([driver._robot.max_turn_rate for driver in drivers])
        self._memory = np.array([[driver._memory] for driver in drivers])
        self._fresh = np.array(
            [[math.sqrt(1 - m**2)] for (m,) in self._memory.tolist()]
        )
        self._homes = np.array([driver._home for driver in drivers])
        self._reach = np.array([driver._reach for driver in drivers])
        self._state = np.zeros((len(drivers), 2))
        self._noise: list[Array] = []  # (B, 2) of the steps to come, the next one last

    def act(self, poses: ArrayLike, step: int) -> Array:
        """Drift on from the last actions; see `ControllerBatch.act`."""
        array = _finite_poses(poses, len(self._state))
        if step > 0:
            self._state = self._memory * self._state + self._fresh * self._next_noise()
        else:
            self._state = 0.0 * self._state + self._next_noise()
        speed = 0.5 + self._state[:, 0] / 4
        turn = self._state[:, 1] / 3 + self._ways_home(array)
        return np.column_stack(
            [
                self._max_speed * np.clip(speed, 0.0, 1.0),
                self._max_turn * np.clip(turn, -1.0, 1.0),
            ]
        )

    def _next_noise(self) -> Array:
        if not self._noise:
            drawn = [rng.standard_normal((_BLOCK, 2)) for rng in self._generators]
            self._noise = list(np.stack(drawn, axis=1))[::-1]
        return self._noise.pop()

    def _ways_home(self, poses: Array) -> Array:
        """Compute the angles from headings to homes, 0 within reach of them."""
        ahead, aside = (self._homes - poses[:, :2]).T
        angles = _wrap(_each(math.atan2, aside, ahead) - poses[:, 2])
        angles[_each(math.hypot, ahead, aside) <= self._reach] = 0.0
        return angles


def make_controller_batch(
    name: str,
    scenarios: Sequence[Scenario],
    generators: Sequence[np.random.Generator],
) -> ControllerBatch:
    """Make a controller for the robots of some worlds by name.

    Parameters
    ----------
    name : {"open_loop", "waypoints", "random"}
        As in `make_controller`.
    scenarios : sequence of Scenario, length B
        The world of each robot; all have equally many steps.
    generators : sequence of numpy.random.Generator, length B
        Used by ``"random"`` only, which draws ahead from them.

    Raises
    ------
    ValueError
        If there is no such controller, or the lengths differ.

    Examples
    --------
    >>> from slamgym.sim_configs import load_scenario
    >>> rngs = [np.random.default_rng(seed) for seed in (0, 1)]
    >>> scenarios = [load_scenario("loop")] * 2
    >>> drivers = make_controller_batch("open_loop", scenarios, rngs)
    >>> drivers.act(np.zeros((2, 3)), step=0).tolist()
    [[0.25, 0.025], [0.25, 0.025]]
    """
    if not scenarios or len(scenarios) != len(generators):
        raise ValueError(
            "scenarios and generators must be equally many, at least 1, "
            f"got {len(scenarios)} and {len(generators)}"
        )
    singles = _singles(name, scenarios, generators)
    match singles[0]:
        case OpenLoop():
            return OpenLoopBatch([d for d in singles if isinstance(d, OpenLoop)])
        case Waypoints():
            return WaypointsBatch([d for d in singles if isinstance(d, Waypoints)])
        case _:
            wanderers = [d for d in singles if isinstance(d, RandomSmooth)]
            return RandomSmoothBatch(wanderers, generators)


def _singles(
    name: str,
    scenarios: Sequence[Scenario],
    generators: Sequence[np.random.Generator],
) -> list[Controller]:
    """Make the single controllers, one for all worlds of the same scenario object."""
    made: dict[int, Controller] = {}
    for scenario, rng in zip(scenarios, generators, strict=True):
        if id(scenario) not in made:
            made[id(scenario)] = make_controller(name, scenario, rng)
    return [made[id(scenario)] for scenario in scenarios]


def _each(function: Callable[..., float], *arguments: Array) -> Array:
    """Apply a function of `math` to every element."""
    numbers = [argument.tolist() for argument in arguments]
    return np.fromiter(map(function, *numbers), np.float64, len(numbers[0]))


def _wrap(angles: Array) -> Array:
    """Bring angles to [-π, π)."""
    return (angles + math.pi) % (2 * math.pi) - math.pi


def _finite_poses(poses: ArrayLike, count: int) -> Array:
    array = np.asarray(poses, dtype=np.float64)
    if array.shape != (count, 3) or not np.isfinite(array).all():
        raise ValueError(
            f"poses must be finite, one row (x, y, θ) for each of {count} robots, "
            f"got {poses!r}"
        )
    return array
