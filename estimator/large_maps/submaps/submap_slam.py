"""Submaps: a map of any size as many small ones, joined when they are asked for."""

from __future__ import annotations

import os
from collections.abc import Mapping
from contextlib import suppress
from functools import partial
from math import hypot
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ...filters.ekf import EkfSlam
from ...filters.invariant import InvariantEkfSlam
from ...interface import Belief, MapView, UpdateReport
from ...models.angles import wrap_angle
from ...support import argument_checks
from ...support.argument_checks import LandmarkIds
from .active_submap import ORIGIN, PresentSubmap
from .chain import Chain
from .closed_submaps import ClosedSubmaps
from .factor import compose
from .graph import SubmapRun
from .landmark_index import Slots, refuse_link_names
from .neighbourhood import Extent, Vicinity
from .saved_state import as_arrays, checked_state
from .store import FolderStore, MemoryStore

Array = NDArray[np.float64]

BASES: dict[str, type[EkfSlam]] = {"ekf": EkfSlam, "invariant": InvariantEkfSlam}


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
        make = BASES[argument_checks.one_of("base", base, tuple(BASES))]
        self._present = PresentSubmap(make(motion_std, measurement_std, **settings))
        noise = np.array(motion_std), np.array(measurement_std)
        ungated = settings | {"gate_probability": None}
        near = partial(InvariantEkfSlam, *noise, **ungated)
        self._vicinity = Vicinity(near, self._survey)
        self._submap_size = argument_checks.whole("submap_size", submap_size, 1)
        self._heading_limit = _limit("heading_limit", heading_limit)
        self._extent_limit = _limit("extent_limit", extent_limit)
        self.belief_limit = argument_checks.whole("belief_limit", belief_limit, 1)
        self._folder = None if folder is None else FolderStore(folder)
        self.reset(initial_pose, initial_pose_std)

    def reset(self, pose: ArrayLike, pose_std: ArrayLike) -> None:
        """Start a new run with an empty map, as :meth:`EkfSlam.reset`."""
        first = argument_checks.finite_vector("pose", pose, 3)
        std = argument_checks.standard_deviations("pose_std", pose_std, 3)
        if self._folder is not None:
            self._folder.clear()
        folder = self._folder  # an empty one is false
        store = MemoryStore() if folder is None else folder
        closed = ClosedSubmaps(store, self._present.frame)
        chain = Chain(first, np.diag(std**2))
        self._present.begin()
        self._run = SubmapRun(Slots(), chain, closed, self._present)
        self._vicinity.forget()

    def predict(self, odometry: ArrayLike, dt: float = 1.0) -> None:
        """Move the pose by one odometry reading, as :meth:`EkfSlam.predict`."""
        self._claim_folder()
        self._present.filter.predict(odometry, dt)
        self._vicinity.predict(odometry, dt)

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
        OSError
            Where the submap that the scan before has filled cannot be written to the
            folder; the belief is then as before.  It is tried again with every scan.
        """
        if np.size(measurements) > 2 * self._submap_size:
            least = len(argument_checks.scan(measurements))
            raise ValueError(
                f"submap_size must be >= {least}, the "
                f"landmarks of one scan, got {self._submap_size}"
            )
        refuse_link_names(landmark_ids)
        self._claim_folder()
        if self._run.is_overdue:
            self._close()
        report = self._present.filter.update(measurements, landmark_ids)
        slots = self._run.slots
        new = tuple(i for i in report.added_ids if i not in slots)
        slots.add(new)
        report = report._replace(added_ids=new)
        self._vicinity.update(measurements, landmark_ids, report)
        if np.size(measurements) and self._is_full():
            with suppress(OSError):  # told before the next scan is in
                self._close()
        return report

    def remove(self, landmark_ids: LandmarkIds) -> None:
        """Forget landmarks; the belief about all else stays as it was.

        One that several submaps hold goes on to tie them together, but nothing tells of
        it any more: seen again, it is a new landmark.

        Parameters
        ----------
        landmark_ids : sequence of int
            Mapped landmarks, without repetition.

        Raises
        ------
        ValueError
            Where one is not in the map; nothing is then removed.
        """
        ids = argument_checks.mapped_identities(landmark_ids, self._run.slots)
        self._claim_folder()
        self._run.remove(ids)
        self._vicinity.remove(ids)

    def merge(self, kept: int, gone: int) -> None:
        """Condition on two landmarks being one, and forget the second.

        Submaps that hold either are tied together by it, as by any common landmark;
        those that hold both are conditioned each (:mod:`.submap_merging`).

        Parameters
        ----------
        kept, gone : int
            Two mapped landmarks.

        Raises
        ------
        ValueError
            Where one is not in the map, they are the same, or the file of a submap is
            lost; nothing is then merged.
        numpy.linalg.LinAlgError
            Where nothing can be said of their distance; nothing is then merged.
        """
        argument_checks.two_landmarks(kept, gone)
        argument_checks.mapped_identities([kept, gone], self._run.slots)
        self._claim_folder()
        self._run.merge(kept, gone)
        self._vicinity.merge(kept, gone)

    def join(self) -> None:
        """Join the closed submaps, and go on from there.

        ``belief()`` joins them too, but leaves no trace.  After ``join()``, ``pose``
        and ``local_belief()`` know of the loops closed so far, and later joins begin
        at this one.
        """
        if self.closed_count:
            self._run.join()

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
            Where one is not in the map, they are more than ``belief_limit``, or the
            file of a submap is lost.
        numpy.linalg.LinAlgError
            Where the submaps contradict each other so that they cannot be joined, or
            where their covariances are degenerate.
        """
        ids = argument_checks.asked_identities(landmark_ids, self._run.slots)
        instead = "give landmark_ids, call local_belief()"
        argument_checks.refuse_large_belief(len(ids), self.belief_limit, instead)
        return self._run.belief(tuple(ids), remember=landmark_ids is None)

    def local_belief(self) -> Belief:
        """Return pose and landmarks of the present submap, in the world, at once.

        As the submap alone knows them, its frame being where the chain of submaps since
        the last :meth:`join` puts it; nothing is joined, and the cost does not grow
        with the map.
        """
        return self._run.local_belief()

    def local_view(self, within: float = 0.0) -> MapView:
        """Look at pose and near landmarks as the joined map has them, in every step.

        From the first call on, the filter follows the robot in a part of the joined
        map, which it takes anew whenever a submap is closed or the robot has left it.
        That changes nothing in the submaps, nor in what :meth:`belief` answers.

        Parameters
        ----------
        within : float
            How far from the robot to look at least [m]; of closed submaps no more
            than the nearest 1000 landmarks are taken.

        Returns
        -------
        MapView
            To look at, not to keep; it may hold landmarks farther away.

        Raises
        ------
        ValueError, numpy.linalg.LinAlgError
            As :meth:`belief`; all is then as before.
        """
        return self._vicinity.view(within)._replace(whole=self.landmark_ids)

    @property
    def pose(self) -> Array:
        """(x, y, θ), shape (3,) [m, m, rad], as :meth:`local_belief` has it."""
        x, y, heading = compose(self._run.chain.pose, self._present.pose)[0]
        return np.array([x, y, wrap_angle(float(heading))])

    @property
    def landmark_ids(self) -> tuple[int, ...]:
        """The mapped landmarks, in the order of the belief."""
        return tuple(self._run.slots)

    @property
    def local_ids(self) -> tuple[int, ...]:
        """The landmarks of the present submap."""
        return tuple(i for i in self._present.names if i in self._run.slots)

    @property
    def closed_count(self) -> int:
        """Number of closed submaps."""
        return len(self._run.closed)

    @property
    def nbytes(self) -> int:
        """Memory that submaps and what joins them take [bytes]."""
        return self._run.closed.nbytes + self._vicinity.nbytes

    def state_dict(self) -> dict[str, Any]:
        """Return copies of everything, as arrays; with a folder, its submaps not.

        The folder must then stay as it is: a filter that continues from this state
        reads the submaps from there.
        """
        return as_arrays(type(self).__name__, self._run, self._vicinity.state_dict())

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue from a saved state, as :meth:`EkfSlam.load_state_dict`.

        Raises
        ------
        ValueError
            Also where it was saved with a folder, and this filter's is of another run,
            lacks a submap or holds another; or where it was saved before the first
            step, and the folder holds a run that is not this filter's.  The belief is
            then as before.
        """
        saved = checked_state(state, type(self).__name__, self._present, self._folder)
        vicinity = self._vicinity.restored(saved.vicinity)
        self._present.filter.load_state_dict(saved.local)
        self._run = SubmapRun(saved.slots, saved.chain, saved.closed, self._present)
        self._vicinity = vicinity
        if isinstance(saved.closed.store, FolderStore):
            self._folder = saved.closed.store

    def _claim_folder(self) -> None:
        if self._folder is not None:
            self._folder.claim()

    def _close(self) -> None:
        self._run.close()
        self._vicinity.renew()

    def _is_full(self) -> bool:
        x, y, _ = self._present.pose.tolist()
        return (
            len(self._present) >= self._submap_size
            or self._present.heading_variance > self._heading_limit**2
            or hypot(x, y) > self._extent_limit
        )

    def _survey(self, reach: float) -> tuple[Belief, Extent]:
        return self._run.survey(reach)


def _limit(name: str, value: float | None) -> float:
    return np.inf if value is None else argument_checks.above(name, value, 0.0)
