"""Filters take no number whose squares and products overflow."""

import warnings

import numpy as np
import pytest

from slamgym.arrays import LARGEST
from slamgym.estimator import list_estimators, make_batch, make_estimator
from slamgym.estimator.association.scan_assignments import Noise
from slamgym.estimator.association.tentative_landmarks import TentativeLandmarks

NOISE = {"motion_std": (0.1, 0.1, 0.1), "measurement_std": (0.1, 0.1)}


TOO_LARGE = {
    "initial_pose_std": (1e160, 0.0, 0.0),
    "initial_pose": (0.0, -2e12, 0.0),
    "motion_std": (0.1, 0.1, 1e13),
    "measurement_std": (1e200, 0.1),
    "range_std_per_metre": 1e9,
}
NO_DURATIONS = [
    (1e300, r"dt must not exceed 1e\+12, got 1e\+300"),
    (-1.0, "dt must be a finite number >= 0, got -1.0"),
    (float("nan"), "dt must be a finite number >= 0, got nan"),
    (None, "dt must be a finite number >= 0, got None"),
    ("1", "dt must be a finite number >= 0, got '1'"),
    (np.ones(2), "dt must be a finite number >= 0, got array"),
    (10**400, r"dt must not exceed 1e\+12, got 1000"),
]


@pytest.mark.parametrize("name", list_estimators())
def test_settings_and_durations_beyond_the_bound_are_refused_by_name(name):
    for key, value in TOO_LARGE.items():
        place = key.removeprefix("initial_")
        most = "1000" if key == "range_std_per_metre" else r"1e\+12"
        with pytest.raises(ValueError, match=rf"{place} must not exceed {most}, got"):
            make_estimator(name, **NOISE | {key: value})
    slam = make_estimator(name, **NOISE)
    for dt, message in NO_DURATIONS:
        with pytest.raises(ValueError, match=message):
            slam.predict((1.0, 0.0), dt=dt)


@pytest.mark.parametrize("name", list_estimators())
def test_the_largest_numbers_give_finite_beliefs(name):
    stds = {"motion_std": 3 * [LARGEST], "measurement_std": 2 * [LARGEST]}
    slam = make_estimator(
        name, **stds, initial_pose=3 * [LARGEST], initial_pose_std=3 * [LARGEST]
    )
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for _ in range(5):
            slam.predict((LARGEST, LARGEST), dt=LARGEST)
            slam.predict((LARGEST, 0.0), dt=LARGEST)
        belief = slam.belief()
    assert np.isfinite(belief.mean).all()
    assert np.isfinite(belief.covariance).all()


@pytest.mark.parametrize("reading", [(0.0, 1e200), (0.0, -1e200), (1e13, 1.0)])
@pytest.mark.parametrize("hypotheses", [1, 3])
def test_readings_without_identity_keep_the_bound(reading, hypotheses):
    slam = make_estimator("ekf", **NOISE, management={"hypotheses": hypotheses})
    slam.update([(0.0, 5.0)])
    with pytest.raises(ValueError, match=r"measurements must not exceed.* in row 1$"):
        slam.update([(0.0, 5.0), reading])
    assert slam.update([(0.0, LARGEST), (1.0, LARGEST)]).tentative_rows == (0, 1)


@pytest.mark.parametrize("distance", [1e9, 1e10, 1e11])
def test_the_odds_of_a_landmark_that_is_too_far_for_its_noise_are_finite(distance):
    noise = Noise(0.02, 0.1)
    for bearing in np.linspace(-3, 3, 50):
        first = np.array([[bearing, distance]])
        held = TentativeLandmarks().with_new(first, noise, np.zeros(1, int), 0.1)
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            again = np.array([0]), np.add(first, (0.02, 0.1)), noise, np.array([1e-3])
            held = held.with_sightings(*again)
        assert np.isfinite(held.odds).all()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"initial_poses": (1e13, 0.0, 0.0)}, "initial_poses must not exceed"),
        ({"initial_pose_std": (1e160, 0.0, 0.0)}, "initial_pose_std must not exceed"),
    ],
)
def test_a_batch_keeps_the_bound(changes, message):
    with pytest.raises(ValueError, match=message):
        make_batch("ekf", runs=2, landmarks=1, **NOISE, **changes)


@pytest.mark.parametrize("dt", [1e300, [1.0, 1e13], "x", [None, 1.0], [1.0, 1.0, 1.0]])
def test_a_batch_refuses_durations_by_name(dt):
    batch = make_batch("ekf", runs=1, landmarks=1, **NOISE)
    with pytest.raises(ValueError, match="dt must "):
        batch.run(np.zeros((1, 2, 2)), np.ones((1, 2, 1, 2)), np.ones((1, 2, 1)), dt=dt)
