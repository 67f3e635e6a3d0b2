"""Removal and merging of landmarks, as mathematics and in every filter."""

from types import SimpleNamespace

import numpy as np
import pytest
from comparison import assert_close_beliefs, assert_same_bits, part_of
from drives import MEASUREMENT_STD, MOTION_STD, NOISE, SIX, drive
from scipy.linalg import expm
from scipy.optimize import root

from slamgym.estimator import EkfSlam, list_estimators, make_estimator
from slamgym.estimator.filters.gaussian_map import without_landmarks
from slamgym.estimator.filters.pose_readings import coincide
from slamgym.estimator.interface import marginal, view_map
from slamgym.estimator.map_management.map_editor import MapEditor
from slamgym.estimator.models.relative_geometry import separation, squared_offsets
from slamgym.estimator.models.rigid_motion import invariant_covariance, invariant_error

MANAGEABLE = list_estimators()

START_STD = (0.05, 0.05, 0.1)
IDS = list(range(6))
TRUE_MAP = dict(enumerate(SIX))


def test_a_map_view_of_an_estimator_without_belief_is_used():
    own = SimpleNamespace(map_view=lambda: "view")
    assert view_map(own) == "view"


def random_map(seed, landmarks=4):
    rng = np.random.default_rng(seed)
    size = 3 + 2 * landmarks
    root = rng.standard_normal((size, size)) * 0.1
    mean = rng.uniform(-5, 5, size)
    mean[5:7] = mean[3:5] + 0.1 * rng.standard_normal(2)  # 0 and 1 may be one
    return mean, root @ root.T


def make(name, **changes):
    return make_estimator(name, **{**NOISE, "initial_pose_std": START_STD, **changes})


def driven(name, steps=25, seed=3, landmarks=SIX):
    slam = make(name)
    ids = list(range(len(landmarks)))
    for odometry, readings, _ in drive(
        seed, steps, landmarks=landmarks, start_std=START_STD
    ):
        slam.predict(odometry)
        slam.update(readings, ids)
    return slam


def doubled(name, steps=25):
    """Landmark 0 also has the name 6, from the middle of the drive on."""
    slam = make(name)
    for step, (odometry, readings, _) in enumerate(
        drive(4, steps, start_std=START_STD)
    ):
        slam.predict(odometry)
        slam.update(readings, [0 if step < steps // 2 else 6, *IDS[1:]])
    return slam


# --- the mathematics ---


def test_dropping_landmarks_leaves_every_other_number_as_it_was():
    mean, P = random_map(0)
    left = [0, 1, 2, 5, 6, 9, 10]
    np.testing.assert_array_equal(without_landmarks(mean, [0, 2]), mean[left])
    np.testing.assert_array_equal(without_landmarks(P, [2, 0]), P[np.ix_(left, left)])


def test_additive_merge_is_the_textbook_update():
    mean, P = random_map(2)
    H = np.zeros((2, 11))
    H[:, 3:5], H[:, 5:7] = np.eye(2), -np.eye(2)
    K = P @ H.T @ np.linalg.inv(H @ P @ H.T)
    merged = coincide(mean, P, 0, 1)
    np.testing.assert_allclose(merged.mean, mean - K @ H @ mean, atol=1e-12)
    np.testing.assert_allclose(merged.covariance, P - K @ H @ P, atol=1e-12)
    np.testing.assert_array_equal(merged.covariance, merged.covariance.T)


def lie_moved(mean, xi):
    """exp(ξ) χ by the matrix exponential of SE_{1+n}(2)."""
    points = np.concatenate([mean[:2], mean[3:]]).reshape(-1, 2)
    moves = np.concatenate([xi[:2], xi[3:]]).reshape(-1, 2)
    n = len(points)
    algebra, group = np.zeros((2 + n, 2 + n)), np.eye(2 + n)
    algebra[:2, :2] = xi[2] * np.array([[0, -1], [1, 0]])
    algebra[:2, 2:], group[:2, 2:] = moves.T, points.T
    c, s = np.cos(mean[2]), np.sin(mean[2])
    group[:2, :2] = [[c, -s], [s, c]]
    moved = (expm(algebra) @ group)[:2, 2:].T.ravel()
    return np.concatenate([moved[:2], [mean[2] + xi[2]], moved[2:]])


@pytest.mark.parametrize("pairs", [[(0, 1)], [(0, 2), (3, 1)]])
def test_invariant_merge_is_the_update_in_invariant_coordinates(pairs):
    mean, P = random_map(3)
    mean[2] = 0.4
    one, other = zip(*pairs, strict=True)
    i, j = (np.ravel([(3 + 2 * k, 4 + 2 * k) for k in slots]) for slots in (one, other))
    H = np.eye(11)[i] - np.eye(11)[j]
    P_xi = invariant_covariance(mean, P)

    def moved(multipliers):
        return lie_moved(mean, P_xi @ H.T @ multipliers)

    found = root(lambda x: H @ moved(x), np.zeros(len(H)), tol=1e-13)
    merged = coincide(mean, P, one, other, frame="invariant")
    np.testing.assert_allclose(merged.mean, moved(found.x), atol=1e-10)
    back = invariant_covariance(merged.mean, merged.covariance)
    K = P_xi @ H.T @ np.linalg.inv(H @ P_xi @ H.T)
    np.testing.assert_allclose(back, P_xi - K @ H @ P_xi, atol=1e-12)
    np.testing.assert_array_equal(merged.covariance, merged.covariance.T)
    assert abs(invariant_error(merged.mean, mean)[2]) > 1e-3  # the heading has moved


def test_additive_merge_of_several_pairs_is_that_of_one_after_the_other():
    mean, P = random_map(6)
    together = coincide(mean, P, [0, 3], [2, 1])
    apart = coincide(*coincide(mean, P, 0, 2), 3, 1)
    np.testing.assert_allclose(together.mean, apart.mean, atol=1e-12)
    np.testing.assert_allclose(together.covariance, apart.covariance, atol=1e-12)


def test_merged_landmarks_have_one_place_and_one_covariance():
    mean, P = coincide(*random_map(4), 0, 1)
    np.testing.assert_allclose(mean[3:5], mean[5:7], atol=1e-12)
    np.testing.assert_allclose(P[3:5], P[5:7], atol=1e-12)


@pytest.mark.parametrize("name", ["invariant", "submaps"])
def test_landmarks_too_far_apart_for_any_turn_stay_two(name):
    noise = {"motion_std": (0.1, 0.1, 0.05), "measurement_std": (0.05, 0.1)}
    slam = make_estimator(name, **noise)
    slam.update([(0.0, 1.0), (1.0, 1000.0)], [4, 5])
    slam.predict((0.0, 0.0))
    before = slam.belief()
    with pytest.raises(np.linalg.LinAlgError, match="too far apart"):
        slam.merge(5, 4)
    after = slam.belief()
    assert after.landmark_ids == before.landmark_ids
    np.testing.assert_array_equal(after.mean, before.mean)
    slam.load_state_dict(slam.state_dict())


def test_what_cannot_differ_cannot_be_merged():
    mean, P = random_map(5)
    P[5:7] = P[3:5]
    P[:, 5:7] = P[:, 3:5]
    assert squared_offsets(*separation(mean, P, 3, 5)) == np.inf
    with pytest.raises(np.linalg.LinAlgError):
        coincide(mean, P, 0, 1)


# --- in the filters ---


@pytest.mark.parametrize("name", MANAGEABLE)
def test_removal_changes_no_other_marginal(name):
    slam = driven(name)
    before = slam.belief()
    MapEditor(slam).remove([4, 1])
    assert_close_beliefs(slam.belief(), part_of(before, (0, 2, 3, 5)), 1e-12)


@pytest.mark.parametrize(
    "name",
    # the cubature points of the unscented filter lie farther out, the larger its state
    [name for name in MANAGEABLE if name != "unscented"],
)
def test_a_removed_landmark_is_not_missed_by_the_rest(name):
    removed, kept = driven(name), driven(name)
    MapEditor(removed).remove([2])
    others = [0, 1, 3, 4, 5]
    for odometry, readings, _ in drive(8, 30):
        for slam in (removed, kept):
            slam.predict(odometry)
            slam.update(readings[others], others)
    one, other = removed.belief(), marginal(kept, others)
    assert one.landmark_ids == other.landmark_ids
    rounding = 1e-11 if name == "sparse_information" else 1e-12  # Λ is ill-conditioned
    assert_close_beliefs(one, other, rounding)


def volume(belief):
    """Of pose and landmarks, the same in every error frame."""
    return np.linalg.slogdet(belief.covariance).logabsdet


@pytest.mark.parametrize("name", MANAGEABLE)
def test_merging_keeps_the_information_of_both(name):
    slam = doubled(name)
    before = [volume(marginal(slam, [i])) for i in (0, 6)]
    MapEditor(slam).merge_pairs([(0, 6)])
    assert slam.belief().landmark_ids == tuple(IDS)
    assert volume(marginal(slam, [0])) < min(before) - 0.1
    assert np.linalg.eigvalsh(slam.belief().covariance).min() > 0
    slam.predict((0.5, 0.08))
    slam.update([(0.3, 5.0)], [0])  # and the filter goes on


@pytest.mark.parametrize(
    "name", ["invariant", "first_estimates", "observability_constrained", "robocentric"]
)
def test_merging_tells_no_filter_that_knows_better_its_heading(name):
    """A robot that stands and looks cannot learn its heading, nor by a merge."""
    slam = make(name, motion_std=(0, 0, 0), initial_pose_std=(0, 0, 0.3))
    rng = np.random.default_rng(0)
    truth = np.array([(0.5, 6.0), (0.5, 6.0), (-1.0, 3.0)])
    for _ in range(20):
        slam.update(truth + MEASUREMENT_STD * rng.standard_normal((3, 2)), [0, 1, 2])
    MapEditor(slam).merge_pairs([(0, 1)])
    for _ in range(20):
        noise = MEASUREMENT_STD * rng.standard_normal((2, 2))
        slam.update(truth[1:] + noise, [0, 2])
    assert slam.belief().pose_covariance[2, 2] ** 0.5 == pytest.approx(0.3, abs=1e-9)


@pytest.mark.parametrize("name", ["ekf", "invariant"])
@pytest.mark.parametrize("more", [(), ("remove",)])
def test_a_filter_of_ones_own_is_edited_through_its_state(name, more):
    hidden, open_one = doubled(name), doubled(name)
    doors = ("belief", "state_dict", "load_state_dict", *more)  # and nothing else
    boxed = SimpleNamespace(**{name: getattr(hidden, name) for name in doors})
    for slam in (boxed, open_one):
        door = MapEditor(slam)
        door.merge_pairs([(0, 6)])
        door.remove([3])
    assert_same_bits(boxed.belief(), open_one.belief())


def test_pairs_merged_one_by_one_are_all_merged_or_none():
    slam = doubled("ekf")
    methods = "belief", "remove", "merge", "state_dict", "load_state_dict"
    door = MapEditor(SimpleNamespace(**{name: getattr(slam, name) for name in methods}))
    before = slam.belief()
    with pytest.raises(ValueError, match="99"):
        door.merge_pairs([(0, 6), (1, 99)])
    assert_same_bits(slam.belief(), before)


def test_a_filter_whose_map_cannot_be_edited_is_refused():
    class Sealed(EkfSlam):
        def belief(self):
            return super().belief()

        def state_dict(self):
            return {"blob": np.zeros(1)}

    with pytest.raises(TypeError, match=r"Sealed cannot be managed, .* with mean"):
        MapEditor(Sealed(MOTION_STD, MEASUREMENT_STD))


@pytest.mark.parametrize("name", MANAGEABLE)
def test_marginal_is_a_part_of_the_belief(name):
    slam = driven(name)
    whole, part = slam.belief(), marginal(slam, [5, 1])
    assert part.frame == whole.frame
    assert_same_bits(part, part_of(whole, (5, 1)))
