"""What people do with worlds and estimators.

* :mod:`~slamgym.experiments.logs` reads, writes and records logs of readings.
* :mod:`~slamgym.experiments.runs` filters a log or simulated runs, and summarises them.
* :mod:`~slamgym.experiments.figures` draws a run: map, errors, covariance.
* :mod:`~slamgym.experiments.monte_carlo` tests the consistency of filters in many runs.
* :mod:`~slamgym.experiments.noise_study` scales each noise, in one run or in many.
* :mod:`~slamgym.experiments.trajectories` generates data sets of trajectories.
* :mod:`~slamgym.experiments.viewers` writes a run as a web page, or for rerun.

The command line ``slamgym`` is ``command_line``.
"""

from lazy_loader import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
