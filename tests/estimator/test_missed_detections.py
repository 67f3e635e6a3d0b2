"""Costs of landmarks that a scan misses, and of readings that fit tentative ones."""

from itertools import product

import numpy as np
import pytest

from slamgym.estimator import make_estimator
from slamgym.estimator.association.scan_assignments import (
    missing_costs,
    predicted_readings,
)
from slamgym.estimator.association.scan_association import (
    HIDDEN,
    RINGS,
    SECTORS,
    SUREST,
    WIDEST,
    Detections,
)
from slamgym.estimator.interface import MapView

LONGEST = 6.0


def random_view(rng, landmarks=8):
    mean = np.append(rng.normal(size=3), rng.uniform(-6, 6, 2 * landmarks))
    root = rng.normal(scale=rng.choice([0.01, 0.05, 0.1]), size=(len(mean), len(mean)))
    return MapView(mean, root @ root.T, tuple(range(landmarks)))


def plain_count(view, slots, detections):
    """Return cost and counts from the dense expected readings, node by node."""
    expected, joint = predicted_readings(
        view.mean, view.covariance, np.arange(len(view.ids))
    )
    seen, tries = detections.seen, detections.expected
    ring = (seen.sum(axis=0) + 1) / (tries.sum(axis=0) + 2)
    sector = (seen.sum(axis=1) + 1) / (tries.sum(axis=1) + 2)
    shares = (seen + 2 * np.minimum(sector[:, None], ring)) / (tries + 2)
    shares = np.minimum(shares, SUREST)
    size = np.array([2 * np.pi / SECTORS, LONGEST / RINGS])
    cost, missed = 0.0, {}
    after = Detections(seen.copy(), tries.copy(), missed)
    for j, (bearing, distance) in enumerate(expected):
        std = np.sqrt(np.diagonal(joint)[2 * j : 2 * j + 2])
        middle = np.array([bearing + np.pi, distance])
        a, b = (middle // size).astype(int)
        if j in slots:
            cost -= 2 * np.log(shares[a % SECTORS, min(b, RINGS - 1)])
        is_sure = distance + 2 * std[1] < LONGEST and 2 * std[0] <= WIDEST
        if is_sure:
            after.expected[a % SECTORS, b] += 1
            after.seen[a % SECTORS, b] += j in slots
        if j in slots or distance - 2 * std[1] >= LONGEST:
            continue
        found = []
        for across, along in product((-2, 0, 2), repeat=2):
            node = middle + std * (across, along)
            cell = int(node[0] // size[0]) % SECTORS, int(abs(node[1]) // size[1])
            weight = np.prod([1 / 8 if step else 3 / 4 for step in (across, along)])
            found.append((weight, shares[cell] if cell[1] < RINGS else 0.0))
        before = detections.missed.get(j, 1.0)
        left = before * (1 - min(share for _, share in found))
        if not is_sure:
            left = min(before, 1 - sum(weight * share for weight, share in found))
        cost -= 2 * np.log(
            (HIDDEN + (1 - HIDDEN) * left) / (HIDDEN + (1 - HIDDEN) * before)
        )
        missed[j] = left
    return cost, after


def test_missed_landmarks_cost_what_the_dense_equations_say():
    rng = np.random.default_rng(4)
    total = 0.0
    for _ in range(100):
        view, slots = random_view(rng), rng.permutation(8)[:4]
        counts = rng.integers(0, 30, (2, SECTORS, RINGS)).astype(float)
        earlier = {j: rng.uniform() for j in range(0, 8, 2)}
        before = Detections(counts.min(axis=0), counts.max(axis=0), earlier)
        cost, after = before.after(view, slots, LONGEST)
        expected_cost, expected = plain_count(view, slots, before)
        assert cost == pytest.approx(expected_cost, rel=1e-9)
        np.testing.assert_array_equal(after.seen, expected.seen)
        np.testing.assert_array_equal(after.expected, expected.expected)
        for j in set(range(8)) - set(slots.tolist()):
            left = expected.missed.get(j, before.missed.get(j, 1.0))
            assert after.missed.get(j, 1.0) == pytest.approx(left, rel=1e-9)
        assert set(after.missed).isdisjoint(slots.tolist())
        total += cost
    assert total > 100  # many were expected


def cost_of_misses(place, std, scans):
    """Return what each of some scans costs that do not show a landmark."""
    mean, covariance = np.append(np.zeros(3), place), np.diag([0, 0, 0, std, std]) ** 2
    view, detections, costs = MapView(mean, covariance, (0,)), Detections.none(), []
    for _ in range(scans):
        cost, detections = detections.after(view, np.array([-1]), LONGEST)
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
        costs.append(slam.alternatives(np.array(scan))[0][0])
        slam.update(scan)
    assert costs[0] == costs[2] == missing_costs(0.02, 1)[0]
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
