"""The adapter to Stable-Baselines3, held against its own DummyVecEnv."""

import importlib
import re
import sys
from functools import partial
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
from comparison import same
from gymnasium.vector import AutoresetMode
from gymnasium.wrappers.vector import RecordEpisodeStatistics

import slamgym  # noqa: F401 (registers the environments)
from slamgym.envs.vector import FlattenBatch, to_stable_baselines

ID = "slamgym/LandmarkWorld-v0"
SEED = 4
LOST = {"scenario": "hidden_identities", "steps": 30}

pytestmark = pytest.mark.filterwarnings("default::DeprecationWarning")


def native(count=3, mode=AutoresetMode.SAME_STEP, **changes):
    return gym.make_vec(ID, count, autoreset_mode=mode, **changes)


def test_without_stable_baselines_the_error_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "stable_baselines3.common.vec_env", None)
    module = importlib.import_module("slamgym.envs.vector.wrappers")
    module._adapter_class.cache_clear()
    with pytest.raises(ImportError, match="pip install stable-baselines3"):
        to_stable_baselines(native())


def test_another_autoreset_mode_is_refused():
    with pytest.raises(ValueError, match=r"SAME_STEP, got .*NEXT_STEP"):
        to_stable_baselines(native(mode=AutoresetMode.NEXT_STEP))


def dummy(count=3, **changes):
    from stable_baselines3.common.vec_env import DummyVecEnv

    make = partial(gym.make, ID, disable_env_checker=True, **changes)
    return DummyVecEnv([make] * count)


@pytest.mark.slow
@pytest.mark.parametrize("changes", [{}, LOST], ids=["plain", "lost"])
def test_it_steps_as_a_dummy_of_single_worlds_does(changes, sb3):
    """Observations, rewards, dones and every info, across the ends of episodes."""
    vectors = [to_stable_baselines(native(**changes)), dummy(**changes)]
    assert vectors[0].observation_space == vectors[1].observation_space
    assert vectors[0].action_space == vectors[1].action_space
    for vector in vectors:
        vector.seed(SEED)
    same(*(dict(vector.reset()) for vector in vectors))
    rng, ends = np.random.default_rng(0), 0
    for _ in range(100):
        actions = rng.uniform(-1, 1, (3, 2)).astype(np.float32)
        results = [vector.step(actions) for vector in vectors]
        observations, rewards, dones, infos = zip(*results, strict=True)
        same(*map(dict, observations))
        same(*rewards)
        same(*dones)
        same(*([dict(sorted(info.items())) for info in each] for each in infos))
        same(vectors[0].reset_infos, vectors[1].reset_infos)
        ends += dones[0].sum()
    assert ends == 9
    same(*(dict(vector.reset()) for vector in vectors))


def test_options_are_those_of_one_reset(sb3):
    mode = {"vector_kwargs": {"autoreset_mode": AutoresetMode.SAME_STEP}}
    certain = {"start": {"std": [0.0] * 3}}
    worlds = gym.make_vec(ID, 2, vectorization_mode="sync", **mode, **certain)
    vector = to_stable_baselines(worlds)
    vector.set_options({"pose": (1.0, 2.0, 0.5)})
    for pose in ([1.0, 2.0, 0.5], [0.0] * 3):
        vector.reset()
        assert vector.reset_infos[1]["pose"].tolist() == pose


@pytest.mark.slow
def test_an_info_that_some_worlds_lack_is_missing_there(sb3):
    vector = RecordEpisodeStatistics(native(max_episode_steps=5))
    adapted = to_stable_baselines(vector)
    adapted.reset()
    for step in range(5):
        *_, infos = adapted.step(np.zeros((3, 2)))
        assert all(("episode" in info) == (step == 4) for info in infos)
    assert infos[1]["episode"]["l"] == 5


@pytest.mark.slow
def test_attributes_and_methods_are_handed_out_world_by_world(sb3):
    worlds = native(3, render_mode="rgb_array")
    vector = to_stable_baselines(worlds)
    vector.reset()
    assert vector.get_attr("render_mode") == ["rgb_array"] * 3
    assert vector.get_attr("scenario", indices=[1]) == [worlds.scenario]
    np.testing.assert_array_equal(vector.get_attr("poses", 2), worlds.poses[2:])
    assert not vector.has_attr("nothing_like_this")
    assert [frame.shape[2] for frame in vector.env_method("render")] == [3, 3, 3]
    assert vector.render().shape[2] == 3
    vector.set_attr("note", 7)
    assert vector.get_attr("note") == [7, 7, 7]
    with pytest.raises(ValueError, match="indices must be all worlds"):
        vector.set_attr("note", 8, indices=[0])
    assert vector.env_is_wrapped(FlattenBatch) == [False] * 3
    flat = to_stable_baselines(FlattenBatch(native()))
    assert flat.env_is_wrapped(FlattenBatch, indices=0) == [True]
    vector.close()
    assert worlds.closed


@pytest.mark.slow
def test_ppo_learns_on_observations_of_several_parts(sb3):
    worlds = to_stable_baselines(native(8, steps=16))
    monitored = sb3.common.vec_env.VecMonitor(worlds)
    policy = "MultiInputPolicy"
    model = sb3.PPO(policy, monitored, n_steps=16, batch_size=64, n_epochs=1, seed=0)
    model.learn(256)
    assert model.num_timesteps == 256
    assert [episode["l"] for episode in model.ep_info_buffer] == [16] * 16
    lengths = sb3.common.evaluation.evaluate_policy(
        model, monitored, n_eval_episodes=4, return_episode_rewards=True
    )[1]
    assert lengths == [16] * 4


DOCUMENT = Path(__file__).parents[2] / "docs" / "reinforcement_learning.md"


def blocks(heading):
    """Return (language, code) of the blocks below a heading of the document."""
    section = DOCUMENT.read_text().split(f"# {heading}\n")[1].split("\n#")[0]
    return re.findall(r"^```(\w+)\n(.*?)^```$", section, re.M | re.S)


@pytest.mark.slow
def test_the_document_leads_from_make_vec_to_a_policy(sb3):
    """The block that needs Stable-Baselines3 is run here, in the place of readers."""
    scope = {"__name__": "reader"}
    languages = []
    for language, code in blocks("Reinforcement learning"):
        languages.append(language)
        if language != "text":  # two updates do here
            exec(compile(code.replace("60_000", "8192"), "document", "exec"), scope)
    assert languages == ["python", "text", "py"]
    assert scope["model"].num_timesteps == 8192
    env = gym.make(scope["name"], scenario="active_easy")
    observation, _ = env.reset(seed=0)
    assert env.action_space.contains(scope["trained"](observation, env))


@pytest.mark.slow
def test_the_tutorial_on_ppo_compares_a_policy_with_a_baseline(sb3, capsys):
    code = DOCUMENT.with_name("tutorials").joinpath("train_8_ppo.py").read_text()
    code = code.replace("500_000", "8192").replace("VALIDATION + 20", "VALIDATION + 2")
    exec(compile(code, "tutorial", "exec"), {"__name__": "reader"})
    table = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in table] == ["return", "trained", "coverage"]


def randomised():
    """Return the two blocks on randomisation: draws per episode, draws per round."""
    found = blocks("Domain randomisation")
    return [code for language, code in found if language == "python"]


@pytest.mark.slow
def test_a_policy_goes_on_in_worlds_drawn_anew_per_round(sb3):
    """The document's lines, also those that stand in comments there."""
    code = randomised()[-1].replace("# model.", "model.").replace("64 * 512", "1024")
    easy = gym.make_vec(
        "slamgym/ActiveSlam-v0", 64, scenario="active_easy", autoreset_mode="SameStep"
    )
    worlds = to_stable_baselines(FlattenBatch(easy))
    model = sb3.PPO("MlpPolicy", worlds, n_steps=16, batch_size=256, n_epochs=1)
    known = {"to_stable_baselines": to_stable_baselines, "FlattenBatch": FlattenBatch}
    scope = {"__name__": "reader", "model": model, **known}
    exec(compile(code, "document", "exec"), scope)
    assert model.num_timesteps == 3 * 1024
    assert model.get_env().worlds.env is scope["worlds"]


@pytest.mark.slow
def test_worlds_that_are_drawn_anew_per_episode_repeat_under_their_seed(sb3):
    scope = {"__name__": "reader"}
    exec(compile(randomised()[0], "document", "exec"), scope)
    drives, noises = [], set()
    for seed in (3, 3):
        worlds = scope["worlds"]
        vector = to_stable_baselines(FlattenBatch(worlds))
        vector.seed(seed)
        seen, ends = [vector.reset()], 0
        for _ in range(40):
            ahead = np.tile(np.float32([1, 0]), (4, 1))  # into the wall, soon
            observations, _, dones, _ = vector.step(ahead)
            seen.append(observations)
            ends += dones.sum()
            drawn = worlds.unwrapped.drawn_scenarios
            noises |= {scenario.motion.std for scenario in drawn}
        drives.append(seen)
    assert ends > 4
    assert len(noises) == ends + 4
    np.testing.assert_array_equal(*drives)
