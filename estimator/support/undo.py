"""Calls that change all of a state or nothing, also where an interrupt ends them."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from copy import copy

import numpy as np

Undo = Callable[[], None]
"""What takes back later changes; it may be called more than once."""


@contextmanager
def undone_on_error(undo: Undo) -> Iterator[None]:
    """Take back what the block has changed if it raises, even `KeyboardInterrupt`."""
    try:
        yield
    except BaseException:
        _to_the_end(undo)
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
    before = [(each, dict(vars(each))) for each in objects]

    def undo() -> None:
        for each, values in before:
            vars(each).update(values)

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
    before = [
        (each, {name: _kept(value) for name, value in vars(each).items()})
        for each in objects
    ]

    def undo() -> None:
        for each, values in before:
            vars(each).update(values)

    return undo


def _kept(value: object) -> object:
    is_changed_in_place = isinstance(value, np.ndarray | list | dict | set)
    return copy(value) if is_changed_in_place else value


def _to_the_end(undo: Undo) -> None:
    """Call a function once more if an interrupt ends it."""
    try:
        undo()
    except KeyboardInterrupt:
        _to_the_end(undo)
        raise
