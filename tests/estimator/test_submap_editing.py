"""Removing and merging landmarks of submaps, and looking around in their map."""

import numpy as np
import pytest
from comparison import assert_same_bits, digest, part_of
from inner_parts import (
    cached_submaps,
    closed_submaps,
    graph_of,
    neighbourhood_of,
    present_submap,
    spied,
)
from scipy.stats import chi2
from test_submaps import LANDMARKS, MEASUREMENT_STD, MOTION_STD, START, laps, made
from town_drives import run

from slamgym.estimator.filters.gaussian_map import without_landmarks
from slamgym.estimator.filters.pose_readings import coincide
from slamgym.estimator.large_maps.submaps import closed_submaps as neighbourhood
from slamgym.estimator.large_maps.submaps import joining as gauss_newton
from slamgym.estimator.large_maps.submaps.submap_slam import BASES, SubmapSlam
from slamgym.estimator.models.bearing_range import predict_measurement, wrap_angle
from slamgym.estimator.models.motions import predict_pose

# By the names that it has in some steps: landmark 4 is also 104, and so on.
ALIAS = 100


def assert_close(one, other, tolerance):
    """Compare beliefs, in standard deviations."""
    assert one.landmark_ids == other.landmark_ids
    compare(one, other, np.sqrt(np.diag(other.covariance)), tolerance)


def compare(one, other, std, tolerance):
    """Compare means and covariances as far as the standard deviations go."""
    n = len(std)
    shift = one.mean[:n] - other.mean
    shift[2] = wrap_angle(shift[2])
    np.testing.assert_allclose(shift / std, 0, atol=tolerance)
    change = (one.covariance[:n, :n] - other.covariance) / np.outer(std, std)
    np.testing.assert_allclose(change, 0, atol=tolerance)


def assert_as_joined(slam, tolerance, within=0.0):
    """Compare the view with the joined map; return both."""
    view, whole = slam.local_view(within), slam.belief()
    part = part_of(whole, view.ids)
    compare(view, part, np.sqrt(np.diag(part.covariance)), tolerance)
    return view, whole


def holders(slam):
    """Which submaps hold each landmark, the present one being the last."""
    slots = [set(o.slots.tolist()) for o in closed_submaps(slam).summaries]
    slots.append(
        set(graph_of(slam).index.slots_of(present_submap(slam).names).tolist())
    )
    return {
        i: [k for k, held in enumerate(slots) if slot in held]
        for i, slot in graph_of(slam).index.items()
    }


def one_of_each_kind(slam):
    """Return landmarks of one or more closed submaps, of the present one, of both."""
    last, kinds = slam.closed_count, {}
    for i, where in holders(slam).items():
        kinds[len(where) > 1, last in where] = i
    return kinds


def without(drive, ids):
    for odometry, readings, seen, pose in drive:
        kept = [row for row, i in enumerate(seen) if i not in ids]
        yield odometry, readings[kept], seen[kept], pose


# --- removing -------------------------------------------------------------------------


@pytest.mark.parametrize("base", BASES)
def test_removal_changes_no_other_marginal(base):
    kinds_met = set()
    for steps in (24, 31, 70):
        whole = run(made(base=base), laps(steps))
        for kind, gone in one_of_each_kind(whole).items():
            slam = made(base=base)
            slam.load_state_dict(whole.state_dict())
            slam.remove([gone])
            left = tuple(i for i in whole.landmark_ids if i != gone)
            assert slam.landmark_ids == left
            assert_close(slam.belief(), part_of(whole.belief(), left), 1e-12)
            some = left[:2]
            assert_close(slam.belief(some), part_of(whole.belief(), some), 1e-9)
            near = tuple(i for i in whole.local_ids if i != gone)
            assert_close(
                slam.local_belief(), part_of(whole.local_belief(), near), 1e-12
            )
            assert slam.local_ids == near
            kinds_met.add(kind)
    assert len(kinds_met) == 4


@pytest.mark.parametrize("base", BASES)
def test_a_removed_landmark_goes_on_to_tie_submaps_together(base):
    removed, kept = (run(made(base=base), laps(31)) for _ in range(2))
    kinds = one_of_each_kind(removed)
    gone = [kinds[True, True], kinds[True, False]]
    removed.remove(gone)
    later = list(without(list(laps(90))[31:], gone))
    run(removed, later)
    run(kept, later)
    assert removed.closed_count == kept.closed_count
    assert_close(removed.belief(), part_of(kept.belief(), removed.landmark_ids), 1e-9)


def test_what_only_the_present_submap_holds_makes_room():
    slam = run(made(submap_size=20), laps(12))
    alone = list(slam.landmark_ids[:3])
    before = len(present_submap(slam))
    slam.remove(alone)
    assert alone
    assert len(present_submap(slam)) == before - len(alone)


def test_a_removed_landmark_that_is_seen_again_is_a_new_one():
    """It comes back elsewhere: were it the old one, the map would be torn."""
    steps, moved = 60, LANDMARKS.copy()
    first = run(made(), laps(steps))
    gone = [i for i, where in holders(first).items() if len(where) > 2][:2]
    moved[gone] += (1.5, -1.0)
    first.remove(gone)
    added = []
    for odometry, readings, ids, _ in list(laps(90, landmarks=moved))[steps:]:
        first.predict(odometry)
        added += first.update(readings, ids).added_ids
    assert set(gone) <= set(added)
    assert first.landmark_ids[-len(added) :] == tuple(added)
    gaps = first.belief(gone).landmarks - moved[gone]
    assert np.hypot(*gaps.T).max() < 0.5


def test_what_is_not_in_the_map_cannot_be_removed():
    slam = run(made(), laps(40))
    before, known = slam.belief(), slam.landmark_ids
    with pytest.raises(ValueError, match="mapped landmarks, got 99"):
        slam.remove([known[0], 99])
    assert_same_bits(before, slam.belief())
    slam.remove([])
    assert_same_bits(before, slam.belief())


@pytest.mark.parametrize("name", [-(2**63), -(2**63) + 2**20 - 1])
def test_no_identity_is_taken_for_a_link(name):
    message = rf"landmark_ids must be >= {-(2**63) + 2**20}, got {name}"
    unrun, slam = made(), run(made(), laps(31))
    slam.remove([one_of_each_kind(slam)[True, True]])
    restored = made()
    restored.load_state_dict(slam.state_dict())
    for each in (unrun, slam, restored):
        before = each.belief()
        with pytest.raises(ValueError, match=message):
            each.update([(0.0, 2.0), (0.1, 3.0)], [1, name])
        assert_same_bits(before, each.belief())


def test_the_lowest_identity_is_removed_like_any_other():
    """It was taken for the link that the landmark in the first slot becomes."""
    lowest, drive = -(2**63) + 2**20, list(laps(60))
    low, plain = made(), made()
    for step, (odometry, readings, ids, _) in enumerate(drive):
        for slam, name in ((low, lowest), (plain, 50)):
            slam.predict(odometry)
            slam.update(readings, [name if i == 12 else i for i in ids.tolist()])
            if step == 31:
                slam.remove([slam.landmark_ids[0]])
            if step == 45:
                slam.remove([name])
    assert_same_bits(low.belief(), plain.belief())


# --- merging --------------------------------------------------------------------------


def doubled(drive, names):
    """Give landmarks a second name in some steps: (landmark, steps) each."""
    for step, (odometry, readings, ids, pose) in enumerate(drive):
        renamed = [i + ALIAS * (i in names and step in names[i]) for i in ids.tolist()]
        yield odometry, readings, np.array(renamed), pose


def seen_often(drive):
    """Return two landmarks that are seen nearly always."""
    counts = np.bincount(np.concatenate([ids for _, _, ids, _ in drive]))
    return np.argsort(counts)[-2:].tolist()


# In which steps of each two the second name is used: within each submap, in some
# submaps only, lately only, at first only.
WAYS = {
    "in every submap": lambda step: step % 2 == 0,
    "in some submaps": lambda step: step % 20 < 10,
    "lately": lambda step: step >= 67,
    "at first": lambda step: step < 20,
}


@pytest.mark.slow
@pytest.mark.parametrize(("way", "base"), list(zip(WAYS, [*BASES] * 2, strict=True)))
def test_merging_is_having_known_it_from_the_start(base, way):
    """With vanishing noise; the second of the landmarks keeps its later name."""
    steps = [step for step in range(70) if WAYS[way](step)]
    differences = []
    for scale in (0.1, 0.001):
        drive = list(laps(70, scale=scale))
        one, other = seen_often(drive)
        limits = {"base": base, "submap_size": 9, "extent_limit": 2.5}
        slam = run(made(scale, **limits), doubled(drive, {one: steps, other: steps}))
        expected = run(made(scale, base=base), drive)
        slam.merge(one, one + ALIAS)
        slam.merge(other + ALIAS, other)
        assert slam.closed_count > 3
        found = slam.belief([*slam.landmark_ids])
        names = [i % ALIAS for i in found.landmark_ids]
        expected = expected.belief(names)
        std = np.sqrt(np.diag(expected.covariance))
        shift = np.abs(found.mean - expected.mean) / std
        change = np.abs(found.covariance - expected.covariance) / np.outer(std, std)
        differences.append((shift.max(), change.max()))
    differences = np.array(differences)
    assert (differences[1] < 0.03 * differences[0]).all()
    assert (differences[1] < 1e-3).all()


@pytest.mark.parametrize(
    ("way", "base"), list(zip(WAYS, [*BASES][::-1] * 2, strict=True))
)
def test_merging_is_a_reading_of_distance_zero(base, way):
    scale = 1e-3
    drive = list(laps(70, scale=scale))
    one, _ = seen_often(drive)
    steps = [step for step in range(70) if WAYS[way](step)]
    slam = run(made(scale, base=base, extent_limit=2.5), doubled(drive, {one: steps}))
    before = slam.belief()
    slots = [before.landmark_ids.index(i) for i in (one, one + ALIAS)]
    mean, P = coincide(before.mean, before.covariance, *slots, frame="invariant")
    slam.merge(one, one + ALIAS)
    left = tuple(i for i in before.landmark_ids if i != one + ALIAS)
    arrays = (without_landmarks(array, slots[1:]) for array in (mean, P))
    expected = type(before)(*arrays, left, "invariant")
    assert_close(slam.belief(), expected, 0.02)
    loose = part_of(before, left).covariance
    assert np.trace(expected.covariance) < 0.999 * np.trace(loose)


@pytest.mark.slow
@pytest.mark.parametrize("base", BASES)
def test_merging_keeps_the_belief_honest(base):
    nees = []
    for seed in range(30):
        drive = list(laps(60, seed=seed))
        one, other = seen_often(drive)
        names = {one: range(0, 60, 2), other: range(25)}
        slam = run(made(base=base, submap_size=9), doubled(drive, names))
        slam.merge(one, one + ALIAS)
        slam.merge(other + ALIAS, other)
        belief = slam.belief()
        truth = LANDMARKS[[i % ALIAS for i in belief.landmark_ids]]
        error = belief.error(drive[-1][3], truth)
        nees.append(error @ np.linalg.solve(belief.error_covariance(), error))
        dof = len(error)
    low, high = chi2.ppf([0.0005, 0.9995], 30 * dof)
    assert low < np.sum(nees) < high


def test_three_names_of_one_landmark_may_be_merged_in_any_order():
    drive = list(laps(60))
    one, _ = seen_often(drive)
    thrice = [
        (odometry, readings, np.where(ids == one, one + ALIAS * (step % 3), ids), pose)
        for step, (odometry, readings, ids, pose) in enumerate(drive)
    ]
    names = [one, one + ALIAS, one + 2 * ALIAS]
    beliefs = []
    for first, second in (((0, 1), (0, 2)), ((1, 2), (0, 1)), ((2, 1), (0, 2))):
        slam = run(made(submap_size=10), thrice)
        slam.merge(names[first[0]], names[first[1]])
        slam.merge(names[second[0]], names[second[1]])
        beliefs.append(slam.belief())
    for other in beliefs[1:]:
        assert_close(other, beliefs[0], 0.02)  # linearised in another order


def test_what_cannot_be_merged_is_refused_and_changes_nothing():
    slam = run(made(), laps(40))
    before, (one, other, *_) = slam.belief(), slam.landmark_ids
    with pytest.raises(ValueError, match="mapped landmarks, got 99"):
        slam.merge(one, 99)
    words = f"kept and gone must be two landmarks, got {one} twice"
    with pytest.raises(ValueError, match=words):
        slam.merge(one, one)
    assert_same_bits(before, slam.belief())
    sure = SubmapSlam((0, 0, 0), (0, 0), submap_size=2)
    for _ in range(2):
        sure.update([(0.0, 2.0), (0.5, 3.0)], [one, other])
    before = sure.belief()
    with pytest.raises(np.linalg.LinAlgError):
        sure.merge(one, other)
    assert_same_bits(before, sure.belief())


# --- looking around -------------------------------------------------------------------


def test_around_the_robot_it_believes_what_the_joined_map_does():
    slam, closed = made(), 0
    for odometry, readings, ids, _ in laps(80):
        slam.predict(odometry)
        slam.update(readings, ids)
        was_surveyed = slam.closed_count > closed
        closed = slam.closed_count
        view, whole = assert_as_joined(slam, 1e-9 if was_surveyed else 0.3, 8.0)
        assert view.mapped == whole.landmark_ids
        assert around(whole, 7.9) <= set(view.ids)
    assert closed > 5


def around(belief, reach):
    """Return which landmarks are within reach of the robot."""
    away = np.hypot(*(belief.landmarks - belief.pose[:2]).T)
    return {i for i, d in zip(belief.landmark_ids, away, strict=True) if d < reach}


def wide_laps(steps, seed=0):
    """A long loop past many landmarks, of which few are near."""
    landmarks = np.random.default_rng(1).uniform(-60, 60, (400, 2))
    pose, rng = np.array(START), np.random.default_rng(seed)
    for _ in range(steps):
        odometry = np.array([1.0, 2 * np.pi / 200])
        motion = predict_pose(pose, odometry)
        slip = MOTION_STD / 3 * rng.standard_normal(3)
        pose = motion.pose + motion.jacobian_noise @ slip
        readings = predict_measurement(pose, landmarks).measurement
        readings += MEASUREMENT_STD * rng.standard_normal(readings.shape)
        ids = np.flatnonzero((readings[:, 1] < 8.0) & (readings[:, 1] > 0.5))
        yield odometry, readings[ids], ids, pose


@pytest.mark.slow
def test_what_lies_around_is_a_part_of_a_large_map_and_moves_with_the_robot():
    slam = made(submap_size=12)
    seen, nees = [], []
    for odometry, readings, ids, pose in wide_laps(250):
        slam.predict(odometry)
        view = slam.local_view(8.0)
        gaps = view.mean[:2] - pose[:2]
        nees.append(gaps @ np.linalg.solve(view.covariance[:2, :2], gaps))
        slam.update(readings, ids)
        seen.append(len(slam.local_view(8.0).ids))
    assert len(slam.landmark_ids) > 80
    assert max(seen[100:]) < 0.75 * len(slam.landmark_ids)
    assert np.mean(nees) < 6  # one run; of the order of 2
    for reach in (8.0, 40.0):  # the second is farther than it held until now
        near = around(slam.belief(), reach)
        assert near <= set(slam.local_view(reach + 0.1).ids)


def test_what_lies_around_learns_of_a_merge_and_of_a_removal():
    drive = list(laps(50))
    other, one = seen_often(drive)
    slam = run(made(submap_size=9), list(doubled(drive, {one: range(20, 50)}))[:-3])
    slam.local_view(8.0)
    run(slam, list(doubled(drive, {one: range(20, 50)}))[-3:])
    before = slam.closed_count
    slam.merge(one, one + ALIAS)
    slam.remove([other])
    view, _ = assert_as_joined(slam, 0.1, 8.0)
    assert slam.closed_count == before
    assert {one + ALIAS, other}.isdisjoint(view.ids)


def surveys_of(slam):
    """Return a list that grows with every look at the joined map, by its reach."""
    reaches, patch = [], pytest.MonkeyPatch()  # of one filter alone, to its end
    spied(patch, neighbourhood_of(slam), "_joined_region", reaches.append)
    return reaches


def test_a_scan_for_which_it_is_taken_anew_counts_once():
    """Long after the only look, scans meet landmarks that it does not hold."""
    slam, taken = made(submap_size=45), 0
    surveys = surveys_of(slam)
    for step, (odometry, readings, ids, _) in enumerate(wide_laps(240)):
        slam.predict(odometry)
        before, closed = len(surveys), slam.closed_count
        slam.update(readings, ids)
        if step == 120:
            slam.local_view(1.0)
        elif len(surveys) > before and slam.closed_count == closed:
            assert_as_joined(slam, 1e-9)
            taken += 1
    assert taken > 2


@pytest.mark.slow
def test_what_was_asked_once_is_not_held_for_ever():
    slam, sizes = made(submap_size=12), []
    surveys = surveys_of(slam)
    for step, (odometry, readings, ids, _) in enumerate(wide_laps(250)):
        slam.predict(odometry)
        slam.local_view(5000.0 if step == 120 else 8.0)
        slam.update(readings, ids)
        sizes.append(len(slam.local_view(8.0).ids))
        if step == 120:
            assert sizes[-1] == len(slam.landmark_ids) > 40
    assert max(sizes[160:]) < 0.75 * len(slam.landmark_ids)
    assert max(surveys) == 5000.0
    assert len(surveys) < 3 * slam.closed_count  # it is not taken anew in every step


@pytest.mark.slow
def test_when_it_is_taken_anew_it_holds_what_scans_tell_of():
    """Nobody asks how far they reach."""
    slam, closed, met = made(submap_size=12), 0, 0
    for odometry, readings, ids, _ in wide_laps(250):
        slam.predict(odometry)
        slam.update(readings, ids)
        view = slam.local_view(0.0)
        if slam.closed_count > closed:
            closed, met = slam.closed_count, met + len(ids)
            assert set(ids.tolist()) <= set(view.ids)
    assert met > 10


def test_it_is_taken_as_far_as_has_been_asked_lately():
    slam = made(submap_size=12)
    surveys = surveys_of(slam)
    for odometry, readings, ids, _ in wide_laps(100):
        slam.predict(odometry)
        slam.local_view(30.0)
        slam.update(readings, ids)
    assert slam.closed_count > 2
    assert min(surveys) == 30.0


def test_a_look_at_all_there_is_holds_until_a_submap_is_closed():
    slam = run(made(), laps(40))
    surveys = surveys_of(slam)
    for _ in range(3):
        for within in (20.0, 1e6):
            assert set(slam.local_view(within).ids) == set(slam.landmark_ids)
    assert len(surveys) == 1


def test_where_there_are_too_many_it_claims_no_more_than_it_holds(monkeypatch):
    monkeypatch.setattr(neighbourhood, "LARGEST_COUNT", 15)
    slam, cut = made(submap_size=12), 0
    for odometry, readings, ids, _ in wide_laps(120):
        slam.predict(odometry)
        slam.update(readings, ids)
        held = set(slam.local_view(25.0).ids)
        extent, whole = neighbourhood_of(slam)._copy.region, slam.belief()
        away = np.hypot(*(whole.landmarks - whole.pose[:2]).T)
        cut += len(held) < len(whole.landmark_ids)
        missing = ~np.isin(whole.landmark_ids, list(held))
        for distance in away[missing]:
            assert not extent.covers(whole.pose[:2], distance + 1e-6)
        assert extent.covers(whole.pose[:2], 0.0)
    assert cut > 30


def test_it_looks_farther_by_how_far_the_map_may_have_drifted():
    slam, met = made(submap_size=12), 0
    for odometry, readings, ids, _ in wide_laps(100):
        closed = slam.closed_count
        slam.predict(odometry)
        slam.update(readings, ids)
        if slam.closed_count > closed:  # the robot is where the present frame begins
            drift = 3 * np.sqrt(np.trace(slam.belief([]).covariance[:2, :2]))
            _, extent = graph_of(slam).joined_region(5.0)
            assert extent.slack == pytest.approx(drift, rel=1e-6)
            assert extent.slack > 0.1
            least = extent.radius - extent.slack
            assert extent.covers(extent.centre, least - 1e-9)
            assert not extent.covers(extent.centre, least + 1e-9)
            aside = extent.centre + np.array([0.0, 1.0])
            assert extent.covers(aside, least - 1 - 1e-9)
            assert not extent.covers(aside, least - 1 + 1e-9)
            met += 1
    assert met > 2


@pytest.mark.parametrize("held_is_kept", [True, False])
def test_it_learns_of_a_merge_with_what_it_does_not_hold(monkeypatch, held_is_kept):
    monkeypatch.setattr(neighbourhood, "LARGEST_COUNT", 4)
    slam = made(submap_size=9)
    names = {i: range(20, 60) for i in range(len(LANDMARKS))}
    for odometry, readings, ids, _ in doubled(list(laps(72)), names):
        slam.predict(odometry)
        slam.update(readings, ids)
        held = set(slam.local_view(0.0).ids)
    assert slam.closed_count == 3
    known = set(slam.landmark_ids)
    one, other = next(
        (i, j)
        for i, j in ((i, i + ALIAS) for i in range(ALIAS) if i + ALIAS in known)
        if len(held.intersection((i, j))) == 1
    )
    kept, gone = (one, other) if (one in held) == held_is_kept else (other, one)
    slam.merge(kept, gone)
    assert kept in slam.local_view(0.0).ids
    assert_as_joined(slam, 1e-9)


def test_it_goes_on_where_the_file_of_a_submap_is_lost(tmp_path):
    slam, drive = made(folder=tmp_path / "run", submap_size=5), list(laps(90))
    few = [(u, z[:5], ids[:5], pose) for u, z, ids, pose in drive]
    run(slam, few[:60])
    slam.local_view(8.0)
    cached_submaps(slam).clear()
    (tmp_path / "run" / "submap_000001.npy").unlink()
    closed = slam.closed_count
    run(slam, few[60:])
    assert slam.closed_count > closed + 2
    gap = slam.local_view(0.0).mean[:2] - drive[-1][3][:2]
    assert np.hypot(*gap) < 0.3
    with pytest.raises(ValueError, match="submap 1 cannot be read"):
        slam.belief()


def test_it_goes_on_where_the_map_cannot_be_joined(monkeypatch):
    slam, drive = made(), list(laps(80))
    for odometry, readings, ids, _ in drive[:20]:
        slam.predict(odometry)
        slam.update(readings, ids)
        slam.local_view(8.0)
    monkeypatch.setattr(gauss_newton, "ITERATIONS", 0)
    run(slam, drive[20:])
    gap = slam.local_view(0.0).mean[:2] - drive[-1][3][:2]
    assert np.hypot(*gap) < 0.3
    with pytest.raises(np.linalg.LinAlgError, match="did not converge"):
        slam.belief()


# --- saved and continued --------------------------------------------------------------


def edited_run(slam, drive, start=0):
    """Look around in every step; now and then remove a landmark, and merge two."""
    twice = doubled(drive, {9: range(0, 90, 2), 12: range(0, 90, 3)})
    for step, (odometry, readings, ids, _) in enumerate(twice, start=0):
        if step < start:
            continue
        slam.predict(odometry)
        slam.update(readings, ids)
        slam.local_view(6.0)
        if step in (14, 40):
            slam.remove([i for i in slam.landmark_ids if i % ALIAS not in (9, 12)][-3:])
        if step == 30:
            slam.merge(12, 112)
        if step == 52:
            slam.merge(109, 9)
    return slam


@pytest.mark.slow
@pytest.mark.parametrize(
    ("base", "on_disk", "cut"),
    [
        ("ekf", False, 16),
        ("ekf", True, 45),
        ("invariant", False, 60),
        ("invariant", True, 16),
    ],
)
def test_an_edited_run_continues_bit_for_bit(tmp_path, base, on_disk, cut):
    options = {"base": base, "folder": tmp_path / "run" if on_disk else None}
    drive = list(laps(75))
    slam = edited_run(made(**options, submap_size=9), drive[:cut])
    with (tmp_path / "state.npz").open("wb") as file:
        np.savez(file, **slam.state_dict())
    other = made(**options, submap_size=9)
    with np.load(tmp_path / "state.npz") as state:
        other.load_state_dict(state)
    reaches, same = (neighbourhood_of(each)._reaches for each in (slam, other))
    assert reaches == same
    assert max(reaches) > 0
    assert_same_bits(slam.belief(), other.belief())
    edited_run(slam, drive, start=cut)
    edited_run(other, drive, start=cut)
    assert slam.closed_count == other.closed_count > 4
    assert closed_submaps(slam).renamed
    assert state_of(slam) == state_of(other)
    for some in (None, slam.landmark_ids[:3]):
        assert_same_bits(slam.belief(some), other.belief(some))


def state_of(slam):
    """Return the state but for the name of the run."""
    return {key: bits for key, bits in digest(slam).items() if key != "run"}


def test_editing_writes_no_submap_again(tmp_path):
    slam = run(made(folder=tmp_path / "run"), laps(60))
    files = {p: p.read_bytes() for p in (tmp_path / "run").iterdir()}
    shared = [i for i, where in holders(slam).items() if len(where) > 2]
    slam.remove(shared[:1])
    slam.merge(*shared[1:3])
    slam.belief()
    assert files == {p: p.read_bytes() for p in (tmp_path / "run").iterdir()}


def test_reset_forgets_all_edits():
    slam = edited_run(made(submap_size=9), list(laps(75)))
    slam.local_view(5.0)
    slam.reset(START, (0, 0, 0))
    fresh = made(submap_size=9)
    for each in (slam, fresh):
        assert not each.local_view(5.0).ids
        edited_run(each, list(laps(75)))
    assert state_of(slam) == state_of(fresh)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"slots": np.array([3, 1, 2])}, "ascending"),
        ({"slot_count": np.array(2)}, "slots.* must be whole numbers from 0 to 1"),
        ({"renamed": np.array([[99, 0]])}, "renamed.* must be whole numbers from 0"),
        ({"renamed": np.array([[0.5, 0]])}, "renamed.* must be whole numbers"),
        ({"vicinity_mean": np.zeros(4)}, r"state\['mean'\]"),
        ({"vicinity_extent": np.zeros(4)}, "extent"),
        ({"local_landmark_ids": np.arange(50, 57)}, "must be in the map, got 50"),
    ],
)
def test_an_edited_state_that_does_not_fit_is_refused(change, message):
    slam = edited_run(made(), list(laps(45)))
    state, other = slam.state_dict(), made()
    if "local_landmark_ids" in change:
        count = len(state["local_landmark_ids"])
        change = {"local_landmark_ids": 50 + np.arange(count)}
    with pytest.raises(ValueError, match=message):
        other.load_state_dict(state | change)
    assert state_of(other) == state_of(made())
