"""Questions about the belief of a run in submaps."""

from __future__ import annotations

from ....arrays import Array
from ...interface import Belief, describe_map
from ...support import argument_checks
from ...support.argument_checks import LandmarkIds
from .graph import SubmapGraph
from .neighbourhood import Neighbourhood


class SubmapQueries:
    """Base class of :class:`SubmapSlam`: the part that does not change the belief."""

    belief_limit: int
    _graph: SubmapGraph
    _neighbourhood: Neighbourhood

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
        ids = argument_checks.asked_identities(landmark_ids, self._graph.index)
        instead = "give landmark_ids, call local_belief()"
        argument_checks.refuse_large_belief(len(ids), self.belief_limit, instead)
        return self._graph.belief(tuple(ids), remember=landmark_ids is None)

    def local_belief(self) -> Belief:
        """Return pose and landmarks of the active submap in the world, without a join.

        The frame of the submap is the composition of all submaps since the last
        :meth:`join`.  The cost does not depend on the size of the map.
        """
        return self._graph.local_belief()

    def __repr__(self) -> str:
        pose = self.local_belief()
        found = describe_map(len(self.landmark_ids), pose.pose, pose.pose_covariance)
        return f"{type(self).__name__} of {found}"

    @property
    def pose(self) -> Array:
        """(x, y, θ), shape (3,) [m, m, rad], as in :meth:`local_belief`."""
        return self._graph.pose

    @property
    def landmark_ids(self) -> tuple[int, ...]:
        """The mapped landmarks, in the order of the belief."""
        return tuple(self._graph.index)

    @property
    def local_ids(self) -> tuple[int, ...]:
        """The landmarks of the active submap."""
        return self._graph.active_ids()

    @property
    def closed_count(self) -> int:
        """Number of closed submaps."""
        return len(self._graph.closed)

    @property
    def nbytes(self) -> int:
        """Memory of submaps and joined map [bytes]."""
        return self._graph.closed.nbytes + self._neighbourhood.nbytes
