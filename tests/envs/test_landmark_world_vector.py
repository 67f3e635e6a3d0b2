"""The native vector world, held against Gymnasium's own vector of single worlds."""

from types import SimpleNamespace

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.error import ResetNeeded
from gymnasium.vector import AutoresetMode
from presets import KINDS
from worlds import WALLS

import slamgym  # noqa: F401 (registers the environments)
from slamgym.envs.vector import FlattenBatch
from slamgym.envs.vector.landmark_world_vector import LandmarkWorldVectorEnv
from slamgym.envs.vector.wrappers import _Adapter
from slamgym.sim_configs import load_scenario

ID = "slamgym/LandmarkWorld-v0"
WORLDS, STEPS, SEED = 5, 200, 3
EVERYTHING = {
    "scenario": "hidden_identities",
    "steps": 70,
    "walls": WALLS,
    "sensor": {"occlusion": True, "dropout": 0.2, "field_of_view": 3.0},
    "landmarks": {"seed": None, "min_distance": 0.5},
    "start": {"std": [0.1, 0.1, 0.1]},
}
# All of it, with 10,000 landmarks, is compared in `test_world_batch`.
CORNER = {"columns": 10, "rows": 10}
WORLDS_TO_TEST = {
    **{name: {"scenario": name} for name in KINDS},
    "a corner": {"scenario": "city", "landmarks": CORNER, "controls": CORNER},
}
MODES = list(AutoresetMode)


def native(count=WORLDS, mode=AutoresetMode.NEXT_STEP, **changes):
    return gym.make_vec(ID, count, autoreset_mode=mode, **changes)


def sync(count=WORLDS, mode=AutoresetMode.NEXT_STEP, **changes):
    options = {"autoreset_mode": mode}
    return gym.make_vec(
        ID, count, vectorization_mode="sync", vector_kwargs=options, **changes
    )


def same(value, other):
    """Assert equality of keys, types, shapes and bits."""
    assert type(value) is type(other)
    if isinstance(value, dict):
        assert set(value) == set(other)
        for key in value:
            same(value[key], other[key])
    elif isinstance(value, tuple):
        for each, its in zip(value, other, strict=True):
            same(each, its)
    elif isinstance(value, np.ndarray):
        assert (value.dtype, value.shape) == (other.dtype, other.shape)
        if value.dtype == object:
            same(tuple(value), tuple(other))
        else:
            assert value.tobytes() == other.tobytes()
    else:
        assert value is other is None


def actions(rng, count=WORLDS):
    wild = rng.uniform((-0.8, -1.2), (1.6, 1.2), (count, 2)).astype(np.float32)
    wild[rng.random(count) < 0.1] = 0.0
    return wild


def reset_some(vectors, mask):
    results = [vec.reset(options={"reset_mask": mask.copy()}) for vec in vectors]
    same(*results)


# --- parity ---


@pytest.mark.slow
@pytest.mark.parametrize("name", WORLDS_TO_TEST)
def test_it_gives_what_gymnasiums_vector_of_single_worlds_gives(name):
    """All of it: observations, rewards, ends, infos with their masks, final ones.

    The worlds take turns with the modes: all modes have all settings in the next test.
    """
    mode = MODES[list(WORLDS_TO_TEST).index(name) % len(MODES)]
    changes = WORLDS_TO_TEST[name]
    steps = min(load_scenario(changes["scenario"]).steps, changes.get("steps", 75))
    changes = {**changes, "steps": steps}
    pair = [native(mode=mode, **changes), sync(mode=mode, **changes)]
    same(*(vec.reset(seed=SEED) for vec in pair))
    rng, ends = np.random.default_rng(1), 0
    for _ in range(STEPS):
        commands = actions(rng)
        (_, _, terminated, truncated, _), _ = results = [
            vec.step(commands.copy()) for vec in pair
        ]
        same(*results)
        ended = terminated | truncated
        ends += np.count_nonzero(ended)
        if mode == AutoresetMode.DISABLED:
            early = rng.random(WORLDS) < 0.003  # so that ends differ
            if (ended | early).any():
                reset_some(pair, ended | early)
    assert ends >= WORLDS
    pair[1].close()


@pytest.mark.parametrize("mode", MODES, ids=str)
def test_worlds_may_end_one_by_one(mode):
    pair = [native(mode=mode, **EVERYTHING), sync(mode=mode, **EVERYTHING)]
    same(*(vec.reset(seed=SEED) for vec in pair))
    rng, when_ended = np.random.default_rng(1), []
    for step in range(200):
        commands = actions(rng)
        results = [vec.step(commands.copy()) for vec in pair]
        same(*results)
        ended = results[0][3]
        if ended.any():
            when_ended.append(tuple(ended))
        if step in {10, 25, 77}:
            reset_some(pair, rng.random(WORLDS) < 0.4)
        elif mode == AutoresetMode.DISABLED and ended.any():
            reset_some(pair, ended)
    assert len(set(when_ended)) > 2


def test_it_is_what_make_vec_makes():
    vector = gym.make_vec(ID, 4, scenario="corridor")
    assert type(vector) is LandmarkWorldVectorEnv
    assert vector.num_envs == 4
    assert vector.scenario == load_scenario("corridor")
    assert vector.metadata["autoreset_mode"] is AutoresetMode.NEXT_STEP
    other = sync(4, scenario="corridor")
    for name in ("action_space", "observation_space"):
        assert getattr(vector, name) == getattr(other, name)
        single = f"single_{name}"
        assert getattr(vector, single) == getattr(other, single)
    for key in ("render_modes", "render_fps"):
        assert vector.metadata[key] == other.metadata[key]


# --- seeds ---


def test_seeds_may_be_a_list_and_none_seeds_nothing_anew():
    pair = [native(3), sync(3)]
    same(*(vec.reset(seed=[5, 2, 2**64 - 1]) for vec in pair))
    assert pair[0].np_random_seed == pair[1].np_random_seed == (5, 2, 2**64 - 1)
    same(*(vec.reset() for vec in pair))
    same(*(vec.reset(seed=[None, 8, None]) for vec in pair))
    same(*(vec.reset() for vec in pair))


def test_a_seed_seeds_the_worlds_of_the_mask_alone():
    pair = [native(mode="Disabled"), sync(mode=AutoresetMode.DISABLED)]
    same(*(vec.reset(seed=1) for vec in pair))
    mask = np.array([True, False, False, True, False])
    same(*(vec.reset(seed=9, options={"reset_mask": mask.copy()}) for vec in pair))
    assert pair[0].np_random_seed == (9, 2, 3, 12, 5)
    same(*(vec.reset() for vec in pair))


def test_without_a_seed_worlds_differ():
    observations, _ = native(2, sensor={"std": [0.1, 0.1]}).reset()
    assert (observations["landmarks"][0] != observations["landmarks"][1]).any()


# --- episodes ---


@pytest.mark.parametrize(
    ("most", "ends_at"), [(3, 3), (1000, 29), (-1, 29), (None, 29)]
)
def test_an_episode_ends_with_the_scenario_or_before(most, ends_at):
    vector = native(2, max_episode_steps=most)
    vector.reset(seed=0)
    truncated = [vector.step(np.zeros((2, 2)))[3].tolist() for _ in range(29)]
    assert truncated.index([True, True]) == ends_at - 1


def test_the_action_of_a_world_that_begins_anew_is_not_looked_at():
    vector = native(2, steps=2)
    vector.reset(seed=0)
    for _ in range(2):
        vector.step(np.zeros((2, 2)))
    vector.step(np.full((2, 2), np.nan))


def test_without_autoreset_an_ended_world_must_be_reset():
    vector = native(3, mode="Disabled", steps=2)
    vector.reset(seed=0)
    for _ in range(2):
        vector.step(np.zeros((3, 2)))
    mask = np.array([True, False, False])
    vector.reset(options={"reset_mask": mask})
    with pytest.raises(ResetNeeded, match=r"worlds \[1, 2\] have ended.*reset_mask"):
        vector.step(np.zeros((3, 2)))


@pytest.mark.parametrize("mode", MODES, ids=str)
def test_nothing_handed_out_is_shared_with_anything_else(mode):
    vector, twin = native(mode=mode, **EVERYTHING), native(mode=mode, **EVERYTHING)
    kept = []
    for step in range(4):
        results = []
        for each in (vector, twin):
            if step == 0:
                results.append(each.reset(seed=0))
            elif step == 2:
                mask = np.array([True, False, True, False, False])
                results.append(each.reset(options={"reset_mask": mask}))
            else:
                observations, *_, infos = each.step(np.full((WORLDS, 2), 0.3))
                results.append((observations, infos))
        if step != 2 or mode == AutoresetMode.DISABLED:
            same(*results)
        arrays = [*leaves(results[0]), vector.poses, vector.landmarks]
        for k, array in enumerate(arrays):
            others = [*kept, *arrays[:k]]
            assert not any(np.shares_memory(array, other) for other in others)
        kept += arrays
        for array in arrays:
            array[...] = 1


def leaves(value):
    if isinstance(value, dict | tuple):
        parts = value.values() if isinstance(value, dict) else value
        for part in parts:
            yield from leaves(part)
    else:
        yield value


# --- pictures ---


@pytest.mark.slow
@pytest.mark.parametrize("mode", MODES[:2], ids=str)
def test_frames_are_those_of_the_single_worlds_from_episode_to_episode(mode):
    changes = {"render_mode": "rgb_array", **EVERYTHING, "steps": 3}
    vector, other = native(2, mode, **changes), sync(2, mode, **changes)
    for step in range(6):
        for each in (vector, other):
            each.reset(seed=0) if step == 0 else each.step(np.full((2, 2), 0.7))
        if step in {1, 5}:
            frames = vector.render()
            assert len(frames) == 2
            for frame, expected in zip(frames, other.render(), strict=True):
                np.testing.assert_array_equal(frame, expected)
    vector.close()
    other.close()


# --- bad input ---


def test_options_of_one_world_are_taken_by_worlds_side_by_side():
    options = {"pose": (1.0, 2.0, 0.5)}
    changes = {"scenario": "six_landmarks", "start": {"std": (0.0, 0.0, 0.0)}}
    with pytest.raises(ValueError, match="vectorization_mode='sync' take those of one"):
        gym.make_vec("slamgym/LandmarkWorld-v0", 2, **changes).reset(options=options)
    apart = {"vectorization_mode": "sync", **changes}
    _, infos = gym.make_vec("slamgym/LandmarkWorld-v0", 2, **apart).reset(
        options=options
    )
    np.testing.assert_array_equal(infos["pose"], [options["pose"]] * 2)


@pytest.mark.parametrize(
    ("options", "error", "word"),
    [
        ({"mask": 1}, ValueError, "'reset_mask' alone"),
        ({"reset_mask": [True] * WORLDS}, TypeError, "bool ndarray"),
        ({"reset_mask": np.ones(WORLDS)}, TypeError, "bool ndarray"),
        ({"reset_mask": np.ones(4, bool)}, ValueError, r"shape \(5,\)"),
        ({"reset_mask": np.zeros(WORLDS, bool)}, ValueError, "True somewhere"),
    ],
)
def test_options_of_another_form_are_refused(options, error, word):
    vector = native()
    vector.reset(seed=0)
    with pytest.raises(error, match=word):
        vector.reset(options=options)


@pytest.mark.parametrize(
    ("seed", "error", "word"),
    [
        ([1, 2], ValueError, "5 seeds"),
        (1.5, TypeError, "got 1.5"),
        ("a", TypeError, "got 'a'"),
        (-1, gym.error.Error, "-1"),
    ],
)
def test_seeds_of_another_form_are_refused(seed, error, word):
    with pytest.raises(error, match=word):
        native().reset(seed=seed)


@pytest.mark.parametrize("count", [0, -1, 2.0, True])
def test_numbers_of_worlds_and_of_steps_are_positive_integers(count):
    with pytest.raises(ValueError, match=r"num_envs must be an integer >= 1"):
        LandmarkWorldVectorEnv(count)
    with pytest.raises(ValueError, match=r"max_episode_steps must be .* got 0"):
        native(max_episode_steps=0)


def test_before_a_reset_of_all_worlds_nothing_works():
    vector = native()
    mask = np.arange(WORLDS) < 3
    for call, message in (
        (vector.render, "no worlds"),
        (lambda: vector.step(np.zeros((WORLDS, 2))), None),
        (lambda: vector.reset(options={"reset_mask": mask}), "all worlds first"),
    ):
        with pytest.raises(ResetNeeded, match=message):
            call()
    vector.reset(seed=0)
    with pytest.raises(ValueError, match=r"shape \(5, 2\).* got shape \(2, 5\)"):
        vector.step(np.zeros((2, WORLDS)))
    with pytest.warns(UserWarning, match="render_mode"):
        assert vector.render() is None


# --- the flat observation ---


@pytest.mark.parametrize("mode", MODES, ids=str)
@pytest.mark.parametrize("changes", [{}, EVERYTHING], ids=["plain", "everything"])
def test_flat_observations_are_gymnasiums(mode, changes):
    nested = native(mode=mode, **changes)
    flat = FlattenBatch(native(mode=mode, **changes))
    space = nested.single_observation_space
    assert flat.single_observation_space == gym.spaces.flatten_space(space)

    def flattened(observations, world):
        one = {key: value[world] for key, value in observations.items()}
        return gym.spaces.flatten(space, one)

    (rows, _), (observations, _) = (each.reset(seed=0) for each in (flat, nested))
    rng = np.random.default_rng(0)
    for _ in range(75):
        assert rows in flat.observation_space
        for world, row in enumerate(rows):
            np.testing.assert_array_equal(row, flattened(observations, world))
        commands = actions(rng)
        rows, *rest, truncated, infos = flat.step(commands)
        observations, *wanted, _, expected = nested.step(commands)
        assert [(a.dtype, *a) for a in rest] == [(a.dtype, *a) for a in wanted]
        for world in np.flatnonzero(truncated) if "final_obs" in infos else ():
            last = gym.spaces.flatten(space, expected["final_obs"][world])
            np.testing.assert_array_equal(infos["final_obs"][world], last)
        if mode == AutoresetMode.DISABLED and truncated.any():
            options = {"reset_mask": truncated}
            (rows, _), (observations, _) = (
                each.reset(options=options) for each in (flat, nested)
            )


def test_only_one_level_of_arrays_can_be_flattened():
    with pytest.raises(ValueError, match="Dict observation"):
        FlattenBatch(gym.make_vec("CartPole-v1", 2, vectorization_mode="sync"))


def test_an_episode_that_ends_by_itself_is_not_truncated_for_stable_baselines():
    ends = np.array([[True, True, False], [True, False, True]])  # terminated, truncated
    step = np.zeros(3), np.zeros(3), *ends, {}
    adapter = SimpleNamespace(
        worlds=SimpleNamespace(step=lambda _: step), _actions=None, _end=lambda *_: None
    )
    *_, dones, infos = _Adapter.step_wait(adapter)
    assert dones.all()
    assert [info["TimeLimit.truncated"] for info in infos] == [False, False, True]
