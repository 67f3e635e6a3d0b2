"""The report of one update: innovations, NIS, and the outcome of each reading."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, fields
from typing import Any, NamedTuple

import numpy as np

from ..arrays import Array


class ScanDecisions(NamedTuple):
    """Which landmark each reading of one scan was given to, as decided in the end."""

    row_ids: tuple[int | None, ...]
    """The landmark of each row; None where the filter did not use the row."""
    added: tuple[int, ...] = ()
    """Landmarks that entered the map with this scan; the row of each confirmed it."""
    removed: tuple[int, ...] = ()
    """Landmarks that left the map after it."""
    merged: tuple[tuple[int, int], ...] = ()
    """Landmarks merged after it, (kept, gone); the second ones left the map."""


@dataclass(frozen=True, eq=False, repr=False)
class UpdateReport:
    """What one call of :meth:`SlamEstimator.update` did: a snapshot, safe to keep.

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
    """Mapped landmarks whose readings the chi-square gate rejected."""
    skipped_ids: tuple[int, ...] = ()
    """Landmarks whose readings are too close to use (range below ``min_range``)."""
    near_ids: tuple[int, ...] = ()
    """Mapped landmarks within 10 σ of the robot, where linearising is unsafe."""
    innovation: Array = field(default_factory=lambda: np.empty((0, 2)))
    """ν, shape (m, 2), rows (bearing, range) [rad, m]."""
    factor: Array | Callable[[], Array] = field(
        default_factory=lambda: np.empty((0, 0))
    )
    """L, shape (2m, 2m), lower triangular, L Lᵀ = S; or a function that returns it."""
    confirmed_ids: tuple[int, ...] = ()
    """Landmarks that were tentative before: among ``added_ids``, or among those
    associated where the filter has applied their earlier sightings."""
    removed_ids: tuple[int, ...] = ()
    """Landmarks marginalised: missed too often, or beyond the map's capacity."""
    merged_ids: tuple[tuple[int, int], ...] = ()
    """Pairs (kept, gone) of landmarks that were merged."""
    row_ids: tuple[int | None, ...] = ()
    """The landmark associated with each row of the scan, None for a row without one;
    empty without landmark management."""
    tentative_rows: tuple[int, ...] = ()
    """Rows of the scan associated with a landmark that is not confirmed yet."""
    ambiguous_rows: tuple[int, ...] = ()
    """Rows left out: they fit more than one landmark, or their range is too short."""

    @property
    def innovation_factor(self) -> Array:
        """L, shape (2m, 2m): L⁻¹ ν is white, in the order β1, r1, β2, r2."""
        return self.factor() if callable(self.factor) else self.factor

    @property
    def innovation_covariance(self) -> Array:
        """S, shape (2m, 2m), of the innovations in the order β1, r1, β2, r2."""
        factor = self.innovation_factor
        return factor @ factor.T

    def squared_given_others(self, landmark_id: int) -> float:
        """Return νᵀ S⁻¹ ν of the reading of a landmark, given the other readings.

        With Λ = S⁻¹ it is (Λν)ᵢᵀ Λᵢᵢ⁻¹ (Λν)ᵢ, i the two rows of the reading.

        Raises
        ------
        ValueError
            If the landmark is not among ``associated_ids``.

        Examples
        --------
        >>> report = UpdateReport(
        ...     associated_ids=(7,), innovation=np.array([[0.2, 1.0]]), factor=np.eye(2)
        ... )
        >>> round(report.squared_given_others(7), 2)
        1.04
        """
        place = 2 * self.associated_ids.index(landmark_id)
        sides = np.zeros((self.innovation.size, 3))
        sides[:, 0] = self.innovation.ravel()
        sides[place, 1] = sides[place + 1, 2] = 1.0
        white = np.linalg.solve(self.innovation_factor, sides)
        root = white[:, 1:]
        weighted = root.T @ white[:, 0]
        return float(weighted @ np.linalg.solve(root.T @ root, weighted))

    def replace(self, **changes: Any) -> UpdateReport:
        """Return a report with some parts changed.

        Examples
        --------
        >>> UpdateReport(nis=1.5, degrees_of_freedom=2).replace(added_ids=(7,))
        UpdateReport: NIS 1.5 of 2 degrees of freedom, 1 added
        """
        parts = {name: getattr(self, name) for name in _PARTS}
        return UpdateReport(**parts | changes)

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, UpdateReport):
            return NotImplemented
        return np.array_equal(self.innovation_factor, other.innovation_factor) and all(
            np.array_equal(getattr(self, name), getattr(other, name))
            if name == "innovation"
            else getattr(self, name) == getattr(other, name)
            for name in _PARTS
            if name != "factor"
        )

    __hash__ = None  # type: ignore[assignment]

    def __repr__(self) -> str:
        counts = {
            name.partition("_")[0]: len(getattr(self, name))
            for name in _PARTS
            if name.endswith(("_ids", "_rows")) and name != "row_ids"
        }
        parts = [f"{count} {name}" for name, count in counts.items() if count]
        nis = f"NIS {self.nis:.3g} of {self.degrees_of_freedom} degrees of freedom"
        return f"UpdateReport: {', '.join([nis, *parts])}"


_PARTS = tuple(part.name for part in fields(UpdateReport))
