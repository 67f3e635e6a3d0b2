"""The policy: who enters the map, who leaves it, who is one."""

import math
import re
from dataclasses import replace
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest
from comparison import assert_same_bits, digest
from drives import MEASUREMENT_STD, MOTION_STD, NOISE, SIX, drive
from scipy.stats import chi2
from town_drives import TOWN_MOTION_STD, map_all, wander

from slamgym.estimator import check_estimator, list_estimators, make_estimator
from slamgym.estimator.association.missed_landmarks import LostEvidence
from slamgym.estimator.map_management import policy as policies
from slamgym.estimator.map_management.managed_slam import ManagedSlam
from slamgym.estimator.map_management.policy import FieldOfView, LandmarkPolicy
from slamgym.estimator.map_management.pruning import LandmarkRecords
from slamgym.estimator.models.motions import UNICYCLE, differential
from slamgym.estimator.models.relative_geometry import largest_std, separation
from slamgym.estimator.registry import find_estimator
from slamgym.evaluation.nees import normalised_squared_error
from slamgym.experiments.logs.ground_truth import true_landmarks_of
from slamgym.experiments.logs.slamlog import OdometryRow, Scan, SlamLog
from slamgym.experiments.run_and_replay.filter_settings import settings_for
from slamgym.experiments.run_and_replay.log_replay import replay
from slamgym.experiments.run_and_replay.summary import summarise

MANAGEABLE = list_estimators()

IDS = list(range(6))
SMALL = {"submap_size": 9, "extent_limit": 2.0}  # many submaps in a short drive
AROUND = FieldOfView(30.0)
NEAREST = {"association": "nearest", "backdate": False}
"""The simplest association, of which these tests know every decision."""

TIDY = {
    **NEAREST,
    "confirm": (2, 4),
    "view": AROUND,
    "remove_after": 4,
    "merge_within": 1.0,
    "capacity": 8,
}


def make(name="ekf", management=True, **changes):
    if isinstance(management, dict):
        management = {**NEAREST, **management}
    return make_estimator(name, management=management, **{**NOISE, **changes})


def polar(points, pose=(0, 0, 0)):
    """What a robot without noise reads of some points (n, 2)."""
    dx, dy = (np.asarray(points, dtype=float) - pose[:2]).T
    return np.column_stack([np.arctan2(dy, dx) - pose[2], np.hypot(dx, dy)])


# --- the policy object ---


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"match_gate": 0.0}, "match_gate must be a finite number > 0, got 0.0"),
        ({"new_gate": 5.0}, "new_gate must be a finite number >= 9.21, got 5.0"),
        ({"ambiguity": -1}, "ambiguity must be a finite number >= 0, got -1"),
        ({"merge_gate": np.nan}, "merge_gate must be a finite number > 0, got nan"),
        ({"confirm": 3}, "confirm must be whole numbers (k, n) with 1 <= k <= n <= 63"),
        ({"confirm": (0, 3)}, "1 <= k <= n <= 63, got (0, 3)"),
        ({"confirm": (1.5, 3)}, "1 <= k <= n <= 63, got (1.5, 3)"),
        ({"confirm": (4, 3)}, "1 <= k <= n <= 63, got (4, 3)"),
        ({"confirm": (4, 64)}, "1 <= k <= n <= 63, got (4, 64)"),
        ({"trust_ids": 1}, "trust_ids must be True or False, got 1"),
        ({"remove_after": 5}, "view must be given with remove_after"),
        ({"remove_after": 0, "view": AROUND},
         "remove_after must be a whole number >= 1, got 0"),
        ("yes", "management must be a LandmarkPolicy"),
        ({"view": 30}, "view must be a FieldOfView or None, got 30"),
        ({"merge_within": 0.0}, "merge_within must be a finite number > 0, got 0.0"),
        ({"capacity": 0}, "capacity must be a whole number >= 1, got 0"),
        ({"capcity": 9}, "management has no 'capcity'; did you mean 'capacity'?"),
        ({"view": {"angle": 1.0}}, "management.view is not complete"),
        ({"view": {"max_range": -1.0}}, "max_range must be a finite number > 0"),
        ({"view": {"max_range": 5, "min_range": 6}}, "max_range must be a finite"),
        ({"view": {"max_range": 5, "angle": 7.0}}, "angle must be at most 2π, got 7.0"),
        *(({"view": {"max_range": 5, name: -1}}, f"{name} must be a finite number >=")
          for name in ("min_range", "range_margin", "bearing_margin", "shadow")),
        ({"view": {"max_range": 5, "angle": 0.0}}, "angle must be a finite number > 0"),
        ({"view": {"max_range": 5, "visible": 3}},
         "visible must be callable or None, got 3"),
        *(({field: value}, field) for field, value in {
            "association": "nearst", "density": 0.0, "hypotheses": 0, "branches": 1.5,
            "search_nodes": 0, "pair_gate": -1.0, "backdate": "yes"}.items()),
    ],
)  # fmt: skip
def test_a_bad_policy_is_refused(changes, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        policies.as_policy(changes)


def test_no_management_is_the_bare_filter():
    assert type(make(management=None)) is type(make(management=False))
    assert type(make(management=None)).__name__ == "EkfSlam"


@pytest.mark.parametrize("management", [True, TIDY], ids=["default", "all"])
@pytest.mark.parametrize("name", MANAGEABLE)
def test_every_managed_filter_keeps_the_contract(name, management):
    assert check_estimator(partial(make_estimator, name, management=management)) == ()


@pytest.mark.parametrize(
    ("name", "steps", "options"),
    [*((name, 20, {}) for name in MANAGEABLE), ("submaps", 40, SMALL)],
)
def test_with_identities_the_default_policy_changes_nothing(name, steps, options):
    managed, bare = (make(name, policy, **options) for policy in (True, None))
    for odometry, readings, _ in drive(0, steps):
        for slam in (managed, bare):
            slam.predict(odometry)
        assert managed.update(readings, IDS).nis == bare.update(readings, IDS).nis
    assert options != SMALL or bare.closed_count > 5
    assert_same_bits(managed.belief(), bare.belief())


# --- confirmation ---


def test_a_landmark_enters_with_its_last_sighting_needed():
    slam = make(management={"confirm": (3, 5)})
    scan = polar([(5, 1), (4, -2)])
    first, second = slam.update(scan), slam.update(scan)
    assert first.tentative_rows == second.tentative_rows == (0, 1)
    assert slam.belief().landmark_ids == ()
    np.testing.assert_allclose(slam.tentative_landmarks, [(5, 1), (4, -2)])
    third = slam.update(scan)
    assert third.confirmed_ids == third.added_ids == third.row_ids == (0, 1)
    assert slam.tentative_landmarks.shape == (0, 2)
    assert slam.update(scan).associated_ids == (0, 1)


@pytest.mark.parametrize(("missed", "is_seen_enough"), [(1, True), (2, False)])
def test_a_landmark_enters_after_sightings_in_recent_scans(missed, is_seen_enough):
    slam, scan = make(management={"confirm": (2, 3), "density": 1e-4}), polar([(5, 1)])
    slam.update(scan)
    for _ in range(missed):
        slam.update([])
    assert bool(slam.update(scan).confirmed_ids) == is_seen_enough


@pytest.mark.parametrize("motion", [UNICYCLE, differential(0.5)])
def test_tentative_landmarks_remain_in_place_while_the_robot_moves(motion):
    slam, points = make(management={}, motion=motion), [(5, 1), (4, -2)]
    slam.update(polar(points))
    slam.predict((0.5, 0.4), dt=4.0)
    np.testing.assert_allclose(slam.tentative_landmarks, points, atol=1e-12)
    doubt = slam.state_dict()["0.tentative.covariance"][:3, :3]
    np.testing.assert_allclose(doubt, slam.belief().covariance, atol=1e-15)


@pytest.mark.parametrize("association", ["nearest", "joint", "hypotheses"])
def test_the_caller_may_fill_the_same_array_with_every_scan(association):
    policy = {"association": association, "backdate": True}
    reusing, twin = make(management=policy), make(management=policy)
    array = np.empty((6, 2))
    for odometry, readings, _ in drive(1, 8):
        array[:] = readings
        for slam, scan in ((reusing, array), (twin, readings)):
            slam.predict(odometry)
            slam.update(scan)
    assert len(twin.landmark_ids) == 6
    assert_same_bits(reusing.belief(), twin.belief())


@pytest.mark.parametrize("edit", ["remove", "merge"])
def test_a_change_of_the_map_between_repeated_scans_is_made_again(edit):
    slam = make(management={"confirm": (3, 5), "backdate": True})
    mapped, new = [(5, 1), (4, -2)], [(4, 6)]
    for _ in range(3):
        slam.update(polar(mapped))
    slam.update(polar(new))  # the first sighting
    if edit == "remove":
        slam.remove([1])
    else:
        slam.merge(0, 1)
    slam.update(polar(new))
    assert slam.update(polar(new)).confirmed_ids == (2,)
    assert slam.landmark_ids == (0, 2)


class Own:
    """A filter without checks that writes into the array that it is given."""

    def __init__(self, spoils, **options):
        self._slam, self._spoils = make_estimator("ekf", **options), spoils

    def predict(self, odometry, dt=1.0):
        self._slam.predict(odometry, float(np.ravel(dt)[0].real))

    def update(self, measurements, landmark_ids=None):
        report = self._slam.update(measurements.copy(), landmark_ids)
        if self._spoils:
            measurements[:] = 0.0
        return report

    def __getattr__(self, name):
        return getattr(self._slam, name)


def test_a_filter_that_writes_into_a_scan_does_not_change_what_is_repeated():
    policy, rng = {"association": "joint", "backdate": True}, np.random.default_rng(1)
    writing, twin = (
        ManagedSlam(
            partial(Own, spoils), MOTION_STD, MEASUREMENT_STD, management=policy
        )
        for spoils in (True, False)
    )
    for k in range(12):  # the second landmark enters after scans of the first alone
        scan = np.array([(0.3, 4.0), (-0.5, 3.0)])[: 1 if k < 4 or k % 2 else 2]
        scan += rng.normal(scale=0.01, size=scan.shape)
        for slam in (writing, twin):
            slam.predict((0.1, 0.0))
            slam.update(scan.copy())
    assert len(twin.landmark_ids) == 2
    assert_same_bits(writing.belief(), twin.belief())


@pytest.mark.parametrize("dt", [np.ones(1), np.ones(2), 1 + 0j, np.ma.masked])
def test_a_duration_that_is_no_number_is_refused_for_a_filter_without_checks(dt):
    slam = ManagedSlam(partial(Own, False), MOTION_STD, MEASUREMENT_STD)
    with pytest.raises(ValueError, match="dt must be a finite number >= 0, got"):
        slam.predict((0.1, 0.0), dt)
    assert slam.steps == 0


def test_too_few_sightings_leave_no_trace():
    slam, bare = make(management={"confirm": (3, 4)}), make(management=None)
    clutter = [(1.0, 5.0)]
    for step in range(12):
        for each in (slam, bare):
            each.predict((0.1, 0.0))
        slam.update(clutter if step % 3 == 0 else np.empty((0, 2)))
        assert len(slam.tentative_landmarks) == 1
    assert_same_bits(slam.belief(), bare.belief())
    for _ in range(4):
        slam.update([])
    assert len(slam.tentative_landmarks) == 0


def test_a_tentative_landmark_is_followed_while_the_robot_drives_and_turns():
    slam = make(management={"confirm": (4, 4)})
    pose = np.zeros(3)
    for _ in range(4):
        report = slam.update(polar([(3, 4)], pose))
        slam.predict((0.7, 0.5))
        pose += [0.7 * np.cos(pose[2]), 0.7 * np.sin(pose[2]), 0.5]
    assert report.confirmed_ids == (0,)
    np.testing.assert_allclose(slam.belief().landmarks, [(3, 4)], atol=1e-6)


@pytest.mark.parametrize(("options", "stays"), [({"noise_at_rest": False}, 1), ({}, 0)])
def test_a_tentative_landmark_stays_as_it_is_where_a_resting_robot_has_no_noise(
    options, stays
):
    slam = make(management={}, **options)
    slam.update(polar([(3, 4)]))
    before = slam.state_dict()
    slam.predict((0.0, 0.0))
    after = slam.state_dict()
    key = "0.tentative.covariance"
    assert np.array_equal(before[key], after[key]) == stays
    slam.predict((0.1, 0.0))
    assert (np.linalg.det(slam.state_dict()[key]) > np.linalg.det(before[key])).all()


def test_a_saved_tentative_landmark_of_negative_variance_is_refused():
    slam = make(management={})
    slam.update(polar([(3, 4)]))
    key = "0.tentative.covariance"
    state = slam.state_dict()
    with pytest.raises(ValueError, match=r"covariance'\] must be positive semidef"):
        slam.load_state_dict(state | {key: -state[key]})
    with pytest.raises(ValueError, match=r"tentative.covariance'\] must be symmetric"):
        slam.load_state_dict(state | {key: np.triu(state[key])})


@pytest.mark.parametrize("keys", [("mean", "covariance"), ("seen", "labels", "odds")])
def test_saved_tentative_landmarks_of_another_number_are_refused(keys):
    slam, other = make(management={}), make(management={})
    slam.update(polar([(3, 4), (4, -2)]))
    other.update(polar([(3, 4)]))
    parts = {key: other.state_dict()[key] for key in (f"0.tentative.{k}" for k in keys)}
    with pytest.raises(ValueError, match="must have shape"):
        slam.load_state_dict(slam.state_dict() | parts)


def test_identities_need_confirmation_where_they_are_not_trusted():
    slam = make(management={"confirm": (2, 3), "trust_ids": False})
    scan = polar([(5, 1), (4, -2)])
    assert slam.update(scan, [7, 9]).tentative_rows == (0, 1)
    slam.update([], [])
    assert slam.update(scan[:1], [7]).confirmed_ids == (7,)
    assert slam.update(scan[1:], [9]).confirmed_ids == ()  # the first is too long ago
    assert slam.update(scan[1:], [9]).confirmed_ids == (9,)


def test_bearing_noise_that_grows_near_the_robot_widens_the_gate_there():
    narrow, wide = make(), make(bearing_std_metres=0.2)
    places = np.array([(1.0, 0.0), (10.0, 0.0)])
    for slam in (narrow, wide):
        for _ in range(3):
            slam.update(polar(places))
    aside = polar(places) + np.array([0.2, 0.0])  # 0.2 m and 2 m across
    assert narrow.update(aside).row_ids == (None, None)
    assert wide.update(aside).row_ids == (0, None)


@pytest.mark.parametrize("association", ["nearest", "joint", "hypotheses"])
def test_a_sensor_of_positions_is_managed_as_with_known_identities(association):
    noise = {"measurement_std": (0.0, 0.1), "bearing_std_metres": 0.1}
    slam = make(management={"association": association, "confirm": (1, 1)}, **noise)
    known = make(management=None, **noise)
    rng = np.random.default_rng(2)
    pose = np.zeros(3)
    for _ in range(12):
        pose += [0.5 * np.cos(pose[2]), 0.5 * np.sin(pose[2]), 0.2]
        scan = polar(SIX + 0.1 * rng.standard_normal(SIX.shape), pose)
        for each, ids in ((slam, None), (known, IDS)):
            each.predict((0.5, 0.2))
            each.update(scan, ids)
    found, expected = slam.belief(), known.belief()
    assert len(found.landmark_ids) == 6
    np.testing.assert_array_equal(found.mean[:3], expected.mean[:3])
    np.testing.assert_allclose(found.covariance, expected.covariance, atol=1e-12)


def test_a_reading_that_could_be_of_two_landmarks_is_left_out():
    slam = make(management={"ambiguity": 2.0})
    slam.update(polar([(5, 0.1), (5, -0.1)]), [3, 4])
    report = slam.update(polar([(5, 0.0)]))
    assert report.ambiguous_rows == (0,)
    assert report.row_ids == (None,)
    assert report.degrees_of_freedom == 0
    report = slam.update([(0.0, 1e-9), (0.0, -1.0)])  # too close to tell
    assert report.ambiguous_rows == (0, 1)


class WithoutAWindow:
    """A filter as it is, but for its view of what is around the robot."""

    def __init__(self, name, **options):
        self._slam = make_estimator(name, **options)

    def __getattr__(self, name):
        if name == "local_view":
            raise AttributeError(name)
        return getattr(self._slam, name)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("compressed", {"local_size": 40}),
        ("compressed", {"base": "invariant", "local_size": 40}),
        ("sparse_information", {}),
    ],
)
def test_to_look_around_the_robot_decides_the_same_as_to_look_at_the_whole_map(
    name, options
):
    noise = {"motion_std": TOWN_MOTION_STD, "measurement_std": MEASUREMENT_STD}
    noise["initial_pose_std"] = (0.5, 0.5, 0.02)  # landmarks may be elsewhere
    policy = LandmarkPolicy(**TIDY | {"capacity": 420, "view": FieldOfView(15.0)})
    near = make_estimator(name, management=policy, **noise, **options)
    whole = ManagedSlam(
        partial(WithoutAWindow, name), management=policy, **noise, **options
    )
    for slam in (near, whole):
        map_all(slam, 300)
    changed = False
    for odometry, readings, _ in wander(300, 15):
        for slam in (near, whole):
            slam.predict(odometry)
        one, other = near.update(readings), whole.update(readings)
        for kind in ("row_ids", "ambiguous_rows", "removed_ids", "merged_ids"):
            assert getattr(one, kind) == getattr(other, kind)
        changed |= bool(one.removed_ids or one.merged_ids)
    assert changed
    assert len(near.filter.local_view(15.0).ids) < len(near.landmark_ids) - 100


def test_new_identities_are_never_used_twice():
    slam = make(management={"confirm": (1, 1), "view": AROUND, "remove_after": 2})
    slam.update(polar([(5, 1)]), [11])
    assert slam.update(polar([(5, 1), (4, -2)])).row_ids == (11, 12)
    for _ in range(2):
        slam.update(polar([(5, 1)]))
    assert slam.belief().landmark_ids == (11,)
    assert slam.update(polar([(5, 1), (4, -2)])).added_ids == (13,)


# --- removal ---


def removed_after(view, steps=6, scan=((5, 1),), pose=(0, 0, 0)):
    """Scans until landmark 1 at (4, −2) is removed when only others are seen."""
    slam = make(management={"view": view, "remove_after": 3}, initial_pose=pose)
    slam.update(polar([(5, 1), (4, -2)], pose), [0, 1])
    for step in range(1, steps + 1):
        report = slam.update(polar(scan, pose), range(0, 2 * len(scan), 2))
        if report.removed_ids:
            assert report.removed_ids == (1,)
            return step
    return None


@pytest.mark.parametrize(
    ("view", "after"),
    [
        (AROUND, 3),
        (FieldOfView(4.0), None),
        (FieldOfView(4.8), None),  # within the margin of the range
        (FieldOfView(30.0, min_range=4.2), None),
        (FieldOfView(30.0, angle=0.8), None),
        (FieldOfView(30.0, angle=0.95), None),  # within the margin of the angle
        (FieldOfView(30.0, visible=lambda _, landmarks: landmarks[:, 1] > 0), None),
    ],
)
def test_who_should_be_seen_and_is_not_is_removed_and_nobody_else(view, after):
    assert removed_after(view) == after


def test_who_may_stand_behind_another_is_not_missed():
    in_front = [(5, 1), (2, -1.05)]
    assert removed_after(FieldOfView(30.0, shadow=0.1), scan=in_front) is None
    assert removed_after(FieldOfView(30.0, shadow=0.01), scan=in_front) == 3
    behind = [(5, 1), (8, -4.05)]
    assert removed_after(FieldOfView(30.0, shadow=0.1), scan=behind) == 3


def is_expected(view, pose, place, scan):
    """Return whether a scan should show a place, one condition after the other."""
    away = math.dist(place, pose[:2])
    bearing = math.atan2(place[1] - pose[1], place[0] - pose[0]) - pose[2]
    if away > view.max_range - view.range_margin:
        return False
    if 0 < view.min_range > away - view.range_margin:
        return False
    aside = abs(math.remainder(bearing, 2 * math.pi))
    if view.angle < 2 * math.pi and aside > view.angle / 2 - view.bearing_margin:
        return False
    gaps = [(abs(math.remainder(bearing - b, 2 * math.pi)), r) for b, r in scan]
    return not view.shadow or all(b > view.shadow or r >= away for b, r in gaps)


def test_a_scan_should_show_what_is_well_in_view_and_not_behind_a_reading():
    rng, shares = np.random.default_rng(2), []
    for _ in range(60):
        far, margin, aside, shadow = rng.uniform((4, 0, 0, 0), (9, 1, 0.3, 0.4))
        view = FieldOfView(
            far,
            min_range=rng.choice([0.0, 1.5]),
            angle=rng.choice([2 * np.pi, 2.5]),
            range_margin=margin,
            bearing_margin=aside,
            shadow=rng.choice([0.0, shadow]),
        )
        pose = rng.uniform((-2, -2, -9), (2, 2, 9))
        places = rng.uniform(-6, 6, (40, 2))
        scan = rng.uniform((-9, 0), (9, 6), (rng.integers(4), 2))
        found = view.expects(pose, places, scan).tolist()
        assert found == [is_expected(view, pose, place, scan) for place in places]
        shares.append(np.mean(found))
    assert 0.1 < np.mean(shares) < 0.6
    edge = FieldOfView(5.0, min_range=1.0, range_margin=0.5, angle=2.0, shadow=0.5)
    at = np.array([(4.5, 0.0), (1.5, 0.0)])  # on both limits
    assert edge.expects(np.zeros(3), at, np.empty((0, 2))).all()
    (behind, before) = edge.expects(np.zeros(3), at, np.array([(-0.5, 1.5)]))
    assert (behind, before) == (False, True)  # on the edge of the shadow
    for edge in (FieldOfView(5.0), FieldOfView(5.0, angle=1.0, bearing_margin=0.5)):
        assert edge.expects(np.zeros(3), at, np.array([(0.0, 1.0)])).all()


def test_a_scan_reaches_as_far_as_landmarks_may_be_read_missed_or_merged():
    scan = np.array([(0.0, 3.0), (1.0, np.inf), (2.0, 7.0)])
    missing = {"view": FieldOfView(9.0), "remove_after": 3}
    assert LandmarkPolicy().reach(scan) == 7.0
    assert LandmarkPolicy(view=FieldOfView(9.0)).reach(scan) == 7.0
    assert LandmarkPolicy(merge_within=0.5, **missing).reach(scan) == 9.5
    assert LandmarkPolicy().reach(np.empty((0, 2))) == 0.0
    policy = LandmarkPolicy(merge_within=1.2, merge_gate=9.0)
    assert policy.worst_separation_std == pytest.approx(0.2)


def test_the_visibility_model_is_asked_in_the_frame_of_the_map():
    asked = []

    def visible(pose, landmarks):
        asked.append((pose, landmarks))
        return np.zeros(len(landmarks), dtype=bool)

    removed_after(FieldOfView(30.0, visible=visible), steps=1, pose=(1, 2, 0.5))
    (pose, landmarks), *_ = asked
    np.testing.assert_allclose(pose, (1, 2, 0.5))
    np.testing.assert_allclose(landmarks, [(5, 1), (4, -2)], atol=1e-9)


def test_a_visibility_model_may_write_into_its_arguments():
    def visible(pose, landmarks):
        pose[:] = landmarks[:] = np.nan
        return np.ones(len(landmarks), dtype=bool)

    pose, landmarks = np.zeros(3), np.array([(5.0, 1.0)])
    view = FieldOfView(30.0, visible=visible)
    assert view.expects(pose, landmarks, np.empty((0, 2))).all()
    assert np.isfinite([*pose, *landmarks[0]]).all()


@pytest.mark.parametrize(
    "answer", [np.ones(1, bool), np.ones(2), np.ones((2, 1), bool)]
)
def test_a_visibility_model_that_answers_nonsense_is_refused(answer):
    view = FieldOfView(30.0, visible=lambda *_: answer)
    slam = make(management={"view": view, "remove_after": 2})
    slam.update(polar([(5, 1), (4, -2)]), [0, 1])
    before = digest(slam)
    with pytest.raises(ValueError, match="visible must return 2 booleans"):
        slam.update(polar([(5, 1)]), [0])
    assert digest(slam) == before


def test_a_sighting_forgives_earlier_misses():
    slam = make(management={"view": AROUND, "remove_after": 3})
    both = polar([(5, 1), (4, -2)])
    slam.update(both, [0, 1])
    for _ in range(4):
        for ids in ([0], [0], [0, 1]):
            assert slam.update(both[: len(ids)], ids).removed_ids == ()


def test_a_landmark_whose_readings_are_refused_is_not_missing():
    slam = make(management={"view": AROUND, "remove_after": 2}, gate_probability=0.99)
    both = polar([(5, 1), (4, -2)])
    slam.update(both, [0, 1])
    for _ in range(5):
        report = slam.update(both + np.array([(0, 0), (0, 3)]), [0, 1])
        assert report.rejected_ids == (1,)
        assert report.removed_ids == ()


def test_a_landmark_that_an_ambiguous_reading_may_be_of_is_not_missing():
    slam = make(management={"ambiguity": 2.0, "view": AROUND, "remove_after": 2})
    slam.update(polar([(5, 0.1), (5, -0.1), (4, -3)]), [3, 4, 5])
    for _ in range(4):
        report = slam.update(polar([(5, 0.0), (4, -3)]))
        assert report.ambiguous_rows == (0,)
        assert report.removed_ids == ()


def test_the_field_of_view_turns_with_the_robot():
    ahead = FieldOfView(30.0, angle=1.0)
    landmarks = np.array([(0.0, 5.0), (5.0, 0.0)])
    seen = ahead.expects(np.array([0, 0, np.pi / 2]), landmarks, np.empty((0, 2)))
    assert seen.tolist() == [True, False]


# --- merging ---


def state_nees(belief, true_pose, landmarks):
    """NEES of pose and map per degree of freedom, in the filter's own frame."""
    there = landmarks[[i % len(landmarks) for i in belief.landmark_ids]]
    error, P = belief.error(true_pose, there), belief.error_covariance()
    return float(normalised_squared_error(error, P)) / len(error)


def in_band(nees, dof):
    """Whether the average over runs is that of a consistent filter."""
    low, high = chi2.ppf([0.0005, 0.9995], dof * len(nees)) / (dof * len(nees))
    return low < np.mean(nees) < high


def merged_runs(name, start_std, runs=100, steps=40):
    """Drives in which landmark 0 gets another name for the second half."""
    policy = LandmarkPolicy(merge_within=2.0)
    errors, merges = [], 0
    for seed in range(runs):
        slam = make(name, policy, initial_pose_std=start_std)
        steps_of_run = list(drive(seed, steps, start_std=start_std))
        for step, (odometry, readings, _) in enumerate(steps_of_run):
            slam.predict(odometry)
            first = 0 if step < steps // 2 else 6
            report = slam.update(readings, [first, *IDS[1:]])
            merges += len(report.merged_ids)
        errors.append(state_nees(slam.belief(), steps_of_run[-1][2], SIX))
    return np.array(errors), merges / runs


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "start_std"), [("ekf", (0, 0, 0)), ("invariant", (0.1, 0.1, 0.1))]
)
def test_merging_true_duplicates_keeps_the_filter_consistent(name, start_std):
    nees, merges = merged_runs(name, start_std)
    assert merges > 0.95
    assert in_band(nees, 15)


@pytest.mark.slow
def test_two_neighbours_are_not_merged():
    """0.3 m apart, never seen in one scan, so that only their distance tells."""
    landmarks = np.vstack([SIX, SIX[0] + (0.3, 0.0)])
    policy, tested = LandmarkPolicy(merge_within=0.3), []
    for seed in range(20):
        slam = make("ekf", policy)
        for step, (odometry, readings, _) in enumerate(
            drive(seed, 80, landmarks=landmarks)
        ):
            slam.predict(odometry)
            ids = [6 * (step % 2), *IDS[1:]]
            assert not slam.update(readings[ids], ids).merged_ids
        both = slam.belief((0, 6))
        _, D = separation(both.mean, both.covariance, 3, 5)
        tested.append(largest_std(D) < policy.worst_separation_std)
    assert np.mean(tested) > 0.9


@pytest.mark.parametrize("names", [(3, 7), (7, 3)])
def test_landmarks_seen_together_are_never_merged(names):
    slam = make(management={"merge_within": 1.0})
    for _ in range(60):
        report = slam.update(polar([(5, 1), (5, 1), (-3, 2)]), [*names, 9])
        assert report.merged_ids == ()


@pytest.mark.parametrize("name", ["ekf", "compressed"])
def test_landmarks_seen_together_are_apart_up_to_twice_the_distance_of_a_merge(name):
    slam, other = (make(name, {"merge_within": 1.25}) for _ in range(2))
    slam.update(polar([(4, 0), (4, 2.2), (4, 5.2)]), [0, 1, 2])
    other.load_state_dict(slam.state_dict())
    for each in (slam, other):
        assert each.best.pruner.records.apart == {(0, 1)}


def test_two_duplicates_of_a_landmark_are_merged_after_a_scan_of_one():
    apart, slam = make(management={}), make(management={"merge_within": 1.0})
    for k in range(60):
        apart.update(polar([(5, 1), (-3, 2)]), [k % 3, 9])
    slam.load_state_dict(apart.state_dict())
    assert slam.update(polar([(5, 1)]), [2]).merged_ids == ((0, 2), (0, 1))
    assert slam.decisions[-1].merged == ((0, 2), (0, 1))
    slam.reset((0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    for k in range(60):  # half a metre apart, beyond the gate
        report = slam.update(polar([(5, 1 + 0.5 * (k % 2)), (-3, 2)]), [k % 2, 9])
        assert report.merged_ids == ()


@pytest.mark.parametrize("name", MANAGEABLE)
def test_landmarks_are_merged_and_removed_by_hand_too(name):
    slam = make(name, {"merge_within": None})
    places = np.array([(4, 1), (4, -2), (6, 2)])
    for _ in range(5):
        slam.update(polar(places), [0, 1, 2])
    slam.update(polar(places[2:]), [7])
    slam.merge(2, 7)
    assert slam.best.pruner.records.ids == slam.landmark_ids
    assert slam.update(polar(places[2:]), [7]).row_ids == (2,)
    slam.remove([1])
    assert slam.landmark_ids == slam.best.pruner.records.ids == (0, 2)
    np.testing.assert_allclose(slam.belief([2]).landmarks, [(6, 2)], atol=0.01)
    for refused in (lambda: slam.remove([0, 1]), lambda: slam.merge(0, 7)):
        with pytest.raises(ValueError, match="mapped landmarks, got"):
            refused()
    with pytest.raises(ValueError, match="must be two landmarks, got 2 twice"):
        slam.merge(2, 2)
    assert slam.landmark_ids == (0, 2)


def test_a_merged_landmark_answers_to_both_names():
    slam = make(management={"merge_within": 1.0})
    place = polar([(5, 1), (2, 2)])
    for _ in range(30):
        slam.update(place, [0, 1])
    before = slam.snapshot()
    pairs = [pair for _ in range(30) for pair in slam.update(place, [8, 1]).merged_ids]
    assert pairs == [(0, 8)]
    assert slam.belief().landmark_ids == (0, 1)
    assert slam.update(place[:1], [8]).associated_ids == (0,)
    both = slam.update(np.vstack([place[:1], place[:1]]), [0, 8])
    assert both.associated_ids == (0,)
    assert both.ambiguous_rows == (1,)
    for back in (partial(slam.resume, before), partial(slam.reset, *np.zeros((2, 3)))):
        back()
        assert slam.update(place[:1], [8]).added_ids == (8,)  # other names


def test_records_of_merged_landmarks_are_those_of_one_with_all_their_names():
    records = LandmarkRecords()
    records.follow([4, 7, 9, 11])
    records.misses[:] = 2, 3, 1, 0
    records.information[:] = np.arange(12.0).reshape(4, 3)
    records.apart = {(9, 11)}
    records.join(7, 9)
    records.join(4, 7)
    assert records.misses.tolist() == [1, 1, 1, 0]  # it was seen as 9
    expected = [[9, 12, 15], [9, 11, 13], [6, 7, 8], [9, 10, 11]]
    assert records.information.tolist() == expected
    assert records.aliases == {7: 4, 9: 4}
    records.follow([4, 11])
    assert records.apart == {(4, 11)}
    records.doubtful, there = {11}, LandmarkRecords()
    there.restore(records.state())
    np.testing.assert_equal(vars(there), vars(records))


# --- capacity ---


def test_beyond_its_capacity_a_map_gives_up_what_it_knows_least_of():
    slam = make(management={"capacity": 3})
    scan = polar([(5, 1), (4, -2), (3, 3)])
    slam.update(scan, [0, 1, 2])
    slam.update(scan[:2], [0, 1])
    report = slam.update(polar([(-3, 2)]), [3])
    assert report.removed_ids == slam.decisions[-1].removed == (2,)  # read once
    assert slam.belief().landmark_ids == (0, 1, 3)
    report = slam.update(polar([(-3, -2), (-3, 2)]), [4, 3])
    assert report.removed_ids == (0,)  # as often read as 1, but from farther
    assert slam.belief().landmark_ids == (1, 3, 4)


def test_of_landmarks_known_alike_the_newest_is_given_up():
    records = LandmarkRecords()
    records.follow([7, 9, 3, 5])
    records.information[:] = np.outer([1, 1, 1, 2], [1.0, 0.5, 1.0])
    assert records.by_information([7, 9, 3, 5]) == [3, 9, 7, 5]


def test_a_reading_from_afar_informs_less_where_noise_grows_with_the_range():
    """The nearer landmark has the smaller σr + k r, not the smaller σr − k r."""
    policy = {"capacity": 2}
    slam = make(management=policy, range_std_per_metre=0.2 * MEASUREMENT_STD[1])
    slam.update(polar([(4, 0), (0, 2)]), [0, 1])
    assert slam.update(polar([(-3, 2)]), [2]).removed_ids == (0,)


def test_a_full_view_gives_up_the_newcomers():
    slam = make(management={"capacity": 2})
    slam.update(polar([(5, 1), (4, -2)]), [0, 1])
    report = slam.update(polar([(5, 1), (4, -2), (3, 3)]), [0, 1, 2])
    assert report.added_ids == report.removed_ids == (2,)


# --- all together ---


def busy_run(slam, steps, start=0):
    """Readings without identity, with clutter; landmarks vanish and come back."""
    beliefs = []
    for step, (odometry, readings, _) in enumerate(drive(5, start + steps)):
        if step < start:
            continue
        rng = np.random.default_rng([7, step])
        slam.predict(odometry)
        there = readings[:4] if 10 <= step < 27 else readings
        clutter = rng.uniform((-3, 1), (3, 20), (2, 2))
        report = slam.update(np.vstack([there, clutter]))
        beliefs.append((report, slam.belief()))
    return beliefs


def test_members_that_a_filter_passes_on_are_its_own_after_a_state_is_loaded():
    slam = make("sparse_information", True)
    busy_run(slam, 4)
    saved = slam.state_dict()
    slam.load_state_dict(saved)
    slam.resume(slam.snapshot())
    slam.reset((0.0, 0.0, 0.0), (0.1, 0.1, 0.1))
    assert slam.local_view.__self__ is slam.filter
    assert not hasattr(
        make("sparse_information", {"association": "hypotheses"}), "local_view"
    )


def test_every_call_is_one_step_and_a_snapshot_holds_their_number_and_the_report():
    slam = make("ekf", {"confirm": (1, 1)})
    report = slam.update([(0.5, 4.0)])
    before, steps = slam.snapshot(), slam.steps
    slam.predict((0.1, 0.0))
    slam.observe_pose(0.0, [0, 0, 1], 1.0)
    slam.update([(0.5, 4.0)])
    assert slam.steps == steps + 3
    slam.resume(before)
    assert (slam.steps, slam.report()) == (steps, report)
    for largest, is_lost in ((3.0, False), (3.1, True)):
        known, evidence = slam.best.candidates, LostEvidence(largest=largest)
        found = known.detections._replace(lost=evidence)
        slam.best.candidates = known._replace(detections=found)
        assert (slam.lost_score, slam.probably_lost) == (largest, is_lost)


@pytest.mark.parametrize(
    ("name", "association"),
    [("ekf", "hypotheses"), ("compressed", "joint"), ("ideal", "joint")],
)
def test_the_filter_decides_the_default_association(name, association):
    for factory in (find_estimator(name), partial(find_estimator(name))):
        assert ManagedSlam(factory, **NOISE).policy.association == association


def test_a_foreign_or_damaged_state_is_refused():
    slam, other = make(management=TIDY), make(management=None)
    busy_run(slam, 8)
    saved, before = slam.state_dict(), digest(slam)
    damaged = saved | {"0.landmarks.apart": np.zeros((2, 3), dtype=int)}
    lacking = {key: saved[key] for key in saved if key != "0.landmarks.misses"}
    for state, message in (
        (other.state_dict(), "state is of EkfSlam, not of ManagedSlam"),
        (lacking, r"state must hold 'landmarks\.misses'"),
        (make("invariant", TIDY).state_dict(), "state is of InvariantEkfSlam"),
        (damaged, r"apart'\] must have shape \(-1, 2\)"),
    ):
        with pytest.raises(ValueError, match=message):
            slam.load_state_dict(state)
        assert digest(slam) == before


@pytest.mark.parametrize("name", MANAGEABLE)
def test_a_filter_that_went_on_takes_back_what_it_saved(name):
    slam = make(name, TIDY)
    unrun = slam.state_dict()
    busy_run(slam, 8)
    early = slam.state_dict()
    busy_run(slam, 17, start=8)
    expected = digest(slam)
    for saved, start in ((early, 8), (unrun, 0)):
        slam.load_state_dict(saved)
        busy_run(slam, 25 - start, start=start)
        assert digest(slam) == expected


def test_reset_forgets_everything():
    slam, fresh = make(management=TIDY), make(management=TIDY)
    busy_run(slam, 25)
    slam.reset((0, 0, 0), (0, 0, 0))
    busy_run(slam, 25)
    busy_run(fresh, 25)
    assert digest(slam) == digest(fresh)


# --- what becomes of it in a replay ---


def hidden_log(steps=30):
    """A drive past six landmarks, the last two gone after ten steps; no identities."""
    events = []
    for step, (odometry, readings, _) in enumerate(drive(3, steps), start=1):
        there = readings[:4] if step > 10 else readings
        events.append(OdometryRow(float(step), *odometry.tolist(), 1.0))
        events.append(Scan(float(step), there))
    return SlamLog(
        "hidden", landmark_ids=[10, 11, 12, 13, 14, 15], landmarks=SIX, events=events
    )


def hidden_settings(**options):
    return settings_for(hidden_log(1), estimator="ekf", **NOISE, options=options)


def test_a_log_without_identities_is_associated():
    settings = hidden_settings()
    assert settings.options["management"] is True
    run = replay(hidden_log(), settings.make((0, 0, 0)))
    summary = summarise(run, settings)
    assert summary["estimator"] == "EkfSlam"
    assert len(summary["landmarks"]) == 6
    assert summary["readings"]["tentative"] == 12
    changes = {"confirmed": 6, "removed": 0, "merged": 0, "most": 6}
    assert summary["map_changes"] == changes


def test_the_summary_counts_what_was_done_to_the_map():
    settings = hidden_settings(management={**TIDY, "confirm": (1, 1)})
    summary = summarise(replay(hidden_log(), settings.make((0, 0, 0))), settings)
    assert summary["map_changes"]["removed"] == 2
    assert summary["map_changes"]["most"] == 6
    assert len(summary["landmarks"]) == 4
    few = hidden_settings(management={**TIDY, "confirm": (1, 1), "capacity": 3})
    found = replay(hidden_log(), few.make((0, 0, 0))).changes
    assert found.most == found.confirmed - found.removed == 3


def test_own_identities_are_scored_by_the_nearest_truth():
    run = replay(hidden_log(), hidden_settings().make((0, 0, 0)))
    errors = [row["euclidean"] for row in summarise(run)["landmarks"]]
    assert max(errors) < 0.5
    false_one = np.vstack([run.belief.landmarks, (3.4, 6.2)])
    path = run.trace.t, run.trace.poses
    truth = true_landmarks_of(run.log, range(7), false_one, path)
    assert np.isfinite(truth[:6]).all()
    assert np.isnan(truth[6]).all()
    np.testing.assert_array_equal(np.sort(truth[:6], axis=0), np.sort(SIX, axis=0))
    # a path almost at rest determines no angle: the map is paired as it is
    rest = np.array([[0.0, 0, 0, 0], [1, 1e-3, 0, 0]])
    at_rest = replace(run.log, ground_truth=rest)
    path = rest[:, 0], -rest[:, 1:]
    again = true_landmarks_of(at_rest, range(7), false_one, path)
    np.testing.assert_array_equal(again, truth)


def test_the_replay_sees_the_same_with_and_without_a_door_to_parts():
    log, settings = hidden_log(), hidden_settings(management=TIDY)
    one = replay(log, settings.make((0, 0, 0))).trace
    slam = settings.make((0, 0, 0))
    doors = ("predict", "update", "belief")  # the belief as a whole only
    closed = SimpleNamespace(**{name: getattr(slam, name) for name in doors})
    other = replay(log, closed).trace
    names = ("poses", "predicted_poses", "pose_covariances", "landmarks")
    for key in (*names, "first_landmarks", "first_covariance"):
        np.testing.assert_array_equal(getattr(one, key), getattr(other, key))
    for mine, theirs in zip(one.landmark_history, other.landmark_history, strict=True):
        for a, b in zip(mine, theirs, strict=True):
            np.testing.assert_array_equal(a, b)


# --- a filter that joins its map only when it is asked ---


@pytest.mark.parametrize("base", ["ekf", "invariant"])
def test_managed_submaps_keep_the_contract_also_when_they_are_closed(base):
    options = {"base": base, "management": TIDY, **SMALL}
    assert check_estimator(partial(make_estimator, "submaps", **options)) == ()


@pytest.mark.slow
def test_submaps_associate_as_a_full_filter_does():
    """Readings without identity, with clutter; landmarks vanish and come back."""
    full, joined = make("invariant", TIDY), make("submaps", TIDY, **SMALL)
    fates = "row_ids", "tentative_rows", "ambiguous_rows", "confirmed_ids"
    for (one, _), (other, _) in zip(
        busy_run(full, 60), busy_run(joined, 60), strict=True
    ):
        for name in (*fates, "removed_ids", "added_ids"):
            assert getattr(one, name) == getattr(other, name)
    assert joined.filter.closed_count > 10
    one, other = full.belief(), joined.belief()
    assert one.landmark_ids == other.landmark_ids
    std = np.sqrt(np.diag(one.covariance))
    np.testing.assert_allclose((one.mean - other.mean) / std, 0, atol=0.3)


def test_landmarks_begun_in_a_new_submap_count_as_seen():
    slam = make("submaps", {"view": AROUND, "remove_after": 3}, **SMALL)
    others = IDS[:-1]
    for step, (odometry, readings, _) in enumerate(drive(0, 20)):
        slam.predict(odometry)
        ids = IDS if step % 3 == 0 else others
        assert slam.update(readings[ids], ids).removed_ids == ()
    state = slam.state_dict()
    assert slam.filter.closed_count > 3
    assert state["0.landmarks.misses"].tolist() == [0] * 5 + [1]
    assert (state["0.landmarks.information"][:, [0, 2]] > 0).all()


@pytest.mark.slow
def test_a_saved_run_in_submaps_in_a_folder_goes_on_bit_for_bit(tmp_path):
    options = {**SMALL, "folder": tmp_path / "run"}
    whole, first = make("submaps", TIDY, **SMALL), make("submaps", TIDY, **options)
    expected = busy_run(whole, 60)
    busy_run(first, 27)
    second = make("submaps", TIDY, **options)
    second.load_state_dict(first.state_dict())
    for (report, belief), (other, again) in zip(
        expected[27:], busy_run(second, 33, start=27), strict=True
    ):
        assert_same_bits(belief, again)
        assert report.row_ids == other.row_ids
        assert report.removed_ids == other.removed_ids
    assert any(report.removed_ids for report, _ in expected)


@pytest.mark.slow
def test_the_capacity_of_submaps_counts_the_landmarks_far_away_too():
    landmarks = np.column_stack([np.arange(0, 42, 3.0), np.tile([3.0, -3.0], 7)])
    slam, gone = make("submaps", {"capacity": 8}, **SMALL), []
    for odometry, readings, _ in drive(1, 50, landmarks=landmarks, odometry=(0.75, 0)):
        slam.predict(odometry)
        ids = np.flatnonzero(readings[:, 1] < 5.0)
        gone += slam.update(readings[ids], ids).removed_ids
        assert len(slam.landmark_ids) <= 8
    assert set(gone) | set(slam.landmark_ids) == set(range(14))
    assert slam.belief().landmark_ids == slam.landmark_ids


def test_a_replay_of_submaps_tells_what_they_could_say_at_once():
    log = hidden_log(58)
    runs = [
        replay(
            log,
            settings_for(
                log, estimator=name, **NOISE, options={**options, "management": NEAREST}
            ).make((0, 0, 0)),
        )
        for name, options in (("invariant", {}), ("submaps", SMALL))
    ]
    full, joined = (run.trace for run in runs)
    std = np.sqrt(np.diagonal(full.pose_covariances, axis1=1, axis2=2))[1:]
    shift = joined.poses[1:] - full.poses[1:]
    np.testing.assert_allclose(shift / std, 0, atol=0.3)
    change = joined.pose_covariances[1:] - full.pose_covariances[1:]
    np.testing.assert_allclose(change / (std[:, :, None] * std[:, None]), 0, atol=0.1)
    np.testing.assert_array_equal(joined.poses[-1], runs[1].belief.pose)
    assert runs[0].changes == runs[1].changes
