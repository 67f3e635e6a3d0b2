import json
import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from far_origins import far_origins, rounding, shifted
from recordings import recorded
from rich.console import Console
from scipy.stats import chi2

from slamgym import smooth
from slamgym.estimator import Belief, Drive, EkfSlam, UpdateReport, make_estimator
from slamgym.evaluation.association_scores import oracle_errors
from slamgym.experiments.command_line import tables
from slamgym.experiments.command_line.tables import key_figures, landmark_table
from slamgym.experiments.logs.ground_truth import (
    path_accuracy,
    starts_at_truth,
    true_poses_of,
    without_identities,
)
from slamgym.experiments.logs.importers import read_log
from slamgym.experiments.logs.recording import steps_of
from slamgym.experiments.logs.slamlog import (
    LogError,
    OdometryRow,
    Scan,
    SlamLog,
    numbers,
    write_slamlog,
)
from slamgym.experiments.run_and_replay.filter_settings import (
    FilterSettings,
    settings_for,
)
from slamgym.experiments.run_and_replay.log_replay import MapHistory, replay
from slamgym.experiments.run_and_replay.log_smoothing import smooth_log
from slamgym.experiments.run_and_replay.summary import (
    LOST,
    never_placed,
    nis_summary,
    pose_nees,
    summarise,
)

NOISE = {"motion_std": (0.1, 0.1, 0.05), "measurement_std": (0.02, 0.1)}

FULL_EUCLIDEAN = (0.0042047, 0.0062251, 0.0086199, 0.0113960, 0.0090583, 0.0101540)
INDEPENDENT_EUCLIDEAN = (
    (0.0024197, 0.0058248, 0.0014076, 0.0032568, 0.0017959, 0.0055838)
)  # fmt: skip
INDEPENDENT_MAHALANOBIS = (0.05452, 0.06478, 0.03508, 0.06410, 0.02195, 0.09436)
HOMEWORK_EUCLIDEAN = (0.0024213, 0.0060985, 0.0013654, 0.0035964, 0.0021436, 0.0060097)
HOMEWORK_MAHALANOBIS = (0.05333, 0.06490, 0.03445, 0.06480, 0.02266, 0.09521)


class Listener:
    """An estimator that believes nothing and writes down what it is told."""

    def __init__(self):
        self.calls = []

    def predict(self, odometry, dt=1.0):
        self.calls.append(("predict", tuple(odometry), dt))

    def update(self, measurements, landmark_ids=None):
        ids = None if landmark_ids is None else list(landmark_ids)
        self.calls.append(("update", np.asarray(measurements).tolist(), ids))
        return UpdateReport()

    def belief(self):
        return Belief(np.zeros(3), np.eye(3), ())


def scan(t, *rows, ids=None):
    return Scan(t, np.array(rows, dtype=float), ids)


def told_of(log):
    listener = Listener()
    replay(log, listener)
    return listener.calls


def summary_of(log, **options):
    """Return the summary of a log by its own settings."""
    settings = settings_for(log, **options)
    return summarise(replay(log, settings.make(log.start)))


def circles():
    """Record a drive whose readings have no identity."""
    return recorded("hidden_identities", 2, steps=80, sensor={"clutter": 0.5})


@pytest.mark.parametrize("method", ["nearest", "hypotheses"])
def test_the_summary_scores_readings_without_identity(method):
    log = circles()
    policy = {"association": method, "backdate": False}  # reports say it all
    settings = settings_for(log, estimator="ekf", options={"management": policy})
    done = replay(log, settings.make(log.start))
    summary = summarise(done)["association"]
    ids, size = done.decisions.identities(), len(done.belief.landmark_ids)
    assert json.loads(json.dumps(summary, allow_nan=False)) == summary
    assert summary["map_size"] == summary["new_correct"] == size > 10
    assert summary["correct"] == done.readings.associated > 300
    assert summary["wrong"] == summary["ghost"] == summary["duplicate"] == 0
    assert summary["true_map_size"] < len(log.landmarks)  # some are seen too rarely
    assert summary["gospa"]["raw"]["missed_count"] == summary["true_map_size"] - size
    truth = dict(zip(log.landmark_ids.tolist(), log.landmarks.tolist(), strict=True))
    expected = [truth[ids[i]] for i in done.belief.landmark_ids]
    assert done.trace.true_landmarks.tolist() == expected
    assert done.trace.every_true_landmark is log.landmarks
    assert done.trace.estimator == "EkfSlam"


def test_a_known_log_whose_identities_are_hidden_is_scored():
    log = recorded("six_landmarks", 1, steps=20)
    assert summary_of(log)["association"] is None
    hidden = without_identities(log)
    assert settings_for(hidden).options == {"management": True}
    settings = settings_for(hidden)
    done = replay(hidden, settings.make(hidden.start))
    scores = summarise(done, settings)["association"]
    assert scores["correct"] + scores["new_correct"] > 80
    readings = [scan.measurements for scan in log.scans]
    ids = [scan.landmark_ids for scan in log.scans]
    world = log.ground_truth[:, 1:], readings, ids, log.landmark_ids, log.landmarks
    share = oracle_errors(*world, settings.measurement_std)
    assert scores["oracle_errors"] == share
    assert summarise(done)["association"]["oracle_errors"] is None
    first, *others = hidden.events
    partly = replace(hidden, events=(replace(first, true_ids=None), *others))
    found = summarise(replace(done, log=partly), settings)["association"]
    assert found["oracle_errors"] is None


def test_without_true_ids_the_map_is_compared_with_all_landmarks():
    log = circles()
    plain = [
        replace(event, true_ids=None) if isinstance(event, Scan) else event
        for event in log.events
    ]
    summary = summary_of(replace(log, events=plain))["association"]
    assert summary["correct"] is summary["precision"] is summary["map_size"] is None
    aligned = summary["gospa"]["aligned"]
    assert aligned["missed_count"] == 20 - aligned["pairs"] > 0


def test_a_lost_run_is_announced_without_the_truth():
    log = circles()
    away = [  # the robot is carried away: the log lacks this part of its odometry
        replace(event, d=0.0, alpha=0.0)
        if isinstance(event, OdometryRow) and 40 < event.t < 55
        else replace(event, true_ids=None)
        if isinstance(event, Scan)
        else event
        for event in log.events
    ]
    lost = replace(log, events=away, landmark_ids=(), landmarks=np.empty((0, 2)))
    for drive, is_lost in ((log, False), (lost, True)):
        summary = summary_of(drive)
        assert summary["probably_lost"] is is_lost
        assert (LOST in summary["warnings"]) == is_lost


def test_with_known_identities_nothing_is_said_about_being_lost():
    summary = summary_of(recorded("six_landmarks", 1, steps=5))
    assert summary["probably_lost"] is None
    assert LOST not in summary["warnings"]


def short_drive(**changes):
    fields = {
        "name": "drive",
        "events": (
            scan(0.0, (0.1, 5.0), (-0.4, 3.0), ids=[7, 3]),
            OdometryRow(1.0, 1.0, 0.2, 1.0),
            scan(1.0, (-0.1, 4.1), ids=[7]),
            OdometryRow(2.0, 0.5, -0.1, 1.0),
            OdometryRow(3.0, 0.5, 0.0, 1.0),
            scan(3.0, (-0.1, 3.0), (0.4, 6.0), ids=[7, 9]),
        ),
    }
    return SlamLog(**{**fields, **changes})


def ekf(**options):
    return make_estimator("ekf", **NOISE, **options)


def test_a_midpoint_row_is_exactly_two_turn_last_steps():
    row = OdometryRow(0.5, 2.0, 0.6, 0.25)
    log = SlamLog("arc", motion="midpoint", events=(row,))
    assert told_of(log) == [("predict", (0.0, 0.3), 0.0), ("predict", (2.0, 0.3), 0.25)]


def test_turn_last_rows_and_scans_reach_the_estimator_as_they_are():
    assert told_of(short_drive())[:3] == [
        ("update", [[0.1, 5.0], [-0.4, 3.0]], [7, 3]),
        ("predict", (1.0, 0.2), 1.0),
        ("update", [[-0.1, 4.1]], [7]),
    ]


def test_without_ids_a_filter_is_left_alone_and_never_told_the_true_ones():
    hidden = Scan(0.0, [(0.1, 5.0), (0.2, 4.0)], true_ids=[7, -1])
    expected = [("update", [[0.1, 5.0], [0.2, 4.0]], None)]
    assert told_of(SlamLog("drive", events=(hidden,))) == expected


def test_rows_that_end_together_are_one_step_with_the_scan_at_their_end():
    events = (
        OdometryRow(1.0, 0.0, 0.3, 0.0),
        OdometryRow(1.0, 2.0, 0.1, 1.0),
        scan(1.0, (0.0, 2.0), ids=[1]),
        scan(1.5, (0.0, 2.0), ids=[2]),
        OdometryRow(1.5, 1.0, 0.0, 0.5),
    )
    steps = list(steps_of(SlamLog("drive", events=events)))
    assert [(s.t, len(s.motions), s.scan is not None) for s in steps] == [
        (0.0, 0, False),
        (1.0, 2, True),
        (1.5, 0, True),
        (1.5, 1, False),
    ]


def test_step_0_has_no_motion_even_where_the_first_row_takes_no_time():
    rows = (OdometryRow(0.0, 0.0, 0.0, 0.0), OdometryRow(0.1, 1.0, 0.0, 0.1))
    steps = list(steps_of(SlamLog("drive", events=rows)))
    assert [(s.t, len(s.motions)) for s in steps] == [(0.0, 0), (0.0, 1), (0.1, 1)]


def test_a_log_that_begins_with_motion_starts_before_all_of_it():
    rows = [OdometryRow(5.0, 1.0, 0.0, dt) for dt in (0.5, 0.25)]
    assert next(steps_of(SlamLog("drive", events=rows))).t == 4.25


def test_the_trace_holds_the_beliefs_before_and_after_every_scan():
    trace = replay(short_drive(), ekf(), keep_history=True).trace
    by_hand = ekf()
    before, after = [], []
    for step in steps_of(short_drive()):
        for row in step.motions:
            by_hand.predict((row.d, row.alpha), row.dt)
        before.append(by_hand.belief())
        if step.scan is not None:
            by_hand.update(step.scan.measurements, step.scan.landmark_ids.tolist())
        after.append(by_hand.belief())
    same = np.testing.assert_array_equal
    same(trace.predicted_poses, [b.pose for b in before])
    same(trace.poses, [b.pose for b in after])
    same(trace.predicted_pose_covariances, [b.pose_covariance for b in before])
    same(trace.pose_covariances, [b.pose_covariance for b in after])
    for kept, belief in zip(trace.landmark_history, after, strict=True):
        assert tuple(kept.ids) == belief.landmark_ids
        np.testing.assert_array_equal(kept.means, belief.landmarks)
        np.testing.assert_array_equal(kept.covariances, belief.landmark_covariances)
    np.testing.assert_array_equal(trace.first_covariance, after[0].covariance)
    np.testing.assert_array_equal(trace.final_covariance, after[-1].covariance)


def test_first_landmarks_are_those_of_the_step_they_entered_at():
    trace = replay(short_drive(), ekf(), keep_history=True).trace
    assert trace.landmark_ids.tolist() == [7, 3, 9]
    at_start, at_end = trace.map_at(0), trace.map_at(3)
    np.testing.assert_array_equal(trace.first_landmarks[:2], at_start.means)
    np.testing.assert_array_equal(trace.first_landmarks[2], at_end.means[2])
    np.testing.assert_array_equal(
        trace.first_landmark_covariances[0], at_start.covariances[0]
    )


def test_without_a_map_the_first_covariance_is_that_of_the_start():
    trace = replay(short_drive(), make_estimator("ekf", **NOISE, min_range=9.0)).trace
    np.testing.assert_array_equal(trace.first_covariance, np.zeros((3, 3)))
    assert trace.final_covariance[0, 0] > 0


def test_readings_are_counted_by_what_became_of_them():
    events = (
        scan(0.0, (0.0, 5.0), (1.0, 1e-6), ids=[1, 2]),
        OdometryRow(1.0, 1.0, 0.0, 1.0),
        scan(1.0, (0.0, 4.0), (1.0, 3.0), ids=[1, 3]),
        OdometryRow(2.0, 1.0, 0.0, 1.0),
        scan(2.0, (2.0, 9.0), (1.33, 2.6), ids=[1, 3]),
    )
    estimator = ekf(gate_probability=0.999)
    counts = replay(SlamLog("drive", events=events), estimator).readings
    assert (counts.associated, counts.added) == (2, 2)
    assert (counts.rejected, counts.skipped) == (1, 1)


def test_an_error_names_the_time_in_the_log():
    events = (OdometryRow(2.5, 1.0, 0.0, 1.0), scan(2.5, (0.0, 4.0)))
    with pytest.raises(
        ValueError, match=r"drive, t = 2\.5: landmark_ids must be given"
    ):
        replay(SlamLog("drive", events=events), ekf())


@pytest.mark.parametrize("part", ["mean", "covariance"])
def test_a_belief_that_is_not_finite_is_refused_at_its_time(part):
    class Diverging(Listener):
        def belief(self):
            mean, covariance = np.zeros(5), np.eye(5)
            if len(self.calls) > 3:
                {"mean": mean, "covariance": covariance}[part][4:] = np.nan
            return Belief(mean, covariance, (7,))

    with pytest.raises(np.linalg.LinAlgError, match=r"t = 3: the belief is not finite"):
        replay(short_drive(), Diverging())


def test_progress_is_told_after_every_step():
    told = []
    replay(short_drive(), ekf(), progress=lambda *numbers: told.append(numbers))
    assert told == [(k, 4) for k in range(1, 5)]


def test_an_empty_log_is_a_run_of_its_start():
    done = replay(SlamLog("nothing"), ekf())
    assert (done.trace.last_step, done.scans) == (0, 0)
    assert summarise(done)["landmarks"] == []


def test_a_long_run_keeps_few_maps_and_the_last_of_them():
    history = MapHistory(most=50)
    for step in range(3000):
        n = min(step // 100, 4)
        mean = np.concatenate([np.zeros(3), np.full(2 * n, float(step))])
        history.append(Belief(mean, np.eye(3 + 2 * n), tuple(range(n))))
    distinct = {id(landmarks.means) for landmarks in history}
    assert len(history) == 3000
    assert 25 <= len(distinct) <= 52
    assert history[-1].means[0, 0] == 2999
    assert [len(history[step].ids) for step in (99, 100)] == [0, 1]
    ages = [step - history[step].means[0, 0] for step in range(100, 3000)]
    assert 0 <= min(ages) <= max(ages) < 128


def test_true_poses_are_interpolated_the_shorter_way_round():
    truth = [[0, 0, 0, 3.0], [2, 4, 2, -3.0]]
    poses = true_poses_of(SlamLog("drive", ground_truth=truth), np.array([1.0, 3.0]))
    assert poses[0] == pytest.approx([2, 1, -math.pi])
    assert np.isnan(poses[1]).all()


def test_truth_measured_beside_the_robots_centre_is_taken_to_the_centre():
    truth = [[0.0, 1.0, 2.0, math.pi / 2], [1.0, 1.0, 5.0, math.pi / 2]]
    log = SlamLog("drive", {"groundtruth_offset": "2,0.5"}, ground_truth=truth)
    times = np.array([0.0, 1.0])
    poses = true_poses_of(log, times)
    np.testing.assert_allclose(poses[:, :2], [[1.5, 0.0], [1.5, 3.0]])
    assert path_accuracy(log, times, poses).raw_rmse == pytest.approx(0, abs=1e-12)


def test_a_path_is_compared_at_the_times_of_the_truth():
    """Many steps at one moment count no more than the moment."""
    truth = [[0, 0, 0, 0.0], [1, 1, 0, 0.0], [2, 2, 0, 0.0]]
    times = np.array([0.0, *np.linspace(0.9, 1.0, 50), 2.0])
    poses = np.column_stack([times, np.zeros((len(times), 2))])
    poses[-1, 1] = 3.0
    log = SlamLog("drive", ground_truth=truth)
    assert path_accuracy(log, times, poses).raw_rmse == pytest.approx(math.sqrt(3))


def test_gps_without_heading_gives_an_error_of_the_path_but_no_nees():
    truth = [[0, 0, 0, math.nan], [3, 2, 0, math.nan]]
    summary = summarise(replay(short_drive(ground_truth=truth), ekf()))
    assert summary["ate"]["raw"] > 0
    assert summary["nees"] is None


def test_an_offset_that_is_no_pair_of_numbers_is_refused():
    log = short_drive(header={"groundtruth_offset": "2"})
    with pytest.raises(LogError, match=r"groundtruth_offset must be two numbers"):
        replay(log, ekf())


def test_pose_nees_is_the_squared_mahalanobis_distance_with_a_wrapped_heading():
    truth = [[float(k), 0.3 * k, 0.1 * k, 3.1] for k in range(4)]
    log = short_drive(ground_truth=truth, start=(0.0, 0.0, 3.1))
    estimator = ekf(initial_pose=log.start, initial_pose_std=(0.1, 0.1, 0.1))
    done = replay(log, estimator)
    trace = done.trace
    step = 3
    e = trace.poses[step] - truth[step][1:]
    assert abs(e[2]) > 6  # without the wrap
    e[2] = math.atan2(math.sin(e[2]), math.cos(e[2]))
    expected = e @ np.linalg.inv(trace.pose_covariances[step]) @ e
    assert pose_nees(trace)[step] == pytest.approx(expected, rel=1e-9)
    assert summarise(done)["nees"]["final"] == pytest.approx(expected, rel=1e-9)


def test_a_start_known_for_certain_has_no_nees():
    truth = [[float(k), 0.3 * k, 0.0, 0.0] for k in range(4)]
    done = replay(short_drive(ground_truth=truth), ekf())
    nees = pose_nees(done.trace)
    assert np.isnan(nees).tolist() == [True, False, False, False]
    summary = summarise(done)["nees"]
    assert summary["steps"] == 3
    assert summary["mean"] == pytest.approx(nees[1:].mean())
    assert summary["per_degree"] == pytest.approx(nees[1:].mean() / 3)


def test_the_final_pose_is_written_with_its_deviations():
    covariance = [[0.04, 0.02, 0.01], [0.02, 0.09, 0.03], [0.01, 0.03, None]]
    text = tables._pose([1.0, -2.0, 0.5], covariance)
    assert text == "x 1.000 ± 0.200 m, y -2.000 ± 0.300 m, θ 0.500 ± - rad"


def test_poses_whose_covariance_is_singular_are_counted():
    truth = [[float(k), 0.3 * k, 0.0, 0.0] for k in range(4)]
    noise = {"motion_std": (0.1, 0.0, 0.0), "measurement_std": (0.1, 0.1)}
    log = short_drive(ground_truth=truth)
    summary = summarise(replay(log, make_estimator("ekf", **noise)))
    found = summary["nees"]
    assert (found["singular"], found["steps"], found["mean"]) == (3, 0, None)
    table = Console(width=100)
    with table.capture() as text:
        table.print(key_figures(summary))
    assert "none: the covariance of 3 poses is singular" in text.get()
    assert "singular" not in summarise(replay(log, ekf()))["nees"]


@far_origins
@pytest.mark.parametrize("name", ["ekf", "robocentric", "invariant", "submaps"])
def test_a_log_far_from_the_origin_has_the_same_summary(name, far):
    summaries = []
    for origin in ((0.0, 0.0), far):
        log = recorded("six_landmarks", 1, steps=20)
        moved = replace(
            log,
            start=shifted(log.start, origin),
            landmarks=log.landmarks + origin,
            ground_truth=log.ground_truth + np.array([0, *origin, 0]),
        )
        slam = make_estimator(
            name, initial_pose=moved.start, initial_pose_std=(0.1,) * 3, **NOISE
        )
        summaries.append(summarise(replay(moved, slam)))
    near, there = summaries
    slack = rounding(far, 20) / 0.02  # the least deviation, that of a bearing at 1 m
    keys = ("nees", "mean"), ("nees", "final"), ("nis", "mean"), ("ate", "aligned")
    for key, part in keys:
        one, other = near[key][part], there[key][part]
        assert other == pytest.approx(one, rel=10 * slack, abs=10 * rounding(far, 20))
    assert "singular" not in there["nees"]


def test_a_summary_holds_plain_finite_numbers_and_null_for_the_unknown():
    known = short_drive(landmark_ids=[7], landmarks=[(5.0, 0.5)])
    settings = FilterSettings("ekf", (0.1,) * 3, (0.1, 0.1), options={"k": math.inf})
    summary = summarise(replay(known, ekf()), settings)
    assert json.loads(json.dumps(summary, allow_nan=False)) == summary
    trace = replay(known, ekf()).trace
    assert summary["pose"] == trace.poses[-1].tolist()
    assert summary["pose_covariance"] == trace.pose_covariances[-1].tolist()
    first, second, _ = summary["landmarks"]
    assert [first["x"], first["y"]] == trace.landmarks[0].tolist()
    assert first["euclidean"] > 0
    assert first["mahalanobis"] > 0
    assert (second["euclidean"], second["mahalanobis"]) == (None, None)
    assert (summary["nees"], summary["ate"]) == (None, None)


def test_the_nis_of_a_summary_is_that_of_the_reports():
    estimator, nis, dof = ekf(), [], []
    for step in steps_of(short_drive()):
        for row in step.motions:
            estimator.predict((row.d, row.alpha), row.dt)
        if step.scan is not None:
            ids = step.scan.landmark_ids.tolist()
            report = estimator.update(step.scan.measurements, ids)
            nis.append(report.nis)
            dof.append(report.degrees_of_freedom)
    summary = summarise(replay(short_drive(), ekf()))["nis"]
    assert summary["scans"] == 2
    assert summary["degrees_of_freedom"] == sum(dof) == 4
    assert summary["total"] == pytest.approx(sum(nis))
    assert summary["mean"] == pytest.approx(sum(nis) / 2)
    assert summary["per_degree"] == pytest.approx(sum(nis) / 4)


def test_the_interval_of_the_nis_covers_95_percent_of_honest_scans():
    rng = np.random.default_rng(3)
    dof = rng.integers(0, 7, 9000)  # 0 where nothing was corrected
    nis = rng.chisquare(np.maximum(dof, 1))
    found = nis_summary(SimpleNamespace(nis=nis, nis_dof=dof))
    limits = chi2.ppf([[0.025], [0.975]], dof[dof > 0])
    inside = (nis[dof > 0] > limits[0]) & (nis[dof > 0] < limits[1])
    assert found["inside_95"] == inside.mean() == pytest.approx(0.95, abs=0.01)
    assert found["scans"] == np.count_nonzero(dof)


def test_a_landmark_that_is_in_the_map_or_was_removed_was_placed():
    log = SlamLog("three", events=(Scan(0.0, [(0.0, 1.0)] * 3, [0, 4, 7]),))
    held = SimpleNamespace(landmark_ids=np.array([0]))
    run = SimpleNamespace(log=log, last_seen={4: 0}, trace=held)
    assert never_placed(run) == [7]


def test_settings_come_from_the_caller_then_the_log():
    header = {"motion_std": "0.1,0.2,0.3", "measurement_std": "0.01,0.1"}
    header |= {"start_sigma": "1,2,3", "range_std_per_metre": "0.05"}
    header["noise_at_rest"] = "true"
    settings = settings_for(SlamLog("log", header), measurement_std=(0.5, 0.6))
    assert settings.motion_std == (0.1, 0.2, 0.3)
    assert settings.measurement_std == (0.5, 0.6)
    assert settings.initial_pose_std == (1, 2, 3)
    assert settings.options == {"range_std_per_metre": 0.05}


def test_noise_of_positions_in_the_header_is_taken_unless_the_user_gives_a_noise():
    header = {"motion_std": "0.1,0.2,0.3", "measurement_std": "0,0.1"}
    header |= {"bearing_std_metres": "0.1", "noise_at_rest": "true"}
    log = SlamLog("log", header)
    assert settings_for(log).options == {"bearing_std_metres": 0.1}
    assert settings_for(log, measurement_std=(0.01, 0.1)).options == {}


@pytest.mark.parametrize("noise", ["bearing_std_metres", "range_std_per_metre"])
def test_a_filter_without_a_noise_of_the_log_is_refused_unless_the_user_gives_one(
    noise,
):
    header = {"motion_std": "0.1,0.2,0.3", "measurement_std": "0,0.1", noise: "0.1"}
    log, simple = SlamLog("log", header), f"{__name__}:Simple"
    with pytest.raises(ValueError, match=f"the noise of log contains {noise}"):
        settings_for(log, estimator=simple)
    assert settings_for(log, estimator=simple, measurement_std=(1, 1)).options == {}


def test_a_robot_that_reports_rest_stands_still_unless_log_or_filter_object():
    assert settings_for(SlamLog("log"), **NOISE).options == {"noise_at_rest": False}
    simple = settings_for(SlamLog("log"), estimator=f"{__name__}:Simple", **NOISE)
    assert simple.options == {}


class Simple(EkfSlam):
    """Takes no options."""

    def __init__(self, motion_std, measurement_std, initial_pose, initial_pose_std):
        super().__init__(motion_std, measurement_std)


@pytest.mark.parametrize(
    ("header", "message"),
    [
        ({}, "log does not specify its motion_std"),
        ({"motion_std": "1,x,1"}, "motion_std must be numbers, got 'x'"),
        ({"noise_at_rest": "maybe"}, "noise_at_rest must be true or false"),
    ],
)
def test_a_header_that_cannot_be_used_is_refused(header, message):
    complete = {"measurement_std": "1,1", **header}
    if "noise_at_rest" in header:
        complete["motion_std"] = "1,1,1"
    with pytest.raises(ValueError, match=message):
        settings_for(SlamLog("log", complete))


def on_the_course(public_logs, estimator="ekf", **options):
    log = read_log(public_logs / "raw" / "cmu16833" / "data.txt")
    return summary_of(log, estimator=estimator, options=options)


def test_the_course_log_ends_at_the_published_distances(public_logs):
    table = on_the_course(public_logs)["landmarks"]
    assert [row["id"] for row in table] == list(range(6))
    euclidean = [row["euclidean"] for row in table]
    assert euclidean == pytest.approx(FULL_EUCLIDEAN, abs=1e-6)


def test_independent_landmarks_reproduce_the_homeworks_table(public_logs):
    table = on_the_course(public_logs, landmark_init="independent")["landmarks"]
    euclidean = [row["euclidean"] for row in table]
    mahalanobis = [row["mahalanobis"] for row in table]
    assert euclidean == pytest.approx(INDEPENDENT_EUCLIDEAN, abs=1e-6)
    assert mahalanobis == pytest.approx(INDEPENDENT_MAHALANOBIS, abs=1e-5)
    assert euclidean == pytest.approx(HOMEWORK_EUCLIDEAN, abs=0.5e-3)
    assert mahalanobis == pytest.approx(HOMEWORK_MAHALANOBIS, abs=0.002)


def errors_on(path, motion_std, measurement_std, **options):
    noise = {"motion_std": motion_std, "measurement_std": measurement_std}
    summary = summary_of(read_log(path), estimator="ekf", **noise, options=options)
    ate = summary["ate"] or {"aligned": None, "raw": None}
    landmarks = summary["landmark_rmse"]
    return ate["aligned"], ate["raw"], landmarks["aligned"], landmarks["raw"]


def test_mrpt_demo_agrees_with_an_independent_filter(public_logs):
    errors = errors_on(
        public_logs / "mrpt_kfslam_demo.csv", (0.04, 0.04, 0.00016), (0.00175, 0.01)
    )
    assert np.round(errors, 4) == pytest.approx([0.0043, 0.0046, 0.0020, 0.0030])


def test_freiburg_agrees_with_an_independent_filter(public_logs):
    path = public_logs / "freiburg9.csv"
    _, _, aligned, raw = errors_on(path, (0.0016, 0.0016, 0.0004), (0.05, 0.1))
    assert (aligned, raw) == pytest.approx((0.0112, 0.0633), rel=0.02)


def test_freiburg_with_wide_noise_agrees_but_for_its_negative_range(public_logs):
    """The other filter uses the last reading, a range of -0.035 m; this one skips it.

    Its aligned error is 0.0196 m; without that reading it is 0.0200 m.
    """
    path = public_logs / "freiburg9.csv"
    _, _, aligned, raw = errors_on(path, (0.1, 0.1, 0.01), (0.1, 0.1))
    assert aligned == pytest.approx(0.0196, rel=0.025)
    assert raw == pytest.approx(0.292, rel=0.02)


UTIAS = {
    "range_std_per_metre": 0.0283,
    "gate_probability": 1 - math.exp(-15),  # χ²(2) below 30
}


def errors_on_utias(public_logs, **options):
    path = public_logs / "utias_d6_r3.csv"
    return errors_on(
        path, (0.0283, 0.08, 0.0353), (0.00354, 0.0044), **UTIAS, **options
    )


@pytest.mark.slow
def test_utias_agrees_with_an_independent_filter(public_logs):
    errors = errors_on_utias(public_logs, range_noise_at="reading")
    assert errors == pytest.approx((0.276, 0.282, 0.158, 0.209), rel=0.05)


@pytest.mark.slow
def test_utias_is_no_worse_with_the_noise_at_the_expected_range(public_logs):
    as_read = errors_on_utias(public_logs, range_noise_at="reading")
    expected = errors_on_utias(public_logs)
    assert (np.array(expected) < 1.01 * np.array(as_read)).all()
    assert expected[2] < 0.97 * as_read[2]


def test_on_the_course_log_the_invariant_filter_is_right(public_logs):
    invariant, ekf_ = (
        on_the_course(public_logs, name)["landmark_rmse"]["raw"]
        for name in ("invariant", "ekf")
    )
    assert invariant <= 0.003
    assert ekf_ == pytest.approx(0.0086, abs=1e-4)


def test_an_estimator_with_a_door_for_the_truth_is_told_it():
    told = []

    class Student(Listener):
        def observe_truth(self, pose, landmarks):
            told.append((pose.tolist(), sorted(landmarks)))

    truth = np.array([[0, 0, 0, 0], [1, 1, 0, 0.2], [3, 2, 0.1, 0.1]], dtype=float)
    landmarks = {"landmark_ids": np.array([3, 7, 9]), "landmarks": np.zeros((3, 2))}
    replay(short_drive(ground_truth=truth, **landmarks), Student())
    assert [pose[0] for pose, _ in told] == [0.0, 1.0, 1.5, 2.0]
    assert {tuple(ids) for _, ids in told} == {(3, 7, 9)}


def test_a_log_without_all_the_truth_tells_none():
    class Student(Listener):
        def observe_truth(self, pose, landmarks):
            raise AssertionError("told")

    replay(short_drive(), Student())
    truth = np.zeros((2, 4))
    truth[1, 0] = 3.0
    replay(short_drive(ground_truth=truth), Student())


def test_a_truth_that_is_known_at_some_steps_only_gives_no_warning_of_numpy():
    truth = np.array([[0.5, 0, 0, 0], [1.5, 1, 0, 0]])
    settings = settings_for(short_drive(), estimator="invariant", **NOISE)
    done = replay(short_drive(ground_truth=truth), settings.make((0, 0, 0)))
    assert done.trace.frame == "invariant"
    assert np.isnan(pose_nees(done.trace)).any()


@pytest.mark.parametrize("given", [None, EkfSlam])
def test_what_is_no_filter_is_refused_by_replay(given):
    with pytest.raises(TypeError, match="estimator must be a filter, as make_estimat"):
        replay(SlamLog("empty"), given)


@pytest.mark.parametrize("use", [replay, settings_for])
def test_what_is_no_log_is_refused(use):
    with pytest.raises(TypeError, match=r"log must be a SlamLog or the path .* got 3"):
        use(3, estimator="ekf")


def test_python_takes_the_path_of_a_log_and_the_name_of_a_filter(tmp_path):
    path = tmp_path / "drive.csv"
    stds = {key: numbers(*std) for key, std in NOISE.items()}
    log = short_drive(header=stds)
    write_slamlog(log, path)
    by_name = replay(path, "ekf").trace
    by_hand = replay(log, settings_for(log, estimator="ekf").make(log.start)).trace
    np.testing.assert_array_equal(by_name.poses, by_hand.poses)
    assert by_name.estimator == "ekf"
    smoothed = smooth_log(str(path))
    assert len(smoothed.poses) == len(by_hand.poses)
    for what in (log, path, str(path)):
        np.testing.assert_array_equal(smooth(drive=what).poses, smoothed.poses)
    with pytest.raises(TypeError, match="drive must be a Drive, got int"):
        smooth(3)
    with pytest.raises(TypeError, match="takes no options of a drive, got tolerance: "):
        smooth(path, tolerance=1e-6)
    with pytest.raises(TypeError, match="settings must be None for a drive, which"):
        smooth(Drive(**NOISE), settings_for(log))


def turned_away(log):
    """Return a log that starts at the origin, wherever the truth does."""
    angle, offset = 1.0, np.array([30.0, -20.0])
    cos, sin = math.cos(angle), math.sin(angle)
    turn = np.array([[cos, sin], [-sin, cos]])
    truth = log.ground_truth.copy()
    truth[:, 1:3] = truth[:, 1:3] @ turn + offset
    truth[:, 3] += angle
    return replace(log, landmarks=log.landmarks @ turn + offset, ground_truth=truth)


def test_without_a_true_start_the_distances_are_aligned_ones():
    log = recorded("six_landmarks", 1, steps=30)
    right = summary_of(log)
    assert right["aligned_landmarks"] is None
    summary = summary_of(turned_away(log))
    assert summary["landmarks"][0]["euclidean"] > 5
    rows = summary["aligned_landmarks"]
    square = np.mean([row["euclidean"] ** 2 for row in rows])
    assert math.sqrt(square) == pytest.approx(summary["landmark_rmse"]["aligned"])
    again = summary_of(turned_away(turned_away(log)))["aligned_landmarks"]
    sigmas = [[row["mahalanobis"] for row in each] for each in (rows, again)]
    assert max(sigmas[0]) < 10
    np.testing.assert_allclose(*sigmas)
    tables = [landmark_table(found) for found in (right, summary)]
    assert [str(t.title).endswith("after alignment") for t in tables] == [False, True]
    shown = list(tables[1].columns[3].cells)
    assert shown == [f"{row['euclidean']:.4g}" for row in rows]


@pytest.mark.parametrize(
    ("changes", "is_true"),
    [
        ({}, True),
        ({"start": (0.2, 0.0, 0.0)}, False),
        ({"start": (0.0, 0.0, 0.2)}, False),
        (
            {"start": (0, 0, -3.14), "ground_truth": [(0, 0, 0, 3.14), (1, 1, 0, 3)]},
            True,
        ),
        ({"start": (0.2, 0.0, 0.1), "header": {"start_sigma": "0.1,0.1,0.1"}}, True),
        ({"header": {"start_from": "origin (no truth then)"}}, False),
        ({"start": (9.0, 0.0, 0.0), "ground_truth": np.empty((0, 4))}, True),
        ({"ground_truth": [(0.5, 0, 0, 0), (1, 1, 0, 0)]}, False),
    ],
)
def test_the_start_of_a_log_is_the_true_one(changes, is_true):
    events = (OdometryRow(0.2, 0.1, 0.0, 0.2), OdometryRow(0.4, 0.1, 0.0, 0.2))
    truth = np.array([(0, 0, 0, 2 * math.pi), (1, 1, 0, 2 * math.pi)])
    log = SlamLog("little", events=events, ground_truth=truth)
    changed = {key: np.array(v) if key != "header" else v for key, v in changes.items()}
    assert starts_at_truth(replace(log, **changed)) is is_true
