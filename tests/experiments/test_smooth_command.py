"""Smoothing a log, from Python and from the command line."""

import json
import os
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from commands import slamgym
from drawn import check_looks
from drives import MEASUREMENT_STD, MOTION_STD, drive

from slamgym.estimator.interface import ScanDecisions
from slamgym.estimator.smoother import Drive, SmoothedDrive, smooth
from slamgym.evaluation.trajectory_error import Alignment
from slamgym.experiments.figures.smoothed import smoothed_figure
from slamgym.experiments.logs.ground_truth import true_poses_of, without_identities
from slamgym.experiments.logs.slamlog import (
    OdometryRow,
    Scan,
    SlamLog,
    read_slamlog,
    write_slamlog,
)
from slamgym.experiments.run_and_replay import log_smoothing
from slamgym.experiments.run_and_replay.filter_settings import SMOOTHER, settings_for
from slamgym.experiments.run_and_replay.log_smoothing import (
    smooth_log,
    summarise_smoothing,
)
from slamgym.experiments.run_and_replay.summary import summarise

SIX = np.array([[3, 6], [3, 12], [7, 8], [7, 14], [11, 6], [11, 12.0]])
NOISE = {
    "motion_std": ",".join(map(str, MOTION_STD)),
    "measurement_std": ",".join(map(str, MEASUREMENT_STD)),
}


def a_log(*, motion="turn-last", with_ids=True, scans=True):
    """Return the log of a drive: two odometry rows for each scan, and the truth."""
    events, truth = [], [(0.0, 0.0, 0.0, 0.0)]
    for step, ((d, alpha), readings, pose) in enumerate(drive(8, 30), start=1):
        events += [
            OdometryRow(step - 0.5, d / 2, alpha / 2, 0.5),
            OdometryRow(float(step), d / 2, alpha / 2, 0.5),
        ]
        truth.append((float(step), *pose))
        if scans:
            ids = np.arange(6) if with_ids else None
            events.append(Scan(float(step), readings, ids))
    return SlamLog(
        "little",
        NOISE,
        motion=motion,
        landmark_ids=np.arange(6),
        landmarks=SIX,
        ground_truth=np.array(truth),
        events=tuple(events),
    )


def smoothed(log, **options):
    return smooth_log(log, settings_for(log, estimator=SMOOTHER, options=options))


@pytest.fixture(scope="module")
def example():
    return smoothed(a_log())


def test_the_map_shows_all_ellipses_and_true_landmarks():
    log = a_log()
    farther = np.array([[3.0, -30.0]])  # a landmark that no reading shows
    log = replace(
        log, landmark_ids=np.arange(7), landmarks=np.concatenate([SIX, farther])
    )
    found = smoothed(log)
    figure = smoothed_figure(found)
    check_looks(figure, "smoothed_figure")
    (axes,) = figure.axes
    low, high = np.transpose([axes.get_xlim(), axes.get_ylim()])
    drive = found.drive
    reach = 3 * np.sqrt(np.diagonal(drive.pose_covariances, axis1=1, axis2=2)[:, :2])
    assert (drive.poses[:, :2] - reach > low).all()
    assert (drive.poses[:, :2] + reach < high).all()
    (marks,) = [line for line in axes.lines if line.get_label() == "true landmark"]
    assert (marks.get_xydata() > low).all()
    assert (marks.get_xydata() < high).all()


def test_the_smoother_is_closer_to_the_truth_than_the_filter(example):
    summary = summarise_smoothing(example)
    for key in ("ate", "landmark_rmse"):
        errors = summary[key]
        assert errors["smoother"]["aligned"] < errors["filter"]["aligned"]
    assert 0.7 < summary["cost"]["per_degree"] < 1.3
    assert 0.2 < summary["nees"]["smoother"]["per_degree"] < 3
    assert summary["poses"] == 31
    assert summary["readings"] == 30 * 6


def repaired(log):
    told, settings = [], settings_for(log, estimator=SMOOTHER)
    found = smooth_log(
        log, settings, associate=True, repairing=lambda *done: told.append(done)
    )
    assert told[-1][0] == told[-1][1]
    return found


def hidden(events):
    log = without_identities(replace(a_log(), events=tuple(events)))
    return replace(log, header=log.header | {"identities": "false"})


def test_a_repair_takes_scans_without_motion_and_motion_without_a_scan():
    """A drive has one pose for the former, and one for the latter."""
    events = list(a_log().events)
    at_rest = [e for event in events for e in (event,) * (1 + isinstance(event, Scan))]
    for changed in (events[:-1], at_rest):
        found = repaired(hidden(changed))
        assert found.repair is not None
        assert found.repair.poses.shape == found.drive.poses.shape
        assert summarise_smoothing(found)["ate"]["smoother"]["aligned"] < 0.2


def test_a_repair_names_each_reading_that_the_filter_gave_to_no_landmark():
    readings, made = np.array([(0.0, 2.0), (1.0, 3.0)]), Drive(MOTION_STD, (0.1, 0.1))
    made.update(readings, [0, 1])
    made.update(readings, [0, 1])
    slam = SimpleNamespace(
        decisions=[ScanDecisions((None, 5)), ScanDecisions((5, None))]
    )
    log = SimpleNamespace(scans=[Scan(float(t), readings, None) for t in range(2)])
    whole = log_smoothing._with_all_readings(made, log, slam)
    assert [scan.ids.tolist() for scan in whole.scans] == [[6, 5], [5, 7]]


def test_a_repair_that_finds_nothing_better_leaves_the_smoothed_drive():
    log = hidden(a_log().events)
    found = repaired(log)
    assert found.repair is not None
    assert not found.repair.changed
    plain = smooth_log(log, settings_for(log, estimator=SMOOTHER))
    np.testing.assert_array_equal(found.drive.poses, plain.drive.poses)


@pytest.mark.slow
@pytest.mark.parametrize("begin", [42, 418])
def test_a_repair_does_not_harm_a_real_drive(public_logs, begin):
    whole = without_identities(read_slamlog(public_logs / "utias_d6_r3.csv"))
    events = tuple(e for e in whole.events if begin <= e.t < begin + 120)
    start = true_poses_of(whole, np.array([events[0].t]))[0]
    log = replace(whole, events=events, start=start)
    noise = {
        "motion_std": (0.03, 0.05, 0.05),
        "measurement_std": (0.01, 0.15),
        "options": {"range_std_per_metre": 0.03},
    }
    settings = settings_for(log, estimator=SMOOTHER, **noise)
    plain, found = smooth_log(log, settings), smooth_log(log, settings, associate=True)
    errors = [summarise_smoothing(one)["ate"]["smoother"] for one in (plain, found)]
    assert errors[1]["aligned"] <= 1.05 * errors[0]["aligned"]


def test_poses_that_are_certain_have_no_nees(example, monkeypatch):
    certain = np.zeros_like(example.drive.pose_covariances)
    monkeypatch.setattr(SmoothedDrive, "pose_covariances", certain)
    summary = summarise_smoothing(example)
    assert summary["nees"]["smoother"] is None


def test_no_known_true_heading_gives_no_nees(example):
    log = example.log
    unknown = log.ground_truth * [1, 1, 1, np.nan]
    filtered = replace(example.filtered, log=replace(log, ground_truth=unknown))
    summary = summarise_smoothing(replace(example, filtered=filtered))
    assert summary["nees"]["smoother"] is None
    assert summary["ate"]["smoother"]["raw"] > 0


def test_every_step_of_the_log_has_a_pose(example):
    trace = example.filtered.trace
    assert len(example.poses) == len(trace.t) == 61
    assert example.poses[example.scan_steps].tolist() == example.drive.poses.tolist()
    assert trace.t[example.scan_steps].tolist() == list(range(31))


def test_the_path_between_scans_is_that_of_a_drive_with_a_pose_at_every_reading(
    example,
):
    fine = Drive(MOTION_STD, MEASUREMENT_STD)
    for event in a_log().events:
        if isinstance(event, OdometryRow):
            fine.predict((event.d, event.alpha), event.dt)
            fine.end_motion()
        else:
            fine.update(event.measurements, event.landmark_ids)
    found = smooth(fine)
    assert example.drive.path == pytest.approx(found.path, abs=1e-3)
    assert found.path.tolist() == found.poses.tolist()


def test_midpoint_odometry_is_smoothed_as_two_readings():
    log = a_log(motion="midpoint")
    found, by_hand = smoothed(log), Drive(MOTION_STD, MEASUREMENT_STD)
    for event in log.events:
        if isinstance(event, OdometryRow):
            by_hand.predict((0.0, event.alpha / 2), 0.0)
            by_hand.predict((event.d, event.alpha / 2), event.dt)
        else:
            by_hand.update(event.measurements, event.landmark_ids)
    assert found.drive.poses == pytest.approx(smooth(by_hand).poses, abs=1e-7)
    assert len(found.drive.path) == 121
    assert len(found.poses) == 61


def test_readings_without_identity_are_smoothed_as_management_associates_them():
    found = smoothed(a_log(with_ids=False))
    summary = summarise_smoothing(found)
    assert summary["landmarks"] == 6
    assert summary["ate"]["smoother"]["aligned"] < 0.1


def test_a_map_in_another_frame_is_paired_with_the_truth_after_alignment():
    """Where the truth is turned, the nearest true landmark is another one."""
    log = a_log(with_ids=False)
    turned = Alignment(2.0, np.array([5.0, -3.0]))
    path = log.ground_truth
    places, headings = turned.apply(path[:, 1:3]), path[:, 3:] + turned.angle
    elsewhere = replace(
        log,
        ground_truth=np.hstack([path[:, :1], places, headings]),
        landmarks=turned.apply(SIX),
    )
    options = {"management": {"confirm": (2, 3)}}
    here, there = (smoothed(one, **options) for one in (log, elsewhere))
    expected, found = map(summarise_smoothing, (here, there))
    for which in ("filter", "smoother"):
        error = expected["landmark_rmse"][which]["aligned"]
        assert error < 0.2
        assert found["landmark_rmse"][which]["aligned"] == pytest.approx(error)
        assert found["landmark_rmse"][which]["raw"] > 1
    gospa = summarise(there.filtered)["association"]["gospa"]
    assert gospa["aligned"]["missed"] == 0 < gospa["raw"]["missed"]


def test_a_log_without_scans_is_refused():
    with pytest.raises(ValueError, match="little holds no scan"):
        smoothed(a_log(scans=False))


def test_a_filter_that_does_not_smooth_is_refused():
    log = a_log()
    with pytest.raises(ValueError, match="estimator 'ekf' does not smooth"):
        smooth_log(log, settings_for(log, estimator="ekf"))


@pytest.fixture
def here(here):
    write_slamlog(a_log(), here / "little.csv")
    write_slamlog(a_log(scans=False), here / "blind.csv")
    return here


def test_the_command_writes_a_picture_and_the_numbers(here):
    result = slamgym("smooth", "little.csv", "--robust", "huber", "--json")
    assert result.exit_code == 0, result.stderr
    summary = json.loads(result.stdout)
    assert summary["files"] == ["map.png", "summary.json"]
    assert (here / summary["out"] / "map.png").stat().st_size > 10_000
    assert summary["settings"]["options"]["robust"] == "huber"
    shown = slamgym("smooth", "little.csv", "--estimator", "ekf").stdout
    assert "path error, aligned" in shown
    assert "1 is expected" in shown


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["blind.csv"], "little holds no scan"),
        (["little.csv", "--estimator", "ekff"], "did you mean 'ekf'?"),
        (["little.csv", "--robust", "tukey"], "robust must be 'huber' or 'cauchy'"),
        (["nowhere.csv"], "cannot read the log nowhere.csv"),
    ],
)
def test_what_cannot_be_smoothed_is_refused_in_one_line(here, arguments, message):
    before = sorted(os.walk(here))
    result = slamgym("smooth", *arguments)
    assert result.exit_code == 2
    assert result.stderr.count("\n") == 1
    assert message in result.stderr
    assert sorted(os.walk(here)) == before


def test_a_log_without_noise_is_smoothed_with_an_assumed_one_and_says_so(here):
    text = (here / "little.csv").read_text()
    lines = [line for line in text.splitlines() if "_std" not in line]
    (here / "unsure.csv").write_text("\n".join(lines) + "\n")
    result = slamgym("smooth", "unsure.csv", "--measurement-std", ".02,.08", "--json")
    assert result.exit_code == 0, result.stderr
    assert "does not specify its motion_std: 0.1,0.1,0.03 is assumed" in result.stderr
    assert "measurement_std" not in result.stderr
    assert json.loads(result.stdout)["settings"]["motion_std"] == [0.1, 0.1, 0.03]


def test_a_log_without_truth_has_no_empty_table(here):
    lines = (here / "little.csv").read_text().splitlines()
    kept = [line for line in lines if not line.startswith(("landmark,", "groundtruth"))]
    (here / "blank.csv").write_text("\n".join(kept) + "\n")
    shown = slamgym("smooth", "blank.csv", "-e", "ekf").stdout
    assert "smoother" not in shown.partition("readings")[0].partition("\n")[2]


def test_the_options_of_a_noise_fit_can_be_pasted(here):
    options = ("--range-std-per-metre", "0.02", "--gate-probability", "0.999")
    result = slamgym("smooth", "little.csv", *options, "--json")
    found = json.loads(result.stdout)["settings"]["options"]
    assert found["range_std_per_metre"] == 0.02
    assert found["gate_probability"] == 0.999


def test_a_graph_is_smoothed_against_the_truth_of_another_file(here):
    edges = [f"EDGE2 {k} {k + 1} 1 0 0\nLANDMARK {k} 9 {4 - k} 4\n" for k in range(3)]
    (here / "graph.txt").write_text("".join([*edges, "EDGE2 3 0 -3 0 0\n"]))
    vertices = [f"VERTEX2 {k} {k + 1} 0.5 0\n" for k in range(4)]
    (here / "true.g2o").write_text("".join([*vertices, "VERTEX_XY 9 5 4.5\n"]))
    noise = ("--motion-std", ".1,.1,.1", "--measurement-std", ".1,.1")
    result = slamgym("smooth", "graph.txt", *noise, "--truth", "true.g2o", "--json")
    assert "note: left out of the log: 1 loop closures between poses" in result.stderr
    summary = json.loads(result.stdout)
    for who in ("filter", "smoother"):
        assert summary["ate"][who]["raw"] == pytest.approx(0, abs=1e-6)
        assert summary["landmark_rmse"][who]["raw"] == pytest.approx(0, abs=1e-6)


def test_the_association_is_repaired_on_request(tmp_path):
    log = a_log(with_ids=False)
    path = tmp_path / "log.csv"
    write_slamlog(log, path)
    out = tmp_path / "out"
    shown = slamgym("smooth", path, "--associate", "--out", out).stdout
    found = json.loads((out / "summary.json").read_text())
    assert found["repair"]["last"] <= found["repair"]["first"]
    assert found["repair"]["landmarks"] == found["landmarks"] == 6
    assert "readings, given to no landmark" in shown
    assert "(lower is better)" in shown
    settings = settings_for(log, estimator=SMOOTHER, options={})
    plain = smooth_log(log, settings)
    repaired = smooth_log(log, settings, associate=True)
    assert plain.repair is None
    assert sum(map(len, repaired.repair.ids)) >= plain.drive.readings
    np.testing.assert_allclose(repaired.poses, plain.poses, atol=0.05)


def test_identified_readings_are_not_repaired():
    log = a_log()
    with pytest.raises(ValueError, match="reports no associations"):
        smooth_log(log, settings_for(log, estimator=SMOOTHER), associate=True)
