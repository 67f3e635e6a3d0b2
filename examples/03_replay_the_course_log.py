"""Replay a log through the EKF, as the CMU 16-833 homework asks, part 2.

Give it the homework's ``data.txt``, or a log that the simulator wrote. Other logs do
not state their noise; use ``slamgym replay`` for them, and its options::

    python examples/03_replay_the_course_log.py path/to/data.txt

Without a path, the example drives through the same world, writes the drive to
``results/03_drive.csv``, and replays it.

It prints how far each landmark ends from its true place, in metres and in standard
deviations, and writes ``results/03_map.png``: predicted poses in magenta, updated poses
in blue, first landmarks in red and later ones in green, all as 3σ ellipses.

The log is replayed twice.  New landmarks should enter the belief with their correlation
to the pose from which they were seen ("full").  The homework omits it ("independent").
On the homework's log this happens to end closer to the truth, but it makes the filter
overconfident.
"""

import sys
from pathlib import Path

from slamgym import load_scenario, read_log, replay
from slamgym.envs import OpenLoop
from slamgym.experiments import (
    Replay,
    SlamLog,
    landmark_table,
    map_figure,
    record_episode,
    save_figure,
    settings_for,
    write_slamlog,
)
from slamgym.sim_configs import action_sequence

RESULTS = Path("results")


def simulated_log() -> Path:
    """Drive once through the homework's world, and write the log."""
    scenario = load_scenario("six_landmarks")
    driver = OpenLoop(action_sequence(scenario), scenario.robot)
    path = RESULTS / "03_drive.csv"
    write_slamlog(record_episode(scenario, driver, seed=0), path)
    return path


def run(log: SlamLog, landmark_init: str) -> Replay:
    """Replay the log through an EKF with the noise in the log's header."""
    settings = settings_for(
        log, estimator="ekf", options={"landmark_init": landmark_init}
    )
    return replay(log, settings.make(log.start), name=f"ekf, {landmark_init}")


def main() -> None:
    RESULTS.mkdir(exist_ok=True)
    path = Path(sys.argv[1]) if len(sys.argv) > 1 else simulated_log()
    try:
        log = read_log(path)
        runs = {init: run(log, init) for init in ("independent", "full")}
    except (OSError, ValueError) as error:
        sys.exit(f"error: {error}")
    print(f"{log.name}: {len(log.events)} odometry rows and scans")
    for landmark_init, done in runs.items():
        print(f"landmark_init = {landmark_init!r}")
        for row in landmark_table(done.trace):
            print(
                f"  landmark {row['id']} at ({row['x']:.3f}, {row['y']:.3f}) m", end=""
            )
            if row["euclidean"] is None:
                print(", true place unknown")
            else:
                print(f", off by {row['euclidean']:.7f} m = {row['mahalanobis']:.5f} σ")
    save_figure(map_figure(runs["full"].trace), RESULTS / "03_map.png", dpi=150)
    print(f"wrote {RESULTS / '03_map.png'}")


if __name__ == "__main__":
    main()
