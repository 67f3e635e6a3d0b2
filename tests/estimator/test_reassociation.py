"""The repair of the association of a drive."""

from itertools import permutations

import numpy as np
import pytest
from scipy.special import xlogy

from slamgym.estimator.models.bearing_range import predict_measurement
from slamgym.estimator.models.motions import predict_pose
from slamgym.estimator.smoother import Drive, reassociate, smooth
from slamgym.estimator.smoother.drive import Sightings
from slamgym.estimator.smoother.reassociation import (
    NONE,
    PRICE,
    _Association,
    _prices,
    _Search,
)

MOTION_STD, MEASUREMENT_STD = (0.02, 0.01, 0.01), (0.02, 0.1)
LAP = 50
WORLD = np.random.default_rng(3).uniform(-11.0, 11.0, (14, 2))


def two_laps(seed):
    """Return the true path, and a drive with the true identities, without clutter."""
    rng = np.random.default_rng(seed)
    made = Drive(MOTION_STD, MEASUREMENT_STD, initial_pose=(8, 0, np.pi / 2))
    pose, path, odometry = np.array([8.0, 0.0, np.pi / 2]), [], (1.0, 2 * np.pi / LAP)
    for k in range(2 * LAP):
        if k:
            moved = predict_pose(pose, odometry)
            slip = np.array(MOTION_STD) * rng.standard_normal(3)
            pose = moved.pose + moved.jacobian_noise @ slip
            made.predict(odometry)
        exact = predict_measurement(pose, WORLD).measurement
        z = exact + np.array(MEASUREMENT_STD) * rng.standard_normal(exact.shape)
        near = np.flatnonzero((exact[:, 1] < 7.0) & (exact[:, 1] > 0.5))
        made.update(z[near], near)
        path.append(pose)
    return np.array(path), made


def renamed(drive, rename):
    """Return a drive with the identities rename(scan, ids)."""
    pairs = enumerate(drive.scans)
    return drive.with_scans([Sightings(z, rename(k, ids)) for k, (z, ids) in pairs])


def twice(k, ids):
    """Name every landmark anew in the second lap."""
    return ids + 100 * (k >= LAP)


def swapped(k, ids):
    """Swap two pairs of landmarks in the second lap."""
    swap = np.arange(len(WORLD))
    swap[[2, 5, 7, 9]] = [5, 2, 9, 7]
    return swap[ids] if k >= LAP else ids


def dropped(k, ids):
    """Give no landmark to the readings of two landmarks."""
    alone = 1000 + 20 * k + ids
    return np.where((ids == 4) | (ids == 8), alone, ids)


def as_one(k, ids):
    """Give landmark 6 the name of 3, in scans that do not show both."""
    both = (ids == 3).any()
    return np.where((ids == 6) & ~both, 3, ids)


def outcome(ids, truth):
    """Count misplaced readings, those of no landmark, and landmarks."""
    found, true = (
        np.concatenate(ids),
        np.concatenate([scan.ids for scan in truth.scans]),
    )
    labels = np.unique(found[found != NONE])
    right = sum(np.bincount(true[found == i]).max() for i in labels)
    unused = np.count_nonzero(found == NONE)
    return len(true) - right - unused, unused, len(labels)


def shuffled(k, ids):
    """Give all landmarks other names in every scan: the run is wholly lost."""
    return np.random.default_rng(k).permutation(len(WORLD))[ids]


@pytest.mark.parametrize("spoil", [twice, swapped, as_one, shuffled])
def test_a_spoilt_association_is_repaired(spoil):
    _, right = two_laps(1)
    wrong = renamed(right, spoil)
    found = reassociate(wrong)
    assert found.score < found.first_score - 10
    misplaced, unused, landmarks = outcome(found.ids, right)
    assert misplaced == 0
    assert unused <= 0.01 * right.readings
    assert landmarks == len(right.landmark_ids)
    best = smooth(right)
    repaired = smooth(wrong, associate=True)
    np.testing.assert_allclose(repaired.poses, best.poses, atol=0.03)


def test_a_right_association_is_left_alone():
    _, right = two_laps(2)
    found = reassociate(right)
    assert not found.changed
    assert found.score == found.first_score
    assert outcome(found.ids, right) == (0, 0, len(WORLD))


def test_an_association_that_only_leaves_readings_out_stays_as_it_is():
    """More explained readings are no evidence: more landmarks always explain more."""
    _, right = two_laps(1)
    wrong = renamed(right, dropped)
    found = reassociate(wrong)
    assert not found.changed
    assert outcome(found.ids, right)[::2] == (0, len(WORLD) - 2)


def test_detections_are_counted_as_by_a_plain_loop():
    path, right = two_laps(3)
    pairs = [(z, ids) if k % 9 else (z[:0], ids[:0]) for k, (z, ids) in
             enumerate(right.scans)]  # fmt: skip
    right = right.with_scans([Sightings(*pair) for pair in pairs])
    search = _Search(right)
    labels = np.concatenate([scan.ids for scan in right.scans])
    labels[::7] = NONE
    counts = np.zeros((2, 2), dtype=int)
    for landmark, place in enumerate(WORLD):
        before = None
        for k, pose in enumerate(path):
            if k % 9 == 0:  # a scan without a reading counts for nothing
                continue
            (bearing, distance), *_ = predict_measurement(pose, place[None]).measurement
            if distance > search.reach or abs(bearing) > search.width:
                continue
            now = int(landmark in labels[search.owners == k])
            if before is not None:
                counts[before, now] += 1
            before = now
    assert counts[0].sum() > 20
    np.testing.assert_array_equal(search.detections(path, WORLD, labels), counts)


def test_costs_are_those_of_single_readings():
    path, right = two_laps(3)
    search = _Search(right)
    found = search.costs(path, WORLD)
    rows = np.random.default_rng(0).choice(len(found), 30)
    std = np.array(MEASUREMENT_STD)
    for i in rows.tolist():
        z = search.data.readings[i]
        gap = z - predict_measurement(path[search.owners[i]], WORLD).measurement
        gap[:, 0] = np.angle(np.exp(1j * gap[:, 0]))
        expected = np.minimum(((gap / std) ** 2).sum(axis=1) / 2, PRICE)
        np.testing.assert_allclose(found[i], expected, rtol=1e-9)


def test_two_landmarks_for_one_do_not_lower_the_score():
    path, right = two_laps(4)
    search = _Search(right)
    first = search.first(path)
    half = np.where(
        search.located(path)[:, 0] > WORLD[search.order[search.data.columns // 2], 0],
        0,
        50,
    )
    labels = np.where(first.labels == 3, 3 + half, first.labels)
    places = np.vstack([first.places, np.zeros((50, 2))])
    places[53] = first.places[3]
    assert search.smoothed(labels, first.poses, places).score > first.score + 10


def test_the_score_is_the_negative_logarithm_of_the_evidence():
    path, right = two_laps(4)
    search = _Search(renamed(right, dropped))
    state = search.first(path)
    unused = np.count_nonzero(state.labels == NONE)
    assert unused > 20
    best = smooth(
        renamed(right, lambda k, ids: np.where(np.isin(ids, (4, 8)), -1, ids))
    )
    spread = np.linalg.slogdet(best.covariance([]))[1]
    area = np.prod(np.ptp(search.located(path), axis=0))
    counts = search.detections(state.poses, state.places, state.labels)
    rates = counts / counts.sum(axis=1, keepdims=True)
    expected = best.cost - spread / 2 + len(state.places) * np.log(area / (2 * np.pi))
    expected += PRICE * unused - xlogy(counts, rates).sum()
    assert state.cost == pytest.approx(best.cost, rel=1e-4)
    assert state.score == pytest.approx(expected, rel=1e-4)


@pytest.mark.parametrize(
    ("followed", "rebuilt", "lowest"),
    [(1, 2, 2), (2, 1, 2), (2, None, 2), (None, 1, 1), (-1, -2, 0), (None, None, 0)],
)
def test_the_lowest_score_decides_whatever_its_cost(
    monkeypatch, followed, rebuilt, lowest
):
    path, right = two_laps(1)
    first = _Search(right).first(path)

    def lower(by):
        score, cost = first.score - 1000.0 * (by or 0), first.cost + 10.0 * (by or 0)
        return None if by is None else first._replace(score=score, cost=cost)

    monkeypatch.setattr(_Search, "followed", lambda _: lower(followed))
    monkeypatch.setattr(_Search, "settled", lambda _, state: state)
    monkeypatch.setattr(_Search, "rebuilt", lambda *_: lower(rebuilt))
    found = reassociate(right, start=path)
    assert (found.first_score, found.changed) == (first.score, lowest > 0)
    assert found.score == lower(lowest).score


def test_only_a_landmark_that_most_scans_show_is_born():
    path, right = two_laps(1)
    search = _Search(right)
    state = search.first(path)
    costs = search.costs(state.poses, state.places)
    price = 1.0  # saved by few readings of any landmark
    prices = _prices(search.detections(state.poses, state.places, state.labels))
    assert search.birth(state.poses, costs, price, prices) is None
    for k, place in enumerate(state.places):
        born = search.birth(state.poses, np.delete(costs, k, 1), price, prices)
        np.testing.assert_allclose(born, place, atol=0.5)


def test_each_scan_gives_its_readings_to_landmarks_at_the_least_cost():
    search = _Search(two_laps(1)[1])
    rng = np.random.default_rng(0)
    costs = rng.uniform(0, 2 * PRICE, (len(search.owners), 4))
    rank = np.arange(len(search.owners)) - search.data.firsts[search.owners]
    costs[rank >= 4] = PRICE  # more would be too many for a search
    labels, together = search.assigned(costs), np.zeros((4, 4), dtype=bool)
    for scan in range(0, search.count, 7):
        rows = np.flatnonzero(search.owners == scan)[:4]
        table = np.hstack([costs[rows], np.full((len(rows),) * 2, PRICE)])
        least = min(
            table[range(len(rows)), marks].sum()
            for marks in permutations(range(table.shape[1]), len(rows))
        )
        found = labels[rows]
        used = found[found != NONE]
        assert len({*used.tolist()}) == len(used)
        paid = np.where(found == NONE, PRICE, costs[rows, found])
        assert paid.sum() == pytest.approx(least)
    for scan in range(search.count):
        shown = labels[search.owners == scan]
        shown = shown[shown != NONE]
        together[np.ix_(shown, shown)] = True
    np.testing.assert_array_equal(search.together(labels, 4), together)


@pytest.mark.parametrize("gap", [30, 31])
def test_a_visit_ends_with_a_gap_of_more_than_30_scans(gap):
    search = _Search(two_laps(1)[1])
    labels, rows = np.full(len(search.owners), NONE), search.starts[[10, 10 + gap]]
    labels[rows] = 0
    first, second = search.visits(labels)[rows]
    assert (first == second) == (gap == 30)


def test_the_cost_of_more_readings_is_scaled_to_the_number_of_fewer():
    def state(used, cost):
        labels = np.where(np.arange(10) < used, 0, NONE)
        score = cost + PRICE * (10 - used) + 1.0
        return _Association(labels, *[np.empty(0)] * 2, score, cost, np.empty(0))

    few, many = state(5, 4.0), state(10, 6.0)
    assert few.advantage_of(many) == pytest.approx(4.0 - 6.0 / 2)
    assert many.advantage_of(few) == pytest.approx(6.0 / 2 - 4.0)


@pytest.mark.parametrize(("readings", "dies"), [(2, 0), (3, None)])
def test_a_landmark_dies_with_fewer_than_three_readings(readings, dies):
    path, right = two_laps(1)
    search = _Search(right)
    costs = search.costs(path, WORLD[:1])
    labels = np.full(len(costs), NONE)
    labels[np.flatnonzero(costs[:, 0] < PRICE / 2)[:readings]] = 0
    assert search.death(labels, costs, price=1.0) == dies


def test_progress_and_refusals():
    _, right = two_laps(5)
    seen = []
    reassociate(right, progress=lambda done, steps: seen.append((done, steps)))
    done, steps = zip(*seen, strict=True)
    assert done == tuple(range(1, steps[0] + 1))
    single = renamed(right, lambda k, ids: 1000 * (k + 1) + ids)
    with pytest.raises(ValueError, match="no landmark has 3 readings"):
        reassociate(single)
