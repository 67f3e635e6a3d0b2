"""Calls that change all of a state or nothing, also where an interrupt ends them."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from copy import copy
from typing import TypeVar

import numpy as np

Result = TypeVar("Result")
Answer = TypeVar("Answer")

Undo = Callable[[], None]
"""What takes back later changes; it may be called more than once."""
Recall = Callable[[], Result | None]
"""Returns the result of a step, or None as long as the step is not done."""


@contextmanager
def undone_on_error(undo: Undo) -> Iterator[None]:
    """Take back what the block has changed if it raises, even `KeyboardInterrupt`."""
    try:
        yield
    except BaseException:
        _to_the_end(undo)
        raise


def carried_out(
    step: Callable[[], Result],
    then: Callable[[Result], Answer],
    undo: Undo,
    recall: Recall[Result] | None,
    bookmark: Callable[[], Undo],
) -> Answer:
    """Return ``then(step())``; an interrupt finds nothing done, or both.

    A compiled kernel changes a covariance in one call.  To take this back would need a
    copy of the covariance before every step; instead, what follows is brought to its
    end before the interrupt is passed on.

    Parameters
    ----------
    step : callable
        Its last change is made by a kernel.
    then : callable
        What follows, from the result of the step.
    undo : callable
        Takes back the step, as long as the kernel has not run.
    recall : callable or None
        Returns the result of the step once the kernel has run; None: ``undo`` can take
        back all.
    bookmark : callable
        Returns what takes back ``then``.
    """
    result: Result | None = None
    undo_then: Undo | None = None

    def settle() -> None:
        nonlocal result, undo_then
        if result is None and recall is not None:
            result = recall()
        if result is None or recall is None:
            undo()
            return
        if undo_then is None:
            undo_then = bookmark()
        undo_then()
        then(result)

    try:
        result = step()
        if recall is not None:
            undo_then = bookmark()
        return then(result)
    except BaseException:
        _to_the_end(settle)
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


_CHANGED_IN_PLACE = frozenset((np.ndarray, list, dict, set))


def _kept(value: object) -> object:
    return copy(value) if type(value) in _CHANGED_IN_PLACE else value


def _to_the_end(undo: Undo) -> None:
    """Call a function once more if an interrupt ends it."""
    try:
        undo()
    except KeyboardInterrupt:
        _to_the_end(undo)
        raise
