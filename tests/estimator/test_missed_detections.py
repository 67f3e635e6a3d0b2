"""Costs of landmarks that a scan misses, and of readings that fit tentative ones."""

import pickle
from itertools import product

import numpy as np
import pytest
from plain_association import predicted_readings
from scipy.stats import poisson

from slamgym.estimator import make_estimator
from slamgym.estimator.association.missed_landmarks import (
    EMPTY,
    FEWER,
    HIDDEN,
    HIDDEN_EACH,
    LIMIT,
    LOST_SCORE,
    MARGIN,
    MOST_OF_SCAN,
    NO_RETURNS,
    PROVEN,
    SCANS,
    SHADOW,
    SUREST,
    TELLING,
    WIDEST,
    Detections,
    LostEvidence,
    whole_times,
)
from slamgym.estimator.association.scan_assignments import missing_costs
from slamgym.estimator.association.scan_association import Candidates
from slamgym.estimator.association.tentative_landmarks import (
    MEMORY,
    RINGS,
    SECTORS,
    UnexplainedDensity,
)
from slamgym.estimator.interface import MapView
from slamgym.jit import jit

LONGEST = 6.0
NONE = np.empty(0, np.int64)


def random_view(rng, landmarks=8):
    mean = np.append(rng.normal(size=3), rng.uniform(-6, 6, 2 * landmarks))
    root = rng.normal(scale=rng.choice([0.01, 0.05, 0.1]), size=(len(mean), len(mean)))
    return MapView(mean, root @ root.T, tuple(range(landmarks)))


CELL = np.array([2 * np.pi / SECTORS, LONGEST / RINGS])


def shares_around(shares, middle, reach):
    """Return weight and P_D of nine nodes."""
    found = []
    for across, along in product((-1, 0, 1), repeat=2):
        node = middle + reach * (across, along)
        cell = int(node[0] // CELL[0]) % SECTORS, int(abs(node[1]) // CELL[1])
        weight = np.prod([1 / 8 if step else 3 / 4 for step in (across, along)])
        found.append((weight, shares[cell] if cell[1] < RINGS else 0.0))
    return found


def plain_count(view, slots, explained, detections, readings=EMPTY[2]):
    """Return cost and counts from the dense expected readings, node by node."""
    expected, joint = predicted_readings(
        view.mean, view.covariance, np.arange(len(view.ids))
    )
    seen, tries, returned = detections.detected
    ring = (seen.sum(axis=0) + 1) / (tries.sum(axis=0) + 2)
    sector = (seen.sum(axis=1) + 1) / (tries.sum(axis=1) + 2)
    shares = (seen + 2 * np.minimum(sector[:, None], ring)) / (tries + 2)
    shares = np.minimum(shares, SUREST)
    cost, missed, fewer = 0.0, {}, 0.0
    after = Detections(detections.detected.copy(), missed, {}, LostEvidence())
    hidden = HIDDEN_EACH * max(returned.sum() ** 0.5 - LIMIT, 0.0) ** 2
    hidden /= seen.sum() + NO_RETURNS
    for j, (bearing, distance) in enumerate(expected):
        std = np.sqrt(np.diagonal(joint)[2 * j : 2 * j + 2])
        middle = np.array([bearing + np.pi, distance])
        a, b = (middle // CELL).astype(int)
        cost -= 2 * (j in slots) * np.log(shares[a % SECTORS, min(b, RINGS - 1)])
        is_sure = distance + 2 * std[1] < LONGEST and 2 * std[0] <= WIDEST
        before = detections.missed.get(j, 1.0)
        if is_sure:
            is_back = j in slots and before < HIDDEN
            after.detected[:, a % SECTORS, b] += j in slots, 1, is_back
        is_telling = (
            detections.shown.get(j, 0) >= PROVEN and j < detections.lost.first_new
        )
        if is_sure and is_telling and j in slots:
            fewer += np.log(FEWER)
        if j in slots or distance - 2 * std[1] >= LONGEST:
            continue
        found = shares_around(shares, middle, 2 * std)
        left = before * (1 - min(share for _, share in found))
        aside = np.abs((bearing - readings[:, 0] + np.pi) % (2 * np.pi) - np.pi)
        is_nearer = readings[:, 1] < distance - 2 * std[1]
        is_hidden = (is_nearer & (aside <= 2 * std[0] + SHADOW)).any()
        if is_sure and is_telling and j not in explained and not is_hidden:
            wider = shares_around(shares, middle, 2 * std + MARGIN * CELL)
            least = min(share for _, share in wider)
            ratio = np.log((1 - FEWER * least) / (1 - least))
            fewer += ratio * before / (before + hidden)
        if not is_sure:
            left = min(before, 1 - sum(weight * share for weight, share in found))
        cost -= 2 * np.log(
            (HIDDEN + (1 - HIDDEN) * left) / (HIDDEN + (1 - HIDDEN) * before)
        )
        missed[j] = left
    evidence = evidence_after(detections.lost, fewer, len(view.ids))
    return cost, after._replace(lost=evidence)


def evidence_after(known, more, landmarks):
    present = max(0.0, known.present + min(more, MOST_OF_SCAN))
    change = (present - known.lasting) * min(abs(more) / TELLING, 1) / SCANS
    lasting = min(present, known.lasting + change)
    return known._replace(
        present=present,
        lasting=lasting,
        largest=max(known.largest, lasting),
        first_new=max(known.first_new, 0 if present > 0 else landmarks),
    )


def test_missed_landmarks_cost_what_the_dense_equations_say():
    rng, memory = np.random.default_rng(4), np.random.default_rng(9)
    total, evidence = 0.0, []
    for _ in range(200):
        view, slots = random_view(rng), rng.permutation(8)[: rng.integers(5)]
        counts = rng.integers(0, 30, (2, SECTORS, RINGS)) ** rng.uniform(0.2, 1)
        if rng.random() < 0.3:
            counts[:] = 30  # each landmark is shown
        has_returned = memory.random((SECTORS, RINGS)) < memory.uniform()
        returned = counts.min(axis=0) * has_returned
        powers = memory.choice([1, 20], 4)
        earlier = {2 * j: rng.uniform() ** power for j, power in enumerate(powers)}
        known = np.array([counts.min(axis=0), counts.max(axis=0), returned]), earlier
        shown = {j: min(j % 4, PROVEN) for j in range(7)}
        first_new = int(rng.integers(5, 12))
        lost = LostEvidence(2.0, memory.uniform(0, 2), 2.0, first_new)
        before = Detections(*known, shown, lost)
        explained = rng.permutation(8)[: rng.integers(4)]
        scale = np.pi, LONGEST
        readings = memory.uniform((-1, 0), 1, (memory.integers(4), 2)) * scale
        cost, after = before.after(view, (slots, explained, readings), LONGEST)
        expected_cost, expected = plain_count(view, slots, explained, before, readings)
        assert cost == pytest.approx(expected_cost, rel=1e-9)
        assert after.lost == pytest.approx(expected.lost, rel=1e-9)
        evidence.append(after.lost.present - before.lost.present)
        more = {j: min(shown.get(j, 0) + (j in slots), PROVEN) for j in range(8)}
        assert {j: after.shown.get(j, 0) for j in range(8)} == more
        np.testing.assert_array_equal(after.detected, expected.detected)
        for j in set(range(8)) - set(slots.tolist()):
            left = expected.missed.get(j, before.missed.get(j, 1.0))
            assert after.missed.get(j, 1.0) == pytest.approx(left, rel=1e-9)
        assert set(after.missed).isdisjoint(slots.tolist())
        total += cost
    assert total > 100  # many were expected
    assert min(evidence) == -2  # both limits
    assert max(evidence) == MOST_OF_SCAN
    assert len(set(evidence)) > 50


def test_a_new_landmark_costs_what_the_scans_before_its_first_should_have_shown():
    rng, costs = np.random.default_rng(5), []
    for _ in range(40):
        counts = np.sort(rng.integers(0, 30, (3, SECTORS, RINGS)), axis=0)
        counts = counts[[1, 2, 0]].astype(float)  # returned ≤ seen ≤ expected
        detections, views = Detections()._replace(detected=counts), []
        for scan in range(6):
            views.append(random_view(rng, landmarks=0))
            views[-1].mean[0] = 2.0 * scan
            axis = rng.integers(2)
            views[-1].covariance[axis, axis] += rng.choice([0.0, 9.0])
            detections = detections.with_pose(scan, views[-1], LONGEST)
        view, first = random_view(rng), int(rng.integers(7))
        expected, missed = 0.0, {}
        for earlier in views[:first]:
            both = np.zeros((5, 5))
            both[:3, :3], both[3:, 3:] = earlier.covariance, view.covariance[5:7, 5:7]
            then = MapView(np.append(earlier.mean, view.mean[5:7]), both, (0,))
            known = detections._replace(missed=missed)
            cost, after = plain_count(then, NONE, NONE, known)
            expected, missed = expected + cost, {**missed, **after.missed}
        cost = detections.cost_of_new(view, {1: first, 99: first}, LONGEST)
        assert cost == pytest.approx(expected, rel=1e-9, abs=1e-9)
        costs.append(cost)
    assert sum(cost > 1 for cost in costs) > 10
    assert max(costs) > 5


@pytest.mark.parametrize(("confirm", "dear"), [((1, 1), []), ((3, 8), [8])])
def test_only_scans_before_the_first_sighting_make_a_landmark_dear(confirm, dear):
    slam = make_estimator(
        "invariant",
        motion_std=(0.01, 0.0, 0.01),
        measurement_std=(0.02, 0.05),
        management={"association": "hypotheses", "confirm": confirm},
    )
    prices = []
    for scan in range(12):  # each remembers a pose
        readings = scan_at(np.array([scan - 6.0, 0.0, 0.0]))[: 5 if scan >= 6 else 4]
        _, complete = slam.best.alternatives(readings)[0]
        plan = complete()
        slam.best.follow(*slam.best.feed(plan))
        slam.predict((1.0, 0.0))
        prices.append(plan.price)
    assert np.flatnonzero(np.array(prices) > 1).tolist() == dear
    assert np.count_nonzero(prices) == len(dear)
    assert len(slam.landmark_ids) == 5


def test_a_robot_that_hardly_moves_remembers_one_pose():
    view, detections = MapView(np.zeros(3), np.eye(3), ()), Detections()
    for scan, x in enumerate((0.0, 0.7, 0.8, 1.5, 1.5)):  # a ring has 0.75 m
        moved = view._replace(mean=np.array([x, 0.0, 0.1]))
        detections = detections.with_pose(scan, moved, LONGEST)
    assert detections.path[:, :4].tolist() == [[0, 0, 0, 0.1], [2, 0.8, 0, 0.1]]


def test_a_saved_state_holds_the_poses_of_earlier_scans():
    slam, kept = circling("hypotheses", steps=20), of_a_circle("hypotheses")
    kept.load_state_dict(slam.state_dict())
    paths = [one.best.candidates.detections.path for one in (slam, kept)]
    assert len(paths[0]) > 1
    np.testing.assert_array_equal(*paths)


def test_a_scan_with_identities_remembers_no_pose_and_weighs_no_readings():
    slam = of_a_circle("hypotheses")
    for x in range(6):
        slam.update(scan_at(np.array([x, 0.0, 0.0])), range(5))
        slam.predict((1.0, 0.0))
    detections = slam.best.candidates.detections
    assert len(detections.path) == 0
    assert (detections.lost.unexplained, detections.lost.explained) == (0, 0)


def cost_of_misses(place, std, scans):
    """Return what each of some scans costs that do not show a landmark."""
    mean, covariance = np.append(np.zeros(3), place), np.diag([0, 0, 0, std, std]) ** 2
    view, detections, costs = MapView(mean, covariance, (0,)), Detections(), []
    for _ in range(scans):
        cost, detections = detections.after(view, (np.array([-1]), *EMPTY[1:]), LONGEST)
        costs.append(cost)
    return costs


def test_a_landmark_that_is_out_of_view_costs_nothing():
    assert cost_of_misses((7.0, 0.0), 0.01, scans=3) == [0, 0, 0]


@pytest.mark.parametrize(
    ("place", "std"), [((5.9, 0.0), 0.2), ((3.0, 0.0), 2.0)], ids=["edge", "somewhere"]
)
def test_a_landmark_that_may_be_out_of_view_costs_once(place, std):
    first, *others = cost_of_misses(place, std, scans=9)
    assert 0 < first < -2 * np.log(0.5)
    assert others == [0] * 8


def test_something_may_hide_a_landmark_for_long():
    costs = cost_of_misses((3.0, 0.0), 0.01, scans=200)
    assert -2 * np.log(1 - (1 - HIDDEN) * 0.5) == pytest.approx(costs[0])
    assert sum(costs) < -2 * np.log(HIDDEN) + 1e-9


def test_a_reading_of_a_tentative_landmark_is_no_clutter():
    slam = make_estimator(
        "invariant",
        motion_std=(0.01, 0.0, 0.01),
        measurement_std=(0.02, 0.1),
        management={"association": "joint", "confirm": (3, 5), "density": 0.02},
    )
    costs = []
    for scan in ([(0.5, 4.0)], [(0.5, 4.0)], [(-2.0, 4.0)]):
        costs.append(slam.best.alternatives(np.array(scan))[0][0])
        slam.update(scan)
    assert costs[0] == costs[2] == missing_costs(np.array([0.02]))[0]
    assert costs[1] < costs[0] - 5


def test_a_loop_closed_by_clutter_is_opened_where_landmarks_fail_to_appear():
    landmarks = np.array([(4.0, 0.0), (4.0, 1.0), (-5.0, 3.0)])
    slam = make_estimator(
        "invariant",
        motion_std=(0.3, 0.0, 0.08),
        measurement_std=(0.02, 0.1),
        initial_pose=(-2.0, 0.0, 0.0),
        management={"association": "hypotheses"},
    )
    for x in np.linspace(-2.0, 0.0, 21):
        dx, dy = (landmarks - (x, 0.0)).T
        slam.update(np.column_stack([np.arctan2(dy, dx), np.hypot(dx, dy)]))
        slam.predict((0.1, 0.0), 1e-6)
    for _ in range(6):  # drift, while nothing is in sight
        slam.predict((0.0, 0.0))
    slam.update([(0.1, 4.8)])
    assert slam.decisions[-1].row_ids != (None,)  # the likeliest, as yet
    for _ in range(4):
        slam.update(np.empty((0, 2)))
    assert slam.decisions[21].row_ids == (None,)


LANDMARKS = np.array([(4.0, 3.0), (4.0, -3.0), (-2.0, 4.0), (6.0, 0.0), (1.0, -5.0)])


def scan_at(pose):
    """Return the readings at a pose; the robot there drives a small circle."""
    dx, dy = (LANDMARKS - pose[:2]).T
    return np.column_stack([np.arctan2(dy, dx) - pose[2], np.hypot(dx, dy)])


def of_a_circle(association):
    noise = {"motion_std": (0.01, 0.0, 0.01), "measurement_std": (0.02, 0.05)}
    return make_estimator("invariant", **noise, management={"association": association})


def circling(association, kidnapped_at=None, steps=50):
    """Follow a robot on a circle; from one step on, its odometry misses 1.5 m."""
    slam, pose = of_a_circle(association), np.zeros(3)
    for step in range(steps):
        if step == kidnapped_at:
            pose += np.array([1.5, 1.5, 0.8])
        slam.update(scan_at(pose))
        pose += 0.1 * np.array([np.cos(pose[2]), np.sin(pose[2]), 1.0])
        slam.predict((0.1, 0.1))
    return slam


@pytest.mark.parametrize("association", ["nearest", "joint", "hypotheses"])
def test_a_kidnapped_robot_is_probably_lost(association):
    slam = circling(association, kidnapped_at=30)
    assert slam.probably_lost
    assert slam.lost_score > LOST_SCORE
    kept = of_a_circle(association)
    kept.load_state_dict(slam.state_dict())
    assert kept.lost_score == slam.lost_score
    assert pickle.loads(pickle.dumps(slam)).lost_score == slam.lost_score
    slam.reset(np.zeros(3), np.zeros(3))
    assert not slam.probably_lost


@pytest.mark.parametrize("association", ["nearest", "joint", "hypotheses"])
def test_a_robot_that_sees_its_map_is_not_lost(association):
    slam = circling(association)
    assert len(slam.landmark_ids) == len(LANDMARKS)
    assert not slam.probably_lost
    assert slam.lost_score < LOST_SCORE / 2


def test_the_alarm_is_that_of_the_reported_hypothesis():
    slam = circling("hypotheses")
    slam.hypotheses.append(circling("hypotheses", kidnapped_at=30).best)
    assert not slam.probably_lost
    slam.hypotheses.reverse()
    assert slam.probably_lost


def test_a_landmark_of_clutter_raises_no_alarm():
    view = MapView(np.array([0, 0, 0, 3.0, 0.5, -2, 1]), 1e-6 * np.eye(7), (0, 1))
    detections = Detections()
    for slot in [[0]] * 80:  # landmark 1 is never shown
        _, detections = detections.after(view, (np.array(slot), *EMPTY[1:]), LONGEST)
    assert detections.lost.largest == 0


def after_scans(places, scans):
    """Return the evidence after scans (slots shown, slots explained, times)."""
    mean = np.append(np.zeros(3), places)
    detections = Detections()
    for ids, slots, explained, times in scans:
        size = 3 + 2 * len(ids)
        view = MapView(mean[:size], 1e-6 * np.eye(size), tuple(ids))
        rows = np.array(slots, np.int64), np.array(explained, np.int64)
        for _ in range(times):
            _, detections = detections.after(view, (*rows, EMPTY[2]), LONGEST)
    return detections.lost


def test_a_landmark_beside_a_reading_is_not_missed():
    places = [(3.31, 0.66)]  # amid a cell
    seen = ((0,), [0], [0], 40)
    assert after_scans(places, [seen, ((0,), [-1], [], 5)]).present > 2
    assert after_scans(places, [seen, ((0,), [-1], [0], 5)]).present == 0


@pytest.mark.parametrize("times", [2, 10])
def test_what_hides_all_landmarks_for_two_scans_raises_no_alarm(times):
    places = [(3.31, y) for y in (-0.66, 0.66, -2.0, 2.0)]
    four = range(4)
    scans = [(four, four, four, 40), (four, [], [], times), (four, four, four, 20)]
    evidence = after_scans(np.ravel(places), scans)
    assert evidence.present == 0
    assert (evidence.largest > LOST_SCORE) == (times > 2)


def test_landmarks_that_a_lost_run_maps_anew_do_not_clear_it():
    places = [(3.31, 0.66), (3.31, -0.66)]
    lost = [((0,), [0], [0], 40), ((0,), [-1], [], 3)]
    evidence = after_scans(places, lost).present
    anew = after_scans(places, [*lost, ((0, 1), [1], [0, 1], 20)])
    assert anew.present == evidence > 0
    again = after_scans(places, [*lost, ((0, 1), [0], [0], 20)])
    assert (again.present, again.first_new) == (0, 2)


def test_a_mapped_landmark_outside_the_view_is_not_newer_than_the_view():
    mean = np.array([0, 0, 0, 3.31, 0.66])
    view = MapView(mean, 1e-6 * np.eye(5), (0,), whole=(0, 5))
    _, after = Detections().after(view, (np.array([0]), *EMPTY[1:]), LONGEST)
    assert after.lost.first_new == 6


@pytest.mark.parametrize(("hides", "is_alarmed"), [(False, True), (True, False)])
def test_misses_count_little_where_hidden_landmarks_return(hides, is_alarmed):
    ids, scans = range(8), []
    bearings = np.pi / 16 + np.pi / 4 * np.arange(8)  # amid cells
    places = 3.31 * np.column_stack([np.cos(bearings), np.sin(bearings)]).ravel()
    for j in ids:  # two after the other are hidden for long
        shown = [i for i in ids if not hides or (i - j) % 8 > 1]
        scans += [(ids, ids, ids, 3), (ids, shown, shown, 15)]
    scans.append((ids, ids, ids, 3))
    assert after_scans(places, scans).largest < LOST_SCORE / 2
    scans.append((ids, [0, 1], [0, 1], 20))  # then most at once
    score = after_scans(places, scans).largest
    assert (score > LOST_SCORE) == is_alarmed


def test_nine_returns_do_not_show_that_something_hides_landmarks():
    view = MapView(np.array([0, 0, 0, 3.31, 0.66]), 1e-6 * np.eye(5), (0,))
    present = []
    for returned in (0, 9, 60):
        counts = detected(30, 30, 0)
        counts[2, 0, :3] = returned / 3
        telling = {0: 0.1}, {0: PROVEN}, LostEvidence(first_new=1)
        _, after = Detections(counts, *telling).after(
            view, (np.array([-1]), *EMPTY[1:]), 6.0
        )
        present.append(after.lost.present)
    assert present[0] == present[1] > present[2] > 0


@pytest.mark.parametrize(("returned", "weight"), [(0, 1), (60, 0)])
def test_a_landmark_missed_so_often_that_its_odds_are_0_is_weighed(returned, weight):
    view = MapView(np.array([0, 0, 0, 3.31, 0.66]), 1e-6 * np.eye(5), (0,))
    counts = detected(30, 60, 0)
    counts[2, 0, :3] = returned / 3
    before = Detections(counts, {0: 0.0}, {0: PROVEN}, LostEvidence(first_new=1))
    _, after = before.after(view, (np.array([-1]), *EMPTY[1:]), LONGEST)
    ratio = (1 - FEWER / 2) / (1 - 1 / 2)  # P_D is a half
    assert after.missed == {0: 0.0}
    assert after.lost.present == pytest.approx(weight * np.log(ratio), abs=1e-9)


def test_a_landmark_at_the_edge_of_the_view_is_no_evidence():
    expected = np.full((SECTORS, RINGS), 30.0)
    seen = np.where(np.arange(RINGS) < 4, expected, 0.0)
    counts = np.array([seen, expected, np.zeros((SECTORS, RINGS))])
    before = Detections(counts, {}, {0: PROVEN}, LostEvidence(first_new=1))
    evidence = []
    for ring in (3.4, 3.6):
        mean = np.array([0, 0, 0, ring * LONGEST / RINGS, 0.5])
        view = MapView(mean, 1e-6 * np.eye(5), (0,))
        _, after = before.after(view, (np.array([-1]), *EMPTY[1:]), LONGEST)
        evidence.append(after.lost.present)
    assert evidence[0] > 2
    assert evidence[1] < 0.1


def test_a_landmark_behind_a_nearer_reading_is_no_evidence():
    view = MapView(np.array([0, 0, 0, 3.31, 0.66]), 1e-6 * np.eye(5), (0,))
    before = Detections(detected(30, 60, 0), {}, {0: PROVEN}, LostEvidence(first_new=1))
    bearing, distance = np.arctan2(0.66, 3.31), np.hypot(0.66, 3.31)
    evidence = []
    for aside, beyond in [(0.0, -1.0), (0.09, -1.0), (0.2, -1.0), (0.0, 1.0)]:
        readings = np.array([[bearing + aside, distance + beyond]])
        _, after = before.after(view, (np.array([-1]), NONE, readings), LONGEST)
        evidence.append(after.lost.present)
    assert evidence[:2] == [0, 0]
    assert min(evidence[2:]) > 0


def test_the_alarm_stays_once_the_map_is_seen_again():
    view = MapView(np.array([0, 0, 0, 3.0, 0.5]), 1e-6 * np.eye(5), (0,))
    detections, scores = Detections(), []
    for slot in [0] * 40 + [-1] * 16 + [0] * 40:
        _, detections = detections.after(view, (np.array([slot]), *EMPTY[1:]), LONGEST)
        scores.append(detections.lost.lasting)
    assert scores[39] == scores[-1] == 0
    assert scores[55] > LOST_SCORE
    assert detections.lost.largest == max(scores)


def test_the_alarm_does_not_grow_in_scans_that_say_nothing():
    evidence = LostEvidence()
    for more in [2.0, 2.0, *[1e-4] * 60]:
        evidence = evidence.after(more, ())
    assert evidence.present > LOST_SCORE > 2 > evidence.largest
    for _ in range(8):
        evidence = evidence.after(0.4, ())
    assert evidence.largest > LOST_SCORE


def with_headings(stds, has_map=True):
    """Return the evidence after scans that leave these deviations of the heading."""
    evidence = LostEvidence()
    for std in stds:
        evidence = evidence.with_heading(std**2, has_map)
    return evidence


def test_a_heading_that_stays_unknown_is_evidence_of_a_lost_run():
    assert with_headings([0.1, 1.0, 1.0]).largest <= LOST_SCORE
    assert with_headings([0.1, 1.0, 1.0, 1.0, 0.1]).largest > LOST_SCORE
    assert with_headings([0.1, 1.0, 1.0, 0.8, 1.0, 1.0]).largest <= LOST_SCORE


@pytest.mark.parametrize("std", [1.6, np.pi, 10.0])
def test_a_heading_that_is_unknown_from_the_start_is_no_evidence(std):
    assert with_headings([std, std, std + 1, std + 1, std + 1]).largest == 0


def test_a_heading_whose_variance_is_rounded_below_0_is_certain():
    assert LostEvidence().with_heading(-1e-17).surest == 0


def test_a_heading_is_no_evidence_before_there_is_a_map():
    assert with_headings([0.1, 2.0, 2.0, 2.0, 2.0], has_map=False).largest == 0


def scans_with_strange_readings(scans):
    """Yield the evidence after each scan (strange readings, others)."""
    evidence, density = LostEvidence(), UnexplainedDensity()
    for strange, explained in scans:
        evidence = evidence.with_readings(strange, explained, density)
        density = density.after(np.ones((strange, 2)), range(strange))
        yield evidence


def after_strange_readings(scans):
    return list(scans_with_strange_readings(scans))[-1]


def test_strange_readings_are_weighed_by_their_likelihoods():
    scans = np.random.default_rng(5).poisson([0.4, 3], (300, 2)).tolist()
    found = list(scans_with_strange_readings(scans))
    expected = 0.0
    for k, (strange, explained) in enumerate(scans):
        weights = MEMORY ** np.arange(k, -1, -1)
        mean, others = weights @ [(1, 0), *scans[:k]] / (weights.sum() + weights[0])
        likelihoods = poisson.logpmf(strange, [mean, mean + (1 - FEWER) * others])
        ratio = np.diff(likelihoods)[0] + explained * np.log(FEWER)
        expected = max(0, expected + min(ratio, MOST_OF_SCAN / 2) / 2)
        assert found[k].unexplained == pytest.approx(expected, abs=1e-9)
    assert found[-1].largest == max(one.unexplained for one in found) > 0


def test_readings_that_stay_strange_are_evidence_of_a_lost_run():
    map_made = [(3, 0)] + [(0, 3)] * 20
    assert after_strange_readings(map_made).largest == 0
    four = [(2, 0)] * 4
    assert after_strange_readings(map_made + four).largest <= LOST_SCORE
    assert after_strange_readings([*map_made, *four, (2, 0)]).largest > LOST_SCORE


@pytest.mark.parametrize(
    "later",
    [[(6, 0), (0, 6), (4, 2), (0, 6)], [(4, 4), (3, 4), (5, 4)] * 30, [(1, 0)] * 30],
    ids=["new landmarks", "clutter", "clutter far from the map"],
)
def test_new_landmarks_and_usual_clutter_are_no_evidence(later):
    scans = [(3, 0), *[(0, 3), (3, 3)] * 20, *later]
    assert after_strange_readings(scans).largest <= LOST_SCORE / 4


def test_a_burst_of_clutter_is_little_evidence():
    burst = [(1, 0), (1, 0), (1, 1), (1, 1)]
    scans = [(3, 0), *[(0, 3)] * 100, *burst, *[(0, 3)] * 10]
    assert 2 < after_strange_readings(scans).largest < LOST_SCORE


@pytest.mark.parametrize("association", ["nearest", "joint", "hypotheses"])
def test_a_robot_moved_where_it_expects_no_landmark_is_probably_lost(association):
    """It drives away from its map; what it sees then moves, though it stands still."""
    slam, kept = of_a_circle(association), of_a_circle(association)
    for _ in range(30):
        slam.update(scan_at(np.zeros(3)))
        slam.predict((0.0, 0.0))
    slam.predict((40.0, 0.0))
    for x in np.arange(0.0, 4.0, 0.5):
        slam.update([(bearing, 5.0 - x) for bearing in (-0.5, 0.0, 0.5)])
        slam.predict((0.0, 0.0))
    assert slam.lost_score > LOST_SCORE
    kept.load_state_dict(slam.state_dict())
    assert kept.lost_score == slam.lost_score


@pytest.mark.parametrize("association", ["joint", "hypotheses"])
def test_a_robot_that_turns_blindly_is_probably_lost(association):
    def make():
        return make_estimator(
            "invariant",
            motion_std=(0.01, 0.0, 0.6),
            measurement_std=(0.02, 0.05),
            management={"association": association},
        )

    def turn(slam, scans):
        for _ in range(scans):
            slam.predict((0.1, 0.1))
            slam.update(np.empty((0, 2)))

    slam, kept = make(), make()
    for _ in range(3):
        slam.update([(0.5, 4.0), (-0.5, 3.0)])
    turn(slam, 4)  # variances 0.36, 0.72, 1.08, 1.44
    assert not slam.probably_lost
    kept.load_state_dict(slam.state_dict())
    for one in (slam, kept):
        turn(one, 1)
        assert one.probably_lost
    slam.reset(np.zeros(3), np.zeros(3))
    assert not slam.probably_lost


def detected(*counts):
    """Return the same counts (seen, expected, returned) in all cells."""
    return np.ones((3, SECTORS, RINGS)) * np.reshape(counts, (3, 1, 1))


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("lost", (-1, 0, 2, 0, 0.1, 0, 0, 0)),
        ("lost", (0, -1, 2, 0, 0.1, 0, 0, 0)),
        ("lost", (0, 3, 2, 0, 0.1, 0, 0, 0)),
        ("lost", (0, 0, 2, -1, 0.1, 0, 0, 0)),
        ("lost", (0, 0, 2, 0, -0.1, 0, 0, 0)),
        ("lost", (0, 0, 2, 0, 0.1, -1, 0, 0)),
        ("lost", (0, 0, 2, 0, 0.1, 0, -1, 0)),
        ("lost", (0, 0, 2, 0, 0.1, 0, 0, -1)),
        ("density", (1, 2, 0, 1, 8)),
        ("density", (1, 2, 8, 1, -1)),
        ("unexplained", np.full((SECTORS, RINGS), -1)),
        ("detected", detected(0, 0, -1)),
        ("detected", detected(1, 2, 2)),
        ("detected", detected(3, 2, 0)),
        ("missed", [(0, 1.1)]),
        ("missed", [(0, -0.1), (1, 0.5)]),
    ],
)
def test_a_saved_state_with_impossible_detections_is_refused(name, value):
    slam = circling("joint", steps=5)
    state = slam.state_dict() | {f"0.tentative.{name}": np.array(value, float)}
    with pytest.raises(ValueError, match=rf"tentative\.{name}'\] must be"):
        slam.load_state_dict(state)


def test_a_run_begins_with_nothing_but_the_assumed_density():
    state = {key: np.asarray(value) for key, value in Candidates().state_dict().items()}
    assert state.pop("density").tolist() == [1.0, 2.0, 1.0, 1.0, 0.0]
    assert state.pop("lost").tolist() == [0, 0, 0, 0, np.pi**2 / 3, 0, 0, 0]
    for key, value in state.items():
        assert not value.any(), key
        assert value.size == 0 or key not in ("labels", "odds", "path", "seen"), key
    kept = Candidates.from_state_dict(state | Candidates().state_dict()).state_dict()
    for key, value in Candidates().state_dict().items():
        np.testing.assert_array_equal(kept[key], value)


@pytest.mark.parametrize("scan", [0, 30])
@pytest.mark.parametrize("wrong", [60.0, 1e12])
def test_a_single_wrong_range_does_not_stretch_the_cells(scan, wrong):
    rng = np.random.default_rng(11)
    landmarks = np.column_stack([np.arange(2.0, 62.0, 4.0), rng.uniform(-5, 5, 15)])

    def drive(is_wrong):
        slam = make_estimator(
            "ekf",
            motion_std=(0.01, 0.01, 0.002),
            measurement_std=(0.02, 0.05),
            management={"association": "nearest"},
        )
        for k in range(120):
            dx, dy = (landmarks - (0.5 * k, 0.0)).T
            readings = np.column_stack([np.arctan2(dy, dx), np.hypot(dx, dy)])
            readings = readings[readings[:, 1] < LONGEST]
            if is_wrong and k == scan:
                readings = np.append(readings, [[0.3, wrong]], axis=0)
            slam.update(readings)
            slam.predict((0.5, 0.0))
        return slam

    clean, other = drive(False), drive(True)
    assert other.landmark_ids == clean.landmark_ids
    np.testing.assert_array_equal(other.belief().mean, clean.belief().mean)
    shares = [
        detections.detected[0].sum(axis=0) / detections.detected[1].sum(axis=0)
        for detections in (s.best.candidates.detections for s in (clean, other))
    ]
    np.testing.assert_allclose(*shares, atol=0.05)
    assert not other.probably_lost


@pytest.mark.parametrize("place", [1, 5, 6])
def test_a_saved_state_whose_evidence_exceeds_its_largest_is_refused(place):
    state = Candidates().state_dict()
    state["lost"][place] = 4.0
    with pytest.raises(ValueError, match="at most the largest so far"):
        Candidates.from_state_dict(state)
    state["lost"][2] = 4.0
    assert Candidates.from_state_dict(state).detections.lost[place] == 4.0


@jit
def fill_whole_times(values, part, found):
    for k in range(len(values)):
        found[k] = whole_times(values[k], part)


@pytest.mark.parametrize("part", [2 * np.pi / 16, 8.3 / 8, 0.1])
def test_a_cell_is_found_by_exact_division(part):
    """The quotient of what is just below an edge may be rounded up to the edge."""
    edges = part * np.arange(-40, 41)
    values = np.concatenate([np.nextafter(edges, s) for s in (-np.inf, np.inf)])
    values = np.concatenate([values, edges])
    found = np.empty(len(values), np.int64)
    fill_whole_times(values, part, found)
    np.testing.assert_array_equal(found, values // part)
    assert (found != np.floor(values / part)).any()
