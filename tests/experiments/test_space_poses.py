"""Poses in space: SE(3), the verdict on six coordinates, and its conventions."""

import json
import re

import numpy as np
import pytest
from commands import slamgym
from scipy.linalg import expm, logm
from scipy.spatial.transform import Rotation

from slamgym.experiments import space_poses
from slamgym.experiments.space_poses import (
    Pose,
    SpaceEstimate,
    _fit,
    _nearer,
    _pose_readings,
    _readings,
    _stacked,
    adjoint,
    between,
    composed,
    exponential,
    hat,
    judge_in_space,
    logarithm,
    nees_in_space_figure,
)

RUNS, STEPS = 40, 25
INVERSE = "poses of the world as the robot sees it (inverse)"
SWAP = np.eye(6)[[3, 4, 5, 0, 1, 2]]


def twist_matrix(twist):
    matrix = np.zeros((4, 4))
    matrix[:3, :3], matrix[:3, 3] = hat(twist[3:]), twist[:3]
    return matrix


def whole(pose):
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = pose.rotations, pose.positions
    return matrix


@pytest.mark.parametrize("angle", [0.0, 1e-9, 9e-5, 1e-3, 0.5, 3.0, np.pi - 1e-6])
def test_exponential_and_logarithm_are_those_of_matrices(angle):
    rng = np.random.default_rng(1)
    axis = rng.normal(size=3)
    twist = np.append(rng.normal(size=3), angle * axis / np.linalg.norm(axis))
    pose = exponential(twist)
    expected = expm(twist_matrix(twist))
    np.testing.assert_allclose(whole(pose), expected, rtol=0, atol=1e-12)
    fine = 1e-9 if angle > 3 else 1e-13
    np.testing.assert_allclose(logarithm(pose), twist, rtol=0, atol=fine)
    if angle < 3.1:
        matrix = logm(whole(pose)).real
        np.testing.assert_allclose(twist_matrix(logarithm(pose)), matrix, atol=1e-7)


def test_the_adjoint_moves_a_twist_to_the_other_side():
    rng = np.random.default_rng(2)
    pose, twist = exponential(rng.normal(size=6)), 0.3 * rng.normal(size=6)
    right = exponential((adjoint(pose) @ twist[:, None])[:, 0])
    one, other = composed(pose, exponential(twist)), composed(right, pose)
    np.testing.assert_allclose(whole(one), whole(other), atol=1e-12)


def drives(seed, runs=RUNS, tilt=0.0, noise=1.0):
    """Dead reckoning with an honest covariance of the left error."""
    rng = np.random.default_rng(seed)
    std = noise * np.array([0.02, 0.02, 0.02, 0.01, 0.01, 0.01])
    step = exponential(np.array([0.5, 0, 0.05, 0.02, -0.05, 0.12]))
    back = adjoint(between(step, Pose(np.zeros(3), np.eye(3))))
    for _ in range(runs):
        true = estimate = exponential(np.array([1, 2, 0, tilt, 0, 0.0]))
        P, rows = (1e-2 * noise) ** 2 * np.eye(6), []
        true = composed(true, exponential(1e-2 * noise * rng.normal(size=6)))
        for _ in range(STEPS):
            rows.append((true, estimate, P))
            shift = exponential(std * rng.normal(size=6))
            true = composed(composed(true, step), shift)
            estimate = composed(estimate, step)
            P = back @ P @ back.T + np.diag(std**2)
        yield rows


def body_to_world(pose):
    matrix = np.eye(6)
    matrix[:3, :3] = pose.rotations
    return matrix


WRITTEN = {
    "left": lambda X, P: P,
    "right": lambda X, P: adjoint(X) @ P @ adjoint(X).T,
    "decoupled": lambda X, P: body_to_world(X) @ P @ body_to_world(X).T,
    "left, rotation first": lambda X, P: SWAP @ P @ SWAP.T,
    "left, transported to the right error by Jᵀ P J instead of J P Jᵀ": (
        lambda X, P: adjoint(X).T @ P @ adjoint(X)
    ),
}


def write(folder, seed, change, runs=RUNS, *, tilt=0.0, start=0.0, noise=1.0):
    for k, rows in enumerate(drives(seed, runs, tilt, noise)):
        for name in "et":
            (folder / name).mkdir(exist_ok=True)
            lines = []
            for step, (true, estimate, P) in enumerate(rows):
                pose = true if name == "t" else estimate
                quaternion = Rotation.from_matrix(pose.rotations).as_quat()
                line = [start + step, *pose.positions, *quaternion]
                lines.append(line + list(change(estimate, P).flat) * (name == "e"))
            np.savetxt(folder / name / f"seed_{k}.tum", lines, fmt="%.17g")
    return folder / "e", folder / "t"


def said_of(written):
    kind, comma, rest = written.partition(", ")
    return f"convention: covariances of the {kind} error{comma}{rest}: read so, NEES"


@pytest.mark.parametrize("written", list(WRITTEN)[1:])
@pytest.mark.parametrize("tilt", [0.0, 3.1])
def test_a_convention_of_poses_in_space_is_named(written, tilt, tmp_path):
    estimates, truth = write(tmp_path, 5, WRITTEN[written], tilt=tilt)
    found = judge_in_space(estimates, truth)
    assert found["verdict"] == "not consistent"
    assert found["cause"].startswith(said_of(written))


@pytest.mark.parametrize("kind", ["left", "right", "decoupled"])
@pytest.mark.parametrize("order", ["translation-first", "rotation-first"])
def test_honest_poses_in_space_are_not_rejected(kind, order, tmp_path):
    swap = SWAP if order == "rotation-first" else np.eye(6)
    estimates, truth = write(
        tmp_path, 6, lambda X, P: swap @ WRITTEN[kind](X, P) @ swap.T
    )
    found = judge_in_space(estimates, truth, covariances=kind, order=order)
    assert found["verdict"] != "not consistent"
    assert not found["cause"]
    assert all(0.8 < ratio < 1.25 for ratio in found["nees"].values())
    low, high = map(
        float, re.search(r"ratio, \[(.*?), (.*?)\]", found["reason"]).groups()
    )
    assert low < found["nees"]["pose"] < high


def inverse(rows):
    quaternions = Rotation.from_quat(rows[:, 4:8]).inv()
    rows[:, 1:4] = -quaternions.apply(rows[:, 1:4])
    rows[:, 4:8] = quaternions.as_quat()


def first_w(rows):
    rows[:, 4:8] = rows[:, [7, 4, 5, 6]]


def centimetres(rows):
    rows[:, 1:4] *= 100


def late(rows):
    rows[:, 0] += 0.5


@pytest.mark.parametrize(
    ("change", "folder", "name"),
    [
        (inverse, "t", f"{INVERSE}, in the truth"),
        (first_w, "t", "quaternions that begin with qw, in the truth"),
        (centimetres, "e", "positions in centimetres"),
        (late, "e", "time stamps that are 0.5 steps too late"),
    ],
)
def test_a_convention_of_the_poses_in_space_is_named(change, folder, name, tmp_path):
    places = write(tmp_path, 13, WRITTEN["left"], runs=3, noise=1e-2)
    for path in (tmp_path / folder).iterdir():
        rows = np.loadtxt(path)
        change(rows)
        np.savetxt(path, rows, fmt="%.17g")
    found = judge_in_space(*places)
    assert found["verdict"] == "not consistent"
    assert found["cause"].startswith(f"convention: {name}: read so, the median errors")


def test_the_truth_in_space_is_interpolated_along_its_twist(tmp_path):
    """A helix of a constant twist, known at half steps, is exact between them."""
    twist = np.array([0.5, 0, 0.2, 0.1, 0, 0.6])
    for name, times in (("t", np.arange(9) + 0.5), ("e", np.arange(9.0))):
        (tmp_path / name).mkdir()
        poses = exponential(times[:, None] * twist)
        quaternions = Rotation.from_matrix(poses.rotations).as_quat()
        columns = [times[:, None], poses.positions, quaternions]
        if name == "e":
            columns.append(np.tile(np.eye(6).ravel(), (9, 1)))
        for k in range(2):
            np.savetxt(tmp_path / name / f"seed_{k}.tum", np.hstack(columns))
    found = judge_in_space(tmp_path / "e", tmp_path / "t")
    assert (found["left_out"], found["steps"]) == (2, 8)
    assert found["nees"]["pose"] < 1e-25


def test_an_npz_of_poses_in_space_is_judged_like_tum(tmp_path):
    estimates, truth = write(tmp_path, 9, WRITTEN["left"], runs=3)
    tables = [np.loadtxt(path) for path in sorted(estimates.iterdir())]
    poses = [table[:, 1:8] for table in tables]
    claims = [table[:, 8:].reshape(-1, 6, 6) for table in tables]
    arrays = {"belief_poses": poses, "belief_pose_covariances": claims}
    np.savez(tmp_path / "all.npz", seed=[0, 1, 2], **arrays)
    found = judge_in_space(tmp_path / "all.npz", truth)
    same = judge_in_space(estimates, truth)["nees"]
    assert found["nees"] == pytest.approx(same, rel=1e-12)
    true = [np.loadtxt(path)[:, 1:] for path in sorted(truth.iterdir())]
    times = np.tile(np.arange(STEPS), (3, 1))
    np.savez(tmp_path / "truth.npz", seed=[0, 1, 2], poses=true, times=times)
    for theirs in tmp_path / "all.npz", estimates:
        again = judge_in_space(theirs, tmp_path / "truth.npz")["nees"]
        assert again == pytest.approx(same, rel=1e-12)
    np.savez(tmp_path / "truth.npz", seed=[0, 1, 2], poses=true, times=times[:, ::-1])
    with pytest.raises(ValueError, match=r"truth\.npz: times must be \(T,\) for each"):
        judge_in_space(estimates, tmp_path / "truth.npz")
    np.savez(tmp_path / "truth.npz", seed=[0, 1, 2], poses=poses[0])
    with pytest.raises(ValueError, match=r"truth\.npz: poses must be \(T, 7\) for"):
        judge_in_space(estimates, tmp_path / "truth.npz")
    np.savez(tmp_path / "truth.npz", seed=[0, 1, 2], poses=np.array(true)[:, 1:])
    with pytest.raises(ValueError, match=r"truth has no times, so .*, got 25 and 24"):
        judge_in_space(estimates, tmp_path / "truth.npz")
    np.savez(tmp_path / "all.npz", seed=[0, 1, 2], belief_poses=poses)
    with pytest.raises(ValueError, match=r"all\.npz must hold belief_poses and"):
        judge_in_space(tmp_path / "all.npz", truth)


def test_a_drive_of_one_pose_in_space_is_refused_with_its_file(tmp_path):
    pose, claim = np.array([[0, 0, 0, 0, 0, 0, 1.0]]), np.eye(6)[None]
    np.savez(tmp_path / "run.npz", belief_poses=pose, belief_pose_covariances=claim)
    truth = tmp_path / "run.tum"
    truth.write_text("0 0 0 0 0 0 0 1\n")
    with pytest.raises(ValueError, match=r"run\.npz must have at least two poses, got"):
        judge_in_space(tmp_path / "run.npz", truth)


def test_what_is_no_pose_in_space_is_refused(tmp_path):
    estimates, truth = write(tmp_path, 10, WRITTEN["left"], runs=2)
    with pytest.raises(ValueError, match="order must be 'translation-first' or"):
        judge_in_space(estimates, truth, order="left")
    path = estimates / "seed_1.tum"
    rows = np.loadtxt(path)
    for wrong, message in (
        (rows[:, :17], "line 1: expected 36 or 21 entries of a covariance"),
        (rows * [*4 * [1], *4 * [0], *36 * [1]], "line 1: expected a rotation qx qy"),
        (rows[::-1], "line 2: expected a time stamp after 24, got 23; sort the rows"),
        (rows + np.eye(44)[9], "the covariance of pose 0 must be finite and symmetric"),
        (rows + 99 * np.eye(44)[0], "must share at least two times"),
    ):
        np.savetxt(path, wrong, fmt="%.17g")
        with pytest.raises(ValueError, match=message):
            judge_in_space(estimates, truth)


@pytest.mark.parametrize(
    ("gains", "is_named"),
    [
        (np.full(40, 0.24), False),
        (np.full(40, 0.26), True),
        (np.tile([3.1, -2.1], 20), False),  # 0.5, with a standard error of 0.41
        (np.tile([1.1, -0.1], 20), True),
    ],
)
def test_a_cause_explains_much_more_than_chance(gains, is_named, monkeypatch):
    fits = {
        "as given": (False, np.full(40, -3.0), 9.0),
        "dishonest": (False, np.full(40, 9.0), 1.0),
        "less likely": (True, gains - 3.1, 1.0),
        "right": (True, gains - 3.0, 1.04),
    }
    monkeypatch.setattr(space_poses, "_fit", lambda error, _: fits[error])
    readings = {name: (name, None) for name in fits}
    nees = np.append(np.full(9, 54.0), np.nan)
    said = "convention: right: read so, NEES / 6 is 1.04, not 9."
    assert space_poses._cause(readings, "as given", nees) == said * is_named


def test_the_command_judges_poses_in_space(tmp_path, monkeypatch):
    monkeypatch.setattr("sys.argv", ["/bin/slamgym", "judge", "my poses"])
    estimates, truth = write(tmp_path, 11, WRITTEN["right"])
    call = "judge", estimates, "--truth", truth, "--out", tmp_path / "out"
    done = slamgym(*call, "--space", "left", "--json")
    found = json.loads(done.stdout)
    assert found["cause"].startswith(said_of("right"))
    saved = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert saved == {name: found[name] for name in found if name != "out"}
    assert saved["files"] == ["nees.svg", "summary.json"]
    assert saved["command"] == "slamgym judge 'my poses'"
    for name, ratio in saved["nees"].items():
        assert np.mean(saved["nees_over_time"][name]) == pytest.approx(ratio)
    assert "ANEES / n" in (tmp_path / "out" / "nees.svg").read_text()
    done = slamgym(*call, "--space", "left")
    printed = " ".join(done.stdout.split())
    assert "e: not consistent: the squared errors of the pose" in printed
    assert f"cause: {said_of('right')}" in printed
    files = "".join(done.stdout.split())  # a long path is broken
    assert files.endswith(f"Wrote{tmp_path}/out/nees.svg,summary.json")
    done = slamgym(*call, "--space", "right", "--json")
    assert json.loads(done.stdout)["cause"] == ""
    done = slamgym(*call, "--space", "up")
    assert "--space must be one of left, right, decoupled, got 'up'" in done.stderr


def test_an_error_of_the_scale_is_not_named_as_a_unit(tmp_path):
    places = write(tmp_path, 13, WRITTEN["left"], runs=3, noise=1e-3)
    for path in (tmp_path / "e").iterdir():
        rows = np.loadtxt(path)
        rows[:, 1:4] *= 1.004
        np.savetxt(path, rows, fmt="%.17g")
    found = judge_in_space(*places)
    assert found["verdict"] == "not consistent"
    assert found["cause"] == ""


@pytest.mark.parametrize("runs", [1, 3])
def test_covariances_in_a_plane_are_refused_as_those_of_space(runs, tmp_path):
    flat = np.diag([1.0, 1.0, 0.0, 0.0, 0.0, 1.0])
    places = write(tmp_path, 16, lambda X, P: flat @ P @ flat, runs=runs)
    with pytest.raises(
        ValueError, match=r"seed_0\.tum: every covariance of six .* is "
    ):
        judge_in_space(*places)


def test_the_figure_in_space_shows_steps_without_nees_as_gaps(tmp_path):
    """The covariance of a known start is 0."""
    places = write(tmp_path, 14, lambda X, P: P * (P[0, 0] > 1.5e-4), runs=3)
    found = judge_in_space(*places)
    assert found["nees_over_time"]["pose"][0] is None
    axes = nees_in_space_figure(found).axes[0]
    lines = {line.get_label(): line.get_ydata() for line in axes.lines}
    shown = np.asarray(lines["pose"], dtype=float)
    assert np.nanmean(shown) == pytest.approx(found["nees"]["pose"])
    band = f"95 % band, {found['tested_steps']} steps"
    assert {"pose", "position", "rotation", band} <= set(lines)
    assert axes.get_yscale() == "linear"
    found["nees_over_time"]["rotation"][9] = 5.0
    assert nees_in_space_figure(found).axes[0].get_yscale() == "log"


def test_two_estimators_in_space_are_refused(tmp_path):
    estimates, truth = write(tmp_path, 15, WRITTEN["left"], runs=2)
    with pytest.raises(ValueError, match=r"must be those of one estimator, .* e and t"):
        judge_in_space([estimates, truth], truth)


# ---- the conventions, compared with matrix formulas


def some_poses(rng, runs=6, steps=5):
    """Return the poses of a few drives, the truth near them, and covariances."""
    poses = exponential(rng.normal(size=(runs, steps, 6)))
    roots = rng.normal(0, 0.05, (runs, steps, 6, 6))
    claims = roots @ roots.swapaxes(-1, -2) + 1e-4 * np.eye(6)
    noise = np.linalg.cholesky(claims) @ rng.normal(size=(runs, steps, 6, 1))
    return poses, composed(poses, exponential(noise[..., 0])), claims


def each_pose(poses):
    for at in np.ndindex(poses.positions.shape[:2]):
        yield at, whole(Pose(poses.positions[at], poses.rotations[at]))


def vector(matrix):
    return np.array(
        [*matrix[:3, 3], matrix[2, 1], matrix[0, 2], matrix[1, 0]], dtype=float
    )


@pytest.mark.parametrize("order", ["translation-first", "rotation-first"])
def test_covariances_in_space_are_read_in_every_convention(order):
    poses, truth, claims = some_poses(np.random.default_rng(30))
    found = dict(_readings(truth, poses, claims, order))
    swap = {"translation-first": np.eye(6), "rotation-first": SWAP}
    degrees = np.diag([1, 1, 1, *[np.pi / 180] * 3])
    for at, X in each_pose(poses):
        T = whole(Pose(truth.positions[at], truth.rotations[at]))
        left, R = vector(logm(np.linalg.inv(X) @ T).real), X[:3, :3]
        errors = {
            "left": left,
            "right": vector(logm(T @ np.linalg.inv(X)).real),
            "decoupled": np.append(T[:3, 3] - X[:3, 3], left[3:]),
        }
        ad = adjoint(Pose(X[:3, 3], R))
        plain = np.block([[R, np.zeros((3, 3))], [np.zeros((3, 3)), np.eye(3)]])
        A = {"left": np.eye(6), "right": ad, "decoupled": plain}
        C = swap[order] @ claims[at] @ swap[order].T
        expected = {}
        for each, matrix in swap.items():
            own = "" if each == "translation-first" else ", rotation first"
            for kind, error in errors.items():
                name = f"covariances of the {kind} error{own}"
                expected[name] = error, matrix @ claims[at] @ matrix.T
                if each != order:
                    continue
                turned = degrees @ C @ degrees
                expected[f"{name}, rotations in degrees"] = error, turned
                for target in set(errors) - {kind}:
                    back = A[kind] @ np.linalg.inv(A[target])
                    said = f"transported to the {target} error by Jᵀ P J instead of"
                    expected[f"{name}, {said} J P Jᵀ"] = error, back.T @ C @ back
        assert set(found) == set(expected)
        for name, (error, matrix) in expected.items():
            np.testing.assert_allclose(found[name][0][at], error, atol=1e-7)
            np.testing.assert_allclose(
                found[name][1][at], matrix, rtol=1e-9, atol=1e-12
            )


def test_poses_in_space_are_read_in_every_convention():
    rng = np.random.default_rng(31)
    poses, truth, _ = some_poses(rng)
    truth = truth._replace(positions=7 * truth.positions)
    found = {name: pair for name, *pair in _pose_readings(truth, poses)}
    scale = np.sqrt(
        np.square(truth.positions - truth.positions.mean(axis=1)[:, None]).sum()
        / np.square(poses.positions - poses.positions.mean(axis=1)[:, None]).sum()
    )
    unit = f"positions in a unit of {scale:.3g} m"
    first = "quaternions that begin with qw"
    shifts = [-2, -1.5, -1, -0.5, 0.5, 1, 1.5, 2]
    late = {
        f"time stamps that are {abs(s):.2g} steps too {'late' if s > 0 else 'early'}": s
        for s in shifts
    }
    both = {INVERSE, first, f"{INVERSE}, in the truth", f"{first}, in the truth"}
    assert set(found) == {*both, unit, *late}
    np.testing.assert_allclose(found[unit][1].positions, scale * poses.positions)
    assert found[unit][0] is truth
    for at, X in each_pose(poses):
        for name, place in ((INVERSE, 1), (first, 1), (INVERSE, 0), (first, 0)):
            given = (
                X if place else whole(Pose(truth.positions[at], truth.rotations[at]))
            )
            x, y, z, w = Rotation.from_matrix(given[:3, :3]).as_quat()
            rolled = given.copy()
            rolled[:3, :3] = Rotation.from_quat([y, z, w, x]).as_matrix()
            read = found[name if place else f"{name}, in the truth"]
            assert read[1 - place] is (truth, poses)[1 - place]
            expected = np.linalg.inv(given) if name == INVERSE else rolled
            shown = Pose(read[place].positions[at], read[place].rotations[at])
            np.testing.assert_allclose(whole(shown), expected, atol=1e-12)
    twist = np.array([0.5, 0, 0.2, 0.1, 0, 0.6])
    line = exponential(np.arange(9.0)[None, :, None] * twist)
    for name, shift in late.items():
        ((then, same),) = [p for n, *p in _pose_readings(line, line) if n == name]
        expected = exponential(np.clip(np.arange(9.0) - shift, 0, 8)[:, None] * twist)
        np.testing.assert_allclose(then.positions[0], expected.positions, atol=1e-12)
        np.testing.assert_allclose(then.rotations[0], expected.rotations, atol=1e-12)
        assert same is line


@pytest.mark.parametrize("scale", [0.5, 0.85, 1.0, 1.2, 1.4])
def test_a_fit_in_space_is_that_of_whitened_errors_after_the_start(scale):
    rng = np.random.default_rng(32)
    _, _, claims = some_poses(rng, 9)
    errors = scale * np.linalg.cholesky(claims) @ rng.normal(size=(9, 5, 6, 1))
    is_honest, likelihood, nees = _fit(errors[..., 0], claims)
    squares, logs = np.empty((9, 4, 6)), np.empty((9, 4))
    for run, step in np.ndindex(9, 4):
        P, e = claims[run, step + 1], errors[run, step + 1, :, 0]
        root = np.linalg.cholesky(SWAP @ P @ SWAP.T)
        squares[run, step] = np.linalg.solve(root, SWAP @ e) ** 2
        logs[run, step] = np.linalg.slogdet(P)[1]
    np.testing.assert_allclose(
        likelihood, -0.5 * (squares.sum(axis=2) + logs).mean(axis=1)
    )
    runs = squares.mean(axis=1)
    mean = runs.mean(axis=0)
    assert nees == pytest.approx(mean.mean())
    limit = np.log(1.5) + 3 * runs.std(axis=0) / 3 / mean
    assert is_honest == (abs(np.log(mean)) <= np.minimum(limit, np.log(2.5))).all()
    assert _fit(errors[..., 0], -claims)[0] is False


@pytest.mark.parametrize(
    ("mean", "swing", "is_honest"),
    [
        *((1 / 2.6, 0.9, False), (1 / 2.4, 0.9, True)),
        *((2.6, 0.9, False), (2.4, 0.9, True), (2.1, 0.3, False), (2.0, 0.3, True)),
    ],
)
def test_squares_of_an_honest_fit_in_space_have_a_mean_within_a_factor(
    mean, swing, is_honest
):
    """Runs that differ much do not excuse more."""
    size = np.sqrt(mean * (1 + swing * (-1.0) ** np.arange(8)))
    errors = size[:, None, None] * np.ones((8, 5, 6))
    fit = _fit(errors, np.broadcast_to(np.eye(6), (8, 5, 6, 6)))
    assert fit[0] == is_honest


def test_estimates_in_space_of_several_lengths_are_thinned_to_the_shortest():
    rng, drives = np.random.default_rng(33), []
    for count, left in ((9, 2), (5, 1)):
        poses, truth, claims = (
            Pose(*(part[0] for part in each)) if isinstance(each, Pose) else each[0]
            for each in some_poses(rng, 1, count)
        )
        drives.append((truth, SpaceEstimate("file", poses, claims), left))
    exact, found, claims, left_out = _stacked(drives)
    assert left_out == 3
    for run, rows in enumerate(([0, 2, 4, 6, 8], [0, 1, 2, 3, 4])):
        truth, estimate, _ = drives[run]
        np.testing.assert_array_equal(exact.positions[run], truth.positions[rows])
        np.testing.assert_array_equal(exact.rotations[run], truth.rotations[rows])
        np.testing.assert_array_equal(
            found.positions[run], estimate.poses.positions[rows]
        )
        np.testing.assert_array_equal(claims[run], estimate.covariances[rows])


def test_far_smaller_errors_in_space_are_named_with_both():
    truth, *_ = some_poses(np.random.default_rng(34))
    off = np.tile([0.01, 0, 0, 0, 0, 0.002], (6, 5, 1))
    origin = Pose(np.zeros((6, 5, 3)), np.tile(np.eye(3), (6, 5, 1, 1)))
    near = composed(exponential(off), truth)
    poses = between(near, origin)
    assert _nearer(truth, near) == ""
    gaps = np.linalg.norm(truth.positions - poses.positions, axis=-1)
    turns = Rotation.from_matrix(
        (truth.rotations.swapaxes(-1, -2) @ poses.rotations).reshape(-1, 3, 3)
    ).magnitude()
    before = f"{np.median(gaps):.2g} m and {np.median(turns):.2g} rad"
    assert _nearer(truth, poses) == (
        f"convention: {INVERSE}, in the truth: read so, the median errors are 0.01 m "
        f"and 0.002 rad instead of {before}."
    )
