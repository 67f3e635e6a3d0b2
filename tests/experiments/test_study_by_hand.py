"""A small study, every number of which is computed once more, step by step."""

import numpy as np
import pytest

from slamgym.estimator import Belief, EkfSlam, make_estimator
from slamgym.estimator.models.sensors import BEARING_RANGE
from slamgym.evaluation.error_bound import posterior_bound
from slamgym.evaluation.noise_findings import CHANNELS
from slamgym.experiments.monte_carlo_study import monte_carlo
from slamgym.experiments.monte_carlo_study.run_measures import VARIABLES, gaps
from slamgym.experiments.run_and_replay.simulated_runs import simulate_runs
from slamgym.sim_configs import load_scenario

RUNS, LAST, RESTS = 3, 9, 2
FAILED, FAILS = 1, 7  # run and step
GO, REST = [3.0, 0.3, 1], [0.0, 0.0, 1]
WORLD = load_scenario("six_landmarks").with_changes(
    steps=LAST,
    start={"pose": (1.0, -2.0, 0.2), "std": (0.1, 0.2, 0.15)},
    motion={"noise_at_rest": False},
    sensor={"std": (0.02, 0.05), "range_std_per_metre": 0.02, "max_range": 9.0},
    gps={"std": 0.5, "every": 3},
    compass={"std": 0.1, "every": 2},
    walls=[[13.0, 5.0, 13.0, 9.0], [40.0, 0.0, 40.0, 5.0]],
    controls={"sequence": "commands", "commands": [GO, REST, *7 * [GO]]},
)
ASSUMED = WORLD.with_changes(
    motion={"std": (0.3, 0.15, 0.12)},
    sensor={"std": (0.03, 0.06), "range_std_per_metre": 0.03},
)


class OneByOne(EkfSlam):
    """The textbook filter, with a method of its own, so that it does not batch."""

    def belief(self):
        return super().belief()


class FailsLate(OneByOne):
    """Loses its covariance late in one run, in which it is farther to the right."""

    scans = 0

    def reset(self, pose, pose_std):
        super().reset(pose, pose_std)
        self.scans = 0

    def predict(self, odometry, dt=1.0):
        super().predict(odometry, dt)
        self.scans += 1

    def belief(self):
        found = super().belief()
        if self.scans == FAILS and found.mean[0] > 8.5:
            return Belief(found.mean, np.nan * found.covariance, found.landmark_ids)
        return found


@pytest.fixture(scope="module")
def runs():
    return simulate_runs(WORLD, RUNS, seed=4)


@pytest.fixture(scope="module")
def study():
    filters = {"ekf": "ekf", "invariant": "invariant", "single": OneByOne}
    filters["fails"] = FailsLate
    return monte_carlo(WORLD, filters, RUNS, 4, assumed=ASSUMED)


def driven(name, runs, run):
    """Return the reports and beliefs of a filter that is driven in a plain loop."""
    slam = make_estimator(
        name,
        motion_std=ASSUMED.motion.std,
        measurement_std=ASSUMED.sensor.std,
        sensor=BEARING_RANGE.with_noise(range_std_per_metre=0.03),
        noise_at_rest=False,
    )
    slam.reset(runs.initial_poses[run], WORLD.start.std)
    for t in range(LAST + 1):
        if t:
            slam.predict(runs.odometry[run, t], 1.0)
        seen = np.flatnonzero(runs.visible[run, t])
        reports = [slam.update(runs.measurements[run, t, seen], seen.tolist())]
        x, y, heading = runs.pose_readings[run, t]
        due = [k for k, every in enumerate((3, 3, 2)) if t % every == 0]
        if due:
            std = np.array([0.5, 0.5, 0.1])[due]
            z = np.array([x, y, heading])[due]
            reports.append(slam.observe_pose(z, np.eye(3)[due], np.diag(std**2)))
        yield reports, slam.belief()


def nees(error, covariance):
    return error @ np.linalg.solve(covariance, error)


def about(point, state, covariance=None):
    """Return a state seen from a point, as x + i y of pose and map; and D P Dᵀ."""
    points = np.delete(state, 2) - np.tile(point, len(state) // 2)
    D = np.eye(len(state))
    D[np.arange(len(state)) != 2, 2] = np.ravel([points[1::2], -points[::2]], "F")
    return points[::2] + 1j * points[
        1::2
    ], None if covariance is None else D @ covariance @ D.T


def invariant(point, truth, mean, covariance=None):
    """Return ξ = Log(χ χ̂⁻¹) about a point, and its covariance."""
    (true, _), (points, P) = about(point, truth), about(point, mean, covariance)
    turn = np.angle(np.exp(1j * (truth[2] - mean[2])))
    moved = (true - np.exp(1j * turn) * points) * 1j * turn / (np.exp(1j * turn) - 1)
    xi = np.ravel([moved.real, moved.imag], "F")
    return np.insert(xi, 2, turn), P


def aligned(points, truth):
    """Return the RMS distance of points (n, 2) after the best rigid motion."""
    a, b = ((each - each.mean(axis=0)) @ [1, 1j] for each in (points, truth))
    return np.sqrt(np.mean(abs(b - a * np.exp(1j * np.angle(np.vdot(a, b)))) ** 2))


def seen(state):
    """Return the map of a state in the robot's frame, shape (2n,)."""
    points = (state[3::2] - state[0] + 1j * (state[4::2] - state[1])) * np.exp(
        -1j * state[2]
    )
    return np.ravel([points.real, points.imag], "F")


def columns(label, runs, run):
    """Return every variable that depends on the filter, for one run."""
    truth, points = runs.true_poses[run], runs.landmarks[run]
    name = "invariant" if label == "invariant" else "ekf"
    rows = {key: [] for key in VARIABLES}
    path = []
    for t, (reports, belief) in enumerate(driven(name, runs, run)):
        x, P = belief.pose, belief.pose_covariance
        e = truth[t] - x
        e[2] = np.angle(np.exp(1j * e[2]))
        xi, Q = invariant(x[:2], truth[t], x, P)
        path.append(x[:2])
        now = {
            "pose_nees_invariant": nees(xi, Q),
            "pose_nees_additive": nees(e, P),
            "position_nees_invariant": nees(xi[:2], Q[:2, :2]),
            "position_nees_additive": nees(e[:2], P[:2, :2]),
            "heading_nees": e[2] ** 2 / P[2, 2],
            "nis": sum(each.nis for each in reports),
            "nis_dof": sum(each.degrees_of_freedom for each in reports),
            "position_error": np.hypot(*e[:2]),
            "position_error_invariant": np.hypot(
                *invariant(np.array(WORLD.start.pose[:2]), truth[t], x)[0][:2]
            ),
            "heading_error": e[2],
            "heading_std": np.sqrt(P[2, 2]),
            "position_std": np.sqrt(np.trace(P[:2, :2])),
        }
        for key, value in now.items():
            rows[key].append(value)
    found = {key: row for key, row in rows.items() if row}
    ids = list(belief.landmark_ids)
    x, P, state = belief.mean, belief.covariance, np.r_[truth[-1], points[ids].ravel()]
    e = state - x
    e[2] = np.angle(np.exp(1j * e[2]))
    xi, Q = invariant(x[:2], state, x, P)
    parts = [slice(3 + 2 * k, 5 + 2 * k) for k in range(len(ids))]
    step = 1e-6
    slopes = [
        (seen(x + step * d) - seen(x - step * d)) / 2 / step for d in np.eye(len(x))
    ]
    relative, R = seen(state) - seen(x), np.transpose(slopes) @ P @ np.array(slopes)
    c, s = np.cos(x[2]), np.sin(x[2])
    turn = np.array([[c, -s], [s, c]])
    blocks = [R[2 * k : 2 * k + 2, 2 * k : 2 * k + 2] for k in range(len(ids))]
    factors = [np.linalg.cholesky(turn @ block @ turn.T) for block in blocks]
    errors = relative.reshape(-1, 2) @ turn.T
    white = [np.linalg.solve(*pair) for pair in zip(factors, errors, strict=True)]
    near, _ = invariant(x[:2], state, x)
    near = invariant_map(near)
    gaps = np.hypot(*(e[3:].reshape(-1, 2)).T)
    path = np.array(path)
    shifts = np.hypot(*(truth[:, :2] - path).T)
    marginals = [P[part, part] for part in parts]
    return found | {
        "ate": np.sqrt((shifts**2).mean()),
        "ate_aligned": aligned(path, truth[:, :2]),
        "pose_area": 9 * np.pi * np.sqrt(np.linalg.det(P[:2, :2])),
        "state_nees_invariant": nees(xi, Q),
        "state_nees_additive": nees(e, P),
        "state_dof": len(x),
        "relative_map_nees": nees(relative, R),
        "relative_map_dof": len(relative),
        "landmark_rmse": np.sqrt((gaps**2).mean()),
        "landmark_rmse_aligned": aligned(belief.landmarks, points[ids]),
        "landmark_area": np.mean(
            [9 * np.pi * np.sqrt(np.linalg.det(p)) for p in marginals]
        ),
        "map_error_centred": near,
        "landmark_deviation_x": by_id(ids, [w[0] for w in white]),
        "landmark_deviation_y": by_id(ids, [w[1] for w in white]),
        "landmark_nees_invariant": by_id(ids, [nees(xi[p], Q[p, p]) for p in parts]),
        "landmark_nees_additive": by_id(ids, [nees(e[p], P[p, p]) for p in parts]),
        "landmark_mahalanobis": by_id(ids, [nees(e[p], P[p, p]) ** 0.5 for p in parts]),
        "landmark_error": by_id(ids, gaps),
    }


def by_id(ids, values):
    return [dict(zip(ids, values, strict=True)).get(i, np.nan) for i in range(6)]


def invariant_map(xi):
    points = xi[3:].reshape(-1, 2)
    return np.sqrt((((points - points.mean(axis=0)) ** 2).sum(axis=1)).mean())


def bounds(runs):
    """Return the bound of the true paths, from the noise of the world."""
    due = np.arange(LAST + 1)[:, None] % (3, 3, 2) == 0
    moves = np.ones((RUNS, LAST + 1))
    moves[:, [0, RESTS]] = 0
    bound = posterior_bound(
        runs.true_poses,
        runs.landmarks,
        runs.visible,
        moves,
        motion_std=WORLD.motion.std,
        measurement_std=WORLD.sensor.std,
        start_std=WORLD.start.std,
        pose_std=np.where(due, [0.5, 0.5, 0.1], np.inf) * np.ones((RUNS, 1, 1)),
        sensor=BEARING_RANGE.with_noise(range_std_per_metre=0.02),
        origin=(1.0, -2.0),
    )
    names = "position_bound", "heading_bound", "position_bound_raw", "map_bound"
    return dict(zip(names, bound, strict=False))


def noise(runs, run):
    """Return count, sum and sum of squares of the noise in assumed deviations."""
    truth, points = runs.true_poses[run], runs.landmarks[run]
    std = ASSUMED.motion.std
    drawn = {name: [] for name in CHANNELS}
    for t in range(LAST + 1):
        x, y, heading = truth[t]
        for k in np.flatnonzero(runs.visible[run, t]):
            away = (points[k] - (x, y)) @ [1, 1j]
            bearing, distance = runs.measurements[run, t, k]
            gap = np.angle(np.exp(1j * (bearing - np.angle(away) + heading)))
            drawn["bearing"].append(gap / 0.03)
            drawn["range"].append((distance - abs(away)) / (0.06 + 0.03 * abs(away)))
        x, y, heading = truth[t - 1]
        wall = np.hypot(13.0 - x, max(5.0 - y, 0.0, y - 9.0))  # the other one is far
        if t in (0, RESTS) or wall < 0.2 + 3.0 * 1.0 + 6 * 0.25:
            continue
        away = (truth[t, :2] - (x, y)) @ [1, 1j] * np.exp(-1j * heading)
        drawn["along"].append((away.real - 3.0) / std[0])
        drawn["sideways"].append(away.imag / std[1])
        drawn["turn"].append((truth[t, 2] - heading - 0.3) / std[2])
    assert 2 < len(drawn["along"]) < LAST - 1
    return [[len(e), np.sum(e), np.square(e).sum()] for e in drawn.values()]


@pytest.mark.parametrize("label", ["ekf", "invariant", "single", "fails"])
def test_every_variable_is_that_of_a_loop_by_hand(label, study, runs):
    bound = bounds(runs)
    for run in {*range(RUNS)} - ({FAILED} if label == "fails" else set()):
        found = study.sel(estimator=label, run=run)
        expected = columns(label, runs, run) | {k: v[run] for k, v in bound.items()}
        expected |= {
            "readings": runs.visible[run].sum(),
            "noise_sums": noise(runs, run),
        }
        expected |= {"failed": False, "failed_at": -1, "message": ""}
        assert set(expected) == set(VARIABLES)
        assert found.message.item() == expected.pop("message")
        for name, value in expected.items():
            got = found[name].values[..., :3] if name == "noise_sums" else found[name]
            np.testing.assert_allclose(got, value, 1e-6, 1e-9, err_msg=name)


def test_a_gap_is_a_step_without_nees_after_the_first_or_a_scan_without_nis():
    nees = np.array([[np.nan, np.nan, 3.0, 3.0, 1e200]])
    nis = np.array([[np.nan, 2.0, np.nan, np.nan, 2.0]])
    freedom = np.array([[0, 2, 0, 2, 2]])
    assert gaps(1, nees, nis, freedom).tolist() == [[False, True, False, True, True]]


def test_a_run_that_fails_has_its_numbers_up_to_this_step(study, runs):
    found, other = (study.sel(estimator=e, run=FAILED) for e in ("fails", "single"))
    assert found.failed
    assert found.failed_at == FAILS
    assert "covariance or the NIS is not finite" in found.message.item()
    for name, (dims, *_) in VARIABLES.items():
        now, whole = found[name].values, other[name].values
        if name in {"pose_nees_invariant", "nis", "position_error", "heading_std"}:
            whole[FAILS:] = np.nan
        elif name == "nis_dof":
            whole[FAILS:] = 0
        elif "landmark" in dims or name in {"ate", "pose_area", "state_nees_additive"}:
            whole[...] = np.nan
        elif "bound" not in name and name not in {"readings", "noise_sums"}:
            continue
        np.testing.assert_array_equal(now, whole, err_msg=name)
