"""The error of a map with a penalty for missed and for false landmarks.

GOSPA is the generalised optimal sub-pattern assignment metric [1]_.  For p = α = 2::

    GOSPA² = min over assignments γ of  Σ_γ ‖x − y‖²  +  c²/2 (missed + false)

over pairs (x, y) of an estimated and a true landmark nearer than the cut-off c.  The
other true landmarks are missed, the other estimated ones are false.

References
----------
.. [1] A. S. Rahmathullah, Á. F. García-Fernández, L. Svensson, Generalized optimal
   sub-pattern assignment metric, 20th International Conference on Information Fusion,
   2017.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import linear_sum_assignment
from scipy.spatial.distance import cdist

from ..arrays import AnyArray, Array
from ..estimator.support.argument_checks import as_floats

CUTOFF = 1.0
"""An estimate farther than this from a true landmark is not of it [m]."""


class Gospa(NamedTuple):
    """The metric and its three parts: distance² = localisation + missed + false."""

    distance: float
    """The metric [m]."""
    localisation: float
    """Σ ‖x − y‖² over the pairs [m²]."""
    missed: float
    """c²/2 for each true landmark without an estimate [m²]."""
    false: float
    """c²/2 for each estimate without a true landmark [m²]."""
    pairs: int
    """Number of pairs."""
    missed_count: int
    """Number of missed landmarks."""
    false_count: int
    """Number of false landmarks."""


def gospa(
    estimate: ArrayLike,
    truth: ArrayLike,
    cutoff: float = CUTOFF,
    *,
    places: ArrayLike | None = None,
) -> Gospa:
    """Compare a map with the truth.

    Parameters
    ----------
    estimate : array_like, shape (n, 2)
        Estimated landmarks [m].
    truth : array_like, shape (m, 2)
        True landmarks [m].
    cutoff : float
        c [m].
    places : array_like of int, shape (m,), optional
        Place of each true landmark: those of one place count as one, as far from an
        estimate as the nearest of them.

    Returns
    -------
    Gospa

    Raises
    ------
    ValueError
        If an array is not of positions, the cut-off is not above 0, or there is not one
        place for each true landmark.

    Examples
    --------
    >>> found = gospa([(0.0, 0.6), (9.0, 9.0)], [(0.0, 0.0)])
    >>> found.localisation, found.missed, found.false, round(found.distance, 3)
    (0.36, 0.0, 0.5, 0.927)
    """
    x, y = (
        as_floats(name, value).reshape(-1, 2)
        for name, value in (("estimate", estimate), ("truth", truth))
    )
    if not 0 < cutoff < np.inf:
        raise ValueError(f"cutoff must be a number > 0, got {cutoff!r}")
    gaps = np.minimum(cdist(x, y), cutoff)
    if places is not None:
        gaps = _nearest_of_each(gaps, np.asarray(places))
    chosen = gaps[linear_sum_assignment(gaps**2)]
    near = chosen[chosen < cutoff]
    pairs = len(near)
    missed, false = gaps.shape[1] - pairs, len(x) - pairs
    penalty = cutoff**2 / 2
    parts = float(np.sum(near**2)), penalty * missed, penalty * false
    return Gospa(float(np.sqrt(sum(parts))), *parts, pairs, missed, false)


def _nearest_of_each(gaps: Array, places: AnyArray) -> Array:
    """Reduce gaps (n, m) to landmarks to gaps (n, k) to their k places."""
    if places.shape != gaps.shape[1:]:
        raise ValueError(
            f"places must have one entry per true landmark, got shape {places.shape} "
            f"for {gaps.shape[1]}"
        )
    each = [gaps[:, places == place].min(axis=1) for place in np.unique(places)]
    return np.array(each).T.reshape(len(gaps), len(each))
