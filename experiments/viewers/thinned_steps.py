"""Items of the steps of a run, all of them or evenly spaced ones."""

from typing import Generic, TypeVar

_Item = TypeVar("_Item")


class ThinnedSteps(Generic[_Item]):
    """Items by step; where they become too many, every second one is dropped.

    Parameters
    ----------
    most_steps : int
        Largest number of items, the last one not counted.
    most_size : int
        Largest sum of their sizes; at least two items are kept.
    last : int
        The last step, which is always kept.

    Examples
    --------
    >>> kept = ThinnedSteps(most_steps=3, most_size=100, last=8)
    >>> for step in range(9):
    ...     if kept.is_due(step):
    ...         kept.put(step, f"map {step}", size=1)
    >>> list(kept.items), kept.stride
    ([0, 4, 8], 4)
    """

    def __init__(self, most_steps: int, most_size: int, last: int) -> None:
        self._most_steps, self._most_size, self._last = most_steps, most_size, last
        self._sizes: dict[int, int] = {}
        self.items: dict[int, _Item] = {}
        """The kept items, by their steps in ascending order."""
        self.stride = 1
        """Steps between two items."""

    def is_due(self, step: int) -> bool:
        """Whether the item of a step will be kept."""
        return step % self.stride == 0 or step == self._last

    def put(self, step: int, item: _Item, size: int) -> None:
        """Keep the item of a step that is due."""
        self.items[step], self._sizes[step] = item, size
        while len(self.items) > 2 and self._is_full():
            self.stride *= 2
            for old in [k for k in self.items if not self.is_due(k)]:
                del self.items[old], self._sizes[old]

    def _is_full(self) -> bool:
        too_many = len(self.items) > self._most_steps + 1
        return too_many or sum(self._sizes.values()) > self._most_size
