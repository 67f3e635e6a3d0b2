"""A large Gaussian map whose update is deferred for all but the local landmarks."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ....arrays import Array, IntArray
from ...filters.ekf import EkfSlam
from ...filters.invariant import InvariantEkfSlam
from ...interface import Belief
from ...support.argument_checks import LOWEST_ID
from ...support.memory_limit import covariance_bytes, refuse_beyond_memory
from ..sparse_cholesky.coordinates import pairs
from ..undo import Undo
from .active_set import choose_local, largest_whole_map
from .deferred_covariance import DeferredCovariance, subtract, symmetric
from .phase_update import (
    Phase,
    begin_phase,
    combine,
    end_phase,
    roots,
    virtual_landmarks,
)
from .saved_state import SavedState


class CompressedMap:
    """Belief of the whole map; the local part is that of an ordinary filter.

    Parameters
    ----------
    local_filter : EkfSlam
        Filters the pose and the local landmarks.
    """

    def __init__(self, local_filter: EkfSlam) -> None:
        self.filter = local_filter
        self.is_invariant = type(local_filter) is InvariantEkfSlam
        self.undo = Undo()

    def reset(self, pose: ArrayLike, pose_std: ArrayLike) -> None:
        """Start a new run with an empty map."""
        self.filter.reset(pose, pose_std)
        self.slots: dict[int, int] = {}  # position of each landmark in the arrays below
        self.free: list[int] = []
        self._points = np.zeros(0)
        self._references = np.zeros(0)
        self.deferred = DeferredCovariance()
        self.local: dict[int, None] = {}  # the local landmarks, in their order
        self._virtual = 0
        self._strip = np.zeros((3, 0))  # covariance of local and all other coordinates
        self._origin = self.filter.map.mean[:2].copy()  # start of the phase

    def add(self, ids: Sequence[int]) -> None:
        """Assign slots to landmarks that the filter has added."""
        for i in ids:
            self.slots[i] = self.free.pop() if self.free else len(self.slots)
            self.local[i] = None

    def remove(self, ids: Sequence[int]) -> None:
        """Marginalise landmarks."""
        self.filter.remove([i for i in ids if i in self.local])
        for i in ids:
            self._drop(i)

    def merge_pairs(self, pairs: Sequence[tuple[int, int]]) -> None:
        """Condition on local landmarks being the same; drop the second of each pair."""
        self.filter.merge_pairs(pairs)
        for _, gone in pairs:
            self._drop(gone)

    def belief(self, ids: Sequence[int]) -> Belief:
        """Return the marginal of the pose and some landmarks."""
        refuse_beyond_memory(
            f"belief() of {len(ids)} landmarks",
            2 * covariance_bytes(len(ids)),  # the belief takes a copy
            "give landmark_ids",
        )
        now = self._phase()
        order = {i: place for place, i in enumerate(self.local)}
        mean = np.zeros(3 + 2 * len(ids))
        covariance = np.zeros((len(mean), len(mean)))
        is_local = np.array([i in order for i in ids], dtype=bool)
        inside = np.r_[0:3, 3 + pairs(np.flatnonzero(is_local))]
        local = np.r_[0:3, 3 + pairs([order[i] for i in ids if i in order])]
        mean[inside] = now.mean[local]
        covariance[np.ix_(inside, inside)] = now.covariance[np.ix_(local, local)]
        if not is_local.all():
            outside = 3 + pairs(np.flatnonzero(~is_local))
            columns = self._columns([i for i in ids if i not in order])
            strip = np.ascontiguousarray(self._strip[:, columns])
            mean[outside] = self._points[columns] + self._combine(now.shift, strip)[0]
            cross = self._combine(now.gain[local], strip)
            covariance[np.ix_(inside, outside)] = cross
            covariance[np.ix_(outside, inside)] = cross.T
            root, signs = roots(now.loss, self.is_invariant)
            block = self.deferred.marginal(columns)
            subtract(block, self._combine(root, strip).T, signs)
            covariance[np.ix_(outside, outside)] = symmetric(block)
            del block  # frees memory before the belief takes its copy
        frame = self.filter.frame
        return Belief(mean, covariance, tuple(ids), frame)

    def ids_near(self, pose: Belief, within: float) -> list[int]:
        """Return the local landmarks and all that may lie within a distance [m].

        The distance is extended by 5 standard deviations.
        """
        others = [i for i in self.slots if i not in self.local]
        columns = self._columns(others)
        away = np.hypot(*(self._points[columns].reshape(-1, 2) - pose.pose[:2]).T)
        variances = self.deferred.diagonal()[columns].reshape(-1, 2).sum(axis=1)
        std = np.sqrt(variances) + np.sqrt(np.trace(pose.covariance[:2, :2]))
        too_far = {others[k] for k in np.flatnonzero(away > within + 5 * std)}
        return [i for i in self.slots if i not in too_far]

    def change_local_map(self, required: Sequence[int], size: int) -> None:
        """End the phase, and begin another one with a new local map.

        Parameters
        ----------
        required : sequence of int
            Landmarks that the local map must hold.
        size : int
            Number of its landmarks.
        """
        refuse_beyond_memory(
            f"a local map of {size} landmarks",
            covariance_bytes(3 * size),  # including virtual landmarks
            "take a smaller local_size",
        )
        self.undo.save(self._checkpoint)
        now = self._phase()
        rows = self._apply(now)
        ahead = now.mean[:2] + (now.mean[:2] - self._origin) / 2  # likely direction
        points = self._points.reshape(-1, 2)
        chosen = choose_local(ahead, required, self.slots, points, size)
        old, slot = list(self.local), self.slots.__getitem__
        staying = [k for k, i in enumerate(old) if i in chosen]
        places = {slot(i): k for k, i in enumerate(old) if i not in chosen}
        leaving = sorted(places)
        entering = sorted((i for i in chosen if i not in self.local), key=slot)
        self.deferred.put(pairs(leaving), rows, 3 + pairs([places[s] for s in leaving]))
        columns = self._columns(entering)
        kept = np.r_[0:3, 3 + pairs(staying)]
        staying_ids = [old[k] for k in staying]
        self.local = dict.fromkeys(staying_ids + entering)
        self._strip = np.empty((len(kept) + len(columns), self.deferred.width))
        self._strip[: len(kept)] = rows[kept]
        fresh = self._strip[len(kept) :]
        self.deferred.read(columns, fresh)
        fresh[:, self._columns(staying_ids)] = rows[kept[3:, None], columns].T
        self._origin = now.mean[:2].copy()
        self._begin()

    def _checkpoint(self) -> Callable[[], None]:
        """Return what takes back a change of the local map."""
        own = {k: v for k, v in vars(self).items() if k not in ("filter", "undo")}
        own |= {"_points": self._points.copy(), "_references": self._references.copy()}
        saved, undo_deferred = self.filter.state_dict(), self.deferred.checkpoint()

        def undo() -> None:
            vars(self).update(own)
            self.filter.restore(saved)
            undo_deferred()

        return undo

    @property
    def is_small(self) -> bool:
        """Whether one local map may hold the whole map."""
        return len(self.slots) <= largest_whole_map(invariant=self.is_invariant)

    @property
    def nbytes(self) -> int:
        """Memory of the belief [bytes]."""
        local = covariance_bytes(len(self.local) + self._virtual)
        others = self.deferred.nbytes + self._strip.nbytes + 2 * self._points.nbytes
        return local + others

    def state_dict(self, numbers: Sequence[int]) -> dict[str, Any]:
        """Return copies of the whole state as arrays, with numbers of the caller."""
        near = [self.slots[i] for i in self.local]
        invalid = pairs([*near, *self.free])  # arrays hold rests of these
        arrays = {
            "points": self._points.copy(),
            "references": self._references.copy(),
            "strip": self._strip.copy(),
        }
        for array in arrays.values():
            array[..., invalid[invalid < array.shape[-1]]] = 0.0
        local = {f"local_{k}": v for k, v in self.filter.state_dict().items()}
        return {
            "base": local.pop("local_estimator"),
            "landmark_ids": np.array(list(self.slots), dtype=np.int64),
            "slots": np.array(list(self.slots.values()), dtype=np.int64),
            **arrays,
            "origin": self._origin.copy(),
            "numbers": np.array([self._virtual, *numbers, *self.free]),
            **local,
            **{f"far_{k}": v for k, v in self.deferred.state_dict(invalid).items()},
        }

    def load(self, saved: SavedState) -> list[int]:
        """Replace the state by a saved one; return the numbers of the caller."""
        self.filter.restore(saved.local)
        self.deferred, self.slots, self.local = saved.far, saved.slots, saved.near
        self._points, self._references, self._strip, self._origin = saved.arrays
        self._virtual, *numbers = saved.numbers[:4]
        self.free = saved.numbers[4:]
        return numbers

    def _drop(self, landmark_id: int) -> None:
        self.local.pop(landmark_id, None)
        self.free.append(self.slots.pop(landmark_id))

    def _begin(self) -> None:
        """Load the local map into the filter."""
        columns = self._columns(list(self.local))
        whole = len(self.local) == len(self.slots)
        size = 3 + len(columns)
        self._virtual = 0 if whole else virtual_landmarks(size, self.is_invariant)
        begin_phase(
            self.filter,
            self._points[columns],
            self._strip[:, columns],
            self._references[columns],
            [*range(LOWEST_ID, LOWEST_ID + self._virtual), *self.local],
        )

    def _apply(self, now: Phase) -> Array:
        """Apply a phase to the map; return the covariance rows of the local map.

        The rows have shape (a, width).  The downdate of all other rows is deferred.
        """
        columns = self._columns(list(self.local))
        self._make_room()
        a = len(now.mean)
        if self._virtual:
            root, signs = roots(now.loss, self.is_invariant)
            coefficients = np.concatenate([now.gain, now.shift, root])
            product = self._combine(coefficients, self._strip)
            rows, shift, lost = product[:a], product[a], product[a + 1 :].T.copy()
            self._points += shift
            self.deferred.defer(lost, signs)
        else:
            rows = np.zeros((a, self.deferred.width))
        if np.array_equal(columns, np.arange(len(columns))):  # far faster in large maps
            rows[:, : len(columns)] = now.covariance[:, 3:]
        else:
            rows[:, columns] = now.covariance[:, 3:]
        self._points[columns] = now.mean[3:]
        self._references[columns] = now.reference[3:]
        return rows

    def _make_room(self) -> None:
        """Extend the arrays to all landmarks."""
        self.deferred.make_room(2 * (len(self.slots) + len(self.free)))
        more = self.deferred.width - self._strip.shape[1]
        if more > 0:
            self._points = np.append(self._points, np.zeros(more))
            self._references = np.append(self._references, np.zeros(more))
            self._strip = np.pad(self._strip, ((0, 0), (0, more)))

    def _combine(self, coefficients: Array, strip: Array) -> Array:
        return combine(coefficients, strip, self.is_invariant)

    def _phase(self) -> Phase:
        return end_phase(self.filter, self._virtual)

    def _columns(self, ids: Sequence[int]) -> IntArray:
        """Return the columns of landmarks in the map's arrays."""
        return pairs([self.slots[i] for i in ids])
