"""Save a sparse information filter, and check what was saved before taking it."""

from collections.abc import Mapping
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...support import argument_checks
from ..sparse_cholesky.information_matrix import (
    InformationMatrix,
    Solver,
    Surroundings,
    solver,
)
from ..sparse_cholesky.landmark_elimination import Factor
from .conditional_pose import PoseGivenMap
from .local_information import LocalInformation, Map, Outer

Array = NDArray[np.float64]
Int = NDArray[np.int64]

_MATRIX = ("counts", "links", "blocks")
_LOCAL = ("slots", "points", "first", "information", "start")
_AROUND = ("slots", "border", "response", "complement")
_OUTER = ("slots", "response", "residual", "scale")
_POSE = ("mean", "gain", "covariance", "reference")
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


def as_arrays(saved: SavedState, name: str, base: str) -> dict[str, Any]:
    """Return copies of everything, as arrays."""
    world, local = saved.world, saved.local
    world.elimination.dissection.grow(len(world.information))
    count = 2 * len(world.information)
    return {
        "estimator": np.array(name),
        "base": np.array(base),
        "landmark_ids": np.array(list(saved.slots), dtype=np.int64),
        "slots": np.array(list(saved.slots.values()), dtype=np.int64),
        "free": np.array(saved.free, dtype=np.int64),
        "points": world.points[:count].copy(),
        "first": world.first[:count].copy(),
        "residual": world.residual[:count].copy(),
        "nodes": world.elimination.dissection.nodes.copy(),
        "parted": np.array(world.elimination.dissection.parted),
        "origin": saved.origin.copy(),
        "reach": np.array(saved.reach),
        "widened": np.array(saved.widened),
        **{f"matrix_{k}": v for k, v in world.information.state_dict().items()},
        **{f"local_{k}": getattr(local, k).copy() for k in _LOCAL},
        **{f"around_{k}": getattr(local.surroundings, k).copy() for k in _AROUND},
        **{f"outer_{k}": getattr(local.outer, k).copy() for k in _OUTER},
        **{f"pose_{k}": getattr(saved.pose, k).copy() for k in _POSE},
    }


def checked_state(state: Mapping[str, Any], name: str, base: str) -> SavedState:
    """Read what :func:`as_arrays` returned, or refuse it."""
    _check_entries(state, name, base)
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
    world.points, world.first, world.residual = (
        argument_checks.finite_vector(f"state[{key!r}]", state[key], 2 * count).copy()
        for key in ("points", "first", "residual")
    )
    pose = PoseGivenMap(**_part(state, "pose", _POSE))
    around = _part(state, "around", _AROUND)
    of_local = _part(state, "local", _LOCAL)
    local = LocalInformation(
        **of_local,
        surroundings=_surroundings(world, of_local["slots"], around),
        outer=Outer(**_part(state, "outer", _OUTER)),
    )
    _check_fit(local, pose, count)
    _take_dissection(state, world, local.slots)
    origin = argument_checks.finite_vector("state['origin']", state["origin"], 2).copy()
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


def _surroundings(world: Map, local: Int, around: dict[str, Any]) -> Surroundings:
    """Eliminate around the local map as before, when that is asked for."""
    slots, response = around["slots"], around["response"]
    if len(slots) and not len(response):
        factor = Factor(world.elimination, world.information, local)
        respond = partial(factor.respond, around["border"])
        return Surroundings(**around, solve=factor.solve, respond=respond)
    solve = _later(world.information, slots)
    return Surroundings(**around, solve=solve, respond=response.__matmul__)


def _take_dissection(state: Mapping[str, Any], world: Map, local: Int) -> None:
    """Take the order of elimination, and put those in it that are in none."""
    matrix, count = world.information, len(world.information)
    nodes = np.asarray(state["nodes"])
    if nodes.shape != (count,) or (nodes < 0).any() or (nodes >= 2**50).any():
        raise ValueError(
            f"state['nodes'] must be {count} whole numbers in [0, 2⁵⁰), got "
            f"shape {nodes.shape}"
        )
    dissection = world.elimination.dissection
    dissection.nodes = nodes.astype(np.int64)
    dissection.parted = int(state["parted"])
    others = np.setdiff1d(np.flatnonzero(dissection.nodes == 0), local)
    others = others[matrix.filled(others)]
    if len(others):
        dissection.revise(matrix, world.first, others)
    dissection.check(matrix, local)


def _later(matrix: InformationMatrix, slots: Int) -> Solver:
    """Factorise only when asked."""
    return lambda right: solver(matrix, slots)(right)  # noqa: PLW0108


def _check_entries(state: Mapping[str, Any], name: str, base: str) -> None:
    entries = ["landmark_ids", "slots", "free", "points", "first", "residual"]
    for prefix, keys in (
        ("matrix", _MATRIX),
        ("local", _LOCAL),
        ("around", _AROUND),
        ("outer", _OUTER),
        ("pose", _POSE),
    ):
        entries += [f"{prefix}_{key}" for key in keys]
    entries += ["nodes", "parted", "origin", "reach", "widened"]
    argument_checks.refuse_other_state(state, entries, estimator=name, base=base)


def _part(
    state: Mapping[str, Any], prefix: str, keys: tuple[str, ...]
) -> dict[str, Any]:
    """Return copies of some entries, checked to be finite numbers."""
    part: dict[str, Any] = {}
    for key in keys:
        name = f"state['{prefix}_{key}']"
        values = argument_checks.as_floats(name, state[f"{prefix}_{key}"])
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
        ("pose_reference", pose.reference, (2,)),
        ("local_points", local.points, (k,)),
        ("local_first", local.first, (k,)),
        ("local_information", local.information, (k, k)),
        ("local_start", local.start, (c,)),
        ("around_response", around.response, (h if len(around.response) else 0, c)),
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
