"""Compare how each convention of estimates is read with a formula of the test."""

from itertools import permutations

import numpy as np
import pytest

from slamgym.experiments.estimate_conventions import (
    FRAMES,
    PosesAsRead,
    _between_steps,
    _Errors,
    _fit,
    _gain,
    _in_other_units,
    _jacobian,
    _nearer,
    _pose_readings,
    _readings,
    _truth_at,
    additive_covariances,
    mistake_in_estimates,
    stray_poses,
    swapped_drives,
)

B, T = 7, 5
RNG = np.random.default_rng(0)
POSES = RNG.uniform(-3, 3, (B, T, 3))
ROOTS = RNG.normal(0, 0.2, (B, T, 3, 3))
CLAIMS = ROOTS @ ROOTS.swapaxes(-1, -2) + 0.02 * np.eye(3)
STARTS = RNG.uniform(-2, 2, (B, 3))
INVERSE = "poses of the world as the robot sees it (inverse)"
QUARTER = np.array([0, 0, np.pi / 2])
SHIFTED = {2: (POSES + 1, CLAIMS + 1), -1: (POSES - 1, CLAIMS - 1)}


def moved(start, pose):
    """Return the pose in the world of a pose that is given in the frame of another."""
    point = start[0] + 1j * start[1] + np.exp(1j * start[2]) * (pose[0] + 1j * pose[1])
    return np.array([point.real, point.imag, start[2] + pose[2]])


def inverse(pose):
    point = -np.exp(-1j * pose[2]) * (pose[0] + 1j * pose[1])
    return np.array([point.real, point.imag, -pose[2]])


READ = {
    "": lambda p, start: p,
    "headings in degrees instead of radians": lambda p, _: [*p[:2], np.radians(p[2])],
    "headings that grow clockwise": lambda p, _: p * [1, 1, -1],
    "y to the right of x": lambda p, _: p * [1, -1, 1],
    "y to the right of x, and headings that grow clockwise": lambda p, _: (
        p * [1, -1, -1]
    ),
    "headings that are 90° too small": lambda p, _: p + QUARTER,
    "headings that are 180° off": lambda p, _: p + 2 * QUARTER,
    "headings that are 90° too large": lambda p, _: p - QUARTER,
    "headings clockwise from the y axis": lambda p, _: [*p[:2], np.pi / 2 - p[2]],
    INVERSE: lambda p, _: inverse(p),
    "poses in the frame of the start": lambda p, start: moved(start, p),
}
READ |= {
    f"the order ({', '.join(order)}) instead of (x, y, θ)": (
        lambda p, _, order=order: p[[order.index(part) for part in "xyθ"]]
    )
    for order in permutations("xyθ")
    if order != ("x", "y", "θ")
}


def test_poses_are_read_in_every_convention_with_its_derivative():
    found = {
        name: each for name, *each in _pose_readings(POSES, CLAIMS, STARTS, SHIFTED)
    }
    late, early = "2 steps too late", "1 step too early"
    shifts = {f"time stamps that are {late}": 2, f"time stamps that are {early}": -1}
    assert set(found) == {*READ, *shifts}
    for name, shift in shifts.items():
        poses, claims, jacobian = found[name]
        np.testing.assert_array_equal(poses, SHIFTED[shift][0])
        np.testing.assert_array_equal(claims, SHIFTED[shift][1])
        np.testing.assert_array_equal(jacobian, np.eye(3))
    for name, read in READ.items():
        poses, claims, jacobian = found[name]
        jacobians = np.broadcast_to(jacobian, (B, T, 3, 3))
        np.testing.assert_array_equal(claims, CLAIMS)
        for b, t in ((0, 1), (3, 4), (6, 0)):
            pose, start = POSES[b, t], STARTS[b]
            np.testing.assert_allclose(poses[b, t], read(pose, start), atol=1e-12)
            steps = 1e-6 * np.eye(3)
            slopes = [
                (np.array(read(pose + s, start)) - read(pose - s, start)) / 2e-6
                for s in steps
            ]
            np.testing.assert_allclose(jacobians[b, t], np.transpose(slopes), atol=1e-8)


def of_order(order):
    rows = [order.index(part) for part in "xyθ"]
    return lambda C: C[..., rows, :][..., rows]


def scaled(x, heading):
    D = np.array([x, x, heading])
    return lambda C: C * D * D[:, None]


def from_lower(C):
    """Fill the lower triangle by rows with the entries of the upper one in the file."""
    full = np.empty_like(C)
    upper = [C[..., i, j] for i in range(3) for j in range(i, 3)]
    places = [(i, j) for i in range(3) for j in range(i + 1)]
    for entry, (i, j) in zip(upper, places, strict=True):
        full[..., i, j] = full[..., j, i] = entry
    return full


READ_CLAIMS = {
    "": lambda C: C,
    "covariances with headings in degrees": scaled(1.0, np.pi / 180),
    "covariances with positions in centimetres": scaled(0.01, 1.0),
    "covariances with positions in millimetres": scaled(0.001, 1.0),
    "covariances with positions in metres, but poses in centimetres": scaled(100, 1.0),
    "covariances with positions in metres, but poses in millimetres": scaled(1000, 1.0),
    "the lower triangle of the covariance, row by row": from_lower,
    "standard deviations in place of variances": lambda C: np.sign(C) * C**2,
    "information matrices in place of covariances": np.linalg.inv,
}
READ_CLAIMS |= {
    f"covariances with the order ({', '.join(order)}) instead of (x, y, θ)": (
        of_order(order)
    )
    for order in permutations("xyθ")
    if order != ("x", "y", "θ")
}


@pytest.mark.parametrize("frame", FRAMES)
@pytest.mark.parametrize("decides", ["additive", "invariant"])
def test_covariances_are_read_in_every_convention(frame, decides):
    turned = POSES + 4 * QUARTER  # headings are wrapped
    found = list(_readings("", turned, CLAIMS, np.eye(3), _Errors(frame, decides)))
    A = {kind: _jacobian(POSES, kind) for kind in FRAMES}
    expected = {
        name: additive_covariances(POSES, read(CLAIMS), frame)
        for name, read in READ_CLAIMS.items()
    }
    kinds = dict.fromkeys(expected, frame)
    for kind, title in FRAMES.items():
        if kind != frame:
            name = f"covariances of {title}"
            expected[name] = additive_covariances(POSES, CLAIMS, kind)
            kinds[name] = kind
        for target in set(FRAMES) - {kind}:
            J = np.linalg.inv(A[target]) @ A[kind]
            back = np.linalg.inv(J)
            P = back.swapaxes(-1, -2) @ CLAIMS @ back
            name = f"covariances of {title} transported by Jᵀ P J instead of J P Jᵀ"
            expected.setdefault(name, []).append(additive_covariances(POSES, P, kind))
            kinds[name] = kind
    assert {each.name for each in found} == set(expected)
    assert len(found) == len(expected) + 3  # two targets of each transport
    for each in found:
        name, wanted = each.name, expected[each.name]
        np.testing.assert_allclose(each.poses, POSES, atol=1e-12)
        options = wanted if isinstance(wanted, list) else [wanted]
        assert any(np.allclose(each.covariances, C, rtol=1e-9) for C in options), name
        assert each.is_additive == (kinds[name] == decides == "additive")
        assert each.truth is None


@pytest.mark.parametrize("frame", ["left", "invariant"])
def test_additive_covariances_are_those_of_a_numeric_jacobian(frame):
    pose, eps = np.array([2.0, -1.0, 0.7]), 1e-6
    cos, sin = np.cos(pose[2]), np.sin(pose[2])

    def moved(xi):
        """Apply a small motion to the estimate, in the robot's or the world's frame."""
        small = np.array([[1, -xi[2], xi[0]], [xi[2], 1, xi[1]], [0, 0, 1]])
        own = np.array([[cos, -sin, pose[0]], [sin, cos, pose[1]], [0, 0, 1]])
        result = own @ small if frame == "left" else small @ own
        heading = np.arctan2(result[1, 0], result[0, 0])
        return np.array([result[0, 2], result[1, 2], heading])

    steps = eps * np.eye(3)
    J = np.column_stack([(moved(s) - moved(-s)) / (2 * eps) for s in steps])
    P = np.array([[2.0, 0.3, 0.1], [0.3, 1.0, -0.2], [0.1, -0.2, 0.5]])
    found = additive_covariances(pose, P, frame)
    np.testing.assert_allclose(found, J @ P @ J.T, rtol=1e-6)


def test_a_covariance_follows_the_convention_of_its_pose():
    J = np.diag([1.0, 2.0, 3.0])
    first, second, *rest = _readings("a", POSES, CLAIMS, J, _Errors("additive", ""))
    assert (first.name, second.name) == ("a", "a")
    np.testing.assert_array_equal(first.covariances, CLAIMS)
    np.testing.assert_allclose(second.covariances, J @ CLAIMS @ J)
    assert all(each.name.startswith("a; ") for each in rest)
    flat = CLAIMS * np.eye(3)
    plain = [each.name for each in _readings("", POSES, flat, J, _Errors("left", ""))]
    assert not any("error" in name for name in plain)  # without correlations


def test_positions_are_scaled_to_the_size_of_the_true_path():
    truth = POSES.copy()
    truth[..., :2] = 0.31 * truth[..., :2] + 5
    ((name, poses, claims, matrix),) = _in_other_units(truth, POSES, CLAIMS)
    assert name == "positions in feet"
    np.testing.assert_allclose(matrix, np.diag([0.3048, 0.3048, 1.0]))
    np.testing.assert_allclose(poses, POSES * [0.3048, 0.3048, 1])
    assert claims is CLAIMS
    truth[..., :2] = 1.1 * POSES[..., :2]
    assert not list(_in_other_units(truth, POSES, CLAIMS))
    assert not list(_in_other_units(0 * truth, POSES, CLAIMS))  # at rest
    assert not list(_in_other_units(truth, 0 * POSES, CLAIMS))
    truth[..., :2] = 0.7 * POSES[..., :2]
    ((name, poses, *_),) = _in_other_units(truth, POSES, CLAIMS)
    assert name == "positions in a unit of 0.7 m"
    np.testing.assert_allclose(poses[..., :2], truth[..., :2])


def arcs(times):
    """Return poses on circles of several radii, shape (6, T, 3)."""
    radius = np.arange(1.0, 7.0)[:, None]
    heading = np.asarray(times) / radius
    x, y = radius * np.sin(heading) - 2, radius * (1 - np.cos(heading))
    return np.stack([x, y, heading], axis=-1)


def test_the_truth_between_steps_lies_on_arcs():
    truth = arcs(np.arange(12.0))
    places = np.array([2.3, 5.0, 7.9])
    np.testing.assert_allclose(_truth_at(truth, places), arcs(places), atol=1e-12)


@pytest.mark.parametrize("offset", [-1.4, -0.3, 0.5, 1.7, 0.1])
def test_a_shift_between_steps_is_that_of_the_nearest_positions(offset):
    truth, steps = arcs(np.arange(12.0)), np.array([4, 5, 7])
    # Headings that are not wrapped do not count.
    poses = arcs(steps - offset) + 4 * QUARTER
    estimates = poses, np.broadcast_to(np.eye(3), (6, 3, 3, 3))
    later = lambda shift: arcs(np.arange(12.0) + shift) + 1e-3  # noqa: E731
    for truth_at, gap in ((None, 0.0), (later, 1e-3)):
        of = _Errors("additive", "invariant", truth_at)
        found = _between_steps(truth, steps, estimates, 3, of)
        if offset == 0.1:  # nearly a whole step
            assert found == []
            continue
        ((first, *_),) = found
        side = "late" if offset > 0 else "early"
        assert first.name == f"time stamps that are {abs(offset):.1f} steps too {side}"
        np.testing.assert_allclose(first.truth + 4 * QUARTER, poses + gap, atol=1e-12)


def test_a_shift_between_steps_is_named_without_a_truth_between_them():
    rng, truth = np.random.default_rng(3), arcs(np.arange(30.0))
    poses = arcs(np.arange(30.0) - 0.5) + rng.normal(0, 0.01, truth.shape)
    claims = np.broadcast_to(1e-4 * np.eye(3), (6, 30, 3, 3))
    said = mistake_in_estimates(truth, poses, claims, truth[:, 0])
    assert said.startswith("time stamps that are 0.5 steps too late: read so, NEES / 3")


def as_by_cholesky(truth, reading):
    """Return mean squares per component and the log likelihood, pose by pose."""
    white, logs = np.empty((B, T, 3)), np.empty((B, T))
    for b, t in np.ndindex(B, T):
        own, P = reading.poses[b, t], reading.covariances[b, t]
        error = truth[b, t] - own
        error[2] = (error[2] + np.pi) % (2 * np.pi) - np.pi
        if not reading.is_additive:  # about the estimated position
            half = error[2] / 2
            turn = 1j * error[2]
            scale = half / np.sin(half) * np.exp(-1j * half)  # 1 / left Jacobian
            moved = scale * (error[0] + 1j * error[1])
            assert np.isclose((np.exp(turn) - 1) / turn * moved, error @ [1, 1j, 0])
            error[:2] = moved.real, moved.imag
        rows = [2, 0, 1]
        L = np.linalg.cholesky(P[np.ix_(rows, rows)])
        white[b, t] = np.linalg.solve(L, error[rows])
        logs[b, t] = np.linalg.slogdet(P)[1]
    squares = (white**2).mean(axis=1)
    return squares, -0.5 * ((white**2).sum(axis=-1) + logs).mean()


@pytest.mark.parametrize("is_additive", [True, False])
@pytest.mark.parametrize("scale", [0.3, 0.7, 1.0, 1.1, 1.4, 2.0])
def test_a_fit_is_that_of_whitened_errors(is_additive, scale):
    rng = np.random.default_rng(1)
    roots, white = np.linalg.cholesky(CLAIMS), rng.normal(size=(B, T, 3, 1))
    errors = (roots @ white)[..., 0]
    truth = POSES + scale * errors + [0, 0, 2 * np.pi]
    reading = PosesAsRead("", POSES, CLAIMS, is_additive)
    squares, likelihood = as_by_cholesky(truth, reading)
    found = _fit(truth, reading)
    mean = squares.mean(axis=0)
    assert found.nees == pytest.approx(mean.mean())
    assert found.likelihood == pytest.approx(likelihood)
    gaps = scale * errors
    median = (
        np.sqrt(np.median((gaps[..., :2] ** 2).sum(axis=-1))),
        np.sqrt(np.median(gaps[..., 2] ** 2)),
    )
    assert found.errors == pytest.approx(median)
    spread = squares.std(axis=0) / np.sqrt(B) / mean
    limit = np.minimum(np.log(1.5) + 3 * spread, np.log(2.5))
    assert found.is_honest == (abs(np.log(mean)) <= limit).all()
    assert _fit(POSES, reading._replace(truth=truth)) == found
    wrong = reading._replace(covariances=-CLAIMS)
    assert _fit(truth, wrong)[1:] == (False, -np.inf, found.errors)


@pytest.mark.parametrize(
    ("mean", "swing", "is_honest"),
    [
        *((1 / 2.6, 0.9, False), (1 / 2.4, 0.9, True)),
        *((2.6, 0.9, False), (2.4, 0.9, True), (2.1, 0.3, False), (2.0, 0.3, True)),
    ],
)
def test_squares_of_an_honest_reading_have_a_mean_within_a_factor(
    mean, swing, is_honest
):
    """Runs that differ much do not excuse more."""
    size = np.sqrt(mean * (1 + swing * (-1.0) ** np.arange(8)))[:, None, None]
    poses, P = np.ones((8, 5, 3)), np.broadcast_to(np.eye(3) / 100, (8, 5, 3, 3))
    fit = _fit((1 + size / 10) * poses, PosesAsRead("", poses, P, True))
    assert fit.is_honest == is_honest


@pytest.mark.parametrize(("drives", "steps"), [(40, 2), (5, 30)])
def test_two_poses_and_five_drives_show_a_convention(drives, steps):
    rng = np.random.default_rng(2)
    truth = rng.uniform(-9, 9, (drives, steps, 3))
    claims = np.tile(np.eye(3) / 10, (drives, steps, 1, 1))
    claims[:, 0] = 0.0  # the start is certain
    given = truth + rng.normal(0, 0.1, truth.shape), claims
    said = mistake_in_estimates(truth, *given, truth[:, 0])
    assert said.startswith("standard deviations in place of variances: read so, NEES")
    for few in np.s_[:, :1], np.s_[:4]:
        some = [each[few] for each in (truth, *given)]
        assert mistake_in_estimates(*some, some[0][:, 0]) == ""


def test_far_smaller_errors_are_named_with_both():
    off = np.array([0.3, 0.4, 0.1])
    near, far = POSES + np.array([0.01, 0, 0.002]), POSES + off
    before = _fit(POSES, PosesAsRead("", far, CLAIMS))
    right, wrong = PosesAsRead("right", near, CLAIMS), PosesAsRead("no", far, CLAIMS)
    gain = np.log(0.5 * 0.1 / (0.01 * 0.002))
    assert _gain(POSES, right, before) == pytest.approx(gain)
    said = "right: read so, the median errors are 0.01 m and 0.002 rad instead of 0.5 m"
    assert _nearer(POSES, [wrong, right], before) == f"{said} and 0.1 rad."
    assert _nearer(POSES, [wrong], before) == ""
    for factor, is_far in ((3.99, False), (4.01, True)):
        half = POSES + off / [factor, factor, 1]
        found = _gain(POSES, PosesAsRead("", half, CLAIMS), before)
        assert found == (pytest.approx(np.log(factor)) if is_far else 0)


def far_apart(drives):
    """Return one constant path per drive, shape (drives, 4, 3)."""
    return np.arange(drives)[:, None, None] * np.array([90.0, -50, 0]) + np.zeros(
        (4, 3)
    )


def test_swapped_drives_are_counted_and_two_are_named():
    truth = far_apart(6)
    estimates = truth[[1, 0, 2, 4, 5, 3]]
    P = np.broadcast_to(np.eye(3), (6, 4, 3, 3))
    fits = "the estimate of drive {} fits the truth of drive {}"
    said = f"{fits.format('a', 'b')} and {fits.format('b', 'a')}"
    assert swapped_drives(truth, estimates, P, "abcdef") == (
        f"estimates or truths of 5 drives are swapped: {said}."
    )
    assert swapped_drives(truth, truth, P, "abcdef") == ""
    holes = estimates.copy()
    holes[:, 1] = np.nan
    assert "of 5 drives" in swapped_drives(truth, holes, P, "abcdef")


def test_stray_poses_are_counted_between_good_ones():
    ratios = np.full((3, 20), 0.9)
    ratios[1, [4, 5]], ratios[2, [9, 11, 12]] = 101.0, 400.0
    said = stray_poses(ratios, "abc")
    assert said == (
        "5 poses are far from the truth although their neighbours are not, as in "
        "swapped rows; the first is step 4 of drive b, and without these poses, "
        "NEES / 3 is 0.90."
    )
    ratios[1, 5] = 99.0
    assert not stray_poses(np.where(ratios < 1, 2.6, ratios), "abc")
    assert stray_poses(np.where(ratios == 99, 11.0, ratios), "abc").startswith(
        "4 poses"
    )
    for ends in np.s_[:2], np.s_[-2:]:  # good neighbours at one side only
        at_an_end = np.full((3, 20), 0.9)
        at_an_end[1, ends] = 200.0
        assert stray_poses(at_an_end, "abc") == ""
    many = np.tile([0.9, 0.9, 200.0, 0.9, 0.9, 0.9, 0.9], (3, 5))
    assert stray_poses(many, "abc") == ""
    lasting = np.where(np.arange(20) > 9, 200.0, 0.9) * np.ones((3, 1))
    assert stray_poses(lasting, "abc") == ""
