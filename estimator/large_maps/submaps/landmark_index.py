"""Slot of each landmark in the whole map, and names of removed landmarks.

A landmark that several submaps hold connects them.  If it is removed, it remains as a
*link*: it keeps its slot and, in the active submap, has a name that no landmark can
have.  No belief contains it, and the same landmark seen again is a new one.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence

import numpy as np

from ....arrays import IntArray
from ...support.argument_checks import LOWEST_ID, LandmarkIds, refuse_reserved
from ...support.undo import Undo


class LandmarkIndex(Mapping[int, int]):
    """Slot of each mapped landmark, in the order of the map; slots are not reused.

    Parameters
    ----------
    slots : mapping
        Slot by landmark, in ascending order.
    count : int
        Number of slots assigned so far.

    Examples
    --------
    >>> index = LandmarkIndex()
    >>> index.add([7, 9])
    >>> index.remove(7)
    0
    >>> index.add([7])
    >>> dict(index)
    {9: 1, 7: 2}
    """

    def __init__(self, slots: Mapping[int, int] | None = None, count: int = 0) -> None:
        self._slots, self.count = dict(slots or {}), count

    def __getitem__(self, landmark_id: int) -> int:
        return self._slots[landmark_id]

    def __iter__(self) -> Iterator[int]:
        return iter(self._slots)

    def __len__(self) -> int:
        return len(self._slots)

    def __contains__(self, landmark_id: object) -> bool:
        return landmark_id in self._slots  # faster than that of Mapping

    def add(self, landmark_ids: Iterable[int]) -> None:
        """Assign a slot to each new landmark."""
        for i in landmark_ids:
            self._slots[i] = self.count
            self.count += 1

    def remove(self, landmark_id: int) -> int:
        """Remove a landmark; return its slot, which is not used again."""
        slots = dict(self._slots)
        slot = slots.pop(landmark_id)
        self._slots = slots
        return slot

    def checkpoint(self) -> Undo:
        """Return what takes back later changes, at a cost of the landmarks added."""
        slots, count = self._slots, self.count

        def undo() -> None:
            while slots and slots[next(reversed(slots))] >= count:
                slots.popitem()
            self._slots, self.count = slots, count

        return undo

    def slots_of(self, names: Sequence[int]) -> IntArray:
        """Return the slots of landmarks and links by their names, shape (n,)."""
        slots = (self._slots.get(name) for name in names)
        known = [
            slot_of_link(name) if slot is None else slot
            for name, slot in zip(names, slots, strict=True)
        ]
        return np.array(known, dtype=np.int64)

    def links(self, names: Iterable[int]) -> set[int]:
        """Return the names in a submap that are not landmarks."""
        return {name for name in names if name not in self._slots}


def link_name(slot: int) -> int:
    """Return the name of a removed landmark in the active submap.

    Examples
    --------
    >>> slot_of_link(link_name(5))
    5
    """
    return slot + LOWEST_ID


def slot_of_link(name: int) -> int:
    """Return the slot of a link."""
    return name - LOWEST_ID


def refuse_link_names(landmark_ids: LandmarkIds | None) -> None:
    """Raise a ValueError for identities in the range of link names."""
    ids = np.asarray(() if landmark_ids is None else landmark_ids)
    if ids.dtype.kind == "i":
        refuse_reserved(ids.ravel().tolist())
