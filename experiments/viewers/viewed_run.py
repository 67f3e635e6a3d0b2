"""A filter's run as the viewers take it, and the steps that they show."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ..runs.trace import RunTrace
from .run_frames import MapFrame, RunFrames


class ViewedRun(NamedTuple):
    """One filter's run over the log of the page."""

    trace: RunTrace
    """Its beliefs; its name labels the filter."""
    frames: RunFrames
    """What it watched of the same replay."""


def shown_steps(frames: Sequence[RunFrames]) -> list[int]:
    """Return the steps that all filters have kept, in ascending order."""
    return sorted(set.intersection(*(set(kept.maps) for kept in frames)))


def map_at(run: ViewedRun, step: int) -> MapFrame:
    """Return the map of a step; of a filter that joins its map, the last joined one."""
    frame = run.frames.maps[step]
    if not run.frames.joins:
        return frame
    ids, means, covariances = run.trace.map_at(step)
    return frame._replace(
        ids=ids.astype(np.int64), means=means, covariances=covariances
    )
