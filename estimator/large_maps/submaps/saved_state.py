"""A run in submaps as arrays, to save and to continue from."""

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...support import argument_checks
from .active_submap import PresentSubmap
from .chain import Chain
from .closed_submaps import ClosedSubmaps
from .frame_initialisation import outline_of
from .graph import SubmapRun
from .landmark_index import Slots, refuse_link_names, slot_of_link
from .merging import merged
from .store import FolderStore, MemoryStore, Submap, SubmapStore

Array = NDArray[np.float64]
Int = NDArray[np.int64]

SHAPES = {
    "start": (4, 3),
    "present": (4, 3),
    "joined": (-1, 3),
}


class SavedRun(NamedTuple):
    """What a saved state holds."""

    local: dict[str, Any]
    vicinity: dict[str, Any]
    """Empty where nobody has looked around."""
    slots: Slots
    chain: Chain
    closed: ClosedSubmaps


def as_arrays(name: str, run: SubmapRun, vicinity: Mapping[str, Any]) -> dict[str, Any]:
    """Return copies of everything; submaps in a folder by their checksums."""
    slots, closed, store = run.slots, run.closed, run.closed.store
    local = run.present.filter.state_dict()
    renamed = np.array(list(closed.renamed.items()), dtype=np.int64)
    state: dict[str, Any] = {
        "estimator": np.array(name),
        "base": np.array(str(local["estimator"])),
        "landmark_ids": np.array(list(slots), dtype=np.int64),
        "slots": np.array(list(slots.values()), dtype=np.int64),
        "slot_count": np.array(slots.count),
        "renamed": renamed.reshape(-1, 2),
        "submap_count": np.array(len(store)),
        "run": np.array(""),
    }
    state |= {f"local_{key}": value for key, value in local.items()}
    state |= {f"vicinity_{key}": value for key, value in vicinity.items()}
    state |= {f"chain_{key}": value for key, value in run.chain.state_dict().items()}
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
    present: PresentSubmap,
    folder: FolderStore | None,
) -> SavedRun:
    """Return what the state holds, or refuse it.

    Parameters
    ----------
    state : mapping
        From :func:`as_arrays`.
    name : str
        Class of the estimator that is to continue.
    present : PresentSubmap
        Of that estimator, which is left as it is.
    folder : FolderStore or None
        Likewise its folder.

    Raises
    ------
    ValueError
        Where something is missing or does not fit together.
    """
    entries = ["landmark_ids", "slots", "slot_count", "renamed", "submap_count", "run"]
    entries += ["local_estimator", *(f"chain_{key}" for key in SHAPES)]
    base = type(present.filter).__name__
    argument_checks.refuse_other_state(state, entries, estimator=name, base=base)
    slots = _slots(state)
    count = int(state["submap_count"])
    chain = _chain(state, count)
    store = _store(state, count, folder)
    pairs = _numbers(state, "renamed", slots.count).reshape(-1, 2)
    renamed = dict(zip(*pairs.T.tolist(), strict=True))
    outlines = []
    for k in range(count):
        submap = store.load(k)
        _check(submap, k, slots.count)
        outlines.append(outline_of(merged(submap, renamed, present.frame)))
    closed = ClosedSubmaps(store, present.frame, renamed, outlines)
    local = _part(state, "local_")
    _check_names(local, slots, closed)
    return SavedRun(local, _part(state, "vicinity_"), slots, chain, closed)


def _part(state: Mapping[str, Any], start: str) -> dict[str, Any]:
    return {k.removeprefix(start): v for k, v in state.items() if k.startswith(start)}


def _numbers(state: Mapping[str, Any], key: str, limit: int) -> Int:
    numbers = np.asarray(state[key])
    if numbers.dtype.kind != "i" or not ((numbers >= 0) & (numbers < limit)).all():
        raise ValueError(f"state[{key!r}] must be whole numbers from 0 to {limit - 1}")
    return numbers


def _slots(state: Mapping[str, Any]) -> Slots:
    """Return who stands where in the map, in its order."""
    saved = np.asarray(state["landmark_ids"])
    ids = argument_checks.identities(saved, saved.size)
    refuse_link_names(ids)
    count = int(state["slot_count"])
    slots = _numbers(state, "slots", count).ravel()
    if len(slots) != len(ids) or (np.diff(slots) <= 0).any():
        raise ValueError(
            f"state['slots'] must be {len(ids)} ascending numbers, one for each of "
            f"landmark_ids, got {slots.tolist()}"
        )
    return Slots(dict(zip(ids, slots.tolist(), strict=True)), count)


def _check_names(local: Mapping[str, Any], slots: Slots, closed: ClosedSubmaps) -> None:
    """Refuse a present submap of landmarks that are not in the map."""
    names = np.asarray(local.get("landmark_ids", ())).ravel().tolist()
    links = slots.links(names)
    if unknown := {i for i in links if slot_of_link(i) not in closed.slots}:
        raise ValueError(
            f"state['local_landmark_ids'] must be in the map, got {min(unknown)}"
        )


def _chain(state: Mapping[str, Any], count: int) -> Chain:
    arrays = {}
    for key, shape in SHAPES.items():
        array = argument_checks.as_floats(
            f"state['chain_{key}']", state[f"chain_{key}"]
        )
        fits = array.ndim == 2 and array.shape[1] == 3
        if key == "joined":
            fits = fits and 1 <= len(array) <= count + 1
        if not (fits and shape[0] in (-1, len(array))):
            raise ValueError(
                f"state['chain_{key}'] must have shape {shape}, got {array.shape}"
            )
        if not np.isfinite(array).all():
            raise ValueError(f"state['chain_{key}'] must be finite")
        arrays[key] = array
    return Chain.restored(arrays)


def _store(
    state: Mapping[str, Any], count: int, folder: FolderStore | None
) -> SubmapStore:
    run = str(state["run"])
    if run:
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
    if folder is not None:
        if count:
            raise ValueError(
                "state holds its submaps itself: make the estimator without folder"
            )
        return folder.continued("", [])
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
    size = 3 + 2 * len(slots)
    fits = mean.shape == (size,) and covariance.shape == (size, size)
    inside = slots.dtype.kind == "i" and all(0 <= s < landmarks for s in slots.tolist())
    if not (fits and inside):
        raise ValueError(f"submap {index} of the state does not fit the rest of it")
    if not (np.isfinite(mean).all() and np.isfinite(covariance).all()):
        raise ValueError(f"submap {index} of the state must be finite")
