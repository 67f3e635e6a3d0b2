import numpy as np
import pytest
from run_traces import make_trace

from slamgym.estimator.interface import ScanDecisions, UpdateReport
from slamgym.estimator.models.rigid_motion import invariant_covariance, invariant_error
from slamgym.evaluation.association_scores import CUTOFF, gospa, score_association
from slamgym.experiments.logs.ground_truth import TrueLandmarks
from slamgym.experiments.run_and_replay.summary import pose_nees
from slamgym.experiments.run_and_replay.trace import (
    DecisionRecorder,
    RunDecisions,
    accuracy_of,
    compare_association,
    quotient,
    root_mean_square,
)


def test_first_steps_are_those_at_which_landmarks_enter():
    np.testing.assert_array_equal(make_trace(count=5).first_steps(), [0, 1, 2, 0, 1])
    nothing, maps = make_trace(count=0).landmark_history[0], make_trace()
    assert (make_trace(count=0).step_of_first_map(), maps.step_of_first_map()) == (0, 0)
    later = (nothing, nothing, *maps.landmark_history[2:])
    assert make_trace(landmark_history=later).step_of_first_map() == 2


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
        ("true_poses", np.zeros((12, 3)), r"true_poses must have shape \(13, 3\)"),
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
    trace = make_trace(true_poses=None, true_landmarks=None)
    assert trace.true_poses is None
    assert trace.every_true_landmark.shape == (0, 2)


@pytest.mark.parametrize("frame", ["additive", "invariant"])
def test_the_nees_is_that_of_the_error_of_the_truth_in_the_frame_of_the_filter(frame):
    trace = make_trace(frame=frame)
    for step, found in enumerate(pose_nees(trace)):
        true, mean = trace.true_poses[step], trace.poses[step]
        error, P = true - mean, trace.pose_covariances[step]
        if frame == "invariant":
            error, P = invariant_error(true, mean), invariant_covariance(mean, P)
        assert found == pytest.approx(error @ np.linalg.solve(P, error))


def test_an_association_is_compared_before_and_after_alignment():
    truth = TrueLandmarks(np.array([4, 7, 9]), np.array([[0.0, 0], [4, 0], [0, 3]]))
    landmarks = truth.positions[:2] + np.array([0.4, -0.2])
    decisions = [ScanDecisions((1, 2), (1, 2)), ScanDecisions((1, 1), ())]
    ids = [np.array([4, 7]), np.array([4, 7])]
    run = RunDecisions(decisions, ids, (1, 1))
    found = compare_association(run, truth, landmarks, truth.positions[:2])
    assert found.resolution == 0
    scores = score_association(
        decisions, ids, places={4: 0, 7: 1, 9: 2}, confirm=(1, 1)
    )
    assert found.scores == scores
    seen = truth.positions[:2]
    assert found.raw == gospa(landmarks, seen)
    np.testing.assert_allclose(found.aligned, gospa(seen, seen), atol=1e-9)
    table = found.as_dict()
    assert table["gospa"] == {
        "raw": found.raw._asdict(), "aligned": found.aligned._asdict(), "cutoff": CUTOFF
    }  # fmt: skip
    assert (table["wrong"], table["precision"]) == (scores.wrong, scores.precision)
    unknown = compare_association(None, truth, landmarks, None, resolution=3.5)
    assert (
        unknown.raw
        == unknown.aligned
        == gospa(landmarks, truth.positions, places=[0, 1, 0])
    )
    assert unknown.as_dict()["wrong"] is None


def test_landmarks_are_compared_where_both_coordinates_are_known():
    truth = np.array([[0.0, 0], [4, 0], [np.nan, 3], [0, 3]])
    found = accuracy_of(truth + np.array([0.5, 0.0]), truth)
    assert found.raw_rmse == pytest.approx(0.5)
    assert accuracy_of(truth, None) is None


def test_decisions_of_a_filter_are_those_of_its_reports():
    recorder = DecisionRecorder(object())
    report = UpdateReport(row_ids=(3, None, 5, 8), added_ids=(5,), confirmed_ids=(3,))
    recorder.add(report, np.array([1, -1, 2, 2]))
    recorder.add(UpdateReport(), None)
    assert recorder._reported[0] == ScanDecisions((3, None, 5, 8), (3, 5))


def test_statistics_leave_out_what_is_not_finite():
    assert root_mean_square([3.0, np.nan, 4.0, np.inf]) == pytest.approx(np.sqrt(12.5))
    assert root_mean_square([np.nan]) is None
    assert root_mean_square([1e200]) is None
    values, freedom = np.array([3.0, np.nan, 9.0]), np.array([2, 100, 4])
    assert quotient(values, freedom) == 2.0
    assert quotient(values[1:2], freedom[1:2]) is None
