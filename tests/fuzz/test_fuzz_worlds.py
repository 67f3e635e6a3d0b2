"""Calls of single and vector worlds with sane and insane arguments."""

import numpy as np
from fuzzing import numbers, strange_values
from gymnasium.error import Error  # of Gymnasium's, for a seed or a wrong order
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, rule

from slamgym.envs import LandmarkWorldEnv, LandmarkWorldVectorEnv
from slamgym.sim_configs import list_presets, load_scenario

PRESETS = [n for n in list_presets() if n not in ("city", "dense")]
COUNT = 3
numbers_3 = st.lists(numbers, min_size=2, max_size=3)
options = st.one_of(
    st.none(),
    st.dictionaries(st.sampled_from(["pose", "reset_mask", "x"]), strange_values()),
)


def assert_finite(values):
    """Every number in nested mappings is finite."""
    for value in values.values():
        if isinstance(value, dict):
            assert_finite(value)
        elif np.asarray(value).dtype.kind == "f":
            assert np.isfinite(value).all()


class Worlds(RuleBasedStateMachine):
    """One world, single or many, its calls in any order."""

    @initialize(name=st.sampled_from(PRESETS), many=st.booleans())
    def make(self, name, many):
        scenario = load_scenario(name)
        self.many = many
        self.env = (
            LandmarkWorldVectorEnv(COUNT, scenario=scenario)
            if many
            else LandmarkWorldEnv(scenario)
        )
        self.begun = False

    def attempt(self, call, *kinds):
        try:
            answer = call()
        except (ValueError, *kinds) as error:
            assert str(error)
            assert not isinstance(error, TypeError) or "must be" in str(error)
            return None
        observation = answer[0]
        assert self.env.observation_space.contains(observation)
        assert_finite({k: v for k, v in answer[-1].items() if "pose" in k})
        if len(answer) == 5:
            assert np.isfinite(answer[1]).all()
        self.begun = True
        return answer

    @rule(seed=st.one_of(st.none(), st.integers(0, 9)))
    def reset(self, seed):
        assert self.attempt(lambda: self.env.reset(seed=seed))

    @rule(seed=st.one_of(numbers, strange_values()), chosen=options)
    def reset_anyhow(self, seed, chosen):
        self.attempt(
            lambda: self.env.reset(seed=seed, options=chosen), Error, TypeError
        )

    @rule(actions=st.lists(st.tuples(st.floats(-1, 1), st.floats(-1, 1)), min_size=3))
    def step(self, actions):
        action = np.array(actions[:COUNT] if self.many else actions[0])
        self.attempt(lambda: self.env.step(action), Error)

    @rule(
        action=st.one_of(numbers_3, st.lists(numbers_3, max_size=4), strange_values())
    )
    def step_anyhow(self, action):
        self.attempt(lambda: self.env.step(action), Error)

    def teardown(self):
        if hasattr(self, "env"):
            self.env.close()


def test_worlds_refuse_or_stay_finite(fuzzer):
    fuzzer.check_machine(Worlds, few=8)
