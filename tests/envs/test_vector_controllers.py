"""Controllers of many robots against single ones, bit for bit."""

import numpy as np
import pytest
from presets import PRESETS

from slamgym.envs import LandmarkWorldEnv
from slamgym.envs.controllers import (
    CONTROLLERS,
    OpenLoop,
    VectorOpenLoop,
    VectorWaypoints,
    Waypoints,
    make_controller,
    make_vector_controller,
)
from slamgym.sim_configs import Robot, load_scenario


def generators(count):
    return [np.random.default_rng([seed, 1]) for seed in range(count)]


def one_by_one(singles, poses, step):
    pairs = zip(singles, poses, strict=True)
    return [single.act(pose, step).tolist() for single, pose in pairs]


@pytest.mark.parametrize("name", CONTROLLERS)
@pytest.mark.parametrize("preset", PRESETS)
def test_every_robot_drives_as_with_a_controller_of_its_own(preset, name):
    scenario = load_scenario(preset).with_changes(steps=60)
    envs = [LandmarkWorldEnv(scenario) for _ in range(3)]
    poses = [env.reset(seed=seed)[1]["pose"] for seed, env in enumerate(envs)]
    singles = [make_controller(name, scenario, rng) for rng in generators(3)]
    batch = make_vector_controller(name, [scenario] * 3, generators(3))
    for step in range(scenario.steps):
        actions = batch.act(poses, step)
        assert actions.tolist() == one_by_one(singles, poses, step)
        poses = [envs[k].step(actions[k])[-1]["pose"] for k in range(3)]


@pytest.mark.parametrize("name", CONTROLLERS)
def test_worlds_may_differ_in_start_and_limits(name):
    base = load_scenario("loop").with_changes(steps=200)
    starts = ([0.0, 0.0, 0.0], [5.0, -2.0, 3.0], [1.0, 1.0, -1.0])
    scenarios = [
        base.with_changes(start={"pose": pose}, robot={"max_speed": 1.0 + k})
        for k, pose in enumerate(starts)
    ]
    rngs = generators(3)
    singles = [make_controller(name, scenarios[k], rngs[k]) for k in range(3)]
    batch = make_vector_controller(name, scenarios, generators(3))
    poses = np.array(starts)
    rng = np.random.default_rng(5)
    for step in range(200):
        actions = batch.act(poses, step)
        assert actions.tolist() == one_by_one(singles, poses, step)
        poses = poses + rng.normal(0.0, 0.5, (3, 3))  # anywhere: corners, far away


def test_waypoints_that_loop_and_that_end_go_side_by_side():
    points = [(1.0, 0.0), (1.0, 1.0), (1.05, 1.0)]
    made = [
        lambda loop=loop: Waypoints(points, Robot(), dt=0.5, tolerance=0.2, loop=loop)
        for loop in (True, False)
    ]
    singles, batch = [make() for make in made], VectorWaypoints([m() for m in made])
    rng, ended = np.random.default_rng(0), 0
    for step in range(300):
        poses = np.column_stack([rng.uniform(-0.3, 1.5, (2, 2)), rng.uniform(-4, 4, 2)])
        actions = batch.act(poses, step)
        assert actions.tolist() == one_by_one(singles, poses, step)
        ended += not actions[1].any()
    assert ended > 100


def test_a_waypoint_just_within_tolerance_counts_as_reached():
    points, pose = [(1.0, 0.0), (0.0, 0.0)], (0.5, 0.0, 0.0)
    driver, batched = (
        Waypoints(points, Robot(), dt=1.0, tolerance=0.5) for _ in range(2)
    )
    batch = VectorWaypoints([batched])
    assert batch.act([pose], 0).tolist() == one_by_one([driver], [pose], 0)


def test_step_zero_starts_anew():
    points = [(1.0, 0.0), (0.0, 0.0)]
    batch = VectorWaypoints([Waypoints(points, Robot(), dt=1.0, tolerance=0.1)])
    first = batch.act([(0.0, 0.0, 0.0)], 0)
    batch.act([(1.0, 0.0, 0.0)], 1)
    assert batch.act([(0.0, 0.0, 0.0)], 0).tolist() == first.tolist() == [[1.0, 0.0]]


def test_actions_handed_out_are_not_touched_again():
    batch = VectorOpenLoop([OpenLoop([(1.0, 0.0), (0.5, 0.1)], Robot())])
    actions = batch.act([(0.0, 0.0, 0.0)], 0)
    actions[:] = 7.0
    assert batch.act([(0.0, 0.0, 0.0)], 0).tolist() == [[1.0, 0.0]]


def test_wrong_poses_and_names_are_named():
    scenario = load_scenario("loop")
    batch = make_vector_controller("waypoints", [scenario] * 2, generators(2))
    with pytest.raises(ValueError, match=r"poses must be finite.* each of 2 robots"):
        batch.act(np.zeros((3, 3)), 0)
    with pytest.raises(ValueError, match="poses must be finite"):
        batch.act([(0.0, 0.0, np.nan), (0.0, 0.0, 0.0)], 0)
    with pytest.raises(ValueError, match="did you mean 'waypoints'"):
        make_vector_controller("waypoint", [scenario], generators(1))
    for count, rngs in (1, 2), (0, 0):
        message = f"equally many, at least 1, got {count} and {rngs}"
        with pytest.raises(ValueError, match=message):
            make_vector_controller("random", [scenario] * count, generators(rngs))
