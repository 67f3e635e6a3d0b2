"""SLAM in submaps: a map of any size as many small ones, joined on demand."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from contextlib import suppress
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ....arrays import Array
from ...filters.ekf import EkfSlam, InvariantEkfSlam
from ...interface import Belief, MapView, UpdateReport
from ...support import argument_checks
from ...support import argument_checks as pair_checks
from ...support.argument_checks import LandmarkIds
from ...support.undo import Undo, attributes, undo_all, undone_on_error
from .active_submap import ORIGIN, ActiveSubmap
from .chain import Chain
from .closed_submaps import ClosedSubmaps
from .closing_rule import ClosingRule
from .graph import SubmapGraph
from .landmark_index import LandmarkIndex, refuse_link_names
from .neighbourhood import Neighbourhood, Region
from .queries import SubmapQueries
from .saved_state import as_arrays, checked_state
from .store import FolderStore, MemoryStore

BASES: dict[str, type[EkfSlam]] = {"ekf": EkfSlam, "invariant": InvariantEkfSlam}


class SubmapSlam(SubmapQueries):
    """SLAM in submaps: small independent local maps, joined on demand.

    A filter starts at the origin of its own frame, where it knows its pose exactly, and
    maps what it sees.  When the submap is full, it is closed, and the next one begins
    at the robot: at (0, 0, 0) in a new frame, with an empty map.  Every linearisation
    is therefore local, and the submaps are independent: each measurement and each
    motion belongs to one submap alone [1]_.

    ``belief()`` joins the submaps.  Landmarks in several submaps are the same unknown,
    which closes loops, and the frames are the sparse least-squares solution,
    linearised at one point (`joining`).  One linear update then fuses the active
    submap (`fusion`).  The cost of a step depends on the active submap only, not
    on the size of the map.

    Parameters
    ----------
    motion_std, measurement_std, initial_pose, initial_pose_std
        As in :class:`EkfSlam`.
    base : {"invariant", "ekf"}
        The filter of a submap.
    submap_size : int
        Number of landmarks that closes a submap; at least as many as a scan holds.
    heading_limit : float or None
        Standard deviation of the heading in the submap's frame that closes it [rad].
        Linearisation is accurate only while it is small.
    extent_limit : float or None
        Distance from the submap's origin that closes it [m].
    folder : path or None
        Folder for closed submaps; only a few then stay in memory.  It must be empty,
        not exist yet, or hold a run that :meth:`load_state_dict` continues.
        :meth:`reset` deletes the submaps of the run.  None: all stay in memory.
    belief_limit : int
        Largest number of landmarks for which ``belief`` computes a dense covariance.
    **settings
        Other options of the base filter.  A gate applies within a submap: it does not
        test the first measurement of a landmark in a new submap against older submaps.

    Raises
    ------
    ValueError
        If an argument is invalid.

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
    >>> slam.belief([7]).landmarks  # belief() returns the whole map
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
        self._active = ActiveSubmap(make(motion_std, measurement_std, **settings))
        noise = np.array(motion_std), np.array(measurement_std)
        ungated = settings | {"gate_probability": None}
        near = partial(InvariantEkfSlam, *noise, **ungated)
        self._neighbourhood = Neighbourhood(near, self._joined_region)
        self._rule = ClosingRule.checked(submap_size, heading_limit, extent_limit)
        self.belief_limit = argument_checks.whole("belief_limit", belief_limit, 1)
        self._folder = None if folder is None else FolderStore(folder)
        self._begin(initial_pose, initial_pose_std)

    def reset(self, pose: ArrayLike, pose_std: ArrayLike) -> None:
        """Start a new run with an empty map, as `EkfSlam.reset`."""
        with undone_on_error(self.checkpoint()):
            self._begin(pose, pose_std)

    def _begin(self, pose: ArrayLike, pose_std: ArrayLike) -> None:
        first = argument_checks.finite_vector("pose", pose, 3)
        std = argument_checks.standard_deviations("pose_std", pose_std, 3)
        if self._folder is not None:
            self._folder.clear()
        folder = self._folder  # its length, and so its truth value, may be 0
        store = MemoryStore() if folder is None else folder
        closed = ClosedSubmaps(store, self._active.frame)
        chain = Chain(first, np.diag(std**2))
        self._active.begin()
        self._graph = SubmapGraph(LandmarkIndex(), chain, closed, self._active)
        self._neighbourhood.forget()

    def predict(self, odometry: ArrayLike, dt: float = 1.0) -> None:
        """Move the pose by one odometry reading, as :meth:`EkfSlam.predict`."""
        motion = argument_checks.pair("odometry", odometry)
        argument_checks.duration(dt)
        self._claim_folder()
        with undone_on_error(self.checkpoint(motion=True)):
            self._active.filter.predict(motion, dt)
            self._neighbourhood.predict(motion, dt)

    def update(
        self, measurements: ArrayLike, landmark_ids: LandmarkIds | None = None
    ) -> UpdateReport:
        """Correct the active submap with one scan, and close the submap if it is full.

        Parameters as in :meth:`EkfSlam.update`.  The report holds innovations and NIS
        within the submap.  ``added_ids`` are new to the whole map.  The first
        measurement of a known landmark in a new submap corrects nothing and is not
        listed.

        Raises
        ------
        ValueError
            If the arguments are malformed, or a scan holds more landmarks than
            ``submap_size``; the belief is then unchanged.
        numpy.linalg.LinAlgError
            If an innovation covariance is not positive definite, naming the
            measurement; the belief is then unchanged.
        OSError
            If the submap that the previous scan filled cannot be written; the belief
            is then unchanged.  Every later scan tries again.
        """
        readings = argument_checks.scan(measurements)
        if len(readings) > self._rule.size:
            raise ValueError(
                f"submap_size must be >= {len(readings)}, the "
                f"landmarks of one scan, got {self._rule.size}"
            )
        ids = argument_checks.given_identities(landmark_ids, len(readings), self)
        refuse_link_names(ids)
        argument_checks.refuse_unusable(readings, ids)
        self._claim_folder()
        with undone_on_error(self.checkpoint()):
            return self._take(readings, ids)

    def _take(self, readings: Array, ids: list[int]) -> UpdateReport:
        if self._graph.is_overdue:
            self._close()
        report = self._active.filter.update(readings, ids)
        index = self._graph.index
        new = tuple(i for i in report.added_ids if i not in index)
        index.add(new)
        if new != report.added_ids:
            report = report.replace(added_ids=new)
        self._neighbourhood.update(readings, ids, report)
        if len(readings) and self._rule.closes(self._active):
            with suppress(OSError):  # the next scan tries again, and raises
                self._close()
        return report

    def remove(self, landmark_ids: LandmarkIds) -> None:
        """Remove landmarks; the belief about all else is unchanged.

        A landmark in several submaps still connects them, but no belief contains it.
        If it is seen again, it is a new landmark.

        Raises
        ------
        ValueError
            If one is not in the map; no landmark is then removed.
        """
        ids = argument_checks.mapped_identities(landmark_ids, self._graph.index)
        self._claim_folder()
        with undone_on_error(self.checkpoint()):
            self._graph.remove(ids)
            self._neighbourhood.remove(ids)

    def merge(self, kept: int, gone: int) -> None:
        """Condition on two mapped landmarks being the same, and remove the second.

        The landmark then connects all submaps that hold either.  Submaps that hold both
        are conditioned separately (`merging`).

        Raises
        ------
        ValueError
            If one is not in the map, both are the same, or the file of a submap is
            lost; nothing is merged.
        numpy.linalg.LinAlgError
            If the covariance of their distance is singular; nothing is merged.
        """
        self.merge_pairs([(kept, gone)])

    def merge_pairs(self, pairs: Sequence[tuple[int, int]]) -> None:
        """Merge several pairs (kept, gone) of landmarks; errors as :meth:`merge`."""
        kept, gone = pair_checks.landmark_pairs(pairs, self._graph.index)
        pairs = list(zip(kept, gone, strict=True))
        self._claim_folder()
        with undone_on_error(self.checkpoint()):
            self._graph.merge_pairs(pairs)
            self._neighbourhood.merge_pairs(pairs)

    def join(self) -> None:
        """Join the closed submaps, and continue from the result.

        After ``join()``, unlike after ``belief()``, ``pose`` and ``local_belief()``
        include all loops closed so far, and later joins begin here.
        """
        if self.closed_count:
            with undone_on_error(self._graph.checkpoint()):
                self._graph.join()

    def local_view(self, within: float = 0.0) -> MapView:
        """Return pose and near landmarks of the joined map, at a low cost per step.

        From the first call on, the filter follows the robot in a copy of a part of the
        joined map.  It replaces the copy when a submap is closed or the robot leaves
        the part.  The submaps and `belief` do not change.

        Parameters
        ----------
        within : float
            Distance from the robot that the view covers at least [m].  The view holds
            at most the 1000 nearest landmarks of closed submaps.

        The arrays are read-only and valid until the next step.

        Raises
        ------
        ValueError, numpy.linalg.LinAlgError
            As `belief`; the state is then unchanged.
        """
        reach = argument_checks.distance("within", within)
        return self._neighbourhood.view(reach)._replace(whole=self.landmark_ids)

    def checkpoint(self, *, motion: bool = False) -> Undo:
        """Return what takes back later calls; ``motion``: only those of predict."""
        return undo_all(
            self._active.filter.checkpoint(motion=motion),
            self._neighbourhood.checkpoint(motion=motion),
            *(() if motion else (self._graph.checkpoint(),)),
            attributes(self),
        )

    def state_dict(self) -> dict[str, Any]:
        """Return copies of the whole state as arrays, without submaps in a folder.

        A filter that loads the state reads them from the folder, which must not change.
        """
        neighbourhood = self._neighbourhood.state_dict()
        return as_arrays(type(self).__name__, self._graph, neighbourhood)

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue from a saved state, as `EkfSlam.load_state_dict`.

        Raises
        ------
        ValueError
            Also if the folder does not hold the submaps of the state, or holds the run
            of another filter; the belief is then unchanged.
        """
        saved = checked_state(state, type(self).__name__, self._active, self._folder)
        neighbourhood = self._neighbourhood.restored(saved.neighbourhood)
        landmarks, chain, closed = saved.landmarks, saved.chain, saved.closed
        with undone_on_error(self.checkpoint()):
            self._active.filter.load_state_dict(saved.local)
            self._graph = SubmapGraph(landmarks, chain, closed, self._active)
            self._neighbourhood = neighbourhood
            if isinstance(closed.store, FolderStore):
                self._folder = closed.store

    def _claim_folder(self) -> None:
        if self._folder is not None:
            self._folder.claim()

    def _close(self) -> None:
        self._graph.close()
        self._neighbourhood.renew()

    def _joined_region(self, reach: float) -> tuple[Belief, Region]:
        return self._graph.joined_region(reach)
