"""What the server of `forked` loads before it forks: modules, and compiled kernels."""

import jobs_to_kill  # noqa: F401
import matplotlib.figure  # noqa: F401
import scipy.optimize  # noqa: F401

import slamgym.experiments.trajectories.generate  # noqa: F401
from slamgym.experiments.monte_carlo_study import monte_carlo

monte_carlo("six_landmarks", "ekf,invariant", 1)
