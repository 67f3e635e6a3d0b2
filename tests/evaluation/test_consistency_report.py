"""The report on many runs: what it counts, says and refuses."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from linear_filter import kalman_scores

from slamgym.evaluation import hypothesis_tests
from slamgym.evaluation.consistency_report import (
    assert_consistent,
    evaluate_consistency,
)
from slamgym.evaluation.map_consistency import map_test

RUNS, STEPS = 100, 40


@pytest.fixture
def scores():
    nees, nis = kalman_scores(np.random.default_rng(1), RUNS, STEPS)
    return nees, nis, np.ones((RUNS, STEPS), dtype=np.int64)


def report(nees, nis, nis_dof, frame="invariant"):
    rng = np.random.default_rng(0)
    return evaluate_consistency(nees, nis, nis_dof, frame=frame, rng=rng)


def test_a_consistent_filter_passes(scores):
    assert_consistent(report(*scores))
    assert report(*scores).equivalence.verdict == "consistent"


@pytest.mark.parametrize("factor", [0.6, 1.6])
def test_a_wrong_filter_raises_with_every_sentence(scores, factor):
    nees, nis, freedom = scores
    found = report(factor * nees, nis, freedom)
    with pytest.raises(AssertionError) as error:
        assert_consistent(found)
    assert all(sentence in str(error.value) for sentence in found.sentences())


@pytest.mark.slow
def test_a_consistent_filter_is_accepted_in_95_of_100_cases():
    nees, nis = kalman_scores(np.random.default_rng(2), 200 * 30, 20)
    freedom = np.ones((30, 20), dtype=np.int64)
    cases = zip(nees.reshape(200, 30, 20), nis.reshape(200, 30, 20), strict=True)
    accepted = [report(*case, freedom).accepted for case in cases]
    assert np.mean(accepted) >= 0.95 - 3 * np.sqrt(0.05 * 0.95 / 200)


def test_failed_runs_are_named_left_out_and_not_accepted(scores):
    nees, nis, freedom = scores
    whole = report(nees[2:], nis[2:], freedom[2:])
    nees[0, 30:], nis[1, 5] = np.nan, np.nan
    assert report(nees[:4], nis[:4], freedom[:4]).used_runs == 2
    with pytest.raises(ValueError, match="got 1 of 3"):
        report(nees[:3], nis[:3], freedom[:3])
    nees[0] = np.where(np.arange(STEPS) == 0, np.nan, 3.0)
    found = report(nees, nis, freedom)
    assert found.failed_runs == (0, 1)
    assert found.final_step == whole.final_step
    assert "2 of 100 runs failed and are left out: 0, 1." in found.sentences()
    with pytest.raises(AssertionError, match="runs failed"):
        assert_consistent(found)


def test_a_start_known_for_certain_is_no_failure(scores):
    nees, nis, freedom = scores
    nees[:, 0] = np.nan
    found = report(nees, nis, freedom)
    assert (found.failed_runs, found.undefined_steps) == ((), 1)
    assert found.family_steps[-1] == STEPS - 1


def test_runs_that_all_end_early_have_failed(scores):
    nees, nis, freedom = scores
    nees[:, -1] = np.nan
    with pytest.raises(ValueError, match="got 0 of 100"):
        report(nees, nis, freedom)


def test_below_10_runs_the_time_averages_have_no_say():
    nees = np.full((9, 5), 3.8) + 0.02 * np.arange(9)[:, None]  # far too much alike
    nis, freedom = np.random.default_rng(3).chisquare(2, (9, 5)), np.full((9, 5), 2)
    few = report(nees, nis, freedom)
    assert few.time_average.p_value < 0.001
    assert few.final_step.p_value > 0.02
    assert (few.deciding_runs, few.ratio_of_others) == (0, few.mean_ratio)
    assert few.accepted
    many = report(*(np.concatenate([a, a[:1]]) for a in (nees, nis, freedom)))
    assert not many.accepted
    nees = np.vstack([nees, np.full((1, 5), np.nan)])  # a failed run
    failed = report(nees, *(np.concatenate([a, a[:1]]) for a in (nis, freedom)))
    assert failed.average_p_value == 1.0


def test_a_bootstrap_of_too_few_runs_says_so(scores):
    lines = report(*(array[:3] for array in scores)).sentences()
    (line,) = (line for line in lines if "bootstrap" in line)
    assert line.endswith("nothing decided: too few runs, or all equal.")


def test_many_failed_runs_are_not_all_named(scores):
    nees, nis, freedom = scores
    nees[:60, 5] = np.nan
    assert report(nees, nis, freedom).warnings()[0] == (
        "60 of 100 runs failed and are left out: 0, 1, 2, 3, 4, 5, 6, 7, 8, 9 and 50 "
        "more."
    )


def test_every_nees_sentence_names_the_frame(scores):
    lines = report(*scores, frame="additive").sentences()
    assert sum("additive frame" in line for line in lines) == 6
    assert lines[-1].endswith("1.1: 767, 1.2: 209, 1.5: 42.")


def test_the_report_is_short_in_repr_and_whole_as_text(scores):
    found = report(*scores)
    assert repr(found).startswith("<ConsistencyReport: accepted, 100 runs, invariant")
    assert str(found).splitlines() == list(found.sentences())


def test_each_test_has_the_degrees_of_freedom_of_the_nees(scores):
    nees = scores[0]
    rng, averages = np.random.default_rng(0), nees.mean(axis=1)
    options = {"dof": 2, "frame": "additive"}
    found = evaluate_consistency(*scores, **options, rng=np.random.default_rng(0))
    assert found.final_step == hypothesis_tests.final_step_test(nees[:, -1], 2)
    assert found.time_average == hypothesis_tests.time_average_test(averages, 2)
    assert found.bootstrap == hypothesis_tests.bootstrap_test(averages, 2, rng=rng)
    assert found.equivalence == hypothesis_tests.equivalence_test(averages, 2)
    grid = hypothesis_tests.family_test(nees[:, found.family_steps], 2)
    np.testing.assert_array_equal(found.family.statistic, grid.statistic)
    nis = [part[:, :2] for part in scores[1:]]  # of two steps: one lag
    white = hypothesis_tests.whiteness_test(*nis, lags=1)
    assert report(nees[:, :2], *nis).whiteness == white
    assert found.mean_ratio == pytest.approx(averages.mean() / 2)
    assert found.runs_needed[0][1] == hypothesis_tests.runs_to_detect(
        found.runs_needed[0][0], 2
    )


def test_the_map_has_a_tenth_of_the_error_rate(scores):
    found = report(*scores)
    assert found.p_value == found.pose_p_value > 0.05
    found = replace(found, map=SimpleNamespace(p_value=0.004))
    assert found.p_value == pytest.approx(0.04)
    assert found.deciding_rate == pytest.approx(0.045 / 3)


def test_unknown_frames_and_misfit_shapes_are_refused(scores):
    nees, nis, freedom = scores
    with pytest.raises(ValueError, match="frame must be"):
        report(*scores, frame="global")
    with pytest.raises(ValueError, match="nis must have shape"):
        report(nees, nis[:-1], freedom)


def test_a_report_holds_the_tests_of_the_runs_that_succeeded():
    rng = np.random.default_rng(9)
    nees, nis = rng.chisquare(3, (24, 60)), rng.chisquare(4, (24, 60))
    freedom = np.full((24, 60), 4)
    nees[:, :3], nees[5, 40:], freedom[7, 3], nis[7, 3] = np.nan, np.nan, 0, np.nan
    errors, in_map = rng.standard_normal((24, 4, 2)), rng.chisquare(2, (24, 4))
    of_maps = rng.chisquare(8, 24), np.full(24, 8), in_map
    errors[5], of_maps[0][5], in_map[5] = 9, 99, 99
    nees[:2] *= 9
    good = np.arange(24) != 5
    found = evaluate_consistency(
        nees, nis, freedom, frame="additive", rng=np.random.default_rng(3),
        landmarks=errors, map_nees=of_maps[0], map_dof=of_maps[1], landmark_nees=in_map,
    )  # fmt: skip
    scores, averages = nees[good, 3:], nees[good, 3:].mean(axis=1)
    grid = np.array([6, 11, 17, 22, 28, 34, 39, 45, 50, 56])
    tests = hypothesis_tests
    expected = {
        "runs": 24,
        "failed_runs": (5,),
        "undefined_steps": 3,
        "used_runs": 23,
        "frame": "additive",
        "degrees_of_freedom": 3,
        "final_step": tests.final_step_test(scores[:, -1], 3),
        "time_average": tests.time_average_test(averages, 3),
        "bootstrap": tests.bootstrap_test(averages, 3, rng=np.random.default_rng(3)),
        "nis": tests.nis_test(nis[good], freedom[good]),
        "whiteness": tests.whiteness_test(nis[good], freedom[good], lags=10),
        "equivalence": tests.equivalence_test(averages, 3),
        "mean_ratio": pytest.approx(averages.mean() / 3),
        "median_ratio": pytest.approx(np.median(averages) / 3),
        "share_above_3": np.mean(averages / 3 > 3),
        "deciding_runs": 2,
        "ratio_of_others": pytest.approx(averages[2:].mean() / 3),
    }
    for name, value in expected.items():
        assert getattr(found, name) == value, name
    assert found.family_steps.tolist() == (grid + 3).tolist()
    family = tests.family_test(scores[:, grid], 3)
    np.testing.assert_array_equal(found.family.statistic, family.statistic)
    alone = map_test(errors[good], *(part[good] for part in of_maps))
    assert found.map.sentence() == alone.sentence()
    assert found.map.p_value == alone.p_value
    for title, test in (("Final step, additive frame, χ²: ratio", found.final_step),
                        ("Time averages, additive frame, t: ratio", found.time_average),
                        ("Time averages, additive frame, bootstrap: ratio",
                         found.bootstrap),
                        ("NIS over all scans, χ²: ratio", found.nis),
                        ("NIS whiteness, Ljung-Box: Q", found.whiteness)):  # fmt: skip
        assert f"\n{title} {test.statistic:.3f}, accepted within" in str(found)
        assert f"p = {test.p_value:.2g}" in str(found)
    rate = (0.05 - 0.005) / 3
    assert found.deciding_rate == pytest.approx(rate)
    p_values = found.final_step.p_value, found.time_average.p_value, family.p_value
    assert found.pose_p_value == pytest.approx(min(p_values) * 0.05 / rate)
    assert found.p_value == min(found.pose_p_value, alone.p_value * 10)


@pytest.mark.parametrize("count", [9, 10, 19, 20])
def test_few_runs_cause_a_warning_and_their_averages_do_not_count(scores, count):
    found = report(*(part[:count] for part in scores))
    average = found.time_average.p_value
    assert found.average_p_value == (average if count >= 10 else 1.0)
    assert any(f"Only {count} runs" in each for each in found.warnings()) == (
        count < 20
    )


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda part: [part[0][:, :1], *part[1:]], "nees must have shape"),
        (lambda part: [part[0][0], *part[1:]], "nees must have shape"),
        (lambda part: [part[0], part[1][:, 1:], part[2]], "nis must have shape"),
        (lambda part: [*part[:2], part[2][:, 1:]], "nis_dof must have shape"),
        (lambda part: [np.nan * part[0], *part[1:]], "got 0 of 100"),
    ],
)
def test_scores_that_do_not_fit_are_refused(scores, change, message):
    with pytest.raises(ValueError, match=message):
        report(*change(list(scores)))
