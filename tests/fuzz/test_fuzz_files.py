"""Damaged scenarios, job files and manifests."""

import json
import tomllib

import numpy as np
import pytest
from fuzzing import edited, edits, replaced, strange_values
from hypothesis import strategies as st

from slamgym.envs import LandmarkWorldEnv
from slamgym.experiments.monte_carlo_study import (
    load_results,
    merge_blocks,
    monte_carlo,
)
from slamgym.experiments.trajectories import generate_trajectories, load_trajectories
from slamgym.sim_configs import ScenarioError, list_presets, load_scenario
from slamgym.sim_configs.scenario_files import scenario_text

PRESETS = {name: scenario_text(load_scenario(name)) for name in list_presets()}
LARGE = 3000  # landmarks or steps of worlds that are read, but not driven in
paths = st.lists(st.integers(0, 12), min_size=1, max_size=4)
DEEP = "[" * 100_000


def drive(scenario):
    """Take a few steps in a world of moderate size: all that it says is finite."""
    landmarks = scenario.landmarks
    sizes = [getattr(landmarks, n, 0) for n in ("count", "rows", "columns", "length")]
    if scenario.steps > LARGE or any(s > 40 for s in sizes if isinstance(s, int)):
        return
    env = LandmarkWorldEnv(scenario)
    try:
        observation, _ = env.reset(seed=1)
    except ScenarioError as error:  # as documented, in the first episode at the latest
        assert "must leave room" in str(error)
        return
    env.action_space.seed(1)
    for _ in range(3):
        assert env.observation_space.contains(observation)
        observation, reward, *_ = env.step(env.action_space.sample())
        assert np.isfinite(reward)
        assert np.isfinite(env.pose).all()
    env.close()


def test_changed_scenarios_are_refused_or_can_be_driven(fuzzer):
    trees = {name: tomllib.loads(text) for name, text in PRESETS.items()}

    def load(name, path, value):
        try:
            scenario = load_scenario(replaced(trees[name], path, value))
        except ValueError as error:
            assert str(error)
            return
        assert load_scenario(tomllib.loads(scenario_text(scenario))) == scenario
        drive(scenario)

    fuzzer.check(
        load,
        st.sampled_from(sorted(PRESETS)),
        paths,
        strange_values(),
        few=30,
        saved=[("active_easy", [9, 3], 1e12)],  # darts that find no room
    )


def test_damaged_scenario_files_are_refused_or_read(fuzzer, tmp_path):
    path = tmp_path / "world.toml"

    def load(text, changes):
        path.write_text(edited(text, changes), encoding="utf-8")
        try:
            load_scenario(path)
        except (ValueError, OSError) as error:
            assert str(error)

    texts = st.sampled_from(sorted(PRESETS.values()))
    saved = [("x = " + DEEP, []), ("a." * 50_000 + "b = 1", [])]
    fuzzer.check(load, texts, edits, few=40, saved=saved)


def check_damaged(fuzzer, file, use, few):
    """Use a JSON file after edits of its text, or with other values in its tree."""
    text = file.read_text()
    tree = json.loads(text)

    def damage(changes, path, value, by_text):
        changed = edited(text, changes)
        if not by_text:
            changed = json.dumps(replaced(tree, path, value))
        file.write_text(changed, encoding="utf-8")
        use()

    deep = [("line", 0, 0, DEEP), ("drop line", 0, 0, "")]
    saved = [(deep, [0], 0, True)]
    some = (edits, paths, strange_values(), st.booleans())
    fuzzer.check(damage, *some, few=few, saved=saved)


def test_damaged_jobs_are_refused_or_go_on(fuzzer, tmp_path):
    folder = tmp_path / "job"
    monte_carlo("six_landmarks", "ekf", 2, block_size=1, out=folder).close()

    def use():
        for call in (
            lambda: monte_carlo("six_landmarks", "ekf", 2, block_size=1, out=folder),
            lambda: load_results(folder),
            lambda: merge_blocks([folder], folder / "merged"),
        ):
            try:
                result = call()
            except (ValueError, OSError) as error:
                assert str(error)
            else:
                if hasattr(result, "close"):
                    result.close()

    check_damaged(fuzzer, folder / "job.json", use, few=6)


@pytest.mark.filterwarnings("ignore:.*is not finished")
def test_damaged_manifests_are_refused_or_read(fuzzer, tmp_path):
    folder = tmp_path / "data"
    world = load_scenario("six_landmarks").with_changes(steps=4)
    generate_trajectories(world, folder, episodes=2, episodes_per_shard=1)

    def use():
        try:
            for trajectory in load_trajectories(folder):
                assert trajectory.scenario.steps
        except (ValueError, OSError) as error:
            assert str(error)

    check_damaged(fuzzer, folder / "manifest.json", use, few=25)
