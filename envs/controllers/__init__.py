"""Controllers: from a pose to the next action, for one robot or for many.

A controller has a method ``act(pose, step)``. The pose is the true one, from
``info["pose"]``, or an estimate from a filter's belief, so the same controller can
generate data and drive on an estimate. Headings need not be wrapped. Every action stays
within the limits of the robot.

The vector form of a controller gives robot i the actions of a single controller to the
bit.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np

from ...sim_configs import Scenario
from ...sim_configs.field_types import unknown_choice
from .interface import Controller, VectorController
from .open_loop import OpenLoop, VectorOpenLoop
from .planned_path import planned_path
from .random_walk import RandomWalk, VectorRandomWalk
from .waypoints import VectorWaypoints, Waypoints

__all__ = [
    "CONTROLLERS",
    "Controller",
    "OpenLoop",
    "RandomWalk",
    "VectorController",
    "VectorOpenLoop",
    "VectorRandomWalk",
    "VectorWaypoints",
    "Waypoints",
    "make_controller",
    "make_vector_controller",
    "planned_path",
]

CONTROLLERS = ("open_loop", "waypoints", "random")
"""The names that :func:`make_controller` accepts."""


def make_controller(
    name: str, scenario: Scenario, rng: np.random.Generator
) -> Controller:
    """Make the controller of a name for a scenario.

    Parameters
    ----------
    name : {"open_loop", "waypoints", "random"}
        ``"open_loop"`` executes the scenario's controls. ``"waypoints"`` steers along
        the path that they take without noise. ``"random"`` is a random walk near that
        path.
    scenario : Scenario
        Source of the controls, the step and the robot.
    rng : numpy.random.Generator
        Used by ``"random"`` only.

    Raises
    ------
    ValueError
        If there is no such controller.
    """
    match name:
        case "open_loop":
            return OpenLoop.for_scenario(scenario)
        case "waypoints":
            return Waypoints.for_scenario(scenario)
        case "random":
            return RandomWalk.for_scenario(scenario, rng)
    raise ValueError(unknown_choice("name", name, CONTROLLERS))


def make_vector_controller(
    name: str,
    scenarios: Sequence[Scenario],
    generators: Sequence[np.random.Generator],
) -> VectorController:
    """Make the controller of a name for the robots of several worlds.

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
    >>> controller = make_vector_controller("open_loop", scenarios, rngs)
    >>> controller.act(np.zeros((2, 3)), step=0).tolist()
    [[0.25, 0.025], [0.25, 0.025]]
    """
    if not scenarios or len(scenarios) != len(generators):
        raise ValueError(
            "scenarios and generators must be equally many, at least 1, "
            f"got {len(scenarios)} and {len(generators)}"
        )
    made: dict[int, Any] = {}  # one for all worlds of the same scenario object
    for scenario, rng in zip(scenarios, generators, strict=True):
        if id(scenario) not in made:
            made[id(scenario)] = make_controller(name, scenario, rng)
    singles = [made[id(scenario)] for scenario in scenarios]
    match name:
        case "open_loop":
            return VectorOpenLoop(singles)
        case "waypoints":
            return VectorWaypoints(singles)
    return VectorRandomWalk(singles, generators)
