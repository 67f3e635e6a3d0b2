"""The tests of the tests: error rates on a filter that is exactly consistent."""

from functools import partial

import numpy as np
import pytest
from linear_filter import kalman_scores
from scipy.stats import chi2, norm, skew, ttest_1samp
from scipy.stats import t as student

from slamgym.evaluation.hypothesis_tests import (
    average_band,
    bootstrap_test,
    chi_square_quantile,
    equivalence_test,
    family_band,
    family_test,
    final_step_test,
    ljung_box,
    nis_test,
    nis_test_in_parts,
    normal_scores,
    runs_to_detect,
    time_average_test,
    whiteness_test,
)

REPETITIONS, RUNS, STEPS, DOF = 2000, 50, 60, 3
GRID = np.arange(STEPS // 10, STEPS + 1, STEPS // 10) - 1


@pytest.fixture(scope="module")
def repetitions():
    rng = np.random.default_rng(1)
    nees, nis = kalman_scores(rng, REPETITIONS * RUNS, STEPS)
    shape = (REPETITIONS, RUNS, STEPS)
    return list(zip(nees.reshape(shape), nis.reshape(shape), strict=True))


def bootstrap(nees):
    rng = np.random.default_rng(2)
    return bootstrap_test(nees.mean(axis=1), DOF, rng=rng, resamples=399)


ONES = np.ones((RUNS, STEPS), dtype=np.int64)
DECISIONS = {
    "final step": lambda nees, _: final_step_test(nees[:, -1], DOF),
    "time average": lambda nees, _: time_average_test(nees.mean(axis=1), DOF),
    "bootstrap": lambda nees, _: bootstrap(nees),
    "family": lambda nees, _: family_test(nees[:, GRID], DOF),
    "nis": lambda _, nis: nis_test(nis, ONES),
    "whiteness": lambda _, nis: whiteness_test(nis, ONES),
}


def test_quantiles_are_those_of_scipy_to_the_bit():
    rng = np.random.default_rng(0)
    degrees, shares = rng.integers(1, 500, 999), rng.random(999)
    np.testing.assert_array_equal(
        chi_square_quantile(shares, degrees), chi2.ppf(shares, degrees)
    )


@pytest.mark.slow
@pytest.mark.parametrize("name", DECISIONS)
def test_a_consistent_filter_is_refused_as_often_as_stated(name, repetitions):
    decide = DECISIONS[name]
    refused = np.mean([not decide(nees, nis).accepted for nees, nis in repetitions])
    assert 0.035 <= refused <= 0.07


@pytest.mark.slow
@pytest.mark.parametrize("runs", [10, 20, 50])
def test_averages_of_a_filter_that_never_forgets_are_refused_as_often(runs):
    """One χ²(3) per run, the most skewed case; the plain t-test refuses 8 %."""
    rng = np.random.default_rng(3)
    averages = rng.chisquare(DOF, (REPETITIONS, runs))
    refused = [not time_average_test(row, DOF).accepted for row in averages]
    assert 0.035 <= np.mean(refused) <= 0.07


@pytest.mark.slow
@pytest.mark.parametrize("ratio", [0.8, 1.25])
def test_equivalence_is_claimed_at_the_margin_as_often_as_stated(ratio):
    rng = np.random.default_rng(4)
    averages = ratio * rng.chisquare(DOF, (REPETITIONS, 400))
    claimed = [equivalence_test(row, DOF).accepted for row in averages]
    assert 0.035 <= np.mean(claimed) <= 0.07


@pytest.mark.slow
def test_covariances_too_small_by_a_fifth_are_found_with_the_stated_power():
    rng = np.random.default_rng(5)
    nees, _ = kalman_scores(rng, REPETITIONS * 209, 8, claimed=1.2)
    rows = nees[:, -1].reshape(REPETITIONS, 209)
    refused = np.mean([not final_step_test(row, DOF).accepted for row in rows])
    assert 0.85 <= refused <= 0.95


@pytest.mark.slow
@pytest.mark.parametrize("factor", [0.5, 2.0])
@pytest.mark.parametrize("name", ["final step", "time average", "bootstrap", "family"])
def test_a_factor_of_two_is_found_in_either_direction(name, factor, repetitions):
    nees, nis = repetitions[0]
    assert not DECISIONS[name](factor * nees, nis).accepted


def test_the_family_band_is_wider_for_more_times():
    assert family_band(50, 3, 1) == average_band(50, 3)
    assert family_band(50, 3, 10).high == pytest.approx(chi2.ppf(1 - 0.0025, 150) / 50)


@pytest.mark.parametrize("numbers", [(0, 3), (2.5, 3), (5, 0), (5, 3, 0), (5, 3, 1)])
def test_a_band_of_nothing_is_refused(numbers):
    probability = dict(zip(["probability"], numbers[2:], strict=False))
    with pytest.raises(ValueError, match=r"must be (a whole number >= 1|between 0)"):
        average_band(*numbers[:2], **probability)


@pytest.mark.parametrize(
    ("factor", "runs"),
    [(1.05, 2933), (1.1, 767), (1.2, 209), (1.3, 101), (1.5, 42), (2.0, 15)],
)
def test_runs_to_detect_a_factor(factor, runs):
    assert runs_to_detect(factor, DOF) == runs


@pytest.mark.parametrize("runs", range(2, 8))
def test_the_bootstrap_of_few_runs_is_finite_or_decides_nothing(runs):
    rng = np.random.default_rng(9)
    for averages in rng.chisquare(DOF, (30, runs)):
        decision = bootstrap_test(averages, DOF, rng=rng)
        assert decision.statistic == pytest.approx(averages.mean() / DOF)
        if runs < 5:
            assert np.isnan(decision.p_value)
            assert decision.accepted
        else:
            assert 0 < decision.p_value <= 1
            assert np.abs(decision.interval).max() < 1e6


@pytest.mark.parametrize(
    ("averages", "p_value"),
    [
        (DOF * np.array([0.5, 0.8, 1.0, 1.2, 1.5]), 1.0),
        (0.03 * np.linspace(0.9, 1.1, 10), 2 / 2000),
        (300 * np.linspace(0.9, 1.1, 10), 2 / 2000),
        (np.full(7, 0.1), np.nan),  # their mean is not 0.1 to the last bit
    ],
)
def test_the_bootstrap_of_extreme_means_and_of_equal_runs(averages, p_value):
    found = bootstrap_test(averages, DOF, rng=np.random.default_rng(3))
    np.testing.assert_equal(found.p_value, p_value)


def test_normal_scores_have_the_quantiles_of_a_normal():
    for dof in (10, 30, 100):
        x = chi2.ppf([0.025, 0.5, 0.975], dof)
        expected = norm.ppf([0.025, 0.5, 0.975])
        np.testing.assert_allclose(normal_scores(x, [dof] * 3), expected, atol=0.03)
    assert np.isnan(normal_scores([1.0], [0]))


@pytest.mark.parametrize("averages", [[0.1, 30.0], [0.1, 0.1, 90.0]])
def test_no_interval_of_a_ratio_holds_negative_numbers(averages):
    for test in (time_average_test, equivalence_test):
        low, high = test(np.array(averages), 3).interval
        assert 0 == low < high


def test_equivalence_has_three_verdicts():
    rng = np.random.default_rng(6)
    averages = rng.chisquare(DOF, 400)
    near = 1.24 * DOF * np.linspace(0.9, 1.1, 10)
    unsure, wrong = [averages[:10], near], [averages / 2, averages * 2]
    cases = {"consistent": [averages], "not shown": unsure, "not consistent": wrong}
    for verdict, given in cases.items():
        found = [equivalence_test(values, DOF) for values in given]
        assert {each.verdict for each in found} == {verdict}
        assert {each.accepted for each in found} == {verdict == "consistent"}


def test_ljung_box_finds_correlated_innovations():
    white = np.random.default_rng(7).standard_normal((20, 200))
    assert ljung_box(white).p_value > 0.01
    assert ljung_box(white[:, 1:] + 0.2 * white[:, :-1]).p_value < 1e-6


def test_what_is_not_one_number_per_run_is_refused():
    with pytest.raises(ValueError, match="nees must be at least 1 finite"):
        final_step_test(np.array([1.0, np.nan]), DOF)
    with pytest.raises(ValueError, match="factor must differ from 1"):
        runs_to_detect(1.0, DOF)
    with pytest.raises(ValueError, match="lags must be in"):
        ljung_box(np.ones((2, 5)), lags=5)
    for lags in (0, 5):
        with pytest.raises(ValueError, match=r"lags must be in \[1, 5\), got"):
            whiteness_test(np.ones((2, 5)), np.ones((2, 5), int), lags=lags)


@pytest.mark.parametrize("sign", [-1, 1])
@pytest.mark.parametrize("runs", [10, 40])
def test_the_time_averages_have_the_p_value_of_halls_cubic(runs, sign):
    drawn = np.random.default_rng(runs).gamma(3.0, 1.1, runs)
    averages = drawn if sign == 1 else 7 - drawn
    ratios = averages / DOF
    error, gamma, root = ratios.std(ddof=1) / np.sqrt(runs), skew(ratios), np.sqrt(runs)

    def cubic(t):
        powers = t**2 * gamma / (3 * root) + gamma**2 * t**3 / (27 * runs)
        return t + powers + gamma / (6 * root)

    found, score = time_average_test(averages, DOF), (ratios.mean() - 1) / error
    p_value = 2 * student.sf(abs(cubic(score)), runs - 1)
    assert found.p_value == pytest.approx(p_value)
    ends, limit = (np.array(found.interval) - 1) / error, student.isf(0.025, runs - 1)
    assert cubic(ends) == pytest.approx([-limit, limit])
    near = (ratios.mean() - np.array(equivalence_test(averages, DOF).interval)) / error
    limit = student.isf(0.05, runs - 1)
    assert cubic(near) == pytest.approx([limit, -limit])
    drawn = bootstrap_test(averages, DOF, rng=np.random.default_rng(0))
    assert drawn.p_value == pytest.approx(p_value, abs=0.05)
    found = (np.array(drawn.interval) - 1) / error
    assert found == pytest.approx(ends, abs=0.5)
    rows = np.random.default_rng(0).integers(0, runs, (1999, runs))
    scores = ttest_1samp(ratios[rows], ratios.mean(), axis=1).statistic
    assert found == pytest.approx(np.quantile(scores, [0.025, 0.975]))
    beyond = min((scores <= score).sum(), (scores >= score).sum())
    assert drawn.p_value == pytest.approx(2 * (1 + beyond) / 2000)


@pytest.mark.parametrize("scale", [0.7, 1.0, 1.3])
def test_pooled_tests_are_those_of_scipy(scale):
    rng = np.random.default_rng(12)
    nis, freedom = scale * rng.chisquare(4, (9, 30)), np.full((9, 30), 4)
    freedom[:, ::5] = 0  # these NIS do not count
    used, n = freedom > 0, freedom.sum()
    total, found = nis[used].sum(), nis_test(nis, freedom)
    assert found.statistic == pytest.approx(total / n)
    tails = chi2.cdf(total, n), chi2.sf(total, n)
    assert found.p_value == pytest.approx(min(1, 2 * min(tails)))
    assert found.interval == pytest.approx(chi2.ppf([0.025, 0.975], n) / n)
    scores = np.where(used, np.cbrt(nis), 0.0)  # nearly normal
    scores[used] -= scores[used].mean()
    parts = [(nis, freedom), (nis, 0 * freedom)]
    assert nis_test_in_parts(lambda: parts) == found
    assert nis_test(0 * nis, freedom).p_value == 0
    white, statistic = whiteness_test(nis, freedom, lags=5), 0.0
    for k in range(1, 6):
        pairs = (used[:, k:] & used[:, :-k]).sum()
        r = (scores[:, k:] * scores[:, :-k]).sum() / pairs / scores[used].var()
        statistic += pairs * r**2
    assert white.statistic == pytest.approx(statistic)
    assert white.p_value == pytest.approx(chi2.sf(statistic, 5))
    assert white.interval == pytest.approx((0, chi2.ppf(0.95, 5)))


def test_every_test_rejects_as_often_as_it_is_asked_to():
    nees = np.random.default_rng(5).chisquare(DOF, (30, 20))
    drawn = partial(bootstrap_test, rng=np.random.default_rng(0))
    of_runs = final_step_test, time_average_test, equivalence_test, drawn
    freedom = np.full(nees.shape, DOF)
    cases = [(test, nees[:, -1], DOF) for test in of_runs]
    cases += [(test, nees, freedom) for test in (nis_test, whiteness_test)]
    for test, *given in (*cases, (family_test, nees, DOF)):
        usual, strict = (test(*given, error_rate=rate) for rate in (0.05, 0.01))
        assert (usual.error_rate, strict.error_rate) == (0.05, 0.01)
        assert strict.interval.low <= usual.interval.low
        assert strict.interval.high > usual.interval.high


@pytest.mark.parametrize("scale", [1.0, 1.25, 1.5, 2.0])
def test_steps_are_rejected_by_holms_method(scale):
    rng = np.random.default_rng(13)
    nees = np.linspace(1, scale, 6) * rng.chisquare(3, (20, 6))
    totals, found = nees.sum(axis=0), family_test(nees, 3)
    p_values = 2 * np.minimum(chi2.cdf(totals, 60), chi2.sf(totals, 60))
    expected, order = np.zeros(6, dtype=bool), np.argsort(p_values)
    for place, step in enumerate(order):
        if p_values[step] * (6 - place) >= 0.05:
            break
        expected[step] = True
    np.testing.assert_array_equal(found.rejected, expected)
    assert found.p_value == pytest.approx(min(1, 6 * p_values.min()))
    assert family_test(np.full((20, 6), chi2.median(60) / 20), 3).p_value == 1
    np.testing.assert_allclose(found.statistic, totals / 60)
    assert found.interval == pytest.approx(np.array(family_band(20, 3, 6)) / 3)
