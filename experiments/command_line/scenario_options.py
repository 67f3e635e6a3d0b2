"""Scenarios as the command line names and drives them."""

from collections.abc import Callable, Iterable
from difflib import get_close_matches

import numpy as np

from ...envs.controllers import CONTROLLERS, Controller, make_controller
from ...sim_configs import Scenario, load_scenario
from ..logs.recording import record_episode
from ..logs.slamlog import SlamLog
from .errors import BadInputError
from .option_values import changes


def chosen_scenario(name: str, *, steps: int | None, sets: Iterable[str]) -> Scenario:
    """Load a preset or a .toml file, and change what the options say.

    Raises
    ------
    ValueError
        If there is no such scenario, or a change does not fit.
    """
    changed = changes("--set", sets)
    if steps is not None:
        changed["steps"] = steps
    return load_scenario(name).with_changes(**changed)


def driver(name: str, scenario: Scenario, seed: int) -> Controller:
    """Make a controller; a random one wanders the same way for the same seed.

    Raises
    ------
    BadInputError
        If there is no such controller.
    """
    if name not in CONTROLLERS:
        near = get_close_matches(name, CONTROLLERS, n=1)
        hint = f"; did you mean '{near[0]}'?" if near else ""
        known = ", ".join(CONTROLLERS)
        raise BadInputError(f"unknown controller '{name}'{hint} (there are {known})")
    return make_controller(name, scenario, np.random.default_rng([seed, 1]))


def recorded(
    scenario: Scenario,
    controller: str,
    seed: int,
    progress: Callable[[int, int], object] | None = None,
) -> SlamLog:
    """Drive one episode with a controller of this name, see `record_episode`."""
    driving = driver(controller, scenario, seed)
    return record_episode(scenario, driving, seed, progress=progress)
