"""Words of the user and for the user: import a path, suggest a name, count things."""

import sys
from collections.abc import Iterable
from difflib import SequenceMatcher
from importlib import import_module
from itertools import islice
from operator import attrgetter
from typing import Any

_SIMILAR = 0.6  # of at most 1

#: Folders in which `imported` looks for modules, after those of Python.
FOLDERS: list[str] = []


def closest(word: str, words: Iterable[str], *, else_all: bool = False) -> str:
    """Return the suggestion that ends an error message, empty if no word is similar.

    Upper and lower case count as equal, and a word is similar to what it begins. Words
    that are equally similar are all suggested. If none is similar, ``else_all`` lists
    all words, the most similar ones first.

    Examples
    --------
    >>> closest("max_rage", ["min_range", "max_range"])
    "; did you mean 'max_range'?"
    >>> closest("range", ["min_range", "max_range"])
    "; did you mean 'min_range' or 'max_range'?"
    >>> closest("EKF", ["ekf", "invariant"])
    "; did you mean 'ekf'?"
    >>> closest("GATE", ["range", "gate_probability"])
    "; did you mean 'gate_probability'?"
    >>> closest("zzz", ["min_range", "max_range"])
    ''
    >>> closest("fov", ["kind", "std", "field_of_view"], else_all=True)
    '; known are field_of_view, kind, std'
    """
    known = {name.lower(): name for name in words}
    matcher = SequenceMatcher(b=word.lower())
    likeness = {}
    for name in known:
        matcher.set_seq1(name)
        likeness[name] = matcher.ratio()
    best = max(likeness.values(), default=0.0)
    if best >= _SIMILAR:
        nearest = [name for name in known if likeness[name] == best]
    else:
        beginning = (name for name in known if word and name.startswith(word.lower()))
        nearest = list(islice(beginning, 1))
    suggested = " or ".join(f"'{known[name]}'" for name in nearest)
    if nearest or not else_all:
        return f"; did you mean {suggested}?" if nearest else ""
    ranked = sorted(known, key=lambda name: -likeness[name])
    return f"; known are {', '.join(known[name] for name in ranked)}"


def imported(path: str, refusal: str, *, kind: bool = False) -> Any:
    """Return what an import path "module:NAME" names, or "module:NAME.PART".

    Raises
    ------
    ValueError
        If it cannot be imported: the refusal, perhaps the kind of the error, the
        error, and what to do if the module lies in another folder.

    Examples
    --------
    >>> imported("math:tau", "no such number: ") == 2 * imported("math:pi", "")
    True
    """
    module, _, name = path.partition(":")
    if module.partition(".")[0] != __package__:
        sys.path.extend(folder for folder in FOLDERS if folder not in sys.path)
    try:
        return attrgetter(name)(import_module(module))
    except Exception as error:
        of_kind = f"{type(error).__name__}: " if kind else ""
        file = module.split(".")[0]
        is_elsewhere = isinstance(error, ModuleNotFoundError) and error.name == file
        hint = f"; run in the folder of {file}.py, or set PYTHONPATH"
        raise ValueError(
            f"{refusal}{of_kind}{error}{hint if is_elsewhere else ''}"
        ) from error


def counted(count: int, noun: str) -> str:
    """Write how many there are of something.

    Examples
    --------
    >>> counted(1, "run"), counted(2, "run")
    ('1 run', '2 runs')
    """
    return f"{count} {noun}{'s' * (count != 1)}"
