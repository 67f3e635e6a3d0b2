"""The keys and streams of episodes, and what is drawn at their start."""

from collections.abc import Sequence

import numpy as np

from ...arrays import Array, ComplexArray, WordArray
from ...sim_configs import Scenario, place_landmarks
from ...sim_configs.layouts import TRIES_PER_LANDMARK, RandomLayout
from ...sim_configs.scenario import RANGES
from ...sim_configs.scenario_files import copied_draw
from .draws import draw_normals, draw_uniforms, throw_darts

# the independent streams of an episode: plain integers, which numba takes quickly
START, MAP, MOTION, MEASUREMENT, DROPOUT, CLUTTER, ORDER, DRAWN = range(8)


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


def drawn_scenarios(scenario: Scenario, keys: WordArray) -> list[Scenario]:
    """Return the scenarios of the episodes with these keys, (K, 2).

    A scenario with ranges (``randomise``) draws every setting from a stream of its own.
    """
    if scenario.randomise is None:
        return [scenario] * len(keys)
    drawn = np.empty((len(keys), len(RANGES) + 2 * scenario.landmarks.count))
    draw_uniforms(keys, np.zeros(len(keys), dtype=np.int64), DRAWN, drawn)
    directions = 2.0 * drawn[:, len(RANGES) :].reshape(len(keys), -1, 2) - 1.0
    shares = drawn[:, : len(RANGES)].tolist()
    return [
        copied_draw(scenario, dict(zip(RANGES, share, strict=True)), direction)
        for share, direction in zip(shares, directions, strict=True)
    ]


class EpisodeStarts:
    """Draws the start poses and the landmarks of the episodes of a scenario.

    Parameters
    ----------
    scenario : Scenario
        Source of the start and the layout.
    """

    def __init__(self, scenario: Scenario) -> None:
        start, self._layout = scenario.start, scenario.landmarks
        self._pose, self._std = np.array(start.pose), np.array(start.std)
        self._draws_truth = start.drawn == "truth"
        self.redraws_landmarks = self._layout.is_redrawn
        """Whether every episode has new landmarks."""

    def poses(self, keys: WordArray) -> tuple[Array, Array]:
        """Return true and estimated start poses, each of shape (K, 3) [m, m, rad]."""
        drawn = np.empty((len(keys), 3))
        steps = np.zeros(len(keys), dtype=np.int64)
        draw_normals(keys, steps, START, drawn[None])
        drawn *= self._std
        drawn += self._pose
        centre = np.empty(drawn.shape)
        centre[:] = self._pose
        return (drawn, centre) if self._draws_truth else (centre, drawn)

    def landmarks(self, keys: WordArray) -> ComplexArray:
        """Return the landmarks x + iy, shape (K, N) [m], drawn anew if random.

        They equal those of `place_landmarks` with numpy's ``Philox`` at the same
        position.

        Raises
        ------
        ScenarioError
            If the layout has no room for its landmarks.
        """
        layout = self._layout
        out = np.empty((len(keys), layout.count, 2))
        if isinstance(layout, RandomLayout) and self.redraws_landmarks:
            rules = layout.bounds, layout.min_distance, TRIES_PER_LANDMARK
            left_out = throw_darts(keys, MAP, *rules, out)
            if left_out >= 0:
                raise layout.no_room(left_out)
        else:
            out[:] = place_landmarks(layout, np.random.default_rng(0))  # draws nothing
        return out.view(np.complex128)[..., 0]
