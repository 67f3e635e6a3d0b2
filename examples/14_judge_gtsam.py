"""Judge the estimates of another library, here of GTSAM, with its own program.

slamgym writes drives, the program reads odometry and readings from them, and writes a
pose with covariance for every step. `judge` then compares both with the truth, as
`monte_carlo` does for filters of slamgym. The program needs only the
files, so any language will do: see 16_judge_a_program_in_c.c.

The program is iSAM2 on a graph of the poses and landmarks. GTSAM states the covariance
of a pose in the robot's own frame. A program that passes it on as it is says
``covariances="left"``. If it forgets that, `judge` names the mistake.

Run it (needs ``pip install 'slamgym[peers]'``)::

    python examples/14_judge_gtsam.py
"""

import argparse
import csv
from pathlib import Path

import gtsam
import numpy as np

from slamgym import generate_trajectories, judge
from slamgym.experiments import summarise_monte_carlo

POSE, PLACE = gtsam.symbol_shorthand.X, gtsam.symbol_shorthand.L


def read_drive(path: Path) -> tuple[dict[str, list[float]], list[list[str]]]:
    """Return the numbers of the header, and the events of a drive."""
    header: dict[str, list[float]] = {}
    events = []
    for row in csv.reader(path.read_text().splitlines()):
        if row[0].startswith("#"):
            key, _, first = row[0][1:].partition(":")
            if first.strip().lstrip("-").replace(".", "", 1).isdigit():
                header[key.strip()] = [float(value) for value in (first, *row[1:])]
        elif row[0] in ("odometry", "measurement"):  # the others are the truth
            events.append(row)
    return header, events


def filtered(path: Path) -> list[str]:
    """Run iSAM2 over a drive; return the lines of its estimates."""
    header, events = read_drive(path)
    sensor = gtsam.noiseModel.Diagonal.Sigmas(np.array(header["measurement_std"]))
    start = gtsam.Pose2(*header["start"])
    prior = gtsam.noiseModel.Diagonal.Sigmas(np.array(header["start_sigma"]))
    settings = gtsam.ISAM2Params()
    settings.setRelinearizeThreshold(0.01)
    settings.relinearizeSkip = 1
    smoother = gtsam.ISAM2(settings)
    graph, guess = gtsam.NonlinearFactorGraph(), gtsam.Values()
    graph.add(gtsam.PriorFactorPose2(POSE(0), start, prior))
    guess.insert(POSE(0), start)
    step, here, known, lines = 0, start, set(), []

    def solve() -> None:
        nonlocal here, graph, guess
        smoother.update(graph, guess)
        for _ in range(3):  # until the estimates no longer move
            smoother.update()
        graph, guess = gtsam.NonlinearFactorGraph(), gtsam.Values()
        here = smoother.calculateEstimatePose2(POSE(step))
        numbers = [here.x(), here.y(), here.theta()]
        numbers += smoother.marginalCovariance(POSE(step)).ravel().tolist()
        lines.append(f"pose,{step},{','.join(map(repr, map(float, numbers)))}")

    for kind, _, *fields in events:
        if kind == "odometry":
            solve()
            distance, turn, _ = map(float, fields)
            moved, model = odometry_factor(distance, turn, header["motion_std"])
            graph.add(
                gtsam.BetweenFactorPose2(POSE(step), POSE(step + 1), moved, model)
            )
            step, here = step + 1, here.compose(moved)
            guess.insert(POSE(step), here)
        else:
            name, bearing, distance = int(fields[0]), float(fields[1]), float(fields[2])
            if name not in known:
                known.add(name)
                seen = distance * np.array([np.cos(bearing), np.sin(bearing)])
                guess.insert(PLACE(name), here.transformFrom(seen))
            graph.add(
                gtsam.BearingRangeFactor2D(
                    POSE(step), PLACE(name), gtsam.Rot2(bearing), distance, sensor
                )
            )
    solve()
    return lines


def odometry_factor(
    distance: float, turn: float, std: list[float]
) -> tuple[gtsam.Pose2, gtsam.noiseModel.Gaussian]:
    """Return a motion, and its noise in the robot's frame after the turn."""
    noise = np.diag(np.square(std))
    back = gtsam.Rot2(turn).matrix()
    noise[:2, :2] = back.T @ noise[:2, :2] @ back
    moved = gtsam.Pose2(distance, 0.0, turn)
    return moved, gtsam.noiseModel.Gaussian.Covariance(noise)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--drives", type=int, default=50, help="number of drives")
    count = parser.parse_args().drives
    folder = Path("results/14_judge_gtsam")
    generate_trajectories(
        "six_landmarks",
        folder / "drives",
        episodes=count,
        controller="open_loop",
        format="slamlog",
    )
    estimates = folder / "isam2"
    estimates.mkdir(exist_ok=True)
    for drive in sorted(folder.glob("drives/shard_*/seed_*.csv")):
        (estimates / drive.name).write_text("\n".join([*filtered(drive), ""]))
    for covariances in ("left", "additive"):
        results = judge(estimates, folder / "drives", covariances=covariances)
        entry = summarise_monte_carlo(results)["estimators"]["isam2"]
        print(f"covariances={covariances!r}: {entry['sentence']}")
        print(entry["diagnosis"]["sentence"])


if __name__ == "__main__":
    main()
