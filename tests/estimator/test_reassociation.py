"""The repair of the association of a drive."""

from itertools import permutations

import numpy as np
import pytest
from scipy.special import xlogy

from slamgym.estimator.models.bearing_range import predict_measurement
from slamgym.estimator.models.motions import predict_pose
from slamgym.estimator.models.rigid_motion import rotation
from slamgym.estimator.smoother import Drive, reassociate, smooth
from slamgym.estimator.smoother.drive import Sightings
from slamgym.estimator.smoother.reassociation import (
    NONE,
    PRICE,
    _Association,
    _prices,
    _Search,
    _surprise,
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
        others = np.delete(costs, k, 1)
        born = search.birth(state.poses, others, price, prices)
        np.testing.assert_allclose(born, place, atol=0.5)
        labels = search.assigned(others)
        paid = np.where(labels == NONE, PRICE, others[search.rows, labels])
        saved = paid - search.costs(state.poses, born[None])[:, 0]
        seen = np.where(saved > 0, 0, NONE)
        worth = np.maximum.reduceat(np.maximum(saved, 0.0), search.starts).sum()
        worth -= (prices * search.detections(state.poses, born[None], seen)).sum()
        for gap, is_born in ((-1e-6, True), (1e-6, False)):
            again = search.birth(state.poses, others, worth + gap, prices)
            assert (again is not None) == is_born


def test_the_readings_of_each_scan_are_assigned_at_the_least_cost():
    search = _Search(two_laps(1)[1])
    rng = np.random.default_rng(0)
    costs = rng.uniform(0, 2 * PRICE, (len(search.owners), 4))
    rank = np.arange(len(search.owners)) - search.data.firsts[search.owners]
    costs[rank >= 4] = PRICE  # so that all permutations can be tried
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


def scored(score, labels=(), places=(), covariance=()):
    """Return an association with these parts; the others do not matter."""
    parts = np.array(labels, dtype=int), np.zeros((1, 3)), np.array(places, dtype=float)
    return _Association(*parts, score, 0.0, np.array(covariance))


def test_a_drive_is_first_smoothed_from_the_mean_places_of_its_readings(monkeypatch):
    path, right = two_laps(1)
    search, given = _Search(right), []
    for scores in ((1.0, 2.0), (2.0, 1.0), (None, 3.0), (3.0, None)):
        one, other = (None if each is None else scored(each) for each in scores)
        keep = lambda *args, one=one: given.append(args) or one  # noqa: E731
        monkeypatch.setattr(search, "smoothed", keep)
        monkeypatch.setattr(search, "begun", lambda _, other=other: other)
        least = min(score for score in scores if score)
        assert search.first(path).score == least
    labels, _, places = given[0]
    located = search.located(path)
    for i in range(len(WORLD)):
        np.testing.assert_allclose(places[i], located[labels == i].mean(axis=0))
    sides = np.log(np.ptp(located, axis=0)).sum()
    assert search.log_area == pytest.approx(sides)


def test_small_changes_count_if_they_lower_the_score_significantly(monkeypatch):
    search, scores = _Search(two_laps(1)[1]), iter([9.95, 9.8, 9.75, 9.0, 8.95, 8.91])
    for name in ("joined", "rearranged"):
        monkeypatch.setattr(search, name, lambda _: scored(next(scores)))
    assert search.settled(scored(10.0)).score == 9.0
    assert next(scores, None) is None
    falling = iter(range(99))
    monkeypatch.setattr(search, "joined", lambda _: scored(-next(falling)))
    assert search.settled(scored(10.0)).score == -7.0  # after eight rounds


def test_landmarks_are_born_then_die_and_readings_go_to_the_others(monkeypatch):
    path, right = two_laps(1)
    search = _Search(right)
    state, given = search.first(path), []
    fewer = state._replace(places=state.places[:-2], covariance=state.covariance)
    fewer = fewer._replace(covariance=state.covariance[:-4, :-4])
    fewer = fewer._replace(labels=np.where(state.labels < 12, state.labels, NONE))
    births, deaths = iter([*state.places[-2:], None]), iter([1, 0, None])
    monkeypatch.setattr(search, "birth", lambda *_: next(births))
    monkeypatch.setattr(search, "death", lambda *_: next(deaths))
    monkeypatch.setattr(search, "smoothed", lambda *args: given.append(args))
    search.rearranged(fewer)
    ((labels, poses, places),) = given
    np.testing.assert_array_equal(places, state.places[2:])
    assert poses is state.poses
    costs = search.costs(state.poses, places)
    np.testing.assert_array_equal(labels, search.assigned(costs))


def test_the_landmark_whose_readings_fit_others_best_is_removed():
    search, rng = _Search(two_laps(1)[1]), np.random.default_rng(3)
    costs = rng.uniform(0, 1.5 * PRICE, (len(search.owners), 4))
    labels = search.assigned(costs)
    labels[rng.random(len(labels)) < 0.9] = NONE
    losses = np.zeros(4)
    for i in np.flatnonzero(labels != NONE):
        shown = {*labels[search.owners == search.owners[i]].tolist()}
        others = [costs[i, j] for j in range(4) if j not in shown]
        losses[labels[i]] += min([PRICE, *others]) - costs[i, labels[i]]
    worst = int(losses.argmin())
    assert search.death(labels, costs, losses[worst] + 1e-9) == worst
    assert search.death(labels, costs, losses[worst] - 1e-9) is None
    labels[np.flatnonzero(labels == worst)[2:]] = NONE
    assert search.death(labels, costs, -99.0) == worst  # two readings are too few


def test_landmarks_that_are_probably_one_are_joined_unless_seen_together(monkeypatch):
    search, rng, given = _Search(two_laps(1)[1]), np.random.default_rng(5), []
    places = np.repeat(rng.uniform(-9, 9, (4, 2)), 3, axis=0)
    places += 0.05 * rng.standard_normal(places.shape)
    root = 0.05 * rng.standard_normal((24, 24))
    labels = np.full(len(search.owners), NONE)
    labels[search.starts] = np.arange(len(search.starts)) % 12
    first = search.starts[0]
    labels[[first, first + 1]] = 0, 1  # in one scan
    search.log_area, P, losses = 5.0, root @ root.T, []
    for i in range(12):
        for j in range(i + 1, 12):
            H = np.zeros((2, 24))
            H[:, 2 * i : 2 * i + 2], H[:, 2 * j : 2 * j + 2] = np.eye(2), -np.eye(2)
            D, d = H @ P @ H.T, places[i] - places[j]
            loss = d @ np.linalg.solve(D, d) / 2 - 5.0
            loss += np.log(2 * np.pi * np.sqrt(np.linalg.det(D)))
            losses.append((loss, i, j))
    rename, free = np.arange(12), {*range(12)}
    for loss, i, j in sorted(losses):
        if loss < 0 and {i, j} <= free and (i, j) != (0, 1):
            rename[j], free = i, free - {i, j}
    assert 2 < len({*rename.tolist()}) < 12
    monkeypatch.setattr(search, "smoothed", lambda *args: given.append(args))
    search.joined(scored(0.0, labels, places, P))
    np.testing.assert_array_equal(
        given[0][0], np.where(labels == NONE, NONE, rename[labels])
    )
    apart = scored(0.0, labels, 99.0 * np.arange(24.0).reshape(12, 2), P)
    assert search.joined(apart) is None


def test_landmarks_of_a_later_part_are_matched_by_one_rigid_motion():
    search, rng = _Search(two_laps(1)[1]), np.random.default_rng(6)
    early = rng.uniform(-9, 9, (7, 2))
    turn = rotation(0.3)
    late = np.concatenate([early[[4, 1, 6, 2]] @ turn.T + 2.0, [(30.0, 1.0)]])
    P = 1e-4 * np.eye(24)
    P[:10, :10] += 4.0 * np.kron(np.ones((5, 5)), np.eye(2))
    labels = np.full(len(search.owners), NONE)
    labels[search.starts[:12]] = np.arange(12)  # none are seen together
    state = scored(0.0, labels, np.concatenate([late, early]), P)
    rows = np.arange(5), 5 + np.arange(7)
    first, *_ = search.matches(state, *rows)
    assert sorted(first.tolist()) == [[0, 9], [1, 6], [2, 11], [3, 7]]
    two = scored(0.0, labels, np.concatenate([late[[0, 1, 4, 4, 4]], early]), P)
    assert all(len(pairs) > 2 for pairs in search.matches(two, *rows))
    assert not list(search.matches(state, rows[0][:2], rows[1]))
    labels[search.starts[0] + 1] = 9  # seen together with 0
    first, *_ = search.matches(state._replace(labels=labels), *rows)
    assert sorted(first.tolist()) == [[1, 6], [2, 11], [3, 7]]


def test_a_drive_is_rebuilt_part_by_part_where_matches_lower_the_score(monkeypatch):
    search, seen, done = _Search(two_laps(1)[1]), [], []
    first = np.arange(len(search.owners)) % 3 + 3 * (search.owners >= 13)
    scores = iter([10.0, 12.0, 8.0, 9.0, *[20.0] * 50])

    def begun(labels):
        seen.append(labels)
        return scored(next(scores), first, np.zeros((6, 2)))

    pairs = [np.array([(4, 1)]), np.array([(3, 0), (5, 2)]), np.array([(4, 2)])]
    given = []

    def matches(state, late, early):
        given.append((state.score, late.tolist(), early.tolist()))
        return pairs

    monkeypatch.setattr(search, "begun", begun)
    monkeypatch.setattr(search, "matches", matches)
    monkeypatch.setattr(search, "joined", lambda _: None)
    monkeypatch.setattr(search, "settled", lambda state: state)
    state = scored(0.0, first)
    assert search.rebuilt(state, done.append).score == 8.0
    np.testing.assert_array_equal(seen[0], search.visits(first))
    renamed_ = [first.copy() for _ in pairs]
    for labels, match in zip(renamed_, pairs, strict=True):
        for gone, kept in match:
            labels[first == gone] = kept
    np.testing.assert_array_equal(seen[1:4], renamed_)
    assert given[0] == (10.0, [3, 4, 5], [0, 1, 2])  # a part has 13 scans
    assert [score for score, *_ in given[1:]] == [8.0] * (len(given) - 1)
    assert done == list(range(1, 8))


def test_the_surprise_of_detections_follows_from_their_rates():
    for counts in np.array([[[4, 1], [2, 0]], [[0, 0], [3, 1]], [[1, 1], [0, 5]]]):
        rates = counts / np.maximum(counts.sum(axis=1, keepdims=True), 1)
        assert _surprise(counts) == pytest.approx(-xlogy(counts, rates).sum())
        more = [(n + 0.5) / (sum(row) + 1) for row in counts for n in row]
        np.testing.assert_allclose(_prices(counts).ravel(), -np.log(more))


def test_progress_and_refusals():
    _, right = two_laps(5)
    seen = []
    reassociate(right, progress=lambda done, steps: seen.append((done, steps)))
    done, steps = zip(*seen, strict=True)
    assert done == tuple(range(1, steps[0] + 1))
    single = renamed(right, lambda k, ids: 1000 * (k + 1) + ids)
    with pytest.raises(ValueError, match="no landmark has 3 readings"):
        reassociate(single)
