"""Random numbers by position, held against numpy and the standard library."""

import os
import subprocess
import sys

import numpy as np
import pytest
from numpy_streams import NAMES, normals, philox, uniforms

from slamgym.envs import random_numbers as episodes
from slamgym.envs.random_numbers import (
    EpisodeStarts,
    draw_normals,
    draw_uniforms,
    episode_keys,
)
from slamgym.sim_configs import load_scenario, place_landmarks

CROWDED = load_scenario("active_medium").with_changes(
    landmarks={"count": 20, "min_distance": 2.5, "bounds": [-7.5, -7.5, 7.5, 6.5]}
)


def keys_of(count, seed=0):
    return episode_keys([np.random.default_rng([seed, k]) for k in range(count)])


def normal_rows(keys, steps, width, *, stream=0):
    out = np.empty((len(keys), width))
    draw_normals(keys, np.asarray(steps), stream, out)
    return out


def uniform_rows(keys, steps, width, *, stream=0):
    out = np.empty((len(keys), width))
    draw_uniforms(keys, np.asarray(steps), stream, out)
    return out


@pytest.mark.parametrize("width", [1, 3, 4, 13])
def test_uniform_numbers_are_those_of_numpys_philox(width):
    keys, steps = keys_of(3), [0, 7, 2**40]
    for stream, name in enumerate(NAMES):
        rows = uniform_rows(keys, steps, width, stream=stream)
        for row, key, step in zip(rows, keys, steps, strict=True):
            np.testing.assert_array_equal(row, uniforms(key, name, width, step))


@pytest.mark.parametrize("width", [3, 10, 12])
def test_normal_numbers_are_the_quantiles_of_numpys_words(width):
    keys, steps = keys_of(40), np.arange(40)
    rows = normal_rows(keys, steps, width, stream=3)
    assert (np.abs(rows) > 1.5).any()  # the tails have their own formula
    for k in range(40):
        expected = normals(keys[k], "measurement", width, k)
        np.testing.assert_array_equal(rows[k], expected)


def test_the_streams_are_numbered_as_named():
    assert [getattr(episodes, name.upper()) for name in NAMES] == list(range(7))


def test_a_row_is_the_same_alone_and_among_others():
    keys, steps = keys_of(64), np.arange(64) % 5
    together = normal_rows(keys, steps, 9)
    for k in (0, 5, 63):
        alone = normal_rows(keys[k : k + 1], steps[k : k + 1], 9)[0]
        np.testing.assert_array_equal(alone, together[k])


def test_every_generator_gives_its_own_key_and_the_next_one_after_it():
    generators = [np.random.default_rng(seed) for seed in range(50)]
    keys = np.concatenate([episode_keys(generators) for _ in range(3)])
    assert len(np.unique(keys)) == keys.size
    again = episode_keys([np.random.default_rng(7)])
    np.testing.assert_array_equal(again[0], keys[7])


def test_darts_are_those_of_the_layout_with_numpys_philox():
    keys = keys_of(30)
    drawn = EpisodeStarts(CROWDED).landmarks(keys)
    for key, landmarks in zip(keys, drawn, strict=True):
        rng = np.random.Generator(philox(key, "map"))
        placed = place_landmarks(CROWDED.landmarks, rng)
        np.testing.assert_array_equal(landmarks, placed[:, 0] + 1j * placed[:, 1])


def test_starts_are_drawn_around_the_pose_with_its_standard_deviations():
    start = {"pose": [1.0, -2.0, 3.0], "std": [0.1, 0.2, 0.3], "drawn": "truth"}
    starts = EpisodeStarts(CROWDED.with_changes(start=start))
    drawn, centre = starts.poses(keys_of(5000))
    assert (centre == start["pose"]).all()
    unit = (drawn - centre) / start["std"]
    assert np.abs(unit.mean(axis=0)).max() < 4 / np.sqrt(5000)
    assert np.abs(unit.std(axis=0) - 1).max() < 4 / np.sqrt(2 * 5000)


@pytest.mark.slow
def test_plain_python_draws_the_same_without_a_warning():
    code = """
from slamgym.envs import LandmarkWorldEnv
env = LandmarkWorldEnv("active_easy", start={"std": [0.1, 0.1, 0.1]})
env.reset(seed=3)
observation, *_ = env.step((0.5, 0.1))
for array in (env.pose, env.landmarks, observation["landmarks"]):
    print(array.tobytes().hex())
"""
    compiled, plain = (
        subprocess.run(
            [sys.executable, "-W", "error", "-c", code],
            env={**os.environ, **environment},
            check=True,
            capture_output=True,
            text=True,
        ).stdout
        for environment in ({}, {"NUMBA_DISABLE_JIT": "1"})
    )
    assert compiled == plain
