"""A large Gaussian map whose update is deferred for all but the local landmarks.

`CompressedMap` predicts and updates the local map; `choose_local` chooses its
landmarks, and `checked_state` checks a saved state before anything changes.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ....argument_checks import LOWEST_ID, covariance_bytes
from ....arrays import Array, IntArray
from ...filters.ekf import EkfSlam, InvariantEkfSlam
from ...guards import saved_states
from ...guards.saved_states import MAP_STATE, with_prefix, without_prefix
from ...interface import Belief
from ..multifrontal import pairs, symmetric
from . import phase_update
from .deferred_covariance import BLOCK, DeferredCovariance, subtract
from .phase_update import combine


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
        self.reset(np.zeros(3), np.zeros(3))

    def reset(self, pose: ArrayLike, pose_std: ArrayLike) -> None:
        """Start a new run with an empty map."""
        self.filter.reset(pose, pose_std)
        self.slots: dict[int, int] = {}  # position of each landmark in the arrays below
        self.free: list[int] = []
        self._points = np.zeros(0)
        self._references = np.zeros(0)
        self.deferred = DeferredCovariance()
        self.local: dict[int, None] = {}  # the local landmarks, in their order
        self._stored = 0  # how many of these, the first, have rows in `deferred`
        self._virtual = 0
        # The last change of the local map, as long as it takes.
        self._handover: phase_update.Handover | None = None
        self._strip = np.zeros((0, 0))  # covariance of local and all other coordinates
        self._scale = np.zeros((0, 0))  # T of this phase
        self._origin = self.filter.map.mean[:2].copy()  # start of the phase

    def add(self) -> None:
        """Assign slots to landmarks that the filter has added."""
        inside, known = self.filter.map, self._virtual + len(self.local)
        ids = inside.parts.ids[known : inside.size // 2 - 1].tolist()
        if not ids:
            return
        reused = self.free[: -len(ids) - 1 : -1]
        first = len(self.slots) + len(self.free)
        fresh = range(first, first + len(ids) - len(reused))
        self.slots = self.slots | dict(zip(ids, [*reused, *fresh], strict=True))
        self.free = self.free[: len(self.free) - len(reused)]
        self.local = self.local | dict.fromkeys(ids)

    def remove(self, ids: Sequence[int]) -> None:
        """Marginalise landmarks."""
        self.filter.remove([i for i in ids if i in self.local])
        self._drop(ids)

    def merge_pairs(self, pairs: Sequence[tuple[int, int]]) -> None:
        """Condition on local landmarks being the same; drop the second of each pair."""
        self.filter.merge_pairs(pairs)
        self._drop([gone for _, gone in pairs])

    def belief(self, ids: Sequence[int]) -> Belief:
        """Return the marginal of the pose and some landmarks."""
        now = self._phase()
        order = {i: place for place, i in enumerate(self.local)}
        mean = np.zeros(3 + 2 * len(ids))
        covariance = np.zeros((len(mean), len(mean)))
        is_local = np.array([i in order for i in ids], dtype=bool)
        inside = np.r_[0:3, 3 + pairs(np.flatnonzero(is_local))]
        local = np.r_[0:3, now.first + pairs([order[i] for i in ids if i in order])]
        mean[inside] = now.mean[local]
        covariance[np.ix_(inside, inside)] = now.covariance[np.ix_(local, local)]
        if not is_local.all():
            self.finish_handover()
            outside = 3 + pairs(np.flatnonzero(~is_local))
            columns = self._columns([i for i in ids if i not in order])
            strip = now.scaled(np.ascontiguousarray(self._strip[:, columns]))
            moved = combine(now.shift, strip)[0]
            mean[outside] = self._points[columns] + moved
            strip = now.extended(strip, moved)
            cross = combine(now.gain(local), strip)
            covariance[np.ix_(inside, outside)] = cross
            covariance[np.ix_(outside, inside)] = cross.T
            root, signs = now.roots()
            block = self.deferred.marginal(columns)
            subtract(block, combine(root, strip).T, signs)
            covariance[np.ix_(outside, outside)] = symmetric(block)
            del block  # frees memory before the belief takes its copy
        return Belief(mean, covariance, tuple(ids), self.filter.frame)

    def ids_near(self, pose: Belief, within: float) -> list[int]:
        """Return the local landmarks and all that may lie within a distance [m].

        The distance is extended by 5 standard deviations.
        """
        self.finish_handover()
        others = [i for i in self.slots if i not in self.local]
        columns = self._columns(others)
        away = np.hypot(*(self._points[columns].reshape(-1, 2) - pose.pose[:2]).T)
        variances = self.deferred.diagonal()[columns].reshape(-1, 2).sum(axis=1)
        std = np.sqrt(variances) + np.sqrt(np.trace(pose.covariance[:2, :2]))
        too_far = {others[k] for k in np.flatnonzero(away > within + 5 * std)}
        return [i for i in self.slots if i not in too_far]

    def change_local_map(
        self, required: Sequence[int], size: int, *, hurried: bool
    ) -> None:
        """End the phase, and begin another one with a new local map.

        Parameters
        ----------
        required : sequence of int
            Landmarks that the local map must hold.
        size : int
            Number of its landmarks.
        hurried : bool
            Whether the change must not take several steps.
        """
        self.finish_handover()
        now, own = self._phase(), self._columns(list(self.local))
        self._make_room()
        self._references = self._references.copy()
        before = self._points
        self._points = before + combine(now.unscaled(now.shift), self._strip)[0]
        self._points[own] = now.mean[now.first :]
        self._references[own] = now.reference[now.first :]
        ahead = now.mean[:2] + (now.mean[:2] - self._origin) / 2  # likely direction
        points = self._points.reshape(-1, 2)
        chosen = choose_local(ahead, required, self.slots, points, size)
        self._origin = now.mean[:2].copy()
        rows, self.local = phase_update.exchanged_rows(
            self.slots, self.local, chosen, self._stored, now.first, own
        )
        blocks = phase_update.blocks_in_a_step(self.deferred.width, hurried=hurried)
        moved = self._points - before
        self._handover = phase_update.Handover(now, self._strip, moved, rows, blocks)
        self.deferred.forget(rows.new)
        columns = self._columns(list(self.local))
        if hurried:
            self._handover.advance(self.deferred, blocks)
            self._begin(columns, self._handover.next_strip[:, columns])
        else:
            self._begin(columns, self._handover.beginning(self.deferred))

    def work(self, rank: int, age: int, *, hurried: bool) -> None:
        """Do a part of the deferred work.

        Parameters
        ----------
        rank : int
            That of a full update: the work is a share of its downdate.  If hurried, it
            is the whole, or as much as is deferred in this step.
        age : int
            Steps since the local map changed, including this one.
        hurried : bool
            Whether the change of the local map must not take several steps.
        """
        width = self.deferred.width
        share = phase_update.blocks_in_a_step(width, hurried=hurried)
        if hurried or (age - 3) * share * BLOCK >= width:
            added = self.finish_handover()
            self.deferred.work(max(rank, added) if hurried else rank * SHARE)
        elif self._handover is not None and age > 1:
            self._handover.advance(self.deferred, (age - 2) * share)

    def finish_handover(self) -> int:
        """Finish the change of the local map now; return the rank that it defers."""
        if (handover := self._handover) is None:
            return 0
        handover.advance(self.deferred, self.deferred.width // BLOCK)
        self.deferred.defer(handover.lost)
        self._strip, self._handover = handover.next_strip, None
        return len(handover.lost.signs)

    @property
    def is_small(self) -> bool:
        """Whether one local map may hold the whole map."""
        largest = LARGEST_WHOLE_INVARIANT if self.is_invariant else LARGEST_WHOLE_MAP
        return len(self.slots) <= largest

    @property
    def nbytes(self) -> int:
        """Memory of the belief [bytes]."""
        local = covariance_bytes(len(self.local) + self._virtual)
        others = self.deferred.nbytes + self._strip.nbytes + 2 * self._points.nbytes
        waiting = 0 if self._handover is None else self._handover.nbytes
        return local + others + waiting

    def state_dict(self, numbers: Sequence[int]) -> dict[str, Any]:
        """Return copies of the whole state as arrays, with numbers of the caller."""
        self.finish_handover()
        new = [self.slots[i] for i in list(self.local)[self._stored :]]
        invalid = pairs([*new, *self.free])  # arrays hold rests of these
        local = with_prefix("local", self.filter.state_dict(), "_")
        found = {
            "landmark_ids": list(self.slots),
            "slots": list(self.slots.values()),
            "points": self._points,
            "references": self._references,
            "strip": self._strip,
            "scale": self._scale,
            "origin": self._origin,
            "counts": [self._virtual, self._stored, *numbers, *self.free],
        }
        state = {"base": local.pop("local_estimator")}
        state |= saved_states.write(found, STATE)
        for key in ("points", "references", "strip"):
            state[key][..., invalid[invalid < state[key].shape[-1]]] = 0.0
        far = self.deferred.state_dict(invalid)
        return state | local | with_prefix("far", far, "_")

    def load_state_dict(self, state: Mapping[str, Any], name: str) -> list[int]:
        """Fill an empty map with a saved one; return the numbers of the caller.

        Raises
        ------
        ValueError
            If the state is not of the estimator of this name, or does not fit
            together.
        """
        entries = [*STATE, *(f"local_{k}" for k in LOCAL)]
        entries += [f"far_{k}" for k in self.deferred.state_dict()]
        base = type(self.filter).__name__
        saved_states.refuse_other_state(state, entries, estimator=name, base=base)
        local_ids = state["local_landmark_ids"]
        local_ids = saved_states.landmark_ids("local_landmark_ids", local_ids)
        self.deferred.load_state_dict(without_prefix(state, "far", "_"))
        width = self.deferred.width
        saved = saved_states.read(state, STATE, w=width)
        ids, slots, counts = (
            list(map(int, saved[key])) for key in ("landmark_ids", "slots", "counts")
        )
        _check_slots(slots, counts, len(ids), len(local_ids))
        local = saved_states.read(without_prefix(state, "local", "_"), LOCAL)
        self._virtual, self._stored, *numbers = counts[:COUNTERS]
        self.free = counts[COUNTERS:]
        self.slots = dict(zip(ids, slots, strict=True))
        self.local = dict.fromkeys(local_ids[self._virtual :])
        self._points, self._references = saved["points"], saved["references"]
        self._strip, self._origin = saved["strip"], saved["origin"]
        self._scale = saved["scale"]
        if np.triu(self._scale, 1).any() or (self._scale.diagonal() <= 0).any():
            raise ValueError("state['scale'] must be triangular, with a diagonal > 0")
        rows = phase_update.virtual_landmarks(len(self._strip), self.is_invariant)
        if self._virtual and rows != self._virtual:
            raise ValueError(
                f"state['strip'] must fit {self._virtual} virtual landmarks and "
                f"{width} columns, got shape {self._strip.shape}"
            )
        own = np.r_[0:3, 3 + 2 * self._virtual : len(local["mean"])]
        P = local["covariance"][np.ix_(own, own)]
        saved_states.refuse_indefinite("state['local_covariance']", P)
        if not self.local.keys() <= self.slots.keys():
            raise ValueError("state['local_landmark_ids'] must be among landmark_ids")
        self.filter.restore(local)
        return numbers

    def _drop(self, ids: Sequence[int]) -> None:
        gone = set(ids)
        self.free = self.free + [self.slots[i] for i in ids]
        self.slots = {i: slot for i, slot in self.slots.items() if i not in gone}
        stored = list(self.local)[: self._stored]
        self._stored = len(stored) - len(gone.intersection(stored))
        self.local = {i: None for i in self.local if i not in gone}

    def _begin(self, columns: IntArray, rows: Array) -> None:
        """Load the local map with these covariance rows (a, a - 3) into the filter."""
        whole = len(self.local) == len(self.slots)
        self._stored = 0 if whole else len(self.local)
        self._virtual = (
            0 if whole else phase_update.virtual_landmarks(len(rows), self.is_invariant)
        )
        if whole:
            self._strip, self._handover = self._strip[:0], None
        self._scale = phase_update.begin_phase(
            self.filter,
            self._points[columns],
            rows,
            self._references[columns],
            [*range(LOWEST_ID, LOWEST_ID + self._virtual), *self.local],
        )

    def _make_room(self) -> None:
        """Extend the arrays to all landmarks."""
        self.deferred.make_room(2 * (len(self.slots) + len(self.free)))
        more = self.deferred.width - self._strip.shape[1]
        if more > 0:
            self._points = np.append(self._points, np.zeros(more))
            self._references = np.append(self._references, np.zeros(more))
            self._strip = np.pad(self._strip, ((0, 0), (0, more)))

    def _phase(self) -> phase_update.Phase:
        parts = (*self.filter.map.used, 3 + 2 * self._virtual)
        is_invariant = self.is_invariant and self._virtual > 0
        return phase_update.Phase(*parts, self._scale, is_invariant)

    def _columns(self, ids: Sequence[int]) -> IntArray:
        """Return the columns of landmarks in the map's arrays."""
        return pairs([self.slots[i] for i in ids])


# --------------------------------------------------------------------------------------
# Choice of the local landmarks, and of their number.

# Up to this many landmarks, the local map is the whole map.
#
# The end of a phase has a cost of its own. In smaller maps it exceeds two full updates.
LARGEST_WHOLE_MAP = 350
# The same in the invariant frame, where phases end at twice the cost.
LARGEST_WHOLE_INVARIANT = 400
# Smallest number of landmarks at which a local map may be too large.
SMALLEST_LOCAL_MAP = 30
SHORT_PHASE = 4  # steps after which a phase has paid for its end
# Share of a full downdate that one step applies to the stored covariance.
#
# A smaller share takes more steps: in the invariant frame, more than half of them.
SHARE = 2 / 3
# Limit of the extra landmarks, as a multiple of the landmarks of a scan.
#
# The multiple is one for every 250 mapped landmarks, at most 2.5: the end of a phase
# costs a² n.
LARGEST_RATIO, LANDMARKS_PER_RATIO = 2.5, 250


def extra_landmarks(before: int, read: int, mapped: int, lasted: int) -> int:
    """Return the number of landmarks of the next local map beyond those of a scan.

    Parameters
    ----------
    before : int
        The last such number.
    read : int
        Mapped landmarks in the scan.
    mapped : int
        Landmarks in the map.
    lasted : int
        Steps of the phase that ends; 0 for the first one.

    Examples
    --------
    >>> [extra_landmarks(9, 10, mapped, lasted=20) for mapped in (300, 1000, 5000)]
    [12, 25, 25]
    >>> extra_landmarks(9, 10, 1000, lasted=1)  # scans far apart from each other
    4
    >>> extra_landmarks(0, 10, 1000, lasted=0)
    25
    """
    if 0 < lasted < SHORT_PHASE:
        return before // 2
    most = int(max(read, 4) * min(LARGEST_RATIO, mapped / LANDMARKS_PER_RATIO))
    return min(2 * before + 8, most) if lasted else most


def choose_local(
    centre: Array,
    required: Sequence[int],
    slots: Mapping[int, int],
    points: Array,
    size: int,
) -> dict[int, None]:
    """Return the required landmarks, and the nearest to a point up to ``size`` in all.

    Parameters
    ----------
    centre : ndarray, shape (2,)
    required : sequence of int
    slots : mapping
        Row in ``points`` by landmark.
    points : ndarray, shape (n, 2)
        Positions of the landmarks [m].
    size : int
    """
    chosen = dict.fromkeys(required)
    if len(chosen) >= size:
        return chosen
    ids = list(slots)
    distances = ((points[list(slots.values())] - centre) ** 2).sum(axis=1)
    count = min(size + len(required), len(ids))
    nearest = np.argpartition(distances, count - 1)[:count]
    nearest = nearest[np.argsort(distances[nearest], kind="stable")]
    chosen |= dict.fromkeys(ids[k] for k in nearest.tolist())
    return dict.fromkeys(list(chosen)[:size])


# --------------------------------------------------------------------------------------
# The saved state of a compressed filter.

STATE: saved_states.Table = {
    "landmark_ids": (saved_states.IDS, "n"),
    "slots": (saved_states.COUNTS, -1),
    "points": (saved_states.NUMBERS, "w"),
    "references": (saved_states.NUMBERS, "w"),
    "strip": (saved_states.NUMBERS, "s", "w"),
    "scale": (saved_states.NUMBERS, "s", "s"),
    "origin": (saved_states.NUMBERS, 2),
    "counts": (saved_states.COUNTS, -1),
}
LOCAL: saved_states.Table = {
    **MAP_STATE,
    "covariance": (saved_states.SYMMETRIC, "3+2n", "3+2n"),
}
# Numbers before the free slots: virtual landmarks, stored ones, extra ones, age, rest.
COUNTERS = 5


def _check_slots(
    slots: list[int], counts: list[int], landmarks: int, local: int
) -> None:
    """Refuse places of landmarks that do not fit their number."""
    if landmarks != len(slots):
        raise ValueError(
            f"state['slots'] must have one entry for each of {landmarks} landmarks, "
            f"got {len(slots)}"
        )
    if len(counts) < COUNTERS or counts[0] + counts[1] > local:
        raise ValueError(
            f"state['counts'] must be at least {COUNTERS}, the first two of them "
            f"together at most {local}, got {counts}"
        )
    free = counts[COUNTERS:]
    if sorted(slots + free) != list(range(len(slots + free))):
        raise ValueError(
            "state['slots'] and the free ones in state['counts'] must be 0, 1, … "
            f"without repetition, got {slots} and {free}"
        )
