"""Costs of landmarks that a scan misses, and of readings that fit tentative ones."""

import numpy as np
import pytest

from slamgym.estimator import make_estimator
from slamgym.estimator.association.scan_assignments import (
    missing_costs,
    predicted_readings,
)
from slamgym.estimator.association.scan_association import (
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
    """Return cost and counts from the dense expected readings, cell by cell."""
    expected, joint = predicted_readings(
        view.mean, view.covariance, np.arange(len(view.ids))
    )
    cost, after = 0.0, Detections(detections.seen.copy(), detections.expected.copy())
    for j, (bearing, distance) in enumerate(expected):
        turn, aside = 2 * np.sqrt(np.diagonal(joint)[2 * j : 2 * j + 2])
        if distance + aside >= LONGEST or turn > WIDEST:
            continue
        middle = np.array([bearing + np.pi, distance])
        size = np.array([2 * np.pi / SECTORS, LONGEST / RINGS])
        margin = np.array([turn, aside])
        low, high = (middle - margin) // size, (middle + margin) // size
        shares = [
            (detections.seen[a % SECTORS, b] + 1)
            / (detections.expected[a % SECTORS, b] + 2)
            for a in np.arange(low[0], high[0] + 1).astype(int)
            for b in np.arange(max(low[1], 0), high[1] + 1).astype(int)
        ]
        if j not in slots:
            cost -= 2 * np.log(1 - min(*shares, SUREST))
        a, b = (middle // size).astype(int)
        after.expected[a % SECTORS, b] += 1
        after.seen[a % SECTORS, b] += j in slots
    return cost, after


def test_missed_landmarks_cost_what_the_dense_equations_say():
    rng = np.random.default_rng(4)
    total = 0.0
    for _ in range(100):
        view, slots = random_view(rng), rng.permutation(8)[:4]
        counts = rng.integers(0, 30, (2, SECTORS, RINGS)).astype(float)
        before = Detections(counts.min(axis=0), counts.max(axis=0))
        cost, after = before.after(view, slots, LONGEST)
        expected_cost, expected = plain_count(view, slots, before)
        assert cost == pytest.approx(expected_cost, rel=1e-9)
        np.testing.assert_array_equal(after.seen, expected.seen)
        np.testing.assert_array_equal(after.expected, expected.expected)
        total += cost
    assert total > 100  # many were expected


@pytest.mark.parametrize(
    ("place", "std"),
    [((5.9, 0.0), 0.2), ((7.0, 0.0), 0.01), ((3.0, 0.0), 2.0)],
    ids=["at the edge of the range", "beyond the range", "somewhere"],
)
def test_a_landmark_that_may_be_out_of_view_costs_nothing(place, std):
    mean, covariance = np.append(np.zeros(3), place), np.diag([0, 0, 0, std, std]) ** 2
    view = MapView(mean, covariance, (0,))
    cost, _ = Detections.none().after(view, np.array([-1]), LONGEST)
    assert cost == 0


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
