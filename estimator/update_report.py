"""The report of one update: innovations, NIS, and what became of each reading."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


class UpdateReport(NamedTuple):
    """What one call of :meth:`SlamEstimator.update` did.

    ``innovation`` rows belong to ``associated_ids``; ν and S are those at the prior.
    """

    nis: float = 0.0
    """νᵀ S⁻¹ ν, χ² distributed when the filter is consistent."""
    degrees_of_freedom: int = 0
    """Of the NIS: twice the number of associated readings."""
    associated_ids: tuple[int, ...] = ()
    """Mapped landmarks whose readings corrected the belief."""
    added_ids: tuple[int, ...] = ()
    """Landmarks that entered the map."""
    rejected_ids: tuple[int, ...] = ()
    """Mapped landmarks whose readings the chi-square gate refused."""
    skipped_ids: tuple[int, ...] = ()
    """Readings too close to use (range below ``min_range``)."""
    near_ids: tuple[int, ...] = ()
    """Mapped landmarks within 10 σ of the robot, where linearising is unsafe."""
    innovation: Array = np.empty((0, 2))
    """ν, shape (m, 2), rows (bearing, range) [rad, m]."""
    factor: Array | Callable[[], Array] = np.empty((0, 0))
    """L, shape (2m, 2m), lower triangular, L Lᵀ = S; or a function that gives it."""
    confirmed_ids: tuple[int, ...] = ()
    """Of those added: tentative before, seen often enough now."""
    removed_ids: tuple[int, ...] = ()
    """Landmarks marginalised: missed too often, or beyond the map's capacity."""
    merged_ids: tuple[tuple[int, int], ...] = ()
    """Pairs (kept, gone) of landmarks found to be one."""
    row_ids: tuple[int | None, ...] = ()
    """For each row of the scan the landmark that it was taken for, if any; empty where
    nothing was associated."""
    tentative_rows: tuple[int, ...] = ()
    """Rows of the scan that speak for a landmark not yet confirmed."""
    ambiguous_rows: tuple[int, ...] = ()
    """Rows left out: of more than one landmark perhaps, or too close to tell."""

    @property
    def innovation_factor(self) -> Array:
        """L, shape (2m, 2m): L⁻¹ ν is white, in the order β1, r1, β2, r2."""
        return self.factor() if callable(self.factor) else self.factor

    @property
    def innovation_covariance(self) -> Array:
        """S, shape (2m, 2m), of the innovations in the order β1, r1, β2, r2."""
        factor = self.innovation_factor
        return factor @ factor.T
