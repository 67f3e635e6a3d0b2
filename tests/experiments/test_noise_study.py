import math
import subprocess
import sys
from dataclasses import replace
from io import StringIO

import numpy as np
import pytest
from recordings import recorded
from rich.console import Console

from slamgym.experiments.command_line.tables import runs_table
from slamgym.experiments.logs.slamlog import Scan
from slamgym.experiments.noise_study import scaled_scenario, study_log, study_scenario
from slamgym.experiments.run_and_replay.filter_settings import (
    SIGMAS,
    FilterSettings,
    settings_for,
)
from slamgym.sim_configs import load_scenario

WORLD = load_scenario("six_landmarks").with_changes(steps=12)


@pytest.fixture(scope="module")
def log():
    return recorded(WORLD, 1)


@pytest.fixture(scope="module")
def of_log(log):
    return study_log(log, settings_for(log))


def test_each_noise_is_changed_alone_both_ways_after_the_reference(of_log):
    changes = [(run.row.sigma, run.row.factor) for run in of_log]
    assert changes[0] == ("none", 1.0)
    assert changes[1:] == [(sigma, k) for sigma in SIGMAS for k in (10.0, 0.1)]


@pytest.mark.parametrize("place", range(5))
def test_scaling_one_sigma_leaves_the_others(place):
    stds = (0.2, 0.1, 0.3, 0.01, 0.08)
    settings = FilterSettings("ekf", stds[:3], stds[3:], (1.0, 2.0, 3.0))
    scaled = settings.scaled(SIGMAS[place], 10)
    ratios = np.array([*scaled.motion_std, *scaled.measurement_std]) / stds
    assert ratios.tolist() == pytest.approx(
        [10.0 if k == place else 1 for k in range(5)]
    )
    assert scaled.initial_pose_std == settings.initial_pose_std


def test_titles_say_what_the_noise_is_then(of_log):
    assert [run.title for run in of_log[:3]] == [
        "unchanged",
        "σx × 10 = 2.5 m",
        "σx ÷ 10 = 0.025 m",
    ]


def test_the_study_of_a_log_changes_the_filter_and_not_the_readings(log, of_log):
    settings = settings_for(log)
    again = study_log(log, settings)
    assert [run.row for run in again] == [run.row for run in of_log]
    for run in of_log:
        np.testing.assert_array_equal(
            run.trace.true_poses[:, :2], log.ground_truth[:, 1:3]
        )


def test_a_filter_that_trusts_its_range_less_ends_with_larger_ellipses(of_log):
    rows = {(run.row.sigma, run.row.factor): run.row for run in of_log}
    reference = rows["none", 1.0]
    wide, narrow = rows["σr", 10.0], rows["σr", 0.1]
    assert narrow.landmark_area < reference.landmark_area < wide.landmark_area
    assert narrow.pose_area < reference.pose_area < wide.pose_area
    assert narrow.nis_per_degree > reference.nis_per_degree > wide.nis_per_degree


def test_the_table_cuts_no_number_at_80_columns(of_log):
    long = dict.fromkeys(of_log[0].row._fields[3:], 0.00123456)
    run = of_log[1]._replace(
        title="σx ÷ 10 = 0.000884 m", row=of_log[1].row._replace(**long)
    )
    console = Console(width=80, file=StringIO())
    console.print(runs_table([run]))
    assert "…" not in console.file.getvalue()


def test_areas_are_those_of_the_final_3_sigma_ellipses(of_log):
    reference = of_log[0]
    trace, row = reference.trace, reference.row
    last = trace.pose_covariances[-1], trace.predicted_pose_covariances[-1]
    *areas, of_pose, predicted = (
        math.pi * math.prod(3 * np.sqrt(np.linalg.eigvalsh(P)))
        for P in (*trace.landmark_covariances, *(P[:2, :2] for P in last))
    )
    assert row.landmark_area == pytest.approx(np.mean(areas))
    assert row.pose_area == pytest.approx(of_pose)
    assert row.predicted_area == pytest.approx(predicted)
    assert row.predicted_area > row.pose_area


def test_errors_are_those_of_the_path_and_of_the_final_map(of_log):
    for _, row, trace in of_log:
        for error, estimate, truth in (
            (row.ate, trace.poses[:, :2], trace.true_poses[:, :2]),
            (row.landmark_rmse, trace.landmarks, trace.true_landmarks),
        ):
            square = ((estimate - truth) ** 2).sum(axis=1).mean()
            assert error == pytest.approx(math.sqrt(square))


def scans(log):
    return np.array([e.measurements for e in log.events if isinstance(e, Scan)])


def test_the_study_of_a_world_keeps_the_random_numbers(log):
    """Ten times σβ: the same path, the same ranges, ten times the bearing errors."""
    exact = recorded(WORLD, 1, sensor={"std": [0.0, 0.08]})
    louder = recorded(scaled_scenario(WORLD, "σβ", 10.0), 1)
    np.testing.assert_array_equal(louder.ground_truth, log.ground_truth)
    np.testing.assert_array_equal(scans(louder)[..., 1], scans(log)[..., 1])
    errors, louder_errors = (
        np.angle(np.exp(1j * (scans(drive) - scans(exact))[..., 0]))
        for drive in (log, louder)
    )
    np.testing.assert_allclose(louder_errors, 10 * errors, atol=1e-12)


def test_in_the_study_of_a_world_the_filter_knows_the_changed_noise():
    driven = []

    def listen(scenario):
        driven.append(scenario)
        return recorded(scenario, 1)

    runs = study_scenario(WORLD, listen)
    assert [scenario.motion.std[0] for scenario in driven[:3]] == [0.25, 2.5, 0.025]
    assert driven[-2].sensor.std == pytest.approx((0.01, 0.8))
    louder = recorded(driven[-2], 1)
    alone = study_log(louder, settings_for(louder))[0]
    assert runs[-2].row.pose_area == alone.row.pose_area
    assert runs[-2].row.std == pytest.approx(0.8)


def test_progress_is_told_after_every_run(log):
    told = []
    study_log(log, settings_for(log), progress=lambda *numbers: told.append(numbers))
    assert told == [(k, 11) for k in range(1, 12)]


def test_without_truth_the_errors_are_unknown(log):
    nothing = {"landmark_ids": np.empty(0), "landmarks": np.empty((0, 2))}
    blind = replace(log, ground_truth=np.empty((0, 4)), **nothing)
    row = study_log(blind, settings_for(blind))[0].row
    assert (row.landmark_rmse, row.ate, row.nees_per_degree) == (None, None, None)
    assert row.landmark_area > 0


@pytest.mark.slow
def test_a_study_of_one_run_loads_nothing_of_the_monte_carlo():
    program = (
        "import sys\n"
        "from slamgym.experiments.command_line.app import main\n"
        "from slamgym.experiments.command_line import noise_study as study\n"
        "study.write_study = lambda *_, **__: None\n"
        "main(['noise-study', 'six_landmarks'], standalone_mode=False)\n"
        "heavy = {'xarray', 'netCDF4', 'joblib', 'slamgym.experiments.viewers'}\n"
        "heavy &= set(sys.modules)\n"
        "assert not heavy, heavy"
    )
    subprocess.run([sys.executable, "-c", program], check=True, capture_output=True)
