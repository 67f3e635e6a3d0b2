"""How well filters of agents associate readings without identity, by episode."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from ..arrays import Array, BoolArray, IntArray
from ..estimator.interface import SupportsDecisions
from ..estimator.map_management.policy import policy_of
from ..evaluation.association_scores import score_association

SCORES = ("precision", "recall", "duplicate", "ghost")
"""Entries of `AssociationScores` that `info` reveals."""


class AssociationRecord:
    """Collects the true landmarks of the readings of B worlds, and scores the filters.

    Parameters
    ----------
    worlds : int
        B, the number of worlds.
    """

    def __init__(self, worlds: int) -> None:
        self._true_ids: list[list[IntArray]] = [[] for _ in range(worlds)]

    def begin(self, worlds: BoolArray) -> None:
        """Forget the readings of some worlds, (B,)."""
        for b in np.flatnonzero(worlds).tolist():
            self._true_ids[b] = []

    def add(self, worlds: BoolArray, true_ids: IntArray, mask: BoolArray) -> None:
        """Note one scan of some worlds, (B,): rows (B, M), and which are readings."""
        for b in np.flatnonzero(worlds).tolist():
            self._true_ids[b].append(true_ids[b][mask[b]])

    def scores(self, filters: Sequence[Any], ended: BoolArray) -> dict[str, Array]:
        """Return the scores of the episodes that have ended, each (B,); -1 elsewhere.

        Not nan, which would make equal infos differ. -1 also where no reading counts.

        Parameters
        ----------
        filters : sequence, length B
            Those without `decisions` have no scores.
        ended : bool ndarray, shape (B,)
            Worlds whose episode is over.
        """
        table = np.full((len(SCORES), len(filters)), -1.0)
        for b in np.flatnonzero(ended).tolist():
            slam = filters[b]
            if isinstance(slam, SupportsDecisions):
                confirm = policy_of(slam).confirm
                scores = score_association(
                    slam.decisions, self._true_ids[b], confirm=confirm
                ).as_dict()
                table[:, b] = [scores[name] for name in SCORES]
        table = np.nan_to_num(table, nan=-1.0)
        return {
            f"association_{name}": row for name, row in zip(SCORES, table, strict=True)
        }
