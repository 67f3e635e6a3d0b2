"""Time of smoothing a drive, beside the compiled filter and GTSAM's batch.

    python benchmarks/smoother.py

One drive of 1,000 steps among 20 landmarks, about half of them visible at each step.
Ratios are formed round by round. GTSAM gets the same start and the same graph, built in
advance with its own factors. Both optimise by Levenberg-Marquardt to the same accuracy,
until no estimate moves by more than about a nanometre.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from importlib import import_module
from typing import Any

import numpy as np
from interleaved import microseconds, ratio, time_interleaved, verdict
from numpy.typing import NDArray

from slamgym.estimator import make_batch
from slamgym.estimator.models.bearing_range import predict_measurement
from slamgym.estimator.models.motions import predict_pose
from slamgym.estimator.smoother import Drive, smooth
from slamgym.estimator.smoother.optimiser import start_of

Array = NDArray[np.float64]
STEPS, LANDMARKS = 1000, 20
MOTION_STD, MEASUREMENT_STD = (0.03, 0.01, 0.01), (0.02, 0.1)
START_STD = (0.01, 0.01, 0.01)
TOLERANCE = 1e-12  # relative, of GTSAM's cost
DEFAULT = "GTSAM batch from the same start, to its default tolerance"
MOST_OF_A_FILTER, LEAST_OF_GTSAM = 40.0, 5.0


class Data:
    """Odometry (T, 2), readings (T, L, 2) and their visibility (T, L) of one drive."""

    def __init__(self, seed: int) -> None:
        rng = np.random.default_rng(seed)
        landmarks = rng.uniform(-10, 10, (LANDMARKS, 2))
        self.odometry = np.tile([0.25, 0.05], (STEPS, 1))
        self.readings = np.zeros((STEPS, LANDMARKS, 2))
        self.visible = np.zeros((STEPS, LANDMARKS), dtype=bool)
        self.odometry[0] = 0.0
        pose = np.array([0.0, -5.0, 0.0])
        for k in range(STEPS):
            if k:
                motion = predict_pose(pose, self.odometry[k])
                slip = np.array(MOTION_STD) * rng.standard_normal(3)
                pose = motion.pose + motion.jacobian_noise @ slip
            exact = predict_measurement(pose, landmarks).measurement
            noise = np.array(MEASUREMENT_STD) * rng.standard_normal(exact.shape)
            self.readings[k] = exact + noise
            near = np.argsort(exact[:, 1])[: LANDMARKS // 2]
            self.visible[k, near[exact[near, 1] > 1.0]] = True

    def drive(self) -> Drive:
        """Record the drive."""
        made = Drive(
            MOTION_STD,
            MEASUREMENT_STD,
            initial_pose=(0, -5, 0),
            initial_pose_std=START_STD,
        )
        for k in range(STEPS):
            if k:
                made.predict(self.odometry[k])
            seen = np.flatnonzero(self.visible[k])
            made.update(self.readings[k, seen], seen)
        return made

    def filter(self) -> None:
        """Run the compiled filter over the whole drive in one call."""
        batch = make_batch(
            "ekf",
            runs=1,
            landmarks=LANDMARKS,
            motion_std=MOTION_STD,
            measurement_std=MEASUREMENT_STD,
            initial_poses=(0.0, -5.0, 0.0),
            initial_pose_std=START_STD,
            threads=1,
        )
        dt = np.ones(STEPS)
        dt[0] = 0.0
        batch.run(self.odometry[None], self.readings[None], self.visible[None], dt)


class Gtsam:
    """The same drive as a factor graph, built in advance."""

    def __init__(self, data: Data, poses: Array, landmarks: dict[int, Array]) -> None:
        self.gtsam: Any = import_module("gtsam")
        g, std = self.gtsam, self.gtsam.noiseModel.Diagonal.Sigmas
        X, L = g.symbol_shorthand.X, g.symbol_shorthand.L
        self.graph, self.start = g.NonlinearFactorGraph(), g.Values()
        origin = g.Pose2(0, -5, 0)
        self.graph.add(g.PriorFactorPose2(X(0), origin, std(np.array(START_STD))))
        motion, reading = std(np.array(MOTION_STD)), std(np.array(MEASUREMENT_STD))
        for k in range(STEPS):
            self.start.insert(X(k), g.Pose2(*poses[k]))
            if k:
                moved = g.Pose2(data.odometry[k, 0], 0, data.odometry[k, 1])
                between = g.BetweenFactorPose2(X(k - 1), X(k), moved, motion)
                self.graph.add(between)
            for i in np.flatnonzero(data.visible[k]).tolist():
                angle, distance = data.readings[k, i]
                bearing = g.Rot2(angle)
                self.graph.add(
                    g.BearingRangeFactor2D(X(k), L(i), bearing, distance, reading)
                )
        for i, place in landmarks.items():
            self.start.insert(L(int(i)), g.Point2(*place))

    def optimise(self, tolerance: float | None = TOLERANCE) -> Any:
        """Solve the graph until its cost no longer falls, or to GTSAM's default."""
        settings = self.gtsam.LevenbergMarquardtParams()
        if tolerance is not None:
            settings.setRelativeErrorTol(tolerance)
            settings.setAbsoluteErrorTol(tolerance)
        optimiser = self.gtsam.LevenbergMarquardtOptimizer
        return optimiser(self.graph, self.start, settings).optimize()

    def with_covariances(self) -> None:
        """Solve, and compute the covariance of every pose and landmark."""
        solution = self.optimise()
        marginals = self.gtsam.Marginals(self.graph, solution)
        for key in solution.keys():  # noqa: SIM118 (no mapping)
            marginals.marginalCovariance(key)


def report(drive: Drive, data: Data, times: Any, names: list[str]) -> None:
    """Print the times of the cases, and their ratios."""
    print(f"{drive}, {data.visible.mean():.0%} visible")
    for name in names:
        print(f"{1e-3 * microseconds(times, name):10.1f} ms  {name}")
    slower = ratio(times, names[1], names[0])
    goal = verdict(slower, MOST_OF_A_FILTER, at_least=False)
    print(f"{slower:.1f} x the compiled filter (at most {MOST_OF_A_FILTER:g}): {goal}")
    for ours, theirs in zip(names[2:4], names[4:6], strict=False):
        faster = ratio(times, theirs, ours)
        goal = verdict(faster, LEAST_OF_GTSAM, at_least=True)
        print(f"{faster:.1f} x faster than GTSAM (at least {LEAST_OF_GTSAM:g}): {goal}")
    if DEFAULT in names:
        faster = ratio(times, DEFAULT, names[2])
        print(f"{faster:.1f} x faster than GTSAM at its default tolerance")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rounds", type=int, default=9)
    parser.add_argument("--seed", type=int, default=1)
    arguments = parser.parse_args()
    data = Data(arguments.seed)
    drive = data.drive()
    poses, landmarks = start_of(drive)

    def whole() -> None:
        found = smooth(data.drive())
        _ = found.pose_covariances, found.landmark_covariances

    def solved() -> None:
        smooth(drive, start=poses, landmarks=landmarks)

    def with_covariances() -> None:
        found = smooth(drive, start=poses, landmarks=landmarks)
        _ = found.pose_covariances, found.landmark_covariances

    cases: dict[str, Callable[[], object]] = {
        "compiled filter": data.filter,
        "smoother: record, filter twice, smooth, all covariances": whole,
        "smoother from a given start": solved,
        "smoother from a given start, all covariances": with_covariances,
    }
    try:
        peer = Gtsam(data, poses, landmarks)
    except ImportError:
        print("GTSAM is not installed: pip install -e '.[benchmark]'")
    else:
        cases["GTSAM batch from the same start"] = peer.optimise
        cases["GTSAM batch from the same start, all covariances"] = (
            peer.with_covariances
        )
        cases[DEFAULT] = lambda: peer.optimise(None)
    report(drive, data, time_interleaved(cases, rounds=arguments.rounds), list(cases))


if __name__ == "__main__":
    main()
