"""The scenarios that episodes draw from the ranges of one."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from ..arrays import Array
from .field_types import Part
from .randomisation import RANGES
from .scenario import Scenario
from .scenario_errors import ScenarioError


def drawn_scenario(scenario: Scenario, rng: np.random.Generator) -> Scenario:
    """Draw the scenario of one episode.

    Every range has its own random number u, so no range affects the draw of another::

        factor = low (high / low)^u,    value = low + u (high - low),    u ~ U[0, 1)

    Parameters
    ----------
    scenario : Scenario
        With or without ``randomise``.
    rng : numpy.random.Generator
        Source of the random numbers.

    Returns
    -------
    Scenario
        Without ``randomise``. A scenario without ranges is returned unchanged. A map
        that is scaled or shifted becomes a layout of points.

    Examples
    --------
    >>> from slamgym.sim_configs import load_scenario
    >>> ranges = {"motion_std": [0.5, 2.0], "start_heading": [-3.0, 3.0]}
    >>> scenario = load_scenario("six_landmarks").with_changes(randomise=ranges)
    >>> drawn = drawn_scenario(scenario, np.random.default_rng(0))
    >>> [round(std / 0.1, 3) for std in drawn.motion.std]
    [3.023, 1.209, 1.209]
    >>> drawn == drawn_scenario(scenario, np.random.default_rng(0))
    True
    """
    if scenario.randomise is None:
        return scenario
    shares = dict(zip(RANGES, rng.random(len(RANGES)).tolist(), strict=True))
    directions = rng.uniform(-1.0, 1.0, (scenario.landmarks.count, 2))
    return scenario.drawn_at(shares, directions)


def refuse_ranges(scenario: Scenario) -> None:
    """Raise a `ScenarioError` if a scenario has ranges (``randomise``)."""
    if scenario.randomise is not None:
        raise ScenarioError(
            f"scenario '{scenario.name}' has ranges (randomise), and a log has the "
            "noise of one world: draw it with drawn_scenario, as slamgym generate does"
        )


def copied_draw(
    scenario: Scenario, shares: Mapping[str, float], directions: Array
) -> Scenario:
    """Return `Scenario.drawn_at` in a tenth of its time, without its checks."""
    assert scenario.randomise is not None
    changes = scenario.randomise.changes(scenario, shares, directions)
    if "layout" in changes.get("landmarks", {}):
        return scenario.with_changes(**changes)
    tables: dict[str, Part] = {}
    for key, table in changes.items():
        if table is not None:
            values = {name: _as_tuple(value) for name, value in table.items()}
            tables[key] = getattr(scenario, key).model_copy(update=values)
    return scenario.model_copy(update={**tables, "randomise": None})


def widest_scenario(scenario: Scenario) -> Scenario:
    """Return a scenario at the high ends of its ranges; itself without any."""
    if scenario.randomise is None:
        return scenario
    unmoved = np.zeros((scenario.landmarks.count, 2))
    return scenario.drawn_at(dict.fromkeys(RANGES, 1.0), unmoved)


def _as_tuple(value: Any) -> Any:
    return tuple(value) if isinstance(value, list) else value
