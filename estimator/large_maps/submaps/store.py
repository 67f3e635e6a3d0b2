"""Storage of closed submaps: in memory, or in a folder with a small cache.

`LandmarkIndex` gives each landmark its slot in the whole map.
"""

import os
import zlib
from collections import OrderedDict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from io import BytesIO
from pathlib import Path
from typing import NamedTuple
from uuid import uuid4

import numpy as np

from ....argument_checks import LOWEST_ID
from ....arrays import Array, IntArray
from ..undo import Undo

CACHE_SIZE = 8  # number of submaps of a folder that are kept in memory
MARKER = "submaps.txt"
FORMAT = "slamgym submaps 1"
SUFFIX, PART = ".npy", ".part"


class LostSubmapError(ValueError):
    """A closed submap cannot be read."""


class Submap(NamedTuple):
    """A closed submap in its own frame."""

    slots: IntArray  # slots of its landmarks in the whole map, shape (n,)
    # Last pose, where the next submap begins, and landmarks, shape (3 + 2n,).
    mean: Array
    # Covariance of the error in its filter's frame, shape (3 + 2n, 3 + 2n).
    covariance: Array


class MemoryStore:
    """Closed submaps in memory."""

    def __init__(self) -> None:
        self._submaps: list[Submap] = []

    def __len__(self) -> int:
        return len(self._submaps)

    def append(self, submap: Submap) -> None:
        """Append a submap."""
        self._submaps.append(submap)

    def truncate(self, count: int) -> None:
        """Forget all submaps but the first ``count``."""
        del self._submaps[count:]

    def load(self, index: int) -> Submap:
        """Return a submap."""
        return self._submaps[index]

    @property
    def nbytes(self) -> int:
        """Memory of the submaps [bytes]."""
        return sum(part.nbytes for submap in self._submaps for part in submap)


class FolderStore:
    """Closed submaps of one run in a folder, with a small cache in memory.

    The file ``submaps.txt`` marks the folder and names the run.  Each submap is one
    file, whose checksum is stored in memory.

    Parameters
    ----------
    folder : str or path
        A folder that is empty, does not exist yet, or holds an earlier run.

    Raises
    ------
    ValueError
        If it is anything else; nothing is written.
    """

    def __init__(self, folder: str | os.PathLike[str]) -> None:
        if not isinstance(folder, str | os.PathLike):
            raise ValueError(f"folder must be a path, got {folder!r}")
        self.folder = Path(folder)
        self.run = ""
        self.digests: list[int] = []
        self._cache: OrderedDict[int, Submap] = OrderedDict()
        self._found_run()

    def __len__(self) -> int:
        return len(self.digests)

    @property
    def nbytes(self) -> int:
        """Memory of the cached submaps [bytes]."""
        return sum(part.nbytes for submap in self._cache.values() for part in submap)

    def claim(self) -> None:
        """Mark the folder as that of a new run.

        Raises
        ------
        ValueError
            If the folder holds submaps of another run.
        """
        if self.run:
            return
        self._refuse(self._found_run())
        self.folder.mkdir(parents=True, exist_ok=True)
        self.run = uuid4().hex
        (self.folder / MARKER).write_text(
            f"{FORMAT}\nrun {self.run}\n", encoding="utf-8"
        )

    def continued(self, run: str, digests: list[int]) -> "FolderStore":
        """Return a store that continues a saved run in this folder.

        Parameters
        ----------
        run : str
            The saved run; "" if it was saved before its first step.
        digests : list of int
            Checksums of the submaps.

        Raises
        ------
        ValueError
            If the folder holds another run.
        """
        store = FolderStore(self.folder)
        found = self._found_run()
        if not run:
            if found != self.run:
                self._refuse(found)
            run = found
        if found != run:
            raise ValueError(
                f"folder {self.folder} must hold the submaps of run {run}, but it "
                + (f"is of run {found}" if found else "holds none")
            )
        store.run, store.digests = run, digests
        return store

    def clear(self) -> None:
        """Delete the files of the run."""
        if self.run and self._found_run() == self.run:
            # This also deletes files that are newer than a loaded state.
            for path in self.folder.glob("submap_[0-9]*"):
                if path.suffix in (SUFFIX, PART):
                    path.unlink()
            (self.folder / MARKER).unlink()
        self.run, self.digests = "", []
        self._cache = OrderedDict()

    def append(self, submap: Submap) -> None:
        """Write a submap."""
        content = _written(submap)
        path = self._path(len(self))
        part = path.with_suffix(PART)
        part.write_bytes(content)
        part.replace(path)
        self._cache_submap(len(self), submap)
        self.digests.append(zlib.crc32(content))

    def truncate(self, count: int) -> None:
        """Forget all but the first ``count``; later ones replace the files."""
        for index in [index for index in self._cache if index >= count]:
            self._cache.pop(index, None)
        del self.digests[count:]

    def load(self, index: int) -> Submap:
        """Return a submap, from the cache or its file.

        Raises
        ------
        LostSubmapError
            If its file is missing or does not match the checksum.
        """
        if index in self._cache:
            self._cache.move_to_end(index)
            return self._cache[index]
        path = self._path(index)
        try:
            content = path.read_bytes()
        except OSError as error:
            raise LostSubmapError(f"submap {index} cannot be read: {error}") from None
        if zlib.crc32(content) != self.digests[index]:
            raise LostSubmapError(
                f"{path} is damaged, or not the submap that was written"
            )
        submap = _read(content)
        self._cache_submap(index, submap)
        return submap

    def _cache_submap(self, index: int, submap: Submap) -> None:
        self._cache[index] = submap
        if len(self._cache) > CACHE_SIZE:
            self._cache.popitem(last=False)

    def _path(self, index: int) -> Path:
        return self.folder / f"submap_{index:06}{SUFFIX}"

    def _refuse(self, found: str) -> None:
        if found:
            raise ValueError(
                f"folder {self.folder} holds the submaps of another run ({found}): "
                "continue that one by load_state_dict, or give an empty folder"
            )

    def _found_run(self) -> str:
        """Return the run of the folder; "" if the folder is free."""
        if not self.folder.exists():
            return ""
        if not self.folder.is_dir():
            raise ValueError(f"folder must be a folder, got the file {self.folder}")
        if not any(self.folder.iterdir()):
            return ""
        mark = self.folder / MARKER
        lines = mark.read_text(encoding="utf-8").split("\n") if mark.is_file() else []
        if len(lines) < 2 or lines[0] != FORMAT or not lines[1].startswith("run "):
            raise ValueError(
                f"folder must be empty or hold submaps, but {self.folder} holds other "
                f"files and no {MARKER} of {FORMAT!r}"
            )
        return lines[1].removeprefix("run ")


SubmapStore = MemoryStore | FolderStore


def _written(submap: Submap) -> bytes:
    stream = BytesIO()
    for part in submap:
        np.save(stream, part, allow_pickle=False)
    return stream.getvalue()


def _read(content: bytes) -> Submap:
    stream = BytesIO(content)
    return Submap(*(np.load(stream, allow_pickle=False) for _ in Submap._fields))


# --------------------------------------------------------------------------------------
# Slot of each landmark in the whole map, and names of removed landmarks.
#
# A landmark that several submaps hold connects them.  If it is removed, it remains as a
# *link*: it keeps its slot and, in the active submap, has a name that no landmark can
# have.  No belief contains it, and the same landmark seen again is a new one.


class LandmarkIndex(Mapping[int, int]):
    """Slot of each mapped landmark, in the order of the map; slots are not reused.

    Parameters
    ----------
    slots : mapping
        Slot by landmark, in ascending order.
    count : int
        Number of slots assigned so far.

    Examples
    --------
    >>> index = LandmarkIndex()
    >>> index.add([7, 9])
    >>> index.remove(7)
    0
    >>> index.add([7])
    >>> dict(index)
    {9: 1, 7: 2}
    """

    def __init__(self, slots: Mapping[int, int] | None = None, count: int = 0) -> None:
        self._slots, self.count = dict(slots or {}), count

    def __getitem__(self, landmark_id: int) -> int:
        return self._slots[landmark_id]

    def __iter__(self) -> Iterator[int]:
        return iter(self._slots)

    def __len__(self) -> int:
        return len(self._slots)

    def __contains__(self, landmark_id: object) -> bool:
        return landmark_id in self._slots  # faster than that of Mapping

    def add(self, landmark_ids: Iterable[int]) -> None:
        """Assign a slot to each new landmark."""
        for i in landmark_ids:
            self._slots[i] = self.count
            self.count += 1

    def remove(self, landmark_id: int) -> int:
        """Remove a landmark; return its slot, which is not used again."""
        slots = dict(self._slots)
        slot = slots.pop(landmark_id)
        self._slots = slots
        return slot

    def checkpoint(self) -> Undo:
        """Return what takes back later changes, at a cost of the landmarks added."""
        slots, count = self._slots, self.count

        def undo() -> None:
            while slots and slots[next(reversed(slots))] >= count:
                slots.popitem()
            self._slots, self.count = slots, count

        return undo

    def slots_of(self, names: Sequence[int]) -> IntArray:
        """Return the slots of landmarks and links by their names, shape (n,)."""
        known = [*map(self._slots.get, names)]
        if None in known:
            known = [self._slots.get(name, slot_of_link(name)) for name in names]
        return np.array(known, dtype=np.int64)


def link_name(slot: int) -> int:
    """Return the name of a removed landmark in the active submap.

    Examples
    --------
    >>> slot_of_link(link_name(5))
    5
    """
    return slot + LOWEST_ID


def slot_of_link(name: int) -> int:
    """Return the slot of a link."""
    return name - LOWEST_ID
