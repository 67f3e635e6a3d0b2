"""SLAM in submaps: a map of any size as many small ones, joined on demand.

`SubmapSlam` is the public filter; `as_arrays` and `saved_graph` convert a run to a
saved state and back.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from contextlib import suppress
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from .... import argument_checks
from ....argument_checks import LandmarkIds
from ....arrays import Array, IntArray
from ...beliefs import Belief, MapView, UpdateReport, describe_map
from ...filters.ekf import EkfSlam, InvariantEkfSlam
from ...guards import saved_states
from ...guards.interrupts import Interruptible, changing
from ...guards.saved_states import with_prefix, without_prefix
from ...models.sensors import only_placing
from ..undo import Undo, attributes, undo_all
from .closed_submaps import ClosedSubmaps, Neighbourhood, Region, merged
from .graph import ORIGIN, ActiveSubmap, Chain, ClosingRule, SubmapGraph
from .joining import summarise
from .store import (
    FolderStore,
    LandmarkIndex,
    MemoryStore,
    Submap,
    SubmapStore,
    slot_of_link,
)

BASES: dict[str, type[EkfSlam]] = {"ekf": EkfSlam, "invariant": InvariantEkfSlam}


class SubmapSlam(Interruptible):
    """SLAM in submaps: small independent local maps, joined on demand.

    A filter starts at the origin of its own frame, where it knows its pose exactly, and
    maps what it sees.  When the submap is full, it is closed, and the next one begins
    at the robot: at (0, 0, 0) in a new frame, with an empty map.  Every linearisation
    is therefore local, and the submaps are independent: each measurement and each
    motion belongs to one submap alone [1]_.

    ``belief()`` joins the submaps.  Landmarks in several submaps are the same unknown,
    which closes loops, and the frames are the sparse least-squares solution,
    linearised at one point (`joining`).  One linear update then fuses the active
    submap (`graph`).  The cost of a step depends on the active submap only, not
    on the size of the map.

    Parameters
    ----------
    motion_std, measurement_std, initial_pose, initial_pose_std
        As in :class:`EkfSlam`.
    base : {"invariant", "ekf"}
        The filter of a submap.
    submap_size : int or None
        Number of landmarks that closes a submap; at least as many as a scan holds.
        None: 50, or twice as many as the last scan holds if it holds more than 50.
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
        submap_size: int | None = None,
        heading_limit: float | None = None,
        extent_limit: float | None = None,
        folder: str | os.PathLike[str] | None = None,
        belief_limit: int = 5000,
        **settings: Any,
    ) -> None:
        make = BASES[argument_checks.one_of("base", base, tuple(BASES))]
        self._active = ActiveSubmap(make(motion_std, measurement_std, **settings))
        only_placing(self._active.filter.sensor, "a submap")
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
        with changing(self, "reset", self._undo(), anew=True):
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
        self._report = UpdateReport()

    def predict(self, odometry: ArrayLike, dt: float = 1.0) -> None:
        """Move the pose by one odometry reading, as :meth:`EkfSlam.predict`."""
        motion = argument_checks.pair("odometry", odometry)
        argument_checks.duration(dt)
        self._claim_folder()
        with changing(self, "predict"):
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
        if self._rule.size is not None and len(readings) > self._rule.size:
            raise ValueError(
                f"submap_size must be >= {len(readings)}, the "
                f"landmarks of one scan, got {self._rule.size}"
            )
        ids = argument_checks.identities(landmark_ids, len(readings), self)
        argument_checks.refuse_reserved(ids)
        argument_checks.refuse_unusable(readings, ids)
        self._claim_folder()
        overdue, index = self._graph.is_overdue, self._graph.index
        with changing(self, "update", self._undo() if overdue else None):
            if overdue:
                self._close()
            report = self._active.filter.update(readings, ids)
            new = tuple(i for i in report.added_ids if i not in index)
            index.add(new)
            if new != report.added_ids:
                report = report.replace(added_ids=new)
            self._neighbourhood.update(readings, ids, report)
            if len(readings) and self._rule.closes(self._active, len(readings)):
                with suppress(OSError):  # the next scan tries again, and raises
                    self._close()
            self._report = report
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
        with changing(self, "remove", self._undo()):
            self._graph.remove(ids)
            self._neighbourhood.remove(ids)

    def merge(self, kept: int, gone: int) -> None:
        """Condition on two mapped landmarks being the same, and remove the second.

        The landmark then connects all submaps that hold either.  Submaps that hold both
        are conditioned separately.

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
        kept, gone = argument_checks.landmark_pairs(pairs, self._graph.index)
        pairs = list(zip(kept, gone, strict=True))
        self._claim_folder()
        with changing(self, "merge", self._undo()):
            self._graph.merge_pairs(pairs)
            self._neighbourhood.merge_pairs(pairs)

    def join(self) -> None:
        """Join the closed submaps, and continue from the result.

        After ``join()``, unlike after ``belief()``, ``pose`` and ``local_belief()``
        include all loops closed so far, and later joins begin here.
        """
        with changing(self, "join", self._graph.checkpoint()):
            if self.closed_count:
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
        self.refuse_interrupted()
        reach = argument_checks.distance("within", within)
        return self._neighbourhood.view(reach)._replace(whole=self.landmark_ids)

    def belief(self, landmark_ids: LandmarkIds | None = None) -> Belief:
        """Join the submaps, and return a snapshot of the belief.

        Parameters
        ----------
        landmark_ids : sequence of int, optional
            Return the marginal of the pose and these landmarks, in this order; by
            default, of the whole map.  The join is cached until a submap is closed.

        Raises
        ------
        ValueError
            If one is not in the map, more than ``belief_limit`` are asked for, or the
            file of a submap is lost.
        numpy.linalg.LinAlgError
            If the submaps contradict each other so that they cannot be joined, or if
            their covariances are degenerate.
        """
        self.refuse_interrupted()
        ids = argument_checks.asked_identities(landmark_ids, self._graph.index)
        instead = "give landmark_ids, call local_belief()"
        argument_checks.refuse_large_belief(len(ids), self.belief_limit, instead)
        return self._graph.belief(tuple(ids), remember=landmark_ids is None)

    def local_belief(self) -> Belief:
        """Return pose and landmarks of the active submap in the world, without a join.

        The frame of the submap is the composition of all submaps since the last
        :meth:`join`.  The cost does not depend on the size of the map.
        """
        self.refuse_interrupted()
        return self._graph.local_belief()

    def __repr__(self) -> str:
        pose = self.local_belief()
        found = describe_map(len(self.landmark_ids), pose.pose, pose.pose_covariance)
        return f"{type(self).__name__} of {found}"

    @property
    def pose(self) -> Array:
        """(x, y, θ), shape (3,) [m, m, rad], as in :meth:`local_belief`."""
        self.refuse_interrupted()
        return self._graph.pose

    @property
    def landmark_ids(self) -> tuple[int, ...]:
        """The mapped landmarks, in the order of the belief."""
        self.refuse_interrupted()
        return tuple(self._graph.index)

    @property
    def local_ids(self) -> tuple[int, ...]:
        """The landmarks of the active submap."""
        self.refuse_interrupted()
        return self._graph.active_ids()

    @property
    def closed_count(self) -> int:
        """Number of closed submaps."""
        return len(self._graph.closed)

    @property
    def nbytes(self) -> int:
        """Memory of submaps and joined map [bytes]."""
        return self._graph.closed.nbytes + self._neighbourhood.nbytes

    @property
    def viewed(self) -> tuple[Any, ...]:
        """What :meth:`local_view` changes; an earlier value takes its calls back."""
        return self._neighbourhood.viewed

    @viewed.setter
    def viewed(self, before: tuple[Any, ...]) -> None:
        self._neighbourhood.viewed = before

    def _undo(self) -> Undo:
        """Return what takes back a change before the step of the active submap."""
        return undo_all(
            attributes(self, self._active.filter.map),
            self._neighbourhood.checkpoint(),
            self._graph.checkpoint(),
        )

    @property
    def steps(self) -> int:
        """Number of steps taken; it changes together with the belief."""
        return self._active.filter.steps

    def report(self) -> UpdateReport:
        """Return the report of the last update once more."""
        self.refuse_interrupted()
        return self._report

    def state_dict(self) -> dict[str, Any]:
        """Return copies of the whole state as arrays, without submaps in a folder.

        A filter that loads the state reads them from the folder, which must not change.
        """
        self.refuse_interrupted()
        vicinity = self._neighbourhood.state_dict()
        return as_arrays(type(self).__name__, self._graph, vicinity)

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue from a saved state, as `EkfSlam.load_state_dict`.

        Raises
        ------
        ValueError
            Also if the folder does not hold the submaps of the state, or holds the run
            of another filter; the belief is then unchanged.
        """
        graph = saved_graph(state, type(self).__name__, self._active, self._folder)
        near = self._neighbourhood.restored(without_prefix(state, "vicinity", "_"))
        with changing(self, "load_state_dict", self._undo(), anew=True):
            self._active.filter.load_state_dict(without_prefix(state, "local", "_"))
            self._graph, self._neighbourhood = graph, near
            self._report = UpdateReport()
            if isinstance(graph.closed.store, FolderStore):
                self._folder = graph.closed.store

    def _claim_folder(self) -> None:
        if self._folder is not None:
            self._folder.claim()

    def _close(self) -> None:
        self._graph.close()
        self._neighbourhood.renew()

    def _joined_region(self, reach: float) -> tuple[Belief, Region]:
        return self._graph.joined_region(reach)


# --------------------------------------------------------------------------------------
# Conversion of a run in submaps to arrays, and checks of such arrays.

STATE: saved_states.Table = {
    "landmark_ids": (saved_states.IDS, "n"),
    "slot_count": (saved_states.COUNTS,),
    "submap_count": (saved_states.COUNTS,),
    "chain_start": (saved_states.NUMBERS, 4, 3),
    "chain_present": (saved_states.NUMBERS, 4, 3),
    "chain_joined": (saved_states.NUMBERS, -1, 3),
}
SUBMAP: saved_states.Table = {
    "slots": (saved_states.COUNTS, "n"),
    "mean": (saved_states.NUMBERS, "3+2n"),
    "covariance": (saved_states.NUMBERS, "3+2n", "3+2n"),
}


def as_arrays(name: str, graph: SubmapGraph, near: Mapping[str, Any]) -> dict[str, Any]:
    """Return copies of the whole state; submaps in a folder by their checksums."""
    index, closed, store = graph.index, graph.closed, graph.closed.store
    local = graph.active.filter.state_dict()
    renamed = np.array(list(closed.renamed.items()), dtype=np.int64)
    state: dict[str, Any] = {
        "estimator": np.array(name),
        "base": np.array(str(local["estimator"])),
        "landmark_ids": np.array(list(index), dtype=np.int64),
        "slots": np.array(list(index.values()), dtype=np.int64),
        "slot_count": np.array(index.count),
        "renamed": renamed.reshape(-1, 2),
        "submap_count": np.array(len(store)),
        "run": np.array(""),
    }
    state |= with_prefix("local", local, "_") | with_prefix("vicinity", near, "_")
    state |= with_prefix("chain", graph.chain.state_dict(), "_")
    if isinstance(store, FolderStore):
        digests = np.array(store.digests, dtype=np.int64)
        return state | {"run": np.array(store.run), "digests": digests}
    for k in range(len(store)):
        saved = {key: part.copy() for key, part in store.load(k)._asdict().items()}
        state |= with_prefix(f"submap_{k}", saved, "_")
    return state


def saved_graph(
    state: Mapping[str, Any],
    name: str,
    active: ActiveSubmap,
    folder: FolderStore | None,
) -> SubmapGraph:
    """Return the graph of a state that :func:`as_arrays` saved.

    Parameters
    ----------
    state : mapping
        From :func:`as_arrays`.
    name : str
        Class of the estimator that loads the state.
    active : ActiveSubmap
        Of that estimator; it is not changed.
    folder : FolderStore or None
        Of that estimator; it is not changed.

    Raises
    ------
    ValueError
        If the state is incomplete or inconsistent.
    """
    entries = [*STATE, "slots", "renamed", "run", "local_estimator"]
    base = type(active.filter).__name__
    saved_states.refuse_other_state(state, entries, estimator=name, base=base)
    saved = saved_states.read(state, STATE)
    index = _index(state, saved["landmark_ids"], int(saved["slot_count"]))
    count = int(saved["submap_count"])
    if not 1 <= (rows := len(saved["chain_joined"])) <= count + 1:
        raise ValueError(
            f"state['chain_joined'] must have 1 to {count + 1} rows, got {rows}"
        )
    for key in ("chain_start", "chain_present"):
        P = (saved[key][1:] + saved[key][1:].T) / 2
        saved_states.refuse_indefinite(f"state[{key!r}]", P)
    names = saved_states.landmark_ids(
        "local_landmark_ids", state.get("local_landmark_ids", ())
    )
    pairs = _numbers(state, "renamed", index.count).reshape(-1, 2)
    renamed = dict(zip(*pairs.T.tolist(), strict=True))
    store, summaries = _store(state, count, folder), []
    for k in range(count):
        if isinstance(store, FolderStore):
            state = with_prefix(f"submap_{k}", store.load(k)._asdict(), "_")
        submap = _submap(state, k, index.count)
        if isinstance(store, MemoryStore):
            store.append(submap)
        summaries.append(summarise(merged(submap, renamed, active.frame)))
    closed = ClosedSubmaps(store, active.frame, renamed, summaries)
    links = {i for i in names if i not in index}
    if unknown := {i for i in links if slot_of_link(i) not in closed.slots}:
        raise ValueError(
            f"state['local_landmark_ids'] must be in the map, got {min(unknown)}"
        )
    chain = Chain.restored(without_prefix(saved, "chain", "_"))
    return SubmapGraph(index, chain, closed, active)


def _numbers(state: Mapping[str, Any], key: str, limit: int) -> IntArray:
    numbers = np.asarray(state[key])
    if numbers.dtype.kind != "i" or not ((numbers >= 0) & (numbers < limit)).all():
        raise ValueError(f"state[{key!r}] must be whole numbers from 0 to {limit - 1}")
    return numbers


def _index(state: Mapping[str, Any], ids: list[int], count: int) -> LandmarkIndex:
    """Return the landmarks of the map with their slots."""
    argument_checks.refuse_reserved(ids)
    slots = _numbers(state, "slots", count).ravel()
    if len(slots) != len(ids) or (np.diff(slots) <= 0).any():
        raise ValueError(
            f"state['slots'] must be {len(ids)} ascending numbers, one for each of "
            f"landmark_ids, got {slots.tolist()}"
        )
    return LandmarkIndex(dict(zip(ids, slots.tolist(), strict=True)), count)


def _store(
    state: Mapping[str, Any], count: int, folder: FolderStore | None
) -> SubmapStore:
    """Return the store of a run: its folder, or an empty one in memory."""
    run = str(state["run"])
    if folder is None:
        if run:
            raise ValueError(
                f"state was saved with a folder of submaps (run {run}): make the "
                "estimator with that folder"
            )
        return MemoryStore()
    if count and not run:
        raise ValueError(
            "state holds its submaps itself: make the estimator without folder"
        )
    sums = np.asarray(state.get("digests", ())).tolist()
    if len(sums) != count:
        raise ValueError(f"state['digests'] must have {count} entries, got {len(sums)}")
    return folder.continued(run, sums)


def _submap(state: Mapping[str, Any], index: int, landmarks: int) -> Submap:
    """Return a submap of a state; its slots must be below a number of landmarks."""
    name = f"submap_{index}"
    saved = saved_states.read(state, with_prefix(name, SUBMAP, "_"))
    submap = Submap(*saved.values())
    if (submap.slots >= landmarks).any():
        raise ValueError(
            f"state['{name}_slots'] must be below {landmarks}, got {submap.slots.max()}"
        )
    P = (submap.covariance + submap.covariance.T) / 2
    saved_states.refuse_indefinite(f"state['{name}_covariance']", P)
    return submap
