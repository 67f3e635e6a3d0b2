"""Observations as sets of landmarks, against the belief itself."""

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from slamgym.agents import ActiveSlamEnv, ActiveSlamVectorEnv
from slamgym.agents.landmark_set import FEATURES, SCALE

SET = {"observation": "set", "max_landmarks": 9}
AXES = "ahead", "aside"


def expected_rows(env):
    """Compute the rows from the joint covariance, turned into the robot's frame."""
    belief, rows = env.knowledge.belief, {}
    x, y, heading = belief.pose
    R = np.array(
        [[np.cos(heading), -np.sin(heading)], [np.sin(heading), np.cos(heading)]]
    )
    T = np.eye(3)
    T[:2, :2] = R.T
    for k, (i, place) in enumerate(
        zip(belief.landmark_ids, belief.landmarks, strict=True)
    ):
        at = [0, 1, 2, 3 + 2 * k, 4 + 2 * k]
        turn = np.zeros((5, 5))
        turn[:3, :3], turn[3:, 3:] = T, R.T
        P = turn @ belief.covariance[np.ix_(at, at)] @ turn.T
        ahead, aside = rho = R.T @ (place - (x, y))
        H = np.array([[-1, 0, aside, 1, 0], [0, -1, -ahead, 0, 1]])
        S = H @ P @ H.T
        std, own = np.sqrt(np.diag(P)), np.sqrt(np.diag(S))
        corr = P / np.outer(std, std)
        log = lambda s: np.clip(np.log10(np.clip(s, 1e-3, 10) / 1e-3) / 4, 0, 1)  # noqa: E731
        distance = np.hypot(*rho)
        rows[distance] = [
            *rho / (distance + SCALE),
            *log(own),
            S[0, 1] / own.prod(),
            *log(std[3:]),
            corr[3, 4],
            float(env.knowledge.known[i]),
            *corr[3, :3],
            *corr[4, :3],
        ]
    return [rows[distance] for distance in sorted(rows)]


def test_rows_are_the_belief_in_the_frame_of_the_robot():
    env = ActiveSlamEnv("active_medium", observation="set", accuracy=0.1)
    observation, _ = env.reset(seed=3)
    rng = np.random.default_rng(0)
    for _ in range(40):
        rows = expected_rows(env)
        mask = observation["mask"]
        assert mask.tolist() == [True] * len(rows) + [False] * (32 - len(rows))
        np.testing.assert_allclose(observation["landmarks"][mask], rows, atol=1e-9)
        assert not observation["landmarks"][~mask].any()
        observation, _, terminated, *_ = env.step(rng.uniform([0, -0.5], [0.6, 0.5]))
        if terminated:
            break
    assert len(rows) > 4
    pose = [f"{a}_pose_{b}" for a in AXES for b in (*AXES, "heading")]
    names = [f"{of}{axis}" for of in ("", "std_", "map_std_") for axis in AXES]
    own = [*names[:4], "correlation", *names[4:], "map_correlation", "known"]
    assert (*own, *pose) == FEATURES


def test_spaces_are_the_same_whatever_the_number_of_landmarks():
    easy = ActiveSlamEnv("active_easy", observation="set")
    hard = ActiveSlamEnv("active_hard", observation="set")
    assert easy.observation_space == hard.observation_space
    assert easy.observation_space["landmarks"].shape == (32, len(FEATURES))


def test_the_rest_of_the_observation_is_that_of_the_flat_one():
    flat, rows = ActiveSlamEnv("active_easy"), ActiveSlamEnv("active_easy", **SET)
    one, other = flat.reset(seed=0)[0], rows.reset(seed=0)[0]
    assert set(other) - set(one) == {"landmarks", "mask"}
    assert not any(key.startswith("belief_landmark") for key in other)
    for key in set(one) & set(other):
        np.testing.assert_array_equal(one[key], other[key])


def test_fewer_rows_hold_the_nearest_landmarks():
    few, many = (
        ActiveSlamEnv("active_uncertain", observation="set", max_landmarks=rows)
        for rows in (2, 12)
    )
    one, other = few.reset(seed=0)[0], many.reset(seed=0)[0]
    assert other["mask"].sum() > 2
    np.testing.assert_array_equal(one["landmarks"], other["landmarks"][:2])


@pytest.mark.parametrize(
    "form", [SET, {**SET, "dtype": "float32"}, {"dtype": "float32"}]
)
@pytest.mark.parametrize("mode", ["NextStep", "SameStep"])
def test_many_worlds_have_the_bits_of_single_ones(form, mode):
    settings = {"scenario": "active_medium", "steps": 6, **form}
    worlds = ActiveSlamVectorEnv(3, autoreset_mode=mode, **settings)
    envs = [ActiveSlamEnv(**settings) for _ in range(3)]
    batch, _ = worlds.reset(seed=4)
    singles = [env.reset(seed=4 + k)[0] for k, env in enumerate(envs)]
    ended = np.zeros(3, dtype=bool)
    for action in np.random.default_rng(0).uniform(-1, 1, (15, 3, 2)):
        assert batch in worlds.observation_space
        for k, single in enumerate(singles):
            assert list(single) == list(envs[k].observation_space)
            for key, value in single.items():
                assert value.dtype == envs[k].observation_space[key].dtype
                np.testing.assert_array_equal(batch[key][k], value)
        batch, _, terminated, truncated, _ = worlds.step(action)
        for k, env in enumerate(envs):
            over = ended[k] and mode == "NextStep"
            singles[k] = env.reset()[0] if over else env.step(action[k])[0]
            if mode == "SameStep" and (terminated | truncated)[k]:
                singles[k] = env.reset()[0]
        ended = terminated | truncated


@pytest.mark.parametrize("form", [SET, {"dtype": "float32"}])
def test_gymnasiums_checker_takes_the_form(form):
    check_env(
        gym.make("slamgym/ActiveSlam-v0", scenario="active_easy", **form).unwrapped
    )


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"observation": "sets"}, "observation must be one of flat, set, got 'sets'"),
        ({"dtype": "float16"}, "dtype must be one of float64, float32, got 'float16'"),
        ({"max_landmarks": 5}, "max_landmarks must be left out unless"),
        ({**SET, "max_landmarks": 0}, "max_landmarks must be a whole number >= 1"),
        ({**SET, "max_landmarks": True}, "max_landmarks must be a whole number >= 1"),
        ({**SET, "max_landmarks": 2.5}, "max_landmarks must be a whole number >= 1"),
    ],
)
@pytest.mark.parametrize("make", [ActiveSlamEnv, ActiveSlamVectorEnv])
def test_a_form_that_cannot_be_is_refused_by_name(make, settings, message):
    with pytest.raises(ValueError, match=message):
        make(scenario="active_easy", **settings)
