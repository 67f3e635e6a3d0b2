"""A batch of runs against single filters fed the same data, bit for bit."""

import numpy as np
import pytest
from comparison import assert_same_bits
from drives import MEASUREMENT_STD, MOTION_STD, NOISE, drive
from numpy_belief_features import marginals_of

from slamgym.estimator import (
    BatchSlam,
    EkfSlam,
    list_estimators,
    make_batch,
    make_estimator,
)
from slamgym.estimator.filters.batch import BatchBeliefs
from slamgym.estimator.kernels.batch import drive_runs

RUNS, STEPS, LANDMARKS = 5, 40, 13
CASES = {
    "ekf": ("ekf", {}),
    "gated": ("ekf", {"gate_probability": 0.9, "range_std_per_metre": 0.02}),
    "positions": ("ekf", {"bearing_std_metres": 0.1, "range_noise_at": "reading"}),
    "independent": ("ekf", {"landmark_init": "independent", "noise_at_rest": False}),
    "invariant": ("invariant", {}),
    "invariant once": ("invariant", {"iterations": 1}),
    "iterated": ("iterated", {}),
    "first_estimates": ("first_estimates", {}),
    "observability_constrained": ("observability_constrained", {}),
}


@pytest.fixture(scope="module")
def data():
    """Odometry, measurements, visibility: each run its own map, noise and gaps."""
    odometry = np.empty((RUNS, STEPS, 2))
    measurements = np.full((RUNS, STEPS, LANDMARKS, 2), np.nan)
    rng = np.random.default_rng(0)
    visible = rng.random((RUNS, STEPS, LANDMARKS)) < 0.4
    visible[2, :, 5:] = False  # a run with a small map
    visible[3, 10:20] = False  # a run that sees nothing for a while
    for run in range(RUNS):
        landmarks = rng.uniform(-15, 15, (LANDMARKS, 2))
        for step, (u, z, _) in enumerate(drive(run, STEPS, landmarks=landmarks)):
            odometry[run, step] = u
            measurements[run, step] = z
    odometry[1, 15:18] = 0.0  # a run that rests
    measurements[~visible] = np.nan
    measurements[0, 5, np.argmax(visible[0, 5]), 1] = -0.1  # a reading to skip
    return odometry, measurements, visible


def single(name, options, data, run, dt):
    start = {"initial_pose": (run, 0, 0), "initial_pose_std": (0.1, 0.1, 0.02)}
    slam = make_estimator(name, **NOISE, **start, **options)
    odometry, measurements, visible = data
    rows = []
    for step in range(STEPS):
        slam.predict(odometry[run, step], dt[step])
        seen = np.flatnonzero(visible[run, step])
        report = slam.update(measurements[run, step, seen], seen)
        belief = slam.belief()
        rows.append((belief.pose, belief.pose_covariance, report))
    return slam.belief(), rows


@pytest.mark.parametrize("case", CASES)
def test_each_run_gives_the_bits_of_a_single_filter(case, data):
    name, options = CASES[case]
    dt = np.ones(STEPS)
    dt[0], dt[7] = 0.0, 2.5
    batch = make_batch(
        name,
        runs=RUNS,
        landmarks=LANDMARKS,
        initial_poses=[(run, 0, 0) for run in range(RUNS)],
        initial_pose_std=(0.1, 0.1, 0.02),
        threads=2,
        **NOISE,
        **options,
    )
    trace = batch.run(*data, dt)
    assert (batch.failed_at == -1).all()
    for run in range(RUNS):
        belief, rows = single(name, options, data, run, dt)
        assert_same_bits(batch.belief(run), belief)
        assert batch.belief(run).landmark_ids == belief.landmark_ids
        assert batch.belief(run).frame == belief.frame
        for step, (pose, covariance, report) in enumerate(rows):
            np.testing.assert_array_equal(trace.poses[run, step], pose)
            np.testing.assert_array_equal(trace.pose_covariances[run, step], covariance)
            assert trace.nis[run, step] == report.nis
            assert trace.degrees_of_freedom[run, step] == report.degrees_of_freedom


def test_runs_take_displacements_and_durations_of_their_own(data):
    odometry, measurements, visible = data
    moved = np.insert(odometry, 1, 0.0, axis=2)
    dt = np.ones((RUNS, STEPS)) * np.arange(RUNS)[:, None]
    batch = make_batch("ekf", runs=RUNS, landmarks=LANDMARKS, **NOISE)
    trace = batch.run(moved, measurements, visible, dt)
    for run in range(RUNS):
        one = make_batch("ekf", runs=1, landmarks=LANDMARKS, **NOISE)
        alone = one.run(*(array[[run]] for array in data), dt[run])
        np.testing.assert_array_equal(trace.poses[run], alone.poses[0])
        np.testing.assert_array_equal(
            trace.pose_covariances[run], alone.pose_covariances[0]
        )


def test_runs_in_pieces_continue_where_they_stopped(data):
    settings = {"runs": RUNS, "landmarks": LANDMARKS, **NOISE}
    whole, pieces = make_batch("ekf", **settings), make_batch("ekf", **settings)
    at_once = whole.run(*data)
    first = pieces.run(*(array[:, :13] for array in data))
    rest = pieces.run(*(array[:, 13:] for array in data))
    np.testing.assert_array_equal(
        at_once.poses, np.concatenate([first.poses, rest.poses], axis=1)
    )


@pytest.mark.parametrize(
    ("reading", "distance"), [((0.1, np.inf), np.nan), ((0.1, 1e200), -1e200)]
)
def test_a_run_with_broken_data_stops_alone_and_says_where(reading, distance, data):
    """Not finite, or too large to square."""
    odometry, measurements, visible = (array.copy() for array in data)
    measurements[1, 20, np.argmax(visible[1, 20])] = reading
    odometry[4, 6, 0] = distance
    batch = make_batch("ekf", runs=RUNS, landmarks=LANDMARKS, **NOISE)
    trace = batch.run(odometry, measurements, visible)
    assert batch.failed_at.tolist() == [-1, 20, -1, -1, 6]
    assert np.isnan(trace.poses[1, 20:]).all()
    assert np.isfinite(trace.poses[1, :20]).all()
    assert np.isfinite(trace.poses[[0, 2, 3]]).all()


def test_memory_is_little_more_than_the_covariances():
    batch = make_batch("ekf", runs=64, landmarks=20, **NOISE)
    assert batch.nbytes <= 1.2 * 64 * 43 * 43 * 8


@pytest.mark.parametrize("name", list_estimators())
def test_a_filter_either_runs_in_batches_or_says_that_it_cannot(name):
    settings = {"runs": 2, "landmarks": 3, **NOISE}
    alone = ("unscented", "robocentric", "ideal")
    if name in (*alone, "compressed", "sparse_information", "submaps"):
        with pytest.raises(ValueError, match="cannot run in batches"):
            make_batch(name, **settings)
    else:
        assert make_batch(name, **settings).runs == 2
        with pytest.raises(ValueError, match=f"{name} with landmark management cannot"):
            make_batch(name, **settings, management=True)


@pytest.mark.parametrize(
    ("index", "message"),
    [
        (0, r"odometry must have shape \(5, 0, 2\)"),
        (1, r"measurements must have shape \(5, 40, 13, 2\), got"),
        (2, r"visible must have shape \(5, 40, 13\), got"),
    ],
)
def test_arrays_of_a_wrong_shape_are_refused_by_name(data, index, message):
    batch = make_batch("ekf", runs=RUNS, landmarks=LANDMARKS, **NOISE)
    arrays = list(data)
    arrays[index] = arrays[index][0]
    for dt in (1.0, np.ones(40)):
        with pytest.raises(ValueError, match=message):
            batch.run(*arrays, dt)


def test_a_run_that_has_stopped_stays_so(data):
    odometry, measurements, visible = (array.copy() for array in data)
    odometry[1, 3] = np.nan
    settings = {"runs": RUNS, "landmarks": LANDMARKS, **NOISE}
    whole, pieces = make_batch("ekf", **settings), make_batch("ekf", **settings)
    held = whole.failed_at
    at_once = whole.run(odometry, measurements, visible)
    assert (held == -1).all()  # it is not changed in place
    parts = [
        pieces.run(*(array[:, steps] for array in (odometry, measurements, visible)))
        for steps in (slice(0, 10), slice(10, STEPS))
    ]
    joined = np.concatenate([part.poses for part in parts], axis=1)
    np.testing.assert_array_equal(at_once.poses, joined)
    assert pieces.failed_at.tolist() == [-1, 0, -1, -1, -1]


def test_arrays_that_cannot_be_written_to_need_no_kernels_of_their_own(data):
    batch = make_batch("ekf", runs=RUNS, landmarks=LANDMARKS, **NOISE)
    batch.run(*data, np.ones(STEPS))
    batch.step(*(array[:, 0] for array in data), np.ones(RUNS))
    kernels = len(drive_runs.signatures)
    data = [np.broadcast_to(array, array.shape) for array in data]
    batch.run(*data, np.broadcast_to(1.0, STEPS))
    batch.step(*(array[:, 0] for array in data), np.broadcast_to(1.0, RUNS))
    assert len(drive_runs.signatures) == kernels


@pytest.mark.parametrize("landmarks", [20, 130])
def test_a_scan_that_fails_leaves_the_belief_of_its_run(landmarks):
    """Ten readings, the last one impossible: P is NaN only where it reads it."""
    batch = make_batch("ekf", runs=1, landmarks=landmarks, **NOISE)
    scan = np.zeros((1, 1, landmarks, 2))
    scan[..., 0], scan[..., 1] = np.linspace(-3, 3, landmarks), 5.0
    visible = np.zeros((1, 1, landmarks), dtype=bool)
    visible[..., :10] = True
    batch.run(np.zeros((1, 1, 2)), scan, visible)
    batch._covariances[0, 21:23, 21:23] = -1e3
    before = batch.belief(0)
    batch.run(np.zeros((1, 1, 2)), scan, visible, dt=0.0)
    assert batch.failed_at.tolist() == [0]
    assert_same_bits(batch.belief(0), before)


def test_a_batch_has_a_thread_for_each_core_of_its_process(monkeypatch):
    monkeypatch.setattr("os.sched_getaffinity", lambda _: {2, 5, 7}, raising=False)
    assert make_batch("ekf", runs=1, landmarks=1, **NOISE)._threads == 3


def test_settings_of_a_wrong_shape_and_those_that_a_batch_would_ignore_are_refused():
    with pytest.raises(ValueError, match="initial_poses must be finite with shape"):
        make_batch("ekf", runs=3, landmarks=1, initial_poses=np.zeros((2, 3)), **NOISE)
    with pytest.raises(ValueError, match="initial_pose must be given as initial_poses"):
        make_batch("ekf", runs=1, landmarks=1, initial_pose=(5, 5, 1), **NOISE)
    with pytest.raises(ValueError, match="threads must be a whole number >= 1"):
        make_batch("ekf", runs=1, landmarks=1, threads=-1, **NOISE)
    batch = make_batch("ekf", runs=1, landmarks=1, **NOISE)
    arrays = (np.zeros((1, 2, 2)), np.zeros((1, 2, 1, 2)), np.zeros((1, 2, 1), bool))
    with pytest.raises(ValueError, match="dt must be finite numbers >= 0"):
        batch.run(*arrays, dt=-1.0)


def test_a_map_beyond_the_blocks_gives_the_bits_of_a_single_filter():
    rng = np.random.default_rng(0)
    landmarks = rng.uniform(-30, 30, (140, 2))
    batch = make_batch("ekf", runs=1, landmarks=140, **NOISE)
    slam = make_estimator("ekf", **NOISE)
    steps = list(drive(0, 4, landmarks=landmarks))
    odometry = np.array([[u for u, _, _ in steps]])
    measurements = np.array([[z for _, z, _ in steps]])
    batch.run(odometry, measurements, np.ones((1, 4, 140), dtype=bool))
    for u, z, _ in steps:
        slam.predict(u)
        slam.update(z, range(140))
    np.testing.assert_array_equal(batch.belief(0).covariance, slam.belief().covariance)


def test_a_batch_does_not_follow_later_changes_of_the_filter_it_was_made_from(data):
    filters = [EkfSlam(MOTION_STD, MEASUREMENT_STD) for _ in range(2)]
    batches = [BatchSlam(each, RUNS, LANDMARKS) for each in filters]
    filters[0]._motion_noise.variance[:] *= 4
    filters[0]._adopt(filters[0].rules._replace(second_std=1.0))
    changed, kept = (batch.run(*data) for batch in batches)
    np.testing.assert_array_equal(changed.poses, kept.poses)


def run_some(batch, data, steps, runs=None):
    return batch.run(*(array[:, steps] for array in data), runs=runs)


def test_runs_begun_anew_are_new_runs_and_the_others_go_on(data):
    settings = {"runs": RUNS, "landmarks": LANDMARKS, **NOISE}
    again = np.array([False, True, False, True, True])
    poses = np.arange(3.0 * RUNS).reshape(RUNS, 3)
    batch, whole, fresh = (make_batch("invariant", **settings) for _ in range(3))
    run_some(batch, data, slice(0, 13))
    run_some(whole, data, slice(0, 13))
    batch.reset(poses, (0.1, 0.1, 0.02), runs=again)
    fresh.reset(poses, (0.1, 0.1, 0.02))
    for each in (batch, whole, fresh):
        run_some(each, data, slice(13, STEPS))
    for run in range(RUNS):
        expected = (fresh if again[run] else whole).belief(run)
        assert_same_bits(batch.belief(run), expected)
        assert batch.belief(run).landmark_ids == expected.landmark_ids


def test_a_run_that_has_stopped_can_begin_anew(data):
    odometry, measurements, visible = (array.copy() for array in data)
    odometry[1, 3] = np.nan
    batch = make_batch("ekf", runs=RUNS, landmarks=LANDMARKS, **NOISE)
    run_some(batch, (odometry, measurements, visible), slice(0, 10))
    batch.reset(np.zeros(3), runs=np.arange(RUNS) == 1)
    trace = run_some(batch, data, slice(10, STEPS))
    assert batch.failed_at.tolist() == [-1] * RUNS
    assert np.isfinite(trace.poses).all()


def test_runs_that_take_no_part_stay_as_they_are(data):
    settings = {"runs": RUNS, "landmarks": LANDMARKS, **NOISE}
    batch, other = make_batch("ekf", **settings), make_batch("ekf", **settings)
    chosen = np.array([True, False, True, False, False])
    broken = [array.copy() for array in data]
    broken[0][~chosen] = np.nan  # is not looked at
    trace = run_some(batch, broken, slice(0, 9), runs=chosen)
    run_some(batch, data, slice(0, 9), runs=~chosen)
    run_some(other, data, slice(0, 9))
    assert np.isnan(trace.poses[~chosen]).all()
    assert np.isfinite(trace.poses[chosen]).all()
    assert (batch.failed_at == -1).all()
    for run in range(RUNS):
        expected = other.belief(run).covariance
        np.testing.assert_array_equal(batch.belief(run).covariance, expected)


def test_beliefs_side_by_side_are_those_of_each_run(data):
    batch = make_batch("ekf", runs=RUNS, landmarks=LANDMARKS, **NOISE)
    run_some(batch, data, slice(0, 4))
    beliefs = batch.beliefs()
    marginals = marginals_of(beliefs)
    assert not beliefs.mapped.all()
    np.testing.assert_array_equal(marginals.mapped, beliefs.mapped)
    for run in range(RUNS):
        belief, ids = batch.belief(run), np.array(batch.belief(run).landmark_ids)
        at = np.r_[:3, np.ravel(3 + 2 * ids[:, None] + [0, 1])]
        np.testing.assert_array_equal(beliefs.means[run][at], belief.mean)
        block = beliefs.covariances[run][np.ix_(at, at)]
        np.testing.assert_array_equal(block, belief.covariance)
        assert np.count_nonzero(beliefs.covariances[run]) == np.count_nonzero(block)
        assert np.flatnonzero(beliefs.mapped[run]).tolist() == sorted(ids)
        np.testing.assert_array_equal(marginals.poses[run], belief.pose)
        np.testing.assert_array_equal(
            marginals.pose_covariances[run], belief.pose_covariance
        )
        np.testing.assert_array_equal(marginals.landmarks[run][ids], belief.landmarks)
        own = belief.landmark_covariances.reshape(-1, 4)[:, [0, 1, 3]]
        np.testing.assert_array_equal(marginals.spreads[:3, run, ids].T, own)
        cross = belief.covariance[3:, :3].reshape(-1, 6)
        np.testing.assert_array_equal(marginals.spreads[3:, run, ids].T, cross)


@pytest.mark.parametrize("runs", [[True, False], [0, 1, 0, 1, 1], True])
def test_a_wrong_choice_of_runs_is_refused(data, runs):
    batch = make_batch("ekf", runs=RUNS, landmarks=LANDMARKS, **NOISE)
    with pytest.raises(ValueError, match="runs must be 5 booleans, got"):
        batch.run(*data, runs=runs)
    with pytest.raises(ValueError, match="runs must be 5 booleans, got"):
        batch.reset(np.zeros(3), runs=runs)


def test_beliefs_of_single_filters_are_those_of_their_runs(data):
    batch = make_batch("ekf", runs=RUNS, landmarks=LANDMARKS, **NOISE)
    run_some(batch, data, slice(0, 4))
    found = BatchBeliefs.of([batch.belief(run) for run in range(RUNS)], LANDMARKS)
    for one, other in zip(found, batch.beliefs(), strict=True):
        np.testing.assert_array_equal(one, other)


def test_the_storage_of_a_batch_is_live_and_cannot_be_written_to(data):
    batch = make_batch("ekf", runs=RUNS, landmarks=LANDMARKS, **NOISE)
    storage = batch.storage()
    assert (storage.slots == -1).all()
    run_some(batch, data, slice(0, 4))
    for run in range(RUNS):
        belief = batch.belief(run)
        slots = storage.slots[run][list(belief.landmark_ids)]
        at = np.r_[:3, np.ravel(3 + 2 * slots[:, None] + [0, 1])]
        np.testing.assert_array_equal(storage.means[run][at][3:], belief.mean[3:])
        block = storage.covariances[run][np.ix_(at, at)]
        np.testing.assert_array_equal(block, belief.covariance)
    for array in storage:
        with pytest.raises(ValueError, match="read-only"):
            array[:] = 0


@pytest.mark.parametrize("name", ["ekf", "iterated"])
def test_runs_that_are_taken_up_again_do_not_notice_the_room_of_earlier_ones(
    name, data
):
    """One thread keeps its workspace between runs; more threads have new ones."""
    one, two = (
        make_batch(name, runs=RUNS, landmarks=LANDMARKS, threads=threads, **NOISE)
        for threads in (1, 2)
    )
    for step in range(8):
        for batch in (one, two):
            run_some(batch, data, slice(step, step + 1))
    for ours, theirs in zip(one.beliefs(), two.beliefs(), strict=True):
        np.testing.assert_array_equal(ours, theirs)


# --- step by step ---


@pytest.mark.parametrize("case", ["ekf", "iterated", "first_estimates"])
def test_runs_taken_step_by_step_have_the_bits_of_a_run_and_their_own_durations(
    case, data
):
    name, options = CASES[case]
    settings = {"runs": RUNS, "landmarks": LANDMARKS, **NOISE, **options}
    batch, durations = make_batch(name, **settings), np.linspace(0.0, 2.0, RUNS)
    for step in range(8):
        batch.step(*(array[:, step] for array in data), durations)
    for run, dt in enumerate(durations):
        whole = make_batch(name, **settings)
        whole.run(*(array[:, :8] for array in data), dt)
        for part in ("mean", "covariance"):
            expected = getattr(whole.belief(run), part)
            np.testing.assert_array_equal(getattr(batch.belief(run), part), expected)


def test_a_step_stops_runs_that_fail_and_passes_over_those_not_chosen(data):
    odometry, measurements, visible = (array[:, 0].copy() for array in data)
    odometry[1], odometry[3] = np.nan, np.inf
    batch = make_batch("ekf", runs=RUNS, landmarks=LANDMARKS, **NOISE)
    chosen = np.arange(RUNS) != 3
    batch.step(odometry, measurements, visible, np.ones(RUNS), runs=chosen)
    assert batch.failed_at.tolist() == [-1, 0, -1, -1, -1]
    before = batch.belief(1)
    batch.step(np.ones((RUNS, 2)), measurements, visible, np.ones(RUNS))
    assert batch.failed_at.tolist() == [-1, 0, -1, -1, -1]
    np.testing.assert_array_equal(batch.belief(1).mean, before.mean)
    assert batch.belief(3).mean[0] == 1.0


@pytest.mark.parametrize("index", range(4))
def test_a_step_of_another_shape_is_refused_by_name(index, data):
    names = ("odometry", "measurements", "visible", "dt")
    parts = [*(array[:, 0] for array in data), np.ones(RUNS)]
    parts[index] = parts[index][:-1]
    batch = make_batch("ekf", runs=RUNS, landmarks=LANDMARKS, **NOISE)
    with pytest.raises(ValueError, match=f"{names[index]} must have shape"):
        batch.step(*parts)


@pytest.mark.parametrize("bad", [-1.0, np.nan, np.inf, 1e13])
def test_a_step_of_an_odd_duration_is_refused(bad, data):
    batch = make_batch("ekf", runs=RUNS, landmarks=LANDMARKS, **NOISE)
    durations = np.ones(RUNS)
    durations[2] = bad
    with pytest.raises(ValueError, match="dt must be finite numbers >= 0"):
        batch.step(*(array[:, 0] for array in data), durations)
