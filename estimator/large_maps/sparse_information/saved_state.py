"""Conversion of a sparse belief to arrays, and checks of such arrays."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from ....arrays import IntArray
from ...support import argument_checks, saved_states
from ..sparse_cholesky.landmark_elimination import RestFactor
from ..sparse_cholesky.schur_complement import Factor, SchurComplement, SubsetFactor
from .conditional_pose import ConditionalPose
from .local_information import FixedLandmarks, LocalInformation, SparseMap
from .sparse_belief import SparseBelief

_PARTS = {
    "matrix": ("counts", "links", "blocks"),
    "local": ("slots", "points", "first", "information", "start"),
    "around": ("slots", "border", "response", "complement"),
    "outer": ("slots", "response", "residual", "scale"),
    "pose": ("mean", "gain", "covariance", "reference"),
}
_MAP = ("points", "first", "residual")
_OTHERS = ("landmark_ids", "slots", "free", "nodes", "parted")
_LOCAL_MAP = ("origin", "reach", "widened")
_WHOLE_NUMBERS = {"counts", "links", "border", "slots"}
_LARGEST_WHOLE = 2.0**53


def as_arrays(belief: SparseBelief, name: str, base: str) -> dict[str, Any]:
    """Return copies of the whole state, as arrays."""
    map_, local = belief.map_, belief.local
    dissection = map_.elimination.dissection
    dissection.grow(len(map_.information))
    parts = {
        "local": local,
        "around": local.eliminated,
        "outer": local.fixed,
        "pose": belief.pose,
    }
    return {
        "estimator": np.array(name),
        "base": np.array(base),
        "landmark_ids": np.array(list(belief.slots), dtype=np.int64),
        "slots": np.array(list(belief.slots.values()), dtype=np.int64),
        "free": np.array(belief.free, dtype=np.int64),
        "nodes": dissection.nodes.copy(),
        "parted": np.array(dissection.dissected),
        "origin": belief.origin.copy(),
        "reach": np.array(float(belief.count)),
        "widened": np.array(belief.enlarged),
        **{k: getattr(map_, k)[: 2 * len(map_.information)].copy() for k in _MAP},
        **{f"matrix_{k}": v for k, v in map_.information.state_dict().items()},
        **{
            f"{prefix}_{key}": getattr(part, key).copy()
            for prefix, part in parts.items()
            for key in _PARTS[prefix]
        },
    }


def checked_state(state: Mapping[str, Any], name: str, base: str) -> SparseBelief:
    """Return the belief that :func:`as_arrays` saved.

    Raises
    ------
    ValueError
        If the state is of another estimator, incomplete or inconsistent.
    """
    entries = [f"{prefix}_{key}" for prefix, keys in _PARTS.items() for key in keys]
    entries += [*_OTHERS, *_MAP, *_LOCAL_MAP]
    saved_states.refuse_other_state(state, entries, estimator=name, base=base)
    map_ = SparseMap()
    map_.information.load_state_dict(_part(state, "matrix"))
    count = len(map_.information)
    slots, free = _slots(state, count)
    map_.points, map_.first, map_.residual = (
        saved_states.array(key, state[key], (2 * count,)) for key in _MAP
    )
    pose = ConditionalPose(**_part(state, "pose"))
    of_local = _part(state, "local")
    local = LocalInformation(
        **of_local,
        eliminated=_eliminated(map_, of_local["slots"], _part(state, "around")),
        fixed=FixedLandmarks(**_part(state, "outer")),
    )
    _check_shapes(local, pose)
    _check_slots(local, count)
    _load_dissection(state, map_, local.slots)
    origin = saved_states.array("origin", state["origin"], (2,))
    reach = argument_checks.as_floats("state['reach']", state["reach"])
    if reach.shape != (1,) or not reach[0] > 0:
        raise ValueError(f"state['reach'] must be a number > 0, got {state['reach']!r}")
    widened = saved_states.flag("widened", state["widened"])
    belief = SparseBelief(
        slots, free, map_, local, pose, origin, float(reach[0]), widened
    )
    _check_definite(belief)
    return belief


def _check_definite(belief: SparseBelief) -> None:
    """Raise a ValueError where pose or map have no positive definite covariance."""
    saved_states.refuse_indefinite("state['pose_covariance']", belief.pose.covariance)
    try:
        pose = belief.marginal([]).covariance
    except np.linalg.LinAlgError:
        raise ValueError(
            "state['matrix_blocks'] must be a positive definite information matrix"
        ) from None
    saved_states.refuse_indefinite("the covariance of the pose of state", pose)


def _slots(state: Mapping[str, Any], count: int) -> tuple[dict[int, int], list[int]]:
    ids = saved_states.landmark_ids("landmark_ids", state["landmark_ids"])
    slots, free = (
        saved_states.whole_numbers(key, state[key], (-1,), 0).tolist()
        for key in ("slots", "free")
    )
    if sorted(slots + free) != list(range(count)) or len(ids) != len(slots):
        raise ValueError(
            f"state['slots'] and state['free'] must share out the {count} rows of the "
            f"matrix among {len(ids)} landmarks, got {len(slots)} and {len(free)}"
        )
    return dict(zip(ids, slots, strict=True)), free


def _eliminated(
    map_: SparseMap, local: IntArray, around: dict[str, Any]
) -> SchurComplement:
    """Return the saved complement; its factor is made when it is first used."""
    slots, response = around["slots"], around["response"]
    factor: Factor = SubsetFactor(map_.information, slots, response)
    if len(slots) and not len(response):
        factor = RestFactor(map_.elimination, map_.information, local)
    return SchurComplement(**around, factor=factor)


def _load_dissection(
    state: Mapping[str, Any], map_: SparseMap, local: IntArray
) -> None:
    """Load the elimination order; insert landmarks that it does not contain."""
    matrix, count = map_.information, len(map_.information)
    nodes = saved_states.whole_numbers("nodes", state["nodes"], (count,), 0)
    if (nodes >= 2**50).any():
        raise ValueError(
            f"state['nodes'] must be whole numbers in [0, 2⁵⁰), got {nodes.max()}"
        )
    dissection = map_.elimination.dissection
    dissection.nodes = nodes
    dissection.dissected = saved_states.whole_number("parted", state["parted"])
    others = np.setdiff1d(np.flatnonzero(dissection.nodes == 0), local)
    others = others[matrix.is_filled(others)]
    if len(others):
        dissection.revise(matrix, map_.first, others)
    dissection.check(matrix, local)


def _part(state: Mapping[str, Any], prefix: str) -> dict[str, Any]:
    """Return copies of the entries with a prefix, all of them finite numbers."""
    part: dict[str, Any] = {}
    for key in _PARTS[prefix]:
        values = saved_states.array(f"{prefix}_{key}", state[f"{prefix}_{key}"])
        if key not in _WHOLE_NUMBERS:
            part[key] = values
            continue
        if (np.abs(values) > _LARGEST_WHOLE).any():
            raise ValueError(f"state['{prefix}_{key}'] must be whole numbers <= 2⁵³")
        part[key] = values.astype(np.int64)
    return part


def _check_shapes(local: LocalInformation, pose: ConditionalPose) -> None:
    eliminated, fixed = local.eliminated, local.fixed
    k, c = 2 * len(local.slots), len(eliminated.border)
    h = 2 * len(eliminated.slots) if len(eliminated.response) else 0
    o = 2 * len(fixed.slots)
    for name, array, shape in (
        ("pose_mean", pose.mean, (3,)),
        ("pose_gain", pose.gain, (3, k)),
        ("pose_covariance", pose.covariance, (3, 3)),
        ("pose_reference", pose.reference, (2,)),
        ("local_points", local.points, (k,)),
        ("local_first", local.first, (k,)),
        ("local_information", local.information, (k, k)),
        ("local_start", local.start, (c,)),
        ("around_response", eliminated.response, (h, c)),
        ("around_complement", eliminated.complement, (c, c)),
        ("outer_response", fixed.response, (o, c)),
        ("outer_residual", fixed.residual, (o,)),
        ("outer_scale", fixed.scale, (o // 2, 2, 2)),
    ):
        if array.shape != shape:
            raise ValueError(f"state[{name!r}] must be {shape}, got {array.shape}")


def _check_slots(local: LocalInformation, count: int) -> None:
    for name, slots, end in (
        ("local_slots", local.slots, count),
        ("around_slots", local.eliminated.slots, count),
        ("outer_slots", local.fixed.slots, count),
        ("around_border", local.eliminated.border, 2 * len(local.slots)),
    ):
        if len(slots) and not 0 <= slots.min() <= slots.max() < end:
            raise ValueError(
                f"state[{name!r}] must lie in [0, {end}), got {slots.min()} to "
                f"{slots.max()}"
            )
