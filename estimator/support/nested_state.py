"""Saved states inside saved states, distinguished by a prefix of their keys."""

from collections.abc import Mapping
from typing import Any


def with_prefix(name: str, state: Mapping[str, Any]) -> dict[str, Any]:
    """Return a state whose keys begin with a name and a dot.

    Examples
    --------
    >>> with_prefix("filter", {"mean": 1})
    {'filter.mean': 1}
    """
    return {f"{name}.{key}": value for key, value in state.items()}


def without_prefix(state: Mapping[str, Any], name: str) -> dict[str, Any]:
    """Return the part of a state that :func:`with_prefix` has given this name."""
    start = f"{name}."
    return {k.removeprefix(start): v for k, v in state.items() if k.startswith(start)}
