"""Conversion of a run in submaps to arrays, and checks of such arrays."""

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from ....arrays import IntArray
from ...support import saved_states
from .active_submap import ActiveSubmap
from .chain import Chain
from .closed_submaps import ClosedSubmaps
from .frame_initialisation import summarise
from .graph import SubmapGraph
from .landmark_index import LandmarkIndex, refuse_link_names, slot_of_link
from .merging import merged
from .store import FolderStore, MemoryStore, Submap, SubmapStore

SHAPES = {
    "start": (4, 3),
    "present": (4, 3),
    "joined": (-1, 3),
}


class SavedRun(NamedTuple):
    """Contents of a saved state."""

    local: dict[str, Any]
    neighbourhood: dict[str, Any]
    """Empty if ``local_view`` was never called."""
    landmarks: LandmarkIndex
    chain: Chain
    closed: ClosedSubmaps


def as_arrays(
    name: str, graph: SubmapGraph, neighbourhood: Mapping[str, Any]
) -> dict[str, Any]:
    """Return copies of the whole state; submaps in a folder by their checksums."""
    index, closed, store = graph.index, graph.closed, graph.closed.store
    local = graph.active.filter.state_dict()
    renamed = np.array(list(closed.renamed.items()), dtype=np.int64)
    state: dict[str, Any] = {
        "estimator": np.array(name),
        "base": np.array(str(local["estimator"])),
        "landmark_ids": np.array(list(index), dtype=np.int64),
        "slots": np.array(list(index.values()), dtype=np.int64),
        "slot_count": np.array(index.count),
        "renamed": renamed.reshape(-1, 2),
        "submap_count": np.array(len(store)),
        "run": np.array(""),
    }
    state |= {f"local_{key}": value for key, value in local.items()}
    state |= {f"vicinity_{key}": value for key, value in neighbourhood.items()}
    state |= {f"chain_{key}": value for key, value in graph.chain.state_dict().items()}
    if isinstance(store, FolderStore):
        digests = np.array(store.digests, dtype=np.int64)
        return state | {"run": np.array(store.run), "digests": digests}
    for k in range(len(store)):
        for key, part in zip(Submap._fields, store.load(k), strict=True):
            state[f"submap_{k}_{key}"] = part.copy()
    return state


def checked_state(
    state: Mapping[str, Any],
    name: str,
    active: ActiveSubmap,
    folder: FolderStore | None,
) -> SavedRun:
    """Return the contents of a state that :func:`as_arrays` saved.

    Parameters
    ----------
    state : mapping
        From :func:`as_arrays`.
    name : str
        Class of the estimator that loads the state.
    active : ActiveSubmap
        Of that estimator; it is not changed.
    folder : FolderStore or None
        Of that estimator; it is not changed.

    Raises
    ------
    ValueError
        If the state is incomplete or inconsistent.
    """
    entries = ["landmark_ids", "slots", "slot_count", "renamed", "submap_count", "run"]
    entries += ["local_estimator", *(f"chain_{key}" for key in SHAPES)]
    base = type(active.filter).__name__
    saved_states.refuse_other_state(state, entries, estimator=name, base=base)
    index = _index(state)
    count = saved_states.whole_number("submap_count", state["submap_count"])
    chain = _chain(state, count)
    store = _store(state, count, folder)
    pairs = _numbers(state, "renamed", index.count).reshape(-1, 2)
    renamed = dict(zip(*pairs.T.tolist(), strict=True))
    summaries = []
    for k in range(count):
        submap = store.load(k)
        _check(submap, k, index.count)
        summaries.append(summarise(merged(submap, renamed, active.frame)))
    closed = ClosedSubmaps(store, active.frame, renamed, summaries)
    local = _part(state, "local_")
    _check_names(local, index, closed)
    return SavedRun(local, _part(state, "vicinity_"), index, chain, closed)


def _part(state: Mapping[str, Any], start: str) -> dict[str, Any]:
    return {k.removeprefix(start): v for k, v in state.items() if k.startswith(start)}


def _numbers(state: Mapping[str, Any], key: str, limit: int) -> IntArray:
    numbers = np.asarray(state[key])
    if numbers.dtype.kind != "i" or not ((numbers >= 0) & (numbers < limit)).all():
        raise ValueError(f"state[{key!r}] must be whole numbers from 0 to {limit - 1}")
    return numbers


def _index(state: Mapping[str, Any]) -> LandmarkIndex:
    """Return the landmarks of the map with their slots."""
    ids = saved_states.landmark_ids("landmark_ids", state["landmark_ids"])
    refuse_link_names(ids)
    count = saved_states.whole_number("slot_count", state["slot_count"])
    slots = _numbers(state, "slots", count).ravel()
    if len(slots) != len(ids) or (np.diff(slots) <= 0).any():
        raise ValueError(
            f"state['slots'] must be {len(ids)} ascending numbers, one for each of "
            f"landmark_ids, got {slots.tolist()}"
        )
    return LandmarkIndex(dict(zip(ids, slots.tolist(), strict=True)), count)


def _check_names(
    local: Mapping[str, Any], index: LandmarkIndex, closed: ClosedSubmaps
) -> None:
    """Raise a ValueError if the active submap holds landmarks not in the map."""
    names = saved_states.landmark_ids(
        "local_landmark_ids", local.get("landmark_ids", ())
    )
    links = index.links(names)
    if unknown := {i for i in links if slot_of_link(i) not in closed.slots}:
        raise ValueError(
            f"state['local_landmark_ids'] must be in the map, got {min(unknown)}"
        )


def _chain(state: Mapping[str, Any], count: int) -> Chain:
    arrays = {}
    for key, shape in SHAPES.items():
        name = f"chain_{key}"
        array = saved_states.array(name, state[name], shape)
        if key == "joined":
            if not 1 <= len(array) <= count + 1:
                raise ValueError(
                    f"state[{name!r}] must have 1 to {count + 1} rows, got {len(array)}"
                )
        else:
            P = (array[1:] + array[1:].T) / 2
            saved_states.refuse_indefinite(f"state[{name!r}]", P)
        arrays[key] = array
    return Chain.restored(arrays)


def _store(
    state: Mapping[str, Any], count: int, folder: FolderStore | None
) -> SubmapStore:
    run = str(state["run"])
    if run:
        return _continued_folder(state, count, folder)
    if folder is None:
        return _memory_store(state, count)
    if count:
        raise ValueError(
            "state holds its submaps itself: make the estimator without folder"
        )
    return folder.continued("", [])


def _continued_folder(
    state: Mapping[str, Any], count: int, folder: FolderStore | None
) -> FolderStore:
    run = str(state["run"])
    if folder is None:
        raise ValueError(
            f"state was saved with a folder of submaps (run {run}): make the "
            "estimator with that folder"
        )
    digests = np.asarray(state.get("digests", ())).tolist()
    if len(digests) != count:
        raise ValueError(
            f"state['digests'] must have {count} entries, got {len(digests)}"
        )
    return folder.continued(run, digests)


def _memory_store(state: Mapping[str, Any], count: int) -> MemoryStore:
    store = MemoryStore()
    for k in range(count):
        keys = [f"submap_{k}_{key}" for key in Submap._fields]
        if not set(keys) <= set(state):
            raise ValueError(f"state must hold {keys}")
        slots, mean, covariance = (np.array(state[key]) for key in keys)
        store.append(Submap(slots, mean, covariance))
    return store


def _check(submap: Submap, index: int, landmarks: int) -> None:
    slots, mean, covariance = submap
    if slots.ndim != 1 or slots.dtype.kind != "i":
        raise ValueError(f"state['submap_{index}_slots'] must be whole numbers")
    size = 3 + 2 * len(slots)
    fits = mean.shape == (size,) and covariance.shape == (size, size)
    inside = slots.dtype.kind == "i" and all(0 <= s < landmarks for s in slots.tolist())
    if not (fits and inside):
        raise ValueError(f"submap {index} of the state does not fit the rest of it")
    saved_states.array(f"submap_{index}_mean", mean, (size,))
    P = saved_states.array(f"submap_{index}_covariance", covariance, (size, size))
    saved_states.refuse_indefinite(f"state['submap_{index}_covariance']", (P + P.T) / 2)
