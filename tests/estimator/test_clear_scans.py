"""Scans that compiled calls take in, beside the same scans taken in by the search."""

from dataclasses import fields

import numpy as np
import pytest

from slamgym.envs import LandmarkWorldEnv
from slamgym.estimator import UpdateReport, make_estimator
from slamgym.estimator.association.constellations import Constellations
from slamgym.estimator.map_management import loop_closing
from slamgym.estimator.map_management.clear_scans import ClearScans
from slamgym.estimator.map_management.managed_slam import ManagedSlam
from slamgym.estimator.models.bearing_range import predict_measurement
from slamgym.experiments.run_and_replay.filter_settings import SMOOTHER
from slamgym.sim_configs import action_sequence, load_scenario


@pytest.fixture
def count(monkeypatch):
    """Return a list with a flag per scan of the first twin: whether it is clear."""
    clear, take = [], ManagedSlam._update_clear

    def counted(slam, *args):
        report = take(slam, *args)
        if slam._hypotheses[0]._clear is not None:
            clear.append(report is not None)
        return report

    monkeypatch.setattr(ManagedSlam, "_update_clear", counted)
    return clear


def make(name="invariant", world=None, *, clear=True, **management):
    """Return a managed filter, with clear scans or with the search alone."""
    noise = {"motion_std": (0.05, 0.02, 0.01), "measurement_std": (0.02, 0.08)}
    if world is not None:
        noise = {"motion_std": world.motion.std, "measurement_std": world.sensor.std}
        noise |= {"initial_pose": world.start.pose, **world.models}
    with pytest.MonkeyPatch.context() as patch:
        if not clear:
            patch.setattr(ClearScans, "serve", lambda *_: False)
        return make_estimator(name, **noise, management=management or True)


def scans_of(name, steps):
    world = load_scenario(name)
    env = LandmarkWorldEnv(world)
    observation, _ = env.reset(seed=3)
    for action in action_sequence(world)[:steps]:
        mask = observation["mask"]
        yield observation["odometry"], observation["landmarks"][mask], mask.nonzero()[0]
        observation, *_ = env.step(action)


def assert_same_report(one, other):
    for field in fields(UpdateReport):
        if field.name != "factor":
            values = getattr(one, field.name), getattr(other, field.name)
            np.testing.assert_array_equal(*values, err_msg=field.name)
    np.testing.assert_array_equal(one.innovation_factor, other.innovation_factor)


def assert_same_state(one, other):
    states = one.state_dict(), other.state_dict()
    assert states[0].keys() == states[1].keys()
    for key in states[0]:
        values = [state[key] for state in states]
        if key.endswith(("missed", "shown")):  # in any order
            values = [np.sort(value, axis=0) for value in values]
        np.testing.assert_array_equal(*values, err_msg=key)


def compare(twins, scans, *, given=False, renew=7):
    """Drive two filters; all that they return must be equal to the bit."""
    for k, (odometry, readings, ids) in enumerate(scans):
        reports = []
        for slam in twins:
            if k:
                slam.predict(odometry)
            reports.append(slam.update(readings, ids if given else None))
        assert_same_report(*reports)
        assert_same_report(reports[0], twins[0].report())
        if k % renew == 0:
            assert_same_state(*twins)
            assert twins[0].lost_score == twins[1].lost_score
    assert_same_state(*twins)
    assert twins[0].decisions == twins[1].decisions
    assert twins[0].steps == twins[1].steps
    beliefs = [slam.belief() for slam in twins]
    np.testing.assert_array_equal(beliefs[0].mean, beliefs[1].mean)
    np.testing.assert_array_equal(beliefs[0].covariance, beliefs[1].covariance)


@pytest.mark.parametrize(
    ("name", "options", "least"),
    [
        ("loop", {}, 0.5),
        ("corridor", {}, 0.6),
        ("dropout", {}, 0.4),
        ("hidden_identities", {}, 0.5),
        ("six_landmarks", {"constellations": None}, 0.5),
        ("corridor", {"association": "joint", "density": 0.05}, 0.6),
        ("corridor", {"backdate": False, "capacity": 12}, 0.2),
        *(("loop", {"name": k}, 0.4) for k in ("ekf", "first_estimates", "iterated")),
    ],
)
def test_a_clear_scan_gives_the_same_bits_as_the_search(count, name, options, least):
    world = load_scenario(name)
    twins = [make(world=world, clear=clear, **options) for clear in (True, False)]
    compare(twins, scans_of(name, 200))
    assert np.mean(count) > least


@pytest.mark.parametrize(
    ("gap", "place", "kept"), [(0.1, 0.1, 2), (0.3, 0.3, 1), (0.3, 0.0, 1)]
)
def test_a_clear_scan_discards_a_hypothesis_that_it_refutes(count, gap, place, kept):
    places = np.array([(4.0, 3.0 * k - 7.0) for k in range(6)])
    twins = [make("ekf", clear=clear) for clear in (True, False)]
    first, last = (
        predict_measurement(np.array([x, 0.0, 0.0]), places).measurement
        for x in (0.0, place)
    )
    for slam in twins:
        for _ in range(4):
            slam.update(first)
        state = slam.state_dict()
        other = {f"1{k[1:]}": v.copy() for k, v in state.items() if k[0] == "0"}
        other["1.filter.mean"][0] += gap
        slam.load_state_dict(state | other | {"costs": np.array([0.0, 5.0])})
    compare(twins, [(None, last, None)])
    assert count[-1]
    assert len(twins[0].hypotheses) == kept
    assert repr(twins[0]).endswith(", best of 2 hypotheses") == (kept > 1)


def test_several_hypotheses_take_scans_as_the_search_does(count):
    clear = 0
    for seed in range(6):
        rng, twins = np.random.default_rng(seed), [make(clear=c) for c in (True, False)]
        places = rng.uniform((2.0, -5.0), (8.0, 5.0), (7, 2))
        places[5:] = places[:2] + rng.normal(0.0, 0.3, (2, 2))  # near the first two
        first = predict_measurement(np.zeros(3), places).measurement
        for slam in twins:
            for _ in range(4):
                slam.update(first)
        state = twins[0].state_dict()
        for k in (1, 2):
            other = {f"{k}{i[1:]}": v.copy() for i, v in state.items() if i[0] == "0"}
            other[f"{k}.filter.mean"] += rng.normal(0.0, 0.1, 17)
            state |= other
        state["costs"] = np.array([0.0, *np.sort(rng.uniform(0.0, 20.0, 2))])
        scans = [first + rng.normal(0.0, (0.02, 0.08), (7, 2)) for _ in range(6)]
        for slam in twins:
            slam.load_state_dict(state)
        count.clear()
        compare(twins, [((0.0, 0.0), readings, None) for readings in scans], renew=1)
        clear += sum(count)
    assert 5 < clear < 31


def test_given_identities_of_mapped_landmarks_are_a_clear_scan(count):
    twins = [make(world=load_scenario("loop"), clear=clear) for clear in (True, False)]
    compare(twins, scans_of("loop", 150), given=True)
    assert np.mean(count) > 0.8


@pytest.mark.parametrize(("lost_std", "has_lost"), [(2.0, False), (0.5, True)])
def test_a_large_map_takes_clear_scans_without_its_lost_landmarks(
    count, lost_std, has_lost
):
    rng = np.random.default_rng(2)
    places = rng.uniform(-40, 40, (180, 2))
    scan = np.stack([np.arctan2(*places.T[::-1]), np.hypot(*places.T)], axis=1)
    near = np.argsort(scan[:, 1])[:9]
    noise = rng.standard_normal((30, 9, 2)) * (0.02, 0.08)
    rules = Constellations(lost_std=lost_std)
    twins = [make(clear=clear, constellations=rules) for clear in (True, False)]
    for slam in twins:
        slam.update(scan, np.arange(len(scan)))
    compare(twins, [((0.0, 0.0), scan[near] + more, None) for more in noise])
    assert loop_closing.lost(twins[0].best.map_view(), rules).any() == has_lost
    assert np.mean(count) > 0.5


@pytest.mark.parametrize("association", ["joint", "hypotheses"])
@pytest.mark.parametrize("gap", [0.3, 0.6, 1.2])
def test_landmarks_near_each_other_and_clutter_give_the_same_bits(
    count, association, gap
):
    """Readings near the gates, of two landmarks each, of none, and of new ones."""
    rng = np.random.default_rng(int(100 * gap))
    first = rng.uniform((-2.5, 2.0), (2.5, 7.0), (7, 2))
    places = np.vstack(
        [first, first[:4] + rng.normal(scale=(gap / 5, gap), size=(4, 2))]
    )
    noise = rng.standard_normal((80, len(places), 2)) * (0.03, 0.12)
    scans = []
    for k, more in enumerate(noise):
        seen = rng.random(len(places)) < (0.9 if k else 2.0)
        clutter = rng.uniform((-3.0, 1.0), (3.0, 8.0), (int(k % 5 == 4), 2))
        scans.append(((0.0, 0.0), np.vstack([(places + more)[seen], clutter]), None))
    twins = [make(clear=clear, association=association) for clear in (True, False)]
    compare(twins, scans)
    assert any(count)
    assert not all(count)


@pytest.mark.parametrize("given", [True, False])
def test_one_call_takes_in_a_scan_that_leaves_nothing_to_decide(monkeypatch, given):
    scans, later = [*scans_of("six_landmarks", 120)], []
    slam = make(world=load_scenario("six_landmarks"))
    update = ClearScans._updated

    def counted(clear, scan):
        later.append(scan.number)
        return update(clear, scan)

    monkeypatch.setattr(ClearScans, "_updated", counted)
    for odometry, readings, ids in scans:
        slam.predict(odometry)
        slam.update(readings, ids if given else None)
    assert len(later) < 30


def test_the_kernel_decides_whether_the_only_hypothesis_splits(monkeypatch):
    """The search then splits it: these scans are not clear, and nearly all others."""
    split, searched, associate = 0, 0, ClearScans.associate

    def watched(*given):
        scan = associate(*given)
        assert not given[-1] or scan is None or len(scan.costs) == 1
        return scan

    monkeypatch.setattr(ClearScans, "associate", watched)
    slam = make(world=load_scenario("hidden_identities"))
    for odometry, readings, _ in scans_of("hidden_identities", 400):
        is_single, before = len(slam.hypotheses) == 1, slam.landmark_ids
        slam.predict(odometry)
        report = slam.update(readings)
        split += is_single and len(slam.hypotheses) > 1
        is_searched = slam.best._report is report and before == slam.landmark_ids
        searched += is_single and is_searched and len(slam.hypotheses) == 1
    assert split > 3
    assert searched == 0


@pytest.mark.parametrize("change", ["remove", "merge", "observe", "load", "resume"])
def test_changes_between_clear_scans_leave_the_same_filter(count, change):
    scans, world = [*scans_of("loop", 160)], load_scenario("loop")
    twins = [make(world=world, clear=clear) for clear in (True, False)]
    compare(twins, scans[:100])
    for slam in twins:
        state, kept = slam.state_dict(), slam.snapshot()
        first, second = slam.landmark_ids[:2]
        if change == "remove":
            slam.remove([first])
        elif change == "merge":
            slam.merge(first, second)
        elif change == "observe":
            slam.observe_pose(slam.belief().pose[2], [0, 0, 1], 0.01)
        else:
            for odometry, readings, _ in scans[100:110]:
                slam.predict(odometry)
                slam.update(readings)
            slam.load_state_dict(state) if change == "load" else slam.resume(kept)
    count.clear()
    compare(twins, scans[100:], renew=1)
    assert any(count)


def test_a_recorder_takes_clear_scans_and_records_the_same_drive(count):
    world = load_scenario("loop")
    twins = [make(SMOOTHER, world, clear=clear) for clear in (True, False)]
    for odometry, readings, _ in scans_of("loop", 120):
        for slam in twins:
            slam.predict(odometry)
        assert_same_report(*[slam.update(readings) for slam in twins])
    assert np.mean(count) > 0.5
    one, other = (slam.filter.smoothed() for slam in twins)
    np.testing.assert_array_equal(one.landmarks, other.landmarks)
    np.testing.assert_array_equal(one.poses, other.poses)


def test_reading_the_report_later_changes_nothing():
    slam = make(world=load_scenario("loop"))
    for odometry, readings, _ in scans_of("loop", 60):
        slam.predict(odometry)
        report = slam.update(readings)
        assert slam.report().row_ids == report.row_ids
        kept = report
    slam.predict((0.1, 0.0))
    assert slam.report() == kept


def test_a_view_does_not_outlive_a_clear_scan_that_moves_the_map(count):
    slam, places = make(), np.linspace(-2.0, 2.0, 60)
    scan = np.stack([places, np.full(60, 9.0)], axis=1)
    for first in (0, 20, 40):
        for _ in range(2):
            slam.update(scan[first : first + 20], range(first, first + 20))
    (one,) = slam.hypotheses
    before = one.editor.map_view()
    slam.update(scan, range(60))  # more readings than any scan before
    assert count[-1]
    view = one.editor.map_view()
    np.testing.assert_array_equal(view.covariance, one.map_view().covariance)
    assert (view.covariance.diagonal()[:123] < before.covariance.diagonal()[:123]).any()


def standing(**management):
    """Return a filter that has mapped four landmarks, and their readings."""
    readings = np.array([(0.1, 4.0), (1.5, 5.0), (-1.2, 6.0), (3.0, 3.0)])
    slam = make(**management)
    slam.update(readings, range(4))
    return slam, readings


def test_an_error_after_a_scan_has_been_taken_in_at_once_leaves_a_mark(monkeypatch):
    slam, readings = standing()
    slam.update(readings)

    def failing(*_):
        raise MemoryError

    monkeypatch.setattr(ClearScans, "update", failing)
    inside = slam.filter
    before = inside.belief().covariance
    with pytest.raises(MemoryError):
        slam.update(readings)
    monkeypatch.undo()
    assert (inside.belief().covariance != before).any()
    with pytest.raises(RuntimeError, match="interrupted in update"):
        slam.predict((0.1, 0.0))
