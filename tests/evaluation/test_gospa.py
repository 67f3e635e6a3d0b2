"""GOSPA of maps: cases made by hand, all assignments, and Stone Soup's metric."""

import datetime
import itertools
import math

import numpy as np
import pytest

from slamgym.evaluation import gospa


def over_all_assignments(x, y, cutoff):
    """The slow twin: every injective assignment of estimates to landmarks or none."""
    best = math.inf
    choices = [*range(len(y)), *([None] * len(x))]
    for chosen in set(itertools.permutations(choices, len(x))):
        pairs = [(i, j) for i, j in enumerate(chosen) if j is not None]
        cost = sum(float(np.sum((x[i] - y[j]) ** 2)) for i, j in pairs)
        best = min(best, cost + cutoff**2 / 2 * (len(x) + len(y) - 2 * len(pairs)))
    return math.sqrt(best)


def test_the_parts_of_a_map_made_by_hand():
    found = gospa([(0, 0), (5, 0.3), (20, 20)], [(0.4, 0), (5, 0), (9, 9)], cutoff=2.0)
    np.testing.assert_allclose(found.localisation, 0.16 + 0.09)
    assert (found.pairs, found.missed_count, found.false_count) == (2, 1, 1)
    assert (found.missed, found.false) == (2.0, 2.0)
    np.testing.assert_allclose(found.distance, math.sqrt(0.25 + 4.0))


def test_landmarks_beyond_the_cutoff_are_both_missed_and_false():
    found = gospa([(0, 0)], [(3, 0)], cutoff=3.0)
    assert (found.pairs, found.missed, found.false) == (0, 4.5, 4.5)


@pytest.mark.parametrize(("n", "m"), [(0, 0), (0, 3), (3, 0)])
def test_empty_maps_are_missed_or_false(n, m):
    found = gospa(np.zeros((n, 2)), np.zeros((m, 2)), cutoff=1.0)
    assert found.distance == math.sqrt((n + m) / 2)
    assert (found.missed_count, found.false_count) == (m, n)


def test_no_assignment_costs_less():
    rng = np.random.default_rng(2)
    for case in range(40):
        n, m = rng.integers(0, 4, 2)
        x, y = rng.uniform(0, 3, (n, 2)), rng.uniform(0, 3, (m, 2))
        cutoff = float(rng.uniform(0.3, 2.0))
        if case < 2:  # whose sums of distances, or of cubes, have another minimum
            x, cutoff = np.array([(0, 0), (0.89 + case / 7, 0.95)]), 9.0
            y = x * [1, -1]
        expected = over_all_assignments(x, y, cutoff)
        found = gospa(x, y, cutoff)
        np.testing.assert_allclose(found.distance, expected, rtol=1e-12)
        parts = found.localisation + found.missed + found.false
        np.testing.assert_allclose(found.distance**2, parts, rtol=1e-12)


def test_a_place_is_as_far_as_its_nearest_landmark():
    truth = [(0, 0), (0.4, 0), (9, 0)]
    apart, together = (
        gospa([(0.5, 0)], truth),
        gospa([(0.5, 0)], truth, places=[3, 3, 4]),
    )
    assert (apart.missed_count, together.missed_count) == (2, 1)
    np.testing.assert_allclose(together.localisation, 0.01)
    estimates = [(0.5, 0), (9.2, 0), (5.0, 0)]
    all_three = gospa(estimates, truth, cutoff=1.0, places=[3, 3, 4])
    np.testing.assert_allclose(all_three.localisation, 0.1**2 + 0.2**2)
    assert (all_three.missed_count, all_three.false_count) == (0, 1)
    rng = np.random.default_rng(3)
    for count in range(1, 6):
        x, y = rng.uniform(0, 2, (count, 2)), rng.uniform(0, 2, (6, 2))
        nearest = itertools.product((0, 1), (2,), (3, 4, 5))  # of each place
        expected = min(gospa(x, y[list(some)]).distance for some in nearest)
        found = gospa(x, y, places=[7, 7, 2, 5, 5, 5])
        np.testing.assert_allclose(found.distance, expected)
    assert [gospa([(0, y)], [(0, 0)]).pairs for y in (0.99, 1.01)] == [1, 0]
    with pytest.raises(ValueError, match="estimate must be"):
        gospa("here", truth)
    with pytest.raises(ValueError, match="places must have one entry per"):
        gospa([(0.5, 0)], truth, places=[3, 3])


@pytest.mark.parametrize("cutoff", [0.0, -1.0, math.inf, math.nan])
def test_a_cutoff_that_is_no_length_is_refused(cutoff):
    with pytest.raises(ValueError, match="cutoff must be a number > 0"):
        gospa([(0, 0)], [(0, 0)], cutoff)


@pytest.mark.slow
def test_stone_soup_finds_the_same():
    pytest.importorskip("stonesoup", reason="needs stonesoup, see extra interop")
    from stonesoup.metricgenerator.ospametric import GOSPAMetric
    from stonesoup.types.state import State

    generator = GOSPAMetric(c=1.5, p=2)
    now = datetime.datetime(2026, 1, 1)
    rng = np.random.default_rng(3)
    for n, m in rng.integers(1, 12, (20, 2)):
        x, y = rng.uniform(0, 6, (n, 2)), rng.uniform(0, 6, (m, 2))
        states, truths = (
            [State(point[:, None], timestamp=now) for point in points]
            for points in (x, y)
        )
        single, _ = generator.compute_gospa_metric(states, truths)
        theirs, ours = single.value, gospa(x, y, cutoff=1.5)
        np.testing.assert_allclose(ours.distance, theirs["distance"], rtol=1e-9)
        for part in ("localisation", "missed", "false"):
            np.testing.assert_allclose(getattr(ours, part), theirs[part], atol=1e-9)
