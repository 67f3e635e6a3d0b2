"""Save a sparse information filter, and check what was saved before taking it."""

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from .. import validation
from .information_matrix import InformationMatrix, Solver, Surroundings, solver
from .local_information import LocalInformation, Map, Outer
from .pose_given_map import PoseGivenMap

Array = NDArray[np.float64]
Int = NDArray[np.int64]

_MATRIX = ("counts", "links", "blocks")
_LOCAL = ("slots", "points", "information", "start")
_AROUND = ("slots", "border", "response", "complement")
_OUTER = ("slots", "response", "residual", "scale")
_POSE = ("mean", "gain", "covariance")
_WHOLE = {"counts", "links", "border", "slots"}


class SavedState(NamedTuple):
    """All that changes in the filter."""

    slots: dict[int, int]
    """Place of each landmark, by identity."""
    free: list[int]
    """Places of removed landmarks."""
    world: Map
    local: LocalInformation
    pose: PoseGivenMap
    origin: Array
    """Where the local map was chosen, shape (2,) [m]."""
    reach: float
    """How many landmarks around it were to be eliminated."""
    widened: bool
    """Whether that is more than at first."""


def as_arrays(saved: SavedState, name: str) -> dict[str, Any]:
    """Return copies of everything, as arrays."""
    world, local = saved.world, saved.local
    count = 2 * len(world.information)
    return {
        "estimator": np.array(name),
        "landmark_ids": np.array(list(saved.slots), dtype=np.int64),
        "slots": np.array(list(saved.slots.values()), dtype=np.int64),
        "free": np.array(saved.free, dtype=np.int64),
        "points": world.points[:count].copy(),
        "residual": world.residual[:count].copy(),
        "origin": saved.origin.copy(),
        "reach": np.array(saved.reach),
        "widened": np.array(saved.widened),
        **{f"matrix_{k}": v for k, v in world.information.state_dict().items()},
        **{f"local_{k}": getattr(local, k).copy() for k in _LOCAL},
        **{f"around_{k}": getattr(local.surroundings, k).copy() for k in _AROUND},
        **{f"outer_{k}": getattr(local.outer, k).copy() for k in _OUTER},
        **{f"pose_{k}": getattr(saved.pose, k).copy() for k in _POSE},
    }


def checked_state(state: Mapping[str, Any], name: str) -> SavedState:
    """Read what :func:`as_arrays` returned, or refuse it."""
    _check_entries(state, name)
    ids, slots, free = (
        np.asarray(state[key]).ravel().tolist()
        for key in ("landmark_ids", "slots", "free")
    )
    world = Map()
    world.information.load_state_dict(_part(state, "matrix", _MATRIX))
    count = len(world.information)
    if sorted(slots + free) != list(range(count)) or len(set(ids)) != len(slots):
        raise ValueError(
            f"state['slots'] and state['free'] must share out the {count} rows of the "
            f"matrix among {len(ids)} landmarks, got {len(slots)} and {len(free)}"
        )
    world.points, world.residual = (
        validation.finite_vector(f"state[{key!r}]", state[key], 2 * count).copy()
        for key in ("points", "residual")
    )
    pose = PoseGivenMap(**_part(state, "pose", _POSE))
    around = _part(state, "around", _AROUND)
    matrix, others = world.information, around["slots"]
    local = LocalInformation(
        **_part(state, "local", _LOCAL),
        surroundings=Surroundings(**around, solve=_later(matrix, others)),
        outer=Outer(**_part(state, "outer", _OUTER)),
    )
    _check_fit(local, pose, count)
    origin = validation.finite_vector("state['origin']", state["origin"], 2).copy()
    return SavedState(
        dict(zip(ids, slots, strict=True)),
        free,
        world,
        local,
        pose,
        origin,
        float(state["reach"]),
        bool(state["widened"]),
    )


def _later(matrix: InformationMatrix, slots: Int) -> Solver:
    """Factorise only when asked."""
    return lambda right: solver(matrix, slots)(right)  # noqa: PLW0108


def _check_entries(state: Mapping[str, Any], name: str) -> None:
    entries = ["landmark_ids", "slots", "free", "points", "residual"]
    for prefix, keys in (
        ("matrix", _MATRIX),
        ("local", _LOCAL),
        ("around", _AROUND),
        ("outer", _OUTER),
        ("pose", _POSE),
    ):
        entries += [f"{prefix}_{key}" for key in keys]
    entries += ["origin", "reach", "widened"]
    validation.refuse_other_state(state, entries, estimator=name)


def _part(
    state: Mapping[str, Any], prefix: str, keys: tuple[str, ...]
) -> dict[str, Any]:
    """Return copies of some entries, checked to be finite numbers."""
    part: dict[str, Any] = {}
    for key in keys:
        name = f"state['{prefix}_{key}']"
        values = validation.as_floats(name, state[f"{prefix}_{key}"])
        if not np.isfinite(values).all():
            raise ValueError(f"{name} must be finite")
        part[key] = values.astype(np.int64) if key in _WHOLE else values.copy()
    return part


def _check_fit(local: LocalInformation, pose: PoseGivenMap, count: int) -> None:
    """Refuse arrays whose shapes do not belong together."""
    around, outer = local.surroundings, local.outer
    k, c = 2 * len(local.slots), len(around.border)
    h, o = 2 * len(around.slots), 2 * len(outer.slots)
    for name, array, shape in (
        ("pose_mean", pose.mean, (3,)),
        ("pose_gain", pose.gain, (3, k)),
        ("pose_covariance", pose.covariance, (3, 3)),
        ("local_points", local.points, (k,)),
        ("local_information", local.information, (k, k)),
        ("local_start", local.start, (c,)),
        ("around_response", around.response, (h, c)),
        ("around_complement", around.complement, (c, c)),
        ("outer_response", outer.response, (o, c)),
        ("outer_residual", outer.residual, (o,)),
        ("outer_scale", outer.scale, (o // 2, 2, 2)),
    ):
        if array.shape != shape:
            raise ValueError(f"state[{name!r}] must be {shape}, got {array.shape}")
    for name, places, end in (
        ("local_slots", local.slots, count),
        ("around_slots", around.slots, count),
        ("outer_slots", outer.slots, count),
        ("around_border", around.border, k),
    ):
        if len(places) and not 0 <= places.min() <= places.max() < end:
            raise ValueError(
                f"state[{name!r}] must lie in [0, {end}), got {places.min()} to "
                f"{places.max()}"
            )
