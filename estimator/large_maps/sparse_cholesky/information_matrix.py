"""A large sparse information matrix over landmarks, and what it says about a part."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve
from scipy.sparse import bsr_array, csc_array
from scipy.sparse.linalg import splu

Array = NDArray[np.float64]
Int = NDArray[np.int64]
Solver = Callable[[Array], Array]

# Below this many landmarks a dense Cholesky factor is the faster one.
DENSE = 150


class InformationMatrix:
    """Symmetric sparse matrix of 2 × 2 blocks, one row of blocks for each landmark.

    Row i holds the landmarks that i is linked with, itself among them, and the blocks
    that link them.  Rows are exchanged singly, so that work on a few landmarks costs
    the same in a map of any size.
    """

    def __init__(self) -> None:
        self._links: list[Int] = []
        self._blocks: list[Array] = []
        self._place = np.zeros(0, dtype=np.int64)  # -1 but while a method runs

    def __len__(self) -> int:
        return len(self._links)

    @property
    def nbytes(self) -> int:
        """Memory that links and blocks take [bytes]."""
        return sum(
            links.nbytes + blocks.nbytes + 220  # two array objects
            for links, blocks in zip(self._links, self._blocks, strict=True)
        )

    @property
    def block_count(self) -> int:
        """Number of 2 × 2 blocks that are not zero."""
        return sum(map(len, self._links))

    def grow(self, count: int) -> None:
        """Append empty rows until there are ``count``."""
        for _ in range(count - len(self)):
            self._links.append(np.empty(0, dtype=np.int64))
            self._blocks.append(np.empty((0, 2, 2)))
        if len(self._place) < count:
            self._place = np.full(2 * count, -1, dtype=np.int64)

    def dense(self, slots: Int) -> Array:
        """Return the rows and columns of a few landmarks, shape (2k, 2k)."""
        return np.asarray(self.part(slots, slots).toarray())

    def diagonal(self, slots: Int) -> Array:
        """Return the blocks of single landmarks, shape (k, 2, 2)."""
        counts, links, blocks = self._gather(slots)
        return np.asarray(blocks[links == np.repeat(slots, counts)])

    def part(self, rows: Int, columns: Int) -> bsr_array:
        """Return the blocks of some rows and columns, shape (2r, 2c), sparse."""
        shape = (2 * len(rows), 2 * len(columns))
        if not (len(rows) and len(columns)):
            return bsr_array(shape)
        counts, links, blocks = self._gather(rows)
        self._place[columns] = np.arange(len(columns))
        place = self._place[links]
        self._place[columns] = -1
        wanted = place >= 0
        owner = np.repeat(np.arange(len(rows)), counts)[wanted]
        starts = np.searchsorted(owner, np.arange(len(rows) + 1))
        return bsr_array((blocks[wanted], place[wanted], starts), shape=shape)

    def put(self, slots: Int, dense: Array) -> None:
        """Store the rows and columns of a few landmarks, leaving out zero blocks."""
        k = len(slots)
        blocks = dense.reshape(k, 2, k, 2).transpose(0, 2, 1, 3)
        linked = np.asarray(blocks.any(axis=(2, 3)))
        inside = self._place
        inside[slots] = 0
        for i, slot in enumerate(slots.tolist()):
            links = self._links[slot]
            kept = inside[links] < 0
            new = linked[i]
            self._links[slot] = np.concatenate([links[kept], slots[new]])
            self._blocks[slot] = np.concatenate(
                [self._blocks[slot][kept], blocks[i, new]]
            )
        inside[slots] = -1

    def around(self, slots: Int, count: float) -> Int:
        """Return up to ``count`` landmarks linked with these, the closest links first.

        The given ones are not among them.  An infinite count gives all others that
        have a row, linked or not.
        """
        if not np.isfinite(count):
            others = np.array([len(links) > 0 for links in self._links], dtype=bool)
            others[slots] = False
            return np.flatnonzero(others)
        found: list[Int] = []
        missing, front, place = int(count), slots, self._place
        place[slots] = 0
        while missing > 0 and len(front):
            front = np.unique(self._gather(front)[1])
            front = front[place[front] < 0][:missing]
            place[front] = 0
            found.append(front)
            missing -= len(front)
        result = np.concatenate([*found, np.empty(0, dtype=np.int64)])
        place[slots] = place[result] = -1
        return result

    def links(self, slot: int) -> Int:
        """Return what a landmark is linked with, itself among it."""
        return self._links[slot]

    def filled(self, slots: Int) -> NDArray[np.bool_]:
        """Whether anything is known about each of some landmarks."""
        return np.array([len(self._links[i]) > 0 for i in slots.tolist()], dtype=bool)

    def rows(self, slots: Int) -> tuple[Int, Int, Array]:
        """Return the rows of some landmarks: lengths, links and blocks, in sequence."""
        return self._gather(slots)

    def neighbours(self, slots: Int) -> Int:
        """Return all landmarks linked with these and not among them."""
        if not len(slots):
            return slots
        return np.setdiff1d(self._gather(slots)[1], slots)

    def clear(self, slots: Int) -> None:
        """Empty rows that no other row links to any more."""
        for slot in slots.tolist():
            self._links[slot] = np.empty(0, dtype=np.int64)
            self._blocks[slot] = np.empty((0, 2, 2))

    def state_dict(self) -> dict[str, Array | Int]:
        """Return copies of all rows, one after another."""
        counts, links, blocks = self._gather(np.arange(len(self)))
        return {"counts": counts, "links": links, "blocks": blocks}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Take rows that :meth:`state_dict` returned; or refuse them."""
        counts, links = (
            np.asarray(state[key]).astype(np.int64) for key in ("counts", "links")
        )
        blocks = np.asarray(state["blocks"], dtype=np.float64)
        if counts.sum() != len(links) or blocks.shape != (len(links), 2, 2):
            raise ValueError(
                f"state['matrix_links'] and state['matrix_blocks'] must have "
                f"{counts.sum()} rows, got {len(links)} and {blocks.shape}"
            )
        if len(links) and not 0 <= links.min() <= links.max() < len(counts):
            raise ValueError(
                f"state['matrix_links'] must lie in [0, {len(counts)}), got "
                f"{links.min()} to {links.max()}"
            )
        if not np.isfinite(blocks).all():
            raise ValueError("state['matrix_blocks'] must be finite")
        ends = np.cumsum(counts)[:-1]
        self._links = [part.copy() for part in np.split(links, ends)][: len(counts)]
        self._blocks = [part.copy() for part in np.split(blocks, ends)][: len(counts)]
        self._place = np.full(2 * len(counts), -1, dtype=np.int64)

    def _gather(self, slots: Int) -> tuple[Int, Int, Array]:
        """Return the rows of some landmarks: lengths, links and blocks."""
        rows: Sequence[int] = slots.tolist()
        if not rows:
            nothing = np.empty(0, dtype=np.int64)
            return nothing, nothing, np.empty((0, 2, 2))
        links = [self._links[i] for i in rows]
        counts = np.array([len(each) for each in links], dtype=np.int64)
        blocks = np.concatenate([self._blocks[i] for i in rows])
        return counts, np.concatenate(links), blocks


class Surroundings(NamedTuple):
    """What landmarks H around a local map L mean for it.

    ::

        Λ_LL δ_L + Λ_LH δ_H = b_L,   Λ_HL δ_L + Λ_HH δ_H = 0
        ⟹ (Λ_LL − C) δ_L = b_L,   δ_H = −T δ_B,   T = Λ_HH⁻¹ Λ_HB,   C = Λ_BH T

    where B ⊂ L are the local landmarks that H is linked with.
    """

    slots: Int
    """H."""
    border: Int
    """Columns of B in L, shape (c,)."""
    response: Array
    """T, shape (2h, c); not made, (0, c), where H is all of the map."""
    complement: Array
    """C, shape (c, c), symmetric."""
    solve: Solver
    """b ↦ Λ_HH⁻¹ b."""
    respond: Solver
    """δ_B ↦ T δ_B."""


def surround(matrix: InformationMatrix, local: Int, around: Int) -> Surroundings:
    """Eliminate the landmarks ``around`` a local map.

    Raises
    ------
    numpy.linalg.LinAlgError
        Where their information is not positive definite.
    """
    link = matrix.part(around, local).tocsc()
    border = np.flatnonzero(np.diff(link.indptr))
    right = link[:, border].toarray()
    solve = solver(matrix, around)
    # One layout in memory: after a trip through a file BLAS must give the same bits.
    response = np.ascontiguousarray(solve(right) if len(border) else right)
    complement = right.T @ response
    return Surroundings(
        around,
        border,
        response,
        (complement + complement.T) / 2,
        solve,
        response.__matmul__,
    )


def solver(matrix: InformationMatrix, slots: Int) -> Solver:
    """Factorise the rows and columns of some landmarks."""
    if not len(slots):
        return np.copy
    if len(slots) <= DENSE:
        factor = cho_factor(matrix.dense(slots), lower=True, check_finite=False)
        return lambda right: np.asarray(cho_solve(factor, right, check_finite=False))
    return sparse_solver(matrix.part(slots, slots).tocsc())


def sparse_solver(information: csc_array) -> Solver:
    """Factorise a sparse symmetric positive definite matrix."""
    try:
        factor = splu(
            information,
            permc_spec="MMD_AT_PLUS_A",
            diag_pivot_thresh=0.0,
            options={"SymmetricMode": True},
        )
    except RuntimeError as error:
        raise np.linalg.LinAlgError(
            f"the information matrix is not positive definite: {error}"
        ) from error

    def solve(right: Array) -> Array:
        return np.asarray(factor.solve(np.ascontiguousarray(right)))

    return solve
