"""
The homework: filter a log, look at the map, change the noise
=============================================================

The EKF-SLAM homework of CMU 16-833 gives a log, ``data.txt``, and asks for four things: the map with its ellipses, the
distances of the landmarks from their true positions, an explanation of the covariance, and the effect of the noise.
Two commands answer these questions, and write their files into the folder ``results``:

.. code-block:: bash

   slamgym replay data.txt -e ekf --landmark-init independent
   slamgym noise-study data.txt -e ekf --landmark-init independent

With ``--landmark-init independent``, the filter adds landmarks without a correlation with the pose, as in the homework.

=================================================== ==================================================
question                                            answer
=================================================== ==================================================
Map, path and ellipses after each step?             ``map.png``, ``map_steps/``, ``run.html``
Distance of each landmark from its true position?   printed by ``replay``; ``truth.png``
Why are the landmarks correlated?                   ``covariance.png``, explained below
What do the noise settings change?                  printed by ``noise-study``; ``noise_study.png``
=================================================== ==================================================

This tutorial does the same in Python, with a simulated drive through the homework's world.
"""

# %%
# The log
# -------
# ``read_log("data.txt")`` reads the homework's file. Here the robot drives through the homework's world instead, with six
# landmarks inside a loop of 29 long steps.

from slamgym import load_scenario, replay
from slamgym.envs import OpenLoop
from slamgym.experiments import landmark_table, record_episode, settings_for

world = load_scenario("six_landmarks")
log = record_episode(world, OpenLoop.for_scenario(world), seed=0)
print(log.name, "with", len(log.events), "rows of odometry and scans")

# %%
# The map
# -------
# The textbook filter of the homework is ``ekf``. ``settings_for`` takes the noise from the log's header.

from slamgym.experiments import covariance_figure, map_figure, truth_figure

settings = settings_for(log, estimator="ekf")
run = replay(log, settings.make(log.start))
picture = map_figure(run.trace)

# %%
# Magenta ellipses are predictions; blue ones are updates. A prediction adds the uncertainty of the motion; the scan after it
# reduces the uncertainty again, because the robot sees landmarks that it has seen before.
#
# How far are the landmarks from the truth?
# -----------------------------------------
# The Euclidean distance is the error of the map. The Mahalanobis distance divides this error by the filter's own
# uncertainty. For a consistent filter, 95 % of the Mahalanobis distances are below 2.45 (the square root of 5.99).

for row in landmark_table(run.trace):
    print(
        f"landmark {row['id']}: {row['euclidean']:.3f} m = {row['mahalanobis']:.2f} σ"
    )
against_truth = truth_figure(run.trace)

# %%
# Why are all landmarks correlated?
# ---------------------------------
# A new landmark inherits the uncertainty of the pose from which it was seen. All landmarks share this error, and the
# covariance between them describes it. After the loop, nearly all of a landmark's uncertainty is shared with the others:
# the relative positions are certain, and the map can only move as a whole.

correlations = covariance_figure(run.trace)

# %%
# What does each noise do?
# ------------------------
# ``study_log`` filters the log eleven times: with the settings of the log, and with each of the five standard deviations
# times 10 and divided by 10. NIS and NEES are printed per degree of freedom, so 1 is expected. If a σ is too large, the
# ellipses are too wide, and both are below 1. If it is too small, the truth lies outside the ellipses, and both are above 1.

from slamgym.experiments import noise_study_figure, study_log

runs = study_log(log, settings)
for study in runs:
    row = study.row
    print(
        f"{study.title:22} NIS {row.nis_per_degree:5.2f}  NEES {row.nees_per_degree:7.2f}"
    )
maps = noise_study_figure([(study.title, study.trace) for study in runs])

# %%
# A single drive is not sufficient to test a filter. :doc:`plot_2_consistency` tests filters with 100 drives.
