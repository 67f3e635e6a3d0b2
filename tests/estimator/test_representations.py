"""Filters, beliefs and reports show in one line what they hold."""

from types import SimpleNamespace

import numpy as np
import pytest
from comparison import assert_same_bits, part_of

from slamgym.estimator import (
    Belief,
    EkfSlam,
    InvariantEkfSlam,
    UpdateReport,
    interface,
    list_estimators,
    make_batch,
    make_estimator,
)
from slamgym.estimator.interface import MapView, marginal_without_joining
from slamgym.estimator.registry import accepted_models, split_labels

NOISE = {"motion_std": (0.1, 0.1, 0.05), "measurement_std": (0.02, 0.1)}


@pytest.mark.parametrize("name", list_estimators())
def test_a_filter_shows_class_landmarks_and_pose_and_stays_as_it_is(name):
    slam = make_estimator(name, **NOISE, initial_pose_std=(0.1, 0.2, 0.01))
    slam.update([(0.0, 2.0), (1.0, 3.0)], [3, 5])
    before = slam.belief()
    shown = repr(slam)
    assert shown.startswith(f"{type(slam).__name__} of 2 landmarks, pose (0.000 ± 0.1")
    assert "\n" not in shown
    near = marginal_without_joining(slam, [5])
    assert near.frame == before.frame
    np.testing.assert_allclose(near.landmarks, before.landmarks[1:], atol=1e-12)
    np.testing.assert_array_equal(slam.belief().covariance, before.covariance)
    slam.predict((0.0, 4.0))
    assert slam.belief().pose[2] == pytest.approx(4.0 - 2 * np.pi)


def test_a_belief_a_report_and_a_managed_filter_show_what_they_hold():
    slam = make_estimator("ekf", management={"confirm": (1, 1)}, **NOISE)
    assert repr(slam) == "Managed " + repr(slam.filter)
    report = slam.update([(0.0, 2.0)])
    assert repr(report).endswith("of 0 degrees of freedom, 1 added, 1 confirmed")
    assert repr(slam.belief()).startswith("Belief of 1 landmark, pose (0.000 ± 0.000 m")


def test_the_error_of_a_marginal_is_additive_by_default():
    whole = np.arange(7.0), np.diag(np.arange(1.0, 8.0))
    part = Belief.marginal(*whole, {3: 0, 5: 1}, [5])
    assert part.frame == "additive"
    assert Belief.marginal(*whole, {3: 0}, [3], "invariant").frame == "invariant"
    np.testing.assert_array_equal(part.landmarks, [(5.0, 6.0)])
    np.testing.assert_array_equal(part.covariance.diagonal(), [1, 2, 3, 6, 7])


def test_an_error_is_the_truth_minus_the_estimate():
    belief = Belief(np.array([1.0, 2.0, 3.1, 4.0, 5.0]), np.eye(5), (7,))
    error = belief.error((1.5, 2.0, -3.1), [(4.0, 6.0)])
    expected = [0.5, 0.0, 2 * np.pi - 6.2, 0.0, 1.0]
    np.testing.assert_allclose(error, expected, atol=1e-12)


def test_a_part_of_a_view_knows_the_whole_map():
    view = MapView(np.arange(7.0), np.eye(7), (3, 5))
    part = view.part([1])
    assert (part.ids, part.mapped) == ([5], (3, 5))
    assert view._replace(whole=(9, 3, 5)).part([0]).mapped == (9, 3, 5)


def six_methods(**noise):
    """Return a filter that has no method beyond those of the interface."""
    inside = InvariantEkfSlam(**noise)
    names = ("reset", "predict", "update", "state_dict", "load_state_dict")
    methods = {name: getattr(inside, name) for name in names}
    return SimpleNamespace(belief=lambda: inside.belief(None), **methods)


class ShowsAnother(EkfSlam):
    """A filter whose map is not its belief."""

    def belief(self):
        whole = super().belief()
        return Belief(whole.mean + 1.0, 2.0 * whole.covariance, (8, 9))


@pytest.mark.parametrize("kind", [EkfSlam, six_methods, ShowsAnother])
def test_the_map_of_any_filter_is_that_of_its_belief(kind):
    slam = kind(**NOISE)
    slam.update([(0.0, 2.0), (1.0, 3.0)], [3, 5])
    whole, view = slam.belief(), interface.view_map(slam)
    ids = whole.landmark_ids
    assert interface.mapped_ids(slam) == ids == tuple(view.ids)
    np.testing.assert_array_equal(view.mean[:7], whole.mean)
    np.testing.assert_array_equal(view.covariance[:7, :7], whole.covariance)
    for name in ("landmarks", "landmark_covariances"):
        np.testing.assert_array_equal(getattr(view, name), getattr(whole, name))
    both = interface.marginal(slam, ids[::-1])
    assert_same_bits(both, part_of(whole, ids[::-1]))
    assert both.frame == whole.frame

    @interface.returned_on_error(slam)
    def interrupted():
        slam.predict((1.0, 0.3))
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert_same_bits(slam.belief(), whole)


def test_the_nis_of_a_fix_is_added_to_that_of_the_scan():
    scan, fix = (UpdateReport(nis=n, degrees_of_freedom=2 + n) for n in (3, 1))
    both = interface.with_fix(scan.replace(added_ids=(4,)), fix)
    assert (both.nis, both.degrees_of_freedom, both.added_ids) == (4, 8, (4,))


OPTIONS = (
    "sensor, landmark_init, gate_probability, noise_at_rest, min_range, motion, "
    "range_std_per_metre, bearing_std_metres, range_noise_at"
)


@pytest.mark.parametrize(
    ("name", "option", "message"),
    [
        ("ekf", "gate", f"; did you mean 'gate_probability'? (there are {OPTIONS})"),
        ("slamgym.estimator:EkfSlam", "x", f" (there are {OPTIONS})"),
        ("unscented", "iterations", f" (there are {OPTIONS})"),
        ("compressed", "x", f" (there are base, local_size, {OPTIONS})"),
    ],
)
def test_an_unknown_option_is_refused_with_those_that_there_are(name, option, message):
    with pytest.raises(ValueError, match="has no option") as caught:
        make_estimator(name, **NOISE, **{option: 1})
    shown = name.rpartition(":")[2]
    assert str(caught.value) == f"{shown} has no option '{option}'{message}"
    with pytest.raises(TypeError, match="argument 'motion_std'"):
        make_estimator("fractions:Fraction", **NOISE)


def test_models_that_an_estimator_does_not_take_are_refused():
    models = {"noise_at_rest": False, "sensor": "position"}
    assert accepted_models(EkfSlam, models) == models
    with pytest.raises(ValueError, match="not accept sensor = 'position'"):
        accepted_models(lambda noise: None, models)


def test_a_batch_shows_its_runs():
    batch = make_batch("ekf", runs=3, landmarks=2, **NOISE)
    assert repr(batch) == "BatchSlam of 3 runs, 0 to 0 of 2 landmarks mapped, 0 stopped"


def test_reports_are_snapshots_that_compare_and_survive_a_pickle():
    import pickle

    slam, other = (make_estimator("ekf", **NOISE) for _ in range(2))
    for each in (slam, other):
        each.update([(0.0, 2.0), (1.0, 3.0)], [3, 5])
    report, same = (
        each.update([(0.1, 2.1), (0.9, 3.0)], [3, 5]) for each in (slam, other)
    )
    kept = pickle.loads(pickle.dumps(same))
    slam.predict((1.0, 0.1))
    later = slam.update([(0.1, 1.1), (0.9, 2.0)], [3, 5])
    assert report == same == kept
    assert report != later
    assert report != report.replace(added_ids=(9,))
    np.testing.assert_allclose(
        report.nis,
        report.innovation.ravel()
        @ np.linalg.solve(report.innovation_covariance, report.innovation.ravel()),
    )


def test_reports_differ_where_any_part_does():
    assert UpdateReport().innovation_covariance.shape == (0, 0)
    report = UpdateReport(innovation=np.ones((1, 2)), factor=np.eye(2))
    assert report == UpdateReport(innovation=np.ones((1, 2)), factor=lambda: np.eye(2))
    others = {"nis": 1.0, "degrees_of_freedom": 2, "merged_ids": ((1, 2),)}
    others |= {"innovation": np.zeros((1, 2)), "factor": 2 * np.eye(2)}
    others |= {f"{name}_rows": (1,) for name in ("tentative", "ambiguous")}
    names = ("associated", "added", "rejected", "skipped", "near", "confirmed")
    others |= {f"{name}_ids": (1,) for name in (*names, "removed")}
    for name, value in (others | {"row_ids": (None,)}).items():
        changed = report.replace(**{name: value})
        assert changed != report, name
        assert getattr(changed, name) is value
        shown = f", 1 {name.partition('_')[0]}" in repr(changed)
        is_list = name.endswith(("_ids", "_rows")) and name != "row_ids"
        assert shown == is_list, name


def test_labels_are_split_at_commas_outside_brackets():
    labels = "invariant[iterations=3,min_range=0.5],ekf, m:C[a=[1,2],b=3] ,"
    expected = ["invariant[iterations=3,min_range=0.5]", "ekf", "m:C[a=[1,2],b=3]"]
    assert split_labels(labels) == expected
