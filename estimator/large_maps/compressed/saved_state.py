"""Check the saved state of a compressed filter before anything changes."""

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from ....arrays import Array
from ...filters.gaussian_map import checked_map
from ...support import saved_states
from .deferred_covariance import DeferredCovariance
from .phase_update import virtual_landmarks

_LOCAL = ("mean", "covariance", "reference", "landmark_ids")
_OWN = ("landmark_ids", "slots", "points", "references", "strip", "origin", "numbers")


COUNTERS = 4
"""Numbers before the free slots: virtual landmarks, extra ones, age, rest."""


class SavedState(NamedTuple):
    """The attributes of a compressed filter, read from a saved state."""

    local: dict[str, Any]
    far: DeferredCovariance
    slots: dict[int, int]
    near: dict[int, None]
    arrays: tuple[Array, Array, Array, Array]  # points, references, strip, origin
    numbers: list[int]


def checked_state(
    state: Mapping[str, Any], name: str, base: str, invariant: bool
) -> SavedState:
    """Read what ``CompressedEkfSlam.state_dict`` returned; refuse what does not fit."""
    far = DeferredCovariance()
    entries = [*_OWN, *(f"local_{k}" for k in _LOCAL)]
    entries += [f"far_{k}" for k in far.state_dict()]
    saved_states.refuse_other_state(state, entries, estimator=name, base=base)
    far.load_state_dict({k: state[f"far_{k}"] for k in far.state_dict()})
    ids, local_ids = (
        saved_states.landmark_ids(key, state[key])
        for key in ("landmark_ids", "local_landmark_ids")
    )
    slots, numbers = (
        saved_states.whole_numbers(key, state[key], (-1,), 0).tolist()
        for key in ("slots", "numbers")
    )
    _check_slots(slots, numbers, len(ids), len(local_ids))
    saved = SavedState(
        checked_map({k: state[f"local_{k}"] for k in _LOCAL}, semidefinite=False),
        far,
        dict(zip(ids, slots, strict=True)),
        dict.fromkeys(local_ids[numbers[0] :]),
        (
            _vector(state, "points", far.width),
            _vector(state, "references", far.width),
            saved_states.array("strip", state["strip"], (-1, far.width)),
            _vector(state, "origin", 2),
        ),
        numbers,
    )
    _check_fit(saved, invariant)
    return saved


def _check_slots(
    slots: list[int], numbers: list[int], landmarks: int, local: int
) -> None:
    """Refuse places of landmarks that do not fit their number."""
    if landmarks != len(slots):
        raise ValueError(
            f"state['slots'] must have one entry for each of {landmarks} landmarks, "
            f"got {len(slots)}"
        )
    if len(numbers) < COUNTERS or numbers[0] > local:
        raise ValueError(
            f"state['numbers'] must be at least {COUNTERS}, the first of them at most "
            f"{local}, got {numbers}"
        )
    free = numbers[COUNTERS:]
    if sorted(slots + free) != list(range(len(slots + free))):
        raise ValueError(
            "state['slots'] and the free ones in state['numbers'] must be 0, 1, … "
            f"without repetition, got {slots} and {free}"
        )


def _vector(state: Mapping[str, Any], key: str, size: int) -> Array:
    return saved_states.array(key, state[key], (size,))


def _check_fit(saved: SavedState, invariant: bool) -> None:
    strip, virtual, width = saved.arrays[2], saved.numbers[0], saved.far.width
    rows = virtual_landmarks(len(strip), invariant)
    if virtual and rows != virtual:
        raise ValueError(
            f"state['strip'] must fit {virtual} virtual landmarks and {width} columns, "
            f"got shape {strip.shape}"
        )
    own = np.r_[0:3, 3 + 2 * virtual : len(saved.local["mean"])]
    covariance = saved.local["covariance"][np.ix_(own, own)]
    saved_states.refuse_indefinite("state['local_covariance']", covariance)
    if not set(saved.near) <= set(saved.slots):
        raise ValueError("state['local_landmark_ids'] must be among landmark_ids")
