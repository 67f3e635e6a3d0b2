"""Warnings about a run that need no ground truth."""

import re

import numpy as np
import pytest

from slamgym.estimator import make_estimator
from slamgym.experiments.logs.slamlog import OdometryRow, Scan, SlamLog
from slamgym.experiments.runs.log_replay import replay
from slamgym.experiments.runs.summary import (
    abandoned_landmarks,
    association_failure,
    run_warnings,
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


def test_many_rejections_are_told():
    # a table moves by 1 m in the second half, under a gate
    scans = [PLACES] * 20 + [PLACES + np.array([(1.0, 0.0), (0, 0), (0, 0)])] * 20
    done = run(standing(scans, ids=[1, 2, 3]), gate_probability=0.999)
    share = done.readings.rejected / (done.readings.associated + done.readings.rejected)
    assert share > 0.1
    assert any(f"rejects {share:.0%} of the readings" in w for w in run_warnings(done))


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


def test_landmarks_that_are_seen_no_longer_are_told():
    # two of five landmarks seem to vanish, and to stand 1.5 m further on
    before = np.vstack([PLACES, [(2.0, 5.0), (2.0, -5.0)]])
    after = before + np.array([(0, 0), (1.5, 0), (1.5, 0), (0, 0), (0, 0)])
    done = run(standing([before] * 20 + [after] * 20), management=True)
    assert len(done.belief.landmark_ids) == 7
    assert abandoned_landmarks(done) == 2
    assert any("2 of the 7 landmarks in the map" in w for w in run_warnings(done))


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
    ],
)
def test_association_failed_by_the_alarm_or_the_truth(
    is_lost, precision, oracle_errors, reason
):
    scores = {"precision": precision, "oracle_errors": oracle_errors}
    summary = {"probably_lost": is_lost, "association": scores}
    assert re.search(reason or "^$", association_failure(summary))
    assert bool(association_failure(summary | {"association": None})) is bool(is_lost)
