"""Filters that can be copied often and cheaply."""

from __future__ import annotations

from collections.abc import Callable, Iterable

import numpy as np

from ..support.undo import Undo, contents
from .managed_slam import ManagedSlam


class FilterPool:
    """Copies managed filters, and reuses those that are no longer needed.

    Parameters
    ----------
    make : callable
        Makes a filter.
    """

    def __init__(self, make: Callable[[], ManagedSlam]) -> None:
        self._make = make
        self._spare: list[ManagedSlam] = []

    def __len__(self) -> int:
        """Return how many filters nobody uses."""
        return len(self._spare)

    def fresh(self) -> ManagedSlam:
        """Return a filter that nobody uses, in any state."""
        return self._spare.pop() if self._spare else self._make()

    def copy(self, slam: ManagedSlam) -> ManagedSlam:
        """Return another filter that continues from the same state."""
        copied = self.fresh()
        copied.copy_from(slam)
        return copied

    def checkpoint(self) -> Undo:
        """Return what takes back which filters nobody uses."""
        return contents(self)

    def free(self, slams: Iterable[ManagedSlam]) -> None:
        """Take filters back."""
        for slam in slams:
            slam.reset(np.zeros(3), np.zeros(3))  # frees its scans
            self._spare.append(slam)
