"""Simulated runs, held against single environments driven one by one."""

import numpy as np
import pytest
from presets import KINDS

from slamgym.envs import LandmarkWorldEnv
from slamgym.experiments.run_and_replay.simulated_runs import simulate_runs
from slamgym.sim_configs import action_sequence, load_scenario

SEED = 30
WALLED = load_scenario("corridor").with_changes(
    steps=60, sensor={"occlusion": True, "dropout": 0.1}, start={"drawn": "estimate"}
)
# Its 10,000 landmarks are scanned in blocks.  The drive passes twenty corners, and the
# noise drawn ahead ends after every 8 steps.
CITY = load_scenario("city").with_changes(steps=300)


def one_by_one(scenario, runs, seed):
    """The slow twin: the fields of `SimulatedRuns`, environment after environment."""
    columns = [[], [], [], [], [], []]
    hides = not load_scenario(scenario).sensor.identities
    columns += [[]] if hides else []
    for run in range(runs):
        env = LandmarkWorldEnv(scenario)
        moments = [env.reset(seed=seed + run)]
        for action in action_sequence(env.scenario):
            observation, _, _, _, info = env.step(action)
            moments.append((observation, info))
        rows = (
            [observation["odometry"] for observation, _ in moments],
            [observation["landmarks"] for observation, _ in moments],
            [observation["mask"] for observation, _ in moments],
            [info["pose"] for _, info in moments],
            env.landmarks,
            env.start_estimate,
            *([[info["landmark_ids"] for _, info in moments]] if hides else ()),
        )
        for column, row in zip(columns, rows, strict=True):
            column.append(row)
    return [np.array(column) for column in columns] + [None] * (3 if hides else 4)


@pytest.mark.parametrize(
    "scenario", [*KINDS, WALLED, pytest.param(CITY, marks=pytest.mark.slow)], ids=str
)
def test_runs_are_the_single_worlds_of_their_seeds_to_the_last_bit(scenario):
    fast, slow = simulate_runs(scenario, 3, SEED), one_by_one(scenario, 3, SEED)
    for name, array, other in zip(fast._fields, fast, slow, strict=True):
        if other is None:
            assert array is None
            continue
        assert (array.dtype, array.shape) == (other.dtype, other.shape), name
        assert array.tobytes() == other.tobytes(), name


def test_a_run_depends_on_its_own_seed_alone():
    many, few = simulate_runs("loop", 4, SEED), simulate_runs("loop", 2, SEED + 2)
    for array, other in zip(many[:6], few[:6], strict=True):
        np.testing.assert_array_equal(array[2:], other)


def test_the_first_scan_comes_before_any_motion():
    runs = simulate_runs("six_landmarks", 2, SEED)
    assert runs.dt.tolist() == [0.0] + [1.0] * 29
    assert not runs.odometry[:, 0].any()
    assert runs.measurements[:, 0].any()


def test_hidden_readings_by_their_true_ids_are_those_of_the_same_world_with_ids():
    hidden = load_scenario("hidden_identities").with_changes(steps=40)
    open_ = hidden.with_changes(
        sensor={"identities": True, "clutter": 0.0, "max_clutter": 0}
    )
    stripped, told = (
        simulate_runs(world, 2, SEED, only_read=True) for world in (hidden, open_)
    )
    assert (stripped.true_ids[stripped.visible] == -1).any()
    for array, other in zip(stripped.identified()[:6], told[:6], strict=True):
        np.testing.assert_array_equal(array, other)
    assert told.identified() is told


def test_rows_without_a_reading_can_be_left_out():
    """A short drive through the city reads few of its 10,000 landmarks."""
    world = CITY.with_changes(steps=20)
    all_, few = (simulate_runs(world, 2, SEED, only_read=only) for only in (0, 1))
    read = np.flatnonzero(all_.visible.any(axis=(0, 1)))
    assert 0 < len(read) < 100
    assert few.ids.tolist() == read.tolist()
    assert few.ids_of(np.array([0, 1])) == read[:2].tolist()
    np.testing.assert_array_equal(few.measurements, all_.measurements[:, :, read])
    np.testing.assert_array_equal(few.visible, all_.visible[:, :, read])
    np.testing.assert_array_equal(few.landmarks, all_.landmarks)
    np.testing.assert_array_equal(few.landmarks_of_rows, all_.landmarks[:, read])


def test_no_runs_are_refused():
    with pytest.raises(ValueError, match="runs must be >= 1, got 0"):
        simulate_runs("loop", 0, SEED)
