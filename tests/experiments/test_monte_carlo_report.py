"""The numbers, the words, the table and the figures of a Monte Carlo."""

import html
import io
import itertools
import json
import re

import numpy as np
import pytest
from drawn import check_looks
from matplotlib.figure import Figure
from matplotlib.text import Text
from monte_carlo_dataset import typical, with_failures
from rich.console import Console
from scipy.stats import chi2

from slamgym import experiments
from slamgym.estimator import EkfSlam
from slamgym.evaluation import diagnose
from slamgym.evaluation.consistency_report import evaluate_consistency
from slamgym.evaluation.hypothesis_tests import (
    EquivalenceTest,
    equivalence_test,
    family_band,
)
from slamgym.evaluation.map_consistency import MapReport
from slamgym.experiments import nees_figure
from slamgym.experiments.command_line.commands import Reporter
from slamgym.experiments.command_line.monte_carlo import show_study
from slamgym.experiments.monte_carlo_study import figures, monte_carlo, verdict
from slamgym.experiments.monte_carlo_study.figures import report_figures, thinned
from slamgym.experiments.monte_carlo_study.report import (
    html_report,
    measures,
    monte_carlo_table,
)
from slamgym.experiments.monte_carlo_study.summary import summarise_monte_carlo
from slamgym.experiments.monte_carlo_study.verdict import (
    KINDS,
    coarse_bearings,
    diagnosis_lines,
    run_warnings,
    scores_of,
    seeds_sentence,
    verdict_of_report,
)
from slamgym.sim_configs import load_scenario

FAILURES = (
    ("invariant", 3, 12, "LinAlgError: not positive definite"),
    ("invariant", 7, 0, "ValueError: <b>no</b> [red]landmark[/red]"),
)


def table_text(summary, width=80):
    console = Console(file=io.StringIO(), width=width)
    console.print(monte_carlo_table(summary))
    return console.file.getvalue()


def figure_of(dataset, name):
    return report_figures(dataset, summarise_monte_carlo(dataset))[name]


def line_of(axes, label):
    (line,) = (line for line in axes.lines if line.get_label() == label)
    return line


def white_report(factor, runs, steps=20, outliers=0):
    """Report on runs whose NEES is white, exactly χ² times a factor."""
    rng = np.random.default_rng(1)
    nees = factor * rng.chisquare(3, (runs, steps))
    nees[:outliers] *= 50
    dof = np.full((runs, steps), 2)
    nis = rng.chisquare(2, (runs, steps))
    return evaluate_consistency(nees, nis, dof, frame="invariant", rng=rng)


@pytest.mark.parametrize("label", ["ekf", "invariant"])
def test_averages_equal_the_plain_formulas(label):
    dataset = typical()
    entry = summarise_monte_carlo(dataset)["estimators"][label]
    raw = {name: dataset[name].sel(estimator=label).values for name in dataset}
    nees = raw["pose_nees_invariant"][:, 1:] / 3
    average, per_run = nees.mean(axis=0), nees.mean(axis=1)
    low, high = chi2.ppf([0.025, 0.975], 3 * 40) / (3 * 40)
    expected = {
        "mean": average.mean(),
        "end": average[-1],
        "share_inside_band": np.mean((low < average) & (average < high)),
    }
    assert entry["pose_nees"]["invariant"] == pytest.approx(expected)
    additive = raw["pose_nees_additive"][:, 1:].mean() / 3
    assert entry["pose_nees"]["additive"]["mean"] == pytest.approx(additive)
    assert entry["median_run"] == pytest.approx(np.median(per_run))
    assert entry["share_above_3"] == pytest.approx(np.mean(per_run > 3))
    heading = raw["heading_nees"][:, 1:]
    assert entry["heading_nees"]["mean"] == pytest.approx(heading.mean())
    assert entry["nis"] == pytest.approx(raw["nis"].sum() / raw["nis_dof"].sum())
    positions = raw["position_nees_additive"][:, 1:].mean() / 2
    assert entry["position_nees"]["additive"] == pytest.approx(positions)


def test_results_read_in_parts_have_the_same_summary_and_figures(monkeypatch):
    dataset = with_failures(typical(), FAILURES)

    def found():
        summary = summarise_monte_carlo(dataset)
        drawn = report_figures(dataset, summary).values()
        lines = [
            line for figure in drawn for axes in figure.axes for line in axes.lines
        ]
        return [*leaves(summary), *(x for each in lines for x in each.get_ydata())]

    whole = found()
    monkeypatch.setattr(verdict, "_AT_ONCE", 7 * dataset.sizes["step"])
    for part, value in zip(found(), whole, strict=True):
        is_float = isinstance(value, float)
        assert part == (approximately(value) if is_float else value)


def leaves(found):
    """Yield all values of nested lists and dictionaries."""
    if isinstance(found, dict | list):
        for each in found.values() if isinstance(found, dict) else found:
            yield from leaves(each)
    else:
        yield found


def approximately(value):
    return pytest.approx(value, rel=1e-12, abs=1e-12, nan_ok=True)


def test_root_mean_squares_equal_the_plain_formulas():
    dataset = typical()
    entry = summarise_monte_carlo(dataset)["estimators"]["ekf"]
    raw = {name: dataset[name].sel(estimator="ekf").values for name in dataset}

    def rms(values):
        return pytest.approx(np.sqrt(np.nanmean(values**2)))

    assert entry["rmse"]["position"] == rms(raw["position_error"][:, 1:])
    assert entry["rmse"]["heading"] == rms(raw["heading_error"][:, 1:])
    assert entry["heading_std_end"]["claimed"] == rms(raw["heading_std"][:, -1])
    assert entry["heading_std_end"]["true"] == rms(raw["heading_error"][:, -1])
    for name in ("ate", "landmark_rmse"):
        assert entry[name]["raw"] == rms(raw[name])
        assert entry[name]["aligned"] == rms(raw[f"{name}_aligned"])
    assert entry["landmark_mahalanobis"] == rms(raw["landmark_mahalanobis"])
    end = entry["nees_end"]
    state = raw["state_nees_invariant"].sum() / raw["state_dof"].sum()
    assert end["state"] == pytest.approx(state)
    landmarks = np.nanmean(raw["landmark_nees_invariant"]) / 2
    assert end["landmarks"] == pytest.approx(landmarks)


def test_the_final_decision_equals_the_chi_square_of_the_last_step():
    dataset = typical()
    entry = summarise_monte_carlo(dataset)["estimators"]["invariant"]
    last = dataset["pose_nees_invariant"].sel(estimator="invariant", step=29)
    total = float(last.sum())
    p_value = 2 * min(chi2.cdf(total, 120), chi2.sf(total, 120))
    decision = entry["decisions"]["final_step"]
    assert decision["statistic"] == pytest.approx(total / 120)
    assert decision["p_value"] == pytest.approx(p_value)


def test_grid_steps_are_numbered_as_the_results_number_them():
    dataset = typical()
    entry = summarise_monte_carlo(dataset)["estimators"]["ekf"]
    grid = entry["decisions"]["grid"]
    nees = dataset["pose_nees_invariant"].sel(estimator="ekf", step=grid["steps"])
    assert grid["statistic"] == pytest.approx((nees.mean("run") / 3).values)
    assert grid["steps"][-1] == 29


def test_a_refusal_at_one_step_names_it_as_the_results_number_it():
    rng = np.random.default_rng(1)
    nees = rng.chisquare(3, (60, 20))
    dof, nis = np.full(nees.shape, 2), rng.chisquare(2, nees.shape)
    nees[:, 8] *= 2
    report = evaluate_consistency(nees, nis, dof, frame="invariant", rng=rng)
    worst = report.family_steps[report.family.rejected]
    assert worst.tolist() == [8]
    assert (
        "at step 9 (p" in verdict_of_report(report, 0, 60).reason
    )  # step 0 is the start


def test_the_ekf_is_refused_and_the_invariant_filter_is_consistent():
    entries = summarise_monte_carlo(typical())["estimators"]
    assert entries["ekf"]["verdict"] == "not consistent"
    assert entries["ekf"]["sentence"].startswith("ekf: not consistent: the squared err")
    assert "(p < 1e-16)" in entries["ekf"]["sentence"]
    assert entries["invariant"]["verdict"] == "consistent"
    assert "lies inside [0.8, 1.25]" in entries["invariant"]["sentence"]


def with_wrong_map(change):
    """Return the entry of the invariant filter, the map of whose results is changed.

    `change` takes the deviations of the landmarks, (estimators, runs, landmarks, 2).
    """
    dataset = typical().copy(deep=True)
    names = "landmark_deviation_x", "landmark_deviation_y"
    deviations = np.stack([dataset[name].values for name in names], axis=-1)
    before = (deviations**2).sum(axis=-1)
    change(deviations)
    for axis, name in enumerate(names):
        dataset[name].values[:] = deviations[..., axis]
    nees = dataset["landmark_nees_invariant"].values
    nees *= (deviations**2).sum(axis=-1) / before
    whole = dataset["relative_map_nees"].values
    whole *= np.nansum(deviations**2, axis=(-2, -1)) / np.nansum(before, axis=-1)
    return summarise_monte_carlo(dataset)["estimators"]["invariant"]


def test_the_verdict_on_an_honest_filter_covers_the_map():
    entry = summarise_monte_carlo(typical())["estimators"]["invariant"]
    low, high = entry["decisions"]["map"]["interval"]
    assert entry["reason"].endswith(f"as does that of the map, [{low:.3f}, {high:.3f}]")
    assert 0.8 < entry["nees_end"]["worst_landmark"] < 1.6


@pytest.mark.parametrize(("factor", "size"), [(5.0, "small"), (0.2, "large")])
def test_a_map_of_wrong_scale_is_refused_by_name(factor, size):
    def scale(deviations):
        deviations *= factor

    entry = with_wrong_map(scale)
    assert entry["verdict"] == "not consistent"
    assert not entry["accepted"]
    assert "of the pose agree with the covariances (5 %), but" in entry["reason"]
    assert entry["diagnosis"]["cause"] == "map"
    cause = entry["diagnosis"]["sentence"]
    assert f"scale: the covariances are too {size}" in cause
    assert cause.endswith("computes or reports these covariances wrongly.")
    assert entry["decisions"]["final_step"]["accepted"]


def test_one_wrong_landmark_is_refused_by_its_number():
    def move(deviations):
        deviations[..., 4, 0] += 4.0

    entry = with_wrong_map(move)
    assert entry["verdict"] == "not consistent"
    assert "one landmark: the squared errors of 4 are" in entry["diagnosis"]["sentence"]
    ratios = {
        each["landmark"]: max(each["ratio"], each["map_ratio"])
        for each in entry["decisions"]["map"]["landmarks"]
    }
    assert max(ratios, key=ratios.get) == 4
    assert entry["nees_end"]["worst_landmark"] == pytest.approx(ratios[4])


def test_an_offset_of_all_landmarks_is_told_from_a_scale():
    def move(deviations):
        deviations[..., 1] -= 3.0

    entry = with_wrong_map(move)
    assert entry["diagnosis"]["sentence"].startswith("map: offset: the landmarks are")


def test_the_table_has_a_row_of_the_map_and_of_its_worst_landmark():
    text = table_text(summarise_monte_carlo(typical()))
    assert "NEES of the map at the end" in text
    assert "… of the worst landmark" in text


def test_the_page_holds_the_decision_on_the_map_and_the_rate_of_the_others():
    dataset = typical()
    summary = summarise_monte_carlo(dataset)
    page = html.unescape(html_report(dataset, summary)).replace("\xa0", " ")
    assert summary["estimators"]["invariant"]["decisions"]["map"]["sentence"] in page
    assert "one has p < 0.015." in page


def test_a_verdict_without_maps_covers_the_pose_only():
    dataset = typical().drop_vars(["landmark_deviation_x", "landmark_deviation_y"])
    entry = summarise_monte_carlo(dataset)["estimators"]["invariant"]
    assert entry["reason"].endswith("; this covers the pose only")
    assert entry["decisions"]["map"] is None


def test_a_heading_better_known_than_at_the_start_is_pointed_out():
    summary = summarise_monte_carlo(typical())
    entries = summary["estimators"]
    assert summary["knowable_heading_std"] == 0.1
    assert "the start was known to 5.7° only" in entries["ekf"]["heading_sentence"]
    assert entries["invariant"]["heading_sentence"] == ""


@pytest.mark.parametrize(
    ("factor", "runs", "word", "said"),
    [
        (1.0, 400, "consistent", "lies inside [0.8, 1.25]"),
        (1.5, 400, "not consistent", "over all steps (p < 1e-16)"),
        (0.6, 400, "not consistent", "the filter is too cautious"),
        (1.06, 2000, "nearly consistent", "certain but small"),
        (1.0, 3, "not shown", "more runs are needed"),
        (0.6, 4, "not shown", "no test rejects it (5 %), but the 90 % interval"),
    ],
)
def test_verdicts_on_white_nees(factor, runs, word, said):
    verdict = verdict_of_report(white_report(factor, runs), 0, runs)
    assert verdict.word == word
    assert said in verdict.reason


def test_the_number_of_runs_that_a_verdict_names_suffices():
    reason = verdict_of_report(white_report(1.0, 15, steps=2), 0, 15).reason
    named = int(re.search(r"about ([\d,]+) in total", reason)[1].replace(",", ""))
    rng = np.random.default_rng(2)

    def power(runs):
        averages = rng.chisquare(6, (100, runs)) / 2  # of two steps, 3 degrees each
        return np.mean([equivalence_test(one, 3).accepted for one in averages])

    assert power(2 * named) >= 0.8
    assert power(named // 2) <= 0.4


@pytest.mark.slow
@pytest.mark.parametrize("runs", [2, 5, 20])
def test_few_runs_of_a_consistent_filter_are_called_wrong_in_5_percent(runs):
    """NEES that never changes over time is the hardest case: as skewed as can be."""
    repetitions = 1000
    rng = np.random.default_rng(13)
    dof = np.full((runs, 4), 2)
    wrong = 0
    for _ in range(repetitions):
        nees = np.repeat(rng.chisquare(3, (runs, 1)), 4, axis=1)
        nis = rng.chisquare(2, (runs, 4))
        report = evaluate_consistency(nees, nis, dof, frame="invariant", rng=rng)
        found = verdict_of_report(report, 0, runs).word == "not consistent"
        assert not (found and report.accepted)
        wrong += found
    assert wrong <= 0.05 * repetitions


@pytest.mark.parametrize("runs", [3, 5, 9])
def test_few_runs_of_a_filter_that_is_far_off_are_found(runs):
    assert verdict_of_report(white_report(8.0, runs), 0, runs).word == "not consistent"


@pytest.mark.slow
@pytest.mark.parametrize("runs", [2, 4, 5])
def test_summary_and_page_of_very_few_runs_hold_no_absurd_number(runs, request):
    world = load_scenario("six_landmarks").with_changes(steps=12)
    for seed in (0, 5, 9):
        if seed or runs not in (2, 5):  # 5: the first with a bootstrap
            request.getfixturevalue("_figures_in_reports_are_blank")
        dataset = monte_carlo(world, "ekf", runs, seed)
        summary = summarise_monte_carlo(dataset)
        json.dumps(summary, allow_nan=False)
        bootstrap = summary["estimators"]["ekf"]["decisions"]["bootstrap"]
        assert (bootstrap["p_value"] is None) == (runs < 5)
        page = html_report(dataset, summary)
        (row,) = re.findall(r"Time averages, bootstrap</th>(.*?)</tr>", page)
        if runs < 5:
            assert row.count("<td>–</td>") == 3
        shown = html.unescape(re.sub(r"<svg.*?</svg>", "", row))
        assert not re.findall(r"\d{9}", shown)
        assert "nan" not in row
        assert "None" not in row


def test_a_few_bad_runs_that_make_the_average_are_pointed_out():
    verdict = verdict_of_report(white_report(1.0, 200, outliers=4), 0, 200)
    assert verdict.word == "not consistent"
    assert (
        "; 3 of 200 runs make this average: without them, it is 1.17" in verdict.reason
    )


def test_the_table_of_verdicts_has_the_numbers_of_the_summary():
    dataset = typical()
    table = experiments.verdict_table(dataset)
    entries = summarise_monte_carlo(dataset)["estimators"]
    assert list(table.index) == list(entries)
    for label, found in entries.items():
        row = table.loc[label]
        nees, rmse = found["pose_nees"]["invariant"], found["rmse"]
        assert row.to_list() == [
            *(found["good_runs"], found["verdict"], nees["mean"], nees["end"]),
            *(found["nis"], rmse["position"], rmse["heading"]),
        ]
    assert "invariant & " in table.to_latex(float_format="%.3g")
    for results in (dataset, dataset.isel(run=slice(None))):
        assert results.table().equals(table)


def test_the_table_of_verdicts_has_a_row_of_a_filter_that_always_fails():
    results = monte_carlo("six_landmarks", {"ekf": Fails}, runs=2)
    table = experiments.verdict_table(results)
    assert table.loc["ekf", "runs"] == 0
    assert table.iloc[0, 2:].isna().all()


class Fails(EkfSlam):
    """A filter that refuses to move."""

    def predict(self, odometry, dt=1.0):
        raise ValueError("no")


def test_failed_runs_are_told_and_counted_nowhere_else():
    dataset = with_failures(typical(), FAILURES)
    entry = summarise_monte_carlo(dataset)["estimators"]["invariant"]
    others = typical().isel(run=[run for run in range(40) if run not in (3, 7)])
    expected = summarise_monte_carlo(others)["estimators"]["invariant"]
    for name in ("pose_nees", "heading_nees", "nis", "rmse", "ate", "landmark_rmse"):
        assert entry[name] == expected[name]
    assert entry["decisions"] == expected["decisions"]
    assert entry["good_runs"] == 38
    names = ("run", "step", "message")
    failures = [dict(zip(names, each[1:], strict=True)) for each in FAILURES]
    assert entry["failed_runs"] == failures
    assert entry["verdict"] == "not shown"
    assert entry["reason"].startswith("2 of 40 runs failed; of the others, ")


def test_notes_group_failures_and_warn_of_few_runs():
    boom, odd = "ZeroDivisionError: boom", "ValueError: [red]odd[/red]\nsecond line"
    failures = [("ekf", run, 3, boom) for run in range(30)]
    failures += [("ekf", 31, -1, odd), ("ekf", 33, 5, "c"), ("ekf", 34, 5, "d")]
    summary = summarise_monte_carlo(with_failures(typical(), failures))
    groups = summary["estimators"]["ekf"]["failure_groups"]
    assert groups[0] == {"count": 30, "message": boom, "run": 0, "step": 3}
    assert [group["count"] for group in groups] == [30, 1, 1, 1]
    assert summary["notes"] == [
        "ekf: 33 of 40 runs failed: 30 × ZeroDivisionError: boom (first: run 0, "
        "step 3); 1 × ValueError: [red]odd[/red] second line (first: run 31); "
        "1 × c (first: run 33, step 5); 1 × other messages.",
        "ekf: only 7 runs succeeded; at least 20 are needed.",
    ]
    assert summarise_monte_carlo(typical())["notes"] == []


def test_seeds_of_failed_bad_and_diverged_runs_are_told_the_worst_first():
    dataset = with_failures(typical(), [("invariant", 3, 1, "boom")])
    dataset = dataset.copy(deep=True).assign_attrs(seed=100)
    nees = dataset["pose_nees_invariant"]
    nees.loc[{"run": 8}], nees.loc[{"run": 9}] = 1000.0, 2000.0
    summary = summarise_monte_carlo(dataset)
    entry = summary["estimators"]["invariant"]
    assert entry["seeds_sentence"].endswith(": seeds 103, 109, 108.")
    assert entry["seeds_sentence"] in diagnosis_lines("invariant", entry)[-1]
    assert ": seeds 103, 109, 108.</p>" in html_report(dataset, summary)
    nees.loc[{"run": range(20, 30)}] = 500.0
    scores, excess = scores_of(dataset, "invariant", "invariant"), np.zeros(39)
    excess[6] = 5.0  # of run 7, since run 3 is missing
    told = seeds_sentence(scores, "invariant", excess)
    assert told.endswith(": seeds 103, 107, 109, 108, 120 and 9 more.")
    honest = summarise_monte_carlo(typical())["estimators"]["invariant"]
    assert honest["seeds_sentence"] == ""


def test_the_tables_of_many_filters_show_each_of_them_at_80_columns(capsys, tmp_path):
    summary = summarise_monte_carlo(typical()) | {"files": []}
    entry = summary["estimators"]["invariant"]
    summary["estimators"] = {f"filter_{k}": entry for k in range(9)}
    summary["estimators"]["filter_3"] = entry | {"good_runs": 0}
    assert show_study(Reporter(as_json=False), summary, tmp_path) == 0
    shown = capsys.readouterr().out
    rows = re.findall("^… at the end +1 (.*)", shown, re.MULTILINE)
    ratio = next(m for m in measures(summary) if m.name == "… at the end")
    assert " ".join(rows).split() == [ratio.of(entry)] * 9


def test_few_runs_are_noted_once_for_all_estimators_and_warned_of_in_each():
    summary = summarise_monte_carlo(typical().isel(run=slice(8)))
    assert summary["notes"] == [
        "Only 8 runs: at least 20 are needed to find more than large errors."
    ]
    entry = summary["estimators"]["invariant"]
    assert any("Only 8 runs" in line for line in entry["warnings"])


def test_a_single_run_is_called_a_run():
    (note,) = summarise_monte_carlo(typical().isel(run=[0]))["notes"]
    assert note.startswith("Only 1 run: at least 20 are needed")
    assert verdict_of_report(None, 0, 1).reason.startswith("1 of 1 run succeeded:")
    failed = with_failures(typical(), [("ekf", run, 1, "a") for run in range(39)])
    assert "ekf: only 1 run succeeded; at" in summarise_monte_carlo(failed)["notes"][1]
    one = diagnose(None, np.ones((1, 5)), np.ones((1, 5)))
    assert one.sentence.startswith("cannot tell: 1 run succeeded")


def test_flagged_runs_and_gaps_that_nobody_flagged_count_as_failed():
    dataset = typical().copy(deep=True)
    dataset["failed"].loc[{"estimator": "ekf", "run": 5}] = True  # all is finite
    dataset["nis"].loc[{"estimator": "ekf", "run": 7, "step": 17}] = np.nan
    entry = summarise_monte_carlo(dataset)["estimators"]["ekf"]
    assert entry["good_runs"] == 38
    assert "2 of 40 runs failed and are left out: 5, 7." in entry["warnings"]
    failure = entry["failed_runs"][1]
    assert (failure["run"], failure["step"]) == (7, 17)
    assert "not finite" in failure["message"]


@pytest.mark.slow
@pytest.mark.parametrize("good", [0, 1])
def test_fewer_than_two_good_runs_decide_nothing_and_break_nothing(good):
    failures = [("ekf", run, 5, "boom") for run in range(good, 40)]
    dataset = with_failures(typical(), failures)
    summary = summarise_monte_carlo(dataset)
    entry = summary["estimators"]["ekf"]
    assert entry["verdict"] == "not shown"
    assert f"{good} of 40 runs" in entry["reason"]
    assert entry["decisions"] is None
    json.dumps(summary, allow_nan=False)
    assert "not shown" in table_text(summary).replace("\n", " ")
    report_figures(dataset, summary)


@pytest.mark.slow
def test_a_diverged_run_breaks_nothing():
    dataset = typical().copy(deep=True)
    row = {"estimator": "ekf", "run": 2, "step": slice(9, None)}
    for name in ("pose_nees_invariant", "pose_nees_additive", "nis", "heading_nees"):
        dataset[name].loc[row] = 1e250
    dataset["position_error"].loc[row | {"run": 3}] = 1e200
    summary = summarise_monte_carlo(dataset)
    (failure,) = summary["estimators"]["ekf"]["failed_runs"]
    assert (failure["run"], failure["step"]) == (2, 9)
    json.dumps(summary, allow_nan=False)
    table_text(summary)
    for figure in report_figures(dataset, summary).values():
        figure.draw_without_rendering()


def test_a_start_known_for_certain_is_no_failure():
    dataset = typical().copy(deep=True)
    for name in ("pose_nees_invariant", "pose_nees_additive", "heading_nees"):
        dataset[name].loc[{"step": slice(0, 2)}] = np.nan
    summary = summarise_monte_carlo(dataset)
    entry = summary["estimators"]["ekf"]
    assert entry["failed_runs"] == []
    nees = dataset["pose_nees_invariant"].sel(estimator="ekf").values[:, 3:]
    assert entry["pose_nees"]["invariant"]["mean"] == pytest.approx(nees.mean() / 3)
    line = line_of(figure_of(dataset, "nees").axes[0], "ekf")
    assert line.get_xdata()[0] == 3
    json.dumps(summary, allow_nan=False)


def test_an_estimator_alone_gets_the_same_figures_as_beside_others():
    alone = summarise_monte_carlo(typical().sel(estimator=["invariant"]))
    beside = summarise_monte_carlo(typical())
    assert alone["estimators"]["invariant"] == beside["estimators"]["invariant"]


def test_the_frame_can_be_chosen():
    summary = summarise_monte_carlo(typical(), frame="additive")
    decision = summary["estimators"]["ekf"]["decisions"]["final_step"]
    last = typical()["pose_nees_additive"].sel(estimator="ekf", step=29)
    assert decision["statistic"] == pytest.approx(float(last.mean()) / 3)
    assert "additive frame" in table_text(summary, 100)
    with pytest.raises(ValueError, match="frame must be 'additive' or 'invariant'"):
        summarise_monte_carlo(typical(), frame="right")


def test_other_noise_than_the_worlds_is_told():
    dataset = typical().copy()
    dataset.attrs["assumed"] = dataset.attrs["scenario"]
    assert summarise_monte_carlo(dataset)["assumed_toml"] is None
    dataset.attrs["assumed"] += "# other"
    assert summarise_monte_carlo(dataset)["assumed_toml"].endswith("# other")


def test_the_table_fits_80_columns_and_keeps_brackets():
    text = table_text(summarise_monte_carlo(typical()))
    assert max(map(len, text.splitlines())) <= 80
    for words in ("path (ATE), raw [m]", "not consistent", "≥ 5.7°", "failed runs"):
        assert words in text


def test_the_share_inside_the_band_is_not_expected_to_be_95_percent():
    summary = summarise_monte_carlo(typical())
    (row,) = (row for row in measures(summary) if "95 % band" in row.name)
    assert row.right == "varies"


@pytest.mark.parametrize(("std", "bound"), [(0.1, "≥ 5.7°"), (1e-4, "")])
def test_a_bound_of_the_heading_too_small_to_matter_is_left_out(std, bound):
    summary = summarise_monte_carlo(typical()) | {"knowable_heading_std": std}
    (row,) = (row for row in measures(summary) if "claimed" in row.name)
    assert row.right == bound


@pytest.mark.usefixtures("_no_figures_in_reports")
def test_a_word_has_one_colour_on_terminal_and_page():
    summary = summarise_monte_carlo(typical())
    styles = {"good": "green", "bad": "red", "open": "yellow"}
    for word, kind in KINDS.items():
        summary["estimators"]["ekf"]["verdict"] = word
        cell = next(monte_carlo_table(summary).columns[2].cells)
        assert (str(cell), cell.style) == (word, styles[kind])
        page = html_report(typical(), summary)
        assert f'<li class="{kind}"><h3><span>ekf</span>' in page
    assert KINDS["nearly consistent"] == "good"


def test_labels_with_markup_reach_the_table_as_they_are():
    dataset = typical().assign_coords(estimator=["[red]x", "y[iterations=3]"])
    text = table_text(summarise_monte_carlo(dataset), 100)
    assert "[red]x" in text
    assert "y[iterations=3]" in text


@pytest.mark.slow
def test_curves_are_averages_over_runs():
    axes = figure_of(typical(), "nees").axes[0]
    line = line_of(axes, "ekf")
    nees = typical()["pose_nees_invariant"].sel(estimator="ekf").values[:, 1:]
    np.testing.assert_array_equal(line.get_xdata(), np.arange(1, 30))
    np.testing.assert_allclose(line.get_ydata(), nees.mean(axis=0) / 3)
    errors = typical()["position_error"].sel(estimator="ekf").values[:, 1:]
    line = line_of(figure_of(typical(), "rmse").axes[0], "ekf")
    np.testing.assert_allclose(line.get_ydata(), np.sqrt((errors**2).mean(axis=0)))


@pytest.mark.usefixtures("_figures_in_reports_are_blank")
def test_the_legend_counts_the_steps_that_are_tested():
    dataset = typical(steps=4)
    axes = figure_of(dataset, "nees").axes[0]
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("step", "ANEES / 3")
    line = line_of(axes, "95 % band, 4 steps")
    assert line.get_ydata()[0] == pytest.approx(family_band(40, 3, 4).low / 3)
    page = html_report(dataset, summarise_monte_carlo(dataset))
    assert "all 4 marked steps" in page
    line_of(figure_of(typical(), "nees").axes[0], "95 % band, 10 steps")
    bound = np.array(typical()["position_bound_raw"].sel(estimator="ekf"))[:, 1:]
    line = line_of(figure_of(typical(), "rmse").axes[0], "bound of any filter")
    np.testing.assert_allclose(line.get_ydata(), np.sqrt(bound.mean(axis=0)))
    below = figure_of(typical().sel(estimator=["ekf"]), "nis").axes[1]
    assert below.lines[-1].get_xdata().tolist() == list(range(1, 11))


def test_the_heading_panels_show_claim_truth_and_what_is_knowable():
    axes = figure_of(typical(), "heading").axes[0]
    std = typical()["heading_std"].sel(estimator="ekf").values[:, 1:]
    claimed = line_of(axes, "claimed deviation").get_ydata()
    np.testing.assert_allclose(claimed, np.degrees(np.sqrt((std**2).mean(axis=0))))
    assert line_of(axes, "deviation at the start").get_ydata()[0] == pytest.approx(
        5.7296, 1e-4
    )


@pytest.mark.slow
def test_every_run_is_a_dot_of_its_own():
    axes = figure_of(typical(), "runs").axes[0]
    dots = [line for line in axes.lines if line.get_marker() == "o"]
    for line, label in zip(dots, ("ekf", "invariant"), strict=True):
        nees = typical()["pose_nees_invariant"].sel(estimator=label).values[:, 1:]
        averages = np.sort(nees.mean(axis=1) / 3)
        shown = np.column_stack(line.get_data())
        assert len(np.unique(shown, axis=0)) == 40
        np.testing.assert_allclose(np.sort(shown[:, 0]), averages, rtol=0.05)


def test_autocorrelations_are_those_of_the_whiteness_decision():
    dataset = typical().copy(deep=True)
    dataset["nis_dof"][..., ::3] = 4  # else the normal scores' scale would not matter
    dataset["nis_dof"][..., ::7] = 0
    scores = scores_of(dataset, "ekf", "invariant")
    correlations, pairs = figures.nis_autocorrelation(scores)
    statistic = (pairs * correlations**2).sum()
    entry = summarise_monte_carlo(dataset)["estimators"]["ekf"]
    assert statistic == pytest.approx(entry["decisions"]["whiteness"]["statistic"])


def test_pooled_nis_adds_up_to_all_of_it():
    dataset = typical().copy(deep=True)
    dataset["nis_dof"][..., 4] = 0  # nothing is corrected then
    scores = scores_of(dataset, "ekf", "invariant")
    steps, ratios, freedom = figures.pooled_nis(scores)
    assert steps.tolist() == [1, 2, 3, *range(5, 30)]
    nis = typical()["nis"].sel(estimator="ekf").values[:, steps.astype(int)]
    assert (ratios * freedom).sum() == pytest.approx(nis.sum())


def test_dots_of_a_bin_lie_side_by_side_within_their_row():
    edges = np.linspace(0, 7, 71)
    values = np.append(np.full(31, 2.55), [0.0, 7.0])
    x, lift = figures._swarm(values, edges)
    np.testing.assert_allclose(x, np.append(np.full(31, 2.55), [0.05, 6.95]))
    np.testing.assert_allclose(np.diff(np.sort(lift[:31])), 0.6 / 31)
    assert lift[:31].mean() == pytest.approx(0)
    assert lift[31:].tolist() == [0, 0]
    _, few = figures._swarm(values[:2], edges)
    np.testing.assert_allclose(np.diff(np.sort(few)), 0.6 / 8)


def test_thinned_lines_keep_ends_and_peaks():
    x, y = np.arange(5000.0), np.zeros(5000)
    y[1234], y[3777] = 9.0, -7.0
    kept_x, kept_y = thinned(x, y, most=100)
    assert len(kept_x) <= 102
    assert (kept_x[0], kept_x[-1]) == (0, 4999)
    assert kept_x[kept_y == 9].tolist() == [1234]
    assert kept_x[kept_y == -7].tolist() == [3777]


def test_dots_of_many_runs_are_quantiles():
    values = np.random.default_rng(0).chisquare(3, 1000)
    np.testing.assert_array_equal(figures._dots(values[:300]), values[:300])
    expected = np.quantile(values, np.linspace(0.5, 299.5, 300) / 300)
    np.testing.assert_allclose(figures._dots(values), expected)


@pytest.mark.parametrize(
    ("ratios", "scale"),
    [([0.26, 3.9], "linear"), ([0.24, 3.9], "log"), ([0.26, 4.1], "log")],
)
def test_ratios_far_from_one_are_drawn_on_a_logarithmic_scale(ratios, scale):
    axes = Figure().subplots()
    axes.set_ylim(0.2, 5)
    figures.scale_ratios(axes, np.array(ratios))
    assert axes.get_yscale() == scale


def test_no_two_of_many_estimators_look_alike():
    looks = [figures.look_of(place) for place in range(30)]
    assert len({(look.colour, str(look.dashes)) for look in looks}) == 30
    neighbours = itertools.pairwise(str(look.dashes) for look in looks)
    assert all(one != two for one, two in neighbours)


def test_warnings_name_unused_readings_and_innovations_of_another_size():
    entry = {"good_runs": 40, "failure_groups": [], "unused_readings": 0.12, "nis": 3.0}
    first, second = run_warnings({"ekf": entry}, 40)
    assert first.startswith("ekf: 12 % of the readings corrected nothing")
    assert "NIS is 3 per degree of freedom" in second
    assert "assumes too little noise" in second
    noted = {"diagnosis": {"cause": "heavy tails", "sentence": "heavy tails: …"}}
    assert diagnosis_lines("a", noted) == ("a: cause: heavy tails: …",)
    noted["verdict"] = "consistent"
    assert diagnosis_lines("a", noted) == ("a: note: heavy tails: …",)
    *_, third = run_warnings({"ekf": entry | {"verdict": "consistent"}}, 40)
    assert "its errors agree with its covariances" in third
    assert "noise" not in third
    (warning,) = run_warnings({"mine": entry | {"nis": None}}, 40)
    assert warning.startswith("mine: its reports list no reading that corrected")
    managed = entry | {"options": {"management": True}, "nis": 1.0}
    assert run_warnings({"ekf": managed}, 40) == []
    assert run_warnings({"ekf": managed | {"good_runs": 20}}, 20) == []
    split = {"map_size": 25.0, "true_map_size": 20.0}
    (warning,) = run_warnings({"ekf": managed | {"association": split}}, 40)
    assert "25.0 landmarks on average, but 20.0 were seen" in warning


def test_readings_that_a_gate_rejects_are_counted():
    results = monte_carlo("six_landmarks", "ekf[gate_probability=0.5],ekf", 20)
    strict, loose = summarise_monte_carlo(results)["estimators"].values()
    assert loose["unused_readings"] == 0.0
    assert 0.4 < strict["unused_readings"] < 0.9


def test_readings_that_wait_are_not_called_unused():
    world = load_scenario("bearing").with_changes(steps=10)
    studies = (world, "ekf"), ("six_landmarks", "ekf[landmark_init=delayed],ekf")
    summaries = [summarise_monte_carlo(monte_carlo(*study, 2)) for study in studies]
    found = [entry for each in summaries for entry in each["estimators"].values()]
    assert [entry["unused_readings"] for entry in found] == [None, None, 0.0]


def test_a_filter_that_waits_gets_no_note_about_coarse_bearings():
    world = "sensor = {std = [0.3, 0.1], max_range = 5.0}"
    refused = {"verdict": "not consistent", "options": {}}
    assert "landmark_init=delayed" in coarse_bearings(world, {"ekf": refused})
    waits = refused | {"options": {"landmark_init": "delayed"}}
    assert not coarse_bearings(world, {"ekf": waits})


@pytest.mark.parametrize("width", [85.0, 170.0])
@pytest.mark.parametrize("name", ["nees", "runs", "heading", "nis", "rmse"])
def test_a_figure_for_print_is_as_wide_as_asked_and_names_its_world(name, width):
    figure = getattr(experiments, f"{name}_figure")(typical(), width)
    assert figure.get_figwidth() * 25.4 == pytest.approx(width)
    said = {text.get_text() for text in figure.findobj(Text)}
    assert "six_landmarks, 40 runs of 29 steps" in said
    if width == 85.0:
        check_looks(figure, f"{name}_figure")
    figure.draw_without_rendering()
    box = figure.get_tightbbox()
    assert box.x0 > -0.1
    assert box.x1 * 25.4 < width + 2.0


@pytest.mark.parametrize("name", ["nees", "runs", "rmse"])
def test_a_figure_of_one_panel_is_drawn_on_given_axes(name):
    whole = Figure(figsize=(6, 3))
    left, right = whole.subplots(1, 2)
    drawn = getattr(experiments, f"{name}_figure")(typical(), ax=right)
    assert drawn is whole
    assert not whole.legends  # the size and layout of the caller's figure stay
    assert tuple(whole.get_size_inches()) == (6, 3)
    assert not left.lines
    (alone,) = getattr(experiments, f"{name}_figure")(typical()).axes
    assert [line.get_label() for line in right.lines] == [
        line.get_label() for line in alone.lines
    ]
    labels = [text.get_text() for text in right.get_legend().get_texts()]
    assert labels == alone.get_legend_handles_labels()[1]


def test_a_narrow_figure_keeps_its_room_for_the_axes_and_labels_them():
    results = typical().sel(estimator=["ekf", "invariant"])
    figure = nees_figure(results)
    (box,) = figure.legends
    figure.draw_without_rendering()
    extent = box.get_window_extent()
    assert extent.width <= figure.bbox.width
    assert extent.height < 0.16 * figure.bbox.height  # two rows, not four
    labels = [text.get_text() for text in figure.axes[0].get_yticklabels()]
    low, high = figure.axes[0].get_ylim()
    inside = [text for text in labels if text and low <= float(text) <= high]
    assert len(inside) >= 4


def test_no_line_is_empty_for_which_the_layout_would_make_room():
    (axes,) = nees_figure(typical().sel(estimator=["invariant"])).axes
    assert all(len(line.get_xdata()) for line in axes.lines)


def test_a_figure_needs_a_run_that_succeeded():
    failures = [
        (name, run, 5, "boom") for name in ("ekf", "invariant") for run in range(40)
    ]
    with pytest.raises(ValueError, match="a successful run"):
        nees_figure(with_failures(typical(), failures))


def a_map(ratios, *, alone=None, means=0.0, p_values=0.0, **changes):
    """Return the report of 40 runs on a rejected map with landmarks 3, 4, …."""
    ratios, n = np.array(ratios, dtype=float), len(ratios)
    means = np.broadcast_to(np.reshape(means, (-1, 1)) * [0.6, 0.8], (n, 2))
    lone = np.broadcast_to(p_values, n).astype(float)
    whole = EquivalenceTest(2.4, (2.2, 2.6), "not consistent", 0.05)
    alone = ratios if alone is None else np.array(alone, dtype=float)
    ones = np.ones(n)
    report = MapReport(
        40, 0, 0, 41, True, whole, 1e-20, np.arange(3, 3 + n),
        ratios, lone, alone, ones, means, ones,
    )  # fmt: skip
    return report._replace(**changes)


WHOLE = "those of the whole map 2.4 times"
WRONGLY = "; the filter computes or reports these covariances wrongly."


@pytest.mark.parametrize(
    ("found", "said"),
    [
        (
            a_map([2, 2.5, 3]),
            "scale: the covariances are too small; the squared errors of the landmarks "
            f"are 2 to 3 times what they state, {WHOLE}{WRONGLY}",
        ),
        (
            a_map([0.5, 0.5, 0.5]),
            "scale: the covariances are too large; the squared errors of the landmarks "
            f"are 0.5 times what they state, {WHOLE}{WRONGLY}",
        ),
        (
            a_map([1.5, 1.6, 4], means=[1.3, 1.5, 0.26]),
            "offset: the landmarks are off by 0.26 to 1.5 deviations on average, which "
            "makes 56 % of their squared errors (median landmark).",
        ),
        (
            a_map([1.0, 1.1, 3, 1.2], p_values=[1, 1, 1e-4, 1], means=[0, 0, 0.5, 0]),
            "one landmark: the squared errors of 5 are 3 times what the covariances "
            "state, with a mean error of 0.5 deviations; those of the other 3 are 1 to "
            "1.2 times.",
        ),
        (
            a_map(
                [1.0] * 5 + [3, 4],
                p_values=[1] * 5 + [1e-4, 1e-5],
                alone=[1.1] * 5 + [5, 6],
            ),
            "some landmarks: the squared errors of 8, 9 are 5 to 6 times what the "
            "covariances state, with a mean error of 0 deviations; those of the other "
            "5 are 1.1 times.",
        ),
        (
            a_map([1.0, 3.1, 1.2], means=[1.3, 2.3, 0.1]),
            "the squared errors of each landmark are 1 to 3.1 times what the "
            "covariances state, those of the whole map 2.4 times: no single scale, "
            "offset or landmark explains this.",
        ),
        (
            a_map([1.0, 1.2, 0.9]),
            "covariances between the landmarks: the squared errors of each landmark "
            f"are 0.9 to 1.2 times what they state, {WHOLE}{WRONGLY}",
        ),
        (
            a_map([1.0, 1.4, 1.3], alone=[1.0, 1.1, 1.2]),
            "covariances between pose and map: the squared errors of each landmark are "
            "1 to 1.2 times what they state, but seen from the robot, they are 1 to "
            f"1.4 times{WRONGLY}",
        ),
        (
            a_map([]),
            "of the squared errors, those of the whole map 2.4 times what the "
            "covariances state.",
        ),
        (
            a_map([2.0], indefinite=2),
            "the covariance has a negative eigenvalue in 2 of 41 runs.",
        ),
    ],
)
def test_the_cause_of_a_wrong_map_is_written_with_its_numbers(found, said):
    assert verdict._map_cause(found) == said


def test_a_refused_map_is_written_by_the_test_that_shows_it_best():
    worst = a_map([2, 3], p_values=[1e-3, 1e-4], joint_p_value=0.5)
    said = verdict.map_refusal(worst)
    assert said == (
        "the squared errors of landmark 4 seen from the robot are 3 times what its "
        "covariances state, the worst of 2 landmarks (p = 0.0004)"
    )
    in_map = worst._replace(
        map_p_values=np.array([1e-9, 1]), map_ratios=np.array([7, 8])
    )
    assert verdict.map_refusal(in_map, "sure").startswith(
        "the squared errors of landmark 3 in the frame of the map are 7 times what"
    )
    off = worst._replace(
        means=np.array([[3.0, 4], [0, 0]]), mean_p_values=np.array([0, 1])
    )
    assert verdict.map_refusal(off, "sure") == (
        "landmark 3 is off by 5.00 deviations on average, the worst of 2 landmarks "
        "(sure)"
    )
    assert verdict.map_refusal(a_map([2, 3])) == (
        "the squared errors are 2.4 times what the covariances state (p < 1e-16)"
    )
    cautious = EquivalenceTest(0.4, (0.3, 0.5), "not consistent", 0.05)
    assert verdict.map_refusal(a_map([0.4], equivalence=cautious)).endswith(
        "(p < 1e-16): the map is too cautious"
    )
    few = EquivalenceTest(1.0, (0.7, 1.4), "not shown", 0.05)
    assert verdict.map_not_shown(a_map([1.0], equivalence=few)) == (
        "no test rejects the map, but the 90 % interval of its ratio, [0.700, 1.400], "
        "is not inside [0.8, 1.25]: more runs are needed, about 410 in total if its "
        "ratio is 1"
    )
    assert "at the end of 3 runs: its covariance" in verdict.map_not_shown(
        a_map([1.0], undefined=3)
    )


@pytest.mark.parametrize(
    ("ratio", "low", "high", "runs", "needed"),
    [
        (1.0, 0.7, 1.4, 40, 410),  # 40 (2 × max(0.3 / 0.2, 0.4 / 0.25))²
        (1.0, 0.61, 1.1, 40, 610),
        (2.0, 1.22, 2.2, 40, 610),
        (1.0, 0.7, 1.4, 9, 0),
        (1.0, 0.99, 1.01, 40, 41),
    ],
)
def test_the_runs_needed_shrink_the_interval_to_half_of_the_margin(
    ratio, low, high, runs, needed
):
    found = EquivalenceTest(ratio, (low, high), "not shown", 0.05)
    assert verdict._runs_needed(found, runs) == needed
