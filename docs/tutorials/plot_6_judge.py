"""
A program of your own, judged by its files
==========================================

slamgym tests programs in any language. It writes drives, the program reads them and writes its estimates, and ``judge``
compares these with the truth.
"""

# %%
# The drives
# ----------
# The command ``slamgym generate six_landmarks --episodes 100 --controller open_loop --out results/drives`` writes such drives. Here,
# a filter of slamgym takes the place of the program.

import math
from pathlib import Path

from slamgym import generate_trajectories, judge, load_trajectories
from slamgym.experiments import nees_figure, summarise_monte_carlo

generate_trajectories(
    "six_landmarks",
    "results/drives",
    episodes=100,
    controller="open_loop",
    estimator="invariant",
)

# %%
# The files of the program
# ------------------------
# Each drive has one file with a line per step: the step, the pose (x, y, θ) and its covariance, by rows. This program
# makes a common mistake: it writes headings in degrees.

for name, unit in {"radians": 1.0, "degrees": math.degrees(1)}.items():
    folder = Path("results", name)
    folder.mkdir(exist_ok=True)
    for drive in load_trajectories("results/drives"):
        beliefs = zip(drive.belief_poses, drive.belief_pose_covariances, strict=True)
        rows = [
            ["pose", step, x, y, unit * heading, *covariance.flat]
            for step, ((x, y, heading), covariance) in enumerate(beliefs)
        ]
        text = "\n".join(",".join(map(str, row)) for row in rows)
        (folder / f"seed_{drive.seed:08}.csv").write_text(text)

# %%
# The verdict
# -----------
# The command is ``slamgym judge results/degrees --drives results/drives``. It names the mistake.

results = judge(["results/radians", "results/degrees"], "results/drives")
for name, found in summarise_monte_carlo(results)["estimators"].items():
    print(f"{name}: {found['verdict']}. {found['diagnosis']['sentence']}")
errors = nees_figure(results)

# %%
# :doc:`/judge` lists the formats and the mistakes that are named. ``examples/16_judge_a_program_in_c.c`` is an EKF-SLAM in C.
