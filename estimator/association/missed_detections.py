"""The cost of landmarks that a scan should have shown and did not.

An assignment that leaves a landmark without a reading, although the sensor sees it with
probability P_D, is less likely by the factor 1 − P_D::

    cost = −2 Σ ln(1 − P_D(β, r))

P_D is the share of expected landmarks that the scans so far have shown, in cells of
bearing and range up to the longest reading, each with one sighting in two tries to
begin with.  A landmark counts as expected with the least P_D within two σ of where it
should be seen; one that may be out of view costs nothing.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from ...arrays import Array, BoolArray, IntArray
from ...jit import jit
from ..interface import MapView
from ..models.bearing_range import reading_slopes_jit, wrap_angle_jit
from ..support import saved_states

SECTORS, RINGS = 16, 8
"""Cells over the bearings, and over the ranges up to the longest reading."""

WIDEST = np.pi / 4
"""A bearing whose two σ are wider than this says nothing [rad]."""

SUREST = 0.95
"""Largest P_D: something may stand before a landmark."""


class Detections(NamedTuple):
    """How many expected landmarks the scans have shown.

    Examples
    --------
    >>> view = MapView(np.array([0, 0, 0, 4.5, 0.5]), 1e-6 * np.eye(5), (7,))
    >>> detections = Detections.none()
    >>> for slot in (0, 0, 0, -1):
    ...     cost, detections = detections.after(view, np.array([slot]), longest=8.0)
    >>> round(cost, 2)  # −2 ln(1 − 4 / 5)
    3.22
    """

    seen: Array
    """Shape (SECTORS, RINGS)."""
    expected: Array
    """Shape (SECTORS, RINGS)."""

    @classmethod
    def none(cls) -> Detections:
        """Return the state before the first scan."""
        return cls(np.zeros((SECTORS, RINGS)), np.zeros((SECTORS, RINGS)))

    def after(
        self, view: MapView, slots: IntArray, longest: float
    ) -> tuple[float, Detections]:
        """Count one scan; return the cost of the landmarks that it has missed, too.

        Parameters
        ----------
        view : MapView
            The map before the scan.
        slots : ndarray of int64, shape (m,)
            Its landmarks that the rows of the scan show; below 0: none.
        longest : float
            Longest range read so far [m].
        """
        is_seen = np.zeros(len(view.ids), dtype=np.bool_)
        is_seen[slots[slots >= 0]] = True
        after = Detections(self.seen.copy(), self.expected.copy())
        cost = _count(view.mean, view.covariance, is_seen, longest, self, after)
        return cost, after

    def state_dict(self) -> dict[str, Array]:
        """Return copies of all, as arrays."""
        return {"detected": self.seen.copy(), "expected": self.expected.copy()}

    @classmethod
    def from_state_dict(cls, state: Mapping[str, Any]) -> Detections:
        """Restore what :meth:`state_dict` returned; refuse what does not fit."""
        shape = SECTORS, RINGS
        seen = saved_states.array("tentative.detected", state["detected"], shape)
        expected = saved_states.array("tentative.expected", state["expected"], shape)
        if not ((seen >= 0) & (seen <= expected)).all():
            raise ValueError(
                "state['tentative.detected'] must be >= 0, and at most "
                "state['tentative.expected']"
            )
        return cls(seen, expected)


@jit
def _count(
    mean: Array,
    P: Array,
    is_seen: BoolArray,
    longest: float,
    before: Detections,
    after: Detections,
) -> float:
    seen, expected = before.seen, before.expected
    cost = 0.0
    sectors, rings = seen.shape
    wide, deep = 2 * np.pi / sectors, longest / rings
    for j in range(len(is_seen)):
        c = 3 + 2 * j
        dx, dy = mean[c] - mean[0], mean[c + 1] - mean[1]
        distance = np.hypot(dx, dy)
        if not 0 < distance < longest:
            continue
        slopes = reading_slopes_jit(dx, dy)
        xx = P[0, 0] + P[c, c] - 2 * P[0, c]
        yy = P[1, 1] + P[c + 1, c + 1] - 2 * P[1, c + 1]
        xy = P[0, 1] + P[c, c + 1] - P[0, c + 1] - P[1, c]
        gx, gy = P[2, c] - P[2, 0], P[2, c + 1] - P[2, 1]
        x, y = slopes[2], slopes[3]
        aside = 2 * np.sqrt(max(x * x * xx + 2 * x * y * xy + y * y * yy, 0.0))
        if not distance + aside < longest:
            continue
        x, y = slopes[0], slopes[1]
        turn = x * x * xx + 2 * x * y * xy + y * y * yy + P[2, 2]
        turn = 2 * np.sqrt(max(turn - 2 * (x * gx + y * gy), 0.0))
        if not turn <= WIDEST:
            continue
        bearing = wrap_angle_jit(np.arctan2(dy, dx) - mean[2]) + np.pi
        first, last = int((bearing - turn) // wide), int((bearing + turn) // wide)
        near, far = max(distance - aside, 0.0) // deep, (distance + aside) // deep
        least = SUREST
        for a in range(first, last + 1):
            for b in range(int(near), min(int(far), rings - 1) + 1):
                tries, hits = expected[a % sectors, b], seen[a % sectors, b]
                least = min(least, (hits + 1) / (tries + 2))
        if not is_seen[j]:
            cost -= 2 * np.log(1 - least)
        a, b = int(bearing // wide) % sectors, min(int(distance // deep), rings - 1)
        after.expected[a, b] += 1
        after.seen[a, b] += is_seen[j]
    return cost
