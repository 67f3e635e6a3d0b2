"""The belief of the sparse information filter: map, local map and pose."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.linalg import cho_factor, cho_solve, solve_triangular

from ....arrays import Array, BoolArray, IntArray
from ...filters.ekf import EkfSlam
from ...interface import Belief, UpdateReport
from ...models.rigid_motion import as_covariance
from ..multifrontal import pairs
from ..undo import Undo, contents, undo_all
from .local_information import (
    ConditionalPose,
    LocalInformation,
    SparseMap,
    choose_local,
    local_map_size,
    means,
    union,
    write_back,
)
from .scan_update import State, marginalise, merge_landmarks


@dataclass
class SparseBelief:
    """All state of the filter; one local map is in use at any time."""

    slots: dict[int, int]  # slot of each landmark, by identity
    free: list[int]  # slots of removed landmarks
    map_: SparseMap
    local: LocalInformation
    pose: ConditionalPose
    origin: Array  # position of the robot when the local map was chosen, shape (2,) [m]
    steps: int = 0  # number of steps taken
    report: UpdateReport = field(default_factory=UpdateReport, repr=False)  # the last

    @classmethod
    def empty(cls, pose: Array, std: Array) -> SparseBelief:
        """Return the belief of a robot at this pose, shape (3,), without a map."""
        start = ConditionalPose(
            pose.copy(), np.zeros((3, 0)), np.diag(std**2), pose[:2].copy()
        )
        map_ = SparseMap()
        local = LocalInformation.of(map_, np.empty(0, dtype=np.int64))
        return cls({}, [], map_, local, start, pose[:2].copy())

    @classmethod
    def of(cls, slam: EkfSlam) -> SparseBelief:
        """Return the belief of a dense filter, with all landmarks in the local map."""
        (mean, P, reference), n = slam.map.arrays, slam.map.size
        slots = np.arange(len(slam.map.slots))
        belief = cls.empty(mean[:3], np.zeros(3))
        belief.add(list(slam.map.slots))
        inverse = cho_solve(cho_factor(P[3:n, 3:n], lower=True), np.eye(n - 3))
        gain, rest = P[:3, 3:n] @ inverse, P[:3, :3].copy()
        rest -= gain @ P[3:n, :3]
        belief.local = replace(
            belief.local.extended(slots, mean[3:n]),
            first=reference[3:n].copy(),
            information=(inverse + inverse.T) / 2,
        )
        belief.pose = ConditionalPose(
            mean[:3].copy(), gain, as_covariance(rest), reference[:2].copy()
        )
        belief.steps = slam.steps
        return belief

    def free_slots(self, count: int) -> IntArray:
        """Return slots for new landmarks."""
        fresh = len(self.slots) + len(self.free)
        slots = self.free[::-1] + list(range(fresh, fresh + count))
        return np.array(slots[:count], dtype=np.int64)

    def add(self, ids: Sequence[int]) -> None:
        """Assign the first free slots to new landmarks."""
        slots = self.free_slots(len(ids)).tolist()
        self.slots.update(zip(ids, slots, strict=True))
        self.free = self.free[: max(len(self.free) - len(ids), 0)]
        self.map_.grow(len(self.slots) + len(self.free))

    def checkpoint(self) -> Undo:
        """Return what takes back later changes."""
        return undo_all(contents(self), self.map_.checkpoint())

    def new_local_map(self, ids: Sequence[int]) -> IntArray | None:
        """Return the slots of a new local map; None if the present one is adequate.

        It must hold all mapped landmarks of a scan, and not be too large.
        """
        seen = np.array([self.slots[i] for i in ids if i in self.slots], dtype=int)
        local = self.local.slots
        required = union(seen, local[self.pose.is_linked])
        size = local_map_size(len(self.slots), len(ids), len(required))
        if np.isin(seen, local).all() and 2 * len(local) <= 3 * size:
            return None
        here = self.pose.mean[:2]
        ahead = here + (here - self.origin) / 2  # likely direction of motion
        mapped = np.array(list(self.slots.values()))
        points = self.map_.points.reshape(-1, 2)
        return choose_local(mapped, points, ahead, required, size)

    def change_local_map(self, slots: IntArray) -> None:
        """Write the local map back, and begin another one."""
        write_back(self.map_, self.local)
        gain = np.zeros((3, 2 * len(slots)))
        _, before, after = np.intersect1d(self.local.slots, slots, return_indices=True)
        gain[:, pairs(after)] = self.pose.gain[:, pairs(before)]
        self.pose = self.pose._replace(gain=gain)
        self.local = LocalInformation.of(self.map_, slots)

    def remove(self, ids: Sequence[int]) -> None:
        """Marginalise landmarks."""
        gone = self._include_links(ids)
        rest = marginalise(self.local, self.pose, gone)
        self._drop(ids, gone, rest)

    def merge(self, kept: int, gone: int) -> None:
        """Condition on two landmarks being the same, and drop the second."""
        dropped = self._include_links([gone, kept])
        place = int(np.flatnonzero(self.local.slots == self.slots[kept])[0])
        dropped[place] = False
        merged = merge_landmarks(self.local, self.pose, place, dropped)
        self._drop([gone], dropped, merged)

    def marginal(self, ids: Sequence[int]) -> Belief:
        """Return the marginal of the pose and some landmarks.

        With L the local map and H all other landmarks::

            p = K m_L + ω,   m_H = −T m_B + h,   cov ω = Ω,  cov h = Λ_HH⁻¹
            Σ_LL = (Λ_LL − C)⁻¹

        With G = [K; E; −T], the covariance is G Σ_LL Gᵀ plus Ω and blocks of Λ_HH⁻¹.
        Only the requested rows of T and Λ_HH⁻¹ are computed.
        """
        slots, local = np.array([self.slots[i] for i in ids], dtype=int), self.local
        place = np.full(len(self.map_.points) // 2, -1)
        place[local.slots] = np.arange(len(local.slots))
        is_near = place[slots] >= 0
        inside = np.append([True] * 3, np.repeat(is_near, 2))
        outside = np.flatnonzero(~inside)
        here = np.append([0, 1, 2], 3 + pairs(place[slots[is_near]]))
        near = self._near()  # its bits do not depend on the slots
        covariance = np.empty((len(inside), len(inside)))
        covariance[np.ix_(inside, inside)] = near[np.ix_(here, here)]
        if len(outside):
            own, T = local.rest.covariance(slots[~is_near])
            border = 3 + local.border
            own += T @ near[np.ix_(border, border)] @ T.T
            covariance[np.ix_(outside, outside)] = (own + own.T) / 2
            cross = -T @ near[np.ix_(border, here)]
            covariance[np.ix_(outside, inside)] = cross
            covariance[np.ix_(inside, outside)] = cross.T
            points = means(self.map_, local)[pairs(slots)]
        else:
            points = local.points[pairs(place[slots])]
        mean = np.concatenate([self.pose.mean, points])
        return Belief(mean, covariance, tuple(ids), "additive")

    def _near(self) -> Array:
        """Return the covariance of the pose and all local landmarks."""
        lower, size = self.local.solver()[0], len(self.local.points)
        rows = np.vstack([self.pose.gain, np.eye(size)])
        root = solve_triangular(lower, rows.T, lower=True, check_finite=False)
        covariance = root.T @ root
        covariance[:3, :3] += self.pose.covariance
        return np.asarray(covariance)

    def landmarks(self) -> Array:
        """Return the positions of all landmarks, shape (n, 2) [m]."""
        points = means(self.map_, self.local).reshape(-1, 2)
        return points[list(self.slots.values())]

    def ids_of(self, slots: IntArray) -> tuple[int, ...]:
        """Return the landmarks in these slots, in the order of the belief."""
        chosen = set(slots.tolist())
        return tuple(i for i, slot in self.slots.items() if slot in chosen)

    @property
    def nbytes(self) -> int:
        """Memory of the belief [bytes]."""
        local, map_ = self.local, self.map_
        arrays = (map_.points, map_.first, local.information)
        stored = map_.information.nbytes + map_.elimination.nbytes
        return stored + sum(array.nbytes for array in arrays)

    def _include_links(self, ids: Sequence[int]) -> BoolArray:
        """Add landmarks and all their links to the local map; return their flags."""
        slots = np.array([self.slots[i] for i in ids])
        linked = np.append(slots, self.map_.information.neighbours(slots))
        chosen = union(self.local.slots, linked)
        self.change_local_map(chosen)
        return np.isin(self.local.slots, slots)

    def _drop(self, ids: Sequence[int], gone: BoolArray, rest: State) -> None:
        """Replace the local map by one without some landmarks; free their slots."""
        stays = np.repeat(~gone, 2)
        information = np.where(stays & stays[:, None], self.local.information, 0.0)
        self.map_.information.replace(self.local.slots, information)
        self.local, self.pose = rest
        slots = [self.slots.pop(i) for i in ids]
        self.map_.elimination.nodes[slots] = 0
        self.free += slots
