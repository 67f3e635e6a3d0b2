"""A filter that keeps its belief in a Gaussian map: belief, saved state, editing."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ..belief import Belief, MapView, describe_filter
from ..error_frames import ErrorFrame
from ..kernels.rules import ADDITIVE, AT_ESTIMATE, INVARIANT, Rules
from ..support import argument_checks, pair_checks, saved_states
from ..support.argument_checks import LandmarkIds
from ..support.memory_limit import covariance_bytes
from ..support.undo import Undo
from .gaussian_map import GaussianMap

FRAMES: dict[int, ErrorFrame] = {ADDITIVE: "additive", INVARIANT: "invariant"}


class MapFilter:
    """A filter without its steps: reset, belief, saved state, map editing."""

    map: GaussianMap
    """The belief, in the arrays that steps change."""
    rules: Rules
    """What distinguishes this filter's updates from another's."""

    __repr__ = describe_filter

    @property
    def frame(self) -> ErrorFrame:
        """Coordinates in which the filter takes its error to be Gaussian."""
        return FRAMES[self.rules.frame]

    def reset(self, pose: ArrayLike, pose_std: ArrayLike) -> None:
        """Start a new run with an empty map.

        Parameters
        ----------
        pose : array_like, shape (3,)
            Mean of the first pose (x, y, θ) [m, m, rad].
        pose_std : array_like, shape (3,)
            Its standard deviation.
        """
        first = argument_checks.finite_vector("pose", pose, 3)
        std = argument_checks.standard_deviations("pose_std", pose_std, 3)
        self.map.reset(first, np.diag(std**2))

    def remove(self, landmark_ids: LandmarkIds) -> None:
        """Marginalise landmarks; the remaining belief is unchanged to the last bit.

        Raises
        ------
        ValueError
            If one is not in the map; nothing is removed.
        """
        self.map.remove(argument_checks.mapped_identities(landmark_ids, self.map.slots))

    def merge(self, kept: int, gone: int) -> None:
        """Condition on two mapped landmarks being one, and remove the second.

        Raises
        ------
        ValueError
            If one is not in the map, or they are the same.
        numpy.linalg.LinAlgError
            If their distance has no uncertainty; nothing is merged.
        """
        self.merge_pairs([(kept, gone)])

    def merge_pairs(self, pairs: Sequence[tuple[int, int]]) -> None:
        """Merge several pairs (kept, gone) at once, as one measurement.

        Raises
        ------
        ValueError
            If a landmark is not in the map, or in two pairs.
        numpy.linalg.LinAlgError
            If a distance has no uncertainty; nothing is merged.
        """
        kept, gone = pair_checks.landmark_pairs(pairs, self.map.slots)
        at_reference = self.rules.linearisation != AT_ESTIMATE
        self.map.merge(kept, gone, frame=self.frame, at_reference=at_reference)

    def belief(self, landmark_ids: LandmarkIds | None = None) -> Belief:
        """Return the belief as a snapshot, of the whole map or of a part of it.

        Parameters
        ----------
        landmark_ids : sequence of int, optional
            Return the marginal of the pose and these landmarks only, in this order.
        """
        if landmark_ids is not None:
            landmark_ids = argument_checks.mapped_identities(
                landmark_ids, self.map.slots
            )
        return self.map.belief(self.frame, landmark_ids)

    def map_view(self) -> MapView:
        """Return pose and map without a copy; it is valid until the next step."""
        return self.map.view()

    @property
    def landmark_ids(self) -> tuple[int, ...]:
        """The mapped landmarks, in the order of the belief."""
        return tuple(self.map.slots)

    def state_dict(self) -> dict[str, Any]:
        """Return copies of mean, covariance, ids and linearisation points."""
        return {"estimator": np.array(type(self).__name__), **self.map.state_dict()}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue from a saved state, bit for bit in a filter of the same settings.

        Parameters
        ----------
        state : mapping
            What :meth:`state_dict` returned, also after a trip through ``numpy.savez``.

        Raises
        ------
        ValueError
            If the state lacks an entry, is of another estimator, or does not fit
            together; the belief is then as before.
        """
        entries = ("covariance", "landmark_ids", "mean", "reference")
        saved_states.refuse_other_state(state, entries, estimator=type(self).__name__)
        self.map.load_state_dict(state)

    def restore(self, state: Mapping[str, Any]) -> None:
        """Continue from a state that this process has saved, without checks."""
        self.map.restore(state)

    def checkpoint(self, *, motion: bool = False) -> Undo:
        """Return what takes back later calls; ``motion``: only those of predict."""
        return self.map.checkpoint(motion=motion)

    def memory_for(self, landmarks: int) -> int:
        """Return the least memory of a map with this many landmarks [bytes]."""
        return self.map.copies * covariance_bytes(landmarks)
