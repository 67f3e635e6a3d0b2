"""The beliefs of many runs, side by side."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from ...arrays import Array
from ..belief import Belief
from ..error_frames import ErrorFrame
from ..kernels.batch import NEVER, RunArrays, begin_runs
from ..kernels.belief_arrays import aligned_zeros
from ..support import argument_checks
from .batch_arguments import checked_beliefs, chosen_runs, first_poses
from .batch_results import BatchBeliefs, BatchStorage
from .gaussian_map import GaussianMap


class BatchOfBeliefs:
    """The beliefs of B runs about their poses and up to L landmarks.

    Parameters
    ----------
    poses : ndarray, shape (B, 3)
        Means of the first poses [m, m, rad].
    std : ndarray, shape (3,)
        Their standard deviation.
    landmarks : int
        L.
    frame : ErrorFrame
        Of the filters.
    """

    def __init__(
        self, poses: Array, std: Array, landmarks: int, frame: ErrorFrame
    ) -> None:
        self.runs, self.landmarks, self._frame = len(poses), landmarks, frame
        capacity = GaussianMap.capacity_for(landmarks)
        self._means = np.zeros((self.runs, capacity))
        self._references = np.zeros((self.runs, capacity))
        self._covariances = aligned_zeros(self.runs, capacity, capacity)
        self._slots = np.full((self.runs, landmarks), -1, dtype=np.int64)
        self._mapped = np.zeros(self.runs, dtype=np.int64)
        self.failed_at = np.full(self.runs, NEVER, dtype=np.int64)
        """Step of the last :meth:`run` at which a run stopped, -1 if it did not.

        A stopped run remains stopped, at step 0 of every later :meth:`run`.
        """
        begin_runs(tuple(self._arrays()), self.failed_at == NEVER, poses.copy(), std**2)

    def reset(
        self,
        poses: ArrayLike,
        pose_std: ArrayLike = (0.0, 0.0, 0.0),
        *,
        runs: ArrayLike | None = None,
    ) -> None:
        """Restart runs with empty maps, also those that had stopped.

        Parameters
        ----------
        poses : array_like, shape (3,) or (B, 3)
            Means of the first poses [m, m, rad].
        pose_std : array_like, shape (3,)
            Their standard deviation.
        runs : array_like of bool, shape (B,), optional
            The runs that start anew; by default all; the others continue.
        """
        std = argument_checks.standard_deviations("pose_std", pose_std, 3)
        first = first_poses("poses", poses, self.runs)
        chosen = chosen_runs(runs, self.runs)
        begin_runs(tuple(self._arrays()), chosen, np.array(first), std**2)
        self.failed_at[chosen] = NEVER

    def beliefs(self) -> BatchBeliefs:
        """Return a snapshot of all beliefs; a run that stopped has its last."""
        return self.storage().beliefs()

    def storage(self) -> BatchStorage:
        """Return the arrays that the runs work on, without a copy.

        They change with the next :meth:`run` or :meth:`reset`.
        """
        return BatchStorage.of(self._means, self._covariances, self._slots)

    @property
    def references(self) -> Array:
        """Linearisation points, stored like the means, for filters that fix them."""
        return BatchStorage.of(self._references, self._covariances, self._slots).means

    def load(
        self,
        beliefs: BatchBeliefs,
        *,
        references: ArrayLike | None = None,
        runs: ArrayLike | None = None,
    ) -> None:
        """Continue runs from given beliefs, also those that had stopped.

        Parameters
        ----------
        beliefs : BatchBeliefs
            Of B runs, as :meth:`beliefs` returns them, or `BatchBeliefs.of` makes them.
        references : array_like, shape (B, 3 + 2L), optional
            Linearisation points of filters that fix them; the means by default.
        runs : array_like of bool, shape (B,), optional
            All by default.

        Raises
        ------
        ValueError
            If a shape is wrong, or a belief cannot be; nothing is loaded.
        """
        chosen = chosen_runs(runs, self.runs)
        loaded = checked_beliefs(beliefs, references, chosen, self.landmarks)
        for run in np.flatnonzero(chosen).tolist():
            loaded.write(run, self._arrays())
        self.failed_at[chosen] = NEVER

    def belief(self, run: int) -> Belief:
        """Return the belief of one run as a snapshot."""
        n = 3 + 2 * int(self._mapped[run])
        slots = self._slots[run]
        order = np.argsort(slots[slots >= 0])
        return Belief(
            self._means[run, :n],
            self._covariances[run, :n, :n],
            tuple(np.flatnonzero(slots >= 0)[order].tolist()),
            self._frame,
        )

    @property
    def nbytes(self) -> int:
        """Memory of the beliefs of all runs [bytes]."""
        return sum(array.nbytes for array in self._arrays())

    def _arrays(self) -> RunArrays:
        return RunArrays(
            self._means, self._covariances, self._references, self._slots, self._mapped
        )
