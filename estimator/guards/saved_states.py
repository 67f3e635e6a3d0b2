"""Declared saved states: what each entry must be, checked by name before it is used."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from ...argument_checks import as_floats, identities
from ...arrays import LARGEST_IN_STATE, Array, IntArray

#: Tolerance of a negative eigenvalue, relative to the trace, or to 1 if it is less.
ROUNDING = 1e-9


#: A length, or a letter for one: "n", or "3+2n" for 3 + 2n.  Its first use sets it.
Size = int | str


class Kind(NamedTuple):
    """What the numbers of an entry are."""

    #: As they are saved.
    dtype: type[np.generic]
    #: Returns a copy of a value by its name and shape, or refuses it.
    checked: Callable[[str, Any, tuple[int, ...]], Any]


#: The kind and the shape of each entry of a state, in the order of the checks.
Table = Mapping[str, tuple[Kind, *tuple[Size, ...]]]


def read(
    state: Mapping[str, Any],
    table: Table,
    prefix: str = "",
    *,
    of: Mapping[str, str] | None = None,
    **sizes: int,
) -> dict[str, Any]:
    """Return copies of the entries that a table declares, or refuse one by its name.

    Parameters
    ----------
    state : mapping
        The saved state, or a part of one.
    table : mapping
        What its entries must be.
    prefix : str
        Precedes their keys in messages.
    of : mapping, optional
        Classes that the state must name, by their keys.
    **sizes : int
        Those known beforehand.

    Examples
    --------
    >>> table = {"ids": (IDS, "n"), "mean": (NUMBERS, "3+2n")}
    >>> read({"ids": np.array([7]), "mean": np.zeros(5)}, table)["ids"]
    [7]
    >>> read({"ids": np.array([7]), "mean": np.zeros(4)}, table)
    Traceback (most recent call last):
    ValueError: state['mean'] must have shape (5,), got shape (4,)
    """
    refuse_other_state(state, table, prefix, **(of or {}))
    found = {}
    for key, (kind, *shape) in table.items():
        lengths = tuple(_length(size, sizes) for size in shape)
        found[key] = kind.checked(prefix + key, state[key], lengths)
        for size, length in zip(shape, np.shape(found[key]), strict=True):
            sizes.setdefault(str(size), length)
    return found


def write(values: Mapping[str, Any], table: Table) -> dict[str, Any]:
    """Return copies of the entries that a table declares, as arrays.

    A set is saved in order, and a mapping as its pairs.
    """
    saved = {}
    for key, (kind, *shape) in table.items():
        value = values[key]
        if isinstance(value, set | Mapping):
            value = sorted(value) if isinstance(value, set) else list(value.items())
        array = np.array(value, dtype=kind.dtype)
        if array.ndim < len(shape):  # an empty list of rows
            array = array.reshape([_length(size, {}) for size in shape])
        saved[key] = array
    return saved


def _length(size: Size, known: Mapping[str, int]) -> int:
    """Return a length, -1 if it is not known yet."""
    if isinstance(size, int):
        return size
    first, _, rest = size.rpartition("+")
    factor, name = rest[:-1], rest[-1]
    length = known.get(name, -1)
    return length if length < 0 else int(first or 0) + int(factor or 1) * length


def refuse_other_state(
    state: Mapping[str, Any], entries: Iterable[str], prefix: str = "", **classes: str
) -> None:
    """Refuse a saved state that lacks an entry, or is of other classes than these.

    The prefix precedes the keys in the message.
    """
    if not isinstance(state, Mapping):
        raise ValueError(f"state must be a mapping, got {state!r}")
    for key in (*classes, *entries):
        if key not in state:
            held = sorted(map(str, state))
            raise ValueError(f"state must hold {prefix + key!r}, got {held}")
    for key, name in classes.items():
        if str(state[key]) != name:
            raise ValueError(f"state is of {state[key]}, not of {name}")


def array(name: str, value: Any, shape: tuple[int, ...] | None = None) -> Array:
    """Return a copy of a finite float64 array, or refuse it.

    The shape is any without one; -1 is any length.
    """
    numbers = as_floats(f"state[{name!r}]", value)
    if shape is not None:
        _refuse_shape(name, numbers.shape, shape)
    if not np.isfinite(numbers).all():
        raise ValueError(f"state[{name!r}] must be finite")
    if (np.abs(numbers) > LARGEST_IN_STATE).any():
        raise ValueError(f"state[{name!r}] must not exceed {LARGEST_IN_STATE:g}")
    return numbers.copy()


def symmetric(name: str, value: Any, shape: tuple[int, ...]) -> Array:
    """Return a copy of a symmetric array, or refuse it."""
    P = array(name, value, shape)
    if not np.array_equal(P, P.T):
        raise ValueError(f"state[{name!r}] must be symmetric")
    return P


def covariance(name: str, value: Any, shape: tuple[int, ...]) -> Array:
    """Return a copy of a symmetric, positive semidefinite array, or refuse it."""
    P = symmetric(name, value, shape)
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
    slack = ROUNDING * np.maximum(1.0, np.trace(P, axis1=-2, axis2=-1))
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
    _refuse_shape(name, numbers.shape, shape)
    if least is not None and numbers.size and numbers.min() < least:
        raise ValueError(
            f"state[{name!r}] must be whole numbers >= {least}, got {numbers.min()}"
        )
    return numbers.astype(np.int64)


def landmark_ids(name: str, value: Any, shape: tuple[int, ...] = (-1,)) -> list[int]:
    """Return identities without repetition as Python integers, or refuse them."""
    ids = whole_numbers(name, value, shape).tolist()
    if len(set(ids)) < len(ids):
        raise ValueError(f"state[{name!r}] must not repeat an identity, got {ids}")
    return identities(ids, len(ids))


def flag(name: str, value: Any) -> bool:
    """Return a truth value of a state, or refuse it."""
    given = np.asarray(value)
    if given.shape or given.dtype.kind not in "biuf" or given not in (0, 1):
        raise ValueError(f"state[{name!r}] must be True or False, got {value!r}")
    return bool(given)


def _refuse_shape(name: str, given: tuple[int, ...], wanted: tuple[int, ...]) -> None:
    if len(given) != len(wanted) or any(
        w not in (-1, g) for w, g in zip(wanted, given, strict=True)
    ):
        raise ValueError(f"state[{name!r}] must have shape {wanted}, got shape {given}")


NUMBERS = Kind(np.float64, array)
SYMMETRIC = Kind(np.float64, symmetric)
COVARIANCE = Kind(np.float64, covariance)
WHOLE = Kind(np.int64, whole_numbers)
COUNTS = Kind(np.int64, partial(whole_numbers, least=0))
IDS = Kind(np.int64, landmark_ids)

#: What a saved map of a pose and n landmarks must be.
MAP_STATE: Table = {
    "landmark_ids": (IDS, "n"),
    "mean": (NUMBERS, "3+2n"),
    "covariance": (COVARIANCE, "3+2n", "3+2n"),
    "reference": (NUMBERS, "3+2n"),
}


# --------------------------------------------------------------------------------------
# Saved states inside saved states, distinguished by a prefix of their keys.


def with_prefix(name: str, state: Mapping[str, Any], mark: str = ".") -> dict[str, Any]:
    """Return a state whose keys begin with a name and a dot, or another mark.

    Examples
    --------
    >>> with_prefix("filter", {"mean": 1})
    {'filter.mean': 1}
    """
    return {f"{name}{mark}{key}": value for key, value in state.items()}


def without_prefix(
    state: Mapping[str, Any], name: str, mark: str = "."
) -> dict[str, Any]:
    """Return the part of a state that :func:`with_prefix` has given this name."""
    start = name + mark
    return {k.removeprefix(start): v for k, v in state.items() if k.startswith(start)}
