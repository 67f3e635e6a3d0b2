"""The path of a scenario's controls without noise and walls."""

import numpy as np

from ...arrays import Array
from ...sim_configs import Scenario, action_sequence
from ..robot.drive_equation import displacement


def planned_path(scenario: Scenario) -> Array:
    """Compute the poses of the scenario's controls, without noise and walls.

    Returns
    -------
    ndarray of float64, shape (steps + 1, 3)
        Poses (x, y, θ) [m, m, rad] from the start on; headings are not wrapped.

    Examples
    --------
    >>> from slamgym.sim_configs import load_scenario
    >>> planned_path(load_scenario("six_landmarks"))[5].tolist()
    [15.0, 0.0, 0.0]
    """
    distances, turns = (action_sequence(scenario) * scenario.dt).T
    x, y, heading = scenario.start.pose
    headings = np.cumsum([heading, *turns])
    cos, sin = np.cos(headings[:-1]), np.sin(headings[:-1])
    dx, dy = displacement(distances, np.zeros(len(distances)), cos, sin)
    return np.column_stack([np.cumsum([x, *dx]), np.cumsum([y, *dy]), headings])
