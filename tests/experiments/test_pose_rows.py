"""Readings of the pose in logs, replays and Monte Carlos."""

import numpy as np
import pytest
from recordings import recorded

from slamgym.experiments.logs.recording import steps_of
from slamgym.experiments.logs.slamlog import (
    LogError,
    OdometryRow,
    PoseRow,
    Scan,
    SlamLog,
    read_slamlog,
    write_slamlog,
)
from slamgym.experiments.run_and_replay.filter_settings import settings_for
from slamgym.experiments.run_and_replay.log_replay import replay
from slamgym.experiments.run_and_replay.log_smoothing import smooth_log
from slamgym.experiments.run_and_replay.simulated_runs import simulate_runs
from slamgym.sim_configs import load_scenario

NAN = float("nan")


@pytest.fixture(scope="module")
def scenario():
    return load_scenario("loop").with_changes(
        steps=25, compass={"std": 0.05}, gps={"std": 0.5, "every": 4}
    )


@pytest.fixture(scope="module")
def log(scenario):
    return recorded(scenario, 4)


def test_a_recorded_log_reads_back_bit_by_bit(log, tmp_path):
    write_slamlog(log, tmp_path / "log.csv")
    again = read_slamlog(tmp_path / "log.csv")
    assert len(again.events) == len(log.events)
    for one, other in zip(log.events, again.events, strict=True):
        assert type(one) is type(other)
        if isinstance(one, PoseRow):
            assert np.array_equal(one.reading, other.reading, equal_nan=True)
            assert one.std == other.std
    rows = [event for event in log.events if isinstance(event, PoseRow)]
    std = [row.std for row in rows if np.isfinite(row.reading[0])]
    assert (len(rows), std) == (26, [(0.5, 0.05)] * 7)


def test_a_row_gives_the_filter_what_is_read_with_its_variances():
    gps = PoseRow(1.0, (4.0, 5.0, NAN), (0.5, NAN)).arguments
    both = PoseRow(1.0, (4.0, 5.0, 0.3), (0.5, 0.1)).arguments
    for found, z, R in (
        (gps, [4.0, 5.0], [0.25, 0.25]),
        (both, [4.0, 5.0, 0.3], [0.25, 0.25, 0.01]),
    ):
        np.testing.assert_array_equal(found[0], z)
        np.testing.assert_array_equal(found[1], np.eye(3)[: len(z)])
        np.testing.assert_allclose(found[2], np.diag(R))


def test_a_replay_feeds_the_filter_as_a_loop_by_hand_does(log):
    settings = settings_for(log, estimator="invariant")
    replayed, slam = replay(log, settings.make(log.start)), settings.make(log.start)
    components = 0
    for event in log.events:
        if isinstance(event, OdometryRow):
            slam.predict((event.d, event.alpha))
        elif isinstance(event, Scan):
            slam.update(event.measurements, event.landmark_ids)
        else:
            components += slam.observe_pose(*event.arguments).degrees_of_freedom
    assert components == 26 + 2 * 7
    assert np.array_equal(replayed.belief.mean, slam.belief().mean)
    used = 2 * replayed.readings.associated
    assert replayed.trace.nis_dof.sum() == used + components


def test_a_smoothed_log_uses_them(log):
    settings = settings_for(log, estimator="smoother")
    with_fixes = smooth_log(log, settings)
    bare = SlamLog(
        **vars(log) | {"events": [e for e in log.events if not isinstance(e, PoseRow)]}
    )
    without = smooth_log(bare, settings)
    std, more = (
        np.sqrt(made.drive.pose_covariances[-1].diagonal())
        for made in (with_fixes, without)
    )
    assert (std[1:] < 0.8 * more[1:]).all()


def test_a_reading_between_scans_is_a_step_of_its_own():
    scan = Scan(1.0, [(0.1, 5.0)], [4])
    row = PoseRow(1.5, (NAN, NAN, 0.2), (NAN, 0.1))
    moves = [OdometryRow(t, 0.5, 0.0, 0.5) for t in (1.5, 2.0)]
    events = scan, moves[0], row, moves[1], PoseRow(2.0, (1.0, 2.0, NAN), (0.3, NAN))
    steps = list(steps_of(SlamLog("drive", events=events)))
    assert [(step.t, len(step.motions), len(step.fixes)) for step in steps] == [
        (1.0, 0, 0),
        (1.5, 1, 1),
        (2.0, 1, 1),
    ]


@pytest.mark.parametrize(
    "row",
    [
        "pose,1,2,,0.1,1,1",
        "pose,1,,,,1,1",
        "pose,1,2,3,,,1",
        "pose,1,2,3,,0,",
        "pose,1,,,0.1,1,",
        "pose,1,2,3,0.1",
        "pose,0.5,2,3,0.1,1,1",
        "pose,,1,2,,0.5,",
    ],
)
def test_a_malformed_row_is_refused_with_its_line(row, tmp_path):
    path = tmp_path / "log.csv"
    path.write_text(f"# format: slamlog 1\nodometry,1,0,0,1\n{row}\n")
    with pytest.raises(LogError, match="3"):
        read_slamlog(path)


def test_a_filter_that_takes_no_such_readings_says_so(log):
    settings = settings_for(log, estimator="submaps")
    with pytest.raises(ValueError, match="does not accept readings of the pose"):
        replay(log, settings.make(log.start))


def test_the_same_noise_in_worlds_of_runs_and_in_logs(scenario, log):
    runs = simulate_runs(scenario, 2, seed=3)
    rows = [event.reading for event in log.events if isinstance(event, PoseRow)]
    np.testing.assert_allclose(runs.pose_readings[1], rows, rtol=0, atol=0)
