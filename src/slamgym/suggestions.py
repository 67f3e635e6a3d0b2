"""Suggest the name that was meant, for error messages."""

from collections.abc import Iterable
from difflib import get_close_matches


def closest(word: str, words: Iterable[str]) -> str:
    """Return the suggestion that ends an error message, empty if no word is similar.

    Upper and lower case count as equal, and a word is similar to what it begins.

    Examples
    --------
    >>> closest("max_rage", ["min_range", "max_range"])
    "; did you mean 'max_range'?"
    >>> closest("EKF", ["ekf", "invariant"])
    "; did you mean 'ekf'?"
    >>> closest("gate", ["range", "gate_probability"])
    "; did you mean 'gate_probability'?"
    >>> closest("zzz", ["min_range", "max_range"])
    ''
    """
    known = {name.lower(): name for name in words}
    nearest = get_close_matches(word.lower(), list(known), n=1)
    if not nearest and word:
        nearest = [name for name in known if name.startswith(word.lower())]
    return f"; did you mean '{known[nearest[0]]}'?" if nearest else ""
