"""Check the saved state of a compressed filter before anything changes."""

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from ....arrays import Array
from ...support import argument_checks
from .deferred_covariance import DeferredCovariance
from .phase_update import virtual_landmarks

_LOCAL = ("mean", "covariance", "reference", "landmark_ids")
_OWN = ("landmark_ids", "slots", "points", "references", "strip", "origin", "numbers")


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
    argument_checks.refuse_other_state(state, entries, estimator=name, base=base)
    far.load_state_dict({k: state[f"far_{k}"] for k in far.state_dict()})
    ids, slots, numbers, local_ids = (
        np.asarray(state[k]).ravel().tolist()
        for k in ("landmark_ids", "slots", "numbers", "local_landmark_ids")
    )
    saved = SavedState(
        {"estimator": state["base"], **{k: state[f"local_{k}"] for k in _LOCAL}},
        far,
        dict(zip(ids, slots, strict=False)),
        dict.fromkeys(local_ids[numbers[0] :]),
        (
            _vector(state, "points", far.width),
            _vector(state, "references", far.width),
            np.array(state["strip"], dtype=np.float64),
            _vector(state, "origin", 2),
        ),
        numbers,
    )
    if len(ids) != len(slots) or len(saved.slots) != len(ids):
        raise ValueError(
            f"state['slots'] must have one entry for each of {len(ids)} landmarks, "
            f"got {len(slots)}"
        )
    _check_fit(saved, invariant)
    return saved


def _vector(state: Mapping[str, Any], key: str, size: int) -> Array:
    return argument_checks.finite_vector(f"state[{key!r}]", state[key], size).copy()


def _check_fit(saved: SavedState, invariant: bool) -> None:
    strip, virtual, width = saved.arrays[2], saved.numbers[0], saved.far.width
    rows = virtual_landmarks(len(strip), invariant)
    if strip.shape[1:] != (width,) or (virtual and rows != virtual):
        raise ValueError(
            f"state['strip'] must fit {virtual} virtual landmarks and {width} columns, "
            f"got shape {strip.shape}"
        )
    if not set(saved.near) <= set(saved.slots):
        raise ValueError("state['local_landmark_ids'] must be among landmark_ids")
