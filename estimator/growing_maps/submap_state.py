"""A run in submaps as arrays, to save and to continue from."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from .. import validation
from .submap_chain import Chain
from .submap_placing import Outline
from .submap_store import FolderStore, MemoryStore, Submap, SubmapStore

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
    near: tuple[int, ...]
    """Landmarks of the present submap."""
    slots: dict[int, int]
    outlines: list[Outline]
    chain: Chain
    store: SubmapStore


def as_arrays(
    name: str,
    local: Mapping[str, Any],
    landmark_ids: Sequence[int],
    chain: Chain,
    store: SubmapStore,
) -> dict[str, Any]:
    """Return copies of everything; submaps in a folder by their checksums."""
    state: dict[str, Any] = {
        "estimator": np.array(name),
        "base": np.array(str(local["estimator"])),
        "landmark_ids": np.array(landmark_ids, dtype=np.int64),
        "submap_count": np.array(len(store)),
        "run": np.array(""),
    }
    state |= {f"local_{key}": value for key, value in local.items()}
    state |= {f"chain_{key}": value for key, value in chain.state_dict().items()}
    if isinstance(store, FolderStore):
        digests = np.array(store.digests, dtype=np.int64)
        return state | {"run": np.array(store.run), "digests": digests}
    for k in range(len(store)):
        for key, part in zip(Submap._fields, store.load(k), strict=True):
            state[f"submap_{k}_{key}"] = part.copy()
    return state


def checked_state(
    state: Mapping[str, Any], name: str, base: str, folder: FolderStore | None
) -> SavedRun:
    """Return what the state holds, or refuse it.

    Parameters
    ----------
    state : mapping
        From :func:`as_arrays`.
    name, base : str
        Classes of the estimator that is to continue, and of the filter of its submaps.
    folder : FolderStore or None
        The folder of that estimator, which is left as it is.

    Raises
    ------
    ValueError
        Where something is missing or does not fit together.
    """
    entries = ["landmark_ids", "submap_count", "run", "local_estimator"]
    entries += [f"chain_{key}" for key in SHAPES]
    validation.refuse_other_state(state, entries, estimator=name, base=base)
    saved = np.asarray(state["landmark_ids"])
    ids = validation.identities(saved, saved.size)
    count = int(state["submap_count"])
    chain = _chain(state, count)
    store = _store(state, count, folder)
    outlines = []
    for k in range(count):
        submap = store.load(k)
        _check(submap, k, len(ids))
        outlines.append(outline_of(submap))
    local = {
        key.removeprefix("local_"): value
        for key, value in state.items()
        if key.startswith("local_")
    }
    slots = {i: slot for slot, i in enumerate(ids)}
    near = tuple(np.asarray(local.get("landmark_ids", ())).ravel().tolist())
    if unknown := set(near) - set(slots):
        raise ValueError(
            f"state['local_landmark_ids'] must be in the map, got {min(unknown)}"
        )
    return SavedRun(local, near, slots, outlines, chain, store)


def outline_of(submap: Submap) -> Outline:
    """Return what is kept at hand of a submap."""
    return Outline(submap.slots, submap.mean, submap.covariance[:3, :3].copy())


def _chain(state: Mapping[str, Any], count: int) -> Chain:
    arrays = {}
    for key, shape in SHAPES.items():
        array = validation.as_floats(f"state['chain_{key}']", state[f"chain_{key}"])
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
        return FolderStore(folder.folder)
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
