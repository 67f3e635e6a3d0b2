import pickle
from dataclasses import replace

import numpy as np
import pytest
from comparison import digest
from numeric_jacobian import numeric_jacobian

from slamgym.estimator import EkfSlam, list_estimators, make_batch, make_estimator
from slamgym.estimator.filters.gaussian_map import move_pose
from slamgym.estimator.filters.imagine import imagine
from slamgym.estimator.map_management import ManagedSlam
from slamgym.estimator.models import motions
from slamgym.estimator.models.bearing_range import wrap_angle
from slamgym.estimator.models.model_checks import check_motion
from slamgym.estimator.models.motions import (
    Motion,
    bicycle,
    differential,
    find_motion,
    predict_pose,
)
from slamgym.estimator.models.rigid_motion import composed_jit, rotation
from slamgym.estimator.smoother.recorded_slam import SmoothingSlam
from slamgym.sim_configs import load_scenario


@pytest.mark.parametrize("heading", [-2.5, 0.0, 0.7, 3.1])
@pytest.mark.parametrize("odometry", [(0.8, -0.3), (-1.5, 0.0), (0.8, -0.4, 2.0)])
def test_pose_jacobian_equals_central_differences(heading, odometry):
    pose = np.array([1.0, -2.0, heading])
    numeric = numeric_jacobian(lambda p: predict_pose(p, np.array(odometry)).pose, pose)
    np.testing.assert_allclose(
        predict_pose(pose, np.array(odometry)).jacobian_pose, numeric, atol=1e-7
    )


def test_noise_jacobian_equals_central_differences():
    pose, (d, turn) = np.array([1.0, -2.0, 0.7]), (0.8, -0.3)

    def moved(noise):
        along, across, turned = noise
        x, y, heading = pose
        return np.array(
            [
                x + (d + along) * np.cos(heading) - across * np.sin(heading),
                y + (d + along) * np.sin(heading) + across * np.cos(heading),
                heading + turn + turned,
            ]
        )

    np.testing.assert_allclose(
        predict_pose(pose, np.array([d, turn])).jacobian_noise,
        numeric_jacobian(moved, np.zeros(3)),
        atol=1e-8,
    )


def test_the_robot_drives_before_it_turns():
    pose = predict_pose(np.array([0.0, 0.0, np.pi / 2]), np.array([2.0, 1.0])).pose
    np.testing.assert_allclose(pose, [0.0, 2.0, np.pi / 2 + 1.0], atol=1e-15)


@pytest.mark.parametrize("heading", [-2.5, 0.0, 0.7, 3.1, 40.0])
@pytest.mark.parametrize(
    "moved", [(0.8, 0.0, -0.3), (-1.5, 0.2, 0.0), (0.0, -1.0, 2.0)]
)
def test_the_compiled_equation_equals_value_and_jacobians(heading, moved):
    pose, (dx, dy, _) = np.array([1.0, -2.0, heading]), moved
    expected = predict_pose(pose, np.array(moved))
    *after, cos, sin = composed_jit(*pose.tolist(), *moved)
    np.testing.assert_allclose(after, expected.pose, rtol=1e-15)
    G, F = np.eye(3), np.eye(3)
    G[:2, 2] = -(dx * sin + dy * cos), dx * cos - dy * sin
    F[:2, :2] = (cos, -sin), (sin, cos)
    np.testing.assert_allclose(G, expected.jacobian_pose, rtol=1e-15)
    np.testing.assert_allclose(F, expected.jacobian_noise, rtol=1e-15)


def test_an_angle_just_below_minus_pi_stays_in_the_interval():
    below = np.nextafter(-np.pi, -4.0)
    assert wrap_angle(below) == -np.pi
    assert wrap_angle(np.array([below, 4.0])) == pytest.approx(
        [-np.pi, 4.0 - 2 * np.pi], abs=1e-15
    )


# --------------------------------------------------------------------------------------
# Drives as values.

NOISE = {"motion_std": (0.03, 0.02, 0.02), "measurement_std": (0.02, 0.05)}

CAR = bicycle(2.8, reference=(3.7, 0.5))
DRIVES = [motions.UNICYCLE, differential(0.4), bicycle(0.6), bicycle(1, (0, 2)), CAR]


def rolled(wheel_speeds, point, steps=20_000):
    """Integrate a body that rolls at (v, ω) of its axle; return where a point goes."""
    speed, rate = wheel_speeds
    x = y = heading = 0.0
    for _ in range(steps):
        middle = heading + rate / steps / 2
        x, y = x + speed / steps * np.cos(middle), y + speed / steps * np.sin(middle)
        heading += rate / steps
    (a, b), cos, sin = point, np.cos(heading), np.sin(heading)
    return x + cos * a - sin * b - a, y + sin * a + cos * b - b, heading


def test_a_differential_drive_rolls_on_its_wheels():
    left, right, width = 0.9, 1.3, 0.4
    expected = rolled(((left + right) / 2, (right - left) / width), (0.0, 0.0))
    found = differential(width).displacement(left, right)
    np.testing.assert_allclose(found, expected, atol=1e-8)


def test_a_bicycle_rolls_on_its_rear_axle_and_carries_its_sensor():
    distance, steering = -1.7, 0.4
    rate = distance * np.tan(steering) / 2.8
    expected = rolled((distance, rate), (3.7, 0.5))
    np.testing.assert_allclose(
        CAR.displacement(distance, steering), expected, atol=1e-8
    )


@pytest.mark.parametrize("motion", DRIVES)
def test_a_drive_passes_its_check_and_is_found_by_its_name(motion):
    check_motion(motion)
    check_motion(motion, trials=0)  # at rest only
    assert find_motion(motion.name) == motion
    assert pickle.loads(pickle.dumps(motion)) == motion


@pytest.mark.parametrize(
    ("displacement", "mistake"),
    [
        (lambda a, b: (a, 0 * a, np.divide(b, 1.0 * (a == 0))), "finite"),
        (lambda a, b: (a, 0 * a, np.sum(b)), "arrays"),
        (lambda a, b: (a, 0 * a, np.sign(b)), "smooth"),
    ],
)
def test_the_check_names_the_mistake(displacement, mistake):
    wrong = Motion("wrong", ("a", "b"), ("m", "m"), displacement)
    with np.errstate(all="ignore"), pytest.raises(ValueError, match=mistake):
        check_motion(wrong)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"columns": ("a",)}, "columns of motion 'unicycle' must name the two numbers"),
        ({"units": ("m", "m", "rad")}, "units of motion 'unicycle' must name the two"),
        ({"displacement": 3}, "displacement of motion 'unicycle' must be a function"),
        ({"displacement": lambda d, a: (d / a, 0, a)}, "got float division by zero"),
        ({"displacement": lambda a, b: (a, b)}, "must return"),
        ({"displacement": lambda a: (a, a, a)}, "must return"),
        ({"displacement": lambda a, b: a}, "must return"),
        ({"displacement": lambda a, b: (a + 0.1, 0, b)}, r"and zeros .* got \[0.1, 0"),
        ({"displacement": lambda a, b: (np.nan, a, b)}, r"and zeros .* got \[nan"),
    ],
)
def test_a_motion_whose_parts_do_not_fit_is_refused_when_built(change, message):
    with pytest.raises(ValueError, match=message):
        replace(motions.UNICYCLE, **change)


@pytest.mark.parametrize(
    ("label", "message"),
    [
        ("differntial", "did you mean 'differential'"),
        ("differential", "track_width"),
        ("differential[track_width=0]", "track_width must be"),
        ("bicycle[wheelbase=1, reference=[1]]", "reference must be"),
        ("bicycle[wheelbase", "must be like|must be one of"),
    ],
)
def test_a_wrong_label_is_refused(label, message):
    with pytest.raises(ValueError, match=message):
        find_motion(label)


def test_a_reading_without_a_finite_displacement_is_refused():
    blows_up = Motion("blows_up", ("a", "b"), ("", ""), lambda a, b: (a, b, 1e300 * a))
    with pytest.raises(ValueError, match="finite displacement"):
        blows_up.moved((1.0, 0.0))
    assert motions.UNICYCLE.moved((1.0, 0.2)) == (1.0, 0.0, 0.2)


class Trusting(EkfSlam):
    """A filter that checks nothing."""

    def predict(self, odometry, dt=1.0):
        moved = self.motion.displacement(*odometry)
        move_pose(self.map.block, *map(float, moved), dt)


@pytest.mark.parametrize("association", ["joint", "hypotheses"])
@pytest.mark.parametrize("confirm", [(1, 1), (2, 2)])
def test_a_managed_filter_refuses_a_displacement_that_its_filter_would_take(
    association, confirm
):
    blows_up = Motion("blows_up", ("a", "b"), ("", ""), lambda a, b: (a, b, 1e300 * a))
    management = {"association": association, "confirm": confirm}
    options = {"management": management, "motion": blows_up}
    slam = ManagedSlam(Trusting, (0.1, 0.1, 0.1), (0.1, 0.1), **options)
    slam.update([(0.5, 2.0)])
    before = digest(slam)
    with pytest.raises(ValueError, match="finite displacement with motion 'blows_up'"):
        slam.predict((1.0, 0.0))
    assert digest(slam) == before
    slam.predict((0.0, 0.5))
    assert digest(slam) != before


def car_drive(steps=25):
    """Yield odometry of a car, and readings of five of eight landmarks."""
    rng = np.random.default_rng(0)
    landmarks, pose = rng.uniform(-4, 4, (8, 2)), np.zeros(3)
    for _ in range(steps):
        odometry = rng.uniform((-0.1, -0.6), (0.3, 0.6))
        moved = np.array(CAR.displacement(*odometry))
        pose[:2] += rotation(pose[2]) @ moved[:2]
        pose[2] += moved[2]
        ids = rng.permutation(8)[:5]
        x, y = ((landmarks[ids] - pose[:2]) @ rotation(pose[2])).T
        readings = np.column_stack([np.arctan2(y, x), np.hypot(x, y)])
        yield odometry, readings + rng.normal(size=(5, 2)) * (0.02, 0.05), ids.tolist()


def move_as_unicycle(slam, odometry, dt):
    """Move as a car, by unicycle readings: turn, drive and turn back, then the turn."""
    dx, dy, turn = map(float, CAR.displacement(*odometry))
    aside = np.arctan2(dy, dx)
    slam.predict((0.0, aside), 0.0)
    slam.predict((np.hypot(dx, dy), -aside), 0.0)
    slam.predict((0.0, turn), dt)


@pytest.mark.parametrize("name", [*list_estimators(), "managed", "smoother"])
def test_every_filter_takes_the_odometry_of_a_car(name):
    make = {
        "managed": lambda **given: make_estimator("ekf", management=True, **given),
        "smoother": SmoothingSlam,
    }.get(name, lambda **given: make_estimator(name, **given))
    car, unicycle = make(**NOISE, motion=CAR.name), make(**NOISE)
    for odometry, readings, ids in car_drive():
        car.predict(odometry, 0.7)
        move_as_unicycle(unicycle, odometry, 0.7)
        for slam in (car, unicycle):
            slam.update(readings, None if name == "managed" else ids)
    if name == "smoother":
        car, unicycle = car.smoothed(), unicycle.smoothed()
        np.testing.assert_allclose(car.poses, unicycle.poses, atol=1e-9)
    found, expected = car.belief(), unicycle.belief()
    np.testing.assert_allclose(found.mean, expected.mean, atol=1e-9)
    np.testing.assert_allclose(found.covariance, expected.covariance, atol=1e-9)


def test_a_batch_takes_the_odometry_of_a_car():
    odometry, readings, ids = map(np.array, zip(*car_drive(), strict=True))
    slam = make_estimator("invariant", **NOISE, motion=CAR)
    batch = make_batch("invariant", runs=1, landmarks=8, **NOISE, motion=CAR)
    measurements, visible = np.zeros((1, 25, 8, 2)), np.zeros((1, 25, 8), bool)
    for step in range(25):
        slam.predict(odometry[step])
        slam.update(readings[step], ids[step])
        measurements[0, step, ids[step]], visible[0, step, ids[step]] = (
            readings[step],
            True,
        )
    trace = batch.run(odometry[None], measurements, visible)
    np.testing.assert_allclose(trace.poses[0, -1], slam.belief().pose, atol=1e-12)


def test_noise_at_rest_goes_by_the_displacement():
    slam = make_estimator("ekf", **NOISE, motion=CAR, noise_at_rest=False)
    slam.predict((0.0, 0.3))  # a car that steers at rest
    assert not slam.belief().pose_covariance.any()


def test_plans_of_another_drive_are_refused():
    slam = make_estimator("ekf", **NOISE, motion=CAR)
    with pytest.raises(ValueError, match="imagine takes the odometry of a unicycle"):
        imagine(slam, [np.zeros((2, 2))], load_scenario("loop").sensor)


@pytest.mark.parametrize("path", ["nowhere:CAR", "slamgym.sim_configs:CAR", "torn:CAR"])
def test_a_drive_that_cannot_be_imported_is_named(path, tmp_path, monkeypatch):
    (tmp_path / "torn.py").write_text("CAR = 1 / 0")
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(ValueError, match=f"cannot import motion '{path}'"):
        find_motion(path)
