"""Closed submaps: kept in memory, or in a folder with a few of them at hand."""

import os
import zlib
from collections import OrderedDict
from io import BytesIO
from pathlib import Path
from typing import NamedTuple, Protocol
from uuid import uuid4

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Int = NDArray[np.int64]

AT_HAND = 8
"""Submaps of a folder that are kept in memory."""
MARK = "submaps.txt"
FORMAT = "slamgym submaps 1"
SUFFIX, PART = ".npy", ".part"


class LostSubmapError(ValueError):
    """A closed submap cannot be read any more."""


class Submap(NamedTuple):
    """What one closed submap says, in its own frame."""

    slots: Int
    """Places of its landmarks in the whole map, shape (n,)."""
    mean: Array
    """Its last pose, where the next one begins, and its landmarks, shape (3 + 2n,)."""
    covariance: Array
    """Of its error, in the coordinates of its filter, shape (3 + 2n, 3 + 2n)."""


class SubmapStore(Protocol):
    """Where closed submaps are."""

    def __len__(self) -> int: ...

    def append(self, submap: Submap) -> None:
        """Keep one more."""

    def load(self, index: int) -> Submap:
        """Return one of them; its arrays are not to be written to."""
        ...

    @property
    def nbytes(self) -> int:
        """Memory that they take [bytes]."""
        ...


class MemoryStore:
    """Closed submaps in memory."""

    def __init__(self) -> None:
        self._submaps: list[Submap] = []

    def __len__(self) -> int:
        return len(self._submaps)

    def append(self, submap: Submap) -> None:
        """Keep one more."""
        self._submaps.append(submap)

    def load(self, index: int) -> Submap:
        """Return one of them."""
        return self._submaps[index]

    @property
    def nbytes(self) -> int:
        """Memory that they take [bytes]."""
        return sum(part.nbytes for submap in self._submaps for part in submap)


class FolderStore:
    """Closed submaps of one run in a folder, a few of them at hand in memory.

    The file ``submaps.txt`` marks the folder and names the run; every submap is a file
    of its own, of which the checksum is remembered.

    Parameters
    ----------
    folder : str or path
        A folder that is empty or does not exist yet, or that of an earlier run.

    Raises
    ------
    ValueError
        Where it is something else; nothing is written to it then.
    """

    def __init__(self, folder: str | os.PathLike[str]) -> None:
        if not isinstance(folder, str | os.PathLike):
            raise ValueError(f"folder must be a path, got {folder!r}")
        self.folder = Path(folder)
        self.run = ""
        self.digests: list[int] = []
        self._at_hand: OrderedDict[int, Submap] = OrderedDict()
        self._found_run()

    def __len__(self) -> int:
        return len(self.digests)

    @property
    def nbytes(self) -> int:
        """Memory that those at hand take [bytes]."""
        return sum(part.nbytes for submap in self._at_hand.values() for part in submap)

    def claim(self) -> None:
        """Mark the folder as that of a new run, or refuse where it holds another.

        Raises
        ------
        ValueError
            Where the folder holds submaps of another run.
        """
        if self.run:
            return
        self._refuse(self._found_run())
        self.folder.mkdir(parents=True, exist_ok=True)
        self.run = uuid4().hex
        (self.folder / MARK).write_text(f"{FORMAT}\nrun {self.run}\n", encoding="utf-8")

    def continued(self, run: str, digests: list[int]) -> "FolderStore":
        """Return this folder as the one of a run to be continued.

        Parameters
        ----------
        run : str
            The run that was saved; "" where that was before its first step.
        digests : list of int
            Checksums of its submaps.

        Raises
        ------
        ValueError
            Where the folder is of another run, or lacks a submap.
        """
        store = FolderStore(self.folder)
        found = store._found_run()
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
        """Forget the run, and delete its files."""
        if self.run and self._found_run() == self.run:
            for path in self.folder.glob("submap_[0-9]*"):
                if path.suffix in (SUFFIX, PART):  # also later ones than are known
                    path.unlink()
            (self.folder / MARK).unlink()
        self.run, self.digests = "", []
        self._at_hand = OrderedDict()

    def append(self, submap: Submap) -> None:
        """Write one more submap."""
        content = _written(submap)
        path = self._path(len(self))
        part = path.with_suffix(PART)
        part.write_bytes(content)
        part.replace(path)
        self._keep(len(self), submap)
        self.digests.append(zlib.crc32(content))

    def load(self, index: int) -> Submap:
        """Return a submap, read from its file where it is not at hand.

        Raises
        ------
        LostSubmapError
            Where its file is missing, or is not the one written.
        """
        if index in self._at_hand:
            self._at_hand.move_to_end(index)
            return self._at_hand[index]
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
        self._keep(index, submap)
        return submap

    def _keep(self, index: int, submap: Submap) -> None:
        self._at_hand[index] = submap
        if len(self._at_hand) > AT_HAND:
            self._at_hand.popitem(last=False)

    def _path(self, index: int) -> Path:
        return self.folder / f"submap_{index:06}{SUFFIX}"

    def _refuse(self, found: str) -> None:
        if found:
            raise ValueError(
                f"folder {self.folder} holds the submaps of another run ({found}): "
                "continue that one by load_state_dict, or give an empty folder"
            )

    def _found_run(self) -> str:
        """Return the run that the folder is of, "" where it is free."""
        if not self.folder.exists():
            return ""
        if not self.folder.is_dir():
            raise ValueError(f"folder must be a folder, got the file {self.folder}")
        if not any(self.folder.iterdir()):
            return ""
        mark = self.folder / MARK
        lines = mark.read_text(encoding="utf-8").split("\n") if mark.is_file() else []
        if len(lines) < 2 or lines[0] != FORMAT or not lines[1].startswith("run "):
            raise ValueError(
                f"folder must be empty or hold submaps, but {self.folder} holds other "
                f"files and no {MARK} of {FORMAT!r}"
            )
        return lines[1].removeprefix("run ")


def _written(submap: Submap) -> bytes:
    stream = BytesIO()
    for part in submap:
        np.save(stream, part, allow_pickle=False)
    return stream.getvalue()


def _read(content: bytes) -> Submap:
    stream = BytesIO(content)
    return Submap(*(np.load(stream, allow_pickle=False) for _ in Submap._fields))
