"""The compressed filter is the full filter: whatever it puts off, nothing is lost."""

import copy
import gc
import pickle
import sys
from pathlib import Path
from types import FunctionType, ModuleType

import numpy as np
import pytest
from comparison import assert_close_beliefs, assert_same_bits, digest, part_of, same
from drives import MEASUREMENT_STD
from hypothesis import given, settings
from hypothesis import strategies as st
from inner_parts import map_of, spied
from interrupts import is_interrupted, lines_of
from matplotlib import pyplot as plt
from town_drives import TOWN_MOTION_STD, map_all, run, wander

from slamgym.estimator import EkfSlam, InvariantEkfSlam, check_estimator
from slamgym.estimator.interface import Belief
from slamgym.estimator.large_maps.compressed import compressed_map as active_set
from slamgym.estimator.large_maps.compressed import phase_update
from slamgym.estimator.large_maps.compressed.compressed_slam import (
    BASES,
    CompressedEkfSlam,
)
from slamgym.estimator.large_maps.compressed.deferred_covariance import (
    BLOCK,
    DeferredCovariance,
    Downdate,
)
from slamgym.estimator.large_maps.compressed.phase_update import Handover, scale_of
from slamgym.estimator.map_management.map_editor import MapEditor
from slamgym.estimator.models.bearing_range import predict_measurement

sys.path.append(str(Path(__file__).parents[2] / "benchmarks"))
import growing_maps
from growing_maps_peers import FullWithDsyrk
from growing_maps_timing import Costs

NOISE = (TOWN_MOTION_STD, MEASUREMENT_STD)
WHOLE = 250
LIMITS = ("LARGEST_WHOLE_MAP", "LARGEST_WHOLE_INVARIANT")


@pytest.fixture(autouse=True)
def _small_maps_are_split_too(monkeypatch):
    """So that what is put off is tested where tests are fast."""
    for limit in LIMITS:
        monkeypatch.setattr(active_set, limit, 0)


@pytest.fixture
def _small_maps_are_whole(monkeypatch):
    """As the filter does unless told a local size."""
    for limit in LIMITS:
        monkeypatch.setattr(active_set, limit, WHOLE)


def forget(full, ids):
    """Marginalise landmarks out of a full filter, by way of its state."""
    state = full.state_dict()
    stays = ~np.isin(state["landmark_ids"], ids)
    keep = np.concatenate([[True] * 3, np.repeat(stays, 2)])
    state |= {key: state[key][keep] for key in ("mean", "reference")}
    state["covariance"] = state["covariance"][np.ix_(keep, keep)]
    full.load_state_dict(state | {"landmark_ids": state["landmark_ids"][stays]})


def assert_equal_beliefs(one, other):
    assert one.frame == other.frame
    assert_close_beliefs(one, other, 1e-9, 1e-10)


def follow_both(
    base, count, steps, *, mapped=False, jumping=False, every=50, **options
):
    """Run full and compressed filter side by side, landmarks removed on the way."""
    rng = np.random.default_rng(3)
    full, slam = BASES[base](*NOISE), CompressedEkfSlam(*NOISE, base=base, **options)
    if mapped:
        map_all(full, count)
        map_all(slam, count)
    phases = 0
    for step, (odometry, readings, ids) in enumerate(
        wander(count, steps, jumping=jumping)
    ):
        before = slam.local_ids
        full.predict(odometry)
        slam.predict(odometry)
        expected, report = full.update(readings, ids), slam.update(readings, ids)
        phases += not set(before) <= set(slam.local_ids)
        assert report.associated_ids == expected.associated_ids
        assert report.added_ids == expected.added_ids
        assert report.nis == pytest.approx(expected.nis, rel=1e-6, abs=1e-6)
        if step % every == every - 1:
            assert_equal_beliefs(slam.belief(), full.belief())
            near = list(slam.local_ids)[::4]
            far = [i for i in slam.landmark_ids if i not in slam.local_ids]
            gone = near + rng.permutation(far)[:3].tolist()
            forget(full, gone)
            slam.remove(gone)
    assert_equal_beliefs(slam.belief(), full.belief())
    return slam, phases


@pytest.mark.parametrize("base", BASES)
def test_it_keeps_the_contract(base):
    assert check_estimator(lambda **noise: CompressedEkfSlam(base=base, **noise)) == ()


@pytest.mark.slow
def test_it_equals_the_full_filter_over_400_steps_among_1000_landmarks():
    """With a twin in numpy and BLAS for the full filter, not its own kernels."""
    slam = map_all(CompressedEkfSlam(*NOISE), 1000)
    start = slam.belief()
    full = FullWithDsyrk(start.mean, start.covariance, *map(np.array, NOISE))
    for odometry, readings, ids in wander(1000, 400):
        full.predict(odometry)
        full.update(readings, ids)
        slam.predict(odometry)
        slam.update(readings, ids)
    lower = np.tril(full.covariance)
    covariance = lower + np.tril(lower, -1).T
    assert_equal_beliefs(
        slam.belief(), Belief(full.mean, covariance, tuple(range(1000)))
    )


@pytest.mark.parametrize("base", BASES)
def test_every_base_stays_itself_where_readings_jump_about_the_map(base):
    follow_both(base, 100, 60, mapped=True, jumping=True, every=20)


@pytest.mark.parametrize("base", ["ekf", "invariant"])
def test_it_equals_the_full_filter_while_it_explores(base):
    slam, phases = follow_both(base, 1000, 500, every=250)
    assert len(slam.landmark_ids) > 80
    assert phases > 3


@pytest.mark.parametrize("base", ["ekf", "invariant"])
def test_it_equals_the_full_filter_at_a_local_size_of_the_users_choice(base):
    slam, phases = follow_both(base, 150, 200, mapped=True, local_size=12)
    assert phases > 10
    assert len(slam.local_ids) <= 18 + 10


def assert_accurate(slam, full, tolerance):
    """Compare covariances, relative to the standard deviations of the full filter."""
    expected = full.belief()
    found = part_of(slam.belief(), expected.landmark_ids)
    variances = expected.covariance.diagonal()
    scale = np.sqrt(np.where(variances > 0, variances, 1.0))
    error = np.abs(found.covariance - expected.covariance) / np.outer(scale, scale)
    assert error.max() < tolerance


def test_a_landmark_whose_place_was_a_guess_stays_accurate_when_it_becomes_exact():
    """A variance of 90,000 falls to 1e-4, while another is 1e-4 from the beginning.

    The filter is at rest.  The landmark leaves the local map in the last scan.
    """
    noise, near = ((0.01, 0.0, 0.3), (0.3, 0.01)), (0.0, 1.0)
    slam, full = CompressedEkfSlam(*noise, local_size=6), EkfSlam(*noise)
    scans = [([0, 1, 2, 3], [near] * 4), ([0, 1, 2, 3, 4], [near] * 5)]
    scans += [([5, 6, 7, 8, 9], [(0.0, 3.0), (2.0, 1000.0), near, near, near])]
    scans += [([3, 4, 5, 6, 7], [near] * 5), ([4, 5, 6], [near, near, (0.0, 0.5)])]
    for ids, readings in [*scans, ([0], [near])]:
        for each in (slam, full):
            each.update(readings, ids)
    assert_accurate(slam, full, 1e-6)


@pytest.mark.parametrize("base", BASES)
@pytest.mark.parametrize("std", [10.0, 100.0])
def test_a_map_stays_accurate_when_its_place_becomes_known(base, std):
    """All variances fall from std² to 1e-4, while distances are known to 1 cm."""
    rng, start = np.random.default_rng(5), {"initial_pose_std": (std, std, 0.0)}
    noise = ((0.01, 0.01, 0.01), (0.01, 0.01))
    slam = CompressedEkfSlam(*noise, base=base, local_size=8, **start)
    full = BASES[base](*noise, **start)
    places = rng.uniform(-8.0, 8.0, (40, 2))
    for step in range(30):
        ids = np.arange(5 * step, 5 * step + 5)
        if step >= 8:
            ids = rng.choice(40, 6, replace=False)
        readings = predict_measurement(np.zeros(3), places[ids]).measurement
        readings += 0.01 * rng.standard_normal(readings.shape)
        for each in (slam, full):
            each.update(readings, ids.tolist())
            if step == 20:
                each.observe_pose((0.0, 0.0), np.eye(2, 3), 1e-4 * np.eye(2))
    assert_accurate(slam, full, 1e-6)


@pytest.mark.parametrize("base", ["ekf", "invariant"])
@pytest.mark.parametrize(("std", "turn"), [(0.0, 0.1), (10.0, 0.1), (10.0, 1.0)])
@pytest.mark.parametrize("at", [0.0, 100.0])
def test_it_stays_accurate_where_every_scan_changes_a_part_of_the_local_map(
    base, std, turn, at
):
    """Two copies of one covariance would drift apart."""
    rng, noise = np.random.default_rng(0), ((0.04, 0.001, 0.003), (0.001, 0.07))
    start = {"initial_pose": (at, at, 0.0), "initial_pose_std": (std, std, turn)}
    slam = CompressedEkfSlam(*noise, base=base, local_size=12, **start)
    full = BASES[base](*noise, **start)
    for odometry, readings, ids in wander(60, 80, seen=20):
        some = rng.choice(20, 6, replace=False)
        for each in (slam, full):
            each.predict(odometry)
            each.update(readings[some], ids[some])
    assert_accurate(slam, full, 1e-7)


@pytest.mark.parametrize("base", ["ekf", "invariant"])
def test_a_phase_without_a_reading_defers_no_work(base):
    slam = run(CompressedEkfSlam(*NOISE, base=base, local_size=12), wander(100, 40))
    ids, whole = slam.landmark_ids, map_of(slam)
    assert len(ids) > 12
    whole.change_local_map(ids[:6], 12, hurried=True)
    assert whole.finish_handover() > 0
    slam.predict((1.0, 0.2))
    whole.change_local_map(ids[-6:], 12, hurried=True)
    assert whole.finish_handover() == 0


@pytest.mark.parametrize("base", BASES)
def test_any_scale_of_a_phase_gives_the_same_belief(base, monkeypatch):
    """Also a diagonal one, which serves where a covariance is indefinite."""
    drive = list(wander(100, 40, jumping=True))
    start = run(map_all(CompressedEkfSlam(*NOISE, base=base), 100), drive[:10])
    expected = run(copy.deepcopy(start), drive[10:]).belief()
    rng = np.random.default_rng(0)

    def diagonal(covariance):
        indefinite = 1e9 * np.eye(len(covariance), k=-1)
        indefinite += np.diag(covariance.diagonal())
        scale, std = scale_of(indefinite), np.sqrt(covariance.diagonal())
        np.testing.assert_allclose(scale, np.diag(std))
        return scale

    def triangular(covariance):
        size = covariance.shape
        return np.tril(0.01 * rng.standard_normal(size)) + np.eye(*size)

    for other in (diagonal, triangular):
        monkeypatch.setattr(phase_update, "scale_of", other)
        found = run(copy.deepcopy(start), drive[10:]).belief()
        assert_close_beliefs(found, expected, 1e-8, 1e-9)


def test_a_scale_is_a_root_of_the_covariance_as_far_as_there_is_one():
    rng = np.random.default_rng(0)
    factor = rng.standard_normal((7, 5)) * [1e-6, 1.0, 1e3, 1.0, 1.0]
    factor[0] = 0.0
    P = factor @ factor.T  # singular, and one variance is 0
    T = scale_of(P)
    std = np.sqrt(P.diagonal() + (P.diagonal() == 0))
    assert (np.abs(T @ T.T - P) <= 1e-11 * np.outer(std, std)).all()
    assert (T.diagonal() > 0).all()
    np.testing.assert_array_equal(T, np.tril(T))
    indefinite = np.array([[4.0, 5.0], [5.0, 1.0]])
    np.testing.assert_allclose(scale_of(indefinite), np.diag([2.0, 1.0]))


def test_a_local_map_lies_ahead_by_half_the_way_of_the_phase_before(monkeypatch):
    slam = map_all(CompressedEkfSlam(*NOISE, local_size=12), 100)
    ahead, places = [], []

    def note(centre, *_):
        ahead.append(centre)
        places.append(map_of(slam).filter.map.mean[:2].copy())

    spied(monkeypatch, active_set, "choose_local", note)
    run(slam, wander(100, 30))
    steps = np.diff(places, axis=0)
    assert np.hypot(*steps.T).max() > 1.0
    np.testing.assert_allclose(ahead[1:], places[1:] + steps / 2, atol=1e-9)


@pytest.mark.usefixtures("_small_maps_are_whole")
def test_a_small_map_that_is_local_as_a_whole_stays_so(monkeypatch):
    slam, changes = CompressedEkfSlam(*NOISE), []
    change = active_set.CompressedMap.change_local_map
    monkeypatch.setattr(
        active_set.CompressedMap,
        "change_local_map",
        lambda *args, **options: changes.append(1) or change(*args, **options),
    )
    scan = np.stack([np.linspace(-2.0, 2.0, 60), np.full(60, 9.0)], axis=1)
    slam.update(scan, range(60))
    for first in range(0, 40, 4):
        slam.update(scan[first : first + 4], range(first, first + 4))
    assert len(slam.local_ids) == 60
    assert not changes


def test_a_local_map_grows_by_half_before_it_changes():
    slam, sizes = CompressedEkfSlam(*NOISE, local_size=4), []
    for k in range(12):  # 6 landmarks are not too many, and one more joins them
        slam.update([(0.1 * k, 3.0)], [k])
        sizes.append(len(slam.local_ids))
    assert sizes == [1, 2, 3, 4, 5, 6, 7, 5, 6, 7, 5, 6]
    with pytest.raises(ValueError, match=r"local_size must be >= 5, .* got 4"):
        slam.update([(0.1 * i, 3.0) for i in range(5)], slam.local_ids[:5])


def test_a_local_map_holds_what_is_required_and_the_nearest_others():
    rng = np.random.default_rng(1)
    points, ids = rng.uniform(-9, 9, (200, 2)), rng.permutation(999)[:200].tolist()
    slots = dict(zip(ids, rng.permutation(200).tolist(), strict=True))
    for required, size in (((), 40), (ids[3:8], 9), (ids[:6], 6), (ids[:6], 2)):
        centre = rng.uniform(-9, 9, 2)
        others = sorted(
            (i for i in ids if i not in required),
            key=lambda i: np.hypot(*(points[slots[i]] - centre)),
        )
        expected = [*required, *others[: max(size - len(required), 0)]]
        found = active_set.choose_local(centre, required, slots, points, size)
        assert list(found) == expected
    everything = active_set.choose_local(centre, ids[:2], slots, points, 999)
    assert {*everything} == {*ids}


@pytest.mark.parametrize(
    ("before", "read", "mapped", "lasted", "extra"),
    [
        *((9, 10, 1000, 3, 4), (9, 10, 1000, 4, 25), (5, 10, 1000, 4, 18)),
        *((0, 2, 1000, 9, 8), (9, 2, 1000, 9, 10), (9, 2, 250, 9, 4)),
        *((9, 4, 500, 0, 8), (3, 10, 125, 9, 5), (9, 12, 625, 9, 26)),
    ],
)
def test_a_local_map_grows_after_long_phases_and_shrinks_after_short_ones(
    before, read, mapped, lasted, extra
):
    assert active_set.extra_landmarks(before, read, mapped, lasted) == extra


def test_a_removed_landmark_leaves_nothing_in_a_saved_state():
    settings = {"base": "first_estimates", "local_size": 12}
    slam = run(CompressedEkfSlam(*NOISE, **settings), wander(100, 40))
    places = dict(zip(slam.landmark_ids, slam.state_dict()["slots"], strict=True))
    gone = [i for i in slam.landmark_ids if i not in slam.local_ids][:3]
    slam.remove(gone)
    state = slam.state_dict()
    for k in [places[i] for i in gone]:
        for key in ("points", "references", "strip"):
            assert not state[key][..., 2 * k : 2 * k + 2].any(), key


def test_a_landmark_counts_as_near_up_to_five_deviations():
    slam = run(CompressedEkfSlam(*NOISE, local_size=12), wander(100, 40))
    pose, whole = slam.belief([]), slam.belief()
    far = [k for k, i in enumerate(whole.landmark_ids) if i not in slam.local_ids]
    k = far[-1]
    away = np.hypot(*(whole.landmarks[k] - pose.pose[:2]))
    parts = whole.landmark_covariances[k], pose.pose_covariance[:2, :2]
    std = sum(np.sqrt(np.trace(part)) for part in parts)
    near = {*map_of(slam).ids_near(pose, away - 4.99 * std)}
    assert {whole.landmark_ids[k], *slam.local_ids} <= near < {*slam.landmark_ids}
    assert whole.landmark_ids[k] not in map_of(slam).ids_near(pose, away - 5.9 * std)
    view = slam.local_view(0.0)
    assert len(view.ids) < len(view.mapped)
    assert view.mapped == slam.landmark_ids


@pytest.mark.slow
def test_over_4000_steps_it_stays_symmetric_and_positive_definite():
    slam = run(CompressedEkfSlam(*NOISE), wander(120, 4000, seen=4))
    belief = slam.belief()
    assert len(belief.landmark_ids) > 100
    np.testing.assert_array_equal(belief.covariance, belief.covariance.T)
    assert np.linalg.eigvalsh(belief.covariance).min() > 0


@pytest.mark.parametrize("base", ["ekf", "invariant"])
def test_a_part_of_the_belief_is_that_part_of_the_whole(base):
    slam = map_all(CompressedEkfSlam(*NOISE, base=base), 300)
    rng = np.random.default_rng(0)
    for odometry, readings, ids in wander(300, 40):
        slam.predict(odometry)
        slam.update(readings, ids)
        some = [*rng.permutation(slam.local_ids)[:2], *rng.permutation(300)[:4]]
        some = list(dict.fromkeys(int(i) for i in some))
        whole = slam.belief()
        assert_close_beliefs(slam.belief(some), part_of(whole, some), 1e-13)
        np.testing.assert_array_equal(slam.belief([]).pose, whole.pose)


@pytest.mark.parametrize("base", ["ekf", "invariant"])
def test_to_ask_for_the_belief_changes_nothing(base):
    quiet, asked = (CompressedEkfSlam(*NOISE, base=base) for _ in range(2))
    run(quiet, wander(200, 150))
    for odometry, readings, ids in wander(200, 150):
        asked.predict(odometry)
        asked.update(readings, ids)
        asked.belief([])
        asked.belief()
    assert_same_bits(quiet.belief(), asked.belief())


@pytest.mark.parametrize("near", [True, False])
def test_to_remove_landmarks_leaves_all_else_exactly_as_it_was(near):
    slam = run(CompressedEkfSlam(*NOISE, base="invariant"), wander(200, 150))
    before = slam.belief()
    gone = [i for i in slam.landmark_ids if (i in slam.local_ids) == near][::3]
    slam.remove(gone)
    stays = [i for i in before.landmark_ids if i not in gone]
    assert_close_beliefs(slam.belief(), part_of(before, stays), 0, 1e-15)


@pytest.mark.parametrize(
    ("base", "jumping"),
    [("ekf", False), ("invariant", True), ("first_estimates", False)],
)
def test_a_merge_is_that_of_the_full_filter(base, jumping):
    count = 60
    slam, full = CompressedEkfSlam(*NOISE, base=base), BASES[base](*NOISE)
    for step, (odometry, readings, ids) in enumerate(
        wander(count, 300, jumping=jumping)
    ):
        told = np.where((ids < 10) & (100 <= step < 200), ids + count, ids)
        for each in (slam, full):
            each.predict(odometry)
            each.update(readings, told)
        if step == 200:
            twice = [i for i in range(10) if {i, i + count} <= set(slam.landmark_ids)]
            assert len(twice) > 1
            for i in twice:
                slam.merge(i, i + count)
                MapEditor(full).merge_pairs([(i, i + count)])
            assert_equal_beliefs(slam.belief(), full.belief())
    assert_equal_beliefs(slam.belief(), full.belief())


def test_landmarks_added_after_a_removal_have_places_of_their_own():
    slam, full = CompressedEkfSlam(*NOISE), EkfSlam(*NOISE)
    readings = np.column_stack([np.linspace(-1, 1, 6), np.full(6, 4.0)])
    for each in (slam, full):
        each.update(readings[:3], [0, 1, 2])
        each.remove([1])
        each.update(readings[3:], [3, 4, 5])  # the first of these in the place of 1
    assert sorted(slam.state_dict()["slots"]) == [0, 1, 2, 3, 4]
    assert_equal_beliefs(slam.belief(), full.belief())


def test_a_landmark_removed_and_seen_again_is_a_new_one():
    slam = run(CompressedEkfSlam(*NOISE), wander(200, 150))
    first, last = slam.landmark_ids[0], slam.local_ids[-1]
    slam.remove([first, last])
    report = slam.update([(0.1, 3.0), (0.5, 4.0)], [last, first])
    assert report.added_ids == (last, first)
    assert slam.landmark_ids[-2:] == (last, first)


def test_a_state_is_shared_with_nobody():
    slam = map_all(CompressedEkfSlam(*NOISE), 200)
    drive = list(wander(200, 150))
    run(slam, drive[:50])
    state = slam.state_dict()
    kept = pickle.dumps(state)
    other = CompressedEkfSlam(*NOISE)
    other.load_state_dict(state)
    for each in (slam, other):
        near = each.local_ids
        run(each, drive[50:])
        assert each.local_ids != near
    assert pickle.dumps(state) == kept


@pytest.mark.parametrize(
    ("base", "jumping"), [("ekf", False), ("ekf", True), ("invariant", True)]
)
def test_no_step_does_more_of_the_map_than_a_full_update(base, jumping, monkeypatch):
    count, seen = 400, 10
    done = []

    def count_numbers(self, blocks):
        size = sum(self._blocks[k].size for k in blocks)
        done[-1] += len(self._pending[0].signs) * size

    slam = map_all(CompressedEkfSlam(*NOISE, base=base), count)
    spied(monkeypatch, DeferredCovariance, "_apply", count_numbers)
    waiting = []
    for odometry, readings, ids in wander(count, 150, seen=seen, jumping=jumping):
        slam.predict(odometry)
        done.append(0)
        slam.update(readings, ids)
        waiting.append(map_of(slam).deferred.pending_rank)
    full = 2 * seen * (2 * count) ** 2 / 2
    assert max(done) < 2 * full
    assert sum(step > 0 for step in done) > 5
    assert max(waiting) < 150  # and nothing piles up


def test_work_that_is_taken_back_is_not_done_twice_also_after_a_saved_state():
    rng, stored, loaded = np.random.default_rng(0), DeferredCovariance(), None
    stored.make_room(4 * BLOCK)
    roots = rng.standard_normal((2, 4 * BLOCK, 30))
    for root in roots:
        stored.defer(Downdate(root, np.ones(30), []))
    for rank in (20, 15):  # it begins; then some more blocks
        undo = stored.checkpoint()
        stored.work(rank)
        undo()
        stored.work(rank)
        loaded = DeferredCovariance()
        loaded.load_state_dict(stored.state_dict())
        same(loaded.state_dict(), stored.state_dict())
        assert 0 < stored.state_dict()["progress"][1] < 4
        for each in (loaded, stored)[: 1 + (rank == 15)]:
            undo = each.checkpoint()
            each.work(18)
            undo()
            each.work(200)
            found = each.marginal(np.arange(4 * BLOCK))
            expected = -sum(root @ root.T for root in roots)
            np.testing.assert_allclose(found, expected, atol=1e-10)
    none = DeferredCovariance().state_dict() | {"progress": np.array([1.0, 0.0, 0.0])}
    with pytest.raises(ValueError, match=r"progress'\] must be 0 or 1, at most 0 blo"):
        stored.load_state_dict(none)


def test_a_downdate_without_memory_is_still_to_be_applied(monkeypatch):
    stored, columns = DeferredCovariance(), np.arange(4)
    stored.make_room(1)
    root = np.random.default_rng(0).standard_normal((stored.width, 50))
    stored.defer(Downdate(root, np.ones(50), []))
    before = stored.marginal(columns)

    def refuse(*_):
        raise MemoryError

    with monkeypatch.context() as patched:
        patched.setattr(DeferredCovariance, "_apply", refuse)
        with pytest.raises(MemoryError):
            stored.work(50)
    np.testing.assert_array_equal(stored.marginal(columns), before)
    stored.work(50)
    assert not stored.pending_rank
    np.testing.assert_allclose(stored.marginal(columns), before)


@pytest.mark.parametrize("base", ["ekf", "invariant"])
def test_a_change_of_the_local_map_is_spread_over_steps(base, monkeypatch):
    """After a long phase, no step exchanges more than a quarter of the blocks.

    The step of the change exchanges none, nor does the next one, which factors Ψ.
    """
    done, factored, ages = [], [], []

    def count_blocks(self, stored, blocks):
        done[-1] += len(blocks)

    def count_factors(self, width):
        factored[-1] += 1

    slam = map_all(CompressedEkfSlam(*NOISE, base=base, local_size=40), 600)
    spied(monkeypatch, Handover, "_exchange", count_blocks)
    spied(monkeypatch, Handover, "_factor", count_factors)
    for odometry, readings, ids in wander(600, 80):
        slam.predict(odometry)
        done.append(0)
        factored.append(0)
        slam.update(readings, ids)
        ages.append(slam._age)
    blocks = 1200 // BLOCK + 1
    assert max(done[10:]) <= blocks // 4
    assert sum(done[10:]) >= 2 * blocks
    last = list(zip(ages, done, factored, strict=True))[10:]
    assert {age for age, count, _ in last if count} == {3, 4, 5, 6, 7}
    assert {age for age, _, count in last if count} == {2}


@pytest.mark.parametrize("base", ["ekf", "invariant"])
def test_a_question_may_be_interrupted_while_it_finishes_a_change(base):
    slam = map_all(CompressedEkfSlam(*NOISE, base=base), 150)
    for odometry, readings, ids in wander(150, 80):
        slam.predict(odometry)
        slam.update(readings, ids)
        if slam._age == 3:  # a part of the rows is exchanged
            break
    expected = copy.deepcopy(slam).belief()
    finish = map_of(copy.deepcopy(slam)).finish_handover
    for line in range(lines_of(finish)):
        other = copy.deepcopy(slam)
        assert is_interrupted(map_of(other).finish_handover, line)
        assert_same_bits(other.belief(), expected)


def test_what_it_stores_is_about_half_a_covariance():
    slam = map_all(CompressedEkfSlam(*NOISE), 1000)
    run(slam, wander(1000, 20))
    assert map_of(slam)._handover is not None  # the largest in a change
    assert slam.nbytes < 0.65 * 8 * 2003**2
    assert 0.8 < slam.nbytes / bytes_of_arrays(map_of(slam)) < 1.0  # others: scratch


def bytes_of_arrays(whole):
    """Return the memory of all arrays that an object refers to, at any depth."""
    found, waiting, total = set(), [whole], 0
    while waiting:
        part = waiting.pop()
        if id(part) in found or isinstance(part, type | ModuleType | FunctionType):
            continue
        found.add(id(part))
        if not isinstance(part, np.ndarray):
            waiting += gc.get_referents(part)
        elif part.base is None:
            total += part.nbytes
        else:
            waiting.append(part.base)
    return total


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: CompressedEkfSlam(*NOISE, base="robocentric"),
         r"base must be 'ekf' or .*, got 'robocentric'"),
        (lambda: CompressedEkfSlam(*NOISE, local_size=0),
         r"local_size must be a whole number >= 1, got 0"),
        (lambda: CompressedEkfSlam(*NOISE, sensor="range"),
         "the compressed filter needs a sensor whose single reading locates a land"),
        (lambda: CompressedEkfSlam(*NOISE).belief([3]),
         r"landmark_ids must be of mapped landmarks, got 3"),
        (lambda: CompressedEkfSlam(*NOISE).remove([3]),
         r"landmark_ids must be of mapped landmarks, got 3"),
        (lambda: CompressedEkfSlam(*NOISE).update([(0.0, 1.0)], [-(2**63)]),
         r"landmark_ids must be >= -\d+, got -9223372036854775808"),
        (lambda: CompressedEkfSlam(*NOISE).update([(0.0, 1.0)]),
         r"landmark_ids must be given: CompressedEkfSlam does not associate"),
    ],
)  # fmt: skip
def test_bad_arguments_are_named(call, message):
    with pytest.raises(ValueError, match=message):
        call()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"estimator": np.array("EkfSlam")}, "state is of EkfSlam, not of Compressed"),
        ({"base": np.array("EkfSlam")}, "state is of EkfSlam, not of InvariantEkfSlam"),
        ({"strip": np.zeros((3, 3))}, r"state\['strip'\] must have shape"),
        ({"slots": np.zeros(3, dtype=int)}, r"state\['slots'\] must have one entry"),
        ({"counts": np.array([99, 0, 0, 0, 0])}, r"state\['counts'\] must be at least"),
        ({"scale": np.eye(3)}, r"state\['scale'\] must have shape"),
        ({"points": np.zeros(3)}, r"state\['points'\] must have shape"),
        ({"far_covariance": np.zeros(7)}, "must be whole blocks of rows"),
        ({"far_pending_root": np.zeros((7, 0))}, "pending_root.* must have shape"),
        ({"local_mean": np.zeros(4)}, r"state\['mean'\] must have shape"),
        ({"origin": None}, "state must hold 'origin'"),
    ],
)
def test_a_state_that_does_not_fit_is_refused_and_changes_nothing(change, message):
    slam = run(CompressedEkfSlam(*NOISE, base="invariant"), wander(100, 60))
    before, state = slam.belief(), slam.state_dict() | change
    state = {key: value for key, value in state.items() if value is not None}
    with pytest.raises(ValueError, match=message):
        slam.load_state_dict(state)
    assert_same_bits(before, slam.belief())


@pytest.mark.parametrize("row", [0, 2, 3, -1])
def test_a_saved_variance_of_a_local_landmark_must_be_positive(row):
    local = CompressedEkfSlam(*NOISE, base="invariant", local_size=20)
    state = run(map_all(local, 60), wander(60, 10)).state_dict()
    P, virtual = state["local_covariance"].copy(), state["counts"][0]
    assert virtual > 0
    own = range(3 + 2 * virtual, len(P))
    P[own[row], own[row]] *= -1
    with pytest.raises(ValueError, match=r"state\['local_covariance'\]"):
        local.load_state_dict(state | {"local_covariance": P})


def test_a_saved_scale_must_be_triangular():
    slam = map_all(CompressedEkfSlam(*NOISE), 100)
    state = run(slam, wander(100, 5, jumping=True)).state_dict()
    for scale in (state["scale"].T, -state["scale"], np.zeros_like(state["scale"])):
        with pytest.raises(ValueError, match="must be triangular, with a diag"):
            slam.load_state_dict(state | {"scale": scale})


def test_a_restart_forgets_the_map():
    slam = run(CompressedEkfSlam(*NOISE, base="invariant"), wander(200, 100))
    slam.reset((1.0, 2.0, 0.5), (0.1, 0.1, 0.1))
    start = {"initial_pose": (1.0, 2.0, 0.5), "initial_pose_std": (0.1, 0.1, 0.1)}
    fresh = CompressedEkfSlam(*NOISE, base="invariant", **start)
    assert digest(slam) == digest(fresh)
    for each in (slam, fresh):
        run(each, wander(200, 120))
    assert_same_bits(slam.belief(), fresh.belief())


def test_bases_are_what_they_say():
    assert BASES["ekf"] is EkfSlam
    assert BASES["invariant"] is InvariantEkfSlam


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_the_stored_covariance_is_that_of_a_dense_matrix(seed):
    """Any order of reading, putting back, deferring and working."""
    rng = np.random.default_rng(seed)
    width = 3 * BLOCK
    store, dense = DeferredCovariance(), np.zeros((width, width))
    store.make_room(width)
    taken = np.empty(0, dtype=np.int64)
    for _ in range(12):
        if len(taken):  # put back, changed
            rows = rng.standard_normal((len(taken), width))
            rows[:, taken] += rows[:, taken].T
            dense[taken], dense[:, taken] = rows, rows.T
            places = rng.permutation(len(taken))
            store.forget(taken)
            for blocks in (range(1), range(1, 3)):
                store.put(blocks, taken, rows[np.argsort(places)], places)
        taken = np.sort(rng.choice(width, rng.integers(1, 9), replace=False))
        root = rng.standard_normal((width, rng.integers(1, 60)))
        signs = rng.choice([-1.0, 1.0], root.shape[1])
        downdate = Downdate(root.copy(), signs, [])
        dense -= (root * signs) @ root.T
        rows = np.empty((len(taken), width))
        for blocks in (range(2), range(2, 3)):
            store.read(blocks, taken, rows, downdate)
        np.testing.assert_allclose(rows, dense[taken], atol=1e-10)
        store.defer(downdate)
        store.work(int(rng.integers(0, 60)))
        other = np.setdiff1d(rng.choice(width, 20, replace=False), taken)
        rng.shuffle(other)
        expected = dense[np.ix_(other, other)]
        np.testing.assert_allclose(store.marginal(other), expected, atol=1e-10)


@pytest.mark.usefixtures("_small_maps_are_whole")
@pytest.mark.parametrize("base", BASES)
def test_in_a_small_map_it_has_the_bits_of_the_full_filter(base):
    full, slam = BASES[base](*NOISE), CompressedEkfSlam(*NOISE, base=base)
    for odometry, readings, ids in wander(100, 60, jumping=True):
        for each in (full, slam):
            each.predict(odometry)
            each.update(readings, ids)
    assert slam.local_ids == slam.landmark_ids
    assert_same_bits(slam.belief(), full.belief())


@pytest.mark.usefixtures("_small_maps_are_whole")
@pytest.mark.parametrize("base", ["ekf", "invariant"])
def test_a_map_may_become_large_and_small_and_large_again(base, monkeypatch):
    full, slam = BASES[base](*NOISE), CompressedEkfSlam(*NOISE, base=base)
    resumed = CompressedEkfSlam(*NOISE, base=base)
    for each in (full, slam):
        map_all(each, WHOLE)
    assert slam.local_ids == slam.landmark_ids
    larger = map_all(slam, WHOLE + 40), map_all(full, WHOLE + 40)
    for step, (odometry, readings, ids) in enumerate(wander(WHOLE + 40, 90)):
        if step == 30:
            assert len(slam.local_ids) < 60
            gone = [i for i in range(WHOLE + 40) if i not in ids][: WHOLE // 2]
            slam.remove(gone)
            forget(full, gone)
        if step == 60:
            assert set(slam.local_ids) == set(slam.landmark_ids)
            assert_equal_beliefs(slam.belief(), full.belief())
            for limit in LIMITS:
                monkeypatch.setattr(active_set, limit, WHOLE // 2)
        for each in larger:
            each.predict(odometry)
            each.update(readings, ids)
        if step % 10 == 9:
            resumed.load_state_dict(slam.state_dict())
            assert_same_bits(resumed.belief(), slam.belief())
    assert len(slam.local_ids) < 60
    assert_equal_beliefs(slam.belief(), full.belief())


@pytest.mark.usefixtures("_small_maps_are_whole")
def test_a_local_size_asked_for_holds_in_a_small_map_too():
    slam = run(CompressedEkfSlam(*NOISE, local_size=12), wander(100, 60))
    assert len(slam.local_ids) <= 18 + 10 < len(slam.landmark_ids)


def test_a_filter_that_was_continued_from_a_saved_state_begins_phases_alike():
    """Its arrays have another capacity, and must be as empty behind what is in use."""
    drive = list(wander(300, 120))
    slam = run(map_all(CompressedEkfSlam(*NOISE), 300), drive[:60])
    other = CompressedEkfSlam(*NOISE)
    other.load_state_dict(slam.state_dict())
    for each in (slam, other):
        near = each.local_ids
        run(each, drive[60:])
        assert each.local_ids != near
        size = map_of(each).filter.map.size
        for array in (map_of(each).filter.map.mean, map_of(each).filter.map.covariance):
            assert not array[size:].any()
        assert not map_of(each).filter.map.covariance[:, size:].any()
    assert_same_bits(slam.belief(), other.belief())


def test_the_legend_of_the_benchmark_names_what_was_measured(tmp_path):
    costs = {"ekf": Costs([1e-4]), "compressed": Costs([1e-5], 1000)}
    growing_maps.draw({300: costs, 1000: costs}, tmp_path / "curves.png")
    lines, names = plt.gcf().axes[0].get_legend_handles_labels()
    plt.close()
    assert "ekf" in names
    assert "GTSAM iSAM2, mean" not in names
    assert all(len(line.get_xdata()) == 2 for line in lines)
