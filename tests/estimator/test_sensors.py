"""Sensors as values: slopes, kernels against the dense oracle, and the check."""

import math
import pickle
from dataclasses import replace
from functools import cache

import dense_family
import numpy as np
import pytest
from camera import AHEAD
from comparison import assert_close_beliefs, assert_same_bits, digest
from dense_ekf import DenseEkf
from far_origins import far_origins, rounding, shifted
from numeric_jacobian import numeric_jacobian
from own_noise import OWN_NOISE
from scipy.optimize import least_squares

from slamgym.argument_checks import LOWEST_ID
from slamgym.estimator import (
    InvariantEkfSlam,
    make_batch,
    make_estimator,
    register_estimator,
)
from slamgym.estimator.filters import delayed_landmarks
from slamgym.estimator.filters.delayed_landmarks import MOST_POSES, SeenLandmark
from slamgym.estimator.filters.imagine import imagine
from slamgym.estimator.models import bearing_range
from slamgym.estimator.models.model_checks import SensorContractError, check_sensor
from slamgym.estimator.models.sensor_kernels import kernel_parts
from slamgym.estimator.models.sensors import (
    BEARING,
    BEARING_RANGE,
    POSITION,
    RANGE,
    SENSORS,
    Sensor,
    find_sensor,
    read_bearing_range,
)
from slamgym.experiments.run_and_replay.simulated_runs import simulate_runs
from slamgym.sim_configs import load_scenario

MOTION = 0.05, 0.03, 0.02
STD = {
    "bearing_range": (0.03, 0.1),
    "position": (0.1, 0.2),
    "bearing": (0.03,),
    "range": (0.1,),
}
LANDMARKS = np.array([[4.0, 1.0], [-3.0, 2.0], [1.0, -5.0], [-6.0, -2.0], [3.0, 6.0]])
ORACLES = {
    "ekf": DenseEkf,
    "invariant[iterations=1]": dense_family.DenseInvariant,
    "invariant": dense_family.DenseAdaptiveInvariant,
    "first_estimates": dense_family.DenseFirstEstimates,
    "observability_constrained": dense_family.DenseConstrained,
    "iterated": dense_family.DenseIterated,
    "unscented": dense_family.DenseUnscented,
}
# a copy of the default sensor, for which kernels are made like for any other
COPY = replace(BEARING_RANGE, name="copy")


def made(label, std, **options):
    return make_estimator(label, motion_std=MOTION, measurement_std=std, **options)


def reading(sensor, pose, landmarks, rng, noise=1.0):
    z = sensor.predict(pose, landmarks).measurement
    if not noise:
        return z
    std = np.resize((*STD.get(sensor.name, (0.03, 0.1)), 0.0), 2)
    return z + noise * rng.normal(size=z.shape) * std


@pytest.mark.parametrize("sensor", SENSORS.values(), ids=SENSORS)
def test_jacobians_equal_central_differences_in_1000_places(sensor):
    rng = np.random.default_rng(1)
    pose = np.array([1.0, -2.0, 2.5])
    points = pose[:2] + rng.choice([-1, 1], (1000, 2)) * rng.uniform(0.3, 20, (1000, 2))
    found, at = sensor.predict(pose, points), sensor.predict(pose, points).measurement
    numeric = numeric_jacobian(
        lambda p: sensor.difference(sensor.predict(p, points).measurement, at), pose
    )
    np.testing.assert_allclose(found.jacobian_pose, numeric, atol=1e-7)
    for axis in (0, 1):
        shift = 1e-6 * np.eye(2)[axis]
        ahead, behind = sensor.predict(pose, points + shift), points - shift
        apart = sensor.difference(
            ahead.measurement, sensor.predict(pose, behind).measurement
        )
        numeric = apart / 2e-6
        np.testing.assert_allclose(
            found.jacobian_landmark[:, :, axis], numeric, atol=1e-7
        )


@pytest.mark.parametrize("sensor", [*SENSORS.values(), COPY], ids=lambda s: s.name)
def test_the_compiled_parts_equal_the_jacobians(sensor):
    rng, parts = np.random.default_rng(2), kernel_parts(sensor)
    expected = parts[bearing_range.expected_reading_jit]
    slopes = parts[bearing_range.pose_slopes_jit]
    for _ in range(100):
        pose, point = rng.normal(size=3) * 3, rng.normal(size=2) * 9
        dx, dy = (point - pose[:2]).tolist()
        slow = sensor.predict(pose, point[None])
        fast = np.array(expected(dx, dy, pose[2]))
        np.testing.assert_allclose(
            sensor.difference(fast, slow.measurement[0]), 0, atol=1e-12
        )
        ax, ay, bx, by, a_turn, b_turn = slopes(dx, dy, pose[2])
        Hl = slow.jacobian_landmark[0]
        np.testing.assert_allclose([[ax, ay], [bx, by]], Hl, atol=1e-12)
        turned = slow.jacobian_pose[0, :, 2]
        np.testing.assert_allclose([a_turn, b_turn], turned, atol=1e-12)


@pytest.mark.parametrize(
    "sensor", [BEARING_RANGE, POSITION, COPY], ids=lambda s: s.name
)
def test_one_reading_places_a_landmark(sensor):
    rng = np.random.default_rng(3)
    placed = kernel_parts(sensor)[bearing_range.placed_jit]
    pose, variances = np.array([1.0, -2.0, 2.5]), (0.3, 0.7)
    for point in rng.normal(size=(20, 2)) * 9:
        z = sensor.predict(pose, point[None]).measurement
        slow = sensor.locate(pose, z)
        np.testing.assert_allclose(slow.position[0], point, atol=1e-12)
        assert sensor.distances(z) == pytest.approx(np.hypot(*(point - pose[:2])))
        numeric = numeric_jacobian(lambda p, z=z: sensor.locate(p, z).position, pose)
        np.testing.assert_allclose(slow.jacobian_pose, numeric, atol=1e-7)
        x, y, tx, ty, xx, more_xx, xy, yy, more_yy = placed(
            tuple(pose), *z[0], *variances
        )
        np.testing.assert_allclose([x, y], point, atol=1e-12)
        np.testing.assert_allclose([tx, ty], slow.jacobian_pose[0, :, 2], atol=1e-12)
        Fz = slow.jacobian_measurement[0]
        noise = Fz @ np.diag(variances) @ Fz.T
        found = [[xx + more_xx, xy], [xy, yy + more_yy]]
        np.testing.assert_allclose(found, noise, rtol=1e-10, atol=1e-12)


@pytest.mark.parametrize("sensor", SENSORS.values(), ids=SENSORS)
@pytest.mark.parametrize("label", ORACLES)
def test_every_filter_equals_the_dense_oracle(label, sensor):
    """Begin with four mapped landmarks, so that no reading has to place one."""
    rng = np.random.default_rng(4)
    std = STD.get(sensor.name, STD["bearing_range"])
    start = made(label, (0.03, 0.1), initial_pose_std=(0.1, 0.1, 0.1))
    start.update(reading(BEARING_RANGE, np.zeros(3), LANDMARKS[:4], rng), range(4))
    slam = made(label, std, sensor=sensor)
    slam.load_state_dict(start.state_dict())
    slow = ORACLES[label](MOTION, std)
    slow.sensor, slow.ids = sensor, [0, 1, 2, 3]
    slow.mean, slow.P = start.map.mean[:11].copy(), start.map.covariance[:11, :11]
    slow.fixed = start.map.reference[:11].copy()
    is_invariant = isinstance(slow, dense_family.DenseInvariant)
    if is_invariant:
        slow.P = slow.to_invariant() @ slow.P @ slow.to_invariant().T
    pose, seen = np.zeros(3), 4
    for step in range(8):
        u = np.array([0.4, 0.5])
        pose = pose + np.array([u[0] * np.cos(pose[2]), u[0] * np.sin(pose[2]), u[1]])
        for each in (slam, slow):
            each.predict(u + 0.01)
        if sensor.places and step == 4:
            seen = 5
        z = reading(sensor, pose, LANDMARKS[:seen], rng)
        report = slam.update(z, range(seen))
        nis = slow.update(z, list(range(seen)))
        assert report.nis == pytest.approx(nis, rel=1e-7)
        used = min(seen, 4) if step == 4 else seen
        assert report.degrees_of_freedom == used * sensor.size
    n = len(slow.mean)
    np.testing.assert_allclose(slam.map.mean[:n], slow.mean, atol=1e-9)
    P = slow.covariance if is_invariant else slow.P
    np.testing.assert_allclose(slam.map.covariance[:n, :n], P, atol=1e-10)


@pytest.mark.parametrize("label", ["ekf", "invariant", "robocentric", "submaps"])
def test_the_default_sensor_made_as_ones_own_gives_the_same_belief(label):
    rng = np.random.default_rng(5)
    noise = {"motion_std": MOTION, "measurement_std": (0.03, 0.1), "min_range": 0.5}
    noise |= {"range_std_per_metre": 0.02, "bearing_std_metres": 0.1}
    sensors = BEARING_RANGE, OWN_NOISE
    both = [make_estimator(label, **noise, sensor=sensor) for sensor in sensors]
    for _ in range(6):
        z = reading(BEARING_RANGE, np.zeros(3), LANDMARKS, rng)
        for slam in both:
            slam.predict((0.1, 0.05))
            slam.update(z, range(5))
    one, other = (slam.belief() for slam in both)
    assert_close_beliefs(one, other, 1e-11, 1e-12)


@pytest.mark.parametrize("label", ["compressed", "submaps", "robocentric"])
def test_filters_of_large_maps_take_positions(label):
    rng, pose = np.random.default_rng(6), np.zeros(3)
    slam, ekf = (made(name, (0.1, 0.2), sensor="position") for name in (label, "ekf"))
    for _ in range(10):
        pose = pose + np.array([0.2 * np.cos(pose[2]), 0.2 * np.sin(pose[2]), 0.1])
        z = reading(POSITION, pose, LANDMARKS, rng)
        for each in (slam, ekf):
            each.predict((0.2, 0.1))
            each.update(z, range(5))
    error = slam.belief().mean - ekf.belief().mean
    tolerance = 1e-10 if label == "compressed" else 0.1  # others linearise elsewhere
    assert np.abs(error).max() < tolerance


def test_a_batch_has_the_bits_of_single_filters():
    rng = np.random.default_rng(7)
    noise = {"motion_std": MOTION, "measurement_std": (0.1, 0.2), "sensor": "position"}
    batch = make_batch("invariant", runs=2, landmarks=5, **noise)
    u = rng.normal(size=(2, 6, 2)) * 0.3
    z = LANDMARKS + rng.normal(size=(2, 6, 5, 2)) * 0.1
    visible = rng.random((2, 6, 5)) < 0.7
    trace = batch.run(u, z, visible)
    for run in (0, 1):
        slam = make_estimator("invariant", **noise)
        for t in range(6):
            slam.predict(u[run, t])
            seen = np.flatnonzero(visible[run, t])
            report = slam.update(z[run, t, seen], seen)
            assert trace.degrees_of_freedom[run, t] == report.degrees_of_freedom
        np.testing.assert_array_equal(batch.belief(run).mean, slam.belief().mean)
        covariance = slam.belief().covariance
        np.testing.assert_array_equal(batch.belief(run).covariance, covariance)


def test_imagined_plans_expect_the_readings_of_the_sensor():
    slam = made("ekf", (0.1, 0.2), sensor="position")
    slam.update(LANDMARKS, range(5))
    world = type("World", (), {"min_range": 0.1, "max_range": 99.0, "dropout": 0.0})
    world.field_of_view, world.occlusion = 7.0, False
    imagined = imagine(slam, [[(0.3, 0.1)] * 3], world)
    for _ in range(3):
        slam.predict((0.3, 0.1))
        belief = slam.belief()
        z = POSITION.predict(belief.pose, belief.landmarks).measurement
        slam.update(z, range(5))
    np.testing.assert_allclose(
        imagined.pose_covariances[0, 0, -1], slam.belief().pose_covariance, atol=1e-12
    )


@pytest.mark.parametrize("sensor", [BEARING, RANGE], ids=lambda s: s.name)
def test_the_void_number_changes_nothing(sensor):
    """Whatever stands in it, and in one column or two."""
    start = made("ekf", (0.03, 0.1))
    start.update([(0.3, 4.0), (-2.0, 3.0)], [0, 1])
    beliefs = []
    for second in (0.0, 5.0, None):
        slam = made("ekf", (0.1, 3.0), sensor=sensor)
        slam.load_state_dict(start.state_dict())
        slam.predict((0.3, 0.2))
        z = sensor.predict(np.zeros(3), np.array([[4.0, 1.0], [-1.0, -3.0]]))
        z = z.measurement + 0.05
        z = z[:, :1] if second is None else np.column_stack([z[:, 0], [second] * 2])
        report = slam.update(z, [0, 1])
        assert (report.innovation[:, 1] == 0).all()
        beliefs.append(slam.belief())
    for belief in beliefs[1:]:
        assert_same_bits(belief, beliefs[0])


def test_the_deviations_of_a_reading_depend_on_the_range():
    sensor = BEARING_RANGE.with_noise(range_std_per_metre=0.05, bearing_std_metres=0.2)
    expected = [(0.07, 0.3), (0.045, 0.5)]
    np.testing.assert_allclose(sensor.stds((0.02, 0.1), np.array([4.0, 8.0])), expected)


def test_bearings_are_wrapped_behind_the_robot():
    start = made("ekf", (0.03, 0.1))
    start.update([(np.pi - 0.001, 4.0)], [0])
    for label in ("ekf", "unscented"):
        slam = made(label, (0.1,), sensor="bearing")
        state = start.state_dict() | {"estimator": np.array(type(slam).__name__)}
        slam.load_state_dict(state)
        report = slam.update([(-np.pi + 0.001,)], [0])
        assert report.innovation[0, 0] == pytest.approx(0.002, abs=1e-4)


def test_the_gate_of_one_number_rejects_its_share():
    rng, rejected = np.random.default_rng(8), 0
    start = make_estimator("ekf", motion_std=MOTION, measurement_std=(1e-6, 1e-6))
    start.update([(0.0, 4.0)], [0])
    slam = made("ekf", (0.1,), sensor="range", gate_probability=0.9)
    for _ in range(500):
        slam.load_state_dict(start.state_dict())
        rejected += len(slam.update([(4.0 + 0.1 * rng.normal(),)], [0]).rejected_ids)
    assert 25 <= rejected <= 80  # 50 expected, σ = 6.7


def test_a_registered_sensor_is_equal_after_pickling():
    for sensor in SENSORS.values():
        assert pickle.loads(pickle.dumps(sensor)) == sensor
    grown = pickle.loads(pickle.dumps(RANGE.with_noise(range_std_per_metre=0.3)))
    assert grown == RANGE
    assert grown.range_std_per_metre == 0.3
    slam = made("ekf", (0.1, 0.1), sensor="position")
    slam.update(LANDMARKS, range(5))
    copy = pickle.loads(pickle.dumps(slam))
    for each in (slam, copy):
        each.update(LANDMARKS + 0.1, range(5))
    np.testing.assert_array_equal(copy.belief().mean, slam.belief().mean)


def test_sensors_are_found_by_name_and_by_path():
    module = "slamgym.estimator.models.sensors"
    found = find_sensor("position"), find_sensor(f"{module}:POSITION")
    assert found[0] is found[1] is find_sensor(POSITION)
    path = f"{module}:read_range"
    for name, message in (
        ("postion", "unknown sensor 'postion'; did you mean 'pos"),
        ("nowhere:X", "cannot import sensor 'nowhere:X': ModuleNot"),
        ("nowhere:X", r"in the folder of nowhere\.py, or set PYTHON"),
        (path, f"'{path}' is a function, not a Sensor"),
    ):
        with pytest.raises(ValueError, match=message):
            find_sensor(name)


NOISE = {"motion_std": MOTION, "measurement_std": (0.1, 0.1)}


def test_parts_without_sensors_refuse_them_in_a_sentence():
    for option in ({"sensor": "position"}, {"landmark_init": "delayed"}):
        with pytest.raises(ValueError, match="ideal filter accepts only sensor 'bear"):
            make_estimator("ideal", **NOISE, **option)
        with pytest.raises(ValueError, match="data association accepts only sensor 'b"):
            make_estimator("ekf", **NOISE, **option, management=True)


@pytest.mark.parametrize(
    ("name", "part"),
    [
        ("robocentric", "the robocentric filter"),
        ("compressed", "the compressed filter"),
        ("submaps", "a submap"),
    ],
)
def test_filters_that_do_not_wait_refuse_a_sensor_that_makes_them(name, part):
    rule = f"^{part} needs a sensor whose single reading locates a landmark, got "
    with pytest.raises(ValueError, match=f"{rule}'range'"):
        make_estimator(name, **NOISE, sensor="range")
    with pytest.raises(ValueError, match=rf"{rule}'bearing_range \(delayed\)'"):
        make_estimator(name, **NOISE, landmark_init="delayed")
    with pytest.raises(ValueError, match="a batch needs a sensor whose"):
        make_batch("ekf", runs=1, landmarks=1, **NOISE, sensor="bearing")


@pytest.mark.parametrize(
    ("option", "message"),
    [
        ({"range_noise_at": "reading"}, "must be 'expected': one reading does not"),
        ({"measurement_std": (0.1, 0.1, 0.1)}, "measurement_std must be 2 finite"),
    ],
)
def test_noise_that_a_sensor_does_not_have_is_refused(option, message):
    with pytest.raises(ValueError, match=message):
        make_estimator("ekf", **(NOISE | option), sensor="range")
    with pytest.raises(ValueError, match=r"'position': .* the same at every"):
        make_estimator("ekf", **NOISE, sensor="position", range_std_per_metre=0.1)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"h": None}, "'copy': h must be a function, got None"),
        ({"h": lambda x, y: (x, y)}, "h must return"),
        ({"h": lambda x, y: ((x, y), (1.0, 0.0, 0.0))}, "h must return"),
        ({"h": lambda x: ((x, x), (1.0, 0.0, 0.0, 1.0))}, "h must return"),
        ({"inverse": 3}, "inverse must be a function, got 3"),
        (
            {"inverse": lambda z0, z1: (z0, z1, 0.0)},
            r"inverse must return \(x, y\): too",
        ),
        ({"std": (0.1, 0.2)}, "std must be a function"),
        ({"std": lambda noise, distance: noise[:1]}, "std must return two finite"),
        ({"std": lambda noise, distance: (noise[0], -1.0)}, "two finite numbers > 0"),
        ({"std": lambda noise, distance: (np.inf, 1.0)}, "std must return two finite"),
        ({"angles": (True,)}, "angles must have one entry for each column"),
        ({"units": ("rad",)}, "columns and units must name the same"),
        ({"columns": ("a", "b", "c")}, "columns and units must name the same"),
        ({"range_noise_at": "true"}, "range_noise_at must be 'expected' or 'reading'"),
        ({"range_std_per_metre": "x"}, "range_std_per_metre must be a finite number"),
        ({"range_std_per_metre": -1.0}, "range_std_per_metre must be a finite"),
        ({"range_std_per_metre": 1001.0}, r"range_std_per_metre .*, got 1001"),
        ({"bearing_std_metres": -1.0}, "bearing_std_metres must be a finite number"),
    ],
)
def test_a_sensor_whose_parts_do_not_fit_is_refused_when_built(change, message):
    with pytest.raises(ValueError, match=message):
        replace(COPY, **change)
    with pytest.raises(ValueError, match="inverse must be None"):
        replace(BEARING, inverse=mirrored)


def test_names_of_a_sensor_may_be_lists():
    names = {name: list(getattr(COPY, name)) for name in ("columns", "units", "angles")}
    lists = replace(COPY, **names)
    assert lists == COPY
    assert hash(lists) == hash(COPY)


def test_a_users_filter_that_names_the_numbers_of_the_noise_gets_them(own_registry):
    class Named(InvariantEkfSlam):
        def __init__(self, *args, range_std_per_metre=0.0, **settings):
            self.named = range_std_per_metre
            super().__init__(*args, **settings)

    register_estimator("named", Named)
    made = make_estimator(
        "named", **NOISE, range_std_per_metre=0.2, bearing_std_metres=0.1
    )
    assert made.named == 0.2
    assert made.sensor.noise((1, 1)) == (1, 1, 0.0, 0.1)


@pytest.mark.parametrize("sensor", [*SENSORS.values(), COPY], ids=lambda s: s.name)
def test_the_shipped_sensors_pass_the_check(sensor):
    check_sensor(sensor)


def wrong_slope(x, y):
    z, (ax, ay, bx, by) = read_bearing_range(x, y)
    return z, (ax, ay, bx, -by)


def void_slope(x, y):
    z, (ax, ay, _, _) = read_bearing_range(x, y)
    return (z[0], 0.0), (ax, ay, 1.0, 0.0)


def from_behind(x, y):
    (bearing, r), slopes = read_bearing_range(x, y)
    return (bearing + (2 * np.pi * (bearing < -0.7) - np.pi), r), slopes


def by_math(x, y):
    _, slopes = read_bearing_range(x, y)
    return (math.atan2(y, x), math.hypot(x, y)), slopes


def mirrored(bearing, distance):
    return distance * np.cos(bearing), -distance * np.sin(bearing)


def negative_std(noise, distance):
    return noise[0], noise[1] + 1 - distance


BOTH = (True, True)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"h": wrong_slope}, r"∂range/∂y at .* is -0\.9\d* by .* but h returns 0\.9"),
        ({"inverse": mirrored}, "inverse of the reading of"),
        ({"angles": ()}, "bearing jumps by 2π around the robot: set its"),
        ({"angles": (), "h": from_behind, "field_of_view": 1.5}, "bearing jumps by 2π"),
        ({"std": negative_std}, "std must return two finite numbers > 0"),
        ({"h": by_math}, "h must accept arrays: .* not of m"),
        ({"angles": BOTH}, "range has the unit 'm', but only radians are wr"),
        (
            {"angles": BOTH, "units": ("rad", "rad")},
            "range varies by .* and never jumps by 2π",
        ),
    ],
)
def test_check_sensor_names_what_is_wrong(change, message):
    with pytest.raises(SensorContractError, match=message):
        check_sensor(replace(COPY, **change))


@pytest.mark.parametrize("focal_length", [1.0, 500.0, 750.0])
def test_check_sensor_does_not_take_the_pole_of_a_camera_for_a_turn(focal_length):
    def column(x, y):
        return (focal_length * y / x, 0.0), (
            *(-focal_length * y / (x * x), focal_length / x),
            *(0.0, 0.0),
        )

    check_sensor(Sensor("camera", ("column",), ("px",), column))


def test_a_camera_is_checked_in_its_field_of_view_only():
    whole = replace(AHEAD, field_of_view=2 * math.pi)
    with pytest.raises(SensorContractError, match=r"inverse of the reading of \(-"):
        check_sensor(whole)
    check_sensor(AHEAD)
    for wrong in (0.0, 7.0, math.nan):
        with pytest.raises(ValueError, match=r"field_of_view must be in \(0, 2π\]"):
            replace(whole, field_of_view=wrong)


@pytest.mark.parametrize(
    ("sensor", "std"),
    [(COPY, (0.02, 0.1, 1.0)), (COPY, 0.02), (COPY, "a"), (BEARING, (0.1, 0.1, 0.1))],
)
def test_check_sensor_refuses_the_noise_that_filters_refuse(sensor, std):
    with pytest.raises(ValueError, match="measurement_std must be"):
        make_estimator("ekf", motion_std=MOTION, measurement_std=std, sensor=sensor)
    with pytest.raises(ValueError, match="measurement_std must be"):
        check_sensor(sensor, std)
    for accepted in ((0.1,), (0.1, 0.0)):
        check_sensor(BEARING, accepted)


def test_check_sensor_refuses_slopes_of_the_void_number():
    single = Sensor("odd", ("bearing",), ("rad",), void_slope, angles=(True,))
    with pytest.raises(SensorContractError, match="∂the unused number/∂x"):
        check_sensor(single)


# --------------------------------------------------------------------------------------
# Landmarks that one reading does not place.


def waiting_filter(label, sensor, **settings):
    noise = {"motion_std": (0.01, 0.01, 0.003), "measurement_std": STD[sensor.name]}
    return make_estimator(label, **noise, sensor=sensor, **settings)


def drive_past(
    slam, sensor, steps, *, landmarks=LANDMARKS, noise=1.0, turn=0.15, start=(0, 0, 0)
):
    """Drive on a circle, or straight on, past landmarks; return the true pose."""
    rng, pose = np.random.default_rng(0), np.array(start, dtype=float)
    for _ in range(steps):
        pose = pose + np.array([0.3 * np.cos(pose[2]), 0.3 * np.sin(pose[2]), turn])
        slam.predict((0.3, turn))
        report = slam.update(
            reading(sensor, pose, landmarks, rng, noise), range(len(landmarks))
        )
        own = report.added_ids[-1:] * (not slam.sensor.places)
        first = [3 + 2 * slam.map.slots[i] for i in own]
        assert (slam.map.reference[first] == slam.map.mean[first]).all()
    return pose, report


@pytest.mark.parametrize("sensor", [BEARING, RANGE], ids=lambda s: s.name)
@pytest.mark.parametrize("label", ["ekf", "invariant", "first_estimates"])
def test_landmarks_are_placed_from_several_poses(label, sensor):
    slam = waiting_filter(label, sensor)
    assert slam.update(reading(sensor, np.zeros(3), LANDMARKS, None, 0), range(5)) == (
        type(slam.report())()
    )
    assert slam.belief().landmark_ids == ()
    assert slam.landmark_ids == ()
    assert slam.map_view().landmarks.shape == (0, 2)
    pose, _ = drive_past(slam, sensor, 40)
    belief = slam.belief()
    assert sorted(belief.landmark_ids) == [0, 1, 2, 3, 4]
    assert len(slam.map.slots) == 5  # no past pose is left
    error = belief.error(pose, LANDMARKS[list(belief.landmark_ids)])
    squared = error @ np.linalg.solve(belief.error_covariance(), error)
    assert squared < 13 * 2.5
    slam.remove([0])
    columns = [3 + 2 * slot for slot in slam.slots.values()]
    np.testing.assert_array_equal(slam.map.mean[columns], slam.belief().landmarks[:, 0])


def test_delayed_readings_of_bearing_and_range_wait_for_several_poses():
    slam = waiting_filter("invariant", BEARING_RANGE, landmark_init="delayed")
    pose, _ = drive_past(slam, BEARING_RANGE, 1)
    assert (slam.landmark_ids, len(slam.map.waiting.ids)) == ((), 5)
    rng = np.random.default_rng(5)
    pose = pose + np.array([0.3 * np.cos(pose[2]), 0.3 * np.sin(pose[2]), 0.15])
    slam.predict((0.3, 0.15))
    slam.update(reading(BEARING_RANGE, pose, LANDMARKS, rng), range(5))
    belief = slam.belief()
    assert len(belief.landmark_ids) >= 4  # fine bearings: two readings are enough
    error = belief.error(pose, LANDMARKS[list(belief.landmark_ids)])
    assert error @ np.linalg.solve(belief.error_covariance(), error) < 2.5 * len(error)


def test_delayed_landmarks_of_fine_bearings_equal_those_of_the_usual_filter():
    noise = {"motion_std": (0.01, 0.01, 0.003), "measurement_std": (0.003, 0.01)}
    slams = [
        make_estimator("invariant", **noise, landmark_init=how)
        for how in ("full", "delayed")
    ]
    for slam in slams:
        drive_past(slam, BEARING_RANGE, 12, noise=0.1)
    full, delayed = (slam.belief(range(5)) for slam in slams)
    std = np.sqrt(np.diag(full.covariance))
    assert (np.abs(delayed.mean - full.mean) < 0.1 * std).all()
    np.testing.assert_allclose(
        delayed.covariance, full.covariance, atol=0.02 * std.max() ** 2
    )


def test_mirror_images_of_ranges_are_kept_until_they_separate():
    """A straight path cannot tell a landmark on the left from one on the right."""
    slam = waiting_filter("invariant", RANGE)
    one = LANDMARKS[1:2] * (-1, 1)
    pose, _ = drive_past(slam, RANGE, 25, landmarks=one, turn=0.0, noise=0.1)
    assert slam.landmark_ids == ()
    assert len(slam.map.waiting.ids) == 25
    rng = np.random.default_rng(1)
    for _ in range(12):
        pose = pose + np.array([0.3 * np.cos(pose[2]), 0.3 * np.sin(pose[2]), 0.2])
        slam.predict((0.3, 0.2))
        slam.update(reading(RANGE, pose, one, rng, 0.1), [0])
    assert slam.landmark_ids == (0,)
    np.testing.assert_allclose(slam.belief().landmarks, one, atol=0.5)


def test_readings_that_waited_are_used_once_as_by_least_squares():
    """Against a batch of all poses and readings, where both are nearly linear."""
    motion, std, steps = np.array([1e-3, 1e-3, 1e-3]), 1e-3, 12
    noise = {"motion_std": motion, "measurement_std": (std, 0.0)}  # 0 is not read
    slam = make_estimator("ekf", **noise, sensor="bearing", landmark_init="delayed")
    landmark, rng, turn = np.array([2.0, 3.0]), np.random.default_rng(3), 0.1
    pose, readings = np.zeros(3), []
    for _ in range(steps):
        pose = pose + np.array([0.3 * np.cos(pose[2]), 0.3 * np.sin(pose[2]), turn])
        slam.predict((0.3, turn))
        z = reading(BEARING, pose, landmark[None], rng, 0)
        z = z + np.array([std * rng.normal(), 0])
        readings.append(z[0, 0])
        slam.update(z, [0])
    assert slam.landmark_ids == (0,)

    def residuals(x):
        """Weighted residuals of the motions ε (steps, 3) and the landmark."""
        noise, point, at, found = x[:-2].reshape(-1, 3), x[-2:], np.zeros(3), [x[:-2]]
        for k in range(steps):
            along, across, turned = noise[k] * motion
            cos, sin = np.cos(at[2]), np.sin(at[2])
            dx, dy = 0.3 + along, across
            moved = cos * dx - sin * dy, sin * dx + cos * dy, turn + turned
            at = at + np.array(moved)
            expected = BEARING.predict(at, point[None]).measurement[0, 0]
            found.append([(readings[k] - expected) / std])
        return np.concatenate(found), at

    x = np.concatenate([np.zeros(3 * steps), landmark])
    for _ in range(5):
        J = numeric_jacobian(lambda y: residuals(y)[0], x)
        x = x - np.linalg.lstsq(J, residuals(x)[0], rcond=None)[0]
    by_pose = numeric_jacobian(lambda y: residuals(y)[1], x)
    out = np.vstack([by_pose, np.eye(len(x))[-2:]])
    covariance = out @ np.linalg.inv(J.T @ J) @ out.T
    belief = slam.belief()
    std_of = np.sqrt(np.diag(covariance))
    expected = np.concatenate([residuals(x)[1], x[-2:]])
    assert (np.abs(belief.mean - expected) < 0.05 * std_of).all()
    scale = np.outer(std_of, std_of)
    np.testing.assert_allclose(belief.covariance / scale, covariance / scale, atol=0.02)


@pytest.mark.parametrize("sensor", [BEARING, RANGE])
def test_place_and_poses_are_fitted_together_as_by_least_squares(sensor):
    """With poses so uncertain that one linearisation is not enough."""
    rng = np.random.default_rng(2)
    along, turn = np.arange(6.0), 0.1 * np.arange(6)
    p = np.stack([along, 0.1 * along**2], axis=1)
    q = p + np.stack([np.cos(turn), np.sin(turn)], axis=1)
    true = np.concatenate([[5.0, 2.5, 0.5], np.stack([p, q], axis=1).ravel()])
    root = 0.03 * rng.normal(size=(len(true), 40)) * np.sqrt(along.repeat(4)[-1])
    P, mean = root @ root.T, true + root @ rng.normal(size=40)
    columns, place = 3 + np.arange(24).reshape(6, 4), np.array([2.0, 4.0])
    noise = (0.01, 1.0)
    exact = SeenLandmark(sensor, noise, np.zeros((6, 2)), columns)
    seen = exact._replace(readings=exact.linearise(true, place)[0])

    def residuals(x):
        state = mean + root @ x[:-2]
        return np.append(seen.weighted(state, x[None, -2:])[0][0], x[:-2])

    best = least_squares(residuals, np.append(np.zeros(40), place), xtol=1e-12)
    fit = seen.fit(mean, P, None, place + 0.3, turns=False)
    shift = fit.shift(P[np.append(columns, 2)])
    expected = np.append(mean + root @ best.x[:-2], best.x[-2:])
    np.testing.assert_allclose(
        np.append(mean, fit.point) + shift, expected, rtol=0, atol=1e-3
    )
    once = seen.fit(mean, P, mean, place + 0.3, turns=False)
    moved = np.append(mean, once.point) + once.shift(P[np.append(columns, 2)])
    assert np.abs(moved - expected).max() > 1e-2  # so it matters here


def test_a_heading_that_has_drifted_loses_no_run_of_bearings():
    """With one linearisation of the places, the errors are 1 m."""
    runs = simulate_runs(load_scenario("bearing").with_changes(steps=160), 1, 777002)
    noise = {"motion_std": (0.02, 0.01, 0.02), "measurement_std": (0.02,)}
    slam = make_estimator("invariant", **noise, sensor="bearing")
    slam.reset(runs.initial_poses[0], np.full(3, 1e-4))
    errors = []
    for step in range(161):
        if step:
            slam.predict(runs.odometry[0, step])
        seen = np.flatnonzero(runs.visible[0, step])
        slam.update(runs.measurements[0, step, seen], seen)
        errors.append(slam.belief().pose[:2] - runs.true_poses[0, step, :2])
    assert len(slam.landmark_ids) >= 15
    assert np.linalg.norm(errors, axis=1).max() < 0.3


def test_the_longer_axis_decides_whether_a_place_is_vague():
    axes = np.diag([0.01, 2.0])
    found = [delayed_landmarks._is_vague(axes, distance) for distance in (1.0, 99.0)]
    assert found == [True, False]


def test_waiting_filters_continue_from_a_saved_state_bit_for_bit():
    slam = waiting_filter("invariant", RANGE)
    pose, _ = drive_past(slam, RANGE, 8)
    assert len(slam.map.waiting.ids)
    other = waiting_filter("invariant", RANGE)
    other.load_state_dict(slam.state_dict())
    rng = np.random.default_rng(4)
    for _ in range(15):
        pose = pose + np.array([0.3 * np.cos(pose[2]), 0.3 * np.sin(pose[2]), 0.15])
        z = reading(RANGE, pose, LANDMARKS, rng)
        for each in (slam, other):
            each.predict((0.3, 0.15))
        assert slam.update(z, range(5)) == other.update(z, range(5))
    np.testing.assert_array_equal(slam.belief().covariance, other.belief().covariance)
    state = slam.state_dict()
    state |= {"waiting_ids": np.array([[0, 77]]), "waiting_readings": np.ones((1, 2))}
    one_point = [LOWEST_ID + 2 * 77, *state["landmark_ids"][1:]]
    for wrong in state, state | {"landmark_ids": np.array(one_point)}:
        with pytest.raises(ValueError, match="must name poses in the map, got 77"):
            other.load_state_dict(wrong)


def test_a_new_run_begins_without_a_report():
    slam = waiting_filter("invariant", RANGE)
    drive_past(slam, RANGE, 30)
    state = slam.state_dict()
    assert len(slam.report().innovation)
    slam.reset(np.zeros(3), np.full(3, 0.1))
    assert not len(slam.report().innovation)
    slam.load_state_dict(state)
    assert not len(slam.report().innovation)


def test_an_update_that_fails_leaves_the_readings_waiting():
    slam = waiting_filter("ekf", RANGE)
    drive_past(slam, RANGE, 5)
    before = digest(slam)
    with pytest.raises(ValueError, match="must be finite"):
        slam.update([(1.0,), (np.nan,)], [8, 9])
    with pytest.raises(ValueError, match="landmark_ids must be >="):
        slam.update([(1.0,)], [-(2**63)])
    assert digest(slam) == before
    slam.reset((0, 0, 0), (0, 0, 0))
    assert len(slam.map.waiting.ids) == 0


PLACING = 35  # steps


@cache
def placed_about(origin, label, sensor):
    """Return the belief after a drive that begins near an origin, and its last NIS."""
    start = {"initial_pose": (*origin, 0), "initial_pose_std": (0.1, 0.1, 0.1)}
    slam = waiting_filter(label, sensor, **start)
    _, report = drive_past(slam, sensor, PLACING, start=(0.05, -0.1, 0.1))
    return slam.belief(), report.nis


@far_origins
@pytest.mark.parametrize("sensor", [BEARING, RANGE], ids=lambda s: s.name)
@pytest.mark.parametrize("label", ORACLES)
def test_landmarks_far_from_the_origin_are_placed_as_at_the_origin(label, sensor, far):
    near, nis = placed_about((0, 0), label, sensor)
    there, nis_there = placed_about(far, label, sensor)
    assert len(near.landmark_ids) == 5
    assert there.landmark_ids == near.landmark_ids
    slack, noise = rounding(far, PLACING), STD[sensor.name][0]
    if label == "unscented":  # roots of a singular covariance have half its digits
        slack += 1e-9
    np.testing.assert_allclose(there.mean, shifted(near.mean, far), atol=slack, rtol=0)
    stds = np.sqrt(near.covariance.diagonal())
    change = (there.covariance - near.covariance) / np.outer(stds, stds)
    assert np.abs(change).max() < slack / noise
    assert np.sqrt(nis_there) == pytest.approx(np.sqrt(nis), abs=slack / noise)


@far_origins
def test_past_poses_at_equal_distances_are_forgotten_in_the_same_order(far):
    """Rounding does not decide which of them is nearest to its predecessor."""
    left = []
    for origin in ((0, 0), far):
        slam = waiting_filter("ekf", BEARING, initial_pose=(*origin, 0))
        drive_past(slam, BEARING, 55, landmarks=np.array([[1e5, 1e5]]))
        left.append(slam.map.waiting.ids[:, 1])
    np.testing.assert_array_equal(*left)


def test_past_poses_do_not_exceed_their_limit():
    slam = waiting_filter("ekf", BEARING)
    far = np.array([[1e5, 1e5]])  # no drive can place it
    drive_past(slam, BEARING, 60, landmarks=far)
    assert slam.landmark_ids == ()
    assert len(slam.map.slots) == 2 * MOST_POSES
    assert len(slam.map.waiting.ids) == MOST_POSES


def test_readings_of_whole_numbers_are_compared_as_real_numbers():
    apart = find_sensor("bearing").difference(np.array([[4, 0]]), np.array([[0, 0]]))
    np.testing.assert_allclose(apart, [[4 - 2 * np.pi, 0.0]])


@pytest.mark.parametrize("wrong", [None, [None], "a"])
def test_a_noise_that_is_no_number_is_refused(wrong):
    with pytest.raises(ValueError, match="measurement_std"):
        make_estimator("ekf", motion_std=MOTION, measurement_std=wrong, sensor="range")
