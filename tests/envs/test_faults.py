"""Faults of the world, held against the same world without them."""

import numpy as np
import pytest
from gymnasium.utils import seeding
from scipy.stats import norm, t

from slamgym.envs import LandmarkWorldEnv
from slamgym.envs.noise_streams import heavy_tails, largest_noise
from slamgym.envs.spaces import clipped_action
from slamgym.envs.vector import WorldBatch
from slamgym.sim_configs import action_sequence, load_scenario, place_landmarks

BASE = load_scenario("six_landmarks")
ENCODERS = {"noise_in": "odometry", "std": [0.05, 0.0, 0.04]}


def episode(scenario, seed=3):
    """Odometry, readings and true poses of one drive, over its steps."""
    env = LandmarkWorldEnv(scenario)
    moments = [env.reset(seed=seed)]
    moments += [env.step(a)[::4] for a in action_sequence(scenario)]
    return (
        np.array([observation["odometry"] for observation, _ in moments]),
        np.array([observation["landmarks"] for observation, _ in moments]),
        np.array([info["pose"] for _, info in moments]),
    )


def gap(faults, scenario=BASE):
    """Faulty minus faultless drive of the same seed."""
    faulty = episode(scenario.with_changes(faults=faults))
    return [a - b for a, b in zip(faulty, episode(scenario), strict=True)]


def test_a_scenario_without_the_table_equals_one_with_an_empty_table():
    assert all((difference == 0).all() for difference in gap({}))


@pytest.mark.parametrize("motion", [{}, ENCODERS])
def test_odometry_faults_change_nothing_but_the_odometry_of_steps_that_move(motion):
    scenario = BASE.with_changes(motion=motion)
    faults = {"odometry_scale": 0.1, "odometry_turn": 0.02}
    odometry, readings, poses = gap(faults, scenario)
    driven = action_sequence(scenario)[:, 0] * scenario.dt
    assert odometry[1:, 0] == pytest.approx(0.1 * driven)
    assert odometry[1:, 1] == pytest.approx(0.02)
    assert (odometry[0] == 0).all()
    assert not readings.any()
    assert not poses.any()


def test_a_robot_at_rest_reads_no_fault():
    resting = BASE.with_changes(faults={"odometry_scale": 0.1, "odometry_turn": 0.02})
    env, worlds = LandmarkWorldEnv(resting), WorldBatch(resting, 1)
    env.reset(seed=0)
    worlds.reset([seeding.np_random(0)[0]])
    worlds.step([[0.0, 0.0]])
    odometry = env.step([0.0, 0.0])[0]["odometry"], *worlds.odometry
    np.testing.assert_array_equal(odometry, 0.0)


@pytest.mark.parametrize("bias", [(0.1, -0.2), (0.1, 0.0), (0.0, -0.2)])
def test_a_biased_sensor_adds_to_every_reading_and_moves_no_robot(bias):
    odometry, readings, poses = gap(
        dict(zip(("bearing_bias", "range_bias"), bias, strict=True))
    )
    wrapped = (readings[..., 0] + np.pi) % (2 * np.pi) - np.pi
    assert wrapped == pytest.approx(bias[0])
    assert readings[..., 1] == pytest.approx(bias[1])
    assert not odometry.any()
    assert not poses.any()


def test_a_negative_bias_never_gives_a_range_below_zero():
    near = BASE.with_changes(
        sensor={"min_range": 0.0}, landmarks={"layout": "points", "points": [[3, 0.1]]}
    )
    worlds = WorldBatch(near.with_changes(faults={"range_bias": -0.3}), 50)
    worlds.reset([seeding.np_random(seed)[0] for seed in range(50)])
    worlds.step(np.tile([1.0, 0.0], (50, 1)))
    assert 0 < worlds.mask.sum() < 50
    assert (worlds.measurements[worlds.mask][:, 1] > 0).all()


@pytest.mark.parametrize("dof", [2.5, 3.0, 30.0])
def test_heavy_tails_have_the_quantiles_of_students_t(dof):
    shares = np.array([1e-12, 0.01, 0.3, 0.5, 0.9, 0.999])
    tails = heavy_tails(norm.ppf(shares), dof)
    assert tails == pytest.approx(t.ppf(shares, dof), rel=1e-6, abs=1e-12)
    assert heavy_tails(-norm.ppf(shares), dof).tolist() == (-tails).tolist()


def test_heavy_tails_reach_motion_and_sensor_separately():
    odometry, readings, poses = gap({"motion_dof": 3})
    assert poses.any()
    assert not odometry.any()
    assert readings.any()  # from other poses
    odometry, readings, poses = gap({"sensor_dof": 3})
    assert readings.any()
    assert not poses.any()


def test_faulty_observations_stay_within_the_observation_space():
    faults = {"range_bias": 3.0, "odometry_turn": 0.3, "odometry_scale": 0.5}
    scenario = BASE.with_changes(
        faults=faults | {"sensor_dof": 2.1, "motion_dof": 2.1}, sensor={"max_range": 9}
    )
    env = LandmarkWorldEnv(scenario)
    env.reset(seed=0)
    for _ in range(29):
        assert env.observation_space.contains(env.step([1.0, 1.0])[0])
    assert np.isfinite(largest_noise(2.1))


RANGES = {"start_x": [1.0, 2.0], "start_y": [-3.0, -2.5], "landmark_shift": 0.5}


@pytest.mark.parametrize("noise_in", ["motion", "odometry"])
@pytest.mark.parametrize("kind", ["bearing_range", "range", "position", "bearing"])
@pytest.mark.parametrize("reach", [9.0, None])
def test_observation_bounds_follow_from_the_largest_errors(noise_in, kind, reach):
    ranges = {  # those of one kind lack an end
        name: ends
        for name, ends in RANGES.items()
        if (kind, name) not in (("position", "start_x"), ("bearing_range", "start_y"))
    }
    stds = {"bearing_range": [0.2, 0.3], "position": [0.4, 0.3]}.get(kind, [0.3, 0])
    is_of_range = kind in ("bearing_range", "range")
    bias = 0.7 if is_of_range else 0.0
    world = BASE.with_changes(
        start={"pose": [1.0, -2.0, 0.3], "std": [0.3, 0.4, 0.1]},
        motion={"std": [0.03, 0.04, 0.02], "noise_in": "motion"},
        sensor={"kind": kind, "std": stds, "max_range": reach or np.inf},
        faults={"odometry_scale": 0.1, "odometry_turn": -0.02, "range_bias": bias},
        randomise=None if kind == "range" else ranges,
        robot={"max_speed": 1.5, "max_turn_rate": 0.7},
    )
    if noise_in == "odometry":
        world = world.with_changes(
            motion={"std": [0.03, 0, 0.02], "noise_in": noise_in}
        )
    growth = 0.1 * (kind == "bearing_range")
    world = world.with_changes(sensor={"range_std_per_metre": growth})
    robot, dt, largest = world.robot, world.dt, largest_noise(np.inf)
    start = [2.0 if "start_x" in ranges else 1.0, -2.5 if "start_y" in ranges else -2.0]
    widths = "start_x" in ranges, 0.5 * ("start_y" in ranges)
    moved = np.hypot(*widths) + np.sqrt(2) * 0.5  # the largest
    if kind == "range":
        start, moved = [1.0, -2.0], 0.0
    away = place_landmarks(BASE.landmarks, None) - start
    step = robot.max_speed * dt + largest * 0.05 * (noise_in == "motion")
    drive = largest * 0.5 + world.steps * step
    farthest = np.hypot(*away.T).max() + drive + moved
    far = reach or farthest
    far += largest * ((0.4 if kind == "position" else 0.3) + growth * far) + bias
    space = LandmarkWorldEnv(world).observation_space
    ends = {
        "bearing_range": [(-np.pi, np.pi), (0, far)],
        "range": [(0, far), (0, 1)],
        "position": [(-far, far), (-far, far)],
        "bearing": [(-np.pi, np.pi), (0, 1)],
    }[kind]
    for column, (low, high) in enumerate(ends):
        assert space["landmarks"].low[:, column] == pytest.approx(low)
        assert space["landmarks"].high[:, column] == pytest.approx(high)
    errs = largest * (noise_in == "odometry")
    odometry = (
        1.1 * robot.max_speed * dt + errs * 0.03,
        robot.max_turn_rate * dt + 0.02 + errs * 0.02,
    )
    assert space["odometry"].high == pytest.approx(odometry)
    assert space["odometry"].low == pytest.approx(np.negative(odometry))


def test_a_reference_point_beside_the_axle_moves_with_the_turns():
    free = {"sensor": {"max_range": np.inf}, "robot": {"reference": [0.3, 0.4]}}
    world = load_scenario("bicycle").with_changes(**free)
    ranges = [
        LandmarkWorldEnv(each).observation_space["landmarks"].high[0, 1]
        for each in (world, world.with_changes(robot={"reference": None}))
    ]
    robot, noise = world.robot, 1 + 10 * world.sensor.range_std_per_metre
    lever = 0.5 * robot.max_turn_rate * world.dt * world.steps
    assert ranges[0] - ranges[1] == pytest.approx(lever * noise)


@pytest.mark.parametrize("drive", ["differential", "bicycle"])
def test_the_largest_odometry_is_that_of_the_drive(drive):
    world = load_scenario(drive)
    distance, turn = (
        getattr(world.robot, name) * world.dt for name in ("max_speed", "max_turn_rate")
    )
    expected = distance, np.pi / 2
    if drive == "differential":
        expected = (distance + turn * world.robot.track_width / 2,) * 2
    space = LandmarkWorldEnv(world).observation_space["odometry"]
    assert space.high == pytest.approx(expected)


@pytest.mark.parametrize(
    ("action", "clipped"),
    [
        ((3.0, -5.0), (2.0, -0.5)),
        ((-3.0, 5.0), (-2.0, 0.5)),
        ((1.5, -0.4), (1.5, -0.4)),
        ((1.5, 1.5), (1.5, 0.5)),
        ((-2.5, 0.4), (-2.0, 0.4)),
        ((-1.9, -0.6), (-1.9, -0.5)),
    ],
)
def test_each_part_of_an_action_is_clipped_to_its_own_limit(action, clipped):
    assert clipped_action(action, (2.0, 0.5)) == clipped
