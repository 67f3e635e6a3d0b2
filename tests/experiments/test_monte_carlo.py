"""The Monte Carlo runner: same bits however it is run, and what it says of rubbish."""

import errno
import json
import resource
import signal
import socket
import subprocess
import sys
import time
import tracemalloc
import zipfile

import forked
import jobs_to_kill
import netCDF4
import numpy as np
import psutil
import pytest
import xarray as xr
from comparison import tree

from slamgym.estimator import Belief, EkfSlam, make_estimator
from slamgym.evaluation import AssociationScores, Gospa, oracle_errors
from slamgym.experiments.command_line.commands import (
    LostSchedulerError,
    _naming_interrupts,
    terminable,
)
from slamgym.experiments.command_line.monte_carlo import connected
from slamgym.experiments.monte_carlo_study import (
    filtered_runs,
    monte_carlo,
    run_measures,
    runner,
    summarise_monte_carlo,
    verdict,
)
from slamgym.experiments.monte_carlo_study.report import html_report, measures
from slamgym.experiments.monte_carlo_study.results import load_results, merge_blocks
from slamgym.experiments.monte_carlo_study.run_measures import (
    HIDDEN_VARIABLES,
    VARIABLES,
    Variable,
    identified,
)
from slamgym.experiments.monte_carlo_study.runner import python_call
from slamgym.experiments.monte_carlo_study.summary import share
from slamgym.experiments.run_and_replay.filter_settings import (
    estimator_choices,
    settings_for_scenario,
)
from slamgym.experiments.run_and_replay.simulated_runs import simulate_runs
from slamgym.sim_configs import load_scenario

RUNS = 20
WORLD = load_scenario("six_landmarks")


class OneByOne(EkfSlam):
    """The textbook filter, with a method of its own, so that it does not batch."""

    def belief(self):
        return super().belief()


class CrashesAtTimes(OneByOne):
    """Fails in the runs that start left of the origin."""

    def update(self, measurements, landmark_ids=None):
        report = super().update(measurements, landmark_ids)
        if self.belief().landmarks[0, 0] < 2.9:
            raise RuntimeError("a wheel came off")
        return report


class Associates:
    """An estimator with an association of its own, hidden in another class."""

    def __init__(self, **options):
        slam = make_estimator("ekf", **options, management=True)
        for name in ("reset", "predict", "belief", "state_dict", "load_state_dict"):
            setattr(self, name, getattr(slam, name))
        self._slam = slam

    def update(self, measurements, landmark_ids=None):
        return self._slam.update(measurements, landmark_ids)


class SaysNothing(Associates):
    """The same, with reports that name no rows."""

    def update(self, measurements, landmark_ids=None):
        return super().update(measurements, landmark_ids).replace(row_ids=())


@pytest.fixture(scope="module")
def whole():
    return monte_carlo("six_landmarks", "ekf,invariant", RUNS, block_size=8)


def test_results_have_every_variable_and_say_where_they_come_from(whole):
    assert set(whole.data_vars) == set(VARIABLES)
    assert whole.pose_nees_invariant.shape == (2, RUNS, 30)
    assert whole.landmark_error.shape == (2, RUNS, 6)
    assert whole.attrs["seed"] == 0
    assert load_scenario("six_landmarks").name in whole.attrs["scenario"]
    assert not whole.failed.any()
    assert np.isfinite(whole.nis).all()


def test_a_run_depends_on_its_seed_alone(whole):
    few = monte_carlo("six_landmarks", ["invariant"], 3, block_size=2)
    xr.testing.assert_equal(few, whole.sel(estimator=["invariant"], run=slice(0, 2)))
    later = monte_carlo("six_landmarks", ["ekf"], 2, seed=5)
    xr.testing.assert_equal(
        later.drop_vars("run"),
        whole.sel(estimator=["ekf"], run=slice(5, 6)).drop_vars("run"),
    )
    part = monte_carlo("six_landmarks", ["ekf"], 7, block_size=2, first_run=4)
    xr.testing.assert_equal(part, whole.sel(estimator=["ekf"], run=slice(4, 6)))


@pytest.mark.slow
@pytest.mark.parametrize("backend", ["loky", "threading"])
def test_workers_change_no_bit(whole, backend):
    shared = monte_carlo(
        "six_landmarks", "ekf,invariant", RUNS, block_size=8, jobs=2, backend=backend
    )
    xr.testing.assert_equal(shared, whole)


def test_a_filter_that_cannot_batch_gives_the_same_numbers(whole):
    single = monte_carlo("six_landmarks", {"ekf": OneByOne}, 4)
    xr.testing.assert_equal(single, whole.sel(estimator=["ekf"], run=slice(0, 3)))


@pytest.fixture(scope="module")
def hidden():
    world = load_scenario("hidden_identities").with_changes(steps=40)
    managed = {"management": {"association": "hypotheses", "confirm": (2, 3)}}
    options = {"default": "invariant", "managed": ("invariant", managed)}
    return monte_carlo(world, options, 3, block_size=2)


def test_readings_without_identity_are_associated_and_scored(hidden):
    assert set(hidden.data_vars) == set(HIDDEN_VARIABLES)
    assert not hidden.failed.any()
    for which in ("raw", "aligned"):
        parts = sum(hidden[f"gospa_{which}_{p}"] for p in ("localisation", "missed"))
        whole = parts + hidden[f"gospa_{which}_false"]
        np.testing.assert_allclose(hidden[f"gospa_{which}_distance"] ** 2, whole)
    assert (hidden.association_map_size <= 20).all()
    assert (hidden.association_precision > 0.9).all()
    assert (hidden.association_new_correct > 2).all()
    assert np.isfinite(hidden.landmark_rmse).all()


def test_bad_runs_are_told_by_the_same_filter_with_known_identities(hidden):
    known = load_scenario("hidden_identities").with_changes(
        steps=40, sensor={"identities": True, "clutter": 0.0, "max_clutter": 0}
    )
    twin = monte_carlo(known, "invariant", 3)
    twin = twin.sel(estimator="invariant")
    for label in hidden.estimator.values:
        one = hidden.sel(estimator=label)
        np.testing.assert_allclose(one.known_ids_ate, twin.ate, rtol=1e-12)
        nees = twin.pose_nees_invariant
        np.testing.assert_allclose(one.known_ids_nees_invariant, nees, rtol=1e-9)


def test_the_summary_holds_the_scores_of_association(hidden):
    entry = summarise_monte_carlo(hidden)["estimators"]["managed"]
    scores, row = entry["association"], hidden.sel(estimator="managed")
    for name in (*AssociationScores._fields, "precision", "recall"):
        assert scores[name] == pytest.approx(float(row[f"association_{name}"].mean()))
    for part in Gospa._fields:
        expected = float(row[f"gospa_aligned_{part}"].mean())
        assert scores["gospa"]["aligned"][part] == pytest.approx(expected)
    assert scores["median_ate"]["hidden"] == float(row.ate.median())
    assert scores["median_ate"]["known"] == float(row.known_ids_ate.median())
    assert json.loads(json.dumps(entry, allow_nan=False)) == entry


def test_runs_worse_by_a_metre_than_with_known_identities_and_failed_ones_are_bad(
    hidden,
):
    results = hidden.copy(deep=True)
    results["ate"].loc[{"estimator": "managed", "run": 0}] = 1.1 + float(
        results.known_ids_ate.sel(estimator="managed", run=0)
    )
    results["failed"].loc[{"estimator": "managed", "run": 1}] = True
    summary = summarise_monte_carlo(results)
    bad = summary["estimators"]["managed"]["association"]["bad_runs"]
    assert bad == {"count": 2, "share": 2 / 3, "margin": 1.0}
    assert summary["estimators"]["default"]["association"]["bad_runs"]["count"] == 0


def test_the_mistakes_that_a_diagnosis_counts_are_those_that_bend_a_map(hidden):
    results = hidden.copy(deep=True)
    names = "wrong", "duplicate", "ghost", "clutter_used", "missed", "correct"
    for k, name in enumerate(names):
        results[f"association_{name}"][:] = 2.0**k
    scores = verdict.scores_of(results, "managed", "invariant")
    np.testing.assert_array_equal(verdict._mistakes(scores), 15.0)


def test_alarms_are_counted_among_bad_and_other_runs(hidden):
    results = hidden.copy(deep=True)
    assert (hidden.probably_lost.sel(estimator="managed") == 0).all()
    at = {"estimator": "managed"}
    for run, (excess, alarm) in enumerate([(1.1, 1.0), (0.0, 1.0), (1.1, 0.0)]):
        where = at | {"run": run}
        results["ate"].loc[where] = excess + float(results.known_ids_ate.sel(where))
        results["probably_lost"].loc[where] = alarm
    summary = summarise_monte_carlo(results)
    found = summary["estimators"]["managed"]["association"]["alarm"]
    assert found == {"count": 2, "share": 2 / 3, "runs": 3, "found": 1, "bad": 2}
    (row,) = (m for m in measures(summary) if m.path == "association.alarm")
    assert row.of(summary["estimators"]["managed"]) == "1 of 2, 1 of 1"
    results["probably_lost"].loc[at] = np.nan
    summary = summarise_monte_carlo(results)
    assert summary["estimators"]["managed"]["association"]["alarm"] is None


def test_precision_is_compared_with_that_of_true_pose_and_map():
    world = load_scenario("hidden_identities").with_changes(
        steps=30, sensor={"std": (0.3, 0.8)}
    )
    results = monte_carlo(world, "invariant", 2)
    runs = simulate_runs(world, 2, seed=0)
    for run, landmarks in enumerate(runs.landmarks):
        ids = runs.true_ids[run]
        z = [m[i >= 0] for m, i in zip(runs.measurements[run], ids, strict=True)]
        scans = z, [i[i >= 0] for i in ids]
        world = np.arange(len(landmarks)), landmarks, (0.3, 0.8)
        expected = oracle_errors(runs.true_poses[run], *scans, *world)
        found = float(results.association_oracle_errors[0, run])
        assert 0.01 < expected == pytest.approx(found)
    summary = summarise_monte_carlo(results)
    entry = summary["estimators"]["invariant"]
    mean = float(results.association_oracle_errors.mean())
    assert entry["association"]["oracle_errors"] == pytest.approx(mean)
    (row,) = (m for m in measures(summary) if m.name == "… with true pose and map")
    assert row.of(entry) == share(1 - mean)


def test_a_report_shows_association_only_where_identities_are_hidden(hidden, whole):
    rows = [measure.name for measure in measures(summarise_monte_carlo(hidden))]
    assert {"precision", "recall", "… duplicates"} <= set(rows)
    known = {measure.name for measure in measures(summarise_monte_carlo(whole))}
    assert not {"precision", "recall"} & known


@pytest.mark.usefixtures("_no_figures_in_reports")
def test_the_page_shows_association_and_says_what_a_bad_run_is(hidden):
    page = html_report(hidden, summarise_monte_carlo(hidden))
    assert "precision" in page
    assert "above that of the same filter with known identities" in page


def test_landmarks_nearer_than_the_resolution_are_one_place():
    world = load_scenario("hidden_identities").with_changes(
        steps=20, sensor={"std": (0.3, 0.8)}
    )
    coarse = monte_carlo(world, "ekf", 1, resolution=100.0)
    assert coarse.association_true_map_size.item() == 1
    assert coarse.association_new_correct.item() == 1
    assert coarse.association_duplicate.item() == coarse.association_map_size - 1 > 2
    assert coarse.association_oracle_errors.item() == 0
    assert coarse.attrs["resolution"] == 100.0
    assert "    resolution=100.0,\n" in python_call(summarise_monte_carlo(coarse))


def test_an_estimator_that_associates_by_itself_is_scored_by_its_reports():
    world = load_scenario("hidden_identities").with_changes(steps=20)
    unmanaged = {"management": False}
    own = {"own": (Associates, unmanaged), "silent": (SaysNothing, unmanaged)}
    results = monte_carlo(world, own, 1)
    assert not results.failed.any()
    own, silent = (results.sel(estimator=label, run=0) for label in ("own", "silent"))
    assert own.association_correct > 20
    assert np.isnan(silent.association_correct)
    assert np.isnan(silent.landmark_rmse)


def test_the_ideal_filter_is_told_the_truth():
    results = monte_carlo("six_landmarks", "ideal", 2)
    assert not results.failed.any()


def test_a_crash_ends_its_own_run_only():
    results = monte_carlo(
        "six_landmarks", {"fragile": CrashesAtTimes, "ekf": "ekf"}, RUNS
    )
    failed = results.failed.sel(estimator="fragile")
    assert 0 < failed.sum() < RUNS
    assert not results.failed.sel(estimator="ekf").any()
    first = int(failed.values.argmax())
    row = results.sel(estimator="fragile", run=first)
    assert str(row.message.values) == "RuntimeError: a wheel came off"
    assert np.isnan(row.pose_nees_invariant[int(row.failed_at) :]).all()
    sound = np.flatnonzero(~failed.values)
    xr.testing.assert_equal(
        results.isel(estimator=0, run=sound).drop_vars("estimator"),
        results.isel(estimator=1, run=sound).drop_vars("estimator"),
    )


def test_a_run_that_a_batch_stops_says_why():
    blind = WORLD.with_changes(
        start={"std": (0, 0, 0)}, motion={"std": (0, 0, 0)}, sensor={"std": (0, 0)}
    )
    results = monte_carlo(blind, "ekf", 2)
    assert results.failed.all()
    assert "not positive definite" in str(results.message[0, 0].values)


def test_the_filters_may_be_told_another_noise(whole):
    wrong = WORLD.with_changes(motion={"std": (0.025, 0.01, 0.01)})
    told = monte_carlo("six_landmarks", "invariant", RUNS, assumed=wrong)
    right = whole.sel(estimator=["invariant"])
    assert (told.pose_area < right.pose_area).all()
    assert told.nis.mean() > 2 * right.nis.mean()


def test_results_on_disk_are_those_in_memory(whole, tmp_path):
    with monte_carlo(
        "six_landmarks", "ekf,invariant", RUNS, block_size=8, out=tmp_path, command="me"
    ) as written:
        xr.testing.assert_equal(written.load(), whole)
        assert written.attrs["command"] == "me"
        assert written.failed.dtype == bool
        for name in whole.data_vars:
            assert written[name].attrs == whole[name].attrs, name


@pytest.mark.slow
def test_more_runs_build_on_those_there_are(whole, tmp_path):
    job = {"estimators": "ekf,invariant", "block_size": 8, "out": tmp_path}
    monte_carlo("six_landmarks", runs=12, **job).close()
    first = tmp_path / "blocks" / "runs-0000000-0000008.npz"
    before = first.stat().st_mtime_ns
    short = tmp_path / "blocks" / "runs-0000008-0000012.npz"
    content = short.read_bytes()
    with monte_carlo("six_landmarks", runs=RUNS, **job) as more:
        xr.testing.assert_equal(more.load(), whole)
    assert first.stat().st_mtime_ns == before
    names = sorted(file.name for file in (tmp_path / "blocks").iterdir())
    blocks = ((0, 8), (8, 16), (16, 20))
    assert names == [f"runs-{a:07d}-{b:07d}.npz" for a, b in blocks]
    short.write_bytes(content)  # as a merge may: the longer block counts
    with monte_carlo("six_landmarks", runs=18, **job) as fewer:
        xr.testing.assert_equal(fewer.load(), whole.isel(run=slice(0, 18)))


def test_only_parts_of_one_job_are_merged(tmp_path):
    monte_carlo("six_landmarks", "ekf", 1, out=tmp_path / "a").close()
    monte_carlo("loop", "ekf", 1, out=tmp_path / "b").close()
    with pytest.raises(ValueError, match="b holds results of scenario"):
        merge_blocks([tmp_path / "a", tmp_path / "b"], tmp_path / "c")
    with pytest.raises(ValueError, match="at least one folder"):
        merge_blocks([], tmp_path / "c")
    (block,) = (tmp_path / "a" / "blocks").iterdir()
    block.write_bytes(block.read_bytes()[:-9])
    with pytest.raises(ValueError, match="truncated"):
        merge_blocks([tmp_path / "a"], tmp_path / "c")
    with pytest.raises(ValueError, match="first_run must be a multiple"):
        monte_carlo("six_landmarks", "ekf", 20, first_run=5)
    with pytest.raises(ValueError, match="of block_size = 10 below runs = 20"):
        monte_carlo("six_landmarks", "ekf", 20, first_run=20, block_size=10)


@pytest.mark.usefixtures("own_registry")
def test_a_filter_of_a_notebook_runs_and_is_known_by_its_methods(tmp_path, monkeypatch):
    monkeypatch.delattr(sys.modules["__main__"], "__file__", raising=False)

    def written(factor):  # classes without a file, as in a notebook
        cell = {"EkfSlam": EkfSlam, "__name__": "__main__"}
        exec(
            "class Cautious(EkfSlam):\n"
            "    def predict(self, odometry, dt=1.0):\n"
            f"        super().predict(odometry, {factor} * dt)\n",
            cell,
        )
        return {"cautious": cell["Cautious"]}

    for _ in range(2):
        monte_carlo("six_landmarks", written(2), 2, out=tmp_path / "out").close()
    with pytest.raises(ValueError, match="holds results of code"):
        monte_carlo("six_landmarks", written(3), 2, out=tmp_path / "out")


@pytest.mark.usefixtures("own_registry")
def test_a_label_does_not_replace_the_class_it_is_given_to():
    class Mine(EkfSlam):
        pass

    noise = {"motion_std": (0, 0, 0), "measurement_std": (0.1, 0.1)}
    (choice,) = estimator_choices({"invariant": Mine})
    assert isinstance(make_estimator(choice.name, **noise), Mine)
    assert not isinstance(make_estimator("invariant", **noise), Mine)


def test_a_filter_that_has_changed_is_not_mixed_with_what_it_was(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(tmp_path)
    source = tmp_path / "changing_filter.py"
    text = "from slamgym.estimator import EkfSlam\nclass Mine(EkfSlam):\n    pass\n"
    source.write_text(text)
    asked = ("six_landmarks", "changing_filter:Mine", 2)
    monte_carlo(*asked, out=tmp_path / "out").close()
    monte_carlo(*asked, out=tmp_path / "out").close()
    source.write_text(text + "# repaired\n")
    with pytest.raises(ValueError, match=r"of code .*folder \(out\), .*\(fresh\)"):
        monte_carlo(*asked, out=tmp_path / "out")
    done, note = [], lambda runs, of: done.append(runs)
    monte_carlo(*asked, out=tmp_path / "out", fresh=True, progress=note).close()
    assert done == [0, 2]


class ForeignIds(OneByOne):
    """Names a landmark that there is not, in some of the runs."""

    def belief(self):
        belief = super().belief()
        ids = belief.landmark_ids
        if belief.mean[0] < 7:
            ids = (106, *ids[1:])
        return Belief(belief.mean, belief.covariance, ids)


class LeavesTheProgram(OneByOne):
    def update(self, measurements, landmark_ids=None):
        raise SystemExit(3)


class UnknownMap(OneByOne):
    """Its map's covariance is not a number."""

    def belief(self):
        belief = super().belief()
        covariance = belief.covariance.copy()
        covariance[3:, 3:] = np.nan
        return Belief(belief.mean, covariance, belief.landmark_ids)


class Indefinite(OneByOne):
    """Its last landmark has a negative variance."""

    def belief(self):
        belief = super().belief()
        covariance = belief.covariance.copy()
        covariance[-1, -1] *= -1
        return Belief(belief.mean, covariance, belief.landmark_ids)


def test_an_indefinite_map_has_an_infinite_nees():
    results = monte_carlo("six_landmarks", {"wrong": Indefinite}, 2)
    assert not results.failed.any()
    assert np.isinf(results.relative_map_nees).all()


def test_of_landmarks_that_show_the_same_one_the_first_counts():
    belief = Belief(np.arange(9.0), np.diag(np.arange(1.0, 10.0)), (4, 7, 9))
    found = identified(belief, {9: 2, 7: 0, 4: 2})
    assert found.landmark_ids == (2, 0)
    np.testing.assert_array_equal(found.landmarks, [[3.0, 4.0], [5.0, 6.0]])
    np.testing.assert_array_equal(found.covariance.diagonal(), np.arange(1.0, 8.0))
    assert identified(belief, {7: 0}).landmark_ids == (0,)


def test_a_batch_fails_in_the_run_whose_final_map_is_not_finite(monkeypatch):
    answers = iter([True, False, True, True])  # of three runs, and of one run again
    monkeypatch.setattr(filtered_runs, "is_finite", lambda belief: next(answers))
    runs = simulate_runs(WORLD.with_changes(steps=6), 3, 0)
    settings = settings_for_scenario(WORLD, estimator="ekf")
    found = filtered_runs.filter_runs(settings, runs)
    assert {run: failure.step for run, failure in found.failures.items()} == {1: 6}
    assert [belief is None for belief in found.beliefs] == [False, True, False]


def test_a_belief_that_is_no_map_of_the_world_ends_its_own_run_only(whole):
    filters = {"foreign": ForeignIds, "gone": LeavesTheProgram, "blind": UnknownMap}
    filters["ekf"] = "ekf"
    results = monte_carlo("six_landmarks", filters, RUNS)
    failed = results.failed.sum("run")
    assert 0 < failed.sel(estimator="foreign") < RUNS
    assert set(results.failed_at.sel(estimator="foreign").values) == {-1, 29}
    assert failed.sel(estimator="gone") == RUNS
    assert failed.sel(estimator="blind") == RUNS
    said = [set(results.message.sel(estimator=name).values) for name in filters]
    assert any("landmark_ids must be distinct and from 0 to 5" in m for m in said[0])
    assert said[1] == {"SystemExit: 3"}
    assert said[2] == {"the belief about the map is not finite"}
    one, other = (each.sel(estimator=["ekf"]) for each in (results, whole))
    xr.testing.assert_equal(one, other)


def test_a_block_that_cannot_be_read_for_now_is_not_touched(tmp_path, monkeypatch):
    job = {"estimators": "ekf", "runs": 2, "out": tmp_path}
    monte_carlo("six_landmarks", **job).close()
    (block,) = (tmp_path / "blocks").iterdir()
    before = block.read_bytes()

    def busy(*_):
        raise OSError(errno.EMFILE, "Too many open files")

    with monkeypatch.context() as patch:
        patch.setattr(zipfile.ZipFile, "testzip", busy)
        with pytest.raises(OSError, match="Too many open files"):
            monte_carlo("six_landmarks", **job)
    assert block.read_bytes() == before


def test_a_disk_that_fills_under_the_results_says_so(tmp_path, monkeypatch):
    def full(*_, **__):
        raise RuntimeError("NetCDF: HDF error")

    monkeypatch.setattr(netCDF4, "Dataset", full)
    with pytest.raises(OSError, match=r"results\.nc cannot be written: .*blocks stay"):
        monte_carlo("six_landmarks", "ekf", 2, out=tmp_path)
    assert list((tmp_path / "blocks").glob("runs-*.npz"))


@pytest.mark.slow
def test_a_job_killed_six_times_ends_with_the_same_bits(whole, tmp_path):
    rng = np.random.default_rng(0)
    blocks = tmp_path / "blocks"
    stood = []
    for _ in range(6):
        before = len(list(blocks.glob("runs-*.npz")))
        job = forked.start(jobs_to_kill.two_filters, tmp_path)
        while job.is_alive() and len(list(blocks.glob("runs-*.npz"))) == before:
            time.sleep(0.001)
        time.sleep(float(rng.uniform(0, 0.004)))  # some time in the next
        job.kill()
        job.join()
        stood.append(len(list(blocks.glob("runs-*.npz"))))
    assert len({count for count in stood if 0 < count < RUNS}) >= 3  # in the middle
    with monte_carlo(
        "six_landmarks", "ekf,invariant", RUNS, block_size=1, out=tmp_path
    ) as resumed:
        xr.testing.assert_equal(resumed.load(), whole)


def test_a_broken_block_is_named_and_done_again(whole, tmp_path):
    job = {"estimators": "ekf,invariant", "block_size": 8, "out": tmp_path}
    monte_carlo("six_landmarks", runs=RUNS, **job).close()
    block = tmp_path / "blocks" / "runs-0000008-0000016.npz"
    block.write_bytes(block.read_bytes()[:-100])
    done, job["progress"] = [], lambda runs, of: done.append(runs)
    with (
        pytest.warns(UserWarning, match=r"runs-0000008-0000016\.npz is truncated"),
        monte_carlo("six_landmarks", runs=RUNS, **job) as mended,
    ):
        xr.testing.assert_equal(mended.load(), whole)
    assert done == [12, RUNS]


def test_a_block_without_a_new_variable_is_refused_and_kept(tmp_path, monkeypatch):
    job = {"estimators": "ekf", "runs": 4, "out": tmp_path}
    monte_carlo("six_landmarks", **job).close()
    before = {file: file.read_bytes() for file in (tmp_path / "blocks").iterdir()}
    newer = {**VARIABLES, "speed": Variable(("run",), "f8", "of the robot")}
    monkeypatch.setattr(run_measures, "VARIABLES", newer)
    with pytest.raises(ValueError, match=r"0004\.npz was written before speed was"):
        monte_carlo("six_landmarks", **job)
    assert {file: file.read_bytes() for file in before} == before


def test_a_truncated_results_file_is_named_and_made_anew(whole, tmp_path):
    job = {"estimators": "ekf,invariant", "block_size": 8, "out": tmp_path}
    monte_carlo("six_landmarks", runs=RUNS, **job).close()
    results = tmp_path / "results.nc"
    results.write_bytes(results.read_bytes()[:5000])
    with pytest.raises(ValueError, match=r"results\.nc is truncated"):
        load_results(tmp_path)
    with (
        pytest.warns(UserWarning, match=r"it is moved to results\.nc\.aside"),
        monte_carlo("six_landmarks", runs=RUNS, **job) as anew,
    ):
        xr.testing.assert_equal(anew.load(), whole)


def test_a_disk_that_is_full_leaves_the_blocks_before(whole, tmp_path):
    signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    job = {"estimators": "ekf,invariant", "block_size": 8, "out": tmp_path}
    monte_carlo("six_landmarks", runs=8, **job).close()
    resource.setrlimit(resource.RLIMIT_FSIZE, (10_000, limits[1]))
    try:
        with pytest.raises(OSError, match="1 complete blocks stay there"):
            monte_carlo("six_landmarks", runs=RUNS, **job)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert len(list((tmp_path / "blocks").iterdir())) == 1
    with monte_carlo("six_landmarks", runs=RUNS, **job) as later:
        xr.testing.assert_equal(later.load(), whole)


@pytest.mark.slow
@pytest.mark.usefixtures("_figures_in_reports_are_blank", "usual_collector")
def test_memory_grows_with_the_block_and_not_with_the_runs(tmp_path, monkeypatch):
    monkeypatch.setattr(verdict, "_AT_ONCE", 8 * 251)
    world = load_scenario("coarse_loop").with_changes(steps=250)

    def peak(runs):
        out = tmp_path / str(runs)
        job = {"block_size": 8, "out": out, "small_noise": True}
        tracemalloc.start()
        with monte_carlo(world, "ekf", runs, **job) as results:
            html_report(results, summarise_monte_carlo(results))
        top = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        return top

    peak(1)
    assert peak(48) < 1.3 * peak(16)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"runs": 0}, "runs must be an integer >= 1, got 0"),
        ({"seed": -1}, "seed must be an integer >= 0"),
        ({"scenario": "lop"}, "did you mean 'loop'"),
        ({"estimators": "invarant"}, "did you mean 'invariant'"),
        ({"estimators": "ekf,ekf"}, "'ekf' twice"),
        ({"estimators": ""}, "must name at least one"),
        ({"estimators": "ekf[iterations"}, "must be like ekf or invariant"),
        ({"estimators": "ekf[speed=3]"}, "has no option 'speed'"),
        ({"jobs": 0}, "jobs must be an integer >= 1"),
        ({"jobs": 2.5}, "jobs must be an integer >= 1"),
        ({"seed": 2**63}, "seed must be"),
        ({"estimators": EkfSlam}, "or labels mapped to classes, got <class"),
        ({"backend": "lokey"}, "did you mean 'loky'"),
        ({"block_size": 0}, "block_size must be"),
        ({"resolution": -1.0}, "resolution must be a number >= 0"),
        ({"assumed": "hidden_identities"}, "must agree with scenario in sensor.ident"),
        ({"scenario": "hidden_identities", "estimators": "ideal"}, "true landmarks"),
    ],
)
def test_what_cannot_be_run_is_refused_before_anything_is_written(
    changes, message, tmp_path
):
    asked = {"scenario": "six_landmarks", "estimators": "ekf", "runs": 2}
    with pytest.raises(ValueError, match=message):
        monte_carlo(**(asked | changes), out=tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_a_folder_of_another_job_is_refused_untouched(tmp_path):
    job = {"scenario": "six_landmarks", "estimators": "ekf", "runs": 2}
    monte_carlo(**job, out=tmp_path, resolution=0.5).close()
    before = tree(tmp_path)
    for changes, message in (
        ({"scenario": "anchored"}, "holds results of scenario .*six_landmarks"),
        ({"estimators": "invariant"}, "estimators ekf, not of estimators invariant"),
        ({"seed": 3}, "seed 0, not of seed 3"),
        ({"resolution": 0.0}, r"resolution 0\.5, not of resolution 0\.0: ch"),
    ):
        with pytest.raises(ValueError, match=message):
            monte_carlo(**(job | {"resolution": 0.5} | changes), out=tmp_path)
    assert tree(tmp_path) == before
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.tex").write_text("years of work")
    with pytest.raises(ValueError, match="holds no Monte Carlo"):
        monte_carlo("six_landmarks", "ekf", 2, out=tmp_path / "mine")


def test_options_may_be_words():
    (choice,) = estimator_choices("ekf[landmark_init=independent,noise_at_rest=false]")
    assert choice.options == {"landmark_init": "independent", "noise_at_rest": False}
    made = choice.settings(WORLD).make((0, 0, 0))
    assert not made.rules.correlated
    assert make_estimator("ekf", motion_std=(0, 0, 0), measurement_std=(0.1, 0.1))


@pytest.mark.slow
def test_a_dask_cluster_that_loses_a_worker_gives_the_same_bits(whole, tmp_path):
    pytest.importorskip("distributed", reason="needs dask.distributed")
    out = tmp_path / "here" / "out"
    out.parent.mkdir()
    job = "six_landmarks -e ekf,invariant --runs 20 --block-size 1 --out out"
    child = forked.start(
        jobs_to_kill.command_that_loses_a_worker,
        out.parent,
        *f"monte-carlo {job} --backend dask --jobs 2".split(),
    )
    child.join(300)
    assert child.exitcode == 0, (tmp_path / "here.messages").read_text()
    assert (tmp_path / "here.victim").exists()
    with load_results(out) as results:
        xr.testing.assert_equal(results.load()[list(whole)], whole)


@pytest.mark.slow
def test_a_dask_cluster_starts_beside_another_without_a_warning():
    pytest.importorskip("distributed", reason="needs dask.distributed")
    with socket.socket() as other:
        if other.connect_ex(("127.0.0.1", 8787)):
            other.bind(("", 8787))  # Dask's usual port
            other.listen()
        with connected("dask", None, 1):
            pass


@pytest.mark.slow
def test_a_dask_cluster_listens_to_this_machine_only():
    distributed = pytest.importorskip("distributed", reason="needs dask.distributed")
    me = psutil.Process()
    before = {each.laddr for each in me.net_connections("tcp")}
    with connected("dask", None, 1):
        processes = [me, *me.children(recursive=True)]
        sockets = {
            each.laddr
            for process in processes
            for each in process.net_connections("tcp")
            if each.status == psutil.CONN_LISTEN
        } - before
        link = distributed.default_client().dashboard_link
    assert any(f":{address.port}/" in link for address in sockets)  # of the dashboard
    assert len(sockets) >= 4  # and of scheduler and worker
    assert {address.ip for address in sockets} == {"127.0.0.1"}


@pytest.mark.slow
def test_a_dask_worker_imports_no_script_of_the_user(tmp_path, monkeypatch):
    distributed = pytest.importorskip("distributed", reason="needs dask.distributed")
    monkeypatch.chdir(tmp_path)
    (tmp_path / "random.py").write_text("raise ImportError('a script of the user')")
    with connected("dask", None, 1):
        assert distributed.default_client().submit(abs, -3).result(timeout=60) == 3


@pytest.mark.slow
def test_a_dask_worker_that_dask_does_not_restart_is_replaced():
    distributed = pytest.importorskip("distributed", reason="needs dask.distributed")
    import dask

    with (
        dask.config.set({"distributed.deploy.lost-worker-timeout": "100ms"}),
        connected("dask", None, 1),
    ):
        client = distributed.default_client()
        (nanny,) = client.cluster.workers.values()
        client.sync(nanny.close)
        assert client.submit(abs, -3).result(timeout=60) == 3


@pytest.mark.slow
def test_a_lost_dask_scheduler_ends_the_wait_for_its_results(tmp_path):
    pytest.importorskip("distributed", reason="needs dask.distributed")
    import dask

    file = tmp_path / "scheduler.json"
    python = f"{sys.executable} -m distributed.cli.dask_scheduler"
    options = f"--port 0 --no-dashboard --host 127.0.0.1 --scheduler-file {file}"
    command = f"{python} {options}".split()
    scheduler = subprocess.Popen(command, stderr=subprocess.DEVNULL)
    # As in a job that a script has begun with "&".
    usual = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        while not file.exists() or not file.read_text().endswith("}"):
            assert scheduler.poll() is None
            time.sleep(0.1)
        address = json.loads(file.read_text())["address"]
        lost = f"the Dask scheduler {address} is lost; what is finished is kept"

        def lose() -> None:
            with terminable(), _naming_interrupts(), connected("dask", address, None):
                scheduler.kill()
                for _ in range(600):  # as joblib waits for results
                    time.sleep(0.1)

        quickly = dask.config.set({"distributed.comm.timeouts.connect": "1s"})
        with quickly, pytest.raises(LostSchedulerError, match=lost):
            lose()
    finally:
        signal.signal(signal.SIGINT, usual)
        scheduler.kill()
        scheduler.wait()


class MyEkf(EkfSlam):
    """A filter of the user."""


def test_estimators_may_be_names_and_classes():
    results = monte_carlo("six_landmarks", ["ekf", MyEkf], 2)
    assert results.estimator.values.tolist() == ["ekf", "MyEkf"]
    same = results.pose_nees_invariant.sel(estimator=["ekf", "MyEkf"]).values
    assert (same[0] == same[1]).all()


class FarAway(OneByOne):
    """Believes to be a thousand kilometres from its map."""

    def belief(self):
        moved = super().belief()
        mean = moved.mean.copy()
        mean[0] += 1e6
        return Belief(mean, moved.covariance, moved.landmark_ids)


def test_a_filter_that_is_far_from_its_map_has_a_score_that_says_so():
    found = monte_carlo("six_landmarks", [FarAway], 2).state_nees_additive.values
    assert (found > 1e9).all()


def test_estimators_that_are_neither_names_nor_classes_are_refused():
    with pytest.raises(ValueError, match="must be names or classes, got 3"):
        monte_carlo("six_landmarks", ["ekf", 3], 2)


@pytest.mark.parametrize(
    "world",
    ["six_landmarks", pytest.param("hidden_identities", marks=pytest.mark.slow)],
)
def test_runs_computed_a_few_at_once_are_those_computed_together(world, monkeypatch):
    scenario = load_scenario(world).with_changes(steps=12)
    together = monte_carlo(scenario, "ekf,robocentric", 5, 300)
    monkeypatch.setattr(runner, "runs_at_once", lambda scenario: 2)
    xr.testing.assert_identical(
        monte_carlo(scenario, "ekf,robocentric", 5, 300), together
    )
