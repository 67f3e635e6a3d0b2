"""A call that raises an error leaves every filter as it was; an interrupt marks it."""

import comparison
import numpy as np
import pytest
from inner_parts import map_of
from interrupts import found_after_interrupts

from slamgym.estimator import list_estimators, make_estimator
from slamgym.estimator.large_maps.sparse_information import sparse_information_slam
from slamgym.estimator.large_maps.sparse_information.sparse_belief import SparseBelief
from slamgym.estimator.large_maps.submaps import joining as gauss_newton
from slamgym.estimator.models.bearing_range import predict_measurement
from slamgym.estimator.models.motions import predict_pose
from slamgym.estimator.smoother.recorded_slam import SmoothingSlam

NOISE = {"motion_std": (0.1, 0.1, 0.05), "measurement_std": (0.05, 0.1)}
READINGS = np.array([[0.1, 4.0], [-0.7, 3.0], [1.4, 5.0], [-2.0, 2.0]])
KINDS = [(name, managed) for name in list_estimators() for managed in (False, True)]
POLICIES = [{"association": name} for name in ("nearest", "joint", "compatibility")]
KINDS += [("smoother", False), *(("ekf", policy) for policy in POLICIES)]
NAN, INF = float("nan"), float("inf")
OPTIONS = {
    "submaps": {"submap_size": 6},
    "compressed": {"local_size": 4},
    "sparse_information": {"dense_limit": 4},
}


def make(name, managed, **changes):
    if name == "smoother":
        return SmoothingSlam(**NOISE)
    options = OPTIONS.get(name, {})
    return make_estimator(
        name, **NOISE | changes, management=managed or None, **options
    )


def driven(name, managed):
    slam = make(name, managed)
    for k in range(6):
        slam.predict((0.2, 0.1))
        ids = None if managed else [k, k + 1, k + 2, k + 3]
        slam.update(READINGS, ids)
    return slam


def digest(slam):
    belief = slam.belief()
    parts = {"belief": (belief.mean.tobytes(), belief.covariance.tobytes())}
    return comparison.digest(slam) | parts


INSANE = {
    "predict(iterator)": lambda s: s.predict(iter([1, 2]), dt=None),
    "predict(None)": lambda s: s.predict(None),
    "predict(10**400)": lambda s: s.predict((10**400, 0)),
    "predict(3)": lambda s: s.predict((1.0, 2.0, 3.0)),
    "predict(nan)": lambda s: s.predict((NAN, 0.0)),
    "predict(1e300)": lambda s: s.predict((1e300, 0.0)),
    "dt None": lambda s: s.predict((1.0, 0.0), dt=None),
    "dt text": lambda s: s.predict((1.0, 0.0), dt="1"),
    "dt nan": lambda s: s.predict((1.0, 0.0), dt=NAN),
    "dt 1e300": lambda s: s.predict((1.0, 0.0), dt=1e300),
    "dt -1": lambda s: s.predict((1.0, 0.0), dt=-1.0),
    "update(None)": lambda s: s.update(None, [1]),
    "update(text)": lambda s: s.update("readings", [1]),
    "update(shape)": lambda s: s.update(np.ones((2, 3)), [1, 2]),
    "update(iterator)": lambda s: s.update(iter([(0.1, 2.0)]), [3]),
    "ids short": lambda s: s.update(READINGS, [1, 2, 3]),
    "ids twice": lambda s: s.update(READINGS, [1, 2, 3, 1]),
    "ids text": lambda s: s.update(READINGS, list("abcd")),
    "ids floats": lambda s: s.update(READINGS, [1.5, 2.0, 3.0, 4.0]),
    "ids ragged": lambda s: s.update(READINGS, [[1], [2, 3], 4, 5]),
    "ids a number": lambda s: s.update(READINGS, 4),
    "ids too large": lambda s: s.update(READINGS, [1, 2, 3, 2**70]),
    "ids reserved": lambda s: s.update(READINGS, [1, 2, 3, None]),
    "reading nan": lambda s: s.update(spoilt(NAN), [3, 4, 5, 99]),
    "reading inf": lambda s: s.update(spoilt(INF), [99, 3, 4, 5]),
    "reading 1e300": lambda s: s.update(spoilt(1e300), [3, 99, 4, 5]),
    "far away, nan": lambda s: s.update(spoilt(NAN) * 30, None),
    "remove unknown": lambda s: s.remove([12345]),
    "remove None": lambda s: s.remove(None),
    "remove text": lambda s: s.remove(["a"]),
    "remove ragged": lambda s: s.remove([[1], [2, 3]]),
    "remove half known": lambda s: s.remove([*s.landmark_ids[:1], 12345]),
    "merge unknown": lambda s: s.merge(s.landmark_ids[0], 12345),
    "merge itself": lambda s: s.merge(s.landmark_ids[0], s.landmark_ids[0]),
    "merge text": lambda s: s.merge("a", "b"),
    "merge lists": lambda s: s.merge([1], [2, 3]),
    "merge arrays": lambda s: s.merge(np.ones(2), np.ones(2)),
    "belief unknown": lambda s: s.belief([12345]),
    "belief text": lambda s: s.belief(["a"]),
    "belief ragged": lambda s: s.belief([[1], [2, 3]]),
    "reset None": lambda s: s.reset(None, None),
    "reset nan": lambda s: s.reset((NAN, 0.0, 0.0), (0.0, 0.0, 0.0)),
    "reset -1": lambda s: s.reset((0.0, 0.0, 0.0), (-1.0, 0.0, 0.0)),
    "reset 1e160": lambda s: s.reset((0.0, 0.0, 0.0), (1e160, 0.0, 0.0)),
    "load None": lambda s: s.load_state_dict(None),
    "load nothing": lambda s: s.load_state_dict({}),
}
OPTIONAL = {
    "merge_pairs None": lambda s: s.merge_pairs(None),
    "merge_pairs flat": lambda s: s.merge_pairs([1, 2]),
    "merge_pairs twice": lambda s: s.merge_pairs([(3, 4), (4, 5)]),
    "merge_pairs iterator": lambda s: s.merge_pairs(iter([(3, 12345)])),
    "local_view nan": lambda s: s.local_view(NAN),
    "local_view None": lambda s: s.local_view(None),
    "local_view text": lambda s: s.local_view("far"),
    "observe_truth None": lambda s: s.observe_truth((0.0, 0.0, 0.0), None),
    "observe_truth nan": lambda s: s.observe_truth((NAN, 0.0, 0.0), {}),
    "observe_truth few": lambda s: s.observe_truth((0.0, 0.0, 0.0), {3: (1.0, 1.0)}),
}


def spoilt(value):
    readings = READINGS.copy()
    readings[2, 1] = value
    return readings


@pytest.mark.parametrize(("name", "managed"), KINDS)
def test_an_insane_call_raises_a_plain_error_and_changes_nothing(name, managed):
    slam = driven(name, managed)
    slam.belief()
    before = digest(slam)
    calls = dict(INSANE)
    calls |= {k: c for k, c in OPTIONAL.items() if hasattr(slam, k.split()[0])}
    for label, call in calls.items():
        with pytest.raises((ValueError, np.linalg.LinAlgError)):
            call(slam)
        assert digest(slam) == before, label


WRAPPED = [{"association": name, "confirm": (1, 2)} for name in ("joint", "hypotheses")]
INTERRUPTED = [(name, policy) for name in list_estimators() for policy in WRAPPED]
INTERRUPTED += [(name, False) for name in ("smoother", *OPTIONS)]


@pytest.mark.parametrize(("name", "managed"), INTERRUPTED)
def test_an_interrupt_leaves_no_filter_mixed_without_a_mark(name, managed):
    slam = driven(name, managed)
    ids = None if managed else [5, 6, 7, 8]
    if managed and managed["association"] == "hypotheses":
        for _ in range(6):
            slam.predict((0.2, 0.1))
        slam.update(READINGS)
        assert len(slam.hypotheses) > 1

    def some(total):
        return np.linspace(0, total - 1, 14).astype(int).tolist()

    found_after_interrupts(slam, lambda s: s.predict((0.2, 0.1)), some)
    slam.predict((0.2, 0.1))
    found = found_after_interrupts(slam, lambda s: s.update(READINGS, ids), some)
    assert found >= {"before", "marked"}
    slam.interrupted_in = "update"
    for refused in ("reset None", "load nothing"):  # the mark stays
        with pytest.raises(ValueError, match=r"pose|state"):
            INSANE[refused](slam)
        with pytest.raises(RuntimeError, match="was interrupted in update"):
            slam.belief()
    slam.reset(np.zeros(3), np.zeros(3))
    assert slam.belief().landmark_ids == ()


TOLD = {i: (r * np.cos(b), r * np.sin(b)) for i, (b, r) in enumerate(READINGS)}


@pytest.mark.parametrize(
    ("name", "options", "call"),
    [
        ("ideal", {}, lambda slam: slam.observe_truth((0.1, 0.0, 0.0), TOLD)),
        (
            *("ekf", {"landmark_init": "delayed"}),
            lambda slam: slam.update(READINGS - (0.2, 0.1), range(4)),
        ),
    ],
)
def test_an_interrupted_filter_without_marks_is_as_before_or_after(name, options, call):
    slam = make_estimator(name, **NOISE, **options)
    slam.update(READINGS, range(4))
    slam.predict((0.6, 0.2))

    def some(total):
        return np.linspace(0, total - 1, 50).astype(int).tolist()

    found = found_after_interrupts(slam, call, some)
    assert {"before"} <= found <= {"before", "after"}


@pytest.mark.parametrize(
    ("name", "managed"), [("submaps", False), ("compressed", False), ("submaps", True)]
)
def test_more_landmarks_than_a_local_map_holds_change_nothing(name, managed):
    slam = driven(name, managed)
    if managed:
        slam.map_view()
    many = np.column_stack([np.linspace(-3, 3, 7), np.full(7, 40.0)])
    before = digest(slam)
    with pytest.raises(ValueError, match=r"_size must be >= [57], .* got [64]"):
        slam.update(many, [*range(1, 6), 60, 61])
    assert digest(slam) == before


@pytest.mark.parametrize("name", ["compressed", "sparse_information"])
def test_an_update_that_fails_after_the_local_map_changed_is_taken_back(
    name, monkeypatch
):
    slam = driven(name, False)
    for k in range(12):
        slam.predict((3.0, 0.0))
        slam.update(READINGS, [20 + 4 * k + j for j in range(4)])
    before, inside = digest(slam), set(slam.local_ids)
    absent = [i for i in slam.landmark_ids if i not in inside][:3]
    assert absent or name == "sparse_information"

    def fail(*_, **__):
        raise np.linalg.LinAlgError("not positive definite")

    with monkeypatch.context() as patch:
        if name == "compressed":
            patch.setattr(type(map_of(slam).filter), "update", fail)
        else:
            patch.setattr(sparse_information_slam, "process_scan", fail)
            patch.setattr(
                SparseBelief, "new_local_map", lambda self, ids: self.local.slots[::-1]
            )
        with pytest.raises(np.linalg.LinAlgError):
            slam.update(READINGS[: max(len(absent), 1)], absent or [0])
    assert digest(slam) == before
    slam.update(READINGS[: max(len(absent), 1)], absent or [0])  # as if it were new
    assert np.isfinite(slam.belief().covariance).all()


def around_a_ring(slam, steps):
    """Drive a filter over hidden identities around a ring of landmarks."""
    angles = np.linspace(0, 2 * np.pi, 20, endpoint=False)
    landmarks = 9.0 * np.column_stack([np.cos(angles), np.sin(angles)]) + (0.0, 5.0)
    pose = np.zeros(3)
    for _ in range(steps):
        pose = predict_pose(pose, np.array([0.5, 0.1])).pose
        near = np.hypot(*(landmarks - pose[:2]).T) < 6
        slam.predict((0.5, 0.1))
        slam.update(predict_measurement(pose, landmarks[near]).measurement)


def test_a_join_that_fails_leaves_managed_submaps_as_they_were(monkeypatch):
    slam = make("submaps", True)
    around_a_ring(slam, 40)

    with monkeypatch.context() as changed:
        changed.setattr(gauss_newton, "ITERATIONS", 0)
        around_a_ring(slam, 8)
        before = comparison.digest(slam)
        with pytest.raises(np.linalg.LinAlgError, match="did not converge"):
            slam.belief()
        assert comparison.digest(slam) == before
    assert np.isfinite(slam.belief().covariance).all()


@pytest.mark.parametrize("seed", [0, 8, 9, 10, 11])
def test_an_exact_sensor_that_reads_more_than_the_pose_has_is_refused(seed):
    rng = np.random.default_rng(seed)
    exact = {"motion_std": (0.1, 0.1, 0.05), "measurement_std": (0.0, 0.0)}
    slam = make_estimator("ekf", **exact)
    readings = np.column_stack([rng.uniform(-3, 3, 2), rng.uniform(1, 9, 2)])
    slam.update(readings, [1, 2])
    slam.predict(rng.uniform(-0.1, 0.1, 2))
    before = digest(slam)
    with pytest.raises(np.linalg.LinAlgError, match="positive definite"):
        slam.update(readings, [1, 2])  # 4 numbers about 3 unknown ones
    assert digest(slam) == before
