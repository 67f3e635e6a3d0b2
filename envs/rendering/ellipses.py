"""The n-sigma ellipses of planar Gaussian beliefs.

Symbols
-------
P = [[a, b], [b, c]]  covariance of a position [m²]
n                     size of the ellipse in standard deviations
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from ...arrays import Array

_RELATIVE_ROUNDING = 1e-9  # of the larger eigenvalue
_ABSOLUTE_ROUNDING = 1e-12  # [m²]: a micrometre, squared


class Ellipses(NamedTuple):
    """Full axes and directions of ellipses, in the shape of the input's batch."""

    widths: Array  # (…), along the direction of largest spread [m]
    heights: Array  # (…), across it [m]
    angles: Array  # (…), from the x-axis to the width, in (-π/2, π/2] [rad]


def covariance_ellipses(covariance: ArrayLike, sigmas: float = 3.0) -> Ellipses:
    """Compute the ellipses { l : (l - mean)ᵀ P⁻¹ (l - mean) = n² } of covariances P.

    ::

        λ = (a + c)/2 ± √( ((a - c)/2)² + b² )        eigenvalues of P
        width, height = 2 n √λ₊, 2 n √λ₋              full axes
        angle = atan2(2 b, a - c) / 2                 eigenvector of λ₊

    Parameters
    ----------
    covariance : array_like, shape (…, 2, 2)
        Covariances P [m²], symmetric, finite and without negative eigenvalues.
        Eigenvalues that are negative by rounding count as zero.
    sigmas : float, default 3
        n > 0.

    Returns
    -------
    Ellipses
        Widths, heights [m] and angles [rad], each of shape (…).

    Raises
    ------
    ValueError
        If a matrix is not a covariance, or sigmas is not positive.

    Examples
    --------
    >>> covariance_ellipses([[4.0, 0.0], [0.0, 1.0]], sigmas=1.0).widths
    array(4.)
    """
    P = np.asarray(covariance, dtype=float)
    _check(P, sigmas)
    a, b, c = P[..., 0, 0], P[..., 0, 1], P[..., 1, 1]
    mean, radius = (a + c) / 2, np.hypot((a - c) / 2, b)
    larger, smaller = mean + radius, mean - radius
    if np.any(smaller < -(_ABSOLUTE_ROUNDING + _RELATIVE_ROUNDING * np.abs(larger))):
        raise ValueError(
            "covariance must have no negative eigenvalue, "
            f"got {float(np.min(smaller)):.3g} m²"
        )
    return Ellipses(
        widths=np.asarray(2 * sigmas * np.sqrt(np.maximum(larger, 0.0))),
        heights=np.asarray(2 * sigmas * np.sqrt(np.maximum(smaller, 0.0))),
        angles=np.asarray(np.arctan2(2 * b, a - c) / 2),
    )


def _check(P: Array, sigmas: float) -> None:
    if P.shape[-2:] != (2, 2):
        raise ValueError(f"covariance must have shape (…, 2, 2), got {P.shape}")
    if not np.isfinite(P).all():
        raise ValueError("covariance must be finite, got nan or inf")
    skew = np.abs(P[..., 0, 1] - P[..., 1, 0])
    size = np.abs(P[..., 0, 0]) + np.abs(P[..., 1, 1])
    if np.any(skew > _ABSOLUTE_ROUNDING + _RELATIVE_ROUNDING * size):
        raise ValueError(
            f"covariance must be symmetric, got entries {float(np.max(skew)):.3g} apart"
        )
    if not sigmas > 0:
        raise ValueError(f"sigmas must be > 0, got {sigmas}")
