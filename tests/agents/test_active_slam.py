"""The benchmark task: its rules, its twin of many worlds, its baselines."""

import math
import re
import runpy
from itertools import pairwise
from pathlib import Path

import gymnasium as gym
import numpy as np
import numpy_active_slam as twin
import pytest
from far_origins import far_origins, moved_world, rounding
from gymnasium.envs.registration import EnvSpec
from worlds import RANGED

import slamgym  # noqa: F401 (registers the environments)
from slamgym.agents import (
    ActiveSlamEnv,
    ActiveSlamVectorEnv,
    BeliefObservation,
    BeliefObservationVector,
)
from slamgym.agents.active_slam_baselines import (
    BASELINES,
    coverage_lanes,
    make_baseline,
)
from slamgym.agents.active_slam_scores import (
    VALIDATION,
    Episode,
    baseline_policy,
    mean_of,
    run_episode,
    run_episodes,
    score_table,
)
from slamgym.agents.belief_features import belief_storage
from slamgym.agents.belief_space_planner import GREEDY, MPC, BeliefSpacePlanner
from slamgym.agents.information_reward import effort, map_covariances
from slamgym.agents.wall_routes import SECTORS, CoverageGrid
from slamgym.envs import LandmarkWorldEnv
from slamgym.estimator import Belief, EkfSlam, list_estimators
from slamgym.sim_configs import drawn_scenario, load_scenario

ID = "slamgym/ActiveSlam-v0"
LEVELS = ["active_easy", "active_medium", "active_hard"]
LIMITS = np.array([1.0, 1.0])
PLANNERS = ("coverage", "frontier", "revisit", "greedy", "mpc")
RING = {"layout": "ring", "count": 5, "radius": 3.0}


def wander(env, steps, seed=0):
    rng = np.random.default_rng(seed)
    observation, info = env.reset(seed=seed)
    yield observation, 0.0, False, False, info
    for _ in range(steps):
        step = env.step(rng.uniform(-LIMITS, LIMITS))
        yield step
        if step[2] or step[3]:
            return


@pytest.mark.parametrize("level", LEVELS)
def test_every_observation_lies_in_its_space_and_has_its_order(level):
    env = ActiveSlamEnv(level)
    for observation, *_ in wander(env, 120, seed=1):
        assert observation in env.observation_space
        assert list(observation) == list(env.observation_space)


def test_info_has_the_same_keys_and_types_in_reset_and_step():
    infos = [step[4] for step in wander(ActiveSlamEnv("active_easy"), 5)]
    forms = [{k: (type(v), np.shape(v)) for k, v in info.items()} for info in infos]
    assert all(form == forms[0] for form in forms)
    told = ["mapped", "known", "success", "true_rmse", "honest_success"]
    assert list(infos[0]) == ["pose", "collision", *told]


def test_the_world_is_the_landmark_world_of_the_same_seed():
    env, world = ActiveSlamEnv("active_medium"), LandmarkWorldEnv("active_medium")
    for seed in (5, None):
        _, info = env.reset(seed=seed)
        np.testing.assert_array_equal(world.reset(seed=seed)[1]["pose"], info["pose"])
        np.testing.assert_array_equal(env.landmarks, world.landmarks)
        for _ in range(10):
            pose = env.step([0.5, 0.3])[4]["pose"]
            np.testing.assert_array_equal(world.step([0.5, 0.3])[4]["pose"], pose)


def test_every_episode_has_another_map():
    env = ActiveSlamEnv("active_easy")
    env.reset(seed=0)
    first = env.landmarks
    env.reset()
    assert (env.landmarks != first).all()


@pytest.mark.parametrize("criterion", ["D", "A", "E"])
def test_rewards_are_what_the_docstring_says(criterion):
    stakes = {"step_cost": 0.1, "effort_cost": 0.3, "crash_cost": 7.0}
    if criterion == "E":  # the landmark is first seen in the second step
        stakes |= {"landmarks": RING | {"count": 1}, "sensor": {"max_range": 1.0}}
    env = ActiveSlamEnv("active_easy", criterion=criterion, accuracy=1e-3, **stakes)
    prior = np.full(2, 12 / math.sqrt(12))

    def measure():
        joint = map_covariances(beliefs(env), prior)[0]
        if criterion == "D":
            return 0.5 * np.linalg.slogdet(joint)[1] / 6
        values = np.linalg.eigvalsh(joint)
        return values.sum() / 6 if criterion == "A" else values[-1]

    env.reset(seed=0)
    before, rewards = measure(), []
    for turn in (0.0, 1.0, *[0.0] * 10):
        action = [1.0, turn]
        _, reward, terminated, _, info = env.step(action)
        expected = before - measure() - 0.1 - 0.3 * effort(action, LIMITS).item()
        before = measure()
        assert reward == pytest.approx(expected - 7.0 * info["collision"])
        assert terminated == info["collision"]
        rewards.append(reward)
        if terminated:
            break
    assert terminated
    if criterion != "E":
        assert len(set(rewards)) == len(rewards)


def beliefs(env):
    count = env.scenario.landmarks.count
    return belief_storage(env.knowledge.belief, count, by_id=True).beliefs()


def test_touching_a_wall_ends_the_episode():
    env = ActiveSlamEnv("active_easy")
    env.reset(seed=0)
    steps = [env.step([1.0, 0.0]) for _ in range(6)]
    assert [step[2] for step in steps] == [False] * 5 + [True]
    assert steps[-1][4]["collision"]
    assert not steps[-1][4]["success"]


@pytest.mark.parametrize("steps", [5, 6, 7])
def test_an_episode_that_ends_by_a_crash_is_not_truncated(steps):
    env = ActiveSlamEnv("active_easy", steps=steps)
    many = ActiveSlamVectorEnv(2, "active_easy", steps=steps)
    env.reset(seed=0)
    many.reset(seed=[0, 0])
    for _ in range(min(steps, 6)):  # the robot touches the wall in step 6
        _, _, *ends, _ = env.step([1.0, 0.0])
        _, _, *of_many, _ = many.step([(1.0, 0.0)] * 2)
    assert ends == [steps > 5, steps == 5]
    assert [each.tolist() for each in of_many] == [[end, end] for end in ends]


def test_knowing_every_landmark_ends_the_episode_with_a_reward():
    ring = {"layout": "ring", "count": 5, "radius": 2.0}
    env = ActiveSlamEnv("active_easy", landmarks=ring, accuracy=0.08)
    env.reset(seed=0)
    terminated, steps = False, 0
    while not terminated:
        before = env.task.episodes.uncertainty.item()
        knowledge = env.knowledge
        _, reward, terminated, truncated, info = env.step([0.0, 0.0])
        steps += 1
        assert not knowledge.known.all()  # as it was before the step
    spreads = env.knowledge.belief.landmark_covariances
    assert np.sqrt(np.linalg.eigvalsh(spreads)[:, -1]).max() <= 0.08
    assert info["success"]
    assert not truncated
    assert info["known"] == 5
    gain = before - env.task.episodes.uncertainty.item()
    left = 1 - steps / env.scenario.steps
    assert reward == pytest.approx(gain - 0.02 + 5 * (1 + left))
    assert not env.reset()[1]["success"]


def test_time_is_up_after_the_steps_of_the_scenario():
    env = ActiveSlamEnv("active_easy", steps=7)
    env.reset(seed=0)
    ends = [env.step([0.0, 0.1])[2:4] for _ in range(7)]
    assert ends == [(False, False)] * 6 + [(False, True)]


def test_the_agent_does_not_see_the_truth(monkeypatch):
    """The same readings with another truth make the same observations."""
    honest = list(wander(ActiveSlamEnv("active_medium"), 40))
    step, reset = LandmarkWorldEnv.step, LandmarkWorldEnv.reset

    def hide(answer):
        *rest, info = answer
        return (*rest, {**info, "pose": np.full(3, 1e6)})

    monkeypatch.setattr(LandmarkWorldEnv, "step", lambda *a: hide(step(*a)))
    monkeypatch.setattr(LandmarkWorldEnv, "reset", lambda *a, **k: hide(reset(*a, **k)))
    for name in ("landmarks", "pose"):
        monkeypatch.setattr(LandmarkWorldEnv, name, property(lambda _: 1 / 0))
    deceived = wander(ActiveSlamEnv("active_medium"), 40)
    for seen, blind in zip(honest, deceived, strict=True):
        assert seen[1:4] == blind[1:4]
        for key in seen[0]:
            np.testing.assert_array_equal(seen[0][key], blind[0][key])


def test_settings_survive_a_spec_written_as_json():
    env = gym.make(ID, scenario="active_easy", accuracy=0.5, estimator="ekf", steps=9)
    rebuilt = gym.make(EnvSpec.from_json(env.spec.to_json()))
    assert rebuilt.unwrapped.task.weights == env.unwrapped.task.weights
    assert rebuilt.unwrapped.scenario == env.unwrapped.scenario
    rebuilt.reset(seed=0)
    assert type(rebuilt.unwrapped.knowledge.estimator) is EkfSlam


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"scenario": "loop"}, "scenario must have walls around its floor"),
        ({"accuracy": 0.0}, "accuracy must be a finite number > 0"),
        ({"crash_cost": -5}, "crash_cost must be a finite number >= 0, got -5"),
        ({"success_reward": math.nan}, "success_reward must be a finite number >= 0"),
        ({"step_cost": math.inf}, "step_cost must be a finite number >= 0, got inf"),
        ({"effort_cost": "x"}, "effort_cost must be a finite number >= 0, got 'x'"),
        ({"criterion": "B"}, "criterion must be one of D, A, E, got 'B'"),
        ({"stesp": 3}, "unknown key 'stesp' of the task; did you mean 'steps'"),
        ({"succes_reward": 3}, "of the task; did you mean 'success_reward'"),
        ({"estimator": "efk"}, "unknown estimator 'efk'; did you mean 'ekf'"),
    ],
)
@pytest.mark.parametrize("make", [ActiveSlamEnv, ActiveSlamVectorEnv])
def test_wrong_settings_are_refused_by_name(make, settings, message):
    with pytest.raises(ValueError, match=message):
        make(**settings)


@pytest.mark.parametrize("action", [[np.nan, 0.0], [1.0], "go"])
def test_a_wrong_action_is_refused_and_changes_nothing(action):
    env, other = ActiveSlamEnv("active_easy"), ActiveSlamEnv("active_easy")
    env.reset(seed=0)
    other.reset(seed=0)
    with pytest.raises(ValueError, match="action must be 2 finite numbers"):
        env.step(action)
    assert env.step([0.5, 0.5])[1] == other.step([0.5, 0.5])[1]


def test_to_step_or_to_look_before_reset_is_refused():
    with pytest.raises(gym.error.ResetNeeded):
        ActiveSlamEnv().step([0.0, 0.0])
    with pytest.raises(gym.error.ResetNeeded):
        _ = ActiveSlamEnv().knowledge
    with pytest.raises(gym.error.ResetNeeded):
        ActiveSlamVectorEnv(2).step(np.zeros((2, 2)))


def test_frames_show_world_and_belief():
    env = gym.make(ID, scenario="active_easy", render_mode="rgb_array")
    env.reset(seed=0)
    env.step([0.5, 0.0])
    shown = env.render()
    env.unwrapped.show_belief(None)
    assert (shown != env.render()).any()
    env.close()


# what an estimator may say


PARTS = ("pose", "pose_covariance", "landmarks", "covariance")


class Slip(EkfSlam):
    """Tells the truth for two steps, then writes one number into its belief."""

    part, place, number = "covariance", (0, 0), 0.0

    def reset(self, pose, pose_std):
        super().reset(pose, pose_std)
        self.told = 0

    def belief(self):
        honest = super().belief()
        parts = {name: np.array(getattr(honest, name)) for name in PARTS}
        if self.told == 2:
            parts[self.part][self.place] = self.number
        self.told += 1
        return type("Said", (), {"landmark_ids": honest.landmark_ids, **parts})()


def observed(estimator):
    return BeliefObservation(
        gym.make("slamgym/LandmarkWorld-v0", scenario="active_easy"), estimator
    )


def slips(make, part, place, number):
    """Drive on the belief of an estimator that slips at step 2."""
    written = {"part": part, "place": place, "number": number}
    env = make(type("Careless", (Slip,), written))
    env.reset(seed=0)
    env.step([0.2, 0.1])
    env.reset()  # steps are counted anew
    for _ in range(3):
        env.step([0.2, 0.1])


@pytest.mark.parametrize(
    "make", [observed, lambda e: ActiveSlamEnv("active_easy", estimator=e)]
)
@pytest.mark.parametrize(
    ("part", "place", "number", "said"),
    [
        ("pose_covariance", (2, 2), -0.5, "have variances >= 0"),
        ("covariance", (1, 1), -2e-9, "have variances >= 0"),
        ("covariance", (4, 4), -1.0, "have variances >= 0"),
        ("pose_covariance", (0, 1), np.nan, "be finite"),
        ("covariance", (3, 0), np.inf, "be finite"),
        ("pose", (2,), np.nan, "be finite"),
        ("landmarks", (0, 1), -np.inf, "be finite"),
    ],
)
def test_a_belief_that_cannot_be_is_refused_with_its_number_and_the_step(
    make, part, place, number, said
):
    where = f"{part}{list(place)} = {number}"
    message = f"Careless.belief() must {said}, got {where} at step 2"
    with pytest.raises(ValueError, match=re.escape(message)):
        slips(make, part, place, number)


def test_a_variance_may_be_negative_by_rounding():
    slips(observed, "covariance", (4, 4), -1e-12)


@pytest.mark.parametrize(
    ("part", "shape"),
    [("pose", (2,)), ("pose_covariance", (2, 2)), ("landmarks", (99, 2))],
)
def test_a_part_of_a_belief_of_another_shape_is_named(part, shape):
    class Short(EkfSlam):
        def belief(self):
            said = super().belief()
            parts = {name: getattr(said, name) for name in PARTS}
            parts[part] = np.zeros(shape)
            return type("Said", (), {"landmark_ids": said.landmark_ids, **parts})()

    message = rf"Short\.belief\(\) must have .*{part} of shape .*got .* at step 0"
    with pytest.raises(TypeError, match=message):
        observed(Short).reset(seed=0)


@pytest.mark.parametrize("rows", ["20", 0, -3, 2.5, 25.0, True, [1], np.nan])
@pytest.mark.parametrize("scenario", ["loop", "hidden_identities"])
def test_odd_numbers_of_rows_are_refused_by_name(scenario, rows):
    world = gym.make("slamgym/LandmarkWorld-v0", scenario=scenario)
    message = rf"max_landmarks must be a whole number >= 1, got {re.escape(repr(rows))}"
    with pytest.raises(ValueError, match=message):
        BeliefObservation(world, "ekf", max_landmarks=rows)
    if scenario == "loop":
        worlds = gym.make_vec("slamgym/LandmarkWorld-v0", 2, scenario=scenario)
        with pytest.raises(ValueError, match=message):
            BeliefObservationVector(worlds, "ekf", max_landmarks=rows)


@pytest.mark.parametrize("rows", [25, np.int64(25)])
def test_rows_may_be_any_integer(rows):
    env = BeliefObservation(
        gym.make("slamgym/LandmarkWorld-v0", scenario="loop"), "ekf", max_landmarks=rows
    )
    assert env.observation_space["belief_mask"].shape == (25,)


def test_landmarks_are_told_ahead_and_aside_one_after_the_other_in_diagonals():
    env = ActiveSlamEnv("active_medium")
    for observation, *_ in wander(env, 40, seed=3):
        belief, told = env.knowledge.belief, observation["belief_landmarks"]
        count = env.scenario.landmarks.count
        assert told.shape == (2 * count,)
        x, y, heading = belief.pose
        for k in range(count):
            ahead, aside = told[2 * k : 2 * k + 2] * 16 * 2**0.5
            if k not in belief.landmark_ids:
                assert (ahead, aside) == (0, 0)
                continue
            lx, ly = belief.landmarks[belief.landmark_ids.index(k)]
            turned = np.exp(-1j * heading) * complex(lx - x, ly - y)  # left is +i
            assert complex(ahead, aside) == pytest.approx(turned, abs=1e-9)
    assert len(belief.landmark_ids) > 3


# many worlds


BOTH = pytest.mark.parametrize("name", [ID, "slamgym/LandmarkWorld-v0"])


@BOTH
@pytest.mark.parametrize("count", [0, -1, True, 2.0, "2", None])
def test_odd_numbers_of_worlds_are_refused_by_name(name, count):
    message = rf"num_envs must be an? \w+ ?\w* >= 1, got {count!r}"
    with pytest.raises(ValueError, match=message):
        gym.make_vec(name, count)


@pytest.mark.parametrize("most", [0, -3, 2.5, True, "x"])
def test_odd_time_limits_are_refused_by_name(most):
    with pytest.raises(ValueError, match="max_episode_steps must be a whole number"):
        ActiveSlamVectorEnv(2, "active_easy", max_episode_steps=most)


@pytest.mark.parametrize(("steps", "most"), [(3, None), (3, -1), (3, 9), (9, 3)])
def test_the_lower_time_limit_holds_in_many_worlds(steps, most):
    settings = {"scenario": "active_easy", "steps": steps, "max_episode_steps": most}
    vector = gym.make_vec(ID, 2, **settings)
    vector.reset(seed=0)
    cut = [vector.step(np.zeros((2, 2)))[3].tolist() for _ in range(3)]
    assert cut == [[False, False], [False, False], [True, True]]


def test_the_estimators_that_run_side_by_side_are_those_of_the_documents():
    page = (Path(__file__).parents[2] / "docs" / "filters.md").read_text()
    sentence = page.split("## Batches")[1].split("and registered")[0]
    able = set(re.findall(r"`(\w+)`", sentence))
    assert able
    for name in able:
        ActiveSlamVectorEnv(2, "active_easy", estimator=name)
    for name in set(list_estimators()) - able:
        with pytest.raises(ValueError, match="cannot run in batches"):
            ActiveSlamVectorEnv(2, "active_easy", estimator=name)


def test_worlds_drawn_from_ranges_observe_in_one_space():
    ranges = {"motion_std": [0.5, 2.0], "max_range": [3.0, 4.5]}
    ranges |= {"start_x": [-2.0, 2.0], "map_scale": [0.8, 1.1]}
    family = load_scenario("active_easy").with_changes(randomise=ranges)
    rng = np.random.default_rng(0)
    draws = [drawn_scenario(family, rng) for _ in range(3)]
    spaces = [ActiveSlamEnv(drawn).observation_space for drawn in draws]
    assert spaces[0] == spaces[1] == spaces[2]
    assert len({drawn.motion.std for drawn in draws}) == 3


def compare(batch, infos, world, observation, info):
    for key, rows in batch.items():
        np.testing.assert_array_equal(rows[world], observation[key])
    for key, value in info.items():
        np.testing.assert_array_equal(infos[key][world], value)


@pytest.mark.slow
@pytest.mark.parametrize("mode", ["NextStep", "SameStep", "Disabled"])
@pytest.mark.parametrize(
    ("level", "settings"),
    [
        ("active_easy", {"accuracy": 0.09, "landmarks": RING}),  # some succeed
        ("active_medium", {"steps": 25, "estimator": "ekf"}),
        ("active_hard", {"steps": 30, "criterion": "E", "sensor": {"dropout": 0.1}}),
    ],
)
def test_many_worlds_are_the_single_ones(mode, level, settings):
    count, kinds = 4, set()
    vector = gym.make_vec(ID, count, scenario=level, autoreset_mode=mode, **settings)
    envs = [ActiveSlamEnv(level, **settings) for _ in range(count)]
    batch, infos = vector.reset(seed=7)
    for k, env in enumerate(envs):
        compare(batch, infos, k, *env.reset(seed=7 + k))
    ended = np.zeros(count, dtype=bool)
    for action in np.random.default_rng(0).uniform(-LIMITS, LIMITS, (90, count, 2)):
        if mode == "Disabled" and ended.any():
            batch, infos = vector.reset(options={"reset_mask": ended})
            for k in np.flatnonzero(ended):
                compare(batch, infos, k, *envs[k].reset())
        batch, rewards, terminated, truncated, infos = vector.step(action)
        assert batch in vector.observation_space
        for k, env in enumerate(envs):
            if mode == "NextStep" and ended[k]:
                compare(batch, infos, k, *env.reset())
                outcome = 0.0, False, False
            else:
                observation, *outcome, info = env.step(action[k])
                kinds.add((info["success"], info["collision"], outcome[2]))
                if mode == "SameStep" and (outcome[1] or outcome[2]):
                    last = {key: {k: v} for key, v in infos["final_obs"][k].items()}
                    compare(last, infos["final_info"], k, observation, info)
                    observation, info = env.reset()
                compare(batch, infos, k, observation, info)
            assert (rewards[k], terminated[k], truncated[k]) == tuple(outcome)
        ended = terminated | truncated
    assert (level != "active_easy") or (True, False, False) in kinds
    assert len(kinds) >= 2


@pytest.mark.parametrize("mode", ["NextStep", "SameStep"])
def test_many_worlds_drawn_anew_are_the_single_ones(mode):
    scenario = load_scenario("active_easy").with_changes(randomise=RANGED, steps=9)
    many = ActiveSlamVectorEnv(3, scenario, autoreset_mode=mode)
    singles = [ActiveSlamEnv(scenario) for _ in range(3)]
    observations, _ = many.reset(seed=7)
    seen = [env.reset(seed=7 + k)[0] for k, env in enumerate(singles)]
    ended = np.zeros(3, dtype=bool)
    rng, draws = np.random.default_rng(0), set()
    for _ in range(40):
        for k in range(3):
            for key, value in seen[k].items():
                np.testing.assert_array_equal(observations[key][k], value)
        drawn = many.drawn_scenarios
        assert [env.drawn_scenario for env in singles] == drawn
        draws |= {each.motion.std for each in drawn}
        actions = rng.uniform(-0.3, 0.8, (3, 2))
        observations, _, terminated, truncated, _ = many.step(actions)
        for k, env in enumerate(singles):
            if mode == "NextStep" and ended[k]:
                seen[k] = env.reset()[0]
                continue
            seen[k], _, over, late, _ = env.step(actions[k])
            assert (over, late) == (terminated[k], truncated[k])
            if mode == "SameStep" and (over or late):
                seen[k] = env.reset()[0]
        ended = terminated | truncated
    assert len(draws) >= 9


def test_filters_keep_the_nominal_noise():
    env = ActiveSlamEnv(
        "active_easy", randomise={"motion_std": [50.0, 50.0], "start_std": [9.0, 9.0]}
    )
    plain = ActiveSlamEnv("active_easy")
    for each in (env, plain):
        each.reset(seed=1)
        each.step([1.0, 0.0])
    uncertain = [each.knowledge.belief.pose_covariance for each in (env, plain)]
    np.testing.assert_allclose(np.sqrt(uncertain[0][0, 0] / uncertain[1][0, 0]), 1, 0.5)


def test_worlds_that_ended_must_be_begun_anew_by_hand_where_autoreset_is_off():
    vector = ActiveSlamVectorEnv(2, "active_easy", steps=2, autoreset_mode="Disabled")
    vector.reset(seed=0)
    vector.step(np.zeros((2, 2)))
    vector.step(np.zeros((2, 2)))
    with pytest.raises(gym.error.ResetNeeded, match=r"worlds \[0, 1\] have ended"):
        vector.step(np.zeros((2, 2)))


def test_frames_of_many_worlds_show_their_beliefs():
    vector = ActiveSlamVectorEnv(2, "active_easy", render_mode="rgb_array")
    vector.reset(seed=0)
    vector.step(np.array([[0.5, 0.0], [0.0, 0.3]]))
    shown = vector.render()
    vector.show_beliefs([None, None])
    for frame, bare in zip(shown, vector.render(), strict=True):
        assert (frame != bare).any()
    vector.close()


def test_the_seeds_of_many_worlds_are_told():
    vector = ActiveSlamVectorEnv(3, "active_easy")
    vector.reset(seed=5)
    assert vector.np_random_seed == (5, 6, 7)


@BOTH
def test_the_specification_has_the_length_of_the_episodes(name):
    env = gym.make(name, steps=7)
    assert env.spec.max_episode_steps == 7
    assert gym.make(name, max_episode_steps=3).spec.max_episode_steps == 3
    aware = gym.wrappers.TimeAwareObservation(env)
    assert aware.reset(seed=0)[0] in aware.observation_space
    with pytest.raises(TypeError, match="unexpected keyword argument 'frameskip'"):
        gym.make(name, frameskip=2)


@pytest.mark.slow
@pytest.mark.parametrize("name", [ID, "slamgym/LandmarkWorld-v0"])
@pytest.mark.filterwarnings("ignore")
def test_torchrl_makes_and_collects(name):
    envs = pytest.importorskip("torchrl.envs", reason="needs TorchRL")
    collectors = pytest.importorskip("torchrl.collectors")
    envs.check_env_specs(envs.GymEnv(name))
    collect = getattr(collectors, "Collector", None) or collectors.SyncDataCollector
    sizes = {"frames_per_batch": 20, "total_frames": 40}
    collected = collect(lambda: envs.GymEnv(name), None, **sizes)
    assert [batch.numel() for batch in collected] == [20, 20]
    collected.shutdown()


# the floor


@pytest.fixture(scope="module")
def grid():
    return CoverageGrid(load_scenario("active_medium"))


POSES = np.array([[0.1, 0.0, 0.3], [-6.0, 7.0, -2.0], [3.0, -7.5, 40.0]])


def test_cells_seen_are_those_in_range_and_in_view(grid):
    seen = grid.visible_from(POSES)
    for row, (x, y, heading) in enumerate(POSES):
        for cell, mark in zip(grid.cells, seen[row], strict=True):
            away = math.hypot(cell.real - x, cell.imag - y)
            bearing = math.atan2(cell.imag - y, cell.real - x) - heading
            in_view = math.cos(bearing) >= 0  # half of the surroundings
            assert mark == (away <= 4.5 and in_view)


def test_paths_see_what_any_of_their_poses_sees(grid):
    paths, chosen = np.stack([POSES, 0.9 * POSES]), grid.cells.real > 1.0
    expected = [grid.visible_from(path).any(axis=0) for path in paths]
    np.testing.assert_array_equal(grid.visible_from(paths), expected)
    some = grid.visible_from(paths, chosen)
    np.testing.assert_array_equal(some, np.array(expected)[:, chosen])


def test_walls_hide_cells_where_they_hide_landmarks():
    scenario = load_scenario("corridor")
    clear = CoverageGrid(scenario.with_changes(sensor={"occlusion": False}))
    seen = CoverageGrid(scenario).visible_from(np.zeros((1, 3)))[0]
    cells = CoverageGrid(scenario).cells
    behind = (cells.real > 1.5) & (cells.imag > 3.0) & (cells.imag < 9.0)
    assert not seen[behind].any()
    assert clear.visible_from(np.zeros((1, 3)))[0, behind].sum() > 20
    assert seen[(np.abs(cells.imag) < 1.0) & (cells.real < 7.5)].all()


def test_the_way_to_a_wall_is_found_in_every_direction(grid):
    walls = load_scenario("active_medium").walls
    ways = twin.wall_distances(walls, grid.diagonal, POSES)
    for row, (x, y, heading) in enumerate(POSES):
        for k in range(SECTORS):
            angle = heading + k * math.pi / 4
            dx, dy = math.cos(angle), math.sin(angle)
            sides = [(8 - x) / dx, (-8 - x) / dx, (8 - y) / dy, (-8 - y) / dy]
            assert ways[row, k] == pytest.approx(min(s for s in sides if s > 0))


def test_inner_walls_stop_the_rays_too():
    walls, far = load_scenario("corridor").walls, 100.0
    ways = twin.wall_distances(walls, far, np.zeros((1, 3)))[0]
    aslant = 1.2 * 2**0.5
    expected = [13.2, 13.2, aslant, 1.2, aslant, 1.2, aslant]
    assert ways[[0, 2, 3, 4, 5, 6, 7]] == pytest.approx(expected)


def test_clearance_is_the_distance_to_the_nearest_wall(grid):
    points = np.random.default_rng(0).uniform(-8, 8, (50, 2))
    np.testing.assert_allclose(grid.clearance(points), 8 - np.abs(points).max(axis=1))


def test_sector_sums_add_up_to_the_weights(grid):
    weights = np.random.default_rng(0).random((3, len(grid.cells)))
    sums = twin.sector_sums(POSES, grid.cells, weights, reach=3.0)
    away = np.abs(grid.cells - (POSES[:, :1] + 1j * POSES[:, 1:2]))
    np.testing.assert_allclose(
        sums.sum(axis=1), (weights * np.exp(-away / 3.0)).sum(axis=1)
    )


def test_a_landmark_on_the_left_counts_on_the_left():
    pose = np.array([[1.0, 1.0, np.pi / 2]])
    there = np.array([-3.0 + 1.0j])
    pull = twin.sector_sums(pose, there, np.ones((1, 1)), reach=4.0)[0]
    assert pull.argmax() == 2
    assert pull[2] == pytest.approx(0.5 / math.e)
    assert pull[[0, 4, 5, 6, 7]] == pytest.approx(np.zeros(5))


def test_goals_are_the_ways_to_what_is_nearest_and_to_what_is_known_best():
    env = ActiveSlamEnv("active_medium", accuracy=0.06)
    for observation, *_ in wander(env, 60, seed=3):
        now = env.knowledge
        ids = list(now.belief.landmark_ids)
        x, y, heading = now.belief.pose
        spots = now.belief.landmarks @ [1, 1j]
        std = np.linalg.eigvalsh(now.belief.landmark_covariances)[:, -1]
        candidates = [now.grid.cells[~now.explored], spots[~now.known[ids]]]
        best = [ids.index(min(np.array(ids)[std <= std.min() + 1e-9]))] if ids else []
        candidates += [spots[best]]
        for k, places in enumerate(candidates):
            goal = observation["goals"][3 * k : 3 * k + 3]
            if not len(places):
                assert not goal.any()
                continue
            away = np.abs(places - (x + 1j * y))
            nearest = places[away.argmin()]
            bearing = np.angle(nearest - (x + 1j * y)) - heading
            expected = [math.cos(bearing), math.sin(bearing), away.min() / 16 / 2**0.5]
            np.testing.assert_allclose(goal, expected, atol=1e-9)


# the baselines


@far_origins
@pytest.mark.parametrize("name", ["coverage", "revisit", "greedy"])
def test_an_agent_acts_far_from_the_origin_as_at_the_origin(name, far):
    """Sides and detours of inner walls are computed from coordinates."""
    acted = []
    for origin in ((0.0, 0.0), far):
        scenario = moved_world(load_scenario("active_rooms"), origin)
        env = ActiveSlamEnv(scenario)
        baseline, steps = make_baseline(name, scenario, np.random.default_rng(0)), []
        env.reset(seed=1)
        for _ in range(8):
            action = baseline.act(env.knowledge)
            _, reward, *_ = env.step(action.astype(np.float32))
            steps.append([*action, reward])
        acted.append(steps)
    # Rounding is divided by the smallest standard deviation, a millimetre.
    np.testing.assert_allclose(*acted, rtol=0, atol=1e3 * rounding(far, 8))


@pytest.fixture(scope="module")
def scores():
    env = ActiveSlamEnv("active_easy")
    played = {}
    for name in BASELINES:
        baseline = make_baseline(name, env.scenario, np.random.default_rng(0))
        played[name] = run_episodes(
            env, baseline_policy(baseline), range(VALIDATION, VALIDATION + 8)
        )
    return played


@pytest.mark.slow
def test_whoever_looks_does_better_than_chance(scores):
    chance = mean_of(scores["random"], "total").value
    for name in PLANNERS:
        assert mean_of(scores[name], "total").value > chance + 4
        assert mean_of(scores[name], "known").value > 0.75
    assert mean_of(scores["coverage"], "success").value > 0.5  # .90 of many, 8 here


@pytest.mark.slow
def test_those_who_plan_do_not_touch_a_wall(scores):
    for name in PLANNERS:
        assert not any(episode.crashed for episode in scores[name])


@pytest.mark.slow
@pytest.mark.parametrize("name", BASELINES)
def test_a_baseline_does_the_same_again(name, scores):
    env = ActiveSlamEnv("active_easy")
    baseline = make_baseline(name, env.scenario, np.random.default_rng(0))
    again = run_episode(env, baseline_policy(baseline), VALIDATION)
    np.testing.assert_array_equal(again.path, scores[name][0].path)


@pytest.mark.parametrize("level", LEVELS)
def test_lanes_show_the_whole_floor(level):
    scenario = load_scenario(level)
    grid, lanes = CoverageGrid(scenario), coverage_lanes(scenario)
    seen = np.zeros(len(grid.cells), dtype=bool)
    for start, end in pairwise(lanes):
        heading = math.atan2(*(end - start)[::-1])
        points = start + np.linspace(0, 1, 60)[:, None] * (end - start)
        poses = np.column_stack([points, np.full(60, heading)])
        seen |= grid.visible_from(poses).any(axis=0)
    assert seen.mean() > 0.97
    sensor, (ways, aside) = scenario.sensor, np.abs(np.diff(lanes, axis=0)).T
    reach = sensor.max_range * math.sin(min(sensor.field_of_view, math.pi) / 2)
    steps = np.concatenate([ways[ways > 0], aside[aside > 0]])
    assert steps.min() > 0.7 * reach  # not more lanes than are needed


@pytest.mark.parametrize("name", ["greedy", "mpc"])
def test_thinking_ahead_leaves_the_estimator_as_it_was(name):
    env = ActiveSlamEnv("active_medium")
    baseline = make_baseline(name, env.scenario, np.random.default_rng(0))
    env.reset(seed=0)
    for _ in range(10):
        before = env.knowledge.estimator.state_dict()
        action = baseline.act(env.knowledge)
        after = env.knowledge.estimator.state_dict()
        for key in before:
            np.testing.assert_array_equal(before[key], after[key])
        env.step(action)


def test_greedy_turns_to_the_side_where_something_can_be_learnt():
    """One landmark to the left is mapped; the floor has been seen."""
    env = ActiveSlamEnv(
        "active_easy",
        landmarks={"layout": "points", "points": [[0.0, 3.0], [3.0, 3.0]]},
        sensor={"field_of_view": 1.0, "max_range": 6.0},
        start={"pose": [0.0, 0.0, np.pi / 2], "std": [0.01, 0.01, 0.01]},
    )
    baseline = make_baseline("greedy", env.scenario, np.random.default_rng(0))
    env.reset(seed=0)
    env.step([0.0, 1.0])
    everything = np.ones(len(env.task.grid.cells), dtype=bool)
    now = env.knowledge._replace(explored=everything)
    assert baseline.act(now)[1] < 0


def test_a_planner_plans_as_far_as_its_name_says():
    env, rng = ActiveSlamEnv("active_easy"), np.random.default_rng(0)
    env.reset(seed=0)
    named, made = (
        [each.act(env.knowledge).tolist() for each in planners]
        for planners in (
            [make_baseline(name, env.scenario, rng) for name in ("greedy", "mpc")],
            [BeliefSpacePlanner(settings) for settings in (GREEDY, MPC)],
        )
    )
    assert named == made
    assert made[0] != made[1]


@pytest.fixture
def returns():
    """Return what tells of each step whether a new `Revisit` returns to a landmark.

    The best known landmark is behind the robot, and the only goal ahead of it. The
    steps are given by the worst standard deviation of the position, as a share of the
    required accuracy.
    """
    env = ActiveSlamEnv("active_easy")
    env.reset(seed=0)
    mean = np.array([0.0, 0.0, 0.0, -2.0, 0.0, 3.0, 0.0])
    known = np.array([True, False])
    explored = np.ones(len(env.task.grid.cells), dtype=bool)
    baseline = make_baseline("revisit", env.scenario, np.random.default_rng(0))

    def steps(*shares, begin=1):
        for step, share in enumerate(shares, begin):
            spread = np.diag([0.01, (share / 2) ** 2, 4.0, 0.01, 0.01, 1.0, 1.0])
            belief = Belief(mean, spread, (0, 1))
            speed, turn = baseline.act(
                env.knowledge._replace(
                    belief=belief,
                    known=known,
                    explored=explored,
                    accuracy=0.5,
                    step=step,
                )
            )
            assert (speed > 0) != (turn != 0)  # ahead, or round on the spot
            yield bool(turn)

    return lambda *shares, **of: list(steps(*shares, **of))


def test_a_return_begins_above_four_fifths_of_the_accuracy_and_ends_below_half(returns):
    assert returns(0.0, 0.6, 0.79, 0.8) == [False] * 4
    assert returns(0.81, 0.6, 0.51, 0.5) == [True] * 4
    assert returns(0.49, 0.6, 0.79) == [False] * 3
    assert returns(0.81, 0.49, 0.81) == [True, False, True]
    assert returns(0.6, 0.6, begin=0) == [False] * 2  # another episode


@pytest.mark.parametrize("share", [0.6, 0.9])
def test_a_return_in_vain_ends_and_the_robot_explores_for_a_while(returns, share):
    assert returns(0.9, *[share] * 25) == [True] * 26
    assert returns(*[share] * 26) == [False] * 26
    assert returns(share) == [share > 0.8]
    assert returns(0.9, *[0.9] * 24) == [True] * 25


def test_certainty_ends_the_exploration_that_follows_a_return_in_vain(returns):
    assert returns(*[0.9] * 28) == [True] * 26 + [False] * 2
    assert returns(0.49, 0.9) == [False, True]


def test_an_unknown_baseline_is_refused_with_the_nearest_name():
    with pytest.raises(ValueError, match="got 'gredy'; did you mean 'greedy'"):
        make_baseline("gredy", load_scenario("active_easy"), np.random.default_rng(0))


def test_a_table_names_means_with_their_intervals():
    ends = [Episode(x, *[True] * 6, np.empty((0, 2))) for x in (1.0, 2.0, 3.0)]
    half = 1.96 * np.std([1, 2, 3], ddof=1) / 3**0.5
    assert f"2.00 ± {half:.2f}" in score_table({"me": ends}).splitlines()[1]


# who learns


@pytest.mark.slow
def test_the_example_trains_saves_reads_back_and_draws(tmp_path, monkeypatch, capsys):
    pytest.importorskip("stable_baselines3", reason="needs Stable-Baselines3")
    example = next(Path(__file__).parents[2].glob("examples/*train_active_slam.py"))
    few = ["--steps", "1024", "--worlds", "16", "--maps", "2"]
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("sys.argv", [str(example), *few, "--scenario", "active_easy"])
    runpy.run_path(str(example), run_name="__main__")
    scores = tmp_path / "results" / "09_train_active_slam" / "scores.txt"
    table = scores.read_text(encoding="utf-8")
    assert table in capsys.readouterr().out
    assert all(f"\nppo - {name}: return " in table for name in BASELINES)
    written = {path.name for path in (tmp_path / "results").rglob("*.*")}
    assert written >= {
        "policy.zip",
        "learning_curve.csv",
        "learning_curve.png",
        "scores.txt",
        "trajectories.png",
    }
