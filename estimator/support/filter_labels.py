"""The text that names a filter and its options, as "invariant[iterations=3]"."""

from __future__ import annotations

import re
import tomllib
from typing import Any, NamedTuple

_LABEL = re.compile(r"(?P<name>[^\[\],]+)(\[(?P<options>.*)\])?", re.DOTALL)
_BARE_WORD = re.compile(r"(=\s*)(?!true\b|false\b|inf\b|nan\b)([A-Za-z_][\w-]*)")


class FilterLabel(NamedTuple):
    """A filter and its options."""

    name: str
    """Registered name or "module:Class"."""
    options: dict[str, Any]
    """Arguments of its constructor other than the noise."""


def read_label(label: str) -> FilterLabel:
    """Read one filter: a name, and perhaps options as in TOML in brackets.

    A bare word is a string.

    Raises
    ------
    ValueError
        If the text is malformed or names several filters.

    Examples
    --------
    >>> read_label("invariant[iterations=3, landmark_init=full]")
    FilterLabel(name='invariant', options={'iterations': 3, 'landmark_init': 'full'})
    """
    match = _LABEL.fullmatch(label.strip())
    if match is None:
        raise ValueError(
            f"an estimator must be like ekf or invariant[iterations=3], got '{label}'"
        )
    options = _BARE_WORD.sub(r'\1"\2"', match["options"] or "")
    try:
        table = tomllib.loads(f"options = {{ {options} }}")["options"]
    except (tomllib.TOMLDecodeError, RecursionError):
        raise ValueError(
            f"options must be like [iterations=3,sequential=true], got '{label}'"
        ) from None
    return FilterLabel(match["name"].strip(), table)


def split_labels(labels: str) -> list[str]:
    """Split a text at its commas outside brackets; empty parts are left out.

    Examples
    --------
    >>> split_labels("ekf, invariant[iterations=3,sequential=true]")
    ['ekf', 'invariant[iterations=3,sequential=true]']
    """
    parts, depth = [""], 0
    for character in labels:
        depth += {"[": 1, "]": -1}.get(character, 0)
        if character == "," and depth <= 0:
            parts.append("")
        else:
            parts[-1] += character
    return [part.strip() for part in parts if part.strip()]
