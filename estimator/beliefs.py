"""What a filter returns: its belief, a view of its map, and the report of an update."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import ArrayLike

from ..arrays import Array
from .models.bearing_range import wrap_angle
from .models.rigid_motion import (
    ErrorFrame,
    additive_error,
    invariant_covariance,
    invariant_error,
    seen_from,
)


@dataclass(frozen=True, eq=False, repr=False)
class Belief:
    """A Gaussian belief over robot pose and map: a snapshot, safe to keep.

    The state is (x, y, θ, l1x, l1y, …), landmarks in the order of ``landmark_ids``.
    """

    #: Shape (3 + 2n,), heading in [-π, π), or nan; a column may be given.
    mean: Array
    #: Shape (3 + 2n, 3 + 2n), of the additive error.
    covariance: Array
    #: Given as any sequence or array, or as the keys of a dict; kept as a tuple.
    landmark_ids: tuple[int, ...]
    #: Coordinates in which the filter takes its error to be Gaussian.
    frame: ErrorFrame = "additive"

    def __post_init__(self) -> None:
        mean = np.array(self.mean, dtype=np.float64).ravel()
        covariance = np.array(self.covariance, dtype=np.float64)
        given: Any = self.landmark_ids
        ids = tuple(given.tolist() if isinstance(given, np.ndarray) else given)
        size = 3 + 2 * len(ids)
        if mean.shape != (size,) or covariance.shape != (size, size):
            raise ValueError(
                f"a belief with {len(ids)} landmarks has mean ({size},) "
                f"and covariance ({size}, {size}), got {mean.shape} and "
                f"{covariance.shape}"
            )
        if not isinstance(given, dict) and len(set(ids)) < len(ids):
            raise ValueError(f"landmark_ids must differ, got {ids}")
        self._chosen(self.frame)
        owned = self.owning(mean, covariance, ids, self.frame)
        vars(self).update(vars(owned))

    @classmethod
    def marginal(
        cls,
        mean: Array,
        covariance: Array,
        slots: Mapping[int, int],
        landmark_ids: Sequence[int],
        frame: ErrorFrame = "additive",
    ) -> Belief:
        """Return the belief over the pose and some landmarks of a larger state.

        Parameters
        ----------
        mean, covariance : ndarray
            The state; there may be room behind it.
        slots : mapping from id to int
            Place of each landmark in the state: column 3 + 2 slot.
        landmark_ids : sequence of int
            The landmarks of the belief, in its order.
        frame : {"additive", "invariant"}
            Coordinates in which the filter takes its error to be Gaussian.
        """
        columns = columns_of([slots[i] for i in landmark_ids])
        P = covariance[np.ix_(columns, columns)]
        return cls(mean[columns], P, tuple(landmark_ids), frame)

    @classmethod
    def owning(
        cls, mean: Array, covariance: Array, ids: tuple[int, ...], frame: ErrorFrame
    ) -> Belief:
        """Return the belief of arrays that nothing else holds, without a copy."""
        belief = object.__new__(cls)
        mean[2] = wrap_angle(float(mean[2]))
        mean.setflags(write=False)
        covariance.setflags(write=False)
        vars(belief).update(
            mean=mean, covariance=covariance, landmark_ids=ids, frame=frame
        )
        return belief

    @property
    def pose(self) -> Array:
        """(x, y, θ), shape (3,) [m, m, rad]."""
        return self.mean[:3]

    @property
    def pose_covariance(self) -> Array:
        """Shape (3, 3)."""
        return self.covariance[:3, :3]

    @property
    def landmarks(self) -> Array:
        """Positions, shape (n, 2) [m]."""
        return self.mean[3:].reshape(-1, 2)

    @property
    def landmark_covariances(self) -> Array:
        """Marginal covariance of each landmark, shape (n, 2, 2) [m²]."""
        n = len(self.landmark_ids)
        blocks = self.covariance[3:, 3:].reshape(n, 2, n, 2)
        return blocks[np.arange(n), :, np.arange(n), :]

    def error(
        self, true_pose: ArrayLike, true_landmarks: ArrayLike, frame: str | None = None
    ) -> Array:
        """Return the error of this belief against the truth.

        The origin of the invariant frame is the estimated position, so that error and
        covariance keep their digits in a world whose origin is far away.

        Parameters
        ----------
        true_pose : array_like, shape (3,)
            (x, y, θ) [m, m, rad].
        true_landmarks : array_like, shape (n, 2)
            In the order of ``landmark_ids`` [m].
        frame : {"additive", "invariant"}, optional
            Error coordinates; the filter's own where not given.

        Returns
        -------
        ndarray, shape (3 + 2n,)
            In the order of the state; its covariance is :meth:`error_covariance` of
            the same frame.
        """
        truth = np.concatenate([np.ravel(true_pose), np.ravel(true_landmarks)])
        if truth.shape != self.mean.shape:
            raise ValueError(
                f"the truth must be a pose (3,) and {len(self.landmark_ids)} landmarks "
                f"(n, 2), got {np.shape(true_pose)} and {np.shape(true_landmarks)}"
            )
        if self._chosen(frame) == "invariant":
            mean, truth = self._seen_from_here(self.mean, truth)
            return invariant_error(truth, mean)
        return additive_error(truth, self.mean)

    def error_covariance(self, frame: str | None = None) -> Array:
        """Return the covariance (3 + 2n, 3 + 2n) that belongs to :meth:`error`."""
        if self._chosen(frame) == "invariant":
            (mean,) = self._seen_from_here(self.mean)
            return invariant_covariance(mean, self.covariance)
        return self.covariance

    def _seen_from_here(self, *states: Array) -> list[Array]:
        return [seen_from(self.mean[:2], state) for state in states]

    def __repr__(self) -> str:
        n = len(self.landmark_ids)
        return f"Belief of {describe_map(n, self.pose, self.pose_covariance)}"

    def _chosen(self, frame: str | None) -> str:
        chosen = self.frame if frame is None else frame
        if chosen not in ("additive", "invariant"):
            raise ValueError(f"frame must be 'additive' or 'invariant', got {chosen!r}")
        return chosen


def columns_of(slots: Iterable[int]) -> list[int]:
    """Return where the pose and the landmarks in some slots stand in a state."""
    return [0, 1, 2, *(3 + 2 * slot + axis for slot in slots for axis in (0, 1))]


class MapView(NamedTuple):
    """The present belief of a filter, without a copy: not to keep or to change."""

    #: In the order of the state; there may be room behind it.
    mean: Array
    #: Of the additive error; there may be room behind it.
    covariance: Array
    #: Landmarks in the order of the state.
    ids: Sequence[int]
    #: All landmarks in the map, where the view holds only those around the robot.
    whole: Sequence[int] | None = None

    @property
    def mapped(self) -> Sequence[int]:
        """All landmarks in the map, in its order."""
        return self.ids if self.whole is None else self.whole

    @property
    def landmarks(self) -> Array:
        """Positions, shape (n, 2) [m]."""
        return self.mean[3 : 3 + 2 * len(self.ids)].reshape(-1, 2)

    def part(self, slots: Sequence[int]) -> MapView:
        """Return a copy of the pose and some landmarks, by their places in the view."""
        columns, ids = columns_of(slots), [self.ids[slot] for slot in slots]
        P = self.covariance[np.ix_(columns, columns)]
        return MapView(self.mean[columns], P, ids, self.mapped)

    @property
    def landmark_covariances(self) -> Array:
        """Marginal covariance of each landmark, shape (n, 2, 2) [m²]."""
        columns = np.arange(3, 3 + 2 * len(self.ids)).reshape(-1, 2)
        return self.covariance[columns[:, :, None], columns[:, None, :]]


def describe_map(landmarks: int, pose: Array, pose_covariance: Array) -> str:
    """Return a pose with its standard deviations and a number of landmarks in words.

    Examples
    --------
    >>> describe_map(6, np.array([1.0, 2.0, 0.5]), np.diag([0.01, 0.04, 0.0004]))
    '6 landmarks, pose (1.000 ± 0.100 m, 2.000 ± 0.200 m, 0.500 ± 0.020 rad)'
    """
    std = np.sqrt(pose_covariance.diagonal().clip(0.0))
    x, y, heading = (f"{p:.3f} ± {s:.3f}" for p, s in zip(pose, std, strict=True))
    noun = f"landmark{'s' * (landmarks != 1)}"
    return f"{landmarks} {noun}, pose ({x} m, {y} m, {heading} rad)"


def part_of(whole: Belief | MapView, ids: Sequence[int], frame: ErrorFrame) -> Belief:
    """Return the marginal of the pose and some landmarks of a belief."""
    order = whole.landmark_ids if isinstance(whole, Belief) else whole.ids
    slots = {i: slot for slot, i in enumerate(order)}
    return Belief.marginal(whole.mean, whole.covariance, slots, ids, frame)


class _HasMarginals(Protocol):
    @property
    def landmark_ids(self) -> Sequence[int]: ...

    def belief(self, landmark_ids: Sequence[int] | None = None) -> Belief: ...


def describe_filter(slam: _HasMarginals) -> str:
    """Return class, number of landmarks and pose of a filter: its ``__repr__``."""
    pose = slam.belief([])
    found = describe_map(len(slam.landmark_ids), pose.pose, pose.pose_covariance)
    return f"{type(slam).__name__} of {found}"


# --------------------------------------------------------------------------------------
# What an update returns.


class ScanDecisions(NamedTuple):
    """Final assignment of the readings of one scan to landmarks."""

    #: The landmark of each row; None where the filter did not use the row.
    row_ids: tuple[int | None, ...]
    #: Landmarks that entered the map with this scan; the row of each confirmed it.
    added: tuple[int, ...] = ()
    #: Landmarks that left the map after it.
    removed: tuple[int, ...] = ()
    #: Landmarks merged after it, (kept, gone); the second ones left the map.
    merged: tuple[tuple[int, int], ...] = ()


@dataclass(frozen=True, eq=False, repr=False)
class UpdateReport:
    """What one call of :meth:`SlamEstimator.update` did: a snapshot, safe to keep.

    ``innovation`` rows belong to ``associated_ids``; ν and S are those at the prior.
    """

    #: νᵀ S⁻¹ ν, χ² distributed when the filter is consistent.
    nis: float = 0.0
    #: Of the NIS: how many numbers the readings hold that corrected the belief.
    degrees_of_freedom: int = 0
    #: Mapped landmarks whose readings corrected the belief.
    associated_ids: tuple[int, ...] = ()
    #: Landmarks that entered the map.
    added_ids: tuple[int, ...] = ()
    #: Mapped landmarks whose readings the chi-square gate rejected.
    rejected_ids: tuple[int, ...] = ()
    #: Landmarks whose readings are too close to use (range below ``min_range``).
    skipped_ids: tuple[int, ...] = ()
    #: Mapped landmarks within 10 σ of the robot, where linearising is unsafe.
    near_ids: tuple[int, ...] = ()
    #: ν, a row of two numbers for each reading; (k,) for a reading of the pose.
    innovation: Array = field(default_factory=lambda: np.empty((0, 2)))
    #: L, lower triangular, L Lᵀ = S of all these numbers; or a function returning it.
    factor: Array | Callable[[], Array] = field(
        default_factory=lambda: np.empty((0, 0))
    )
    #: Landmarks that were tentative before: among ``added_ids``, or among those
    #: associated where the filter has applied their earlier sightings.
    confirmed_ids: tuple[int, ...] = ()
    #: Landmarks marginalised: missed too often, or beyond the map's capacity.
    removed_ids: tuple[int, ...] = ()
    #: Pairs (kept, gone) of landmarks that were merged.
    merged_ids: tuple[tuple[int, int], ...] = ()
    #: The landmark associated with each row of the scan, None for a row without one;
    #: empty without landmark management.
    row_ids: tuple[int | None, ...] = ()
    #: Rows of the scan associated with a landmark that is not confirmed yet.
    tentative_rows: tuple[int, ...] = ()
    #: Rows left out: they fit more than one landmark, or their range is too short.
    ambiguous_rows: tuple[int, ...] = ()

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

    def completed(self, **parts: Any) -> UpdateReport:
        """Return the report with parts that its filter did not know.

        A subclass may change and return this report itself.  Call this before anybody
        else has received the report.
        """
        return self.replace(**parts)

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
