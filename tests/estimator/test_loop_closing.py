"""Loops closed after long drift by constellations, in managed filters."""

from types import MappingProxyType

import numpy as np
import pytest
from comparison import assert_same_bits
from scipy.stats import multivariate_normal

from slamgym.envs import LandmarkWorldEnv
from slamgym.estimator import LandmarkPolicy, make_estimator
from slamgym.estimator.association.constellations import Constellations
from slamgym.estimator.association.scan_assignments import Noise
from slamgym.estimator.filters.pose_readings import observe_relative_pose
from slamgym.estimator.interface import Belief, MapView
from slamgym.estimator.map_management.loop_closing import (
    AROUND,
    OFFSET_GATE,
    _gaps,
    _offsets,
    is_astray,
    lost,
    places_of_scan,
    same_landmarks,
    with_readings,
)
from slamgym.estimator.map_management.map_editor import MapEditor
from slamgym.estimator.map_management.policy import as_policy
from slamgym.sim_configs import action_sequence, load_scenario

EIGHT = {"least": 8, "always": True}
POLICY = {"association": "joint", "backdate": True, "constellations": True}
OPTIONS = {
    "invariant": {},
    "compressed": {"base": "invariant"},
    "submaps": {"submap_size": 30},
}


@pytest.fixture(scope="module")
def lap():
    """Odometry, readings and true identities of a lap until the loop is closed."""
    world = load_scenario("lost_loop")
    env = LandmarkWorldEnv(world)
    observation, info = env.reset(seed=40)
    steps = []
    for action in action_sequence(world)[:285]:
        mask = observation["mask"]
        ids = np.asarray(info["landmark_ids"])[: mask.sum()].tolist()
        readings = observation["landmarks"][mask]
        steps.append((observation["odometry"], readings, ids, info["pose"]))
        observation, *_, info = env.step(action)
    return steps


def made(name="invariant", **changes):
    world = load_scenario("lost_loop")
    noise = {"motion_std": world.motion.std, "measurement_std": world.sensor.std}
    return make_estimator(name, **noise, management=POLICY | changes, **OPTIONS[name])


def run(slam, steps, owners):
    """Feed steps; return the merged pairs, and note who each landmark is."""
    merged = []
    for odometry, readings, ids, _ in steps:
        slam.predict(odometry)
        report = slam.update(readings)
        for true, i in zip(ids, report.row_ids, strict=True):
            if i is not None:
                owners.setdefault(i, true)
        merged += report.merged_ids
    return merged


def duplicates(slam, owners):
    true = [owners[i] for i in slam.landmark_ids]
    return len(true) - len(set(true))


@pytest.mark.slow
@pytest.mark.parametrize("name", OPTIONS)
def test_a_lost_loop_is_closed(lap, name):
    owners = {}
    slam = made(name)
    merged = run(slam, lap, owners)
    assert len(merged) >= 6
    assert all(owners[kept] == owners[gone] for kept, gone in merged)
    assert duplicates(slam, owners) == 0
    end, truth = slam.belief([]).pose, lap[-1][3]
    assert np.hypot(*(end - truth)[:2]) < 2.0


# --- small maps ---

PLACE = np.array([(2, 2), (3, -2), (5, 1), (6, -1), (8, 2), (9, -3), (4, 4.0)])


def readings_of(landmarks, pose=(0.0, 0.0, 0.0)):
    d = landmarks - np.array(pose[:2])
    bearings = np.arctan2(d[:, 1], d[:, 0]) - pose[2]
    return np.column_stack([bearings, np.hypot(d[:, 0], d[:, 1])])


def lost_and_seen_again(scans=3, given=None, name="invariant", **changes):
    """Map a place, lose the way by noise alone, and see the place again."""
    slam = make_estimator(
        name,
        motion_std=(0.01, 0.01, 0.005),
        measurement_std=(0.01, 0.03),
        management={
            "association": "joint",
            "constellations": {"always": True},
            "confirm": (2, 3),
        }
        | changes,
        **OPTIONS[name],
    )
    for _ in range(3):
        slam.update(readings_of(PLACE))
    slam.predict((0.0, 0.0), dt=30_000.0)  # σ = 1.7 m and 0.9 rad
    where = (0.8, -0.9, 0.3)
    merged = []
    for _ in range(scans):
        merged += slam.update(readings_of(PLACE, where), given).merged_ids
    return slam, merged, where


def test_a_constellation_is_merged_with_the_older_one():
    slam, merged, where = lost_and_seen_again()
    assert sorted(merged) == [(i, i + 7) for i in range(7)]
    assert slam.landmark_ids == tuple(range(7))
    np.testing.assert_allclose(slam.belief().pose, where, atol=0.05)
    np.testing.assert_allclose(slam.belief().landmarks, PLACE, atol=0.05)


@pytest.mark.parametrize(
    ("name", "association"),
    [
        *(("invariant", each) for each in ("nearest", "joint", "hypotheses")),
        *((name, "joint") for name in ("compressed", "submaps")),
    ],
)
def test_a_saved_state_continues_bit_for_bit_through_the_merge(name, association):
    options = {"association": association, "backdate": association != "nearest"}
    slam, _, where = lost_and_seen_again(scans=1, name=name, **options)
    copy, _, _ = lost_and_seen_again(scans=0, name=name, **options)
    copy.load_state_dict(slam.state_dict())
    scan = readings_of(PLACE, where)
    for _ in range(3):
        for each in (slam, copy):
            each.predict((0.0, 0.0), dt=0.1)
        report = slam.update(scan)
        assert copy.update(scan).merged_ids == report.merged_ids
        assert_same_bits(slam.belief(), copy.belief())
    assert sorted(slam.landmark_ids) == list(range(7))


def test_doubtful_landmarks_are_part_of_the_saved_state():
    slam, _, where = lost_and_seen_again(constellations=EIGHT)
    copy, _, _ = lost_and_seen_again(scans=0, constellations=EIGHT)
    copy.load_state_dict(slam.state_dict())
    two = readings_of(PLACE[:2], where)
    merged = [one.update(two, [0, 1]).merged_ids for one in (slam, copy)]
    assert merged[0] == merged[1] != ()


def test_readings_of_lost_landmarks_are_not_associated_with_them():
    slam, merged, _ = lost_and_seen_again(constellations=EIGHT)
    assert merged == []
    assert len(slam.landmark_ids) == 14


def test_lost_landmarks_are_not_missing():
    view = {"max_range": 20.0}
    changes = {"view": view, "remove_after": 2, "constellations": EIGHT}
    slam, _, _ = lost_and_seen_again(scans=4, **changes)
    assert len(slam.landmark_ids) == 14


def test_landmarks_that_come_with_an_identity_are_not_merged():
    slam, merged, _ = lost_and_seen_again(given=range(20, 27))
    assert merged == []
    assert len(slam.landmark_ids) == 14


def test_a_doubtful_landmark_is_merged_once_the_older_one_is_found_again():
    slam, merged, where = lost_and_seen_again(constellations=EIGHT)
    assert merged == []
    report = slam.update(readings_of(PLACE[:2], where), [0, 1])  # identities are given
    assert set(report.merged_ids) == {(i, i + 7) for i in range(7)}


def test_a_merge_that_fails_leaves_all_as_after_the_scan(monkeypatch):
    slam, _, where = lost_and_seen_again(scans=1)

    def refuse(pairs):
        raise np.linalg.LinAlgError

    monkeypatch.setattr(slam.filter, "merge_pairs", refuse)
    report = slam.update(readings_of(PLACE, where))
    assert report.confirmed_ids == tuple(range(7, 14))
    assert report.merged_ids == ()
    assert len(slam.landmark_ids) == 14


def test_constellations_are_given_by_their_fields_true_or_none():
    assert as_policy({"constellations": True}).constellations == Constellations()
    assert as_policy({"constellations": False}).constellations is None
    rules = as_policy({"constellations": {"least": 8}}).constellations
    assert rules == Constellations(least=8)
    with pytest.raises(ValueError, match="constellations has no 'leest'"):
        as_policy({"constellations": {"leest": 8}})
    with pytest.raises(ValueError, match="constellations must be"):
        LandmarkPolicy(constellations=6)  # type: ignore[arg-type]


@pytest.mark.parametrize("local", [2, 8])
def test_landmarks_are_lost_only_where_a_constellation_can_be_recognised(local):
    count = 14 + local
    mean = np.append(np.zeros(3), np.arange(2.0 * count))
    variance = np.repeat([9.0] * 14 + [0.01] * local, 2)
    view = MapView(mean, np.diag(np.append(np.zeros(3), variance)), tuple(range(count)))
    always = lost(view, Constellations(always=True))
    assert always.tolist() == [True] * 14 + [False] * local
    found = lost(view, Constellations())
    assert found.tolist() == (always.tolist() if local >= 6 else [False] * count)


def test_a_landmark_is_merged_only_into_an_older_one():
    view = MapView(np.array([0, 0, 0, 5, 0, 5, 0.0]), 1e-4 * np.eye(7), (4, 9))
    for doubtful, pairs in (({9}, [(4, 9)]), ({4}, [])):
        found = same_landmarks(view, Constellations(), (), doubtful, within=8.0)
        assert found == (doubtful, pairs)


def lost_alone(places, where, options=MappingProxyType({}), *, name="ekf", **changes):
    """Map some places, lose the way by noise alone, and take one scan of them."""
    slam = make_estimator(
        name,
        motion_std=(0.01, 0.01, 0.005),
        measurement_std=(0.01, 0.03),
        management={"confirm": (2, 3)} | changes,
        **options,
    )
    for _ in range(3):
        slam.update(readings_of(places))
    slam.predict((0.0, 0.0), dt=15_000.0)  # σ = 1.2 m and 0.6 rad
    slam.update(readings_of(places, where))
    return slam


@pytest.mark.parametrize("where", [(0.9, -1.0, 0.5), (-1.4, 0.6, -0.9)])
def test_one_scan_finds_the_place_of_a_robot_that_has_lost_its_map(where):
    slam = lost_alone(PLACE, where)
    assert slam.landmark_ids == tuple(range(7))
    assert None not in slam.decisions[-1].row_ids
    np.testing.assert_allclose(slam.belief().pose, where, atol=0.05)
    blind = lost_alone(PLACE, where, constellations=False)
    assert np.abs(blind.belief().pose - where).max() > 0.1


@pytest.mark.parametrize("name", ["first_estimates", "observability_constrained"])
def test_a_filter_linearises_at_the_place_that_a_scan_has_shown(name):
    where = (-1.4, 0.6, -0.9)
    found = lost_alone(PLACE, where, name=name).belief(())
    np.testing.assert_allclose(found.pose, where, atol=0.02)


def test_landmarks_at_one_point_show_no_turn():
    mean = np.append([0.3, 0.2, 0.5], [4.0, 1.0] * 3)
    belief = Belief(mean, np.eye(9), range(3))
    with np.errstate(all="raise"):
        found = observe_relative_pose(belief, np.zeros(3), np.arange(3), AROUND)
    assert np.isfinite(found.mean).all()


def test_a_scan_that_fits_two_places_continues_at_both():
    group = np.array([(3, 0.5), (4, 1.5), (3.5, -1), (6, 0.2), (5, -1.2)])
    two = np.vstack([group, group + np.array((0.0, 4.0))])
    slam = lost_alone(two, (0.0, 0.0, 0.0))
    slam.predict((0.0, 0.0), dt=15_000.0)
    slam.update(readings_of(group))
    found = [h.filter.belief(()).pose[:2].round(1).tolist() for h in slam.hypotheses]
    assert [0.0, 0.0] in found
    assert [0.0, 4.0] in found


def test_a_filter_that_takes_no_place_continues_as_it_is():
    slam = lost_alone(PLACE, (0.0, 0.0, 0.0), name="submaps", association="hypotheses")
    np.testing.assert_allclose(slam.belief().pose, 0.0, atol=0.01)


@pytest.mark.parametrize("name", ["robocentric", "compressed"])
def test_a_filter_that_keeps_its_belief_elsewhere_observes_its_pose_at_a_place(name):
    where = (-1.4, 0.6, -0.9)
    slam = lost_alone(PLACE, where, name=name, association="hypotheses")
    assert slam.landmark_ids == tuple(range(7))
    np.testing.assert_allclose(slam.belief().pose, where, atol=0.05)


class Elsewhere:
    """A filter that saves its belief with another origin."""

    def __init__(self, **options):
        self._slam = make_estimator("ekf", **options)

    def __getattr__(self, name):
        return getattr(self._slam, name)

    def state_dict(self):
        state = self._slam.state_dict()
        state["mean"][3:] += 100.0
        return state


def test_a_belief_that_is_saved_otherwise_is_not_replaced():
    noise = {"motion_std": (0.01, 0.01, 0.005), "measurement_std": (0.01, 0.03)}
    slam = Elsewhere(**noise)
    slam.update(readings_of(PLACE), range(7))
    assert not MapEditor(slam).can_move
    assert MapEditor(slam._slam).can_move


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_a_bad_scan_changes_nothing_where_the_map_is_lost(bad):
    slam, twin = (lost_alone(PLACE, (0.0, 0.0, 0.0)) for _ in range(2))
    for each in (slam, twin):
        each.predict((0.0, 0.0), dt=15_000.0)
    scan = readings_of(PLACE, (0.9, -1.0, 0.5))
    with pytest.raises(ValueError, match="must be finite"):
        slam.update(np.vstack([scan, (0.1, bad)]))
    for each in (slam, twin):
        each.update(scan)
    assert len(slam.hypotheses) == len(twin.hypotheses)
    assert_same_bits(slam.belief(), twin.belief())


def test_places_are_sought_only_where_no_landmark_is_known_accurately():
    certain, noise = np.diag(np.full(3 + PLACE.size, 1e-4)), Noise(0.01, 0.03)
    where, rules = np.array([0.8, -0.9, 0.4]), Constellations()
    readings, view = readings_of(PLACE, where), view_of_a_lost_robot(PLACE)
    ((found, slots),) = places_of_scan(view, readings, noise, rules)
    np.testing.assert_allclose(found, where, atol=1e-9)
    assert sorted(slots) == [*range(7)]
    assert is_astray(view, rules)
    for seen in (view._replace(covariance=certain), view._replace(ids=range(2))):
        assert not is_astray(seen, rules)
    assert places_of_scan(view, readings[:2], noise, rules) == []
    with pytest.raises(ValueError, match="must be finite"):
        places_of_scan(view, np.append(readings, [[np.nan, 3.0]], axis=0), noise, rules)
    mean, P = np.append(view.mean, 9.0), np.pad(view.covariance, (0, 1))
    roomy = places_of_scan(MapView(mean, P, range(7)), readings, noise, rules)
    np.testing.assert_array_equal(roomy[0][0], found)


@pytest.mark.parametrize("turn", [-3.0, 0.0, 2.0])
def test_a_place_is_found_at_any_heading(turn):
    view = view_of_a_lost_robot(PLACE, std=(0.5, 0.5, 1.5))
    where = np.array([0.8, -0.9, turn])
    scan = readings_of(PLACE, where), Noise(0.01, 0.03), Constellations()
    ((found, _),) = places_of_scan(view, *scan)
    np.testing.assert_allclose(found, where, atol=1e-9)


def test_a_reading_extends_the_map_as_a_new_landmark_of_the_filter():
    given = lost_alone(PLACE, (0.8, -0.9, 0.3)).filter
    readings = np.array([[0.3, 4.0], [-2.0, 1.5]])
    before = given.belief()
    view = MapView(before.mean, before.covariance, before.landmark_ids)
    extended = with_readings(view, readings, Noise(0.01, 0.03))
    given.update(readings, [90, 91])
    np.testing.assert_allclose(extended.mean, given.belief().mean, atol=1e-9)
    np.testing.assert_allclose(
        extended.covariance, given.belief().covariance, atol=1e-9
    )


def test_a_reading_is_as_far_from_a_landmark_as_it_is_in_a_map_with_both():
    rng, n = np.random.default_rng(7), len(PLACE)
    root = rng.normal(size=(3 + 2 * n, 3 + 2 * n)) / 5
    root[2] /= 5
    view = MapView(np.append([0.3, 0.2, 0.5], PLACE), root @ root.T, range(n))
    readings = readings_of(PLACE - (-0.9, 2.1), view.mean[:3])[:5]
    # The steps neglect that the noise of a reading turns with it.
    for noise, rtol in (Noise(0.01, 0.03), 1e-3), (Noise(0.2, 0.3, 0.05, 0.1), 5e-2):
        gaps = _gaps(view, readings, noise)
        squared = [_of_a_turned_map(view, phi, readings, noise) for phi in TURNS]
        expected = np.min(squared, axis=0)
        may_be = expected <= OFFSET_GATE
        assert may_be.sum() >= 20
        np.testing.assert_allclose(gaps[may_be], expected[may_be], rtol, atol=1e-4)
        assert (gaps >= expected - 1e-4).all()
        assert (gaps[~may_be] > OFFSET_GATE).all()


@pytest.mark.parametrize("std", [1.0, 1e3])
def test_readings_fit_along_the_only_line_on_which_the_robot_may_be(std):
    for direction in np.linspace(0.1, 3.0, 8):
        line, P = np.array([np.cos(direction), np.sin(direction)]), np.zeros((17, 17))
        P[:2, :2] = std**2 * np.outer(line, line)
        view = MapView(np.append([0.3, 0.2, 0.5], PLACE), P, range(7))
        where = view.mean[:3] + np.append(2 * std * line, 0.0)
        gaps = _gaps(view, readings_of(PLACE, where), Noise(0.0, 0.0))
        np.testing.assert_allclose(gaps.diagonal(), 4.0, rtol=1e-3)
        assert (gaps[~np.eye(7, dtype=bool)] > OFFSET_GATE).all()


TURNS = np.linspace(-1.0, 1.0, 1601)


def _of_a_turned_map(view, phi, readings, noise):
    """Return χ² of readings and landmarks if the robot is turned by φ."""
    P, gain = view.covariance, view.covariance[:, 2] / view.covariance[2, 2]
    known = np.eye(len(P)) * 1e-12  # less would be singular
    given = view.mean + gain * phi, P - np.outer(gain, P[2]) + known
    n, m = len(view.ids), len(readings)
    both = with_readings(MapView(*given, view.ids), readings, noise)
    squared, _ = _offsets(both, n + np.arange(m), np.arange(n))
    return phi**2 / P[2, 2] + squared


@pytest.mark.parametrize("seed", [2, 17, 24, 26, 29, 33, 35])
def test_a_robot_astray_decides_when_a_scan_shows_enough_landmarks(seed):
    rng = np.random.default_rng(seed)
    places, where = rng.uniform(-8, 8, (14, 2)), rng.normal(size=3) * (1.2, 1.2, 0.6)
    slam = lost_alone(places, (0.0, 0.0, 0.0), name="invariant")
    slam.predict((0.0, 0.0), dt=30_000.0)  # σ = 1.7 m and 0.9 rad
    near = places[np.argsort(np.hypot(*(places - where[:2]).T))]
    slam.update(readings_of(near[:2], where))
    for _ in range(2):
        slam.update(readings_of(near[:6], where))
    np.testing.assert_allclose(slam.belief().pose, where, atol=0.1)


def test_a_part_of_the_belief_weighs_what_the_prior_holds_of_it():
    slam = lost_alone(PLACE, (0.0, 0.0, 0.0))
    slam.predict((0.0, 0.0), dt=15_000.0)
    prior = slam.belief()
    where = np.array([0.8, -0.9, 0.3])
    scan = readings_of(PLACE, where)
    ((pose, slots),) = slam.best.places_of_scan(scan)
    (part,) = slam._at_places(scan, slam.hypotheses)
    gap, H = gap_and_slopes(prior.mean, pose, slots)
    S = H @ prior.covariance @ H.T + AROUND
    held = multivariate_normal(np.zeros(3), S).pdf(gap)
    held /= multivariate_normal(np.zeros(3), AROUND).pdf(np.zeros(3))
    assert part.cost == pytest.approx(-2 * np.log(held), abs=1e-6)


def view_of_a_lost_robot(places, std=(1.2, 1.2, 0.6), drift=0.0):
    """Return a view of places whose common error is `drift`, and a lost robot."""
    mean = np.append(np.zeros(3), places)
    P = np.diag(np.append(np.square(std), np.full(len(mean) - 3, 1e-4)))
    for axis in (0, 1):
        both = np.r_[axis, 3 + axis : len(mean) : 2]
        P[np.ix_(both, both)] += drift**2
    return MapView(mean, P, range(len(places)))


@pytest.mark.parametrize("drift", [0.1, 1.0, 3.0])
def test_a_place_leaves_the_common_error_of_the_landmarks_as_it_is(drift):
    where = np.array([0.8, -0.9, 0.4])
    scan = readings_of(PLACE, where), Noise(0.01, 0.03), Constellations()
    view = view_of_a_lost_robot(PLACE, drift=drift)
    (place,) = places_of_scan(view, *scan)
    belief = Belief(view.mean, view.covariance, range(7), "invariant")
    P = observe_relative_pose(belief, *place, AROUND).covariance
    lone = view_of_a_lost_robot(PLACE)
    alone = Belief(lone.mean, lone.covariance, range(7), "invariant")
    without = observe_relative_pose(alone, *place, AROUND).covariance
    common = np.kron(np.ones((8, 8)), np.diag([drift**2] * 2))
    axes = np.delete(np.arange(len(P)), 2)
    np.testing.assert_allclose((P - without)[np.ix_(axes, axes)], common, atol=1e-9)


def displaced(pose, landmarks, moved):
    """Return where a pose is if the landmarks around it have moved rigidly."""
    a, b = (x[:, 0] + 1j * x[:, 1] for x in (landmarks, moved))
    turn = np.angle(np.vdot(a - a.mean(), b - b.mean()))
    z = b.mean() + np.exp(1j * turn) * (complex(*pose[:2]) - a.mean())
    return np.array([z.real, z.imag, pose[2] + turn])


def gap_and_slopes(mean, pose, slots):
    """Return the pose less one among landmarks, and its numeric slopes."""
    places = mean[3:].reshape(-1, 2)[slots]

    def gap(state):
        moved = state[3:].reshape(-1, 2)[slots]
        return state[:3] - displaced(pose, places, moved)

    steps = 1e-6 * np.eye(len(mean))
    H = np.array([(gap(mean + d) - gap(mean - d)) / 2e-6 for d in steps]).T
    return gap(mean), H


def test_a_place_corrects_as_its_numeric_slopes_say():
    rng = np.random.default_rng(5)
    root, slots = rng.normal(size=(17, 17)) / 5, np.array([0, 2, 3, 6])
    mean, R = np.append([0.3, 0.2, 0.5], PLACE), np.diag([0.2, 0.3, 0.1])
    pose, P = np.array([0.8, -0.5, 0.9]), root @ root.T
    gap, H = gap_and_slopes(mean, pose, slots)
    S = H @ P @ H.T + R
    gain = P @ H.T @ np.linalg.inv(S)
    found = observe_relative_pose(Belief(mean, P, range(7)), pose, slots, R)
    np.testing.assert_allclose(found.mean, mean - gain @ gap, atol=1e-8)
    np.testing.assert_allclose(found.covariance, P - gain @ H @ P, atol=1e-8)
    assert found.nis == pytest.approx(gap @ np.linalg.solve(S, gap), rel=1e-7)


def test_a_turn_of_everything_turns_the_part_at_a_place():
    rng = np.random.default_rng(6)
    root, slots = rng.normal(size=(17, 17)) / 5, np.array([0, 2, 3, 6])
    mean, pose = np.append([0.3, 0.2, 0.5], PLACE), np.array([0.8, -0.5, 0.9])
    P, cos, sin = root @ root.T, np.cos(2.0), np.sin(2.0)
    isotropic = np.diag([0.2, 0.2, 0.1])
    turn = np.kron(np.eye(8), np.array([(cos, -sin), (sin, cos)]))
    turn = np.insert(np.insert(turn, 2, 0.0, axis=0), 2, 0.0, axis=1)
    turn[2, 2] = 1.0
    ahead = np.eye(1, 17, 2)[0] * 2.0
    for frame in ("additive", "invariant"):
        one = Belief(mean, P, range(7), frame)
        other = Belief(turn @ mean + ahead, turn @ P @ turn.T, range(7), frame)
        found = observe_relative_pose(one, pose, slots, isotropic)
        there = turn[:3, :3] @ pose + ahead[:3]
        same = observe_relative_pose(other, there, slots, isotropic)
        np.testing.assert_allclose(same.mean, turn @ found.mean + ahead, atol=1e-9)
        np.testing.assert_allclose(
            same.covariance, turn @ found.covariance @ turn.T, atol=1e-9
        )


def test_the_order_of_the_readings_does_not_matter_in_a_large_map():
    rng = np.random.default_rng(3)
    places = rng.uniform(-12, 12, (150, 2))
    where, noise = np.array([0.6, -0.9, 0.2]), Noise(0.002, 0.005)
    known = readings_of(places[:7], where)
    others = readings_of(rng.uniform(-12, 12, (5, 2)), where)
    view = view_of_a_lost_robot(places, std=(3.0, 3.0, 0.3))
    for scan in ([*others, *known], [*known, *others]):
        places = places_of_scan(view, np.array(scan), noise, Constellations())
        assert min(np.abs(pose - where).max() for pose, _ in places) < 0.05


def test_a_place_that_the_gate_refuses_is_left_out():
    gate = {"gate_probability": 0.5}
    slam = lost_alone(PLACE, (0.0, 0.0, 0.0), gate, name="robocentric")
    slam.predict((0.0, 0.0), dt=15_000.0)
    scan = readings_of(PLACE, (2.4, -2.4, 1.0))
    assert slam.best.places_of_scan(scan)
    assert slam._at_places(scan, slam.hypotheses) == []


def test_readings_beside_the_robot_and_far_away_show_no_place_and_give_no_warning():
    metres = {"bearing_std_metres": 0.01}
    slam, twin = (lost_alone(PLACE, (0.0, 0.0, 0.0), metres) for _ in range(2))
    scan = readings_of(PLACE, (0.9, -1.0, 0.5))
    bad = [(0.1, 0.0), (0.2, 1e-4), (0.3, 1e150)]
    for each in (slam, twin):
        each.predict((0.0, 0.0), dt=15_000.0)
    with np.errstate(all="raise"):
        found = slam._at_places(np.vstack([bad, scan]), slam.hypotheses)
    (other,) = twin._at_places(scan, twin.hypotheses)
    assert_same_bits(found[0].filter.belief(), other.filter.belief())
