"""
The NEES of a filter of your own
================================

A filter is consistent if its covariance matches the size of its errors. In this tutorial, you write a filter, check it,
and compare it with two filters of the package on 100 drives.
"""

# %%
# Write and check a filter
# ------------------------
# A filter is any class with the methods of ``SlamEstimator``; :doc:`/own_filter` shows a whole one. Here, an existing filter is changed.
# ``check_estimator`` runs it in a small world and lists what it lacks to run, wrong beliefs, and recommendations. It notices that this
# filter assumes more noise than it is given, which is intended here. Such a filter runs in all commands.

from slamgym import EkfSlam, check_estimator
from slamgym.estimator import EstimatorContractError


class CautiousEkf(EkfSlam):
    """The textbook EKF with twice the variance of the motion noise."""

    def predict(self, odometry, dt=1.0):
        """Count the motion noise twice."""
        super().predict(odometry, 2 * dt)


try:
    check_estimator(CautiousEkf)
except EstimatorContractError as error:
    print(error)

# %%
# A hundred drives
# ----------------
# All filters receive the same readings. A command does the same for a class in the file ``my_filters.py``,
# and writes a report: ``slamgym monte-carlo six_landmarks -e ekf,invariant,my_filters:CautiousEkf --runs 100``.

from slamgym import consistency_of, monte_carlo

filters = {"ekf": "ekf", "cautious": CautiousEkf, "invariant": "invariant"}
results = monte_carlo("six_landmarks", filters, runs=100)
for name in filters:
    for sentence in consistency_of(results, name).sentences()[:1]:
        print(sentence)

# %%
# The NEES over the drive
# -----------------------
# The results are an xarray dataset: estimator × run × step. The dashed line is the expected value.

import matplotlib.pyplot as plt

figure, axes = plt.subplots(figsize=(7, 3.2), layout="constrained")
for name in filters:
    nees = results["pose_nees_invariant"].sel(estimator=name)
    axes.plot(nees.mean("run") / 3, label=name)
axes.axhline(1, color="0.5", linestyle="--", linewidth=1)
axes.set(xlabel="step", ylabel="pose NEES per degree", ylim=(0, None))
axes.legend(frameon=False)

# %%
# A larger motion noise does not make the filter consistent. The problem of ``ekf`` is the heading, which its linearisation
# treats as observable. :doc:`/filters` explains the mechanism, and :doc:`/consistency` the tests.
