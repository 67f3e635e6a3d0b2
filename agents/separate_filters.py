"""One filter per world: in a batch, or side by side where worlds hide identities."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from ..arrays import AnyArray, Array, BoolArray
from ..estimator.filters.batch import BatchBeliefs, BatchSlam, BatchStorage
from ..sim_configs import Scenario
from .belief_arrays import belief_storage, update_batch
from .estimator_choice import (
    BeliefOfMap,
    checked_belief,
    choose_batch,
    choose_estimator,
)


class SeparateFilters:
    """Filters side by side, for vector worlds that hide identities.

    Batches do not associate; these filters are managed and do.

    Parameters
    ----------
    estimator : str
        Registered name or "module:Class".
    scenario : Scenario
        Source of the noise settings.
    runs : int
        B, the number of worlds.
    rows : int
        N, the most landmarks in a map.
    options : mapping, optional
        Further options of the filters.

    Raises
    ------
    ValueError
        If the name is unknown, or an option does not fit.
    """

    def __init__(
        self,
        estimator: str,
        scenario: Scenario,
        runs: int,
        rows: int,
        options: Mapping[str, Any] | None = None,
    ) -> None:
        if not isinstance(estimator, str):
            raise ValueError(
                "estimator must be a registered name for vector environments, "
                f"got {estimator!r}"
            )
        self.filters = [
            choose_estimator(estimator, scenario, options, rows=rows)
            for _ in range(runs)
        ]
        """Filter i is that of world i."""
        self._steps = np.zeros(runs, dtype=np.int64)
        capacity = 3 + 2 * rows
        self._means = np.zeros((runs, capacity))
        self._covariances = np.zeros((runs, capacity, capacity))
        self._slots = np.full((runs, rows), -1, dtype=np.int64)

    def reset(self, poses: Array, pose_std: Any, *, runs: BoolArray) -> None:
        """Start new runs in some worlds, at poses (B, 3) with deviations (3,)."""
        for run in np.flatnonzero(runs).tolist():
            self.filters[run].reset(poses[run], pose_std)
            self._steps[run] = 0

    def update(
        self,
        observations: Mapping[str, AnyArray],
        worlds: BoolArray,
        *,
        moved: BoolArray,
    ) -> None:
        """Update the filters of some worlds with an observation, batched along B.

        Parameters
        ----------
        observations : mapping
            Batched observations of a landmark world.
        worlds : bool ndarray, shape (B,)
            Worlds whose filters are updated.
        moved : bool ndarray, shape (B,)
            Which of them have moved; the others take the scan from their start.
        """
        for run in np.flatnonzero(worlds).tolist():
            slam = self.filters[run]
            if moved[run]:
                slam.predict(observations["odometry"][run])
                self._steps[run] += 1
            seen = np.flatnonzero(observations["mask"][run])
            slam.update(observations["landmarks"][run][seen], None)
            belief = checked_belief(slam, int(self._steps[run]))
            stored = belief_storage(belief, self._slots.shape[1], by_id=False)
            self._means[run] = stored.means[0]
            self._covariances[run] = stored.covariances[0]
            self._slots[run] = stored.slots[0]

    def storage(self) -> BatchStorage:
        """Return the arrays of the beliefs; they change with the next update."""
        return BatchStorage.of(self._means, self._covariances, self._slots)

    def belief(self, run: int) -> BeliefOfMap:
        """Return the belief of one world."""
        return checked_belief(self.filters[run], int(self._steps[run]))

    def beliefs(self) -> BatchBeliefs:
        """Return the beliefs of all worlds side by side, as a snapshot."""
        return self.storage().beliefs()


Filters = BatchSlam | SeparateFilters


def choose_filters(
    estimator: str,
    scenario: Scenario,
    runs: int,
    rows: int,
    options: Mapping[str, Any] | None = None,
) -> Filters:
    """Make a batch of filters; where the scenario hides identities, separate ones.

    Raises
    ------
    ValueError
        If the name is unknown, an option does not fit, or the filter cannot run in
        batches and must.
    """
    choose = choose_batch if scenario.sensor.identities else SeparateFilters
    filters: Filters = choose(estimator, scenario, runs, rows, options)
    return filters


def update_filters(
    filters: Filters,
    observations: Mapping[str, AnyArray],
    worlds: BoolArray,
    *,
    moved: BoolArray,
) -> None:
    """Update the filters of some worlds; see `SeparateFilters.update`."""
    if isinstance(filters, SeparateFilters):
        filters.update(observations, worlds, moved=moved)
    else:
        update_batch(filters, observations, worlds, moved=moved)
