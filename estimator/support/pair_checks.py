"""Checks of landmarks that are to be merged in pairs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from .argument_checks import mapped_identities

_WHOLE = (int, np.integer)


def two_landmarks(kept: int, gone: int, mapped: Mapping[int, int]) -> list[int]:
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
