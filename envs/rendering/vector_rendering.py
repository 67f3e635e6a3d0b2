"""The pictures of worlds that are simulated side by side: a view of each."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ...sim_configs import Scenario
from ..vector.world_batch import WorldBatch
from .live_view import LiveView, Moment
from .render_state import BeliefLike

BoolArray = NDArray[np.bool_]


class WorldViews:
    """One `LiveView` per world.

    Parameters
    ----------
    scenario : Scenario
        What is shown.
    mode : {"human", "rgb_array"}
        As of `LiveView`.
    fps : float
        At most so many frames per second appear in a window [1/s].
    count : int
        Number of worlds.
    """

    def __init__(self, scenario: Scenario, mode: str, fps: float, count: int) -> None:
        self._views = [LiveView(scenario, mode, fps=fps) for _ in range(count)]

    def begin(self, batch: WorldBatch, worlds: BoolArray) -> None:
        """Begin an episode's pictures in these worlds, and add its first moment."""
        landmarks = batch.landmarks
        for world in np.flatnonzero(worlds):
            self._views[world].begin(landmarks[world])
        self.add(batch, worlds)

    def add(self, batch: WorldBatch, worlds: BoolArray) -> None:
        """Add the present moment of these worlds."""
        for world in np.flatnonzero(worlds):
            seen = batch.measurements[world][batch.mask[world]]
            pose, collision = batch.poses[world].copy(), bool(batch.collisions[world])
            self._views[world].add(Moment(pose, seen, collision))

    def draw(self) -> tuple[NDArray[np.uint8], ...]:
        """Draw a frame of every world."""
        frames = (view.draw() for view in self._views)
        return tuple(frame for frame in frames if frame is not None)

    def show_beliefs(self, beliefs: Sequence[BeliefLike | None]) -> None:
        """Draw belief i in world i from now on, or none.

        Raises
        ------
        ValueError
            If there is not one per world.
        """
        if len(beliefs) != len(self._views):
            raise ValueError(
                f"beliefs must be {len(self._views)}, one per world, got {len(beliefs)}"
            )
        for view, belief in zip(self._views, beliefs, strict=True):
            view.show_belief(belief)

    def close(self) -> None:
        """Close the windows and free the figures; may be repeated."""
        for view in self._views:
            view.close()
