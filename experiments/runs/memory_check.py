"""Whether the maps of a job fit into memory: told before the filters run."""

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
    """Refuse a log whose landmarks are more than memory holds for this filter.

    What is counted is the least that a run takes, the filter's map and the belief at
    its end, of the landmarks that the log names; where it names none, or the filter
    does not say what it takes (``memory_for``), nothing is refused here.

    Raises
    ------
    ValueError
        Where they are more than the filter's ``belief_limit``.
    MemoryError
        With what it takes, and what is available.
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
    """Refuse runs whose landmarks are more than memory holds for this filter.

    Parameters
    ----------
    runs : SimulatedRuns
        What the filters will be fed.
    estimator : SlamEstimator
        One of them.
    at_once : bool
        Whether all are in memory together; the beliefs at their ends are in any case.

    Raises
    ------
    ValueError
        Where they are more than the filter's ``belief_limit``.
    MemoryError
        With what it takes, and what is available.
    """
    read = runs.visible.any(axis=1).sum(axis=1).tolist()  # by each run
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
    """Refuse a run at whose end the belief would be one that the filter refuses."""
    if isinstance(estimator, SupportsBeliefLimit):
        refuse_large_belief(landmarks, estimator.belief_limit, "take fewer steps")
