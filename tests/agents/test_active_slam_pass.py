"""The compiled pass of active SLAM against its slow definition in numpy."""

import numpy as np
import pytest
from numpy_active_slam import SlowTask

from slamgym.agents import ActiveSlamVectorEnv
from slamgym.agents.active_slam_task import ActiveSlamTask, RewardWeights
from slamgym.estimator.filters.batch import BatchStorage
from slamgym.sim_configs import load_scenario

FLOOR = [[-8, -8, 8, -8], [8, -8, 8, 9], [8, 9, -8, 9], [-8, 9, -8, -8]]
SLOW = {"max_speed": 0.6}  # m/s, and turns by up to 1 rad/s
INNER = {"walls": [*FLOOR, [2, 2, 2, 6], [-3, -1, 0, 3]], "sensor": {"occlusion": True}}
NEAR = {"accuracy": 0.12, "landmarks": {"layout": "ring", "count": 5, "radius": 3.0}}
CASES = [
    ("active_easy", {}),
    ("active_medium", {}),
    ("active_hard", {}),
    ("active_easy", {**NEAR, "success_reward": 3.0}),
    ("active_medium", {"criterion": "A", "effort_cost": 0.3, "robot": SLOW}),
    ("active_medium", {"criterion": "E", "steps": 9, "crash_cost": 2, "walls": FLOOR}),
    ("active_medium", INNER),
]


def play(level, settings, steps, worlds=16):
    """Compare every step with the slow definition; return the kinds of ends met."""
    env = ActiveSlamVectorEnv(worlds, level, autoreset_mode="Disabled", **settings)
    slow, kinds = SlowTask(env.scenario, env.task.weights), set()
    rng = np.random.default_rng(1)
    observations, _ = env.reset(seed=0)
    now = slow.begin(env.beliefs())
    for _ in range(steps // worlds):
        same_observations(observations, slow.observe(now))
        actions = rng.uniform([-0.5, -1.0], [1.0, 1.0], (worlds, 2))
        observations, *ends, infos = env.step(actions)
        before, now = now, slow.proceed(now, env.beliefs())
        expected = slow.reward(before, now, actions, infos["collision"])
        np.testing.assert_allclose(ends[0], expected[0], rtol=0, atol=1e-12)
        measure = env.task.episodes.uncertainty
        np.testing.assert_allclose(measure, now.uncertainty, rtol=1e-12)
        for end, other in zip((*ends[1:], infos["success"]), expected[1:], strict=True):
            np.testing.assert_array_equal(end, other)
        kinds |= set(zip(*(end.tolist() for end in expected[1:]), strict=True))
        ended = ends[1] | ends[2]
        if ended.any():
            same_observations(observations, slow.observe(now))
            observations, _ = env.reset(options={"reset_mask": ended})
            now = begun_anew(now, slow.begin(env.beliefs()), ended)
    return kinds


def same_observations(observations, expected):
    assert set(observations) == set(expected)
    for key, rows in expected.items():
        found = observations[key]
        np.testing.assert_allclose(found, rows, rtol=0, atol=1e-12, err_msg=key)


def begun_anew(now, fresh, ended):
    """Replace the progress of worlds that have ended by that of their next episode."""
    parts = (
        np.where(ended.reshape(-1, *[1] * (new.ndim - 1)), new, old)
        for new, old in zip(fresh[1:], now[1:], strict=True)
    )
    return type(now)(fresh.beliefs, *parts)


@pytest.mark.parametrize(("level", "settings"), CASES)
def test_rewards_ends_and_observations_are_those_of_the_slow_definition(
    level, settings
):
    play(level, settings, steps=320)


@pytest.mark.slow
def test_ends_of_every_kind_are_those_of_the_slow_definition():
    kinds = play("active_easy", NEAR, steps=800)
    kinds |= play("active_easy", {"steps": 30}, steps=1600)
    success, crash = (True, False, True), (True, False, False)
    timeout = (False, True, False)
    assert kinds >= {success, crash, timeout}


def goals_at(x, y, heading):
    """Return the goals of an agent that stands there with an empty map."""
    scenario = load_scenario("active_medium")
    task = ActiveSlamTask(scenario, RewardWeights())
    means = np.zeros((1, 27))
    means[0, :3] = x, y, heading
    nothing = BatchStorage.of(means, np.zeros((1, 27, 27)), np.full((1, 12), -1))
    task.begin(nothing, np.ones(1, dtype=bool), np.zeros((1, 12), dtype=complex))
    return task.observations()["goals"][0]


@pytest.mark.parametrize("heading", [0.0, np.pi / 2, np.pi, -np.pi / 2])
def test_rounding_does_not_decide_between_cells_that_are_equally_near(heading):
    """From the corner of a cell, the nearest unseen cells lie on both sides."""
    corner = 8 / 21
    first = goals_at(corner, corner, heading)
    assert first[0] == pytest.approx(-(0.5**0.5))  # behind, aside
    for dx, dy in ((1, 1), (-1, 1), (1, -1), (-1, -1)):
        goals = goals_at(corner + 1e-13 * dx, corner + 1e-13 * dy, heading)
        np.testing.assert_allclose(goals, first, atol=1e-9)
