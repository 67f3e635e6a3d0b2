"""The scripts that train: what they write repeats, and their parts do as they say."""

import csv
import runpy
import sys
from pathlib import Path

import numpy as np
import pytest

from slamgym.agents import ActiveSlamEnv
from slamgym.agents.active_slam_scores import run_episode

ROOT = Path(__file__).parents[2]
ONE_FILE = ROOT / "examples" / "12_ppo_in_one_file.py"
LEARNING = ROOT / "benchmarks" / "learning.py"

pytestmark = [
    pytest.mark.slow,
    pytest.mark.filterwarnings("default::DeprecationWarning"),
]


@pytest.fixture(scope="module")
def ppo(torch):
    return runpy.run_path(str(ONE_FILE))


def test_the_file_is_short():
    assert len(ONE_FILE.read_text().splitlines()) <= 200


def test_equal_seeds_learn_the_same_and_other_seeds_do_not(ppo, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    written = []
    for seed in ("3", "3", "4"):
        given = ["--scenario", "active_easy", "--worlds", "16", "--seed", seed]
        monkeypatch.setattr(sys, "argv", ["ppo", "--steps", "2048", *given])
        ppo["main"]()
        folder = tmp_path / "results" / "12_ppo_in_one_file"
        written.append((folder / "curve.csv").read_text())
        assert (folder / "policy.pt").stat().st_size > 10_000
    assert written[0] == written[1] != written[2]
    rows = list(csv.DictReader(written[0].splitlines()))
    assert [row["steps"] for row in rows] == ["1024", "2048"]
    assert all(-30 < float(row["return"]) < 30 for row in rows[1:])


def test_advantages_equal_the_sum_of_discounted_errors(ppo, torch):
    rng = torch.Generator().manual_seed(0)
    rollout = ppo["Rollout"](3, 2, 1)
    rollout.values = torch.randn(rollout.values.shape, generator=rng)
    rollout.rewards = torch.randn(rollout.values.shape, generator=rng)
    rollout.ended = (torch.rand(rollout.values.shape, generator=rng) < 0.1).float()
    last = torch.randn(3, generator=rng)
    gamma, decay, steps = ppo["GAMMA"], ppo["LAMBDA"], ppo["ROLLOUT"]
    values = np.vstack([rollout.values.numpy(), last.numpy()])
    rewards, goes_on = rollout.rewards.numpy(), 1.0 - rollout.ended.numpy()
    expected = np.zeros((steps, 3))
    for world in range(3):
        for start in range(steps):
            weight = 1.0
            for t in range(start, steps):
                bootstrap = gamma * goes_on[t, world] * values[t + 1, world]
                error = rewards[t, world] + bootstrap - values[t, world]
                expected[start, world] += weight * error
                weight *= gamma * decay * goes_on[t, world]
    np.testing.assert_allclose(rollout.advantages(last).numpy(), expected, atol=2e-4)


def test_an_update_makes_rewarded_actions_likelier_and_fits_values(ppo, torch):
    torch.manual_seed(0)
    agent, rollout = ppo["Agent"](4, 2), ppo["Rollout"](32, 4, 2)
    rollout.observations = torch.randn(rollout.observations.shape)
    rollout.ended[:] = 1.0  # every step is an episode: the return is the reward
    with torch.no_grad():
        policy = agent.policy(rollout.observations)
        rollout.actions = policy.sample()
        rollout.log_probs = policy.log_prob(rollout.actions).sum(-1)
        rollout.values = agent.value(rollout.observations)
        rollout.rewards = 3.0 + rollout.actions[..., 0]
        before = agent.actor(rollout.observations).mean((0, 1))
    optimiser = torch.optim.Adam(agent.parameters(), lr=3e-3)
    ppo["update"](agent, optimiser, rollout, torch.zeros(32))
    with torch.no_grad():
        after = agent.actor(rollout.observations).mean((0, 1))
        values = agent.value(rollout.observations).mean()
    assert after[0] - before[0] > 0.1
    assert abs(after[1] - before[1]) < 0.5 * (after[0] - before[0])
    assert values > 1.0


@pytest.fixture(scope="module")
def learning(torch):
    pytest.importorskip("stable_baselines3", reason="needs Stable-Baselines3")
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(LEARNING.parent))
        yield runpy.run_path(str(LEARNING))


def test_training_twice_writes_equal_files_and_a_picture(
    learning, tmp_path, monkeypatch, capsys
):
    few = ["--scenario", "active_easy", "--steps", "1024", "--worlds", "16"]
    few += ["--validation-maps", "1", "--maps", "2", "--seeds", "0", "1"]
    for name in ("first", "again"):
        folder = ["--folder", str(tmp_path / name)]
        figure = ["--figure", str(tmp_path / name / "curves.png")]
        monkeypatch.setattr(sys, "argv", ["learning", *few, *folder, *figure])
        learning["main"]()
    first = {path.name: path.read_bytes() for path in (tmp_path / "first").iterdir()}
    again = {path.name: path.read_bytes() for path in (tmp_path / "again").iterdir()}
    assert first == again
    assert first["evaluations_0.csv"] != first["evaluations_1.csv"]
    assert len(first["held_out.csv"].splitlines()) == 1 + 2 * 2
    assert " ± " in capsys.readouterr().out.splitlines()[-1]


def test_a_saved_policy_acts_as_that_of_the_library(learning, tmp_path):
    example = runpy.run_path(str(ROOT / "examples" / "09_train_active_slam.py"))
    model = example["make_learner"]("active_easy", 16)
    model.save(tmp_path / "policy.zip")
    learning["save_actor"](model, tmp_path / "policy.npz")
    library = example["load_policy"](tmp_path / "policy.zip")
    ours = learning["load_actor"](tmp_path / "policy.npz")
    env = ActiveSlamEnv("active_easy")
    env.reset(seed=0)
    for _ in range(20):
        observation, *_ = env.step(env.action_space.sample())
        np.testing.assert_allclose(
            ours(observation, env), library(observation, env), atol=1e-6
        )


def test_the_committed_policies_repeat_their_scores_on_held_out_maps(learning):
    with (ROOT / "docs" / "learning" / "held_out.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    env = ActiveSlamEnv("active_medium")
    for row in rows[::90]:
        policy = learning["load_actor"](
            ROOT / "docs" / "learning" / f"policy_{row['seed']}.npz"
        )
        episode = run_episode(env, policy, int(row["map"]))
        assert episode.total == pytest.approx(float(row["return"]), abs=2e-3)
        assert episode.honest == bool(float(row["honest_success"]))
