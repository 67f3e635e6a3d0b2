"""Warnings about a run that need no ground truth."""

import re
from dataclasses import replace

import numpy as np
import pytest
from recordings import recorded

from slamgym.estimator import make_estimator
from slamgym.experiments.logs.importers import read_log
from slamgym.experiments.logs.slamlog import OdometryRow, Scan, SlamLog
from slamgym.experiments.run_and_replay.filter_settings import (
    SMOOTHER,
    FilterSettings,
    settings_for,
)
from slamgym.experiments.run_and_replay.log_replay import replay
from slamgym.experiments.run_and_replay.log_smoothing import (
    smooth_log,
    summarise_smoothing,
)
from slamgym.experiments.run_and_replay.summary import (
    abandoned_landmarks,
    association_failure,
    run_warnings,
    summarise,
)

NOISE = {"motion_std": (0.02, 0.02, 0.01), "measurement_std": (0.02, 0.1)}
PLACES = np.array([(4.0, 1.0), (5.0, -1.0), (3.0, -2.0)])


def polar(places):
    x, y = np.asarray(places).T
    return np.column_stack([np.arctan2(y, x), np.hypot(x, y)])


def standing(scans, *, ids=None):
    """Return the log of a robot that stands still, with some scans."""
    rng = np.random.default_rng(1)
    events = []
    for t, places in enumerate(scans):
        if t:
            events.append(OdometryRow(float(t), 0.0, 0.0, 1.0))
        readings = polar(places) + rng.normal(size=(len(places), 2)) * (0.02, 0.1)
        events.append(Scan(float(t), readings, ids))
    return SlamLog("standing", events=events)


def run(log, **options):
    return replay(log, make_estimator("ekf", **NOISE, **options))


def test_a_run_in_order_gives_no_warning():
    assert run_warnings(run(standing([PLACES] * 30, ids=[1, 2, 3]))) == []
    assert run_warnings(run(standing([PLACES] * 30), management=True)) == []


@pytest.mark.parametrize(("factor", "words"), [(10, "too much"), (0.3, "too little")])
def test_innovations_of_another_size_than_claimed_are_told(factor, words):
    log = standing([PLACES] * 40, ids=[1, 2, 3])
    noise = {key: np.array(std) * factor for key, std in NOISE.items()}
    (warning,) = run_warnings(replay(log, make_estimator("ekf", **noise)))
    assert warning.endswith(f"assumes {words} noise.")  # it associates nothing


def test_innovations_of_a_filter_that_associates_may_be_of_wrong_landmarks():
    noise = {key: np.array(std) * 10 for key, std in NOISE.items()}
    slam = make_estimator("ekf", **noise, management=True)
    warnings = run_warnings(replay(standing([PLACES] * 40), slam))
    assert any("too much noise, or associates wrongly." in w for w in warnings)


def test_bearings_that_are_coarse_beside_fine_ranges_are_reported():
    """The median distance is 4.1 m: σβ = 0.3 moves a reading by 0.19 m."""
    done = run(standing([PLACES] * 30, ids=[1, 2, 3]))

    def said(bearing_std, **options):
        std = bearing_std, 0.1
        settings = FilterSettings("ekf", NOISE["motion_std"], std, options=options)
        return run_warnings(done, settings)

    (warning,) = said(0.3)
    assert "error of σβ = 0.3 rad moves a reading at 4.1" in warning
    assert "by 0.18" in warning
    assert warning.endswith("filters of slamgym wait for several readings.")
    for silent in said(0.2), said(0.3, landmark_init="delayed"), run_warnings(done):
        assert silent == []


@pytest.mark.parametrize("count", [1, 2])
def test_landmarks_that_are_seen_no_longer_are_told_if_they_are_many(count):
    # some of five landmarks seem to vanish, and to stand 1.5 m further on
    before = np.vstack([PLACES, [(2.0, 5.0), (2.0, -5.0)]])
    after = before + np.array([(1.5 * (2 - count < k < 3), 0) for k in range(5)])
    log = standing([before] * 20 + [after] * 10)
    done = run(log, management=True, initial_pose=(30.0, -7.0, -3.0))
    assert len(done.belief.landmark_ids) == 5 + count
    assert abandoned_landmarks(done) == count
    told = [w[:33] for w in run_warnings(done) if "seen again" in w]
    assert told == ["2 of the 7 landmarks in the map s"] * (count == 2)


def test_rejections_and_innovations_are_told_beyond_their_limits():
    done = run(standing([PLACES] * 30, ids=[1, 2, 3]))
    for rejected in 4, 6:
        counts = done.readings._replace(rejected=rejected, associated=100 - rejected)
        told = run_warnings(replace(done, readings=counts))
        assert [w[:21] for w in told] == ["The gate rejects 6% o"] * (rejected > 5)
    for ratio in 0.48, 0.52, 1.92, 2.08:
        one = np.ones_like(done.trace.nis_dof)
        trace = replace(done.trace, nis=ratio * one, nis_dof=one)
        told = run_warnings(replace(done, trace=trace))
        assert [w[:15] for w in told] == [f"The NIS is {ratio}"] * (not 0.5 < ratio < 2)


def test_one_wrong_reading_and_a_gap_of_odometry_are_told_with_their_time():
    *events, last = standing([PLACES] * 40, ids=[1, 2, 3]).events
    wrong = last.measurements * [[1, 1], [1, 1000], [1, 1]]
    for reading, gap in ((last.measurements, 29.5), (wrong, 31.25)):
        late = OdometryRow(38 + gap, 0.0, 0.0, 1.0)
        scan = replace(last, t=38 + gap, measurements=reading)
        log = SlamLog("standing", events=[*events[:-1], late, scan])
        told = run_warnings(run(log))
        assert len(told) == 2 * (gap > 30)
    nis, hole = told
    assert re.fullmatch(
        r"The NIS is .*e\+07 per.*, and 0\.[7-9]\d* without the scan at t = 69.25 s.*",
        nis,
    )
    assert hole.startswith("The log has no odometry between t = 38 s and t = 69.25 s:")


def test_landmarks_out_of_view_are_not_missed():
    # after 20 scans the robot turns round, and sees others
    events = list(standing([PLACES] * 40).events)
    events[39] = OdometryRow(20.0, 0.0, np.pi, 1.0)
    done = run(SlamLog("turned", events=events), management=True)
    assert len(done.belief.landmark_ids) == 6
    assert abandoned_landmarks(done) == 0


@pytest.mark.parametrize(
    ("is_lost", "precision", "oracle_errors", "reason"),
    [
        (True, None, None, "is probably lost"),
        (False, None, None, ""),
        (None, 0.87, 0.002, "13.0% of the assigned readings .* map, 0.2% would"),
        (False, 0.87, 0.1, ""),  # no filter is much better
        (False, 0.97, None, ""),
        (False, 0.87, None, "13.0% of the assigned readings .* map, 0.0% would"),
    ],
)
def test_association_failed_by_the_alarm_or_the_truth(
    is_lost, precision, oracle_errors, reason
):
    scores = {"precision": precision, "oracle_errors": oracle_errors}
    summary = {"probably_lost": is_lost, "association": scores}
    assert re.search(reason or "^$", association_failure(summary))
    assert bool(association_failure(summary | {"association": None})) is bool(is_lost)


def exchanged(log, *ids):
    """Give each of some landmarks the true position of the one before it."""
    rows = [log.landmark_ids.tolist().index(i) for i in ids]
    places = log.landmarks.copy()
    places[rows] = log.landmarks[np.roll(rows, 1)]
    return replace(log, landmarks=places)


def exchange_warnings_of(log, **noise):
    """Return what a filter and the smoother say about a log with exchanged ids."""
    filtered = summarise(replay(log, settings_for(log, **noise).make(log.start)))
    smoothed = summarise_smoothing(
        smooth_log(log, settings_for(log, estimator=SMOOTHER, **noise))
    )
    told = filtered["warnings"], smoothed["warnings"]
    return [[text for text in found if "true position" in text] for found in told]


@pytest.fixture(scope="module")
def drive():
    return recorded("loop", 5, steps=60)


def test_landmarks_that_fit_each_others_truth_are_named(drive):
    ids = sorted(drive.read_ids)
    one, other = ids[1], ids[-2]
    for (warning,) in exchange_warnings_of(exchanged(drive, one, other)):
        assert f"Landmarks {one} and {other} fit each other's true" in warning
        assert f"`landmark,{one},…` and `landmark,{other},…`" in warning


def test_a_cycle_of_three_is_named_with_the_ids_that_its_rows_need(drive):
    ids = sorted(drive.read_ids)
    chosen = sorted([ids[0], ids[len(ids) // 2], ids[-1]])
    wrong = exchanged(drive, *chosen)
    for (warning,) in exchange_warnings_of(wrong):
        found = re.search(r"the rows (.*) in the file .* need the ids (.*)\.$", warning)
        rows, needed = (
            [int(i) for i in re.findall(r"\d+", part)] for part in found.groups()
        )
        truth = dict(zip(wrong.landmark_ids.tolist(), wrong.landmarks, strict=True))
        places = truth | {
            new: truth[row] for row, new in zip(rows, needed, strict=True)
        }
        mended = [places[i] for i in drive.landmark_ids.tolist()]
        np.testing.assert_array_equal(mended, drive.landmarks)


@pytest.mark.parametrize("name", ["loop", "six_landmarks", "corridor"])
def test_no_landmark_of_a_right_log_is_named(name):
    assert exchange_warnings_of(recorded(name, 5, steps=60)) == [[], []]


@pytest.mark.parametrize(
    ("name", "motion_std", "measurement_std"),
    [
        ("raw/cmu16833/data.txt", (0.25, 0.1, 0.1), (0.01, 0.08)),
        ("freiburg9.csv", (0.1, 0.1, 0.01), (0.1, 0.1)),
        pytest.param(
            *("utias_d6_r3.csv", (0.03, 0.08, 0.035), (0.0035, 0.05)),
            marks=pytest.mark.slow,
        ),
    ],
)
def test_no_landmark_of_a_public_log_is_named(
    public_logs, name, motion_std, measurement_std
):
    log = read_log(public_logs / name)
    noise = {"motion_std": motion_std, "measurement_std": measurement_std}
    options = {"gate_probability": 0.999} if "utias" in name else {}
    found = replay(log, settings_for(log, **noise, options=options).make(log.start))
    assert not any("true position" in text for text in run_warnings(found))
