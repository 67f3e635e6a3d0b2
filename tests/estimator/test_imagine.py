"""Imagined beliefs against real filters that drive the same plans."""

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from slamgym.envs.bearing_range import LineOfSight
from slamgym.estimator import (
    BatchBeliefs,
    RobocentricEkfSlam,
    imagine,
    make_batch,
    make_estimator,
)
from slamgym.estimator.kernels.imagine import is_hidden
from slamgym.estimator.models.bearing_range import predict_measurement
from slamgym.estimator.models.sensors import BEARING_RANGE

FAMILY = ("ekf", "invariant", "first_estimates", "observability_constrained")
NOISE = {"motion_std": (0.05, 0.03, 0.03), "measurement_std": (0.02, 0.1)}
LANDMARKS = np.random.default_rng(5).uniform(-5.0, 5.0, (8, 2))
PLANS = np.random.default_rng(0).uniform([0.0, -0.7], [0.9, 0.7], (6, 7, 2))
WALLS = [(2.0, -4.0, 2.0, 4.0), (-3.0, 2.5, 1.0, 2.5)]


def sensor(**changes):
    """Return a sensor that sees what is near and ahead."""
    limits = {
        "min_range": 0.1,
        "max_range": 5.0,
        "field_of_view": 4.0,
        "occlusion": False,
        "dropout": 0.0,
    }
    return SimpleNamespace(**{**limits, **changes})


def driven(name, seed=1, **options):
    """Return a filter that has driven and mapped, not all landmarks in order of id."""
    slam = make_estimator(name, initial_pose_std=(0.05, 0.05, 0.1), **NOISE, **options)
    rng, pose = np.random.default_rng(seed), np.zeros(3)
    for _ in range(8):
        slam.predict((0.4, 0.3))
        pose += (0.4 * math.cos(pose[2]), 0.4 * math.sin(pose[2]), 0.3)
        readings = predict_measurement(pose, LANDMARKS).measurement
        seen = np.flatnonzero((readings[:, 1] < 5) & (np.abs(readings[:, 0]) < 1.0))
        noise = NOISE["measurement_std"] * rng.standard_normal((len(seen), 2))
        slam.update(readings[seen] + noise, seen.tolist())
    return slam


def drive_for_real(slam, plan, seen_from):
    """Drive a plan with noise-free readings; return beliefs after every step."""
    beliefs = []
    for step in plan:
        slam.predict(step)
        now = slam.belief()
        readings = predict_measurement(now.pose, now.landmarks).measurement
        seen = seen_from(now.pose, now.landmarks, readings)
        ids = np.array(now.landmark_ids)
        slam.update(readings[seen], ids[seen].tolist())
        beliefs.append(slam.belief())
    return beliefs


def in_view(_, __, readings):
    near = (readings[:, 1] > 0.1) & (readings[:, 1] <= 5.0)
    return near & (np.abs(readings[:, 0]) <= 2.0)


def not_hidden(pose, landmarks, readings):
    places, frame = (landmarks @ [1, 1j])[None], np.array(pose, dtype=float)[:, None]
    (hidden,) = LineOfSight(WALLS).blocked(places, frame)
    return in_view(pose, landmarks, readings) & ~hidden


def agree(imagined, world, plan, beliefs):
    """Compare one imagined plan with the beliefs of a real drive."""
    poses = imagined.poses[world, plan]
    np.testing.assert_allclose(poses[:, :2], [b.pose[:2] for b in beliefs], atol=1e-10)
    turned = poses[:, 2] - [b.pose[2] for b in beliefs]
    np.testing.assert_allclose(np.cos(turned), 1.0, atol=1e-10)
    np.testing.assert_allclose(
        imagined.pose_covariances[world, plan],
        [b.pose_covariance for b in beliefs],
        atol=1e-10,
    )
    last = beliefs[-1]
    log_det = np.linalg.slogdet(last.covariance[3:, 3:])[1]
    assert imagined.log_det[world, plan] == pytest.approx(log_det, abs=1e-10)
    return np.linalg.eigvalsh(last.landmark_covariances)[:, -1]


@pytest.mark.parametrize("walls", [(), WALLS], ids=["open", "walls"])
@pytest.mark.parametrize("name", FAMILY)
def test_a_plan_imagined_is_the_plan_driven_without_noise(name, walls):
    sight = sensor(occlusion=bool(walls))
    imagined = imagine(driven(name), PLANS, sight, walls=walls)
    seen_from = not_hidden if walls else in_view
    for k, plan in enumerate(PLANS):
        beliefs = drive_for_real(driven(name), plan, seen_from)
        variances = agree(imagined, 0, k, beliefs)
        np.testing.assert_allclose(
            imagined.worst_variances[0, k], variances, atol=1e-10
        )


@pytest.mark.parametrize("name", FAMILY)
def test_worlds_side_by_side_each_imagine_their_own_plans(name):
    batch = make_batch(name, runs=2, landmarks=8, **NOISE)
    singles = [driven(name, seed) for seed in (1, 2)]
    beliefs = BatchBeliefs.of([slam.belief() for slam in singles], 8)
    references = np.zeros((2, 19))
    for run, slam in enumerate(singles):
        ids = np.array(slam.landmark_ids)
        references[run, :3] = slam.map.reference[:3]
        points = slam.map.reference[3 : slam.map.size].reshape(-1, 2)
        references[run, 3:].reshape(-1, 2)[ids] = points
    batch.load(beliefs, references=references)
    imagined = imagine(batch, np.stack([PLANS[:3], PLANS[3:]]), sensor())
    for run, slam in enumerate(singles):
        plans = PLANS[3 * run : 3 * run + 3]
        alone = imagine(slam, plans, sensor())
        order = list(slam.landmark_ids)
        for got, expected in zip(imagined, alone, strict=True):
            rows = got[run]
            if rows.shape == (3, 8):
                missing = [i for i in range(8) if i not in order]
                assert (rows[:, missing] == np.inf).all()
                rows = rows[:, order]
            np.testing.assert_allclose(rows, expected[0], rtol=0, atol=1e-9)


def test_imagining_changes_nothing():
    slam, batch = driven("invariant"), make_batch("ekf", runs=2, landmarks=8, **NOISE)
    batch.load(BatchBeliefs.of([driven("ekf", seed).belief() for seed in (1, 2)], 8))
    before, stored = slam.state_dict(), [array.copy() for array in batch.storage()]
    imagine(slam, PLANS, sensor())
    imagine(batch, PLANS, sensor())
    for key, value in slam.state_dict().items():
        np.testing.assert_array_equal(value, before[key])
    for array, copy in zip(batch.storage(), stored, strict=True):
        np.testing.assert_array_equal(array, copy)


def test_dropout_counts_readings_with_their_share_of_information():
    half = make_estimator(
        "ekf",
        motion_std=NOISE["motion_std"],
        measurement_std=np.array(NOISE["measurement_std"]) * 2**0.5,
        range_std_per_metre=0.02 * 2**0.5,
        bearing_std_metres=0.05 * 2**0.5,
    )
    slam = driven("ekf", range_std_per_metre=0.02, bearing_std_metres=0.05)
    half.load_state_dict(slam.state_dict())
    lossy = imagine(slam, PLANS, sensor(dropout=0.5))
    expected = imagine(half, PLANS, sensor())
    np.testing.assert_allclose(lossy.log_det, expected.log_det, atol=1e-9)
    blind = imagine(driven("ekf"), PLANS, sensor(dropout=1.0))
    unseen = imagine(driven("ekf"), PLANS, sensor(max_range=0.2))
    np.testing.assert_array_equal(blind.log_det, unseen.log_det)


def test_new_landmarks_are_expected_where_a_plan_looks_first():
    slam = make_estimator("ekf", **NOISE)
    ahead, turning = np.full((4, 2), (1.0, 0.0)), np.full((4, 2), (0.0, 1.0))
    points, counts = [(8.0, 0.0), (-3.0, 0.0), (20.0, 0.0)], [0.5, 0.2, 9.0]
    sight = sensor(field_of_view=1.0)
    found = imagine(slam, [ahead, turning], sight, density=(points, counts))
    np.testing.assert_allclose(found.new_landmarks[0, :, -1], [0.5, 0.2])
    assert found.new_landmarks[0, 1].tolist() == [0.0, 0.0, 0.2, 0.2]
    narrow = replace(BEARING_RANGE, field_of_view=1.0)  # the filter's own
    own = imagine(
        make_estimator("ekf", **NOISE, sensor=narrow),
        *([ahead, turning], sensor()),
        density=(points, counts),
    )
    np.testing.assert_array_equal(own.new_landmarks, found.new_landmarks)
    sight.dropout = 0.1
    lossy = imagine(slam, [ahead, turning], sight, density=(points, counts))
    np.testing.assert_allclose(lossy.new_landmarks[0, 0, -1], 0.5 * (1 - 0.1**2))
    assert not imagine(slam, [ahead], sight).new_landmarks.any()


def test_new_landmarks_are_those_that_the_sensor_sees():
    rng = np.random.default_rng(4)
    points, counts = rng.uniform(-6.0, 6.0, (60, 2)), rng.uniform(0.0, 1.0, 60)
    counts[:10] = 0.0
    sight = sensor(occlusion=True, dropout=0.25, min_range=0.0)
    slam, density = make_estimator("ekf", **NOISE), (points, counts)
    found = imagine(slam, PLANS, sight, walls=WALLS, density=density)
    for poses, each in zip(found.poses[0], found.new_landmarks[0], strict=True):
        missed, total = np.ones(60), []
        for pose in poses:
            readings = predict_measurement(pose, points).measurement
            seen = not_hidden(pose, points, readings)
            total.append((counts * missed)[seen].sum() * 0.75)
            missed[seen] *= 0.25
        np.testing.assert_allclose(each, np.cumsum(total), atol=1e-12)


@pytest.mark.parametrize("name", FAMILY)
def test_horizons_tell_what_shorter_plans_tell(name):
    slam = driven(name)
    several = imagine(slam, PLANS, sensor(), horizons=(1, 4, 7))
    assert several.worst_variances.shape == (1, 6, 3, len(slam.belief().landmark_ids))
    for h, steps in enumerate((1, 4, 7)):
        one = imagine(slam, PLANS[:, :steps], sensor())
        np.testing.assert_array_equal(several.log_det[:, :, h], one.log_det)
        worst = several.worst_variances[:, :, h]
        np.testing.assert_array_equal(worst, one.worst_variances)
    np.testing.assert_array_equal(several.poses, one.poses)


def test_a_point_is_hidden_as_in_the_world():
    rng, hidden = np.random.default_rng(4), 0
    kernel = getattr(is_hidden, "py_func", is_hidden)  # only kernels call it
    for wall in rng.uniform(-1.0, 1.0, (300, 4)):
        (x, y), (dx, dy) = rng.uniform(-1.0, 1.0, (2, 2))
        point, robot = np.array([[complex(x + dx, y + dy)]]), np.array([[x], [y]])
        expected = bool(LineOfSight([tuple(wall)]).blocked(point, robot)[0, 0])
        assert kernel(x, y, dx, dy, wall[None]) == expected
        hidden += expected
    assert 20 < hidden < 280


def test_a_robot_at_rest_has_noise_as_in_the_filter():
    for at_rest in (True, False):
        slam = driven("ekf", noise_at_rest=at_rest)
        imagined = imagine(slam, np.zeros((1, 3, 2)), sensor(max_range=0.2))
        for _ in range(3):
            slam.predict((0.0, 0.0))
        np.testing.assert_allclose(
            imagined.pose_covariances[0, 0, -1], slam.belief().pose_covariance
        )


WHOLE = "horizons must be whole numbers of steps"
RISING = "horizons must increase from 1 to at most 7"
WRONG = [
    *(({"horizons": each}, WHOLE) for each in ((), 3, (2.5,))),
    *(({"horizons": each}, RISING) for each in ((0, 3), (3, 3), (5, 8))),
    ({"plans": np.zeros((0, 5, 2))}, "with at least one plan of one step"),
    ({"plans": np.zeros((3, 0, 2))}, "with at least one plan of one step"),
    ({"plans": np.zeros((3, 5, 3))}, r"plans must have shape \(K, T, 2\)"),
    ({"plans": np.zeros(2)}, r"plans must have shape \(K, T, 2\)"),
    ({"plans": np.zeros((2, 3, 5, 2))}, "plans must be those of 1 filters"),
    ({"plans": np.full((1, 1, 2), np.nan)}, "plans must be finite"),
    ({"density": ([(0.0, 0.0)], [1.0, 2.0])}, "density must be points"),
    ({"density": ([0.0, 0.0], [1.0])}, "density must be points"),
    ({"density": ([(0.0, np.nan)], [1.0])}, "density must be finite"),
    ({"density": ([(0.0, 0.0)], [-1.0])}, "density must be finite points and finite c"),
    ({"walls": [[0, 1, 2]]}, r"walls must have shape \(W, 4\)"),
    ({"walls": [0, 1, 2, 3]}, r"walls must have shape \(W, 4\)"),
    ({"walls": [[0, 1, 2, np.nan]]}, "walls must be finite"),
]


@pytest.mark.parametrize(("arguments", "message"), WRONG)
def test_wrong_arguments_are_refused(arguments, message):
    arguments = {"plans": PLANS} | arguments
    plans = arguments.pop("plans")
    with pytest.raises(ValueError, match=message):
        imagine(driven("ekf"), plans, sensor(), **arguments)


def test_other_filters_and_keywords_are_refused():
    with pytest.raises(TypeError, match="can run in batches, got RobocentricEkfSlam"):
        imagine(RobocentricEkfSlam(**NOISE), PLANS, sensor())
    with pytest.raises(TypeError, match="unexpected keyword argument 'horizon'"):
        imagine(driven("ekf"), PLANS, sensor(), horizon=3)
    with pytest.raises(TypeError, match=r"sensor must have .* has no min_range"):
        imagine(driven("ekf"), PLANS, None)


# beliefs loaded into a batch


def test_a_batch_loads_what_it_returned_and_goes_on_alike():
    batch = make_batch("invariant", runs=2, landmarks=8, **NOISE)
    beliefs = BatchBeliefs.of([driven("invariant", s).belief() for s in (1, 2)], 8)
    batch.load(beliefs)
    for loaded, given in zip(batch.beliefs(), beliefs, strict=True):
        np.testing.assert_array_equal(loaded, given)
    one = make_batch("invariant", runs=2, landmarks=8, **NOISE)
    one.load(beliefs, runs=[False, True])
    assert one.belief(0).landmark_ids == ()
    np.testing.assert_array_equal(one.belief(1).mean, batch.belief(1).mean)


def broken(part, change):
    beliefs = BatchBeliefs.of([driven("ekf").belief()], 8)
    array = getattr(beliefs, part).copy()
    change(array)
    return beliefs._replace(**{part: array})


def lopsided(array):
    array[0, 0, 1] += 0.1


def impossible(array):
    array[0, 0, 1] = array[0, 1, 0] = 9.0


@pytest.mark.parametrize(
    ("part", "change", "message"),
    [
        ("covariances", lopsided, "must be symmetric, but is not in run 0"),
        ("covariances", impossible, "positive semidefinite, but has the eigenvalue -"),
        ("covariances", lambda a: a.fill(np.nan), "covariances must be finite"),
        ("means", lambda a: a.fill(np.inf), "beliefs.means must be finite"),
    ],
)
def test_beliefs_that_cannot_be_are_not_loaded(part, change, message):
    batch = make_batch("ekf", runs=1, landmarks=8, **NOISE)
    with pytest.raises(ValueError, match=message):
        batch.load(broken(part, change))
    beliefs = BatchBeliefs.of([driven("ekf").belief()], 8)
    with pytest.raises(ValueError, match="references must be finite"):
        batch.load(beliefs, references=np.full(beliefs.means.shape, np.nan))
    assert batch.belief(0).landmark_ids == ()


def test_beliefs_of_another_shape_are_not_loaded():
    beliefs = BatchBeliefs.of([driven("ekf").belief()], 8)
    for batch in (
        make_batch("ekf", runs=2, landmarks=8, **NOISE),
        make_batch("ekf", runs=1, landmarks=9, **NOISE),
    ):
        with pytest.raises(ValueError, match=r"beliefs\.means must have shape"):
            batch.load(beliefs)
    with pytest.raises(ValueError, match="landmark ids must be below landmarks = 3"):
        BatchBeliefs.of([driven("ekf").belief()], 3)
