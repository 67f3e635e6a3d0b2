"""Headings of columns that are labels of estimators, however long."""

from collections.abc import Sequence
from string import ascii_uppercase

_ROOM = 36  # characters for all columns of a terminal of 80
_GAP = 2


def headings_and_key(labels: Sequence[str]) -> tuple[list[str], str]:
    r"""Return the headings of columns, and the key that explains short ones.

    Labels that fit beside each other are headings themselves, and the key is empty.
    Else the headings are letters, and the key has a line for each.

    Examples
    --------
    >>> headings_and_key(["ekf", "invariant"])
    (['ekf', 'invariant'], '')
    >>> headings, key = headings_and_key(["ekf", "invariant[iterations=3]", "iterated"])
    >>> print(headings, key, sep="\n")
    ['A', 'B', 'C']
    A  ekf
    B  invariant[iterations=3]
    C  iterated
    """
    fits = sum(len(label) + _GAP for label in labels) <= _ROOM
    if fits or len(labels) > len(ascii_uppercase):
        return list(labels), ""
    letters = ascii_uppercase[: len(labels)]
    lines = [
        f"{letter}  {label}" for letter, label in zip(letters, labels, strict=True)
    ]
    return list(letters), "\n".join(lines)
