"""Verdicts on a study that grows hold 5 % at all looks together."""

import json

import numpy as np
import pytest
import xarray as xr
from monte_carlo_dataset import simulated
from scipy import stats

from slamgym.evaluation.hypothesis_tests import EQUIVALENCE_MARGIN
from slamgym.evaluation.sequential_tests import ConfidenceSequence
from slamgym.experiments.monte_carlo_study import (
    load_results,
    monte_carlo,
    runner,
    summarise_monte_carlo,
)
from slamgym.experiments.monte_carlo_study.looks import (
    Look,
    Watch,
    _Shown,
    error_rate_after,
    verdict_of,
    watched,
)
from slamgym.experiments.monte_carlo_study.runner import python_call
from slamgym.experiments.monte_carlo_study.verdict import scores_of

JOB = {"scenario": "six_landmarks", "estimators": "ekf,invariant", "block_size": 16}
MOST = 160


def honest(rng, runs, steps=12, memory=0.9):
    error, nees = rng.standard_normal((runs, 3)), []
    for _ in range(steps):
        fresh = rng.standard_normal((runs, 3))
        error = memory * error + np.sqrt(1 - memory**2) * fresh
        nees.append((error**2).sum(axis=1))
    return np.stack(nees, axis=1)


def verdict(nees, *looks, failed=(), landmarks=None):
    seen = [Look(0, runs, until) for runs, until in looks]
    results = simulated(nees, seen, failed, landmarks)
    return verdict_of(scores_of(results, "mine", "invariant"), "invariant")


@pytest.fixture(scope="module")
def decided():
    return monte_carlo(**JOB, runs=MOST, until="decided")


# run until decided


def test_a_study_until_decided_ends_with_the_block_that_decides(decided):
    runs = decided.sizes["run"]
    assert 30 <= runs < MOST
    assert runs % JOB["block_size"] == 0
    entries = summarise_monte_carlo(decided)["estimators"]
    assert entries["ekf"]["verdict"] == "not consistent"
    assert entries["invariant"]["verdict"] == "consistent"
    after = entries["invariant"]["sequential"]["shown_after"]
    assert runs - JOB["block_size"] < after <= runs
    assert f"after {after} runs" in entries["invariant"]["sentence"]
    assert "e = " in entries["invariant"]["sentence"]


def test_its_results_are_those_of_a_study_of_as_many_runs(decided):
    xr.testing.assert_equal(decided, monte_carlo(**JOB, runs=decided.sizes["run"]))


def test_it_runs_the_same_runs_with_any_number_of_workers(decided):
    for jobs in (2, 3):
        found = monte_carlo(
            **JOB, runs=MOST, until="decided", jobs=jobs, backend="threading"
        )
        xr.testing.assert_identical(found, decided)


@pytest.mark.slow
def test_it_runs_the_same_runs_in_processes_of_loky(decided):
    found = monte_carlo(**JOB, runs=MOST, until="decided", jobs=2, backend="loky")
    xr.testing.assert_identical(found, decided)


def test_an_interrupted_study_until_decided_continues(decided, tmp_path):
    def stop(done, _):
        if done >= 32:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        monte_carlo(**JOB, runs=MOST, until="decided", out=tmp_path, progress=stop)
    assert "looks" not in json.loads((tmp_path / "job.json").read_text("utf-8"))
    told = []
    with monte_carlo(
        **JOB,
        runs=MOST,
        until="decided",
        out=tmp_path,
        progress=lambda *done: told.append(done),
    ) as found:
        xr.testing.assert_equal(found, decided)
        assert found.attrs["until"] == "decided"
        assert "looks" not in found.attrs
    assert {most for _, most in told} == {MOST}
    assert told[0] == (16, MOST)


def test_a_study_that_is_not_decided_ends_with_its_runs():
    found = monte_carlo(**JOB, runs=20, until="decided")
    assert found.sizes["run"] == 20
    entry = summarise_monte_carlo(found)["estimators"]["invariant"]
    assert entry["verdict"] == "not shown"
    assert "30 runs or more are needed" in entry["sentence"]


def test_the_python_call_of_a_study_until_decided_repeats_it(decided):
    assert "until='decided'" in python_call(summarise_monte_carlo(decided))


def test_a_misspelt_until_is_refused():
    with pytest.raises(ValueError, match="until must be 'decided'"):
        monte_carlo(**JOB, runs=4, until="done")


def test_runs_that_all_fail_are_not_repeated_for_ever():
    watch = Watch()
    watch.update(np.full((16, 5), np.nan), np.zeros(16, dtype=bool), 1)
    assert not watch.decided
    watch.update(np.full((16, 5), np.nan), np.zeros(16, dtype=bool), 1)
    assert watch.decided


def test_a_watch_counts_failed_runs_in_the_number_after_which_it_decides():
    nees = np.insert(100 * honest(np.random.default_rng(0), 10), 0, np.nan, axis=1)
    watch = Watch()
    watch.update(nees, np.arange(10) >= 4, 1)
    assert watch.rejected_after == 5


# the map


def some_landmarks(rng, runs, count=6):
    errors = rng.standard_normal((runs, count, 2))
    errors[rng.random((runs, count)) < 0.2] = np.nan
    return errors


UNTIL = 10, "decided"


def test_a_verdict_without_a_map_states_that_it_covers_the_pose_only():
    found = verdict(honest(np.random.default_rng(20), 200), UNTIL)
    assert found.word == "consistent"
    assert found.reason.endswith("; this covers the pose only")


def test_a_verdict_with_a_map_shows_the_ratios_of_pose_and_map():
    rng = np.random.default_rng(20)
    found = verdict(honest(rng, 200), UNTIL, landmarks=some_landmarks(rng, 200))
    assert found.word == "consistent"
    assert "no anytime-valid test rejects pose or map (e" in found.reason
    assert "lies inside [0.8, 1.25], as does that of the map, [" in found.reason
    assert "pose only" not in found.reason


@pytest.mark.parametrize("wrong", [lambda e: 1.6 * e, lambda e: e + 1.1])
def test_a_wrong_map_beside_a_correct_pose_is_rejected_as_the_map(wrong):
    rng = np.random.default_rng(21)
    nees, landmarks = honest(rng, 60), wrong(some_landmarks(rng, 60))
    for looks in ([UNTIL], [(4, "")]):
        found = verdict(nees, *looks, landmarks=landmarks)
        assert found.word == "not consistent"
        assert found.by_map
        assert "rejects the map: " in found.reason or "rejected it" in found.reason


def test_a_wrong_pose_beside_a_wrong_map_is_rejected_for_both():
    rng = np.random.default_rng(22)
    landmarks = 2 * some_landmarks(rng, 60)
    found = verdict(2 * honest(rng, 60), UNTIL, landmarks=landmarks)
    assert found.word == "not consistent"
    assert not found.by_map
    assert "the squared errors of the pose are " in found.reason
    assert "; of the map, the squared errors are 4" in found.reason


def test_a_study_is_not_decided_before_the_map_is():
    rng = np.random.default_rng(23)
    nees, landmarks = honest(rng, 100, memory=0.0), some_landmarks(rng, 100)
    landmarks[:80] = np.nan  # no map
    found = verdict(nees, UNTIL, landmarks=landmarks)
    assert found.word == "not shown"
    assert "that of the map, [0.000, inf], does not: more runs are" in found.reason
    assert verdict(nees, UNTIL).word == "consistent"
    more = np.concatenate([landmarks, some_landmarks(rng, 200)])
    longer = np.concatenate([nees, honest(rng, 200, memory=0.0)])
    scores = scores_of(simulated(longer, landmarks=more), "mine", "invariant")
    assert watched(scores, "invariant").shown_after >= 80 + 30


def test_a_map_without_a_nees_is_not_shown_to_be_consistent():
    rng = np.random.default_rng(24)
    nees, landmarks = honest(rng, 200), some_landmarks(rng, 200)
    landmarks[3, 2] = np.inf
    found = verdict(nees, UNTIL, landmarks=landmarks)
    assert found.word == "not shown"
    assert "the map has no NEES at the end of 1 run: its covariance" in found.reason


def test_runs_that_have_no_nees_of_the_map_are_not_repeated_for_ever():
    rng = np.random.default_rng(25)
    nees, landmarks = honest(rng, 200), np.full((200, 6, 2), np.inf)
    scores = scores_of(simulated(nees, landmarks=landmarks), "mine", "invariant")
    assert watched(scores, "invariant").decided
    chosen = verdict(nees, landmarks=landmarks)
    found = verdict(nees, UNTIL, landmarks=landmarks)
    assert found.word == chosen.word == "consistent"
    for each in found, chosen:
        assert each.reason.endswith("; this covers the pose only")


def test_a_wrong_map_that_a_later_verdict_shows_is_rejected():
    rng = np.random.default_rng(26)
    nees, landmarks = honest(rng, 200), 1.35 * some_landmarks(rng, 200)
    few = verdict(nees[:4], landmarks=landmarks[:4])
    assert few.word == "not shown"
    assert "the map" not in few.reason  # while the pose is not shown
    found = verdict(nees, (4, ""), (8, ""), landmarks=landmarks)
    assert found.word == "not consistent"
    assert "an anytime-valid test rejects the map: " in found.reason


def test_a_first_verdict_that_rejects_the_map_stands():
    rng = np.random.default_rng(30)
    nees, landmarks = honest(rng, 400), some_landmarks(rng, 400)
    landmarks[:25] *= 1.3
    found = verdict(nees, (25, ""), landmarks=landmarks)
    assert found.word == "not consistent"
    assert found.by_map
    assert "the first verdict, after 25 runs, rejected it" in found.reason
    assert verdict(nees, (25, "decided"), landmarks=landmarks).word == "consistent"


def test_a_small_error_of_the_pose_is_no_excuse_for_a_wrong_map():
    rng = np.random.default_rng(28)
    nees, landmarks = 1.1 * honest(rng, 1500), some_landmarks(rng, 1500)
    found = verdict(nees, UNTIL, landmarks=landmarks)
    assert found.word == "nearly consistent"
    assert "as does that of the map, [" in found.reason
    few = landmarks.copy()
    few[10:] = np.nan
    assert verdict(nees, UNTIL, landmarks=few).word == "not consistent"
    found = verdict(nees, UNTIL, landmarks=1.3 * landmarks)
    assert found.word == "not consistent"
    assert not found.by_map


def test_honest_studies_of_pose_and_map_are_rarely_rejected_at_any_look():
    rng, rejected, studies = np.random.default_rng(29), 0, 100
    for _ in range(studies):
        results = simulated(honest(rng, 60), landmarks=some_landmarks(rng, 60))
        watch = watched(scores_of(results, "mine", "invariant"), "invariant")
        rejected += watch.rejected_after is not None
    assert stats.binom.sf(rejected - 1, studies, 0.05) > 1e-3


WRONG_MAPS = """
from slamgym import Belief
from slamgym.estimator.filters.ekf import InvariantEkfSlam


class Alone(InvariantEkfSlam):
    def predict(self, odometry, dt=1.0):  # not in a batch, which has its own belief
        super().predict(odometry, dt)


class Scaled(Alone):
    def belief(self, landmark_ids=None):
        own = super().belief(landmark_ids)
        covariance = own.covariance.copy()
        covariance[3:] *= 0.1
        covariance[:, 3:] *= 0.1
        return Belief(own.mean, covariance, own.landmark_ids, own.frame)


class Shifted(Alone):
    def belief(self, landmark_ids=None):
        own = super().belief(landmark_ids)
        mean = own.mean.copy()
        mean[3::2] += 0.2
        return Belief(mean, own.covariance, own.landmark_ids, own.frame)
"""


@pytest.mark.parametrize("name", ["Scaled", "Shifted"])
def test_a_filter_with_a_wrong_map_is_rejected_within_few_runs(
    name, tmp_path, monkeypatch
):
    (tmp_path / "wrong_maps.py").write_text(WRONG_MAPS)
    monkeypatch.syspath_prepend(tmp_path)
    label = f"wrong_maps:{name}"
    found = monte_carlo("anchored", label, runs=60, until="decided", block_size=4)
    assert found.sizes["run"] <= 8
    entry = summarise_monte_carlo(found)["estimators"][label]
    assert entry["verdict"] == "not consistent"
    assert entry["sequential"]["map_e_value"] > 200
    of_all = entry["sequential"]["e_value"]
    assert name == "Scaled" or of_all < entry["sequential"]["map_e_value"] / 5
    assert "an anytime-valid test rejects the map: " in entry["sentence"]
    assert entry["diagnosis"]["cause"] == "map"
    assert not entry["accepted"]


def test_a_study_that_is_rejected_has_the_2_runs_that_a_report_needs():
    watch = Watch()
    nees = np.insert(100 * honest(np.random.default_rng(0), 2), 0, np.nan, axis=1)
    watch.update(nees[:1], np.ones(1, dtype=bool), 1)
    assert watch.rejected_after == 1
    assert not watch.decided
    watch.update(nees[1:], np.ones(1, dtype=bool), 1)
    assert watch.decided


# extend a folder


def test_a_first_verdict_is_that_of_a_study_without_a_folder(tmp_path):
    with monte_carlo(**JOB, runs=32, out=tmp_path) as found:
        first = summarise_monte_carlo(found)
    assert first == summarise_monte_carlo(monte_carlo(**JOB, runs=32))
    assert "sequential" not in first["estimators"]["ekf"]


def test_a_folder_counts_its_looks_and_a_repeated_one_once(tmp_path, monkeypatch):
    for runs in (16, 32, 32, 48):
        monte_carlo(**JOB, runs=runs, out=tmp_path).close()
    entry = summarise_monte_carlo(load_results(tmp_path))["estimators"]["invariant"]
    assert entry["sequential"]["earlier_looks"] == [16, 32]
    assert "look 3, after verdicts on 16 and 32 runs" in entry["sentence"]
    with monte_carlo(**JOB, runs=48, out=tmp_path) as again:
        assert summarise_monte_carlo(again)["estimators"]["invariant"] == entry
    counted = []
    monkeypatch.setattr(runner, "error_rate_after", counted.extend)
    with monte_carlo(**JOB, runs=48, first_run=16, out=tmp_path) as later:
        assert "looks" not in later.attrs  # the others began with other runs
    assert counted == []
    assert json.loads((tmp_path / "job.json").read_text())["looks"][-1] == [16, 48, ""]
    with monte_carlo(**JOB, runs=48, out=tmp_path, fresh=True) as fresh:
        assert "looks" not in fresh.attrs


@pytest.mark.parametrize("damaged", ["3", '[[0, "x", ""]]', "[[1, 2]]", "null"])
def test_damaged_looks_are_refused_in_one_sentence(damaged, tmp_path):
    monte_carlo(**JOB, runs=4, out=tmp_path).close()
    file = tmp_path / "job.json"
    table = json.loads(file.read_text("utf-8")) | {"looks": json.loads(damaged)}
    file.write_text(json.dumps(table), encoding="utf-8")
    with pytest.raises(ValueError, match=r"job\.json is damaged: looks must be"):
        monte_carlo(**JOB, runs=8, out=tmp_path)


@pytest.mark.parametrize(
    ("looks", "rate"),
    [((), 0.05), (("",), 0.01), (("decided",), 0.05), (("", "decided"), 0.01),
     (("decided", ""), 0.05)],
)  # fmt: skip
def test_only_a_first_verdict_on_a_chosen_number_of_runs_takes_from_the_rate(
    looks, rate
):
    every = [Look(0, 50 * k, until) for k, until in enumerate(looks, start=1)]
    assert error_rate_after(every) == rate


def test_an_honest_folder_that_is_extended_five_times_is_rarely_refused():
    rng, refused, sizes = np.random.default_rng(12), 0, (20, 30, 45, 70, 100, 150)
    studies = 120
    for _ in range(studies):
        nees = honest(rng, sizes[-1])
        looks = [(runs, "") for runs in sizes[:-1]]
        word = verdict(nees, *looks).word
        refused += word in ("not consistent", "nearly consistent")
    assert stats.binom.sf(refused - 1, studies, 0.05) > 1e-3


def test_a_first_verdict_that_rejects_stands_however_many_runs_agree():
    nees = honest(np.random.default_rng(6), 400)
    nees[:25] *= 1.3
    assert verdict(nees[:25]).word == "not consistent"
    found = verdict(nees, (25, ""))
    assert found.word == "nearly consistent"
    assert "the first verdict, after 25 runs, rejected it" in found.reason
    assert verdict(nees, (25, "decided")).word == "consistent"


def test_a_wrong_filter_is_rejected_by_a_later_verdict():
    nees = 1.4 * honest(np.random.default_rng(6), 200)
    found = verdict(nees, (4, ""), (8, ""))
    assert found.word == "not consistent"
    assert "an anytime-valid test rejects it (e " in found.reason


def test_a_rejection_counts_more_than_an_acceptance():
    rng = np.random.default_rng(7)
    nees = np.concatenate([honest(rng, 150), 1.6 * honest(rng, 250)])
    assert verdict(nees[:150], (10, "decided")).word == "consistent"
    assert verdict(nees, (10, "decided")).word == "not consistent"


def test_failed_runs_forbid_consistency_at_later_looks_too():
    nees = honest(np.random.default_rng(8), 200)
    found = verdict(nees, (50, ""), failed=[3])
    assert found.word == "not shown"
    assert found.reason.startswith("1 of 200 runs failed; of the others, after ")


def test_the_interval_in_the_sentence_is_the_first_inside_the_margin_else_the_last():
    nees, shown = honest(np.random.default_rng(9), 300), _Shown()
    ratios = nees.mean(axis=1) / 3
    low, high = ConfidenceSequence().update(ratios)
    least, most = EQUIVALENCE_MARGIN
    first = int(((least <= low) & (high <= most)).argmax())
    for runs in np.array_split(np.arange(300), 9):
        shown.update(ratios[runs], runs + 1)
        at = min(first, runs[-1])
        assert shown.interval == (low[at], high[at])
        assert shown.after == (None if at < first else first + 1)
    assert f"{shown.text()}, lies inside" in verdict(nees, (40, "")).reason
