"""Find the smoother in an estimator that may be managed."""

from __future__ import annotations

from ..interface import SlamEstimator, SupportsSmoothing
from ..map_management.hypotheses import HypothesisSlam


def smoother_in(slam: SlamEstimator) -> SupportsSmoothing | None:
    """Return the smoother, that of the most probable hypothesis; None without one."""
    inner = slam.best if isinstance(slam, HypothesisSlam) else slam
    return inner if isinstance(inner, SupportsSmoothing) else None
