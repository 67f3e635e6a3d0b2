"""A saved state that cannot be is refused, and leaves the filter as it was."""

import copy
import pickle

import numpy as np
import pytest
from comparison import digest
from drives import MEASUREMENT_STD, MOTION_STD, drive

from slamgym.estimator import list_estimators, make_estimator
from slamgym.estimator.guards import saved_states as guard
from slamgym.estimator.map_management.policy import FieldOfView
from slamgym.estimator.smoother.recorded_slam import SmoothingSlam

NOISE = {"motion_std": (0.1, 0.1, 0.05), "measurement_std": (0.05, 0.1)}
READINGS = np.array([[0.1, 4.0], [-0.7, 3.0], [1.4, 5.0], [-2.0, 2.0]])
KINDS = [*list_estimators(), "smoother"]


CIRCLE = np.array([[0.0, 6.25]])  # the middle of the drive
RING = CIRCLE + [
    (r * np.cos(a), r * np.sin(a))
    for r, count in ((4.0, 7), (8.5, 12))
    for a in 2 * np.pi * np.arange(count) / count
]
TIDY = {
    "confirm": (2, 4),
    "view": FieldOfView(5.0),
    "remove_after": 2,
    "merge_within": 3.0,
    "merge_gate": 50.0,
    "capacity": 9,
}
POLICIES = {
    "none": None,
    "default": True,
    "nearest": {"association": "nearest", "backdate": False},
    "joint": {"association": "joint"},
    "compatibility": {"association": "compatibility"},
    "hypotheses": {"association": "hypotheses", "hypotheses": 3},
    "known_density": {"density": 0.02, "trust_ids": False},
    "constellations": {"association": "joint", "constellations": True},
    "tidy": {"association": "nearest", **TIDY},
    "tidy_hypotheses": {"association": "hypotheses", "hypotheses": 3, **TIDY},
}


OTHERS = sorted(set(list_estimators()) - {"ekf", "submaps"})


def make(name, managed, noise=NOISE):
    if name == "smoother":
        return SmoothingSlam(**noise)
    small = {  # fewer than are mapped: else it is dense
        "submaps": {"submap_size": 6},
        "compressed": {"local_size": 4},
        "sparse_information": {"active_bound": 4, "dense_limit": 4},
    }
    options = small.get(name, {})
    return make_estimator(name, **noise, management=managed or None, **options)


def step(slam, k):
    slam.predict((0.2, 0.1))
    ids = [k, k + 1, k + 2, k + 3] if not hasattr(slam, "policy") else None
    if hasattr(slam, "observe_truth") and ids:
        return
    slam.update(READINGS, ids)


def driven(name, managed):
    slam = make(name, managed)
    for k in range(5):
        step(slam, k)
    return slam


def broken(value):
    """Yield what a damaged file may hold instead of a value."""
    yield None
    yield "text"
    yield np.array([None, {}], dtype=object)
    array = np.asarray(value)
    yield array[None]
    if array.ndim and len(array):
        yield array[:-1]
        yield np.concatenate([array, array[:1]])
    if array.dtype.kind == "f" and array.size:
        for strange in (np.nan, np.inf, 1e300):
            yield np.full_like(array, strange)
    if array.ndim == 2 and array.size and array.shape[0] == array.shape[1]:
        yield -np.eye(len(array))
        yield array + np.triu(np.ones_like(array), 1)


def scans(steps):
    """Yield odometry, readings (m, 2) of what is near, and their identities."""
    rng = np.random.default_rng(1)
    for odometry, readings, _ in drive(2, steps, landmarks=RING):
        seen = np.flatnonzero((readings[:, 1] < 5.0) & (rng.random(len(RING)) < 0.8))
        yield odometry, readings[seen], seen.tolist()


def follow(slam, some_scans):
    """Return what a filter reports and remembers step by step, as bytes."""
    found = []
    for odometry, readings, ids in some_scans:
        slam.predict(odometry)
        report = slam.update(readings, None if hasattr(slam, "policy") else ids)
        belief = slam.belief()
        found.append((repr(report), belief.mean.tobytes(), digest(slam)))
        found.append((belief.covariance.tobytes(), belief.landmark_ids))
    return found


def settled(name, policy, steps=22):
    """Return a filter in the middle of a drive, and the rest of its scans."""
    noise = {"motion_std": MOTION_STD, "measurement_std": MEASUREMENT_STD}
    slam, scans_of_all = make(name, policy, noise), list(scans(34))
    follow(slam, scans_of_all[:steps])
    return slam, scans_of_all[steps:]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "policy"),
    [
        *((n, p) for n in ("ekf", "submaps") for p in POLICIES),
        *((n, p) for n in OTHERS for p in ("none", "tidy", "tidy_hypotheses")),
        ("smoother", "none"),
    ],
)
def test_a_filter_continues_bit_for_bit_from_a_pickle_and_from_a_file(
    name, policy, tmp_path
):
    slam, rest = settled(name, POLICIES[policy])
    twin = pickle.loads(pickle.dumps(slam))
    restored, _ = settled(name, POLICIES[policy], 0)
    follow(restored, rest[:9])  # takes back what it has done
    np.savez(tmp_path / "state.npz", **slam.state_dict())
    has_objects = name == "smoother"  # the events that it records
    with np.load(tmp_path / "state.npz", allow_pickle=has_objects) as state:
        restored.load_state_dict(state)
    assert len(slam.belief().landmark_ids) > 2
    expected = follow(slam, rest)
    assert follow(twin, rest) == expected
    assert follow(restored, rest) == expected


# A managed filter saves what its filter saves, and adds the same to each of them.
MANAGED = ["ekf", "ideal", "unscented", "robocentric", "compressed", "submaps"]
MANAGED += ["sparse_information"]


@pytest.mark.parametrize(
    ("name", "managed"), [*((n, False) for n in KINDS), *((n, True) for n in MANAGED)]
)
def test_a_damaged_state_is_refused_or_works(name, managed):
    slam = driven(name, managed)
    state, before = slam.state_dict(), digest(slam)
    loaded = slam.state_dict()
    for saved in (slam.state_dict(), loaded):
        slam.load_state_dict(loaded)
        for value in saved.values():
            value[...] = value.dtype.type()  # of the filter it is no part
        assert digest(slam) == before
    for key, value in state.items():
        for damaged in broken(value):
            other = copy.copy(state) | {key: damaged}
            try:
                slam.load_state_dict(other)
            except ValueError:
                assert digest(slam) == before, key
                continue
            try:
                step(slam, 6)
                belief = slam.belief()
            except (ValueError, np.linalg.LinAlgError):
                slam = make(name, managed)
            else:
                assert np.isfinite(belief.covariance).all(), (key, damaged)
            slam.load_state_dict(state)


@pytest.mark.parametrize("name", KINDS)
def test_a_state_with_an_entry_missing_is_refused(name):
    slam = driven(name, False)
    state = slam.state_dict()
    for key in state:
        with pytest.raises(ValueError, match=f"state .*{key.removeprefix('local_')}"):
            slam.load_state_dict({k: v for k, v in state.items() if k != key})
    with pytest.raises(ValueError, match="state must be a mapping, got None"):
        slam.load_state_dict(None)


def negative(value):
    return -np.eye(len(value))


def without_the_last(value):
    return value[:-1]


@pytest.mark.parametrize(
    ("name", "key", "damaged", "message"),
    [
        ("ekf", "covariance", negative,
         r"state\['covariance'\] must be positive semidefinite"),
        ("robocentric", "covariance", negative,
         "must be positive semidefinite, got the eigenv"),
        *((name, key, negative, f"{key}.* semidefinite") for name, key in (
            ("compressed", "local_covariance"), ("submaps", "submap_0_covariance"),
            ("sparse_information", "pose_covariance"))),
        ("compressed", "far_progress", lambda v: v + np.inf,
         r"state\['far_progress'\] must be finite"),
        ("sparse_information", "local_slots", lambda _: np.array([2.0**63]),
         "local_slots'] must be whole numbers <= 2⁵³"),
        ("sparse_information", "local_slots", lambda v: v[:, None],
         r"state\['local_slots'\] must have shape"),
        *(("joint", f"0.landmarks.{key}", without_the_last, r"state\['landmarks")
          for key in ("ids", "misses", "information")),
    ],
)  # fmt: skip
def test_a_damaged_entry_is_refused_by_name(name, key, damaged, message):
    slam = driven("ekf", POLICIES["joint"]) if name == "joint" else driven(name, False)
    state = slam.state_dict()
    with pytest.raises(ValueError, match=message):
        slam.load_state_dict(state | {key: damaged(state[key])})


@pytest.mark.parametrize("name", KINDS)
def test_a_state_saved_after_an_uncertain_start_is_accepted(name):
    slam = make(name, False)
    for pose in np.random.default_rng(3).normal(size=(20, 3)):
        slam.reset(pose, (0.8, 0.3, 0.1))
        slam.load_state_dict(slam.state_dict())


@pytest.mark.parametrize(
    ("kind", "shape", "taken", "refused"),
    [
        (
            guard.NUMBERS,
            (2,),
            [1.5, -2.0],
            ([1.0], [1.0, np.nan], [[1, 2]], [1e299, 1]),
        ),
        (guard.SYMMETRIC, (2, 2), [[1, 2], [2, -1]], ([[1, 2], [3, 1]], np.eye(3))),
        (guard.COVARIANCE, (2, 2), [[1, 1], [1, 1]], ([[1, 2], [2, 1]], -np.eye(2))),
        (guard.WHOLE, (-1,), [-1, 3, 3], ([1.5], [[1]], "1")),
        (guard.COUNTS, (-1,), [0, 3, 3], ([-1, 2], [True, 2.0])),
        (guard.IDS, (-1,), [-1, 3, 0], ([3, 3], [1.0])),
    ],
    ids=["numbers", "symmetric", "covariance", "whole", "counts", "ids"],
)
def test_an_entry_is_checked_and_copied(kind, shape, taken, refused):
    given = np.array(taken)
    found = kind.checked("key", given, shape)
    given[...] = 0
    assert np.asarray(found).tolist() == taken
    for value in refused:
        with pytest.raises(ValueError, match=r"state\['key'\] must|landmark_ids"):
            kind.checked("key", value, shape)
