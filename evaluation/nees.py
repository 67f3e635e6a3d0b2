"""NEES of poses, headings, landmarks and maps.

NEES = eᵀ P⁻¹ e of an error e with claimed covariance P.  If P is correct, NEES is
chi-square with as many degrees of freedom as e has entries.  Averages over runs (ANEES)
are not divided by the dimension unless the name says so.  Every function names the
frame of its error, additive or invariant
(:mod:`slamgym.estimator.models.rigid_motion`), because the additive NEES
rejects even a consistent filter if the heading is uncertain.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from ..argument_checks import one_of
from ..arrays import Array, BoolArray
from ..estimator.models.rigid_motion import (
    ERROR_FRAMES,
    ErrorFrame,
    additive_error,
    invariant_covariance,
    invariant_error,
    left_jacobian,
    seen_from,
)

#: Conditional variance, as a share of the variance, below which it counts as zero.
SINGULAR = 1e-10

_ROUNDING = 1e-9  # of eigenvalues of correlations, per row
_ROUNDED = 1e-14  # share of the larger variance of x and y that counts as zero
_FEW = 4  # up to this size, all covariances are factored together


def normalised_squared_error(errors: Array, covariances: Array) -> Array:
    """Return eᵀ P⁻¹ e over any leading axes.

    Parameters
    ----------
    errors : ndarray, shape (..., n)
    covariances : ndarray, shape (..., n, n)

    Returns
    -------
    ndarray, shape (...)
        nan where a covariance is singular or anything is nan.

    Examples
    --------
    >>> normalised_squared_error(np.array([[2.0, 0.0]]), np.array([np.eye(2) * 4]))
    array([1.])
    """
    return np.asarray((whitened(errors, covariances) ** 2).sum(axis=-1))


def whitened(errors: Array, covariances: Array) -> Array:
    """Return w with wᵀ w = eᵀ P⁻¹ e, whose covariance is I if P is correct.

    Parameters
    ----------
    errors : ndarray, shape (..., n)
        They may have more leading axes than the covariances.
    covariances : ndarray, shape (..., n, n)
        Their lower halves count.

    Returns
    -------
    ndarray, shape (..., n)
        From the first entry that is nan, or certain given the entries before it, all
        entries are nan.

    Examples
    --------
    >>> whitened(np.array([2.0, 0.0]), np.eye(2) * 4)
    array([1., 0.])
    """
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        if errors.shape[-1] > _FEW:
            return _whiten_each(errors, covariances)
        std = np.sqrt(np.maximum(np.diagonal(covariances, axis1=-2, axis2=-1), 0.0))
        correlations = covariances / std[..., :, None] / std[..., None, :]
        return _whiten_few(errors / std, correlations)


def pose_nees(
    true_poses: Array, poses: Array, covariances: Array, *, frame: ErrorFrame
) -> Array:
    """Return the NEES of poses in a named error frame, 3 degrees of freedom.

    Parameters
    ----------
    true_poses, poses : ndarray, shape (..., 3)
        True and estimated (x, y, θ) [m, m, rad].
    covariances : ndarray, shape (..., 3, 3)
        Claimed covariances of the additive error.
    frame : {"additive", "invariant"}
        Error coordinates.

    Returns
    -------
    ndarray, shape (...)
    """
    return normalised_squared_error(*in_frame(true_poses, poses, covariances, frame))


def heading_nees(true_poses: Array, poses: Array, covariances: Array) -> Array:
    """Return the NEES of headings, 1 degree of freedom, the same in either frame.

    Parameters
    ----------
    true_poses, poses, covariances
        As in :func:`pose_nees`.
    """
    errors = additive_error(true_poses, poses)[..., 2]
    return np.asarray(errors**2 / covariances[..., 2, 2])


def position_nees(
    true_poses: Array, poses: Array, covariances: Array, *, frame: ErrorFrame
) -> Array:
    """Return the NEES of robot positions, 2 degrees of freedom.

    Parameters
    ----------
    true_poses, poses, covariances, frame
        As in :func:`pose_nees`.
    """
    errors, claimed = in_frame(true_poses, poses, covariances, frame)
    return normalised_squared_error(errors[..., :2], claimed[..., :2, :2])


def state_nees(
    true_states: Array, means: Array, covariances: Array, *, frame: ErrorFrame
) -> Array:
    """Return the NEES of whole states, 3 + 2n degrees of freedom.

    Parameters
    ----------
    true_states, means : ndarray, shape (..., 3 + 2n)
        True and estimated (x, y, θ, l1x, l1y, …) [m, rad].
    covariances : ndarray, shape (..., 3 + 2n, 3 + 2n)
        Claimed covariances of the additive error.
    frame : {"additive", "invariant"}
        Error coordinates.

    Returns
    -------
    ndarray, shape (...)
    """
    return normalised_squared_error(*in_frame(true_states, means, covariances, frame))


def landmark_nees(
    true_states: Array, means: Array, covariances: Array, *, frame: ErrorFrame
) -> Array:
    """Return the NEES of each landmark, 2 degrees of freedom.

    Parameters
    ----------
    true_states, means, covariances, frame
        As in :func:`state_nees`.

    Returns
    -------
    ndarray, shape (..., n)
    """
    states = in_frame(true_states, means, covariances, frame)
    return normalised_squared_error(*parts_of_landmarks(*states))


def parts_of_landmarks(
    errors: Array, covariances: Array, first: int = 3
) -> tuple[Array, Array]:
    """Return the errors (..., n, 2) of landmarks, and their own covariances.

    Parameters
    ----------
    errors : ndarray, shape (..., 3 + 2n)
    covariances : ndarray, shape (..., 3 + 2n, 3 + 2n)
    first : {3, 0}
        Where the landmarks begin.

    Returns
    -------
    errors : ndarray, shape (..., n, 2)
    covariances : ndarray, shape (..., n, 2, 2)
    """
    rows = np.arange(first, errors.shape[-1] - 3 + first).reshape(-1, 2)
    blocks = covariances[..., rows[:, :, None], rows[:, None, :]]
    return errors[..., rows], np.ascontiguousarray(blocks)


def relative_map_nees(true_states: Array, means: Array, covariances: Array) -> Array:
    """Return the NEES of the map in the robot's frame, 2n degrees of freedom.

    ::

        m = R(θ)ᵀ (l − p),   ∂m/∂θ = −J m,   J = [0 −1; 1 0]

    A rotation or translation of the whole world does not change this NEES.

    Parameters
    ----------
    true_states, means, covariances
        As in :func:`state_nees`.

    Returns
    -------
    ndarray, shape (...)
    """
    found = relative_state(true_states, means, covariances)
    return normalised_squared_error(
        found.errors[0, ..., :-3], found.covariance[..., :-3, :-3]
    )


def is_indefinite(covariance: Array) -> bool:
    """Whether a finite matrix (n, n) has an eigenvalue that rounding cannot explain.

    Examples
    --------
    >>> is_indefinite(np.diag([1.0, -1.0])), is_indefinite(np.diag([1.0, 0.0]))
    (True, False)
    """
    if not np.isfinite(covariance).all():
        return False
    std = np.sqrt(abs(np.diagonal(covariance)))
    std[std == 0] = 1.0
    least = np.linalg.eigvalsh(covariance / std[:, None] / std)[0]
    return bool(least < -_ROUNDING * len(std))


class RelativeState(NamedTuple):
    """Errors of the map as seen from the robot, in the map's axes, and of the pose.

    ::

        R(θ̂) (m − m̂),    m = R(θ)ᵀ (l − p)
    """

    #: Along the first axis: these of the map, with zeros for the pose; then the error
    #: of the state, additive and invariant, with w = e_l − e_p − J (l̂ − p̂) e_θ for the
    #: map.
    errors: Array  # (3, ..., 2n + 3)
    covariance: Array  # (..., 2n + 3, 2n + 3)
    #: The same three of each landmark, now relative to the robot, additive, invariant.
    landmarks: Array  # (3, ..., n, 2)
    landmark_covariances: Array  # (3, ..., n, 2, 2)


def relative_state(
    true_states: Array, means: Array, covariances: Array
) -> RelativeState:
    """Transform states so that one Cholesky factor gives three NEES.

    The covariance of the map is W P Wᵀ with W = [−B I], B the columns of the pose ::

        P_ll − B Yᵀ − Y Bᵀ,    Y = P_lp − B P_pp / 2

    The invariant error ξ about p̂ has w = ξ_l − ξ_p, and that of the map is V(t) R(t)ᵀ w
    (:mod:`slamgym.estimator.models.rigid_motion`).
    """
    size = means.shape[-1]
    shape = np.broadcast_shapes(
        true_states.shape[:-1], means.shape[:-1], covariances.shape[:-2]
    )
    means = np.broadcast_to(means, (*shape, size))
    covariances = np.broadcast_to(covariances, (*shape, size, size))
    truth, near = (seen_from(means[..., :2], each) for each in (true_states, means))
    n, pose = size - 3, covariances[..., :3, :3]
    B = np.zeros((*near.shape[:-1], n, 3))
    B[..., 0::2, 0] = B[..., 1::2, 1] = 1.0
    B[..., 0::2, 2], B[..., 1::2, 2] = -near[..., 4::2], near[..., 3::2]
    e, xi = additive_error(truth, near), invariant_error(truth, near)
    errors = np.zeros((3, *means.shape))
    errors[1, ..., n:], errors[2, ..., n:] = e[..., :3], xi[..., :3]
    errors[1, ..., :n] = e[..., 3:] - (B @ e[..., :3, None])[..., 0]
    errors[2, ..., :n] = xi[..., 3:] - (B[..., :2] @ xi[..., :2, None])[..., 0]
    turn = left_jacobian(-e[..., 2])[..., None]  # V(t) R(t)ᵀ
    errors[0, ..., :n] = (turn * errors[2, ..., :n].copy().view(complex)).view(float)
    across = covariances[..., 3:, :3] - B @ pose
    half = across + B @ pose / 2
    Q = np.empty(covariances.shape)
    np.matmul(
        np.concatenate([-B, -half], axis=-1),
        np.concatenate([half, B], axis=-1).mT,
        out=Q[..., :n, :n],
    )
    Q[..., :n, :n] += covariances[..., 3:, 3:]
    Q[..., :n, n:], Q[..., n:, :n] = across, across.mT
    Q[..., n:, n:] = without_rounding(pose)
    each, own = parts_of_landmarks(e, covariances)
    _, seen = parts_of_landmarks(e, Q, 0)
    lever = B[..., 2].reshape(each.shape)
    slope = covariances[..., 3:, 2] - B[..., 2] * pose[..., 2, 2, None] / 2
    turned = lever[..., :, None] * slope.reshape(each.shape)[..., None, :]
    return RelativeState(
        errors,
        Q,
        np.stack([errors[0, ..., :n], e[..., 3:], xi[..., 3:]]).reshape(3, *each.shape),
        np.stack([seen, own, own - turned - turned.mT]),
    )


def _whiten_few(errors: Array, correlations: Array) -> Array:
    """Solve L w = e, C = L Lᵀ, entry by entry over all leading axes at once.

    Each entry costs a few operations on whole arrays.  The result for one covariance
    does not depend on the others, to the bit.  The arguments are overwritten.
    """
    white: Array = np.empty(errors.shape)
    n = white.shape[-1]
    factor = np.empty(correlations.shape)
    for j in range(n):
        left = correlations[..., j, j]
        rest = errors[..., j]
        for k in range(j):
            left -= factor[..., j, k] ** 2
            rest -= factor[..., j, k] * white[..., k]
        pivot = np.sqrt(np.where(left > SINGULAR, left, np.nan))
        white[..., j] = rest / pivot
        for i in range(j + 1, n):
            entry = correlations[..., i, j]
            for k in range(j):
                entry -= factor[..., i, k] * factor[..., j, k]
            factor[..., i, j] = entry / pivot
    return white


def _whiten_each(errors: Array, covariances: Array) -> Array:
    """Solve L w = e, P = L Lᵀ, one by one.

    A pivot of P, as a share of its variance, is that of the correlations.
    """
    from scipy.linalg.lapack import dpotrf, dtrtrs  # noqa: PLC0415 (slow to import)

    n, own = errors.shape[-1], covariances.shape[:-2]
    shape = np.broadcast_shapes(errors.shape[:-1], own)
    errors = np.broadcast_to(errors, (*shape, n))
    more, own = shape[: len(shape) - len(own)], shape[len(shape) - len(own) :]
    covariances = np.broadcast_to(covariances, (*own, n, n))
    factors = np.array(covariances, np.float64, order="C")
    factors = factors.reshape(math.prod(own), n, n)
    variances = factors.diagonal(axis1=1, axis2=2).copy()
    white = np.array(errors, np.float64, order="C")
    white = white.reshape(math.prod(more), len(factors), n).swapaxes(0, 1).copy()
    for U, w in zip(factors.mT, white.mT, strict=True):  # in Fortran's order: U = Lᵀ
        _, failed = dpotrf(U, lower=0, clean=0, overwrite_a=1)
        if not failed:
            dtrtrs(U, w, lower=0, trans=1, overwrite_b=1)
            continue
        size = failed - 1
        if size:
            w[:size] = dtrtrs(U[:size, :size], w[:size], lower=0, trans=1)[0]
        w[size:] = np.nan
    good = factors.diagonal(axis1=1, axis2=2) ** 2 > SINGULAR * variances
    known = np.logical_and.accumulate(good, axis=1)[:, None]
    return np.where(known, white, np.nan).swapaxes(0, 1).reshape(errors.shape)


def in_frame(
    true_states: Array, means: Array, covariances: Array, frame: ErrorFrame
) -> tuple[Array, Array]:
    """Return errors and their claimed covariances in a named frame, as for `whitened`.

    The origin of the invariant frame is the estimated position, so that the NEES has
    the same digits wherever the world's origin lies.
    """
    covariances = without_rounding(covariances)
    if one_of("frame", frame, ERROR_FRAMES) == "invariant":
        origins = means[..., :2]
        truth, means = seen_from(origins, true_states), seen_from(origins, means)
        return invariant_error(truth, means), invariant_covariance(means, covariances)
    return additive_error(true_states, means), covariances


def without_rounding(covariances: Array) -> Array:
    """Return covariances in which variances of the position that are rounding are 0.

    At first, a robot without sideways noise is certain of its y, given its heading.  A
    filter that rotates covariances, or solves for them, turns this zero into about
    1e-18 times the variance of x, in any direction.  Therefore, the smallest variance
    of the position given the heading decides.
    """
    P = np.moveaxis(covariances[..., :3, :3], (-2, -1), (0, 1))
    rounded = _is_rounded(P)
    if not rounded.any():
        return covariances
    cleared = covariances.copy()
    cleared[rounded, :2, :2] = 0.0
    return cleared


def _is_rounded(P: Array) -> BoolArray:
    """Return where `without_rounding` clears covariances P (3, 3, ...)."""
    with np.errstate(divide="ignore", invalid="ignore"):
        share = np.where(P[2, 2] > 0, 1 / P[2, 2], 0.0)
    a, b = P[2, 0] * share, P[2, 1] * share
    x, y, xy = P[0, 0] - P[2, 0] * a, P[1, 1] - P[2, 1] * b, P[1, 0] - P[2, 1] * a
    largest = np.maximum(P[0, 0], P[1, 1])
    return np.asarray(x * y - xy * xy < _ROUNDED * largest * (x + y))


def nees_of_poses(
    P: Array, *errors: tuple[Array, Array, Array]
) -> Iterator[tuple[Array, Array]]:
    """Yield the NEES of the position and of the pose for each kind of error.

    They are those of `whitened` for covariances without rounding, entry by entry.

    Parameters
    ----------
    P : ndarray, shape (3, 3, ...)
    errors : three arrays of shape (...)
        x, y and the heading, of each kind.
    """
    (xx, *_), (xy, yy, _), (xt, yt, tt) = P
    sx, sy, st = np.sqrt(xx), np.sqrt(yy), np.sqrt(tt)
    a, b, c = xy / (sx * sy), xt / (sx * st), yt / (sy * st)
    left, rest = 1 - a * a, c - a * b
    known = (left > SINGULAR) & (xx + yy < np.inf) & ~_is_rounded(P)
    left = np.where(known, left, np.nan)
    slope = rest / left
    last = 1 - b * b - rest * slope
    last = np.where((last > SINGULAR) & (tt < np.inf), last, np.nan)
    for x, y, turn in errors:
        u = x / sx
        v = y / sy - a * u
        w = turn / st - b * u - slope * v
        position = u * u + v * v / left
        yield position, position + w * w / last
