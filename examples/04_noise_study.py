"""Show what each noise does: all five σ times 10 and divided by 10, one at a time.

Section 3.2 of the CMU 16-833 homework.  The robot drives once, and the filter replays
the drive with eleven settings of its noise; only the first one is right.  If a σ is too
large, the ellipses are too wide, and NIS and NEES are below 1.  If it is too small, the
truth lies outside the ellipses, and NIS and NEES are above 1.  Both are given per
degree of freedom.

Run it::

    python examples/04_noise_study.py

It prints the table and writes ``results/04_noise_study.png``.  The command
``slamgym noise-study`` does the same for any log or scenario.
"""

from pathlib import Path

from slamgym import load_scenario
from slamgym.envs import OpenLoop
from slamgym.experiments import (
    noise_study_figure,
    record_episode,
    save_figure,
    settings_for,
    study_log,
)
from slamgym.sim_configs import action_sequence

PICTURE = Path("results/04_noise_study.png")


def main() -> None:
    scenario = load_scenario("six_landmarks")
    driver = OpenLoop(action_sequence(scenario), scenario.robot)
    log = record_episode(scenario, driver, seed=0)
    runs = study_log(log, settings_for(log, estimator="invariant"))
    print(
        f"{'the filter believes':22} {'pose 3σ area':>14} {'map error':>11} NIS   NEES"
    )
    for run in runs:
        row = run.row
        print(
            f"{run.title:22} {row.pose_area:11.3f} m² {row.landmark_rmse:9.3f} m "
            f"{row.nis_per_degree:5.2f} {row.nees_per_degree:6.2f}"
        )
    PICTURE.parent.mkdir(exist_ok=True)
    maps = noise_study_figure([(run.title, run.trace) for run in runs])
    save_figure(maps, PICTURE, dpi=100)
    print(f"wrote {PICTURE}")


if __name__ == "__main__":
    main()
