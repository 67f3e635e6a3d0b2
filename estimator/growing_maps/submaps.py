"""Submaps: a map of any size as many small ones, joined when they are asked for."""

import os
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .. import validation
from ..angles import wrap_angle
from ..ekf_slam import FRAMES, EkfSlam
from ..interface import Belief, UpdateReport
from ..invariant import InvariantEkfSlam
from ..validation import LandmarkIds
from .coordinates import pairs
from .submap_chain import Chain
from .submap_fusion import fuse
from .submap_joining import Gaussian, JoinedMap, with_uncertain_start
from .submap_placing import Outline, Placing
from .submap_relation import compose
from .submap_state import as_arrays, checked_state, outline_of
from .submap_store import FolderStore, MemoryStore, Submap, SubmapStore

Array = NDArray[np.float64]
Int = NDArray[np.int64]

BASES: dict[str, type[EkfSlam]] = {"ekf": EkfSlam, "invariant": InvariantEkfSlam}

ORIGIN = (0.0, 0.0, 0.0)
ROUGHLY = 0.1


class SubmapSlam:
    """SLAM in submaps: small local maps, independent of each other, joined on demand.

    An ordinary filter starts at the origin of a frame of its own, where it knows its
    pose exactly, and maps what it sees.  Once its submap is full it is closed, and the
    next begins where the robot is: at (0, 0, 0) in a new frame, with an empty map.  So
    every linearisation is local, and no submap uses what another used: the readings of
    a scan, and the noise of a motion, belong to one submap alone [1]_.

    ``belief()`` joins the submaps: landmarks known to several are one and the same,
    which closes loops, and the frames are the sparse least-squares solution of it all,
    linearised at one point (:mod:`.submap_joining`).  The present submap is then fused
    by one linear update (:mod:`.submap_fusion`) until it is closed and joined like the
    others.  A step costs what the present submap costs, however large the map.

    Parameters
    ----------
    motion_std, measurement_std, initial_pose, initial_pose_std
        As in :class:`EkfSlam`.
    base : {"invariant", "ekf"}
        The filter of a submap.
    submap_size : int
        Landmarks that close a submap; at least as many as a scan holds.
    heading_limit : float or None
        Standard deviation of the heading in the submap's frame that closes it too
        [rad]: linearisation is safe only while this is small.
    extent_limit : float or None
        Distance from the submap's origin that closes it too [m].
    folder : path or None
        Where closed submaps are written, a few being kept in memory: empty or not
        there yet, or that of a run to be continued by :meth:`load_state_dict`.
        :meth:`reset` deletes the submaps of the run that it forgets.  None: all stay
        in memory.
    belief_limit : int
        Largest number of landmarks of which ``belief`` makes a dense covariance.
    **settings
        The other keywords of the base filter.  A gate works within a submap: the first
        reading of a landmark in a new one is not held against older submaps.

    Raises
    ------
    ValueError
        Where an argument is refused.

    References
    ----------
    .. [1] L. Paz, J. Tardós, J. Neira, Divide and conquer: EKF SLAM in O(n), IEEE T-RO
       24(5), 2008.

    Examples
    --------
    >>> slam = SubmapSlam((0.05, 0.02, 0.01), (0.02, 0.1), submap_size=2)
    >>> slam.update([(0.0, 2.0), (1.5, 3.0)], landmark_ids=[7, 9]).added_ids
    (7, 9)
    >>> slam.closed_count  # full: the next submap begins here
    1
    >>> slam.predict((1.0, 0.0))
    >>> slam.update([(0.0, 1.0)], landmark_ids=[7]).added_ids
    ()
    >>> slam.belief([7]).landmarks  # of the whole map: belief()
    array([[2., 0.]])
    """

    def __init__(
        self,
        motion_std: ArrayLike,
        measurement_std: ArrayLike,
        *,
        initial_pose: ArrayLike = ORIGIN,
        initial_pose_std: ArrayLike = ORIGIN,
        base: str = "invariant",
        submap_size: int = 50,
        heading_limit: float | None = None,
        extent_limit: float | None = None,
        folder: str | os.PathLike[str] | None = None,
        belief_limit: int = 5000,
        **settings: Any,
    ) -> None:
        make = BASES[validation.one_of("base", base, tuple(BASES))]
        self._local = make(motion_std, measurement_std, **settings)
        self._frame = FRAMES[self._local.rules.frame]
        self._submap_size = validation.whole("submap_size", submap_size, 1)
        self._heading_limit = _limit("heading_limit", heading_limit)
        self._extent_limit = _limit("extent_limit", extent_limit)
        self._belief_limit = validation.whole("belief_limit", belief_limit, 1)
        self._folder = None if folder is None else FolderStore(folder)
        self.reset(initial_pose, initial_pose_std)

    def reset(self, pose: ArrayLike, pose_std: ArrayLike) -> None:
        """Start a new run with an empty map, as :meth:`EkfSlam.reset`."""
        first = validation.finite_vector("pose", pose, 3)
        std = validation.standard_deviations("pose_std", pose_std, 3)
        if self._folder is not None:
            self._folder.clear()
        folder = self._folder  # an empty one is false
        self._store: SubmapStore = MemoryStore() if folder is None else folder
        self._slots: dict[int, int] = {}  # place of each landmark in the whole map
        self._outlines: list[Outline] = []  # of the closed submaps
        self._closed_slots: set[int] = set()
        self._near: tuple[int, ...] = ()  # landmarks of the present one, in their order
        self._chain = Chain(first, np.diag(std**2))
        self._placing = Placing()
        self._begin()

    def predict(self, odometry: ArrayLike, dt: float = 1.0) -> None:
        """Move the pose by one odometry reading, as :meth:`EkfSlam.predict`."""
        self._claim_folder()
        self._local.predict(odometry, dt)

    def update(
        self, measurements: ArrayLike, landmark_ids: LandmarkIds | None = None
    ) -> UpdateReport:
        """Correct the present submap with one scan, and close it where it is full.

        Parameters as in :meth:`EkfSlam.update`.  In the report, innovations and NIS are
        those within the submap.  ``added_ids`` are new to the whole map; a reading that
        begins a known landmark in a new submap corrects nothing yet, and is not listed.

        Raises
        ------
        ValueError
            Where the arguments are malformed, or a scan holds more landmarks than
            ``submap_size``; the belief is then as before.
        numpy.linalg.LinAlgError
            Where an innovation covariance is not positive definite, naming the
            reading; the belief is then as before.
        """
        if np.size(measurements) > 2 * self._submap_size:
            raise ValueError(
                f"submap_size must be >= {len(validation.scan(measurements))}, the "
                f"landmarks of one scan, got {self._submap_size}"
            )
        self._claim_folder()
        report = self._local.update(measurements, landmark_ids)
        new = [i for i in report.added_ids if i not in self._slots]
        for i in new:
            self._slots[i] = len(self._slots)
        self._near += report.added_ids
        if np.size(measurements) and self._is_full():
            self._close()
        return report._replace(added_ids=tuple(new))

    def join(self) -> None:
        """Join the closed submaps, and go on from there.

        ``belief()`` joins them too, but leaves no trace.  After ``join()``, ``pose``
        and ``local_belief()`` know of the loops closed so far, and later joins begin
        at this one.
        """
        if not self._outlines:
            return
        joined = self._join()
        last = joined.marginal(np.empty(0, dtype=np.int64))
        where = with_uncertain_start(last, *self._chain.start)
        self._chain.rebase(joined.frames, *where)
        self._placing = Placing()
        self._forget_joined()

    def belief(self, landmark_ids: LandmarkIds | None = None) -> Belief:
        """Join the submaps, and return the belief as a snapshot.

        Parameters
        ----------
        landmark_ids : sequence of int, optional
            Of these landmarks and the pose only, in this order: their marginal.  The
            whole map's where not given.  What was joined holds until the next submap
            is closed.

        Raises
        ------
        ValueError
            Where one is not in the map, or they are more than ``belief_limit``.
        numpy.linalg.LinAlgError
            Where the submaps contradict each other so that they cannot be joined, or
            where their covariances are degenerate.
        """
        ids = validation.mapped_identities(landmark_ids, self._slots)
        instead = "give landmark_ids, call local_belief()"
        validation.refuse_large_belief(len(ids), self._belief_limit, instead)
        local, local_slots = self._present()
        wanted = np.array([self._slots[i] for i in ids], dtype=np.int64)
        if landmark_ids is None:
            closed, world = self._everything()
        else:
            needed = np.union1d(wanted, local_slots)
            closed = needed[[slot in self._closed_slots for slot in needed.tolist()]]
            world = self._closed(closed)
        _, in_world, in_local = np.intersect1d(closed, local_slots, return_indices=True)
        fused = fuse(world, local, self._frame, (in_world, in_local))
        fused = with_uncertain_start(fused, *self._chain.start)
        order = np.concatenate([closed, np.delete(local_slots, in_local)])
        return _chosen(fused, order, wanted, tuple(ids))

    def local_belief(self) -> Belief:
        """Return pose and landmarks of the present submap, in the world, at once.

        As the submap alone knows them, its frame being where the chain of submaps since
        the last :meth:`join` puts it; nothing is joined, and the cost does not grow
        with the map.
        """
        local, slots = self._present()
        world = Gaussian(self._chain.pose, self._chain.covariance)
        none = np.empty(0, dtype=np.int64)
        fused = fuse(world, local, self._frame, (none, none))
        return _chosen(fused, slots, slots, self.local_ids)

    @property
    def pose(self) -> Array:
        """(x, y, θ), shape (3,) [m, m, rad], as :meth:`local_belief` has it."""
        x, y, heading = compose(self._chain.pose, self._local_pose)[0]
        return np.array([x, y, wrap_angle(float(heading))])

    @property
    def landmark_ids(self) -> tuple[int, ...]:
        """The mapped landmarks, in the order of the belief."""
        return tuple(self._slots)

    @property
    def local_ids(self) -> tuple[int, ...]:
        """The landmarks of the present submap."""
        return self._near

    @property
    def closed_count(self) -> int:
        """Number of closed submaps."""
        return len(self._outlines)

    @property
    def nbytes(self) -> int:
        """Memory that submaps and what joins them take [bytes]."""
        outlines = sum(outline.nbytes for outline in self._outlines)
        joined = 0 if self._joined is None else self._joined.nbytes
        whole = 0 if self._whole is None else self._whole[1].covariance.nbytes
        return self._store.nbytes + outlines + joined + whole

    def state_dict(self) -> dict[str, Any]:
        """Return copies of everything, as arrays; with a folder, its submaps not.

        The folder must then stay as it is: a filter that continues from this state
        reads the submaps from there.
        """
        return as_arrays(
            type(self).__name__,
            self._local.state_dict(),
            list(self._slots),
            self._chain,
            self._store,
        )

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue from a saved state, as :meth:`EkfSlam.load_state_dict`.

        Raises
        ------
        ValueError
            Also where it was saved with a folder, and this filter's is of another run,
            lacks a submap or holds another; the belief is then as before.
        """
        base = type(self._local).__name__
        saved = checked_state(state, type(self).__name__, base, self._folder)
        self._local.load_state_dict(saved.local)
        self._near = saved.near
        self._slots, self._chain = saved.slots, saved.chain
        self._store, self._outlines = saved.store, saved.outlines
        self._closed_slots = set().union(*(o.slots.tolist() for o in saved.outlines))
        self._placing = Placing()
        if isinstance(saved.store, FolderStore):
            self._folder = saved.store
        self._forget_joined()

    def _claim_folder(self) -> None:
        if self._folder is not None:
            self._folder.claim()

    def _begin(self) -> None:
        """Begin a submap: the robot at the origin of its frame, which is certain."""
        self._local.reset(ORIGIN, ORIGIN)
        self._near = ()
        self._forget_joined()

    def _forget_joined(self) -> None:
        self._joined: JoinedMap | None = None
        self._whole: tuple[Int, Gaussian] | None = None

    @property
    def _local_pose(self) -> Array:
        return self._local._mean[:3]  # no public way to it costs as little

    def _present(self) -> tuple[Gaussian, Int]:
        """Return the present submap, in its filter's error coordinates; its slots."""
        mean: Array = self._local.state_dict()["mean"]  # its heading is not wrapped
        covariance = self._local.belief().error_covariance()
        slots = np.array([self._slots[i] for i in self._near], dtype=np.int64)
        return Gaussian(mean, covariance), slots

    def _is_full(self) -> bool:
        return (
            len(self._near) >= self._submap_size
            or self._local._covariance[2, 2] > self._heading_limit**2
            or float(np.hypot(*self._local_pose[:2])) > self._extent_limit
        )

    def _close(self) -> None:
        """Close the present submap; the next begins at the robot."""
        local, slots = self._present()
        submap = Submap(slots, local.mean, local.covariance)
        self._store.append(submap)
        self._outlines.append(outline_of(submap))
        self._closed_slots.update(slots.tolist())
        self._chain.extend(local.mean[:3], self._local.belief().pose_covariance)
        self._begin()

    def _join(self) -> JoinedMap:
        if self._joined is None:
            self._joined = JoinedMap(
                self._store.load,
                self._outlines,
                self._frame,
                self._placing.frames(self._outlines, self._chain.joined, self._settle),
            )
        return self._joined

    def _settle(self, first: int, last: int, frames: Array) -> Array:
        """Join some submaps by themselves, roughly; return their frames."""
        return JoinedMap(
            lambda index: self._store.load(first + index),
            self._outlines[first:last],
            self._frame,
            frames,
            ROUGHLY,
        ).frames

    def _closed(self, slots: Int) -> Gaussian:
        """Return the last frame and closed landmarks, given where the run began."""
        if not self._outlines:
            return Gaussian(self._chain.start[0], np.zeros((3, 3)))
        return self._join().marginal(slots)

    def _everything(self) -> tuple[Int, Gaussian]:
        """All landmarks of closed submaps, kept until the next one is closed."""
        if self._whole is None:
            slots = np.array(sorted(self._closed_slots), dtype=np.int64)
            self._whole = slots, self._closed(slots)
        return self._whole


def _limit(name: str, value: float | None) -> float:
    return np.inf if value is None else validation.above(name, value, 0.0)


def _chosen(map_: Gaussian, order: Int, wanted: Int, ids: tuple[int, ...]) -> Belief:
    """Marginal of the wanted landmarks, by their places in the order of the map."""
    sorter = np.argsort(order)
    places = sorter[np.searchsorted(order, wanted, sorter=sorter)]
    rows = np.concatenate([np.arange(3), 3 + pairs(places)])
    covariance = map_.covariance[rows[:, None], rows]
    return Belief(map_.mean[rows], covariance, ids, "invariant")
