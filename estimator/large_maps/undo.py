"""Undo the changes of a refused call, where a snapshot would be too large."""

from collections.abc import Callable

from ...argument_checks import with_copies

#: What takes back later changes; it may be called more than once.
Undo = Callable[[], object]


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
