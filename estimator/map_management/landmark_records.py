"""Records that landmark management keeps of each mapped landmark."""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from ...arrays import Array, IntArray
from ..support import saved_states


class LandmarkRecords:
    """Sightings, misses and information of the landmarks, in the order of the map.

    The information of a landmark is its block of the information matrix, summed over
    all its readings with the pose of the robot taken as known::

        Λ = Σ H_lᵀ Q⁻¹ H_l,   H_l = [a / r; e]
        content = ½ ln det Λ

    with the unit vectors e towards the landmark and a across.  This information is lost
    when the landmark is marginalised and never seen again.

    Examples
    --------
    >>> records = LandmarkRecords()
    >>> records.follow([7, 9])
    >>> ahead, across = np.zeros(2), np.ones(2)
    >>> records.note_sightings([7, 9], ahead, np.array([4.0, 9.0]), across)
    >>> records.by_information([9, 7])
    [7, 9]
    """

    def __init__(self) -> None:
        self.ids: tuple[int, ...] = ()
        self.sightings: IntArray = np.zeros(0, dtype=np.int64)
        self.misses: IntArray = np.zeros(0, dtype=np.int64)
        self.information: Array = np.zeros((0, 3))
        self._slots: dict[int, int] = {}

    def follow(self, ids: Sequence[int]) -> None:
        """Adopt the order of the map: keep records of its landmarks, start new ones."""
        if self.ids == tuple(ids):
            return
        old = {i: k for k, i in enumerate(self.ids)}
        rows = np.array([old.get(i, -1) for i in ids], dtype=np.int64)
        fresh = rows < 0
        for name in ("sightings", "misses", "information"):
            before = getattr(self, name)
            after = np.zeros((len(rows), *before.shape[1:]), dtype=before.dtype)
            after[~fresh] = before[rows[~fresh]]
            setattr(self, name, after)
        self.ids = tuple(ids)
        self._slots = {i: k for k, i in enumerate(self.ids)}

    def note_sightings(
        self, ids: Sequence[int], bearings: Array, along: Array, across: Array
    ) -> None:
        """Count one sighting of each landmark; all arrays have shape (m,).

        Parameters
        ----------
        ids : sequence of int
            The landmarks, without repetition.
        bearings : ndarray
            Directions in the world frame in which they were seen [rad].
        along, across : ndarray
            Information of each reading along the line of sight and across it [1/m²].
        """
        slots = self.slots(ids)
        cos, sin = np.cos(bearings), np.sin(bearings)
        self.sightings[slots] += 1
        self.misses[slots] = 0
        self.information[slots, 0] += along * cos * cos + across * sin * sin
        self.information[slots, 1] += (along - across) * cos * sin
        self.information[slots, 2] += along * sin * sin + across * cos * cos

    def slots(self, ids: Iterable[int]) -> IntArray:
        """Return the places of landmarks in the order of the map."""
        return np.array([self._slots[i] for i in ids], dtype=np.int64)

    def note_misses(self, slots: IntArray) -> None:
        """Count one miss of each landmark: a scan should have shown it and did not."""
        self.misses[slots] += 1

    def overdue(self, misses: int) -> list[int]:
        """Return the landmarks missed at least ``misses`` times since last seen."""
        return [self.ids[k] for k in np.flatnonzero(self.misses >= misses)]

    def join(self, kept: int, gone: int) -> None:
        """Add the records of one landmark to those of another."""
        i, j = self._slots[kept], self._slots[gone]
        self.sightings[i] += self.sightings[j]
        self.information[i] += self.information[j]
        self.misses[i] = min(self.misses[i], self.misses[j])

    def by_information(self, ids: Sequence[int]) -> list[int]:
        """Sort landmarks by information, the least first, of equals the newest."""
        xx, xy, yy = self.information[self.slots(ids)[::-1]].T
        order = np.argsort(xx * yy - xy * xy, kind="stable")
        return [ids[len(ids) - 1 - k] for k in order.tolist()]

    def state_dict(self) -> dict[str, Any]:
        """Return copies of all records, as arrays."""
        return {
            "ids": np.array(self.ids, dtype=np.int64),
            "sightings": self.sightings.copy(),
            "misses": self.misses.copy(),
            "information": self.information.copy(),
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore what :meth:`state_dict` returned; refuse what does not fit."""
        ids = saved_states.landmark_ids("landmarks.ids", state["ids"])
        count = len(ids)
        sightings, misses = (
            saved_states.whole_numbers(f"landmarks.{key}", state[key], (count,), 0)
            for key in ("sightings", "misses")
        )
        information = saved_states.array(
            "landmarks.information", state["information"], (count, 3)
        )
        self.ids = tuple(ids)
        self._slots = {i: k for k, i in enumerate(ids)}
        self.sightings, self.misses = sightings, misses
        self.information = information
