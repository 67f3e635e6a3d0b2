"""Submaps: independent pieces, joined into the map that all of the data make."""

from functools import partial

import numpy as np
import pytest
from comparison import assert_close_beliefs, assert_same_bits, part_of
from far_origins import far_origins, rounding, shifted
from inner_parts import cached_submaps, closed_submaps, graph_of, present_submap
from numeric_jacobian import numeric_jacobian
from scipy.linalg import block_diag
from scipy.optimize import least_squares
from scipy.sparse import csc_array
from town_drives import run

from slamgym.estimator import Belief, EkfSlam, InvariantEkfSlam, check_estimator
from slamgym.estimator.large_maps.elimination import (
    SubmapElimination,
    common_ancestor,
    dissect,
)
from slamgym.estimator.large_maps.submaps import closed_submaps as closing
from slamgym.estimator.large_maps.submaps import graph as fusing
from slamgym.estimator.large_maps.submaps import joining as gauss_newton
from slamgym.estimator.large_maps.submaps.closed_submaps import Neighbourhood, Region
from slamgym.estimator.large_maps.submaps.factor import (
    Gaussian,
    factor_error,
    gradient,
    inverse_spread,
    quadratic,
    retract,
)
from slamgym.estimator.large_maps.submaps.graph import ClosingRule, fuse
from slamgym.estimator.large_maps.submaps.store import (
    CACHE_SIZE,
    MARKER,
    FolderStore,
    LostSubmapError,
    Submap,
)
from slamgym.estimator.large_maps.submaps.submap_slam import BASES, SubmapSlam
from slamgym.estimator.models.bearing_range import predict_measurement, wrap_angle
from slamgym.estimator.models.motions import predict_pose
from slamgym.estimator.models.rigid_motion import invariant_covariance, rotation
from slamgym.evaluation.nees import pose_nees
from slamgym.experiments.run_and_replay.simulated_runs import simulate_runs
from slamgym.sim_configs import load_scenario

MOTION_STD, MEASUREMENT_STD = np.array([0.03, 0.02, 0.01]), np.array([0.02, 0.05])
LANDMARKS = np.random.default_rng(0).uniform(-4, 16, (16, 2))
START = (1.0, 2.0, 0.3)


def laps(steps=90, *, scale=1.0, seed=0, landmarks=LANDMARKS, reach=7.0):
    """Yield (odometry, readings, ids, pose) of a noisy drive in circles."""
    rng = np.random.default_rng(seed)
    pose = np.array(START)
    for _ in range(steps):
        motion = predict_pose(pose, np.array([0.5, 0.1]))
        slip = scale * MOTION_STD * rng.standard_normal(3)
        pose = motion.pose + motion.jacobian_noise @ slip
        readings = predict_measurement(pose, landmarks).measurement
        readings += scale * MEASUREMENT_STD * rng.standard_normal(readings.shape)
        ids = np.flatnonzero((readings[:, 1] < reach) & (readings[:, 1] > 0.5))
        yield (0.5, 0.1), readings[ids], ids, pose


def made(scale=1.0, **options):
    options = {"submap_size": 7, "initial_pose": START} | options
    return SubmapSlam(scale * MOTION_STD, scale * MEASUREMENT_STD, **options)


@pytest.fixture(scope="module")
def driven():
    return run(made(), laps())


@pytest.mark.parametrize("base", BASES)
@pytest.mark.parametrize("limits", [{}, {"submap_size": 5}, {"extent_limit": 2.5}])
def test_it_keeps_the_contract(base, limits):
    assert (
        check_estimator(lambda **noise: SubmapSlam(base=base, **limits, **noise)) == ()
    )


@pytest.mark.parametrize(("limit", "steps"), [(0.021, 5), (0.019, 4)])
def test_a_submap_ends_where_its_heading_exceeds_the_limit(limit, steps):
    slam, k = made(heading_limit=limit, submap_size=99), 0
    while slam.closed_count == 0:
        k += 1
        slam.predict((0.5, 0.0))
        slam.update([(0.0, 3.0)], [k])  # a new landmark corrects nothing
    assert k == steps  # σ is 0.01 √k


# --- the joined map against the full filter, and against a dense solution -------------


@pytest.mark.slow
@pytest.mark.parametrize("base", BASES)
def test_it_comes_nearer_to_the_full_filter_as_the_noise_shrinks(base):
    differences = []
    for scale in (1.0, 0.1, 0.01):
        full = BASES[base](
            scale * MOTION_STD, scale * MEASUREMENT_STD, initial_pose=START
        )
        slam = run(made(scale, base=base), laps(scale=scale))
        one, other = slam.belief(), run(full, laps(scale=scale)).belief()
        assert slam.closed_count >= 5
        assert one.landmark_ids == other.landmark_ids
        std = np.sqrt(np.diag(other.covariance))
        shift = np.abs(one.mean - other.mean) / std
        change = np.abs(one.covariance - other.covariance) / np.outer(std, std)
        differences.append((shift.max(), change.max()))
    differences = np.array(differences)
    assert (differences[1:] < 0.4 * differences[:-1]).all()
    assert (differences[-1] < 2e-3).all()


def unwrapped(error):
    error[2] = wrap_angle(error[2])
    return error


def seen_from(start, state):
    """Return a state (pose, landmarks) as seen from a frame: the slow way."""
    c, s = np.cos(start[2]), np.sin(start[2])
    turn = np.array([[c, s], [-s, c]])
    points = [turn @ (state[:2] - start[:2])]
    points += [turn @ (q - start[:2]) for q in state[3:].reshape(-1, 2)]
    return np.concatenate([points[0], [state[2] - start[2]], *points[1:]])


def dense_join(slam):
    """Solve for frames and landmarks with scipy, numeric derivatives and no sparsity.

    For a base filter whose error is additive; every submap is closed.
    """
    submaps = [closed_submaps(slam).store.load(k) for k in range(slam.closed_count)]
    count, known = len(submaps), len(slam.landmark_ids)
    roots = [np.linalg.cholesky(np.linalg.inv(s.covariance)).T for s in submaps]

    def errors(x):
        frames = np.vstack([START, x[: 3 * count].reshape(-1, 3)])
        points = x[3 * count :].reshape(-1, 2)
        parts = []
        for k, (submap, root) in enumerate(zip(submaps, roots, strict=True)):
            world = np.concatenate([frames[k + 1], points[submap.slots].ravel()])
            seen = seen_from(frames[k], world)
            parts.append(root @ unwrapped(seen - submap.mean))
        return np.concatenate(parts)

    belief = slam.belief()
    guess = np.concatenate([np.zeros(3 * count), belief.landmarks.ravel()])
    guess[: 3 * count] = (
        closed_submaps(slam).join(graph_of(slam).chain.joined).frames[1:].ravel()
    )
    guess += 1e-3 * np.random.default_rng(0).standard_normal(len(guess))
    x = least_squares(errors, guess, xtol=1e-14, ftol=1e-14, gtol=1e-14).x
    J = numeric_jacobian(errors, x)
    keep = np.r_[3 * count - 3 : 3 * count, 3 * count : 3 * count + 2 * known]
    return x[keep], np.linalg.inv(J.T @ J)[np.ix_(keep, keep)]


def test_the_joined_map_is_the_dense_least_squares_solution():
    slam = made(base="ekf", extent_limit=2.0)
    drive = list(laps(60))
    run(slam, drive)
    if slam.local_ids:
        graph_of(slam).close()  # all of them are closed
    mean, covariance = dense_join(slam)
    belief = slam.belief()
    mean[2] = wrap_angle(mean[2])
    std = np.sqrt(np.diag(covariance))
    assert slam.closed_count > 8
    assert any(np.diff([len(o.slots) for o in closed_submaps(slam).summaries]))
    np.testing.assert_allclose((belief.mean - mean) / std, 0, atol=1e-4)
    scaled = (belief.covariance - covariance) / np.outer(std, std)
    np.testing.assert_allclose(scaled, 0, atol=1e-4)


def test_the_uncertainty_of_the_start_moves_the_map_as_a_whole():
    std = (0.2, 0.1, 0.15)
    sure, unsure = run(made(), laps()), run(made(initial_pose_std=std), laps())
    one, other = sure.belief(), unsure.belief()
    np.testing.assert_allclose(one.mean, other.mean, rtol=0, atol=1e-12)

    def moved(start):
        c, s = np.cos(start[2]), np.sin(start[2])
        seen = seen_from(np.array(START), one.mean)
        turn, points = np.array([[c, -s], [s, c]]), [seen[:2], *seen[3:].reshape(-1, 2)]
        points = [turn @ q + start[:2] for q in points]
        return np.concatenate([points[0], [seen[2] + start[2]], *points[1:]])

    G = numeric_jacobian(moved, np.array(START))
    expected = one.covariance + G @ np.diag(np.square(std)) @ G.T
    np.testing.assert_allclose(other.covariance, expected, rtol=1e-6, atol=1e-9)


@far_origins
@pytest.mark.parametrize("base", BASES)
def test_submaps_far_from_the_origin_are_joined_as_at_the_origin(base, far):
    drive, std, found = list(laps(60)), (0.2, 0.1, 0.15), []
    for origin in ((0, 0), far):
        pose = shifted(START, origin)
        slam = run(made(base=base, initial_pose=pose, initial_pose_std=std), drive[:40])
        slam.join()
        other = made(base=base)
        other.load_state_dict(slam.state_dict())
        run(other, drive[40:])
        view = other.local_view(5.0)
        other.predict((0.5, 0.1))
        beliefs = other.belief(), other.local_belief()
        found.append((*beliefs, other.pose, view.mean[:3].copy()))
    slack = rounding(far, 20)
    for near, there in zip(*found, strict=True):
        mean = near if isinstance(near, np.ndarray) else near.mean
        mean_there = there if isinstance(there, np.ndarray) else there.mean
        gap = shifted(mean_there, -np.array(far)) - mean
        np.testing.assert_allclose(gap, 0, atol=slack, rtol=0)
    for near, there in zip(found[0][:2], found[1][:2], strict=True):
        np.testing.assert_allclose(
            there.covariance, near.covariance, rtol=1e-9, atol=1e-12
        )


def test_a_part_of_the_belief_is_that_part_of_the_whole(driven):
    whole = driven.belief()
    some = [whole.landmark_ids[k] for k in (9, 0, 4, 7)]
    assert_close_beliefs(driven.belief(some), part_of(whole, some), 1e-9, 1e-11)
    assert driven.belief([]).landmark_ids == ()


@pytest.mark.parametrize("base", ["ekf", "invariant"])
def test_both_ways_to_the_covariance_of_a_map_agree(base, monkeypatch):
    spread = np.random.default_rng(5).uniform(-9, 15, (60, 2))
    slam, found = (
        run(made(base=base, submap_size=15), laps(90, landmarks=spread, reach=5.0)),
        [],
    )
    summaries = closed_submaps(slam).summaries
    held = np.bincount(np.concatenate([summary.slots for summary in summaries]))
    assert (held == 1).any()
    assert (held > 1).any()
    for few in (0.0, np.inf):
        monkeypatch.setattr(gauss_newton, "MANY", few)
        found.append(slam.belief([*slam.landmark_ids]))
    assert_close_beliefs(*found, 1e-12, 1e-12)


def test_the_frame_of_the_present_submap_is_the_chain_of_the_others():
    std = np.array([0.1, 0.2, 0.05])
    slam = run(made(base="ekf", initial_pose_std=std), laps(50))
    submaps = [closed_submaps(slam).store.load(k) for k in range(slam.closed_count)]

    def end(parts):
        pose = parts[:3]
        for step in parts[3:].reshape(-1, 3):
            c, s = np.cos(pose[2]), np.sin(pose[2])
            turn = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
            pose = pose + turn @ step
        return pose

    present = present_submap(slam).filter.belief()
    parts = [START, *(submap.mean[:3] for submap in submaps), present.pose]
    noise = [np.diag(std**2), *(submap.covariance[:3, :3] for submap in submaps)]
    G = numeric_jacobian(end, np.concatenate(parts))
    expected = G @ block_diag(*noise, present.pose_covariance) @ G.T
    belief = slam.local_belief()
    mean = unwrapped(end(np.concatenate(parts)))
    np.testing.assert_allclose(belief.pose, mean, rtol=0, atol=1e-9)
    np.testing.assert_allclose(slam.pose, mean, rtol=0, atol=1e-9)
    np.testing.assert_allclose(belief.pose_covariance, expected, rtol=1e-6, atol=1e-9)


def test_a_landmark_is_added_once_however_many_submaps_hold_it():
    slam, added = made(), []
    for odometry, readings, ids, _ in laps():
        slam.predict(odometry)
        added += slam.update(readings, ids).added_ids
    assert tuple(added) == slam.landmark_ids
    assert sum(len(o.slots) for o in closed_submaps(slam).summaries) > 3 * len(added)


def test_asking_for_the_belief_or_a_view_leaves_no_trace():
    asked, silent = made(), made()
    for odometry, readings, ids, _ in laps():
        for slam in (asked, silent):
            slam.predict(odometry)
            slam.update(readings, ids)
        asked.belief()
        asked.local_belief()
        asked.local_view(5.0)
    assert_same_bits(asked.belief(), silent.belief())
    assert_same_bits(asked.local_belief(), silent.local_belief())


def test_a_whole_map_is_the_same_however_often_it_is_asked_for():
    spread = np.random.default_rng(5).uniform(-9, 15, (60, 2))
    slam = run(made(submap_size=15), laps(90, landmarks=spread, reach=5.0))
    before, first = slam.nbytes, slam.belief()
    assert first.covariance.base is not None  # the memory of the joined map
    asked_once = slam.nbytes
    for _ in range(3):
        assert_same_bits(slam.belief(), first)
    assert before < asked_once < slam.nbytes  # it keeps what is asked for again
    other = run(made(submap_size=15), laps(90, landmarks=spread, reach=5.0))
    for each in (slam, other):
        each.join()
    assert_same_bits(slam.belief(), other.belief())


@pytest.mark.parametrize("base", ["ekf", "invariant"])
def test_a_join_needs_few_linearisations(base, monkeypatch):
    slams, counts = [], []
    linearise = gauss_newton.JoinedMap._linearise
    few, small = closing.NEARLY_CONVERGED, gauss_newton.SMALL_TURN
    ways = [(0, 0.0, 0.0), (99, 0.0, 0.0), (99, few, 0.0), (99, few, small)]
    for kept, trusted, turn in ways:
        monkeypatch.setattr(gauss_newton, "MOST_KEPT", kept)  # 0: no other steps
        monkeypatch.setattr(closing, "NEARLY_CONVERGED", trusted)
        monkeypatch.setattr(gauss_newton, "SMALL_TURN", turn)
        counts.append(0)

        def counted(*arguments):
            counts[-1] += 1
            return linearise(*arguments)

        monkeypatch.setattr(gauss_newton.JoinedMap, "_linearise", counted)
        slams.append(run(made(base=base, extent_limit=4.0), laps(90)))
        assert_close_beliefs(slams[0].belief(), slams[-1].belief(), 1e-6, 1e-7)
    assert counts == sorted(set(counts), reverse=True)

    def linear(x):  # linear up to 4; beyond, the cost is high
        step = 3.0 - x
        cost, decrement = (1.0 + step @ step, step @ step) if x < 4 else (99.0, 0.05)
        return gauss_newton.Iterate(x, cost, decrement, step)

    def correct(target, x):
        corrected.append(x)
        return 0.01, target - x

    for trusted, target in ((0, None), (15, None), (17, None), (0, 0.5), (0, 5.0)):
        corrected, again = [], target and partial(correct, target)
        found = gauss_newton.minimise(linear, np.array([-1.0]), 0.1, trusted, again)
        assert found.tolist() == [3.0]
        assert len(corrected) == 2 * (again is not None)  # the second one is too slow


def test_joining_halfway_changes_nothing_in_the_end():
    joined, silent = made(), made()
    for step, (odometry, readings, ids, _) in enumerate(laps()):
        for slam in (joined, silent):
            slam.predict(odometry)
            slam.update(readings, ids)
        if step % 20 == 19:
            joined.join()
    one, other = joined.belief(), silent.belief()
    std = np.sqrt(np.diag(other.covariance))
    np.testing.assert_allclose((one.mean - other.mean) / std, 0, atol=1e-3)
    # … but where the robot is meanwhile, is known better.
    assert np.trace(joined.local_belief().pose_covariance) < 0.7 * np.trace(
        silent.local_belief().pose_covariance
    )


def test_a_submap_uses_nothing_of_what_came_before_it():
    ids, later = range(7), list(laps(40))
    slams = []
    for bearing in (0.1, -0.8):
        slam = made()
        slam.predict((bearing, bearing))
        slam.update([(bearing, 2.0 + k) for k in ids], ids)  # fills the first submap
        slams.append(run(slam, later))
    one, other = slams
    assert one.closed_count == other.closed_count > 3
    for k in range(1, one.closed_count):
        submaps = [closed_submaps(slam).store.load(k) for slam in slams]
        for part, same in zip(*submaps, strict=True):
            if part.dtype != np.int64:
                np.testing.assert_array_equal(part, same)
    means = [closed_submaps(slam).store.load(0).mean for slam in slams]
    assert not np.array_equal(*means)


def test_without_a_closed_submap_it_is_the_base_filter():
    for base, make in BASES.items():
        start = {"initial_pose": START, "initial_pose_std": (0.1, 0.2, 0.05)}
        slam = SubmapSlam(MOTION_STD, MEASUREMENT_STD, base=base, **start)
        run(slam, laps(1))
        other = run(make(MOTION_STD, MEASUREMENT_STD, **start), laps(1)).belief()
        assert slam.closed_count == 0
        assert_close_beliefs(slam.belief(), other)
        np.testing.assert_allclose(slam.pose, other.pose, atol=1e-9)


def test_a_coordinate_without_variance_has_no_covariance():
    slam = SubmapSlam((0.01, 0.0, 0.3), MEASUREMENT_STD)
    slam.predict((3.0, 0.0))  # σy = 0 and θ = 0: y stays known
    np.testing.assert_array_equal(slam.belief().covariance[1], 0.0)
    slam.local_view(0.0)
    slam.predict((-5e-200, 0.0))
    covariance = slam.local_view(0.0).covariance
    assert (covariance.diagonal() >= 0).all()
    assert abs(covariance[1, 2]) <= np.sqrt(covariance[1, 1] * covariance[2, 2]) + 1e-99


# --- honesty --------------------------------------------------------------------------


@pytest.mark.slow
def test_the_landmarks_and_the_pose_are_where_the_covariance_says():
    nees = []
    for seed in range(25):
        drive = list(laps(60, seed=seed))
        belief = run(made(), drive).belief()
        truth = LANDMARKS[list(belief.landmark_ids)]
        error = belief.error(drive[-1][3], truth)
        nees.append(error @ np.linalg.solve(belief.error_covariance(), error))
    dof = 25 * len(error)
    assert abs(np.sum(nees) - dof) < 4 * np.sqrt(2 * dof)


@pytest.mark.slow
def test_in_the_loop_it_is_honest_where_the_ekf_is_not():
    world, nees = load_scenario("loop"), {"ekf": [], "submaps": []}
    data = simulate_runs(world, 2, 0)
    for run_, first in enumerate(data.initial_poses):
        start = {"initial_pose": first, "initial_pose_std": world.start.std}
        noise = world.motion.std, world.sensor.std
        filters = {
            "ekf": EkfSlam(*noise, **start),
            "submaps": SubmapSlam(*noise, submap_size=8, **start),
        }
        for step, odometry in enumerate(data.odometry[run_]):
            ids = np.flatnonzero(data.visible[run_, step])
            for name, slam in filters.items():
                slam.predict(odometry, data.dt[step])
                slam.update(data.measurements[run_, step, ids], ids)
                if step % 5 == 4:
                    belief, truth = slam.belief([]), data.true_poses[run_, step]
                    pair = belief.pose, belief.pose_covariance
                    nees[name].append(pose_nees(truth, *pair, frame="invariant"))
    assert np.mean(nees["ekf"]) / 3 > 4
    assert np.mean(nees["submaps"]) / 3 < 1.8


# --- the mathematics ------------------------------------------------------------------


@pytest.mark.parametrize("frame", ["additive", "invariant"])
@pytest.mark.parametrize("turn", [0.0, 1e-4, 0.7, -2.0])
def test_the_derivative_of_a_relation_is_that_of_differences(frame, turn):
    rng = np.random.default_rng(3)
    start, state, mean = rng.normal(size=3), 3 * rng.normal(size=9), rng.normal(size=9)
    state[2] = start[2] + mean[2] + turn

    def error(x):
        return factor_error(x[:3], x[3:], mean, frame).error

    expected = numeric_jacobian(error, np.concatenate([start, state]))
    found = factor_error(start, state, mean, frame).through(np.eye(len(state)))
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-7)
    # The same for a landmark that no other submap holds.
    own, root = np.append(mean, [3.0, -2.0]), rng.normal(size=(11, 11))
    submap = Submap(np.arange(4), own, root @ root.T)
    whitener = np.linalg.inv(np.linalg.cholesky(submap.covariance[:9, :9]))

    def private(x):
        found = factor_error(x[:3], x[3:], mean, frame)
        shared = np.arange(9), whitener
        return gauss_newton.private_landmarks(
            submap, shared, np.array([3]), x[:3], found, frame
        )

    x = np.concatenate([start, state])
    expected = numeric_jacobian(lambda x: private(x).points, x)
    np.testing.assert_allclose(private(x).jacobian, expected, rtol=0, atol=1e-6)


@pytest.mark.parametrize("frame", ["additive", "invariant"])
@pytest.mark.parametrize("fixed", [0, 3])
def test_a_submap_is_the_square_of_its_error_as_dense_products_compute_it(frame, fixed):
    rng = np.random.default_rng(5)
    start, state, mean = rng.normal(size=3), 3 * rng.normal(size=9), rng.normal(size=9)
    found = factor_error(start, state, mean, frame)
    J = found.through(np.eye(len(found.error)))
    error, J = found.error, J[:, 3 - fixed :]
    information = (root := np.tril(rng.normal(size=(9, 9)))).T @ root
    H, g, cost = quadratic(found, root, information, is_first=fixed == 0)
    np.testing.assert_allclose(np.triu(H), np.triu(J.T @ information @ J), atol=1e-12)
    for each in (g, gradient(found, root, is_first=fixed == 0)):
        np.testing.assert_allclose(each, -J.T @ information @ error, atol=1e-12)
    assert cost == pytest.approx(error @ information @ error, rel=1e-12)


@pytest.mark.parametrize("frame", ["additive", "invariant"])
def test_private_landmarks_follow_the_error_of_the_shared_part(frame):
    rng, slots = np.random.default_rng(6), np.array([7, 2, 9, 4])
    mean, start, shared = rng.normal(size=11), rng.normal(size=3), [0, 1, 2, 5, 6]
    P = (root := rng.normal(size=(11, 11))) @ root.T
    own = P[np.ix_(shared, shared)]
    whitening = np.array(shared), np.linalg.inv(np.linalg.cholesky(own))

    def found(x):  # x holds two frames and landmark 2, in the world
        error, wanted = factor_error(x[:3], x[3:], mean[shared], frame), slots[[3, 0]]
        given = Submap(slots, mean, P), whitening, wanted, x[:3], error, frame
        return gauss_newton.private_landmarks(*given)

    x = np.concatenate([start, rng.normal(size=5)])
    error = factor_error(start, x[3:], mean[shared], frame).error
    error = P[:, shared] @ np.linalg.solve(own, error)
    state = retract(mean, error, frame)
    made = factor_error(np.zeros(3), state, mean, frame).error
    np.testing.assert_allclose(made, error, rtol=0, atol=1e-12)
    seen = state[[9, 10, 3, 4]].reshape(2, 2) @ rotation(start[2]).T + start[:2]
    np.testing.assert_allclose(found(x).points, seen.ravel(), rtol=0, atol=1e-12)
    expected = numeric_jacobian(lambda x: found(x).points, x)
    np.testing.assert_allclose(found(x).jacobian, expected, rtol=0, atol=1e-6)


def test_the_inverse_spread_has_no_jump_where_its_series_ends():
    for turn in (1e-6, 1.9e-3, 2.1e-3, 1.0, -3.0):
        t = turn + np.array([0.0, 1e-4, -1e-4])
        exact, ahead, behind = 1j * t / (np.exp(1j * t) - 1)
        spread, slope = inverse_spread(turn)
        assert spread == pytest.approx(exact, abs=1e-9)
        assert slope == pytest.approx((ahead - behind) / 2e-4, abs=1e-7)


def random_problem(rng, count=9, size=40):
    unknowns, matrices = [], []
    for k in range(count):
        mine = np.unique(np.r_[3 * k : 3 * k + 6, rng.integers(0, size, 6)]) % size
        unknowns.append(np.unique(mine))
        A = rng.normal(size=(len(unknowns[-1]) + 2, len(unknowns[-1])))
        matrices.append((A.T @ A, rng.normal(size=len(unknowns[-1])), 1.0))
    used = np.unique(np.concatenate(unknowns))
    return [np.searchsorted(used, u) for u in unknowns], matrices, len(used)


@pytest.mark.parametrize("count", [1, 2, 9])
def test_elimination_solves_what_a_dense_solver_solves(count):
    rng = np.random.default_rng(count)
    unknowns, matrices, size = random_problem(rng, count)
    H, g = np.zeros((size, size)), np.zeros(size)
    for mine, (matrix, right, _) in zip(unknowns, matrices, strict=True):
        H[np.ix_(mine, mine)] += matrix
        g[mine] += right
    parts = dissect(unknowns, rng.normal(size=(count, 2)))
    done = SubmapElimination(parts, size, lambda k: matrices[k])
    rows = rng.normal(size=(4, size)) * (rng.random((4, size)) < 0.2)
    np.testing.assert_allclose(done.solution(), np.linalg.solve(H, g), atol=1e-8)
    np.testing.assert_allclose(
        done.covariance(csc_array(rows)), rows @ np.linalg.solve(H, rows.T), atol=1e-8
    )
    found = done.inverse(np.arange(size)[::-1], size)
    inverse = found.matrix[:, found.places][::-1, ::-1]
    np.testing.assert_allclose(inverse, np.linalg.inv(H), atol=1e-8)
    assert done.decrement() == pytest.approx(g @ np.linalg.solve(H, g))
    assert done.cost == count


# --- saved and continued --------------------------------------------------------------


@pytest.mark.parametrize(
    ("base", "joined", "on_disk"),
    [("ekf", False, True), ("invariant", False, False), ("invariant", True, True)],
)
def test_a_saved_run_continues_bit_for_bit(tmp_path, base, joined, on_disk):
    options = {"base": base, "folder": tmp_path / "run" if on_disk else None}
    drive = list(laps(70))
    slam = run(made(**options), drive[:45])
    if joined:
        slam.join()
    with (tmp_path / "state.npz").open("wb") as file:
        np.savez(file, **slam.state_dict())
    with np.load(tmp_path / "state.npz") as state:
        other = made(**options)
        other.load_state_dict(state)
    assert_same_bits(slam.belief(), other.belief())
    expected = run(slam, drive[45:])
    found = run(other, drive[45:])
    assert found.closed_count == expected.closed_count > 5
    assert_same_bits(expected.belief(), found.belief())
    assert_same_bits(expected.local_belief(), found.local_belief())


def test_submaps_on_disk_are_those_in_memory_and_few_are_cache(tmp_path):
    drive = list(laps())
    slam = run(made(folder=tmp_path / "run", submap_size=5), fewer(drive))
    other = run(made(submap_size=5), fewer(drive))
    assert slam.closed_count > CACHE_SIZE + 3
    assert len(cached_submaps(slam)) == CACHE_SIZE
    assert_same_bits(slam.belief(), other.belief())
    assert slam.nbytes < other.nbytes
    assert len(list((tmp_path / "run").glob("submap_*.npy"))) == slam.closed_count


def fewer(drive, most=5):
    return [(u, z[:most], ids[:most], pose) for u, z, ids, pose in drive]


def test_an_earlier_state_of_a_longer_run_leaves_nothing_behind(tmp_path):
    folder, drive = tmp_path / "run", list(laps(60))
    slam = run(made(folder=folder), drive[:30])
    state, early = slam.state_dict(), slam.closed_count
    run(slam, drive[30:])
    assert slam.closed_count > early > 0
    (folder / f"submap_{slam.closed_count:06}.part").write_bytes(b"half of it")
    (folder / "notes.txt").write_text("of somebody else")
    slam.load_state_dict(state)
    slam.reset(START, (0, 0, 0))
    assert [path.name for path in folder.iterdir()] == ["notes.txt"]
    (folder / "notes.txt").unlink()
    assert_same_bits(run(slam, drive).belief(), run(made(), drive).belief())


@pytest.mark.parametrize("origin", ["own", "in memory"])
def test_a_state_before_the_first_step_begins_again_in_the_filters_own_folder(
    tmp_path, origin
):
    drive = list(laps(40))
    slam = made(folder=tmp_path / "run")
    first = {"own": slam, "in memory": made()}[origin].state_dict()
    run(slam, drive)
    slam.load_state_dict(first)
    assert slam.closed_count == 0
    expected = run(made(), drive)
    assert_same_bits(run(slam, drive).belief(), expected.belief())
    slam.reset(START, (0, 0, 0))
    assert list((tmp_path / "run").iterdir()) == []
    assert_same_bits(run(slam, drive).belief(), expected.belief())


def test_a_state_before_the_first_step_is_refused_in_the_folder_of_another_run(
    tmp_path,
):
    run(made(folder=tmp_path / "run"), laps(40))
    other = made(folder=tmp_path / "run")
    other.reset((5, 5, 0), (0, 0, 0))
    before = other.belief()
    with pytest.raises(ValueError, match="holds the submaps of another run"):
        other.load_state_dict(made().state_dict())
    assert_same_bits(before, other.belief())
    assert (tmp_path / "run" / "submap_000000.npy").exists()


def test_a_submap_that_cannot_be_written_is_told_before_the_next_scan_is_in(tmp_path):
    folder, away, drive = tmp_path / "run", tmp_path / "away", list(laps(60))
    slam, other = made(folder=folder), made()
    step = 0
    while other.closed_count < 4:
        run(other, drive[step : step + 1])
        step += 1
    run(slam, drive[: step - 1])
    folder.rename(away)
    run(slam, drive[step - 1 : step])  # fills a submap
    assert slam.closed_count == other.closed_count - 1
    assert slam.landmark_ids == other.landmark_ids
    odometry, readings, ids, _ = drive[step]
    slam.predict(odometry)
    before = slam.belief()
    for _ in range(2):
        with pytest.raises(FileNotFoundError, match="submap_000003"):
            slam.update(readings, ids)
        assert_same_bits(before, slam.belief())
    away.rename(folder)
    slam.update(readings, ids)
    run(other, drive[step : step + 1])
    assert slam.closed_count == other.closed_count
    found = run(slam, drive[step + 1 :]).belief()
    expected = run(other, drive[step + 1 :]).belief()
    assert slam.closed_count == len(list(folder.glob("submap_*.npy")))
    assert found.landmark_ids == expected.landmark_ids
    shift = (found.mean - expected.mean) / np.sqrt(np.diag(expected.covariance))
    assert np.abs(shift).max() < 0.5  # one submap ends a motion later


# --- refusals -------------------------------------------------------------------------


def test_a_folder_that_is_none_is_refused(tmp_path):
    file = tmp_path / "file"
    file.write_text("x")
    with pytest.raises(ValueError, match="folder must be a folder, got the file"):
        made(folder=file)
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "letters.txt").write_text("x")
    with pytest.raises(ValueError, match=f"other files and no {MARKER}"):
        made(folder=tmp_path / "other")
    assert [p.name for p in (tmp_path / "other").iterdir()] == ["letters.txt"]


def test_the_folder_of_another_run_is_refused_before_the_first_step(tmp_path):
    first = run(made(folder=tmp_path / "run"), laps(30))
    for call in (
        lambda slam: slam.predict((1.0, 0.0)),
        lambda slam: slam.update([(0.0, 2.0)], [1]),
    ):
        second = made(folder=tmp_path / "run")
        before = second.belief()
        with pytest.raises(ValueError, match=r"another run \(.*load_state_dict"):
            call(second)
        assert_same_bits(before, second.belief())
    first.belief()


def test_a_state_is_refused_where_the_folder_does_not_hold_its_run(tmp_path):
    slam = run(made(folder=tmp_path / "one"), laps(40))
    run(made(folder=tmp_path / "two"), laps(40))
    state = slam.state_dict()
    for folder, message in (
        (tmp_path / "two", "but it is of run"),
        (tmp_path / "empty", "but it holds none"),
        (None, "make the estimator with that folder"),
    ):
        other = made(folder=folder)
        with pytest.raises(ValueError, match=message):
            other.load_state_dict(state)
        assert other.belief().landmark_ids == ()
    without_folder = run(made(), laps(40)).state_dict()
    with pytest.raises(ValueError, match="without folder"):
        made(folder=tmp_path / "new").load_state_dict(without_folder)


@pytest.mark.parametrize(
    ("harm", "message"),
    [
        (lambda path: path.unlink(), "submap 1 cannot be read"),
        (lambda path: path.write_bytes(path.read_bytes()[:-8]), "damaged"),
        (lambda path: path.write_bytes(b"x" + path.read_bytes()[1:]), "damaged"),
    ],
)
def test_a_missing_or_changed_submap_is_refused_by_name(tmp_path, harm, message):
    slam = run(made(folder=tmp_path / "run"), laps(60))
    harm(tmp_path / "run" / "submap_000001.npy")
    with pytest.raises(ValueError, match=message):
        made(folder=tmp_path / "run").load_state_dict(slam.state_dict())


def test_a_state_that_does_not_fit_is_refused():
    slam = run(made(), laps(40))
    state = slam.state_dict()
    for change, message in (
        ({"estimator": "EkfSlam"}, "is of EkfSlam, not of SubmapSlam"),
        ({"base": "EkfSlam"}, "is of EkfSlam, not of InvariantEkfSlam"),
        ({"chain_joined": np.zeros((0, 3))}, "chain_joined"),
        ({"chain_present": np.full((4, 3), np.nan)}, "must be finite"),
        ({"chain_start": -state["chain_start"] - 1}, "chain_start'] must"),
        ({"submap_0_slots": state["submap_0_slots"] + 99}, "_slots'] must be below"),
        ({"submap_0_mean": state["submap_0_mean"][:-1]}, "_mean'] must have shape"),
        ({"landmark_ids": state["landmark_ids"][:3]}, "must be 3 ascending numbers"),
    ):
        with pytest.raises(ValueError, match=message):
            made().load_state_dict(state | change)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"submap_size": 0}, "submap_size must be a whole number >= 1, got 0"),
        ({"heading_limit": 0.0}, "heading_limit must be a finite number > 0"),
        ({"extent_limit": -1.0}, "extent_limit must be a finite number > 0"),
        ({"base": "robocentric"}, "base must be 'ekf' or 'invariant'"),
        ({"belief_limit": 0}, "belief_limit must be a whole number >= 1"),
        ({"folder": 3}, "folder must be a path, got 3"),
    ],
)
def test_bad_options_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        made(**options)


def test_a_world_without_noise_is_mapped_as_it_is():
    slam = SubmapSlam(0 * MOTION_STD, (0.0, 0.0), submap_size=2)
    for step in range(3):
        slam.update([(0.0, 4.0 - step), (np.pi / 2, 3.0)], [0, 10 + step])
        slam.predict((1.0, 0.0))
    assert slam.closed_count == 3
    expected = [[4, 0], [0, 3], [1, 3], [2, 3]]
    np.testing.assert_allclose(slam.belief().landmarks, expected, atol=1e-6)


@pytest.mark.parametrize("frame", ["additive", "invariant"])
@pytest.mark.parametrize(("shared", "heading_std"), [(0, 1), (3, 1), (3, 0)])
def test_a_fusion_equals_a_dense_update_with_numeric_derivatives(
    frame, shared, heading_std, monkeypatch
):
    """The updated covariance is T (P - K S Kᵀ) Tᵀ; T takes errors to the map."""
    monkeypatch.setattr(fusing, "AT_ONCE", 5)  # several blocks
    rng = np.random.default_rng(1)
    spread = [rng.normal(size=(size, size)) for size in (15, 13)]
    spread[0][2] *= heading_std
    P, L = (1e-3 * (root @ root.T) for root in spread)
    mean, own = 5 * rng.normal(size=15), 3 * rng.normal(size=13)
    start, turn = complex(*mean[:2]), np.exp(1j * mean[2])
    seen = (own[3:].view(complex) * turn + start).view(float)
    mean[3 : 3 + 2 * shared] = seen[: 2 * shared] + rng.normal(size=2 * shared)
    common = np.arange(shared)

    def moved(errors, mean, own):
        return retract(mean, errors[:15], "invariant"), retract(own, errors[15:], frame)

    def difference(errors, mean, own):
        world, local = moved(errors, mean, own)
        away = (world[3:].view(complex) - complex(*world[:2])) * np.exp(-1j * world[2])
        return (away[:shared] - local[3:].view(complex)[:shared]).view(float)

    def whole(errors, mean, own):
        world, local = moved(errors, mean, own)
        turn, start = np.exp(1j * world[2]), complex(*world[:2])
        robot = complex(*local[:2]) * turn + start
        fresh = local[3:].view(complex)[shared:] * turn + start
        pose = [robot.real, robot.imag, world[2] + local[2]]
        return np.concatenate([pose, world[3:], fresh.view(float)])

    covariance = block_diag(invariant_covariance(mean, P), L)
    fused = fuse(Gaussian(mean, P), Gaussian(own, L), frame, (common, common))
    for size in (16, 30):  # the second one has room for the result
        order, room = rng.permutation(size)[:15], rng.normal(size=(size, size))
        room[:15, order] = P
        same = fuse(
            Gaussian(mean, room, order), Gaussian(own, L), frame, (common, common)
        )
        np.testing.assert_allclose(same.covariance, fused.covariance, atol=1e-15)
        assert np.shares_memory(same.covariance, room) == (size == 30)
    if shared:
        A = numeric_jacobian(lambda e: difference(e, mean, own), np.zeros(28))
        gain = covariance @ A.T @ np.linalg.inv(A @ covariance @ A.T)
        correction = -gain @ difference(np.zeros(28), mean, own)
        covariance = covariance - gain @ A @ covariance
        mean, own = moved(correction, mean, own)
    T = numeric_jacobian(lambda e: whole(e, mean, own), np.zeros(28))
    np.testing.assert_allclose(fused.mean, whole(np.zeros(28), mean, own), atol=1e-6)
    np.testing.assert_allclose(fused.covariance, T @ covariance @ T.T, atol=1e-7)
    assert np.array_equal(fused.covariance, fused.covariance.T)


def test_differences_that_cannot_be_solved_are_told():
    world, local = (Gaussian(np.r_[0.0, 0, 0, 1, 1], np.zeros((5, 5))) for _ in "ab")
    common = (np.array([0]), np.array([0]))
    with pytest.raises(np.linalg.LinAlgError, match="measurement_std is degenerate"):
        fuse(world, local, "additive", common)


def test_an_empty_scan_closes_nothing_and_changes_nothing():
    slam = made(extent_limit=1.0)
    for _ in range(4):
        slam.predict((0.5, 0.1))
    before = slam.belief()
    slam.update(np.empty((0, 2)), [])
    assert slam.closed_count == 0
    assert_same_bits(before, slam.belief())


def test_submaps_without_landmarks_are_joined_too():
    slam = SubmapSlam(MOTION_STD, MEASUREMENT_STD, extent_limit=1.0, min_range=0.1)
    for _ in range(8):
        slam.predict((0.5, 0.1))
        slam.update([(0.0, 0.05)], [1])  # too close to use
    other = SubmapSlam(MOTION_STD, MEASUREMENT_STD)
    for _ in range(8):
        other.predict((0.5, 0.1))
    assert slam.closed_count == 2
    assert_close_beliefs(slam.belief(), other.belief())


def test_the_default_size_takes_a_scan_of_any_size():
    rng = np.random.default_rng(0)
    slam = SubmapSlam(MOTION_STD, MEASUREMENT_STD)
    ekf = InvariantEkfSlam(MOTION_STD, MEASUREMENT_STD)
    readings = np.column_stack([np.linspace(-3, 3, 100), rng.uniform(2, 9, 100)])
    for filter_ in (slam, ekf):
        filter_.update(readings, range(100))
        filter_.predict((0.0, 0.0))
        filter_.update(readings[:60], range(60))
        filter_.update(readings, range(100, 200))  # as many as end a submap
    assert slam.closed_count == 1
    expected = ekf.belief(slam.landmark_ids)
    np.testing.assert_allclose(slam.belief().mean, expected.mean, atol=1e-6)


def test_a_belief_beyond_the_limit_names_the_memory_it_would_take():
    slam = run(made(belief_limit=5), laps())
    with pytest.raises(ValueError, match=r"of 10 landmarks .* 0\.0 GB.*local_belief"):
        slam.belief()
    assert len(slam.belief(slam.landmark_ids[:3]).landmark_ids) == 3
    with pytest.raises(ValueError, match="mapped landmarks, got 99"):
        slam.belief([99])


def test_submaps_that_cannot_be_joined_are_told(driven, monkeypatch):
    monkeypatch.setattr(gauss_newton, "ITERATIONS", 1)
    other = made()
    other.load_state_dict(driven.state_dict())
    with pytest.raises(np.linalg.LinAlgError, match="did not converge in 1 iterations"):
        other.belief()


def test_rounding_makes_no_variance_negative():
    rng = np.random.default_rng(2)
    for distance, turn in rng.normal(size=(20, 2)):
        slam = SubmapSlam((0.1, 0.0, 0.05), (0.1, 0.1))
        slam.predict((distance, turn))
        assert (slam.belief().covariance.diagonal() >= 0).all()


@pytest.mark.parametrize(
    ("one", "other", "both"), [(11, 8, 2), (5, 11, 5), (2, 3, 1), (6, 6, 6)]
)
def test_the_common_ancestor_of_two_nodes_is_the_deepest_one(one, other, both):
    assert common_ancestor(one, other) == common_ancestor(other, one) == both


def test_a_folder_keeps_the_submaps_of_last_use_in_memory(tmp_path):
    store, most = FolderStore(tmp_path / "run"), CACHE_SIZE + 2
    store.claim()
    submaps = [Submap(np.arange(1), np.full(5, k), np.eye(5)) for k in range(most)]
    for submap in submaps:
        store.append(submap)
    for file in tmp_path.glob("run/submap_*"):
        file.unlink()
    assert store.load(most - 1).mean[0] == most - 1
    with pytest.raises(LostSubmapError):
        store.load(0)
    size = store.nbytes
    store.truncate(most - 1)
    assert (len(store), store.nbytes) == (
        most - 1,
        size * (CACHE_SIZE - 1) // CACHE_SIZE,
    )


def test_a_neighbourhood_is_renewed_for_the_farthest_of_recent_distances():
    asked, pose = [], Belief(np.zeros(3), 0.01 * np.eye(3), (), "invariant")

    def joined_region(reach):
        asked.append(reach)
        return pose, Region(np.full(2, 99.0), reach, 0.25)  # the robot has left it

    near = Neighbourhood(
        lambda: InvariantEkfSlam(MOTION_STD, MEASUREMENT_STD), joined_region
    )
    for within in (5.0, 1.0):
        near.view(within)
    near.forget()
    near.view(1.0)
    assert asked == [5.0, 5.0, 1.0]
    saved = near.state_dict()
    np.testing.assert_equal(near.restored(saved).state_dict(), saved)


@pytest.mark.parametrize(
    ("limits", "landmarks", "readings", "std", "away", "closes"),
    [
        *(((None, None, None), n, 50, 9.0, 9e9, n >= 50) for n in (49, 50)),
        *(((None, None, None), n, 51, 9.0, 9e9, n >= 102) for n in (101, 102)),
        *(((7, None, None), n, 60, 9.0, 9e9, n >= 7) for n in (6, 7)),
        *(((9, 0.5, None), 8, 1, std, 9e9, std > 0.5) for std in (0.5, 0.51)),
        *(((9, None, 5.0), 8, 1, 9.0, away, away > 5) for away in (5.0, 5.01)),
    ],
)
def test_a_submap_is_closed_at_any_of_its_limits(
    limits, landmarks, readings, std, away, closes
):
    class Active:
        pose = np.array([0.6 * away, -0.8 * away, 1.0])
        pose_covariance = np.diag([1e9, 1e9, std**2])

        def __len__(self):
            return landmarks

    assert ClosingRule.checked(*limits).closes(Active(), readings) == closes


def test_a_region_is_twice_as_large_as_required_and_holds_the_nearest(monkeypatch):
    region = Region(np.array([1.0, 2.0]), reach=3.0, slack=0.5)
    assert region.radius == 7.0
    assert region._replace(is_all=True).radius == np.inf
    assert region._replace(farthest=4.0).radius == 4.0
    for position, within, covers in (
        *(((1.0, 2.0), 6.5, True), ((1.0, 2.0), 6.6, False)),
        *(((1.0 + 3, 2.0 - 4), 1.5, True), ((1.0 + 3, 2.0 - 4), 1.6, False)),
    ):
        assert region.covers(np.array(position), within) == covers
    points = region.centre + np.array([(7.0, 0), (0, 7.1), (2, 0), (0, -3), (-1, 0)])
    inside, same = region.chosen(points)
    assert (inside.tolist(), same) == ([0, 2, 3, 4], region)
    monkeypatch.setattr(closing, "LARGEST_COUNT", 2)
    inside, smaller = region.chosen(points)
    assert (inside.tolist(), smaller.farthest) == ([2, 4], 2.0)
