"""Worlds side by side, held against single worlds with the same seeds, bit by bit."""

import copy
import pickle

import numpy as np
import pytest
from gymnasium.error import ResetNeeded
from gymnasium.utils import seeding
from presets import KINDS
from worlds import RANDOM_MAP, WALLS

from slamgym.envs import LandmarkWorldEnv
from slamgym.envs.drives import BicycleDrive
from slamgym.envs.robot import UnicycleBodies, UnicycleBody
from slamgym.envs.spaces import _begin_step
from slamgym.envs.vector import WorldBatch
from slamgym.sim_configs import load_scenario

WORLDS, STEPS, SEED = 5, 200, 11
ROAMING = load_scenario("six_landmarks").with_changes(
    dt=0.5,
    steps=60,
    robot={"max_turn_rate": 0.9},
    motion={"std": [0.05, 0.03, 0.04]},
    landmarks=RANDOM_MAP,
    controls={"sequence": "circle", "radius": 3.0, "speed": 0.8},
)
HALF_BLIND = {"occlusion": True, "max_range": 8.0, "field_of_view": 3.0, "dropout": 0.2}
HIDDEN = {"clutter": 1.0, "max_clutter": 5, "identities": False}
ENCODERS = {"noise_in": "odometry", "noise_at_rest": False, "std": [0.05, 0.0, 0.04]}
FAULTS = {
    "odometry_scale": 0.1,
    "odometry_turn": 0.05,
    "bearing_bias": 0.3,
    "range_bias": -0.2,
    "motion_dof": 3.0,
    "sensor_dof": 4.5,
}
RANGES = {
    **{"motion_std": [0.2, 5.0], "measurement_std": [0.2, 5.0]},
    **{"dropout": [0.0, 0.6], "clutter": [0.0, 3.0]},
    **{"max_range": [3.0, 9.0], "field_of_view": [1.0, 6.0]},
    **{"start_x": [-2.0, 2.0], "start_y": [-1.0, 1.0], "start_heading": [-3.0, 3.0]},
    **{"start_std": [0.5, 2.0], "map_scale": [0.5, 1.5]},
}
SHIFTED = {"layout": "points", "points": [[1.0, 2.0], [-4.0, 3.0], [5.0, -1.0]]}
VARIANTS = {
    "drawn anew": {
        "sensor": {**HALF_BLIND, **HIDDEN, "range_std_per_metre": 0.1},
        **{"randomise": RANGES, "walls": WALLS, "start": {"std": [0.1, 0.1, 0.1]}},
    },
    "drawn anew, by id": {
        "randomise": {**RANGES, "clutter": None},
        "sensor": {"dropout": 0.0},
        "faults": FAULTS,
        "motion": ENCODERS,
    },
    "few ranges": {"randomise": {"motion_std": [0.5, 2.0]}},
    "map shifted": {
        "randomise": {"landmark_shift": 0.5, "map_scale": [0.8, 1.2]},
        "landmarks": SHIFTED,
    },
    "walls": {"walls": WALLS},
    "walls that hide": {"walls": WALLS, "sensor": HALF_BLIND},
    "everything": {"walls": WALLS, "sensor": {**HALF_BLIND, **HIDDEN}},
    "hidden, no clutter": {"sensor": {"identities": False}},
    "noise grows": {"sensor": {"range_std_per_metre": 0.3, "min_range": 0.0}},
    "coarse": {"sensor": {"std": [1.0, 1.0], "min_range": 0.0}},
    "one landmark": {"landmarks": {"layout": "points", "points": [[1.0, 2.0]]}},
    "silent at rest": {"motion": {"noise_at_rest": False}},
    "faults": {"faults": FAULTS, "motion": {"noise_at_rest": False}, "walls": WALLS},
    "faulty encoders": {"faults": FAULTS, "motion": ENCODERS},
    "encoders": {"motion": ENCODERS, "start": {"drawn": "estimate", "std": [1, 1, 1]}},
}
SCENARIOS = {name: load_scenario(name) for name in (*KINDS, "city")} | {
    name: ROAMING.with_changes(**changes) for name, changes in VARIANTS.items()
}

NAMES = ("measurements", "mask", "odometry", "poses", "collisions", "landmark_ids")
NAMES += ("landmarks", "start_estimates")


def generators(count=WORLDS, seed=SEED):
    return [seeding.np_random(seed + i)[0] for i in range(count)]


def begun(scenario=ROAMING, count=WORLDS):
    batch = WorldBatch(scenario, count)
    batch.reset(generators(count))
    return batch


def actions(rng, count=WORLDS):
    """Wild ones, some beyond the limits, some of rest, half of them in float32."""
    wild = rng.uniform((-0.8, -1.2), (1.6, 1.2), (count, 2))
    wild[rng.random(count) < 0.1] = 0.0
    return wild.astype(np.float32) if rng.random() < 0.5 else wild


def bits(value):
    array = np.asarray(value)
    return array.dtype, array.shape, array.tobytes()


def of_single(env, observation, info):
    return {
        "measurements": observation["landmarks"],
        "mask": observation["mask"],
        "odometry": observation["odometry"],
        "poses": info["pose"],
        "collisions": info["collision"],
        "landmark_ids": info.get("landmark_ids"),
        "landmarks": env.landmarks,
        "start_estimates": env.start_estimate,
    }


def assert_equal_worlds(batch, singles):
    for world, moment in enumerate(singles):
        for name, value in of_single(*moment).items():
            rows = getattr(batch, name)
            assert (rows is None) == (value is None)
            if rows is not None:
                assert bits(value) == bits(rows[world]), (name, world)


@pytest.mark.slow
@pytest.mark.parametrize("name", SCENARIOS)
def test_each_world_is_the_single_world_of_its_generator(name):
    """Through resets of some worlds, and steps that some worlds do not take."""
    batch = begun(SCENARIOS[name])
    rngs = generators()
    batch.reset(rngs)
    envs = [LandmarkWorldEnv(SCENARIOS[name]) for _ in range(WORLDS)]
    singles = [(env, *env.reset(seed=SEED + i)) for i, env in enumerate(envs)]
    rng = np.random.default_rng(0)
    steps_left = rng.integers(10, 40, WORLDS)
    for step in range(60 if name == "city" else STEPS):  # the city is ten times slower
        assert_equal_worlds(batch, singles)
        commands = actions(rng)
        moving = rng.random(WORLDS) < (1.0 if step < 30 else 0.9)
        batch.step(commands, moving=None if moving.all() else moving)
        for world in np.flatnonzero(moving):
            observation, _, _, _, info = envs[world].step(commands[world])
            singles[world] = envs[world], observation, info
        steps_left -= 1
        ended = steps_left < 0
        if ended.any():
            batch.reset(rngs, ended)
        for world in np.flatnonzero(ended):
            singles[world] = envs[world], *envs[world].reset()
            steps_left[world] = rng.integers(10, 160)


def test_variants_meet_walls_lose_readings_and_see_clutter():
    """What the comparison above rests on."""
    batch, rng = begun(SCENARIOS["everything"]), np.random.default_rng(0)
    hits, clutter, seen = 0, 0, []
    for _ in range(200):
        batch.step(actions(rng))
        hits += np.count_nonzero(batch.collisions)
        clutter += np.count_nonzero(batch.mask & (batch.landmark_ids < 0))
        seen.append(batch.mask.mean())
    assert hits > 20
    assert clutter > 100
    assert 0.02 < np.mean(seen) < 0.5


def test_the_number_of_worlds_changes_no_world():
    few, many = begun(count=2), begun(count=40)
    rng = np.random.default_rng(0)
    for _ in range(20):
        commands = actions(rng, 40)
        few.step(commands[:2])
        many.step(commands)
    for name in ("measurements", "mask", "poses"):
        assert bits(getattr(few, name)) == bits(getattr(many, name)[:2])


def test_nothing_handed_out_is_written_into_or_heeded_later():
    batch, twin = begun(), begun()
    kept, values = [], []
    for _ in range(6):
        for worlds in (batch, twin):
            worlds.step(np.full((WORLDS, 2), 0.3))
        arrays, others = (
            [getattr(each, name) for name in NAMES if name != "landmark_ids"]
            for each in (batch, twin)
        )
        for array, other in zip(arrays, others, strict=True):
            assert bits(array) == bits(other)
            assert not any(np.shares_memory(array, old) for old in kept)
            array[...] = 7
        kept += arrays
        values += [bits(array) for array in arrays]
    assert [bits(array) for array in kept] == values


@pytest.mark.parametrize(
    "duplicate", [copy.deepcopy, lambda batch: pickle.loads(pickle.dumps(batch))]
)
def test_a_copy_goes_on_as_the_original_would(duplicate):
    batch = begun(SCENARIOS["everything"])
    rng = np.random.default_rng(0)
    batch.step(actions(rng))
    other = duplicate(batch)
    for _ in range(150):  # beyond the noise drawn ahead
        commands = actions(rng)
        batch.step(commands)
        other.step(commands)
        assert bits(batch.measurements) == bits(other.measurements)
        assert bits(batch.poses) == bits(other.poses)


# --- walls ---


@pytest.mark.parametrize("drive", [None, BicycleDrive(0.5, 3.0, (0.3, 0.1))])
def test_bodies_move_like_single_ones_near_and_far_from_walls(drive):
    rng, count = np.random.default_rng(0), 3000
    one, asking = (UnicycleBody(0.2, WALLS, drive) for _ in range(2))
    asking._contacts.reach = np.inf  # asks the engine about every way
    bodies = UnicycleBodies(count, 0.2, WALLS, drive)
    starts = np.column_stack([rng.uniform(-8, 10, (count, 2)), rng.normal(size=count)])
    scale = rng.choice([0.0, 0.01, 0.3, 3.0], count)[:, None]
    commands, slip = (scale * rng.normal(size=(count, n)) for n in (2, 3))
    before = bodies.frame
    bodies.place(np.arange(count), starts)
    assert not before[:3].any()  # a place replaces the frame
    shares = bodies.drive(commands, slip).tolist()
    for k, pose in enumerate(starts.tolist()):
        for body in (one, asking):
            body.place(pose)
            assert body.drive(commands[k].tolist(), slip[k].tolist()) == shares[k]
            assert bits(body.pose) == bits(bodies.poses()[k])
    assert 50 < np.count_nonzero(np.less(shares, 1.0)) < 2500


# --- steps in which some worlds begin ---


@pytest.mark.parametrize("name", ["drawn anew, by id", "everything", "map shifted"])
def test_worlds_that_begin_in_a_step_are_those_of_a_step_and_a_reset(name):
    scenario, rng = SCENARIOS[name], np.random.default_rng(3)
    once, twice = begun(scenario), begun(scenario)
    ours, theirs = generators(seed=70), generators(seed=70)
    for _ in range(12):
        wanted, moving = actions(rng), rng.random(WORLDS) < 0.7
        once.step(wanted, moving, ours)
        twice.step(wanted, moving)
        if not moving.all():
            twice.reset(theirs, ~moving)
        for part in NAMES:
            assert bits(getattr(once, part)) == bits(getattr(twice, part)), part


# --- bad input ---


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("world", [0, 3])
def test_an_action_that_is_no_number_names_its_world_and_moves_none(bad, world):
    batch, twin = begun(), begun()
    commands = np.zeros((WORLDS, 2))
    commands[world, 1] = bad
    with pytest.raises(ValueError, match=rf"finite.*\[0\.0, {bad}\] for world {world}"):
        batch.step(commands)
    moving = np.arange(WORLDS) != world
    batch.step(commands, moving)
    twin.step(np.zeros((WORLDS, 2)), moving)
    assert bits(batch.poses) == bits(twin.poses)


@pytest.mark.parametrize(
    "wrong", [np.zeros(2), np.zeros((4, 2)), np.zeros((5, 3)), [[0, 0]] * 4 + [[0]]]
)
def test_actions_of_another_shape_are_refused(wrong):
    with pytest.raises(ValueError, match=r"actions must be .* shape \(5, 2\)"):
        begun().step(wrong)


@pytest.mark.parametrize("dtype", [object, str, complex, bool])
def test_actions_of_another_kind_are_refused(dtype):
    with pytest.raises(ValueError, match=r"actions must be real numbers"):
        begun().step(np.zeros((WORLDS, 2), dtype=dtype))


def test_masked_actions_are_refused():
    with pytest.raises(ValueError, match=r"actions must be .*, got a masked array"):
        begun().step(np.ma.zeros((WORLDS, 2)))


def test_the_layout_of_actions_compiles_no_further_kernel():
    batch, actions = begun(), np.linspace(-1, 1, 2 * WORLDS).reshape(WORLDS, 2)
    for given in (actions, np.asfortranarray(actions), actions.astype(np.float32)):
        batch.step(given)
    assert len(getattr(_begin_step, "signatures", [None])) == 1  # plain without JIT


def test_worlds_that_have_not_begun_do_not_step():
    batch = WorldBatch(ROAMING, WORLDS)
    with pytest.raises(ResetNeeded, match="reset before step"):
        batch.step(np.zeros((WORLDS, 2)))
    with pytest.raises(ResetNeeded, match="all worlds first"):
        batch.reset(generators(), np.arange(WORLDS) < 3)


def test_choices_and_generators_of_another_form_are_refused():
    batch = begun()
    with pytest.raises(ValueError, match=r"worlds must be a bool .* got int64"):
        batch.reset(generators(), np.arange(WORLDS))
    with pytest.raises(ValueError, match=r"moving must be .* \(5,\), .* \(4,\)"):
        batch.step(np.zeros((WORLDS, 2)), np.ones(4, dtype=bool))
    with pytest.raises(ValueError, match=r"generators must be 5.* got 4"):
        batch.reset(generators(4))
    before = batch.poses.copy()
    with pytest.raises(ValueError, match=r"generators must be 5.* got 4"):
        batch.step(np.ones((WORLDS, 2)), np.arange(WORLDS) > 0, generators(4))
    np.testing.assert_array_equal(batch.poses, before)
    with pytest.raises(ValueError, match="count must be >= 1, got 0"):
        WorldBatch(ROAMING, 0)
