"""The live view of a landmark world, by matplotlib alone.

Everything is drawn once; from then on a frame costs only what moves (blitting).
"""

from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray

from ...sim_configs import Scenario
from .blitting import BlittedFigure
from .render_state import BeliefLike, WorldSnapshot
from .scene import WorldPicture
from .video import write_video

if TYPE_CHECKING:
    from .window import Window

__all__ = ["BeliefLike", "WorldRenderer", "WorldSnapshot", "write_video"]

Array = NDArray[np.floating]

_INCHES = 6.0  # side of the figure; its pixels come from the resolution


class _Scene(NamedTuple):
    """What exists from the first frame until `close`."""

    picture: WorldPicture
    blitted: BlittedFigure
    window: "Window | None"


class WorldRenderer:
    """Draws snapshots of one world, to arrays or to a window.

    The figure is made at the first `render` and is never pickled or copied with the
    renderer, which then makes another.

    Parameters
    ----------
    scenario : Scenario
        What is drawn: walls, robot, sensor, and the planned path for the limits.
    landmarks : ndarray, shape (N, 2)
        True positions [m].
    mode : {"rgb_array", "human"}
        Whether `render` returns frames or shows them in matplotlib's own window.
    size_px : int, default 600
        Side of the square picture [pixels].
    fps : float, default 30
        At most so many frames per second appear in the window [1/s].

    Examples
    --------
    >>> from slamgym.sim_configs import load_scenario
    >>> renderer = WorldRenderer(
    ...     load_scenario("six_landmarks"), np.ones((1, 2)), "rgb_array", size_px=200
    ... )
    >>> start = WorldSnapshot(
    ...     np.zeros(3), np.zeros((1, 2)), np.empty((0, 2)), False, None, 0.0, 0
    ... )
    >>> renderer.render(start).shape
    (200, 200, 3)
    >>> renderer.close()
    """

    def __init__(
        self,
        scenario: Scenario,
        landmarks: Array,
        mode: Literal["rgb_array", "human"],
        size_px: int = 600,
        *,
        fps: float = 30.0,
    ) -> None:
        if mode not in ("rgb_array", "human"):
            raise ValueError(f"mode must be 'rgb_array' or 'human', got {mode!r}")
        if size_px < 100:
            raise ValueError(f"size_px must be >= 100, got {size_px}")
        if not 0 < fps < np.inf:
            raise ValueError(f"fps must be a finite number > 0, got {fps}")
        self._scenario = scenario
        self._landmarks = np.array(landmarks, dtype=float).reshape(-1, 2)
        self._mode = mode
        self._size_px = size_px
        self._fps = fps
        self._scene: _Scene | None = None

    def render(self, snapshot: WorldSnapshot) -> NDArray[np.uint8] | None:
        """Draw one snapshot.

        Returns
        -------
        ndarray of uint8, shape (size_px, size_px, 3), or None
            A fresh copy in mode "rgb_array"; None in mode "human", which waits so
            long that the window shows at most `fps` frames per second.
        """
        if self._scene is None:
            self._scene = self._make_scene()
        picture, blitted, window = self._scene
        if picture.show(snapshot):
            blitted.outdate()
        if window is None:
            return blitted.frame()
        window.refresh(blitted)
        return None

    def close(self) -> None:
        """Close the window, if there is one, and free the figure; may be repeated."""
        if self._scene is not None and self._scene.window is not None:
            self._scene.window.close()
        self._scene = None

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_scene": None}

    def _make_scene(self) -> _Scene:
        figure, window = Figure(), None
        if self._mode == "human":
            from .window import Window  # noqa: PLC0415 (pyplot, for windows only)

            window = Window(self._fps)
            figure = window.figure
        else:
            FigureCanvasAgg(figure)
        figure.set_dpi((self._size_px + 0.01) / _INCHES)  # never a pixel less
        figure.set_size_inches(_INCHES, _INCHES)
        picture = WorldPicture(figure, self._scenario, self._landmarks)
        return _Scene(picture, BlittedFigure(figure, picture.moving), window)
