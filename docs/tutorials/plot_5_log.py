"""
A log of your own
=================

slamgym reads :doc:`several formats of logs </logs>`. In this tutorial, you write a log and filter it.
"""

# %%
# Write it
# --------
# A log is a CSV file that starts with ``# format: slamlog 1``. Rows are in the order in which a filter consumes them.

from pathlib import Path

LOG = """\
# format: slamlog 1
# name: corner
landmark,0,3,6
landmark,1,-2,4
measurement,0,0,1.11,6.70
measurement,0,1,2.03,4.47
odometry,1,3,0,1
measurement,1,0,1.57,6.01
measurement,1,1,2.47,6.40
odometry,2,1,1.57,1
measurement,2,0,0.17,6.07
measurement,2,1,1.11,7.21
"""
Path("corner.csv").write_text(LOG)

# %%
# Filter it
# ---------
# The header of this log contains no noise settings, so you must specify them. On the command line, use
# ``slamgym replay corner.csv --motion-std .1,.05,.05 --measurement-std .02,.05``.

from slamgym import InvariantEkfSlam, read_log, replay
from slamgym.experiments import landmark_table, map_figure

log = read_log("corner.csv")
run = replay(log, InvariantEkfSlam((0.1, 0.05, 0.05), (0.02, 0.05)))
for row in landmark_table(run.trace):
    print(
        f"landmark {row['id']} at ({row['x']:.2f}, {row['y']:.2f}), off by {row['euclidean']:.2f} m"
    )
picture = map_figure(run.trace)

# %%
# The smoother
# ------------
# A filter processes the readings one after the other. The smoother estimates all poses and landmarks of the log at once
# (``slamgym smooth corner.csv``). :doc:`/limits` compares their accuracy.

from slamgym.experiments import settings_for, smooth_log, smoothed_figure

settings = settings_for(
    log,
    estimator="smoother",
    motion_std=(0.1, 0.05, 0.05),
    measurement_std=(0.02, 0.05),
)
smoothed = smooth_log(log, settings)
print(smoothed.poses[-1])
smoothed_picture = smoothed_figure(smoothed)
