"""The same drive for GTSAM: its graph, its start, and its batch solution."""

import numpy as np
import pytest

gtsam = pytest.importorskip("gtsam", reason="needs gtsam, see extra peers")

X, L = gtsam.symbol_shorthand.X, gtsam.symbol_shorthand.L


def rotated(std, angle):
    """Covariance of motion noise in the frame of the new heading, as GTSAM takes it."""
    cos, sin = np.cos(angle), np.sin(angle)
    back = np.array([[cos, sin, 0], [-sin, cos, 0], [0, 0, 1]])
    return back @ np.diag(np.square(std)) @ back.T


def graph_of(moves, scans, motion_std, measurement_std, start_std, kernel=None):
    """Graph of odometry (d, α) between poses, and of scans [(z (m, 2), ids)].

    GTSAM takes noise at the new heading, and its ``BetweenFactor`` leaves a derivative
    out; the custom factor has the exact one.
    """
    graph = gtsam.NonlinearFactorGraph()
    prior = gtsam.noiseModel.Diagonal.Sigmas(np.asarray(start_std, dtype=float))
    graph.add(gtsam.PriorFactorPose2(X(0), gtsam.Pose2(), prior))
    for k, (d, alpha) in enumerate(moves, start=1):
        noise = gtsam.noiseModel.Gaussian.Covariance(rotated(motion_std, alpha))
        odometry = gtsam.Pose2(d, 0, alpha)
        graph.add(gtsam.CustomFactor(noise, [X(k - 1), X(k)], exact_between(odometry)))
    reading = gtsam.noiseModel.Diagonal.Sigmas(np.asarray(measurement_std, dtype=float))
    for k, (measurements, ids) in enumerate(scans):
        for (bearing, distance), i in zip(measurements, ids, strict=True):
            turn = gtsam.Rot2(bearing)
            graph.add(
                gtsam.BearingRangeFactor2D(X(k), L(int(i)), turn, distance, reading)
            )
    return graph


def exact_between(odometry):
    """Return the error measured⁻¹ (x⁻¹ y) with its exact derivatives."""

    def error(factor, values, jacobians):
        keys = factor.keys()
        first, second = values.atPose2(keys[0]), values.atPose2(keys[1])
        relative = first.between(second)
        difference = odometry.between(relative)
        if jacobians is not None:
            turn = np.eye(3)
            turn[:2, :2] = difference.rotation().matrix()
            jacobians[1] = turn
            jacobians[0] = -turn @ relative.inverse().AdjointMap()
        return np.array([difference.x(), difference.y(), difference.theta()])

    return error


def values_of(poses, landmarks):
    """Start of poses (N, 3) and a mapping of landmarks."""
    values = gtsam.Values()
    for k, pose in enumerate(poses):
        values.insert(X(k), gtsam.Pose2(*pose))
    for i, place in landmarks.items():
        values.insert(L(int(i)), gtsam.Point2(*place))
    return values


def solve(graph, values, tolerance=1e-14):
    """Batch solution by Levenberg-Marquardt."""
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setRelativeErrorTol(tolerance)
    parameters.setAbsoluteErrorTol(tolerance)
    parameters.setMaxIterations(100)
    return gtsam.LevenbergMarquardtOptimizer(graph, values, parameters).optimize()


def pose_of(solution, k):
    pose = solution.atPose2(X(k))
    return np.array([pose.x(), pose.y(), pose.theta()])


def world_covariance(marginals, solution, k):
    """Marginal of a pose, turned from its own frame into the world's."""
    turn = np.eye(3)
    turn[:2, :2] = solution.atPose2(X(k)).rotation().matrix()
    return turn @ marginals.marginalCovariance(X(k)) @ turn.T
