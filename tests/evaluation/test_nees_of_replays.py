"""Whether the filter is as sure as it may be: NEES over many runs.

In a world anchored at the start, where the first pose is the origin by definition, the
standard EKF is consistent; the sum of the final pose NEES of 200 runs is χ² with 600
degrees of freedom.
"""

import numpy as np
import pytest
from recordings import recorded
from scipy.stats import chi2

from slamgym.experiments.run_and_replay.filter_settings import settings_for
from slamgym.experiments.run_and_replay.log_replay import replay
from slamgym.experiments.run_and_replay.summary import pose_nees

RUNS = 200


@pytest.mark.slow
def test_nees_at_the_end_and_nis_are_chi_square_in_a_world_anchored_at_the_start():
    """The innovations of a filter are white, so those of one run add up too."""
    start = {"std": [0, 0, 0]}
    drives = [recorded("six_landmarks", seed, start=start) for seed in range(RUNS)]
    traces = [replay(log, settings_for(log).make(log.start)).trace for log in drives]
    nees = np.array([pose_nees(trace)[-1] for trace in traces])
    low, high = chi2.ppf([0.005, 0.995], 3 * RUNS)
    assert low < nees.sum() < high
    inside = np.mean(nees < chi2.ppf(0.95, 3))
    assert inside == pytest.approx(0.95, abs=3 * np.sqrt(0.95 * 0.05 / RUNS))
    dof = sum(trace.nis_dof.sum() for trace in traces)
    low, high = chi2.ppf([0.005, 0.995], dof)
    assert low < sum(trace.nis.sum() for trace in traces) < high
    assert dof == RUNS * 29 * 12
