"""Scores of association: cases made by hand, and a slow twin."""

import math

import numpy as np
import pytest

from slamgym.estimator.interface import ScanDecisions
from slamgym.estimator.models.sensors import BEARING_RANGE
from slamgym.evaluation import (
    landmark_identities,
    oracle_errors,
    places_of,
    score_association,
)
from slamgym.evaluation.association_scores import AssociationScores, known_places

A, B, C, CLUTTER = 7, 8, 9, -1


def counts(decisions, true_ids, **options):
    """Return the counts that are not zero, except the sizes of maps."""
    scores = score_association(decisions, true_ids, **options)._asdict()
    return {k: v for k, v in scores.items() if v and not k.endswith("map_size")}


def given(*row_ids, added=(), removed=(), merged=()):
    return ScanDecisions(row_ids, added, removed, merged)


def test_every_kind_of_decision_is_counted_once():
    decisions = [
        given(0, 1, added=(0, 1)),
        given(0, 1, None, 2, added=(2,)),
        given(1, None, 2, 0, None),
        given(3, added=(3,)),
    ]
    true_ids = [[A, B], [A, A, CLUTTER, CLUTTER], [CLUTTER, A, CLUTTER, C, C], [B]]
    assert counts(decisions, true_ids) == {
        "new_correct": 2,  # 0 of A and 1 of B
        "correct": 1,
        "wrong": 2,  # A given to 1; C, not in the map yet, given to 0
        "ghost": 1,
        "clutter_used": 2,  # 1, and the ghost
        "missed": 1,  # A in the third scan; C is not in the map
        "duplicate": 1,
    }
    scores = score_association(decisions, true_ids)
    assert (scores.precision, scores.recall) == (3 / 9, 3 / 7)
    assert (scores.map_size, scores.true_map_size) == (4, 3)
    each = AssociationScores(*2 ** np.arange(9))
    assert each.precision == (1 + 4) / (1 + 4 + 2 + 8 + 16 + 64)
    assert each.recall == (1 + 4) / (1 + 4 + 2 + 8 + 32)
    twice = given(0, 0, added=(0,))
    assert counts([twice], [[A, A]]) == {"new_correct": 1, "correct": 1}


def test_the_confirming_reading_says_who_a_landmark_is():
    decisions = [given(0), given(0), given(0, added=(0,)), given(0), given(None)]
    true_ids = [[A], [B], [B], [B], [A]]
    assert landmark_identities(decisions, true_ids) == {0: B}
    assert counts(decisions, true_ids) == {"wrong": 1, "correct": 2, "new_correct": 1}


def test_a_place_counts_as_missed_from_its_confirmation_on():
    decisions = [given(None), given(0, added=(0,)), given(None)]
    assert counts(decisions, [[A], [A], [A]]) == {"new_correct": 1, "missed": 1}


def test_clutter_that_is_left_out_is_no_miss_even_with_a_ghost_in_the_map():
    decisions = [given(0, added=(0,)), given(None)]
    assert counts(decisions, [[CLUTTER], [CLUTTER]]) == {"ghost": 1}


def test_a_landmark_that_was_removed_may_come_back():
    gone = given(0, added=(0,), removed=(0,))
    decisions = [gone, given(None), given(1, added=(1,))]
    assert counts(decisions, [[A], [A], [A]]) == {"new_correct": 2}
    assert score_association(decisions, [[A], [A], [A]]).map_size == 1


def test_merging_ends_a_duplicate():
    twice = [given(0, added=(0,)), given(1, added=(1,), merged=((0, 1),))]
    decisions = [*twice, given(0)]
    scores = score_association(decisions, [[A], [A], [A]])
    assert (scores.duplicate, scores.correct, scores.map_size) == (1, 1, 1)
    wrongly = [given(0, 1, added=(0, 1), merged=((0, 1),)), given(None, None)]
    assert counts(wrongly, [[A, B], [A, A]])["missed"] == 2  # the place of the first


def test_two_new_landmarks_of_one_place_in_one_scan_are_a_duplicate():
    places = {A: A, B: A}
    decisions = [given(0, 1, added=(0, 1))]
    assert counts(decisions, [[A, B]], places=places) == {
        "new_correct": 1,
        "duplicate": 1,
    }
    assert counts(decisions, [[A, B]]) == {"new_correct": 2}


def test_readings_of_a_neighbour_within_the_resolution_are_correct():
    decisions = [given(0, added=(0,)), given(0), given(None)]
    true_ids = [[A], [B], [B]]
    assert counts(decisions, true_ids)["wrong"] == 1
    by_place = counts(decisions, true_ids, places={A: A, B: A})
    assert by_place == {"new_correct": 1, "correct": 1, "missed": 1}


def test_without_readings_of_landmarks_the_shares_are_unknown():
    scores = score_association([given(None)], [[CLUTTER]])
    assert math.isnan(scores.precision)
    assert math.isnan(scores.recall)


def test_places_are_connected_by_gaps_below_the_resolution():
    ids, positions = [4, 2, 6, 9], [(0, 0), (1, 0), (2, 0), (3.5, 0)]
    assert places_of(ids, positions, 1.0) == {4: 4, 2: 2, 6: 6, 9: 9}
    assert places_of(ids, positions, 1.01) == {4: 2, 2: 2, 6: 2, 9: 9}
    assert places_of(ids, positions, 1.51) == dict.fromkeys(ids, 2)
    assert places_of([], np.empty((0, 2)), 1.0) == {}


def test_landmarks_at_one_spot_differ_without_a_resolution():
    assert places_of([1, 2], [(0, 0), (0, 0)], 0.0) == {1: 1, 2: 2}
    assert places_of([1, 2], [(0, 0), (0, 0)], 1e-9) == {1: 1, 2: 1}


def test_known_places_are_those_of_any_window_of_scans():
    rng = np.random.default_rng(5)
    for _ in range(200):
        k, n = sorted(rng.integers(1, 6, 2).tolist())
        scans = [
            rng.choice(4, rng.integers(0, 4), replace=False).tolist() for _ in range(12)
        ]
        slow = {
            place
            for place in range(4)
            for first in range(len(scans))
            if sum(place in scan for scan in scans[first : first + n]) >= k
        }
        assert known_places(scans, (k, n)) == slow


def test_a_scan_that_shows_a_place_twice_counts_once():
    assert known_places([[A, A, A]], (3, 8)) == set()


@pytest.mark.parametrize(
    ("true_ids", "message"),
    [
        ([], "must be of 1 scans, got 0"),
        ([[A, B]], r"true_ids\[0\] must have one entry per reading"),
    ],
)
def test_what_does_not_match_is_refused(true_ids, message):
    with pytest.raises(ValueError, match=message):
        score_association([given(0, added=(0,))], true_ids)


@pytest.mark.parametrize("resolution", [-1.0, math.inf, math.nan])
def test_a_resolution_that_is_no_length_is_refused(resolution):
    with pytest.raises(ValueError, match="resolution must be"):
        places_of([1], [(0, 0)], resolution)


def test_the_oracle_takes_the_landmark_of_the_least_mahalanobis_distance():
    rng = np.random.default_rng(4)
    ids, world = np.array([2, 3, 5, 9]), rng.uniform(-4, 4, (4, 2))
    poses, std, slope = rng.uniform(-1, 1, (6, 3)), (0.3, 0.2), 0.1
    poses[4, 2] = np.nan
    truth = [rng.choice([*ids, CLUTTER], 5) for _ in poses]
    scans = [rng.uniform((-3, 0.5), (3, 5), (5, 2)) for _ in poses]
    for places in (None, {2: 2, 3: 2, 5: 5, 9: 5}):
        name = (places or {}).get
        wrong = []
        for pose, readings, true in zip(poses, scans, truth, strict=True):
            for (bearing, distance), i in zip(readings, true, strict=True):
                squares = []
                for x, y in world - pose[:2]:
                    expected = math.hypot(x, y)
                    turn = math.atan2(y, x) - pose[2] - bearing
                    turn = math.remainder(turn, 2 * math.pi)
                    gap = (distance - expected) / (std[1] + slope * expected)
                    squares.append((turn / std[0]) ** 2 + gap**2)
                if i != CLUTTER and math.isfinite(squares[0]):
                    best = int(ids[np.argmin(squares)])
                    wrong.append(name(best, best) != name(int(i), int(i)))
        found = oracle_errors(
            poses,
            scans,
            truth,
            ids,
            world,
            std,
            sensor=BEARING_RANGE.with_noise(range_std_per_metre=slope),
            places=places,
        )
        assert 0 < found < 1
        assert found == np.mean(wrong)
    at_one = [(0.0, 0.0), (1.0, 0.0)]  # the robot is where a landmark is
    drive = np.zeros((1, 3)), [np.array([(0.0, 1.0)])], [[3]]
    assert oracle_errors(*drive, [2, 3], at_one, std) == 0
    nothing = oracle_errors(poses[4:5], scans[4:5], truth[4:5], ids, world, std)
    assert math.isnan(nothing)
    with pytest.raises(ValueError, match=r"zip\(\)"):
        oracle_errors(poses[1:], scans, truth, ids, world, std)
