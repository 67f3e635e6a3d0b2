"""The bound on the errors of any filter in simulated runs."""

import numpy as np

from ....evaluation.error_bound import PosteriorBound, posterior_bound
from ....sim_configs import Scenario
from ...runs.simulated_runs import SimulatedRuns


def bound_runs(scenario: Scenario, runs: SimulatedRuns) -> PosteriorBound:
    """Return the bound along each run's true path, with the noise of the world.

    Where the world hides identities, it is that of a filter which knows them.
    """
    identified = runs.identified()
    dt = np.tile(runs.dt, (len(runs.odometry), 1))
    if not scenario.motion.noise_at_rest:
        dt *= runs.odometry.any(axis=2)
    return posterior_bound(
        runs.true_poses,
        runs.landmarks,
        identified.visible,
        dt,
        motion_std=scenario.motion.std,
        measurement_std=scenario.sensor.std,
        start_std=scenario.start.std,
        range_std_per_metre=scenario.sensor.range_std_per_metre,
    )
