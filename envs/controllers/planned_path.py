"""The path that a scenario's controls mean to take."""

import numpy as np
from numpy.typing import NDArray

from ...sim_configs import Scenario, action_sequence


def planned_path(scenario: Scenario) -> NDArray[np.float64]:
    """Compute the poses of the scenario's controls, without noise and walls.

    ::

        x' = x + d cos θ,    y' = y + d sin θ,    θ' = θ + α

    Returns
    -------
    ndarray of float64, shape (steps + 1, 3)
        Poses (x, y, θ) [m, m, rad], the start first, headings not wrapped.

    Examples
    --------
    >>> from slamgym.sim_configs import load_scenario
    >>> planned_path(load_scenario("six_landmarks"))[5].tolist()
    [15.0, 0.0, 0.0]
    """
    distances, turns = (action_sequence(scenario) * scenario.dt).T
    x, y, heading = scenario.start.pose
    headings = np.cumsum([heading, *turns])
    return np.column_stack(
        [
            np.cumsum([x, *(distances * np.cos(headings[:-1]))]),
            np.cumsum([y, *(distances * np.sin(headings[:-1]))]),
            headings,
        ]
    )
