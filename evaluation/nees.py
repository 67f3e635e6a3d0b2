"""NEES of poses, headings, landmarks and maps.

NEES = eᵀ P⁻¹ e of an error e with claimed covariance P.  If P is correct, NEES is
chi-square with as many degrees of freedom as e has entries.  Averages over runs (ANEES)
are not divided by the dimension unless the name says so.  Every function names the
frame of its error, additive or invariant
(:mod:`slamgym.estimator.models.rigid_motion`), because the additive NEES
rejects even a consistent filter if the heading is uncertain.
"""

from __future__ import annotations

import numpy as np

from ..argument_checks import one_of
from ..arrays import Array
from ..estimator.models.rigid_motion import (
    ERROR_FRAMES,
    ErrorFrame,
    additive_error,
    invariant_covariance,
    invariant_error,
    rotations,
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
    covariances : ndarray, shape (..., n, n)

    Returns
    -------
    ndarray, shape (..., n)
        nan where a covariance is singular or anything is nan.

    Examples
    --------
    >>> whitened(np.array([2.0, 0.0]), np.eye(2) * 4)
    array([1., 0.])
    """
    std = np.sqrt(np.maximum(np.diagonal(covariances, axis1=-2, axis2=-1), 0.0))
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        scaled = errors / std
        correlations = covariances / std[..., :, None] / std[..., None, :]
        whiten = _whiten_few if std.shape[-1] <= _FEW else _whiten_each
        return whiten(scaled, correlations)


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


def parts_of_landmarks(errors: Array, covariances: Array) -> tuple[Array, Array]:
    """Return the errors (..., n, 2) of landmarks, and their own covariances.

    Parameters
    ----------
    errors : ndarray, shape (..., 3 + 2n)
    covariances : ndarray, shape (..., 3 + 2n, 3 + 2n)

    Returns
    -------
    errors : ndarray, shape (..., n, 2)
    covariances : ndarray, shape (..., n, 2, 2)
    """
    rows = np.arange(3, errors.shape[-1]).reshape(-1, 2)
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
    return normalised_squared_error(*relative_map(true_states, means, covariances))


def relative_landmark_deviations(
    true_states: Array, means: Array, covariances: Array
) -> Array:
    """Return the whitened error of each landmark, as seen from the robot.

    ::

        w = L⁻¹ R(θ̂) (m − m̂),   L Lᵀ = R(θ̂) P R(θ̂)ᵀ,   P the covariance of m − m̂

    with m as in :func:`relative_map_nees`. The axes are those of the map. If the
    covariances are correct, w has the mean 0 and the covariance I, and its square is
    the NEES of the landmark, 2 degrees of freedom.

    Parameters
    ----------
    true_states, means, covariances
        As in :func:`state_nees`.

    Returns
    -------
    ndarray, shape (..., n, 2)
        nan where the covariance of a landmark is singular.
    """
    relative = relative_map(true_states, means, covariances)
    return deviations_of_landmarks(*relative, means[..., 2])


def deviations_of_landmarks(errors: Array, claimed: Array, headings: Array) -> Array:
    """Return the deviations from what `relative_map` returns, and θ̂ (...)."""
    rows = np.arange(errors.shape[-1]).reshape(-1, 2)
    turn = np.swapaxes(rotations(-headings), -1, -2)[..., None, :, :]
    blocks = turn @ claimed[..., rows[:, :, None], rows[:, None, :]]
    blocks = blocks @ np.swapaxes(turn, -1, -2)
    return whitened(np.einsum("...ij,...j->...i", turn, errors[..., rows]), blocks)


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


def relative_map(
    true_states: Array, means: Array, covariances: Array
) -> tuple[Array, Array]:
    """Return the errors of the map in the robot's frame, and their covariance."""
    local = _landmarks_from_robot(means)
    errors = _landmarks_from_robot(true_states) - local
    n = errors.shape[-1] // 2
    turn = rotations(-means[..., 2])
    jacobian = np.zeros((*turn.shape[:-2], 2 * n, 3 + 2 * n))
    for row in range(0, 2 * n, 2):
        jacobian[..., row : row + 2, :2] = -turn
        jacobian[..., row : row + 2, 3 + row : 5 + row] = turn
    jacobian[..., 0::2, 2] = local[..., 1::2]
    jacobian[..., 1::2, 2] = -local[..., 0::2]
    claimed = jacobian @ covariances @ np.swapaxes(jacobian, -1, -2)
    return errors, claimed


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


def _whiten_each(errors: Array, correlations: Array) -> Array:
    """Solve L w = e, C = L Lᵀ, one by one; nan where C is singular."""
    from scipy.linalg.lapack import dpotrf, dtrtrs  # noqa: PLC0415 (slow to import)

    n = errors.shape[-1]
    e, C = errors.reshape(-1, n), correlations.reshape(-1, n, n)
    white, pivots = np.full((2, *e.shape), np.nan)
    for index in range(len(white)):
        factor, failed = dpotrf(C[index], lower=1)
        if not failed:
            pivots[index] = factor.diagonal()
            white[index] = dtrtrs(factor, e[index], lower=1)[0]
    white[~(pivots**2 > SINGULAR).all(axis=1)] = np.nan
    return white.reshape(errors.shape)


def in_frame(
    true_states: Array, means: Array, covariances: Array, frame: ErrorFrame
) -> tuple[Array, Array]:
    """Return errors and their claimed covariances in a named frame, as for `whitened`.

    The origin of the invariant frame is the estimated position, so that the NEES has
    the same digits wherever the world's origin lies.
    """
    cleared = without_rounding(covariances)
    return of_cleared(true_states, means, cleared, frame)


def of_cleared(
    true_states: Array, means: Array, covariances: Array, frame: ErrorFrame
) -> tuple[Array, Array]:
    """Return what `in_frame` returns, of covariances from `without_rounding`."""
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
    position, heading = covariances[..., :2, :2], covariances[..., 2, 2]
    inverse = np.divide(1, heading, out=np.zeros(heading.shape), where=heading > 0)
    cross = covariances[..., :2, 2, None]
    given = position - cross * cross.mT * inverse[..., None, None]
    x, y = given[..., 0, 0], given[..., 1, 1]
    largest = np.diagonal(position, axis1=-2, axis2=-1).max(axis=-1)
    area = x * y - given[..., 0, 1] * given[..., 1, 0]
    rounded = area < _ROUNDED * largest * (x + y)
    if not rounded.any():
        return covariances
    cleared = covariances.copy()
    cleared[rounded, :2, :2] = 0.0
    return cleared


def _landmarks_from_robot(states: Array) -> Array:
    """Return the landmarks in the robot's frame, shape (..., 2n)."""
    dx, dy = states[..., 3::2] - states[..., :1], states[..., 4::2] - states[..., 1:2]
    cos, sin = np.cos(states[..., 2:3]), np.sin(states[..., 2:3])
    pairs = np.stack([cos * dx + sin * dy, cos * dy - sin * dx], axis=-1)
    return np.asarray(pairs.reshape(*states.shape[:-1], -1))
