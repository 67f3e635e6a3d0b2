"""Scenarios and controllers by the names that the user gives."""

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ...envs.controllers import CONTROLLERS, Controller, make_controller
from ...sim_configs import Scenario, list_presets, load_scenario
from ...suggestions import closest
from .errors import BadInputError
from .option_values import changes

if TYPE_CHECKING:
    from ..logs.slamlog import SlamLog


def chosen_scenario(
    name: str, steps: int | None, sets: Iterable[str] | None
) -> Scenario:
    """Load a preset or a .toml file, with the changes of ``--steps`` and ``--set``.

    Raises
    ------
    ValueError
        If there is no such scenario, it is a log, or a change does not fit.
    """
    changed = changes("--set", sets)
    if steps is not None:
        changed["steps"] = steps
    _refuse_log(name)
    return load_scenario(name).with_changes(**changed)


def _refuse_log(name: str) -> None:
    """Refuse a file or folder that is no scenario, and name the command for logs."""
    path = Path(name)
    if name in list_presets() or path.suffix == ".toml" or not path.exists():
        return
    raise BadInputError(
        f"{name} is no scenario (a preset or a .toml file); to filter a log: slamgym "
        f"replay {name}"
    )


def chosen_controller(name: str, scenario: Scenario, seed: int) -> Controller:
    """Make a controller; a random one drives the same path for the same seed.

    Raises
    ------
    BadInputError
        If there is no such controller.
    """
    if name not in CONTROLLERS:
        hint, known = closest(name, CONTROLLERS), ", ".join(CONTROLLERS)
        raise BadInputError(f"unknown controller '{name}'{hint} (there are {known})")
    return make_controller(name, scenario, np.random.default_rng([seed, 1]))


def recorded(
    scenario: Scenario,
    controller: str,
    seed: int,
    progress: Callable[[int, int], object] | None = None,
) -> "SlamLog":
    """Record one episode with the controller of a name; see `record_episode`."""
    from ..logs.recording import record_episode

    driver = chosen_controller(controller, scenario, seed)
    return record_episode(scenario, driver, seed, progress=progress)
