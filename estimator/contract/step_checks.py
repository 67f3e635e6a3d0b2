"""Checks of interface, beliefs and reports of an estimator."""

import numpy as np

from ..interface import UpdateReport, differences_from_interface
from ..models.angles import wrap_angle
from .trial_drive import (
    LANDMARKS,
    Factory,
    checked_belief,
    drive,
    expect,
    make,
    same_beliefs,
    scan,
)


def check_interface(factory: Factory) -> None:
    """Check that all methods of the interface exist and accept its arguments."""
    estimator = make(factory, initial_pose=(0, 0, 0), initial_pose_std=(0, 0, 0))
    lacks = differences_from_interface(estimator)
    expect(not lacks, f"{type(estimator).__name__} has {'; '.join(lacks)}")


def check_start(factory: Factory) -> None:
    """Check the belief of a new estimator."""
    pose, std = (1.0, -2.0, 0.5), (0.1, 0.2, 0.3)
    estimator = make(factory, initial_pose=pose, initial_pose_std=std)
    belief = checked_belief(estimator)
    expect(
        np.allclose(belief.pose, pose) and belief.landmark_ids == (),
        f"belief() of a new estimator must be initial_pose and no landmark, got "
        f"{belief.pose} and landmarks {belief.landmark_ids}",
    )
    expect(
        np.allclose(belief.pose_covariance, np.diag(np.square(std))),
        "belief().pose_covariance of a new estimator must be diag(initial_pose_std²), "
        f"{np.diag(np.square(std)).tolist()}, got {belief.pose_covariance.tolist()}",
    )


def check_motion(factory: Factory) -> None:
    """Check the motion model and its noise."""
    estimator = make(factory, initial_pose=(0, 0, np.pi / 2))
    estimator.predict((2.0, 0.5))
    pose = checked_belief(estimator).pose
    expect(
        np.allclose(pose, (0, 2, np.pi / 2 + 0.5), atol=1e-6),
        "predict((d, α)) must drive d along the old heading, then turn by α: from "
        f"(0, 0, π/2), (2, 0.5) leads to (0, 2, π/2 + 0.5), got {pose}",
    )
    once, twice = make(factory), make(factory)
    once.predict((0.0, 0.0), dt=2.0)
    twice.predict((0.0, 0.0))
    twice.predict((0.0, 0.0))
    expect(
        np.allclose(once.belief().pose_covariance, twice.belief().pose_covariance),
        "predict(…, dt=2) must add the noise variance of two steps of dt=1",
    )
    expect(
        once.belief().pose_covariance[2, 2] > 0,
        "predict() must add motion noise to the covariance of the pose",
    )


def check_mapping(factory: Factory) -> None:
    """Check how landmarks enter the map."""
    estimator = make(factory)
    report = estimator.update(scan(np.zeros(3))[[2, 0]], [9, 4])
    expect(
        isinstance(report, UpdateReport),
        f"update() must return an UpdateReport, got {type(report).__name__}",
    )
    belief = checked_belief(estimator)
    expect(
        set(report.added_ids) == set(belief.landmark_ids) == {9, 4},
        "update() of ids 9 and 4 must map them and report them in added_ids, got map "
        f"{belief.landmark_ids} and added_ids {report.added_ids}",
    )
    order = [belief.landmark_ids.index(9), belief.landmark_ids.index(4)]
    expect(
        np.allclose(belief.landmarks[order], LANDMARKS[[2, 0]], atol=1e-3),
        "a landmark read exactly from a known pose must be mapped where it is: l = "
        f"(x + r cos(θ + β), y + r sin(θ + β)), got {belief.landmarks[order].tolist()}",
    )


def check_update(factory: Factory) -> None:
    """Check that an update fits the truth, and its report the scan."""
    estimator = make(factory)
    pose = drive(estimator, steps=20)
    belief = checked_belief(estimator)
    error = belief.pose - pose
    error[2] = wrap_angle(error[2])
    nees = float(error @ np.linalg.solve(belief.pose_covariance, error))
    expect(
        nees < 30,
        "after 20 easy steps the error of the pose must fit its covariance: NEES "
        f"below 30 (3 is expected), got {nees:.1f}",
    )
    report = estimator.update(scan(pose), range(4))
    expect(
        report.degrees_of_freedom == 8 and set(report.associated_ids) == set(range(4)),
        "update() must report the 4 readings used: associated_ids and 8 degrees of "
        f"freedom, got {report.associated_ids} and {report.degrees_of_freedom}",
    )
    expect(
        0 <= report.nis < 60,
        f"update().nis must be νᵀ S⁻¹ ν of 8 plausible readings, got {report.nis}",
    )
    after = estimator.belief()
    expect(
        np.trace(after.covariance) <= np.trace(belief.covariance) + 1e-12,
        "update() must not make the belief less certain",
    )


def check_second_reading(factory: Factory) -> None:
    """Read a landmark behind the robot from both sides of the jump of the bearing."""
    for bearing in (3.13, -3.13):
        estimator = make(factory)
        estimator.update([(bearing, 3.0)], [0])
        variance = np.trace(estimator.belief().covariance)
        nis = estimator.update([(-bearing, 3.0)], [0]).nis
        belief = estimator.belief()
        error = float(np.linalg.norm(belief.landmarks - (-3.0, 0.0)))
        expect(
            nis < 10 and error < 0.1,
            f"bearings {bearing} and {-bearing} rad are next to each other: update() "
            f"must wrap the innovation to [-π, π), got NIS {nis:.2g} and a landmark "
            f"{error:.2g} m off",
        )
        expect(
            np.trace(belief.covariance) < variance,
            "update() must make the belief more certain: a second reading of a "
            "landmark must shrink its covariance",
        )


def check_empty_scan(factory: Factory) -> None:
    """Check that a scan without readings changes nothing."""
    estimator = make(factory)
    drive(estimator, steps=2)
    before = estimator.belief()
    no_ids: tuple[list[int] | None, ...] = ([], None)
    for ids in no_ids:
        report = estimator.update(np.empty((0, 2)), ids)
        expect(
            same_beliefs(before, estimator.belief()) and report.degrees_of_freedom == 0,
            f"update() with no reading (ids {ids}) must leave the belief as it was",
        )
