import numpy as np
import pytest
from run_traces import make_trace

from slamgym.estimator.models.rigid_motion import invariant_covariance, invariant_error
from slamgym.experiments.run_and_replay.summary import pose_nees


def test_first_steps_are_those_at_which_landmarks_enter():
    np.testing.assert_array_equal(make_trace(count=5).first_steps(), [0, 1, 2, 0, 1])


def test_landmark_covariances_are_blocks_of_the_final_covariance():
    trace = make_trace(count=4)
    np.testing.assert_array_equal(
        trace.landmark_covariances[2], trace.final_covariance[7:9, 7:9]
    )


def test_map_at_a_step_holds_only_what_was_seen():
    trace = make_trace(count=5)
    np.testing.assert_array_equal(trace.map_at(0).ids, [10, 13])
    assert trace.map_at(0).covariances.shape == (2, 2, 2)


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("poses", np.zeros((13, 2)), r"poses must have shape \(13, 3\), got \(13, 2\)"),
        ("nis", np.zeros(12), r"nis must have shape \(13,\), got \(12,\)"),
        (
            "true_landmarks",
            np.zeros((5, 2)),
            r"true_landmarks must have shape \(6, 2\)",
        ),
        ("final_covariance", np.eye(14), r"shape \(15, 15\), got \(14, 14\)"),
        ("landmark_history", (), "landmark_history must have 13 entries, got 0"),
        ("t", np.zeros(0), "t must hold at least one step"),
    ],
)
def test_arrays_that_do_not_fit_together_are_refused(name, value, message):
    with pytest.raises(ValueError, match=message):
        make_trace(**{name: value})


def test_unknown_truth_may_be_missing():
    assert make_trace(true_poses=None, true_landmarks=None).true_poses is None


@pytest.mark.parametrize("frame", ["additive", "invariant"])
def test_the_nees_is_that_of_the_error_of_the_truth_in_the_frame_of_the_filter(frame):
    trace = make_trace(frame=frame)
    for step, found in enumerate(pose_nees(trace)):
        true, mean = trace.true_poses[step], trace.poses[step]
        error, P = true - mean, trace.pose_covariances[step]
        if frame == "invariant":
            error, P = invariant_error(true, mean), invariant_covariance(mean, P)
        assert found == pytest.approx(error @ np.linalg.solve(P, error))
