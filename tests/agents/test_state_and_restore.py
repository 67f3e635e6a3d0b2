"""Worlds return to earlier states, to the bit, whatever they have done since."""

import pickle
from functools import partial

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import data_equivalence

from slamgym import make_estimator
from slamgym.agents import ActiveSlamEnv, ActiveSlamVectorEnv
from slamgym.envs import LandmarkWorldEnv
from slamgym.envs.vector import LandmarkWorldVectorEnv, world_batch
from slamgym.sim_configs import list_presets

PRESETS = [name for name in list_presets() if name != "city"]
FLOORS = ["active_easy", "active_rooms", "active_hidden"]


def drive(env, actions):
    """Step, beginning anew where a single world ends; return all that came out."""
    outputs = []
    for action in actions:
        outputs.append(env.step(action))
        if isinstance(env, gymnasium.Env) and (outputs[-1][2] or outputs[-1][3]):
            outputs.append(env.reset())
    return outputs


def same(one, other):
    return data_equivalence(one, other, exact=True)


def shown(env):
    """Return the arrays that an environment and its worlds show of their state."""
    kind, worlds = type(env), getattr(env, "_worlds", env)
    names = [name for name in dir(kind) if isinstance(getattr(kind, name), property)]
    values = {name: getattr(env, name) for name in names} | vars(worlds)
    arrays = {n: value for n, value in values.items() if isinstance(value, np.ndarray)}
    return {n: np.nan_to_num(value) for n, value in arrays.items()}  # copies


def check(env, seed, *, before=7, after=50):
    rng = np.random.default_rng(seed)
    low, high = env.action_space.low, env.action_space.high
    actions = rng.uniform(low, high, (before + 2 * after, *low.shape)).astype("f4")
    env.reset(seed=seed)
    drive(env, actions[:before])
    state, there = env.state(), shown(env)
    first = drive(env, actions[before : before + after])
    drive(env, actions[before + after :])
    env.reset(seed=seed + 1)  # a new generator and, in some scenarios, a new world
    for _ in range(2):  # the state itself stays as it was
        env.restore(state)
        assert same(there, shown(env))
        again = drive(env, actions[before : before + after])
        assert same(first, again)


@pytest.mark.slow
@pytest.mark.parametrize("name", PRESETS)
def test_worlds_continue_from_a_state_to_the_bit(name, monkeypatch):
    monkeypatch.setattr(world_batch, "_READINGS_AT_ONCE", 500)  # several blocks
    check(LandmarkWorldEnv(name), 3)
    for count, mode in ((100, "NextStep"), (3, "SameStep")):
        check(LandmarkWorldVectorEnv(count, name, autoreset_mode=mode), 5)


@pytest.mark.slow
@pytest.mark.parametrize("name", FLOORS)
def test_worlds_with_filters_continue_from_a_state_to_the_bit(name, monkeypatch):
    monkeypatch.setattr(world_batch, "_READINGS_AT_ONCE", 500)  # several blocks
    after = 15 if name == "active_hidden" else 50
    check(ActiveSlamEnv(name), 3, after=after)
    worlds = 3 if name == "active_hidden" else 100
    check(ActiveSlamVectorEnv(worlds, name), 5, after=after)
    check(ActiveSlamVectorEnv(3, name, autoreset_mode="SameStep"), 6, after=after)


def test_worlds_that_draw_their_settings_return_to_them():
    ranges = {"motion_std": [0.5, 2.0], "measurement_std": [0.5, 2.0]}
    for changes in ({"randomise": ranges}, {"compass": {"std": 0.1, "every": 2}}):
        check(LandmarkWorldEnv("loop", **changes), 8)
        check(LandmarkWorldVectorEnv(3, "loop", **changes), 8)


def test_filters_of_any_kind_return_with_their_world():
    check(ActiveSlamEnv("active_easy", render_mode="rgb_array"), 2, after=20)
    for estimator in ("ekf", "robocentric", "compressed", "unscented"):
        check(ActiveSlamEnv("active_easy", estimator=estimator), 2, after=20)


def test_filters_that_follow_several_hypotheses_return_with_their_world():
    env = ActiveSlamEnv("active_hidden")
    rng = np.random.default_rng(0)
    actions = rng.uniform([0.2, -0.5], [0.5, 0.5], (40, 2))
    env.reset(seed=4)
    drive(env, actions[:20])
    several, slam = env.state(), env._estimator
    records = slam.state_dict()
    drive(env, actions[20:30])
    fewer, counts = env.state(), [len(several_in(several)), len(slam.hypotheses)]
    for state in (several, fewer, several):
        env.restore(state)
        assert len(slam.hypotheses) == len(several_in(state))
    assert same(slam.state_dict(), records)
    first = drive(env, actions[20:])
    saved = slam.state_dict()
    other = ActiveSlamEnv("active_hidden")
    other.reset(seed=9)
    other.restore(several)
    assert same(first, drive(other, actions[20:]))
    assert same(saved, other._estimator.state_dict())
    assert max(counts) > 1, counts


def several_in(state):
    """Return the hypotheses in a state of a world that hides identities."""
    explorers = state[ActiveSlamEnv.changing.index("_explorers")]
    return explorers[0][0][0][0]


def test_frames_return_with_their_world():
    env = ActiveSlamEnv("active_easy", render_mode="rgb_array")
    env.reset(seed=1)
    drive(env, [[0.5, 0.2]] * 3)
    state, frame = env.state(), env.render()
    drive(env, [[0.5, -0.2]] * 3)
    env.reset(seed=9)
    env.restore(state)
    assert np.array_equal(env.render(), frame)
    worlds = LandmarkWorldVectorEnv(2, "corridor", render_mode="rgb_array")
    worlds.reset(seed=1)
    state, frames = worlds.state(), worlds.render()
    drive(worlds, [[[0.5, 0.2]] * 2] * 3)
    worlds.restore(state)
    assert all(map(np.array_equal, worlds.render(), frames))


def test_there_is_no_state_before_the_first_episode():
    kinds = (LandmarkWorldEnv, LandmarkWorldVectorEnv)
    for kind in (*kinds, ActiveSlamEnv, ActiveSlamVectorEnv):
        with pytest.raises(gymnasium.error.ResetNeeded):
            kind().state()
        begun = kind()
        begun.reset(seed=0)
        with pytest.raises(gymnasium.error.ResetNeeded):
            kind().restore(begun.state())


class WithoutState:
    """A filter of four methods, which cannot return to a state."""

    def __init__(self, **settings):
        slam = make_estimator("ekf", **settings)
        self.reset, self.predict = slam.reset, slam.predict
        self.update, self.belief = slam.update, slam.belief


def test_a_filter_that_cannot_return_to_a_state_is_named():
    env = ActiveSlamEnv("active_easy", estimator=WithoutState)
    env.reset(seed=0)
    with pytest.raises(TypeError, match=r"WithoutState has no method state_dict\(\)"):
        env.state()


def test_a_state_of_another_scenario_is_refused_and_changes_nothing():
    for kind, names in [
        (LandmarkWorldEnv, ("loop", "corridor")),
        (ActiveSlamEnv, ("active_easy", "active_medium")),
        (partial(LandmarkWorldVectorEnv, 2), ("loop", "coarse_loop")),
        (partial(ActiveSlamVectorEnv, 2), ("active_easy", "active_medium")),
    ]:
        own, other = map(kind, names)
        own.reset(seed=0)
        other.reset(seed=0)
        before = own.state()
        message = "same world: name must be '{}', got '{}'".format(*names)
        with pytest.raises(ValueError, match=message):
            own.restore(other.state())
        assert same(before, own.state())


@pytest.mark.parametrize("kind", [LandmarkWorldEnv, partial(LandmarkWorldVectorEnv, 2)])
def test_a_state_of_other_settings_is_refused_by_their_names(kind):
    own = kind("loop")
    named_alike = {
        r"dt must be 1\.0, got 0\.3": kind("loop", dt=0.3),
        r"sensor\.max_range must be 5\.0, got 8\.0": kind(
            "loop", sensor={"max_range": 8.0}
        ),
        r"compass must be None, got Compass\(": kind("loop", compass={"std": 0.1}),
    }
    twin = kind(own.scenario.model_copy())
    for each in (own, twin, *named_alike.values()):
        each.reset(seed=3)
    before = own.state()
    for message, other in named_alike.items():
        with pytest.raises(ValueError, match=f"of the same world: {message}"):
            own.restore(other.state())
        assert same(before, own.state())
    own.restore(pickle.loads(pickle.dumps(twin.state())))
    actions = np.broadcast_to([0.5, 0.1], own.action_space.shape)
    assert same(own.step(actions), twin.step(actions))


def test_what_is_no_state_of_these_worlds_is_refused_and_changes_nothing():
    single, worlds = LandmarkWorldEnv("loop"), LandmarkWorldVectorEnv(3, "loop")
    others = LandmarkWorldVectorEnv(2, "loop")
    for each in (single, worlds, others):
        each.reset(seed=0)
    wrong = [None, "x", (), 3, others.state()]
    for each, given in [(single, worlds.state()), (worlds, single.state())]:
        before, step = each.state(), (0.5, 0.1) if each is single else [(0.5, 0.1)] * 3
        expected = each.step(step)
        each.restore(before)
        for state in [*wrong, given]:
            with pytest.raises(
                ValueError, match=r"what state\(\) of the same Landmark"
            ):
                each.restore(state)
        assert data_equivalence(each.step(step), expected)
