"""Tests that may be looked at after every run: their error rates hold at all looks."""

import numpy as np
import pytest
from scipy import integrate, stats

from slamgym.evaluation.sequential_tests import (
    FEWEST_SHOWN,
    SCALES,
    ConfidenceSequence,
    EProcess,
    MeanEProcess,
    average_of,
)

STUDIES, RUNS, STEPS = 200, 200, 10
REJECTED = np.log(20)


def correlated(rng, memory, runs=RUNS):
    """NEES of errors that are exactly N(0, I), AR(1) in time: (runs, STEPS)."""
    error, nees = rng.standard_normal((runs, 3)), []
    for _ in range(STEPS):
        fresh = rng.standard_normal((runs, 3))
        error = memory * error + np.sqrt(1 - memory**2) * fresh
        nees.append((error**2).sum(axis=1))
    return np.stack(nees, axis=1)


def at_most(count, studies=STUDIES, rate=0.05):
    """Whether a rate of at most 5 % explains the count, but for one case in 10,000."""
    return stats.binom.sf(count - 1, studies, rate) > 1e-4


@pytest.mark.parametrize("memory", [0.0, 0.9, 1.0])
def test_honest_errors_are_rarely_rejected_at_any_of_200_looks(memory):
    rng = np.random.default_rng(1)
    evidence = [EProcess().update(correlated(rng, memory), 3) for _ in range(STUDIES)]
    assert at_most(sum((each > REJECTED).any() for each in evidence))


@pytest.mark.parametrize("freedom", [2, 40])
@pytest.mark.parametrize(("ratio", "fair"), [(0.8, 1), (1, 1), (1.25, 1), (2, 0)])
def test_evidence_against_a_margin_is_at_most_1_on_average_inside_it(
    ratio, fair, freedom
):
    def weighed(nees):
        evidence = EProcess((0.8, 1.25)).update([[nees]], freedom)[0]
        return np.exp(evidence + stats.chi2.logpdf(nees, freedom, scale=ratio))

    total = sum(integrate.quad(weighed, *ends)[0] for ends in ((0, 100), (100, 3000)))
    assert (total <= 1 + 1e-6) == bool(fair)


@pytest.mark.parametrize(
    ("mean", "variance", "fair"),
    [(0.25, 1.25, 1), (0.1, 1.25, 1), (0.25, 0.8, 1), (1, 1.25, 0), (0.25, 2, 0)],
)
def test_evidence_against_a_mean_error_is_at_most_1_on_average_up_to_the_margin(
    mean, variance, fair
):
    points, weights = np.polynomial.hermite_e.hermegauss(40)
    total = 0.0
    for x, at_x in zip(points, weights / weights.sum(), strict=True):
        errors = np.sqrt(variance) * np.stack([np.full(40, x), points], axis=1)
        errors[:, 0] += mean  # one of the directions of the mixture: the worst case
        found = [MeanEProcess(0.25, 1.25).update([[error]])[0] for error in errors]
        total += at_x * np.exp(found) @ (weights / weights.sum())
    assert (total <= 1 + 1e-6) == bool(fair)


def test_evidence_against_a_mean_error_is_the_same_in_all_directions_of_the_grid():
    errors = np.random.default_rng(2).normal(0.8, 1.0, (6, 2, 2))
    cos, sin = np.cos(np.pi / 4), np.sin(np.pi / 4)
    turned = errors @ np.array([[cos, sin], [-sin, cos]])
    one, other = (MeanEProcess(0.3, 1.2).update(each) for each in (errors, turned))
    np.testing.assert_allclose(one, other, rtol=1e-12)


@pytest.mark.parametrize("angle", np.linspace(0, 2 * np.pi, 9)[:-1] + 0.2)
def test_a_mean_error_is_found_in_every_direction(angle):
    errors = np.random.default_rng(2).standard_normal((60, 1, 2))
    shift = [1.2 * np.cos(angle), 1.2 * np.sin(angle)]
    assert MeanEProcess(0.25, 1.25).update(errors).max() < REJECTED
    assert MeanEProcess(0.25, 1.25).update(errors + shift)[-1] > REJECTED


@pytest.mark.parametrize(
    ("ratio", "most"), [(0.5, 40), (1.5, 80), (2.0, 30), (5.0, 8), (30.0, 4)]
)
def test_wrong_covariances_are_rejected_soon(ratio, most):
    rng = np.random.default_rng(3)
    looks = [
        EProcess().update(ratio * correlated(rng, 0.9), 3) > REJECTED for _ in range(40)
    ]
    assert np.all(np.any(looks, axis=1))
    assert np.median(np.argmax(looks, axis=1)) + 1 <= most


def test_runs_added_in_blocks_give_the_same_evidence_and_intervals_to_the_bit():
    rng = np.random.default_rng(5)
    nees, freedom = correlated(rng, 0.5), rng.integers(0, 40, RUNS)
    whole, parts = EProcess((0.8, 1.25)), EProcess((0.8, 1.25))
    blocks = np.split(np.arange(RUNS), [1, 7, 64, 65])
    found = [parts.update(nees[block], freedom[block]) for block in blocks]
    assert np.array_equal(np.concatenate(found), whole.update(nees, freedom))
    errors, means = rng.standard_normal((RUNS, 4, 2)), MeanEProcess(0.25, 1.25)
    found = np.concatenate([means.update(errors[block]) for block in blocks])
    assert np.array_equal(found, MeanEProcess(0.25, 1.25).update(errors))
    sequence = ConfidenceSequence()
    ends = [sequence.update(nees[block, 0]) for block in blocks]
    expected = ConfidenceSequence().update(nees[:, 0])
    assert np.array_equal(np.concatenate(ends, axis=1), expected)


def test_steps_without_degrees_of_freedom_and_unknown_errors_add_no_evidence():
    with_gap = EProcess().update([[30.0, 3.0]], [[3, 0]])
    np.testing.assert_allclose(with_gap, EProcess().update([[30.0, 0.0]], [[3, 0]]))
    errors = [[[2.0, 1.0]], [[np.nan, np.nan]], [[2.0, 1.0]]]
    found = MeanEProcess(0.25, 1.25).update(errors)
    assert found[0] == found[1] < found[2]


def test_evidence_and_intervals_are_those_of_their_formulas():
    rng = np.random.default_rng(9)
    nees, freedom = rng.chisquare(3, (8, 5)), rng.integers(0, 5, (8, 5))
    gains = -freedom[..., None] * np.log(SCALES) / 2
    gains -= np.where(freedom, nees, 0.0)[..., None] * (1 / SCALES - 1) / 2
    expected = np.log(np.exp(gains.cumsum(axis=0)).mean(axis=(1, 2)))
    np.testing.assert_allclose(EProcess().update(nees, freedom), expected)
    ratios = rng.gamma(4.0, 0.5, 200)
    low, high = ConfidenceSequence().update(ratios)
    assert np.isinf(high).tolist() == [True] * 29 + [False] * 171
    for m in (30, 75, 200):
        mean, grown = ratios[:m].mean(), 0.1 * m + 1
        h = 2 * grown / (m**2 * 0.1) * np.log(np.sqrt(grown) / 0.07)
        ends = mean * np.exp(np.array([-1, 1]) * ratios[:m].std() * np.sqrt(h) / mean)
        assert (low[m - 1], high[m - 1]) == pytest.approx(tuple(ends))


def test_the_average_of_e_processes_weighs_them():
    found = average_of([np.log([1.0, 8.0]), np.log([3.0, 4.0])], [0.25, 0.75])
    np.testing.assert_allclose(np.exp(found), [2.5, 5.0])


def shown(ratios):
    low, high = ConfidenceSequence().update(ratios)
    return ((low > 0.8) & (high < 1.25)).any()


@pytest.mark.parametrize("ratio", [0.8, 1.25])
@pytest.mark.parametrize("memory", [0.0, 0.9, 1.0])
def test_a_ratio_at_the_margin_is_rarely_shown_to_be_near_1_at_any_look(ratio, memory):
    rng = np.random.default_rng(7)
    wrong = [
        shown(ratio * correlated(rng, memory).mean(axis=1) / 3) for _ in range(STUDIES)
    ]
    assert at_most(sum(wrong))


def test_honest_errors_are_shown_to_be_near_1():
    rng = np.random.default_rng(8)
    found = [shown(correlated(rng, 0.9).mean(axis=1) / 3) for _ in range(40)]
    assert np.mean(found) > 0.9


def test_a_confidence_sequence_shows_nothing_with_few_or_zero_numbers():
    low, high = ConfidenceSequence().update(np.ones(FEWEST_SHOWN))
    assert np.all(low[:-1] == 0)
    assert np.all(np.isinf(high[:-1]))
    assert low[-1] == high[-1] == 1
    assert not shown(np.zeros(50))


@pytest.mark.parametrize("nees", [[3.0, 3.0], [[np.nan, 3.0]], [[np.inf, 3.0]]])
def test_evidence_from_numbers_that_are_not_finite_is_refused(nees):
    with pytest.raises(ValueError, match="nees must be finite numbers of shape"):
        EProcess().update(nees, 3)


def test_evidence_from_other_steps_than_before_is_refused():
    evidence = EProcess()
    evidence.update(np.full((2, 10), 3.0), 3)
    with pytest.raises(ValueError, match="the 10 steps of earlier runs, got 4"):
        evidence.update(np.full((2, 4), 3.0), 3)


@pytest.mark.parametrize("ratios", [[[1.0]], [-1.0], [np.nan]])
def test_a_confidence_sequence_of_other_than_ratios_is_refused(ratios):
    with pytest.raises(ValueError, match="ratios must be finite numbers >= 0"):
        ConfidenceSequence().update(ratios)
