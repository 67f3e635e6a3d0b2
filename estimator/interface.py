"""The interface of every estimator, and of what only some of them can do."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any, Protocol, runtime_checkable

from numpy.typing import ArrayLike

from ..arrays import Array
from .belief import Belief, MapView
from .support.undo import Undo
from .update_report import ScanDecisions, UpdateReport

__all__ = [
    "Belief",
    "MapView",
    "ScanDecisions",
    "SlamEstimator",
    "SmoothedPath",
    "SupportsBeliefLimit",
    "SupportsCheckpoint",
    "SupportsDecisions",
    "SupportsJoin",
    "SupportsJointMerging",
    "SupportsLandmarkIds",
    "SupportsLocalView",
    "SupportsMapView",
    "SupportsMemoryEstimate",
    "SupportsMerging",
    "SupportsRemoval",
    "SupportsRestore",
    "SupportsSmoothing",
    "SupportsTruth",
    "UpdateReport",
    "optional_members",
    "restore",
]


@runtime_checkable
class SlamEstimator(Protocol):
    """A filter that estimates a robot's pose and a map of landmarks step by step.

    Any class with these methods works in an experiment or an agent's loop.
    :func:`slamgym.estimator.check_estimator` names what a class of your own lacks.
    """

    def reset(self, pose: ArrayLike, pose_std: ArrayLike) -> None:
        """Start a new run at a pose (3,) with deviations (3,) [m, m, rad], no map."""

    def predict(self, odometry: ArrayLike, dt: float = 1.0) -> None:
        """Move by odometry (d, α) [m, rad], its motion noise counted √dt times."""

    def update(
        self, measurements: ArrayLike, landmark_ids: Sequence[int] | None = None
    ) -> UpdateReport:
        """Take in one scan, rows (bearing, range) [rad, m], all seen at once."""
        ...

    def belief(self) -> Belief:
        """Return the present belief."""
        ...

    def state_dict(self) -> dict[str, Any]:
        """Return everything that load_state_dict() needs, as arrays."""
        ...

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue from a saved state, bit for bit."""


@runtime_checkable
class SupportsTruth(Protocol):
    """An estimator that linearises at the ground truth, for study only."""

    def observe_truth(
        self, pose: ArrayLike, landmarks: Mapping[int, ArrayLike]
    ) -> None:
        """Pass the true pose (3,) and landmarks before the predict of a step."""


@runtime_checkable
class SupportsDecisions(Protocol):
    """An estimator that associates readings and lists its decisions about them."""

    @property
    def decisions(self) -> Sequence[ScanDecisions]:
        """The decisions about every scan since the start, as they stand now."""


class SmoothedPath(Protocol):
    """Beliefs about the poses of a drive, given all of its readings."""

    poses: Array
    """At every scan, shape (N, 3) [m, m, rad]."""

    @property
    def pose_covariances(self) -> Array:
        """Shape (N, 3, 3)."""
        ...

    def belief(self) -> Belief:
        """Return the belief about the last pose and the map."""
        ...


@runtime_checkable
class SupportsSmoothing(Protocol):
    """An estimator that knows more of a pose once it has seen the whole drive."""

    def smoothed(self) -> SmoothedPath:
        """Return the beliefs about all poses, given the drive until now."""
        ...


@runtime_checkable
class SupportsLocalView(Protocol):
    """An estimator that returns the belief around the robot faster than the whole."""

    def local_view(self, within: float) -> MapView:
        """Return the pose and at least the landmarks within that distance [m]."""
        ...


@runtime_checkable
class SupportsJoin(SupportsLocalView, Protocol):
    """An estimator that keeps parts of its map apart until it joins them."""

    def join(self) -> None:
        """Join the parts of the map, and continue from the joined map."""


@runtime_checkable
class SupportsMapView(Protocol):
    """An estimator that shows its whole map without a copy."""

    def map_view(self) -> MapView:
        """Return the pose and all landmarks; valid until the next step."""
        ...


@runtime_checkable
class SupportsLandmarkIds(Protocol):
    """An estimator that lists its landmarks without computing a belief."""

    @property
    def landmark_ids(self) -> Sequence[int]:
        """The mapped landmarks, in the order of the belief."""


@runtime_checkable
class SupportsRemoval(Protocol):
    """An estimator that removes landmarks from its map."""

    def remove(self, landmark_ids: Sequence[int]) -> None:
        """Marginalise landmarks; all else is unchanged to the last bit."""


@runtime_checkable
class SupportsMerging(Protocol):
    """An estimator that merges landmarks of its map."""

    def merge(self, kept: int, gone: int) -> None:
        """Condition on two landmarks being one, and remove the second."""


@runtime_checkable
class SupportsJointMerging(SupportsMerging, Protocol):
    """An estimator that merges several pairs of landmarks by one measurement."""

    def merge_pairs(self, pairs: Sequence[tuple[int, int]]) -> None:
        """Condition on the landmarks (kept, gone) being one; remove the second ones."""


@runtime_checkable
class SupportsMemoryEstimate(Protocol):
    """An estimator that knows how much memory a map takes."""

    def memory_for(self, landmarks: int) -> int:
        """Return the least memory that a map of this many landmarks takes [bytes]."""
        ...


@runtime_checkable
class SupportsRestore(Protocol):
    """An estimator that continues from its own states without checking them."""

    def restore(self, state: Mapping[str, Any]) -> None:
        """Continue from a state that this process has saved."""


@runtime_checkable
class SupportsCheckpoint(Protocol):
    """An estimator that can take back its own calls."""

    def checkpoint(self, *, motion: bool = False) -> Undo:
        """Return what takes back later calls; ``motion``: only those of predict."""
        ...


@runtime_checkable
class SupportsBeliefLimit(Protocol):
    """An estimator that refuses a dense belief of too many landmarks."""

    belief_limit: int
    """Largest number of landmarks of a dense belief."""


_MEMBERS: dict[type, tuple[str, ...]] = {
    SupportsTruth: ("observe_truth",),
    SupportsLocalView: ("local_view",),
    SupportsJoin: ("join",),
    SupportsSmoothing: ("smoothed",),
    SupportsMemoryEstimate: ("memory_for",),
    SupportsBeliefLimit: ("belief_limit",),
}


def optional_members(estimator: SlamEstimator) -> dict[str, Any]:
    """Return what an estimator offers that a wrapper passes on unchanged, by name."""
    return {
        name: getattr(estimator, name)
        for ability, names in _MEMBERS.items()
        if isinstance(estimator, ability)
        for name in names
    }


def checkpoint(estimator: SlamEstimator, *, motion: bool = False) -> Undo:
    """Return what takes back later calls; ``motion``: only those of predict."""
    if isinstance(estimator, SupportsCheckpoint):
        return estimator.checkpoint(motion=motion)
    return partial(restore, estimator, estimator.state_dict())


def restore(estimator: SlamEstimator, state: Mapping[str, Any]) -> None:
    """Continue from a state that this process has saved, without checks if possible."""
    if isinstance(estimator, SupportsRestore):
        estimator.restore(state)
    else:
        estimator.load_state_dict(state)
