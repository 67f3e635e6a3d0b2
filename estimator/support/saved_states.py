"""Checks of saved states, with messages that name the entry."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from ...arrays import LARGEST_IN_STATE, Array, IntArray
from .argument_checks import as_floats, identities

ROUNDING = 1e-9
"""Tolerance of a negative eigenvalue, relative to the trace, or to 1 if it is less."""


def refuse_other_state(
    state: Mapping[str, Any], entries: Iterable[str], **classes: str
) -> None:
    """Refuse a saved state that lacks an entry, or is of other classes than these."""
    if not isinstance(state, Mapping):
        raise ValueError(f"state must be a mapping, got {state!r}")
    for key in (*classes, *entries):
        if key not in state:
            raise ValueError(f"state must hold {key!r}, got {sorted(map(str, state))}")
    for key, name in classes.items():
        if str(state[key]) != name:
            raise ValueError(f"state is of {state[key]}, not of {name}")


def array(name: str, value: Any, shape: tuple[int, ...] | None = None) -> Array:
    """Return a copy of a finite float64 array, or refuse it.

    The shape is any without one; -1 is any length.
    """
    numbers = as_floats(f"state[{name!r}]", value)
    if shape is not None:
        _refuse_other_shape(name, numbers.shape, shape)
    if not np.isfinite(numbers).all():
        raise ValueError(f"state[{name!r}] must be finite")
    if (np.abs(numbers) > LARGEST_IN_STATE).any():
        raise ValueError(f"state[{name!r}] must not exceed {LARGEST_IN_STATE:g}")
    return numbers.copy()


def covariance(name: str, value: Any, size: int, *, semidefinite: bool = True) -> Array:
    """Return a copy of a symmetric (size, size) array, positive semidefinite or not."""
    P = array(name, value, (size, size))
    if not np.array_equal(P, P.T):
        raise ValueError(f"state[{name!r}] must be symmetric")
    if semidefinite:
        refuse_indefinite(f"state[{name!r}]", P)
    return P


def refuse_indefinite(name: str, P: Array) -> None:
    """Refuse a symmetric matrix with an eigenvalue < 0, except for rounding."""
    if not is_semidefinite(P):
        raise ValueError(
            f"{name} must be positive semidefinite, got the eigenvalue "
            f"{float(np.linalg.eigvalsh(P)[0]):.3g}"
        )


def is_semidefinite(P: Array) -> bool:
    """Return whether symmetric matrices (…, n, n) have no eigenvalue < 0.

    Examples
    --------
    >>> is_semidefinite(np.diag([1.0, 0.0])), is_semidefinite(np.diag([1.0, -1.0]))
    (True, False)
    """
    size = P.shape[-1]
    if not P.size:
        return True
    trace = np.trace(P, axis1=-2, axis2=-1)
    slack = ROUNDING * np.maximum(1.0, trace)
    try:
        np.linalg.cholesky(P + slack[..., None, None] * np.eye(size))
    except np.linalg.LinAlgError:
        return False
    return True


def whole_numbers(
    name: str, value: Any, shape: tuple[int, ...] = (-1,), least: int | None = None
) -> IntArray:
    """Return a copy of an int64 array, or refuse it; -1 is any length."""
    numbers = np.asarray(value) if not isinstance(value, str) else np.array(value)
    if numbers.dtype.kind not in "iu" and numbers.size:
        raise ValueError(f"state[{name!r}] must be whole numbers, got {value!r}")
    _refuse_other_shape(name, numbers.shape, shape)
    if least is not None and numbers.size and numbers.min() < least:
        raise ValueError(
            f"state[{name!r}] must be whole numbers >= {least}, got {numbers.min()}"
        )
    return numbers.astype(np.int64)


def whole_number(name: str, value: Any, least: int = 0) -> int:
    """Return a whole number of a state, or refuse it."""
    return int(whole_numbers(name, value, (), least))


def landmark_ids(name: str, value: Any) -> list[int]:
    """Return identities without repetition as Python integers, or refuse them."""
    ids = whole_numbers(name, value).tolist()
    if len(set(ids)) < len(ids):
        raise ValueError(f"state[{name!r}] must not repeat an identity, got {ids}")
    return identities(ids, len(ids))


def flag(name: str, value: Any) -> bool:
    """Return a truth value of a state, or refuse it."""
    given = np.asarray(value)
    if given.shape != () or given.dtype.kind not in "biuf" or given not in (0, 1):
        raise ValueError(f"state[{name!r}] must be True or False, got {value!r}")
    return bool(given)


def _refuse_other_shape(
    name: str, given: tuple[int, ...], wanted: tuple[int, ...]
) -> None:
    if len(given) != len(wanted) or any(
        w not in (-1, g) for w, g in zip(wanted, given, strict=True)
    ):
        raise ValueError(f"state[{name!r}] must have shape {wanted}, got shape {given}")


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
