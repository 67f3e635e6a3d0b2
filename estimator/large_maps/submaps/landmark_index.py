"""Where each landmark stands in the whole map, and what becomes of one removed.

A landmark that several submaps hold ties them together.  When it is removed that tie
stays, as a *link*: it keeps its slot, and in the present submap a name that no landmark
has; but no belief tells of it, and the same landmark seen again is a new one.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from ...support.argument_checks import LOWEST_ID, LandmarkIds, refuse_reserved

Int = NDArray[np.int64]


class Slots(Mapping[int, int]):
    """The slot of each mapped landmark, in the order of the map; none is used twice.

    Parameters
    ----------
    slots : mapping
        By landmark, in ascending order.
    count : int
        Of the slots that have been given so far.

    Examples
    --------
    >>> slots = Slots()
    >>> slots.add([7, 9])
    >>> slots.remove(7)
    0
    >>> slots.add([7])
    >>> dict(slots)
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
        """Give new landmarks a slot each."""
        for i in landmark_ids:
            self._slots[i] = self.count
            self.count += 1

    def remove(self, landmark_id: int) -> int:
        """Forget a landmark; return its slot, which stays taken."""
        return self._slots.pop(landmark_id)

    def of(self, names: Sequence[int]) -> Int:
        """Return the slots of landmarks, and of links by their names, shape (n,)."""
        slots = (self._slots.get(name) for name in names)
        known = [
            slot_of_link(name) if slot is None else slot
            for name, slot in zip(names, slots, strict=True)
        ]
        return np.array(known, dtype=np.int64)

    def links(self, names: Iterable[int]) -> set[int]:
        """Return those names in a submap that are of no landmark."""
        return {name for name in names if name not in self._slots}


def link_name(slot: int) -> int:
    """Return the name of a removed landmark within the present submap.

    Examples
    --------
    >>> slot_of_link(link_name(5))
    5
    """
    return slot + LOWEST_ID


def slot_of_link(name: int) -> int:
    """Return the slot of a link by its name."""
    return name - LOWEST_ID


def refuse_link_names(landmark_ids: LandmarkIds | None) -> None:
    """Refuse identities as low as the names of links are."""
    ids = np.asarray(() if landmark_ids is None else landmark_ids)
    if ids.dtype.kind == "i":
        refuse_reserved(ids.ravel().tolist())
