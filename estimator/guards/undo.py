"""Calls that change all of a state or nothing, also where an interrupt ends them."""

from collections.abc import Callable
from typing import Any

from .argument_checks import with_copies

#: What takes back later changes; it may be called more than once.
Undo = Callable[[], None]


class undone_on_error:  # noqa: N801 (reads as a verb, in a with statement)
    """Take back what the block has changed if it raises, even `KeyboardInterrupt`.

    With ``unless_moved``, only if this filter has not taken another step.
    """

    def __init__(self, undo: Undo, unless_moved: Any = None) -> None:
        self._undo, self._slam = undo, unless_moved
        self._steps = getattr(unless_moved, "steps", None)

    def __enter__(self) -> None:
        """Begin the block."""

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        """Take back the changes if there is an error."""
        if kind is not None and getattr(self._slam, "steps", None) == self._steps:
            to_the_end(self._undo)


def to_the_end(call: Callable[[], object]) -> None:
    """Call a function, once more if an interrupt ends it."""
    try:
        call()
    except KeyboardInterrupt:
        to_the_end(call)
        raise


def undo_all(*undos: Undo) -> Undo:
    """Return what takes back the changes of several parts."""

    def undo() -> None:
        for each in undos:
            each()

    return undo


def attributes(*objects: object) -> Undo:
    """Return what restores the attributes of objects, for those that only replace them.

    Arrays, lists, dicts and sets must not be changed in place; see :func:`contents`.
    """
    before = [(values := vars(each), values.copy()) for each in objects]

    def undo() -> None:
        for values, old in before:
            values.update(old)

    return undo


def contents(*objects: object) -> Undo:
    """Return what restores the attributes of objects, with their arrays and lists.

    Examples
    --------
    >>> class Count:
    ...     def __init__(self):
    ...         self.numbers = [1]
    >>> count = Count()
    >>> undo = contents(count)
    >>> count.numbers.append(2)
    >>> undo()
    >>> count.numbers
    [1]
    """
    before = [(vars(each), with_copies(vars(each))) for each in objects]

    def undo() -> None:
        for values, old in before:
            values.update(with_copies(old))

    return undo
