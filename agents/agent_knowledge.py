"""The knowledge of an agent in active SLAM: belief, floor and progress, no truth."""

from typing import NamedTuple

import numpy as np

from ..arrays import Array, BoolArray
from ..sim_configs import Scenario
from .coverage_grid import CoverageGrid
from .estimator_choice import BeliefOfMap, FollowingEstimator
from .wall_routes import as_points


class AgentKnowledge(NamedTuple):
    """What an agent may know at one step, for policies that plan."""

    scenario: Scenario
    grid: CoverageGrid
    estimator: FollowingEstimator
    """For predictions. A policy that changes its state must restore it."""
    belief: BeliefOfMap
    explored: BoolArray
    """Cells of the grid seen so far, as believed, shape (C,)."""
    known: BoolArray
    """Landmarks known to the required accuracy, shape (N,); with hidden identities in
    the order of the map."""
    accuracy: float
    """Required standard deviation of a landmark [m]."""
    prior_std: tuple[float, float]
    """Standard deviations of the coordinates of an unmapped landmark [m]."""
    step: int
    """Steps so far."""

    @property
    def known_in_map(self) -> BoolArray:
        """Which landmarks of the belief are known, in its order, shape (n,)."""
        ids = list(self.belief.landmark_ids)
        rows = ids if self.scenario.sensor.identities else list(range(len(ids)))
        return self.known[rows]

    @property
    def missing(self) -> int:
        """How many landmarks are not yet mapped."""
        return len(self.known) - len(self.belief.landmark_ids)

    @property
    def to_explore(self) -> BoolArray:
        """Which cells are unseen and within the robot's reach, shape (C,)."""
        return ~self.explored & self.grid.routes.reachable

    def goals(self) -> Array:
        """Return the positions worth a visit, shape (K, 2) [m].

        These are the mapped landmarks that are not yet known and, while a landmark is
        not yet mapped, the unexplored cells that the robot can get to.
        """
        landmarks: Array = self.belief.landmarks[~self.known_in_map]
        if not self.missing:
            return landmarks
        cells = self.grid.cells[self.to_explore]
        return np.concatenate([landmarks, as_points(cells)])
