"""Check whether the maps of a job fit into memory, before the filters run."""

from typing import TYPE_CHECKING

import numpy as np

from ...estimator.interface import (
    SlamEstimator,
    SupportsBeliefLimit,
    SupportsMemoryEstimate,
)
from ...estimator.support.argument_checks import refuse_large_belief
from ...estimator.support.memory_limit import covariance_bytes, refuse_beyond_memory
from ..logs.events import Scan
from ..logs.slamlog import SlamLog

if TYPE_CHECKING:
    from .simulated_runs import SimulatedRuns


def refuse_large_map(log: SlamLog, estimator: SlamEstimator) -> None:
    """Refuse a log with more landmarks than memory holds for this filter.

    The check counts the least memory of a run: the filter's map and the final belief of
    the landmarks that the log names. It accepts a log without names, and a filter that
    does not estimate its memory (``memory_for``).

    Raises
    ------
    ValueError
        If they exceed the filter's ``belief_limit``.
    MemoryError
        With the required and the available memory.
    """
    scans = [event.landmark_ids for event in log.events if isinstance(event, Scan)]
    named = [ids for ids in scans if ids is not None]
    if not named:
        return
    landmarks = len(np.unique(np.concatenate(named)))
    _refuse_beyond_limit(landmarks, estimator)
    if not isinstance(estimator, SupportsMemoryEstimate):
        return
    refuse_beyond_memory(
        f"a map of the {landmarks} landmarks that {log.name} reads",
        estimator.memory_for(landmarks) + covariance_bytes(landmarks),
        "take fewer steps, or landmarks",
    )


def refuse_large_maps(
    runs: "SimulatedRuns", estimator: SlamEstimator, *, at_once: bool
) -> None:
    """Refuse runs with more landmarks than memory holds for this filter.

    Parameters
    ----------
    runs : SimulatedRuns
        Input of the filters.
    estimator : SlamEstimator
        One of them.
    at_once : bool
        Whether all filters are in memory together; the final beliefs always are.

    Raises
    ------
    ValueError
        If they exceed the filter's ``belief_limit``.
    MemoryError
        With the required and the available memory.
    """
    read = runs.identified().visible.any(axis=1).sum(axis=1).tolist()  # by each run
    _refuse_beyond_limit(max(read), estimator)
    if not isinstance(estimator, SupportsMemoryEstimate):
        return
    maps = [estimator.memory_for(landmarks) for landmarks in read]
    beliefs = sum(covariance_bytes(landmarks) for landmarks in read)
    refuse_beyond_memory(
        f"a block of {len(read)} runs that read up to {max(read)} landmarks each",
        beliefs + (sum(maps) if at_once else max(maps)),
        "take a smaller block_size, or fewer steps",
    )


def _refuse_beyond_limit(landmarks: int, estimator: SlamEstimator) -> None:
    """Refuse a run with more landmarks than the filter's belief may hold."""
    if isinstance(estimator, SupportsBeliefLimit):
        refuse_large_belief(landmarks, estimator.belief_limit, "take fewer steps")
