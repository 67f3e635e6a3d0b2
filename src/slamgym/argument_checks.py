"""Checks of public arguments, with messages that name the argument.

Those of every step take well-formed arguments through without a copy.
"""

from __future__ import annotations

import os
from collections.abc import Collection, Iterable, Mapping, Sequence
from math import inf, isfinite, prod
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .arrays import LARGEST, SMALLEST, AnyArray, Array, IntArray

LandmarkIds = Sequence[int] | NDArray[np.integer[Any]]

# The lowest identity that 64 bits hold, and how many from there on are no landmarks.
LOWEST_ID, RESERVED_IDS = -(2**63), 2**20

CACHE_LINE = 64  # [bytes]

_FLOAT64, _INT64 = np.dtype(np.float64), np.dtype(np.int64)


def finite_vector(name: str, value: ArrayLike, size: int) -> Array:
    """Return ``value`` as float64 (size,) of usable magnitude, or refuse it."""
    vector = as_floats(name, value)
    if vector.shape != (size,) or not np.isfinite(vector).all():
        raise ValueError(f"{name} must be {size} finite numbers, got {value!r}")
    refuse_beyond(name, vector, value)
    return vector


def standard_deviations(name: str, value: ArrayLike, size: int) -> Array:
    """Return ``value`` as float64 (size,), from 0 to the largest, or refuse it."""
    std = as_floats(name, value)
    if std.shape == (size,) and all(0.0 <= each <= LARGEST for each in std.tolist()):
        return std
    if std.shape != (size,) or not (np.isfinite(std) & (std >= 0)).all():
        raise ValueError(f"{name} must be {size} finite numbers >= 0, got {value!r}")
    refuse_beyond(name, std, value)
    return std


def duration(dt: float) -> float:
    """Return the duration of a prediction [steps], or refuse it."""
    return at_least("dt", dt, 0.0)


def refuse_beyond(name: str, array: Array, value: object) -> None:
    """Refuse finite numbers beyond the largest that filters accept."""
    if (np.abs(array) > LARGEST).any():
        raise ValueError(f"{name} must not exceed {LARGEST:g}, got {value!r}")


def as_floats(name: str, value: ArrayLike) -> Array:
    """Return ``value`` as a contiguous float64 array, or refuse it."""
    if isinstance(value, np.ndarray):
        _refuse_masked_and_complex(name, value)
    try:
        return np.ascontiguousarray(value, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):  # an integer beyond all floats
        raise ValueError(f"{name} must be numbers, got {value!r}") from None


def shaped(name: str, value: ArrayLike, shape: tuple[int, ...]) -> Array:
    """Return ``value`` as float64 of one shape, or refuse it."""
    array = as_floats(name, value)
    if array.shape != shape:
        raise ValueError(f"{name} must have shape {shape}, got {array.shape}")
    return array


def scan(
    measurements: ArrayLike, columns: tuple[str, ...] = ("bearing", "range")
) -> Array:
    """Return ``measurements`` as a writeable float64 array (m, 2), or refuse them.

    The rows of a sensor of one number get a void second number.
    """
    if (  # kernels can take them as they are
        type(measurements) is np.ndarray
        and measurements.dtype is _FLOAT64
        and measurements.flags.carray
        and measurements.ndim == 2
        and measurements.shape[1] == 2
    ):
        return measurements
    readings = as_floats("measurements", measurements)
    if not readings.flags.writeable:  # another type to numba: it would compile anew
        readings = readings.copy()
    if readings.ndim == 2 and readings.shape[1] == 2:
        return readings
    if len(columns) == 1 and readings.shape[1:] == (1,):
        return np.pad(readings, ((0, 0), (0, 1)))
    if readings.size == 0:
        return readings.reshape(0, 2)
    raise ValueError(
        f"measurements must have shape (m, 2), rows ({', '.join(columns)}), "
        f"got shape {readings.shape}"
    )


def identities(
    landmark_ids: LandmarkIds | None, count: int, estimator: object = None
) -> list[int]:
    """Return ids as Python integers, without repetition; see `identity_array`."""
    ids: list[int] = identity_array(landmark_ids, count, estimator).tolist()
    refuse_repeated(ids)
    return ids


def refuse_repeated(ids: Sequence[int]) -> None:
    """Refuse an identity that a scan holds twice."""
    if len(set(ids)) < len(ids):
        twice = next(i for i in ids if ids.count(i) > 1)
        raise ValueError(
            f"landmark_ids must not repeat within a scan, got {twice} twice"
        )


def identity_array(ids: LandmarkIds | None, count: int, estimator: object) -> IntArray:
    """Return ids as kernels take them: one for each reading; they refuse repetition.

    Parameters
    ----------
    ids : sequence of int
    count : int
        Number of readings.
    estimator
        The filter that needs the ids, which may be None where there are no readings;
        None if ids are always needed.
    """
    array: Any = ids
    if ids is None and estimator is not None:
        if count:
            name = type(estimator).__name__
            raise ValueError(
                f"landmark_ids must be given: {name} does not associate readings; "
                "one made with management=True does"
            )
        return np.empty(0, dtype=np.int64)
    if type(array) is not np.ndarray:
        try:
            array = np.asarray(ids)
        except ValueError:  # a list of lists of several lengths
            raise ValueError(
                f"landmark_ids must be a list of int64, got {ids!r}"
            ) from None
    if array.dtype is not _INT64 or not array.flags.carray or array.ndim != 1:
        array = np.array(_as_signed(array, ids), dtype=np.int64)
    if len(array) != count:
        raise ValueError(
            f"landmark_ids must have one entry per row of measurements, {count}, got "
            f"{len(array)}"
        )
    checked: IntArray = array
    return checked


def _as_signed(array: AnyArray, given: LandmarkIds | None) -> AnyArray:
    """Return ids that are unsigned or none at all, or refuse what is neither."""
    if array.size and (array.dtype.kind not in "iu" or array.ndim != 1):
        raise ValueError(f"landmark_ids must be a list of int64, got {given!r}")
    if array.dtype == np.uint64 and (array > np.iinfo(np.int64).max).any():
        raise ValueError(f"landmark_ids must fit 64 bits, got {given!r}")
    return array.ravel()


def refuse_reserved(ids: Iterable[int]) -> None:
    """Refuse identities that filters keep for what is no landmark."""
    lowest = min(ids, default=0)
    if lowest < LOWEST_ID + RESERVED_IDS:
        raise ValueError(
            f"landmark_ids must be >= {LOWEST_ID + RESERVED_IDS}, got {lowest}"
        )


def asked_identities(ids: LandmarkIds | None, mapped: Mapping[int, int]) -> list[int]:
    """Return ids of mapped landmarks without repetition, all of them for None."""
    if ids is None:
        return list(mapped)
    return mapped_identities(ids, mapped)


def mapped_identities(asked: LandmarkIds, mapped: Collection[int]) -> list[int]:
    """Return ids of mapped landmarks, without repetition."""
    if isinstance(asked, tuple) and not asked:
        return []
    try:
        count = np.size(asked)
    except ValueError:
        count = 0  # refused by the next line
    ids = identities(asked, count)
    for i in ids:
        if i not in mapped:
            raise ValueError(f"landmark_ids must be of mapped landmarks, got {i}")
    return ids


def refuse_unusable(readings: Array, ids: Sequence[int] | None = None) -> None:
    """Refuse readings that are not finite or too large, naming the first."""
    if sum(map(abs, readings.ravel().tolist())) <= LARGEST:  # fast, then exact
        return
    for usable, rule in (
        (np.isfinite(readings), "must be finite"),
        (np.abs(readings) <= LARGEST, f"must not exceed {LARGEST:g}"),
    ):
        if not usable.all():
            row = int(np.argmin(usable.all(axis=1)))
            of = "" if ids is None else f" (landmark {ids[row]})"
            raise ValueError(
                f"measurements {rule}, got {readings[row].tolist()} in row {row}{of}"
            )


def not_positive_definite(landmark_id: int) -> np.linalg.LinAlgError:
    """Return the error of an innovation covariance that cannot be factored."""
    return np.linalg.LinAlgError(
        "the innovation covariance is not positive definite at the reading of "
        f"landmark {landmark_id}: the belief or measurement_std is degenerate"
    )


def refuse_large_belief(landmarks: int, limit: int, instead: str) -> None:
    """Refuse a dense covariance of more landmarks than the limit, with its size."""
    if landmarks > limit:
        gigabytes = 1e-9 * covariance_bytes(landmarks)
        raise ValueError(
            f"belief() of {landmarks} landmarks has a dense covariance of "
            f"{gigabytes:.1f} GB, and belief_limit is {limit}: {instead}, or raise "
            "belief_limit"
        )


def pair(name: str, value: ArrayLike) -> tuple[float, float]:
    """Return ``value`` as two finite floats of a usable size, or refuse it."""
    given: Any = value
    if type(given) is np.ndarray and given.dtype is _FLOAT64:
        given = given.tolist()  # in half the time that numpy's own numbers take
    elif isinstance(given, np.ndarray):
        _refuse_masked_and_complex(name, given)
        given = given.tolist()
    try:
        first, second = given
        a, b = float(first), float(second)
    except (TypeError, ValueError, OverflowError):
        raise _not_a_pair(name, value) from None
    if -LARGEST <= a <= LARGEST and -LARGEST <= b <= LARGEST:
        return a, b
    if isfinite(a) and isfinite(b):
        raise ValueError(f"{name} must not exceed {LARGEST:g}, got {value!r}")
    raise _not_a_pair(name, value)


def _not_a_pair(name: str, value: ArrayLike) -> ValueError:
    return ValueError(f"{name} must be 2 finite numbers, got {value!r}")


def at_least(name: str, value: float, least: float, largest: float = LARGEST) -> float:
    """Return a number from ``least`` to the largest, or refuse it."""
    if type(value) is float and least <= value <= largest:  # three times as fast
        return value
    if not (_is_finite(value) and value >= least):
        raise ValueError(f"{name} must be a finite number >= {least:g}, got {value!r}")
    if value > largest:
        raise ValueError(f"{name} must not exceed {largest:g}, got {value!r}")
    return float(value)


def above(name: str, value: float, least: float) -> float:
    """Return a number above ``least``, up to the largest, or refuse it."""
    if not (_is_finite(value) and value > least):
        raise ValueError(f"{name} must be a finite number > {least:g}, got {value!r}")
    return at_least(name, value, least)


def positive(name: str, value: float) -> float:
    """Return a number > 0 that other numbers can be divided by, or refuse it."""
    if above(name, value, 0.0) < SMALLEST:
        raise ValueError(f"{name} must be at least {SMALLEST:g}, got {value!r}")
    return float(value)


def distance(name: str, value: float) -> float:
    """Return a distance >= 0 [m], also infinity, or refuse it."""
    if isinstance(value, float) and value == inf:
        return value
    return at_least(name, value, 0.0)


def whole(name: str, value: int, least: int) -> int:
    """Return a whole number >= ``least``, or refuse it."""
    is_whole = isinstance(value, int | np.integer) and not isinstance(value, bool)
    if not is_whole or value < least:
        raise ValueError(f"{name} must be a whole number >= {least}, got {value!r}")
    return int(value)


def one_of(name: str, value: str, choices: tuple[str, ...]) -> str:
    """Return one of a few words, or refuse another."""
    if value not in choices:
        wanted = " or ".join(repr(choice) for choice in choices)
        raise ValueError(f"{name} must be {wanted}, got {value!r}")
    return value


def flag(name: str, value: bool) -> bool:
    """Return True or False, or refuse what is neither."""
    if not isinstance(value, bool | np.bool_):
        raise ValueError(f"{name} must be True or False, got {value!r}")
    return bool(value)


def _refuse_masked_and_complex(name: str, value: AnyArray) -> None:
    """Numpy would take what lies under a mask, and half of a complex number."""
    if isinstance(value, np.ma.MaskedArray):
        raise ValueError(f"{name} must be an array without a mask, got {value!r}")
    if value.dtype.kind == "c":
        raise ValueError(f"{name} must be real numbers, got {value!r}")


def _is_finite(value: float) -> bool:
    if isinstance(value, int):
        return True  # of any size
    return isinstance(value, float | np.number) and isfinite(value)


_WHOLE = (int, np.integer)


def two_landmarks(kept: int, gone: int, mapped: Collection[int]) -> list[int]:
    """Return the ids of two different landmarks of a map."""
    if not (isinstance(kept, _WHOLE) and isinstance(gone, _WHOLE)):
        raise ValueError(f"kept and gone must be integers, got {kept!r} and {gone!r}")
    if kept == gone:
        raise ValueError(f"kept and gone must be two landmarks, got {kept} twice")
    return mapped_identities([kept, gone], mapped)


def landmark_pairs(
    pairs: Sequence[tuple[int, int]], mapped: Mapping[int, int]
) -> tuple[list[int], list[int]]:
    """Return the first and the second landmarks of pairs, all mapped and different."""
    try:
        kept, gone = [i for i, _ in pairs], [j for _, j in pairs]
    except (TypeError, ValueError):
        raise ValueError(f"pairs must be pairs (kept, gone), got {pairs!r}") from None
    if len(kept) != len(gone):
        raise ValueError(f"pairs must be a sequence, got {pairs!r}")
    for i, j in zip(kept, gone, strict=True):
        two_landmarks(i, j, mapped)
    ids = mapped_identities([*kept, *gone], mapped)
    return ids[: len(kept)], ids[len(kept) :]


# --------------------------------------------------------------------------------------
# The machine: its memory, where arrays begin in it, and its cores.


def covariance_bytes(landmarks: int) -> int:
    """Return the size of a dense covariance of a pose and n landmarks [bytes].

    Examples
    --------
    >>> covariance_bytes(10_000)
    3200960072
    """
    return 8 * (3 + 2 * landmarks) ** 2


def too_large(what: str, size: float) -> MemoryError:
    """Return the error of a map that memory does not hold, with its size [bytes]."""
    return MemoryError(
        f"{what} takes {1e-9 * size:.1f} GB, and memory does not hold it: "
        "'submaps' and 'sparse_information' take less"
    )


def aligned_zeros(*shape: int) -> Array:
    """Return zeros that begin on a cache line, so that no vector spans two lines.

    Examples
    --------
    >>> aligned_zeros(3, 5).ctypes.data % CACHE_LINE
    0
    """
    size = prod(shape)
    room = np.zeros(size + CACHE_LINE // 8)
    # ``ctypes.data`` is the same number, at several times the cost.
    skipped = -room.__array_interface__["data"][0] % CACHE_LINE // 8
    return room[skipped : skipped + size].reshape(shape)


def aligned_copy(array: Array) -> Array:
    """Copy an array to memory that begins on a cache line."""
    copy = aligned_zeros(*array.shape)
    copy[:] = array
    return copy


_CHANGED_IN_PLACE = frozenset((np.ndarray, list, dict, set))


def with_copies(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return attributes with copies of those that are arrays, lists, dicts or sets."""
    return {
        name: value.copy() if type(value) in _CHANGED_IN_PLACE else value
        for name, value in values.items()
    }


def usable_cores() -> int:
    """Return the number of cores that this process may use, 1 where it is unknown."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return 1
