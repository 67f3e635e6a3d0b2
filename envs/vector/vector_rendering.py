"""Rendering of worlds that are simulated together: one renderer per world."""

from collections.abc import Sequence

import numpy as np

from ...arrays import BoolArray, ImageArray
from ...sim_configs import Scenario
from ..rendering.episode_renderer import EpisodeRenderer
from ..rendering.render_state import BeliefLike
from .world_batch import WorldBatch


class VectorRenderer:
    """One `EpisodeRenderer` per world.

    Parameters
    ----------
    scenario, mode, fps
        As in `EpisodeRenderer`.
    count : int
        Number of worlds.
    """

    def __init__(self, scenario: Scenario, mode: str, fps: float, count: int) -> None:
        self._renderers = [EpisodeRenderer(scenario, mode, fps) for _ in range(count)]

    def begin(self, batch: WorldBatch, worlds: BoolArray) -> None:
        """Start an episode in these worlds, and add its first state."""
        landmarks = batch.landmarks
        for world in np.flatnonzero(worlds):
            self._renderers[world].begin(landmarks[world])
        self.add(batch, worlds)

    def add(self, batch: WorldBatch, worlds: BoolArray) -> None:
        """Add the present state of these worlds."""
        ids = batch.landmark_ids
        for world in np.flatnonzero(worlds):
            mask = batch.mask[world]
            self._renderers[world].add(
                batch.poses[world].copy(),
                batch.measurements[world][mask],
                bool(batch.collisions[world]),
                None if ids is None else ids[world][mask] < 0,
            )

    def draw(self) -> tuple[ImageArray, ...]:
        """Draw a frame of every world."""
        frames = (renderer.draw() for renderer in self._renderers)
        return tuple(frame for frame in frames if frame is not None)

    def show_beliefs(self, beliefs: Sequence[BeliefLike | None]) -> None:
        """Show belief i in the following frames of world i; None hides it.

        Raises
        ------
        ValueError
            If there is not one belief per world.
        """
        if len(beliefs) != len(self._renderers):
            raise ValueError(
                f"beliefs must be {len(self._renderers)}, one per world, "
                f"got {len(beliefs)}"
            )
        for renderer, belief in zip(self._renderers, beliefs, strict=True):
            renderer.show_belief(belief)

    def close(self) -> None:
        """Close the windows and free the figures. Further calls have no effect."""
        for renderer in self._renderers:
            renderer.close()
