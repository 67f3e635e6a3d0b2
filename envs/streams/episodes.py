"""The keys and streams of episodes, and what is drawn at their start."""

from collections.abc import Sequence

import numpy as np

from ...arrays import Array, ComplexArray, IntArray, WordArray
from ...sim_configs import Scenario, place_landmarks
from ...sim_configs.layouts import TRIES_PER_LANDMARK, RandomLayout
from .draws import draw_normals, throw_darts

# the independent streams of an episode: plain integers, which numba takes quickly
START, MAP, MOTION, MEASUREMENT, DROPOUT, CLUTTER, ORDER = range(7)


def episode_keys(generators: Sequence[np.random.Generator]) -> WordArray:
    """Draw the key of one episode from each generator, shape (K, 2).

    Two words of the bit generator make a key. So a generator with the same state gives
    the same episode.

    Examples
    --------
    >>> rng = np.random.default_rng(0)
    >>> before = rng.bit_generator.state
    >>> keys = episode_keys([rng])
    >>> rng.bit_generator.state = before
    >>> bool((keys == episode_keys([rng])).all())
    True
    """
    words = [rng.bit_generator.random_raw() for rng in generators for _ in range(2)]
    return np.array(words, dtype=np.uint64).reshape(-1, 2)


def draw_starts(scenario: Scenario, keys: WordArray) -> tuple[Array, Array]:
    """Return true and estimated start poses, each of shape (K, 3) [m, m, rad]."""
    start = scenario.start
    unit = np.empty((1, len(keys), 3))
    draw_normals(keys, _first_steps(len(keys)), START, unit)
    drawn = start.pose + unit[0] * start.std
    centre = np.empty(drawn.shape)
    centre[:] = start.pose
    return (drawn, centre) if start.drawn == "truth" else (centre, drawn)


def draw_landmarks(scenario: Scenario, keys: WordArray) -> ComplexArray:
    """Return the landmarks x + iy, shape (K, N) [m], new ones for every key.

    They equal those of `place_landmarks` with numpy's ``Philox`` at the same position.

    Raises
    ------
    ScenarioError
        If the layout has no room for its landmarks.
    """
    layout = scenario.landmarks
    out = np.empty((len(keys), layout.count, 2))
    if isinstance(layout, RandomLayout) and layout.is_redrawn:
        rules = layout.bounds, layout.min_distance, TRIES_PER_LANDMARK
        left_out = throw_darts(keys, MAP, *rules, out)
        if left_out >= 0:
            raise layout.no_room(left_out)
    else:
        out[:] = place_landmarks(layout, np.random.default_rng(0))  # draws nothing
    return out.view(np.complex128)[..., 0]


def _first_steps(count: int) -> IntArray:
    return np.zeros(count, dtype=np.int64)
