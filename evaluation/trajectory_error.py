"""How far an estimated path or map lies from the truth.

SLAM without a fixed start knows its map only up to one rigid motion of the plane, so
positions are compared twice: as they are (raw), and after the rotation and translation
that bring them closest to the truth (aligned). Scale is never adapted.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..argument_checks import as_floats, shaped
from ..arrays import Array, IntArray
from ..estimator.models.bearing_range import wrap_angle
from ..estimator.models.rigid_motion import rotation, rotations

_ROUNDING = 4 * np.finfo(np.float64).eps
_LEAST_TO_EXCHANGE = 5  # positions, so that most of them are right
_FAR = 10.0  # standard deviations between a position and an exchanged truth
_NEARER = 5.0  # factor between the distances to the own truth and to the other one
_APART = 2.5  # standard deviations between two truths that an estimate distinguishes
_MOST_TRIED = 64  # positions whose pairs are tried as alignments


class Alignment(NamedTuple):
    """A rigid motion of the plane, e ↦ C(φ) e + c."""

    #: φ, counter-clockwise, in [-π, π] [rad].
    angle: float
    #: c, shape (2,) [m].
    translation: Array

    def apply(self, positions: Array) -> Array:
        """Move positions, shape (n, 2)."""
        return np.asarray(positions @ rotation(self.angle).T + self.translation)


class PositionAccuracy(NamedTuple):
    """Distances between estimated and true positions, raw and aligned."""

    #: Shape (n,) [m].
    raw_errors: Array
    #: Shape (n,) [m].
    aligned_errors: Array
    #: The motion that takes the estimate onto the truth.
    alignment: Alignment

    @property
    def raw_rmse(self) -> float:
        """Root of the mean square of the raw errors [m]."""
        return float(np.sqrt(np.mean(self.raw_errors**2)))

    @property
    def aligned_rmse(self) -> float:
        """Root of the mean square of the aligned errors [m]."""
        return float(np.sqrt(np.mean(self.aligned_errors**2)))


class Exchange(NamedTuple):
    """Positions whose truths are exchanged."""

    #: Cycles of indices: each position fits the truth of the next one, and the last one
    #: that of the first.
    cycles: tuple[tuple[int, ...], ...]
    #: The motion that takes the estimate onto the truth, exchanged back.
    alignment: Alignment


class LandmarkDistances(NamedTuple):
    """Distance of each landmark estimate to its ground truth."""

    #: ‖e‖, shape (n,) [m].
    euclidean: Array
    #: sqrt(eᵀ P⁻¹ e), shape (n,): the same distance in standard deviations.
    mahalanobis: Array


def align_positions(estimate: ArrayLike, truth: ArrayLike) -> Alignment:
    """Find the rigid motion that brings estimated positions closest to the true ones.

    ::

        min over φ, c of  Σ ‖C(φ) eₖ + c − gₖ‖²:
        φ = atan2(Σ e'ₖ × g'ₖ,  Σ e'ₖ · g'ₖ),   c = ḡ − C(φ) ē

    with e' = e − ē and g' = g − ḡ: the plane's closed form of [1]_, without scale.

    Parameters
    ----------
    estimate, truth : array_like, shape (n, 2)
        Positions eₖ and gₖ of the same n >= 1 things [m].

    Returns
    -------
    Alignment
        The motion; φ = 0 if the positions determine none, as a single one does.

    Raises
    ------
    ValueError
        If the arrays are not n finite positions each.

    References
    ----------
    .. [1] S. Umeyama, Least-squares estimation of transformation parameters between two
       point patterns, IEEE PAMI 13(4), 1991.

    Examples
    --------
    >>> align_positions([[0, 0], [1, 0]], [[5, 5], [5, 6]])
    Alignment(angle=1.5707963267948966, translation=array([5., 5.]))
    """
    e, g = _paired(estimate=estimate, truth=truth)
    angle, translation, _ = _aligned(e, g)
    return Alignment(float(angle), translation)


def _aligned(e: Array, g: Array) -> tuple[Array, Array, Array]:
    """Return φ (...), c (..., 2) and the aligned e, for positions (..., n, 2)."""
    e_mean, g_mean = e.mean(axis=-2), g.mean(axis=-2)
    e_centred, g_centred = e - e_mean[..., None, :], g - g_mean[..., None, :]
    cross = np.vecdot(e_centred[..., 0], g_centred[..., 1])
    cross = cross - np.vecdot(e_centred[..., 1], g_centred[..., 0])
    dot = _summed(e_centred * g_centred)
    noise = _ROUNDING * e.shape[-2] * (_largest(e) * _largest(g_centred))
    noise += _ROUNDING * e.shape[-2] * (_largest(g) * _largest(e_centred))
    angle = np.where(np.hypot(cross, dot) > noise, np.arctan2(cross, dot), 0.0)
    turn = rotations(angle).mT
    translation = g_mean - (e_mean[..., None, :] @ turn)[..., 0, :]
    return angle, translation, e @ turn + translation[..., None, :]


def _summed(positions: Array) -> Array:
    return np.asarray(positions.reshape(*positions.shape[:-2], -1).sum(axis=-1))


def _largest(positions: Array) -> Array:
    return np.asarray(np.abs(positions).max(axis=(-2, -1)))


def position_accuracy(estimate: ArrayLike, truth: ArrayLike) -> PositionAccuracy:
    """Compare estimated positions with the true ones, raw and aligned.

    For a path this is the absolute trajectory error (ATE); for a map, landmark by
    landmark, the error of its landmarks.

    Parameters
    ----------
    estimate, truth : array_like, shape (n, 2)
        Positions of the same n >= 1 things [m].

    Returns
    -------
    PositionAccuracy
        All errors, and their root mean squares ``raw_rmse`` and ``aligned_rmse``.

    Raises
    ------
    ValueError
        If the arrays are not n finite positions each.

    Examples
    --------
    >>> accuracy = position_accuracy([[0, 0], [1, 0]], [[0, 2], [1, 2]])
    >>> accuracy.raw_rmse, accuracy.aligned_rmse
    (2.0, 0.0)
    """
    e, g = _paired(estimate=estimate, truth=truth)
    angle, translation, moved = _aligned(e, g)
    return PositionAccuracy(
        raw_errors=np.linalg.norm(e - g, axis=1),
        aligned_errors=np.linalg.norm(moved - g, axis=1),
        alignment=Alignment(float(angle), translation),
    )


def aligned_rms(truth: Array, errors: Array) -> Array:
    """Return the aligned RMSE of `position_accuracy`, without distances and checks.

    Rounding adds up to about 1e-8 of the RMSE before the alignment. With g and e true
    and estimated positions about their means, C the best rotation::

        Σ |C e − g|² = Σ |e − g|² + 2 (a − √(a² + b²)),    a = Σ e · g,  b = Σ e × g

    Parameters
    ----------
    truth, errors : ndarray, shape (2, ..., n)
        x and y of true positions, and of estimated ones minus these [m].

    Returns
    -------
    ndarray, shape (...)
        [m]
    """
    given = np.stack([truth, errors])  # in the order in which numpy adds up quickly
    (gx, gy), (dx, dy) = given - given.mean(axis=-1, keepdims=True)
    dot, cross, raw = (
        np.vecdot(a, b) + np.vecdot(c, d)
        for a, b, c, d in (
            (gx + dx, gx, gy + dy, gy),
            (dx, gy, -dy, gx),
            (dx, dx, dy, dy),
        )
    )
    length = np.hypot(dot, cross)
    gain = np.asarray(length - dot)  # by another form where it would lose digits
    np.divide(cross * cross, length + dot, out=gain, where=dot > 0)
    return np.asarray(np.sqrt(np.maximum(raw - 2 * gain, 0.0) / gx.shape[-1]))


def exchanged_positions(estimate: ArrayLike, truth: ArrayLike) -> Exchange:
    """Find positions that fit each other's truth, as in a table with exchanged ids.

    ::

        ‖ẽᵢ − gᵢ‖ > max(10 s, 5 ‖ẽᵢ − gⱼ‖),    s² = Σ ‖ẽₖ − g_π(k)‖² / (2n − 3)

    holds for every i of a cycle π that is found, with j = π(i) and ẽ the positions
    after alignment with the truth in the order π.  The aligned map must thus be good
    for all others.  π is the best assignment of the positions that lie far from their
    own truths after the alignment with the least median error [1]_.  No other order may
    be nearly as good ::

        (ẽᵢ − ẽₖ)ᵀ (g_π(i) − g_π(k)) > (2.5 s)²    for all k ≠ i,

    The left side is half the increase of the sum of squares if i and k change places in
    π.

    Parameters
    ----------
    estimate, truth : array_like, shape (n, 2)
        Positions eₖ and gₖ of the same n >= 1 things [m].

    Returns
    -------
    Exchange
        No cycle if n < 5, or if half of the positions or more are far from the truth.

    Raises
    ------
    ValueError
        If the arrays are not n finite positions each.

    References
    ----------
    .. [1] P. J. Rousseeuw, Least median of squares regression, JASA 79(388), 1984.

    Examples
    --------
    >>> places = np.array([[0, 0], [4, 0], [9, 3], [2, 7], [5, 5], [8, 8]])
    >>> exchanged_positions(places, places[[0, 4, 2, 3, 1, 5]]).cycles
    ((1, 4),)
    """
    e, g = _paired(estimate=estimate, truth=truth)
    n = len(e)
    order = np.arange(n)
    if n >= _LEAST_TO_EXCHANGE:
        order = _best_order(e, g)
    moved = align_positions(e, g[order]).apply(e)
    own, other = (np.linalg.norm(moved - there, axis=1) for there in (g, g[order]))
    scale = np.sqrt(np.sum(other**2) / max(2 * n - 3, 1))
    is_sure = own > np.maximum(_FAR * scale, _NEARER * other)
    for i in np.flatnonzero(is_sure):
        margins = ((moved[i] - moved) * (g[order[i]] - g[order])).sum(axis=1)
        margins[i] = np.inf
        is_sure[i] = margins.min() > (_APART * scale) ** 2
    cycles = tuple(cycle for cycle in _cycles(order) if is_sure[list(cycle)].all())
    order = np.arange(n)
    for cycle in cycles:
        order[list(cycle)] = np.roll(cycle, -1)
    return Exchange(cycles, align_positions(e, g[order]))


def _best_order(e: Array, g: Array) -> IntArray:
    """Assign the positions that are far from their truths to these truths, (n,)."""
    moved = _median_aligned(e, g)
    errors = np.linalg.norm(moved - g, axis=1)
    (far,) = np.nonzero(errors > _FAR * np.median(errors))
    order = np.arange(len(errors))
    if len(far) < 2:
        return order
    from scipy.optimize import linear_sum_assignment  # noqa: PLC0415 (slow to import)

    gaps = np.linalg.norm(moved[far, None] - g[far], axis=2)
    order[far] = far[linear_sum_assignment(np.minimum(gaps, errors[far, None]))[1]]
    return order


def _median_aligned(e: Array, g: Array) -> Array:
    """Move positions by the motion of a pair of them that has the least median error.

    ::

        u = (gⱼ − gᵢ) / (eⱼ − eᵢ) of length 1,   e ↦ u (e − (eᵢ + eⱼ)/2) + (gᵢ + gⱼ)/2

    with positions as complex numbers.
    """
    z, w = e @ (1, 1j), g @ (1, 1j)
    tried = np.unique(np.linspace(0, len(e) - 1, _MOST_TRIED).astype(np.int64))
    least, best = np.inf, z
    for i in tried:
        j = tried[(tried > i) & (z[tried] != z[i]) & (w[tried] != w[i])]
        turn = (w[j] - w[i]) / (z[j] - z[i])
        turn /= np.abs(turn)
        moved = turn[:, None] * (z - (z[i] + z[j, None]) / 2) + (w[i] + w[j, None]) / 2
        medians = np.median(np.abs(moved - w), axis=1)
        if len(j) and medians.min() < least:
            least, best = medians.min(), moved[medians.argmin()]
    return np.column_stack([best.real, best.imag])


def _cycles(order: IntArray) -> list[tuple[int, ...]]:
    """List the cycles of a permutation, each from its least index, without fixed ones.

    Examples
    --------
    >>> _cycles(np.array([1, 0, 2, 4, 5, 3]))
    [(0, 1), (3, 4, 5)]
    """
    found, seen = [], set[int]()
    for first in range(len(order)):
        cycle, index = [], first
        while index not in seen:
            seen.add(index)
            cycle.append(index)
            index = int(order[index])
        if len(cycle) > 1:
            found.append(tuple(cycle))
    return found


def landmark_distances(
    landmarks: ArrayLike, covariances: ArrayLike, truth: ArrayLike
) -> LandmarkDistances:
    """Distance of every landmark to its ground truth, in metres and in deviations.

    ::

        e = l − l_true,   ‖e‖,   sqrt(eᵀ P⁻¹ e)

    Parameters
    ----------
    landmarks : array_like, shape (n, 2)
        Estimated positions l [m].
    covariances : array_like, shape (n, 2, 2)
        Covariance P of each [m²], see :func:`landmark_covariances`.
    truth : array_like, shape (n, 2)
        True positions of the same landmarks [m].

    Returns
    -------
    LandmarkDistances
        Both distances, (n,) each.

    Raises
    ------
    ValueError
        If the shapes do not fit, or if a covariance is not positive definite.

    Notes
    -----
    CMU 16-833, EKF-SLAM homework, part 2.

    Examples
    --------
    >>> landmark_distances([[3, 4]], [[[25, 0], [0, 25]]], [[0, 0]])
    LandmarkDistances(euclidean=array([5.]), mahalanobis=array([1.]))
    """
    estimate, true = _paired(landmarks=landmarks, truth=truth)
    e = estimate - true
    P = shaped("covariances", covariances, (len(e), 2, 2))
    if not (np.linalg.eigvalsh(P) > 0).all():
        raise ValueError("covariances must be positive definite, got one that is not")
    weighted = np.linalg.solve(P, e[..., None])[..., 0]
    return LandmarkDistances(
        euclidean=np.linalg.norm(e, axis=1),
        mahalanobis=np.sqrt(np.sum(e * weighted, axis=1)),
    )


def landmark_covariances(covariance: ArrayLike) -> Array:
    """Cut the blocks of the single landmarks out of a joint covariance.

    Parameters
    ----------
    covariance : array_like, shape (3 + 2n, 3 + 2n)
        Joint covariance in the order of the state (x, y, θ, l1x, l1y, …).

    Returns
    -------
    ndarray, shape (n, 2, 2)
        Covariance of each landmark's position [m²].

    Examples
    --------
    >>> landmark_covariances(np.diag([0, 0, 0, 1, 2, 3, 4]))[1]
    array([[3., 0.],
           [0., 4.]])
    """
    P = as_floats("covariance", covariance)
    size = len(P) if P.ndim else 0
    if P.shape != (size, size) or size < 3 or size % 2 == 0:
        raise ValueError(f"covariance must have shape (3 + 2n, 3 + 2n), got {P.shape}")
    rows = np.arange(3, size).reshape(-1, 2)
    return np.asarray(P[rows[:, :, None], rows[:, None, :]])


def ellipse_areas(covariances: NDArray[np.floating]) -> Array:
    """Return the areas 9 π √det P of 3σ ellipses, for covariances (k, 2, 2) [m²].

    Examples
    --------
    >>> ellipse_areas(np.eye(2)[None]) / np.pi
    array([9.])
    """
    (xx, xy), (yx, yy) = np.moveaxis(covariances, (-2, -1), (0, 1))
    return np.asarray(9 * np.pi * np.sqrt(np.maximum(xx * yy - xy * yx, 0.0)))


def poses_at(times: ArrayLike, ground_truth: ArrayLike) -> Array:
    """Interpolate a true path, its heading along the shorter way round.

    Parameters
    ----------
    times : array_like, shape (k,)
        When to know the pose [s].
    ground_truth : array_like, shape (n, 4)
        Rows (t, x, y, θ) [s, m, m, rad], t not decreasing; θ may be nan.

    Returns
    -------
    ndarray, shape (k, 3)
        Poses (x, y, θ), θ in [-π, π); rows of nan before the first and after the last
        row of the path.

    Examples
    --------
    >>> poses_at([0.5, 9.0], [[0, 0, 0, 3], [1, 2, 0, -3]])
    array([[ 1.        ,  0.        , -3.14159265],
           [        nan,         nan,         nan]])
    """
    t = as_floats("times", times)
    path = as_floats("ground_truth", ground_truth)
    if path.ndim != 2 or path.shape[1] != 4:
        raise ValueError(f"ground_truth must have shape (n, 4), got {path.shape}")
    if not len(path):
        return np.full((len(t), 3), np.nan)
    columns = (path[:, 1], path[:, 2], _unwrapped(path[:, 3]))
    poses = np.column_stack(
        [np.interp(t, path[:, 0], c, left=np.nan, right=np.nan) for c in columns]
    )
    poses[:, 2] = wrap_angle(poses[:, 2])
    return poses


def _unwrapped(headings: Array) -> Array:
    """Take out the jumps of 2π between the headings that are known."""
    known = ~np.isnan(headings)
    smooth = headings.copy()
    smooth[known] = np.unwrap(headings[known])
    return smooth


def _paired(**positions: ArrayLike) -> tuple[Array, Array]:
    """Check two arrays of positions; their names are those the caller knows."""
    arrays = {name: as_floats(name, value) for name, value in positions.items()}
    for name, rows in arrays.items():
        if rows.ndim != 2 or rows.shape[1] != 2 or not len(rows):
            raise ValueError(f"{name} must have shape (n, 2), n >= 1, got {rows.shape}")
        if not np.isfinite(rows).all():
            raise ValueError(f"{name} must be finite, got nan or inf")
    first, second = arrays.values()
    if len(first) != len(second):
        raise ValueError(
            f"{' and '.join(arrays)} must be equally many positions, "
            f"got {len(first)} and {len(second)}"
        )
    return first, second
