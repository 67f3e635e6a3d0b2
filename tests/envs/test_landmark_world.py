import copy
import os
import pickle
import subprocess
import sys
from types import SimpleNamespace

import forked
import numpy as np
import pytest
from gymnasium.error import ResetNeeded
from numpy_streams import first_key, normals, philox
from worlds import RANDOM_MAP

from slamgym.envs import LandmarkWorldEnv
from slamgym.sim_configs import (
    ScenarioError,
    action_sequence,
    load_scenario,
    place_landmarks,
)

DIFFERENTIAL = {
    "robot": {"drive": "differential", "track_width": 0.5},
    "motion": {"noise_in": "motion"},
}
WALLS = [[5.0, -2.0, 5.0, 2.0], [-4.0, 4.0, 9.0, 4.5]]
ROAMING = {
    "dt": 0.5,
    "steps": 1000,
    "motion": {"std": [0.05, 0.03, 0.04]},
    "landmarks": RANDOM_MAP,
    "controls": {"sequence": "circle", "radius": 3.0, "speed": 0.8},
}


def make(**changes):
    return LandmarkWorldEnv("six_landmarks", **{**ROAMING, **changes})


def actions(count, seed=0):
    return np.random.default_rng(seed).uniform((0.0, -1.0), (1.0, 1.0), (count, 2))


def episode(env, count=100, seed=7):
    """Observations and infos of one episode, the reset's first."""
    moments = [env.reset(seed=seed)]
    for action in actions(count):
        observation, _, _, _, info = env.step(action)
        moments.append((observation, info))
    return moments


def noise_of(seed, name, count, steps=(0,)):
    """The numbers of one noise source, made without the environment, row by step."""
    key = first_key(seed)
    return np.array([normals(key, name, count, step) for step in steps])


def assert_same(moments, others):
    for (observation, info), (other, other_info) in zip(moments, others, strict=True):
        for key in observation:
            np.testing.assert_array_equal(observation[key], other[key])
        for key in info:
            np.testing.assert_array_equal(info[key], other_info[key])


def poses(moments):
    return np.array([info["pose"] for _, info in moments])


def readings(moments):
    return np.array([observation["landmarks"] for observation, _ in moments])


def masks(moments):
    return np.array([observation["mask"] for observation, _ in moments])


def odometry(moments):
    return np.array([observation["odometry"] for observation, _ in moments[1:]])


def true_readings(env, moments):
    """Bearings as unit complex numbers, and ranges, by trigonometry."""
    x, y, theta = poses(moments).T[..., None]
    lx, ly = env.landmarks.T
    bearings = np.arctan2(ly - y, lx - x) - theta
    return np.exp(1j * bearings), np.hypot(lx - x, ly - y)


# --- one step ---


def test_the_path_is_the_turn_last_model_with_the_motion_stream_to_the_last_bit():
    env = make()
    moments = episode(env, count=500, seed=3)
    noise = noise_of(3, "motion", 3, range(1, 501)) * env.scenario.motion.std
    x, y, theta = moments[0][1]["pose"].tolist()
    for (v, w), (ex, ey, ea), (_, info) in zip(
        actions(500).tolist(), noise.tolist(), moments[1:], strict=True
    ):
        cos, sin = np.cos(theta), np.sin(theta)
        d, alpha = v * 0.5, w * 0.5
        x += (d + ex) * cos - ey * sin
        y += (d + ex) * sin + ey * cos
        theta += alpha + ea
        assert info["pose"].tolist() == [x, y, theta]


def test_every_moment_is_measured_from_its_own_pose_also_the_first():
    env = make(sensor={"std": [0.0, 0.0]})
    moments = episode(env)
    directions, ranges = true_readings(env, moments)
    seen = masks(moments)
    assert seen.mean() > 0.99
    gaps = np.abs(np.exp(1j * readings(moments)[..., 0]) - directions)
    assert gaps[seen].max() < 1e-12
    assert np.abs(readings(moments)[..., 1] - ranges)[seen].max() < 1e-12


def test_sensor_noise_is_the_measurement_stream_step_by_step():
    env = make(sensor={"min_range": 0.0, "std": [0.02, 0.001]})
    moments = episode(env, seed=5)
    noise = noise_of(5, "measurement", 60, range(len(moments))).reshape(-1, 2, 30)
    directions, ranges = true_readings(env, moments)
    seen = masks(moments)
    bearings = directions * np.exp(0.02j * noise[:, 0])
    gaps = np.abs(np.exp(1j * readings(moments)[..., 0]) - bearings)
    assert gaps[seen].max() < 1e-12
    gaps = readings(moments)[..., 1] - (ranges + 0.001 * noise[:, 1])
    assert np.abs(gaps[seen]).max() < 1e-12


def test_at_reset_the_odometry_is_zero():
    assert make().reset(seed=0)[0]["odometry"].tolist() == [0.0, 0.0]


def test_a_slipping_robot_reports_the_command():
    moments = episode(make())
    np.testing.assert_array_equal(odometry(moments), actions(100) * 0.5)


def test_an_obeying_robot_reports_the_command_plus_noise():
    motion = {"std": [0.05, 0.0, 0.04], "noise_in": "odometry"}
    env = make(motion=motion)
    moments = episode(env, seed=3)
    exact = episode(make(motion={"std": [0.0, 0.0, 0.0]}), seed=3)
    np.testing.assert_array_equal(poses(moments), poses(exact))
    noise = noise_of(3, "motion", 3, range(1, 101)) * motion["std"]
    expected = actions(100) * 0.5 + noise[:, [0, 2]]
    np.testing.assert_array_equal(odometry(moments), expected)


@pytest.mark.parametrize("noise_in", ["motion", "odometry"])
def test_a_robot_told_to_rest_has_noise_only_if_asked_for(noise_in):
    for noisy in (True, False):
        motion = {"noise_in": noise_in, "noise_at_rest": noisy, "std": [0.1, 0.0, 0.1]}
        env = make(motion=motion)
        _, before = env.reset(seed=0)
        observation, *_, after = env.step([0.0, 0.0])
        stands = (before["pose"] == after["pose"]).all()
        silent = (observation["odometry"] == 0.0).all()
        assert (stands and silent) != noisy
        observation, *_, moved = env.step([0.0, 0.5])
        turn = moved["pose"][2] - after["pose"][2] - observation["odometry"][1]
        assert abs(turn) > 1e-6


def test_a_wall_stalls_the_wheels_and_not_the_turn():
    still = {"std": [0.0, 0.0, 0.0]}
    env = make(walls=WALLS, dt=3.0, motion=still, start=still)
    assert env.reset(seed=0)[1]["collision"] is False
    observation, *_, info = env.step([1.0, 0.0])
    assert info["collision"] is False
    observation, *_, info = env.step([1.0, 0.5])
    x, _, theta = info["pose"]
    assert info["collision"] is True
    assert x == pytest.approx(5.0 - 0.2 - 1e-6)
    np.testing.assert_allclose(observation["odometry"], [x - 3.0, 1.5], rtol=1e-12)
    assert theta == 1.5


def test_an_episode_is_truncated_after_its_steps_and_never_terminated():
    env = make(steps=5)
    for _ in range(2):
        env.reset(seed=0)
        ends = [env.step([1.0, 0.0])[1:4] for _ in range(5)]
        assert ends == [(0.0, False, False)] * 4 + [(0.0, False, True)]
        assert all(type(flag) is bool for end in ends for flag in end[1:])


# --- actions ---


@pytest.mark.parametrize("wild", [[50.0, -1e300], [-1.001, 2.0]])
def test_actions_beyond_the_limits_are_clipped(wild):
    env = make(robot={"max_turn_rate": 0.5})
    env.reset(seed=0)
    limits = env.action_space.high
    assert limits.tolist() == [1.0, 0.5]
    expected = np.sign(wild) * limits * 0.5
    np.testing.assert_array_equal(env.step(wild)[0]["odometry"], expected)


def test_double_precision_actions_keep_their_precision():
    env = make()
    env.reset(seed=0)
    speed = 0.1 + 1e-12
    assert env.step(np.array([speed, 0.0]))[0]["odometry"][0] == speed * 0.5


@pytest.mark.parametrize(
    "action",
    [
        [np.nan, 0.0], [0.0, np.inf], [0.0, -np.inf], [0.5], [0.1, 0.2, 0.3],
        [[0.1, 0.2]], 0.5, None, "ab", ["0.1", "0.2"], [True, False], [1j, 0.0],
        [[0.1], [0.2, 0.3]], [None, 0.1], {"v": 1.0}, [10**400, 0],
        np.ma.array([0.1, 0.2], mask=[True, False]),
    ],
    ids=repr,
)  # fmt: skip
def test_what_is_not_two_finite_numbers_is_refused_and_changes_nothing(action):
    env, twin = make(), make()
    episode(env, count=5)
    episode(twin, count=5)
    with pytest.raises(ValueError, match=r"action must be 2 finite numbers .*, got "):
        env.step(action)
    np.testing.assert_array_equal(env.pose, twin.pose)
    moment, expected = env.step([0.3, 0.2]), twin.step([0.3, 0.2])
    assert_same([moment[::4]], [expected[::4]])


@pytest.mark.parametrize("dtype", ["float32", "float16", "int64", "uint8"])
def test_actions_of_every_real_type_give_the_same_observations(dtype):
    env = make()
    env.reset(seed=0)
    observation = env.step(np.array([1, 0], dtype=dtype))[0]
    assert observation["odometry"].tolist() == [0.5, 0.0]
    assert observation in env.observation_space


# --- seeds and streams ---


def test_the_same_seed_gives_the_same_episode_and_the_one_after():
    env, other = make(), make()
    first, second = episode(env, seed=3), episode(env, seed=None)
    assert_same(first, episode(other, seed=3))
    assert_same(second, episode(other, seed=None))
    assert (poses(first) != poses(second)).any()
    assert (poses(first) != poses(episode(env, seed=4))).any()


@pytest.mark.parametrize(
    "sensor",
    [
        {"max_range": 4.0}, {"field_of_view": 2.0}, {"occlusion": True},
        {"dropout": 0.3}, {"min_range": 2.0},
    ],
    ids=repr,
)  # fmt: skip
def test_what_is_still_seen_reads_the_same_whatever_else_is_not(sensor):
    all_seen, some = (
        episode(make(walls=WALLS, sensor=settings)) for settings in ({}, sensor)
    )
    np.testing.assert_array_equal(poses(all_seen), poses(some))
    seen = masks(some)
    assert 0.03 < seen.mean() < masks(all_seen).mean()
    assert masks(all_seen)[seen].all()
    np.testing.assert_array_equal(readings(some)[seen], readings(all_seen)[seen])


def test_ten_times_the_sensor_noise_leaves_the_path_unchanged():
    std = load_scenario("six_landmarks").sensor.std
    quiet, loud = (
        episode(make(sensor={"std": [k * std[0], k * std[1]]})) for k in (1, 10)
    )
    np.testing.assert_array_equal(poses(quiet), poses(loud))
    assert (readings(quiet) != readings(loud)).any(axis=-1).mean() > 0.98


def test_ten_times_the_motion_noise_leaves_the_sensor_noise_unchanged():
    errors = []
    for scale in (0.1, 1.0):
        env = make(motion={"std": [scale * 0.05] * 3}, sensor={"std": [0.01, 0.01]})
        moments = episode(env)
        directions, ranges = true_readings(env, moments)
        bearings = np.angle(np.exp(1j * readings(moments)[..., 0]) / directions)
        errors.append(np.stack([bearings, readings(moments)[..., 1] - ranges], axis=-1))
        errors[-1][~masks(moments)] = np.nan
    gaps = np.abs(errors[0] - errors[1])
    assert np.nanmax(gaps) < 1e-11
    assert np.isnan(gaps).mean() < 0.01


@pytest.mark.parametrize("drawn", ["truth", "estimate"])
def test_the_start_stream_draws_the_truth_or_the_estimate_around_the_other(drawn):
    env = make(start={"pose": [1, 2, 3], "std": [0.1, 0.2, 0.3], "drawn": drawn})
    _, info = env.reset(seed=4)
    random, given = info["pose"], env.start_estimate
    if drawn == "estimate":
        random, given = given, random
    np.testing.assert_array_equal(
        random, [1, 2, 3] + noise_of(4, "start", 3)[0] * [0.1, 0.2, 0.3]
    )
    assert given.tolist() == [1, 2, 3]


def test_a_random_map_is_thrown_from_the_map_stream():
    env = make(landmarks={**RANDOM_MAP, "min_distance": 2.0})
    env.reset(seed=6)
    rng = np.random.Generator(philox(first_key(6), "map"))
    thrown = place_landmarks(env.scenario.landmarks, rng)
    np.testing.assert_array_equal(env.landmarks, thrown)


def test_a_random_map_without_room_is_refused():
    env = make(landmarks={**RANDOM_MAP, "count": 90, "min_distance": 3.0})
    with pytest.raises(ScenarioError, match=r"min_distance must leave room for 90 .*"):
        env.reset(seed=0)


def test_restoring_the_generator_reproduces_the_next_episodes():
    env = make()
    env.reset(seed=2)
    before = env.np_random.bit_generator.state
    episodes = [episode(env, count=5, seed=None) for _ in range(2)]
    env.np_random.bit_generator.state = before
    for moments in episodes:
        assert_same(moments, episode(env, count=5, seed=None))


def test_a_random_map_is_new_in_every_episode_unless_it_has_a_seed():
    fixed = make(landmarks={**RANDOM_MAP, "seed": 1})
    new = make()
    maps = {id(env): [] for env in (fixed, new)}
    for env in (fixed, new):
        for seed in (0, None, 1, 0):
            env.reset(seed=seed)
            maps[id(env)].append(env.landmarks.tolist())
    assert len({str(m) for m in maps[id(fixed)]}) == 1
    assert len({str(m) for m in maps[id(new)]}) == 3
    assert maps[id(new)][0] == maps[id(new)][3]
    assert np.abs(maps[id(new)]).max() <= 9.0


def test_a_map_drawn_anew_does_not_change_path_or_noise():
    drawn = make(sensor={"std": [0.0, 0.0]})
    moments = episode(drawn)
    points = {"layout": "points", "points": drawn.landmarks.tolist()}
    assert_same(moments, episode(make(landmarks=points, sensor={"std": [0.0, 0.0]})))


@pytest.mark.slow
def test_episodes_are_the_same_in_every_process():
    code = (
        "import hashlib, numpy as np\n"
        "from slamgym.envs import LandmarkWorldEnv\n"
        "from slamgym.sim_configs import action_sequence, load_scenario\n"
        "digest = hashlib.sha256()\n"
        "for name in ('hidden_identities', 'corridor'):\n"
        "    env = LandmarkWorldEnv(name)\n"
        "    env.reset(seed=3)\n"
        "    for action in action_sequence(env.scenario):\n"
        "        observation, *_, info = env.step(action)\n"
        "        for array in (*observation.values(), info['pose']):\n"
        "            digest.update(array.tobytes())\n"
        "print(digest.hexdigest())\n"
    )
    other = subprocess.run(
        [sys.executable, "-c", code],
        stdout=subprocess.PIPE,
        env={**os.environ, "PYTHONHASHSEED": "1"},
        check=True,
        text=True,
    )
    assert other.stdout == forked.run(code).stdout
    assert len(other.stdout) == 65


# --- hidden identities ---


def test_hidden_identities_are_told_in_info_alone():
    env = LandmarkWorldEnv("hidden_identities")
    moments = [env.reset(seed=2)]
    for action in action_sequence(env.scenario):
        observation, *_, info = env.step(action)
        moments.append((observation, info))
    shown, false = 0, 0
    directions, ranges = true_readings(env, moments)
    for k, (observation, info) in enumerate(moments):
        ids, mask = info["landmark_ids"], observation["mask"]
        assert ids.shape == mask.shape == (26,)
        assert ids.dtype == np.int64
        real = ids >= 0
        assert (mask[real]).all()
        bearings, distances = observation["landmarks"][real].T
        assert np.abs(np.exp(1j * bearings) - directions[k, ids[real]]).max() < 0.06
        assert np.abs(distances - ranges[k, ids[real]]).max() < 0.3
        shown, false = shown + real.sum(), false + (mask & ~real).sum()
    assert shown > 5 * len(moments)
    assert false == pytest.approx(len(moments), rel=0.2)


def test_known_identities_are_not_repeated_in_info():
    assert set(make().reset(seed=0)[1]) == {"pose", "collision"}


# --- copies ---


@pytest.mark.parametrize(
    "duplicate", [copy.deepcopy, lambda env: pickle.loads(pickle.dumps(env))]
)
@pytest.mark.parametrize("render_mode", [None, "rgb_array"])
def test_a_copied_environment_continues_alike(duplicate, render_mode):
    settings = {"walls": WALLS, "landmarks": RANDOM_MAP, **DIFFERENTIAL}
    env = LandmarkWorldEnv("hidden_identities", render_mode=render_mode, **settings)
    episode(env, count=150)
    if render_mode:
        env.render()
    twin = duplicate(env)
    for action in actions(60, seed=1):
        a, b = env.step(action), twin.step(action)
        assert_same([a[::4]], [b[::4]])
    if render_mode:
        assert twin.render().shape == env.render().shape  # views may differ in zoom
    assert_same([env.reset()], [twin.reset()])
    assert (env.landmarks == twin.landmarks).all()


def test_what_is_handed_out_can_be_changed_without_harm():
    env, twin = make(), make()
    for action in (None, *actions(20)):
        (observation, info), expected = (
            each.reset(seed=0) if action is None else each.step(action)[::4]
            for each in (env, twin)
        )
        assert_same([(observation, info)], [expected])
        np.testing.assert_array_equal(env.landmarks, twin.landmarks)
        np.testing.assert_array_equal(env.start_estimate, twin.start_estimate)
        for array in (*observation.values(), info["pose"]):
            array[...] = 1
        for array in (env.pose, env.landmarks, env.start_estimate):
            array[...] = 1


# --- errors ---


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"sensr": {"max_range": 4.0}}, r"unknown key 'sensr'.*'sensor'"),
        ({"scenari": "loop"}, "did you mean 'scenario'"),
        ({"sensor": {"max_rage": 4.0}}, r"'max_rage' in sensor.*'max_range'"),
        ({"render_mode": "ascii"}, r"render_mode must be .*, got 'ascii'"),
    ],
)
def test_wrong_settings_are_refused_by_name(changes, message):
    error = ValueError if "render_mode" in changes else ScenarioError
    with pytest.raises(error, match=message):
        make(**changes)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"pse": 1}, r"options may hold pose, .*, got 'pse'; did you mean 'pose'"),
        ({"pose": (0, 1)}, r"\['pose'\] must be finite numbers of shape \(3,\), got"),
        ({1: 2}, "options may hold pose, landmarks, scenario, got 1"),
        ("pose", "options must be a dict, got 'pose'"),
        ({"pose": "here"}, r"\['pose'\] must be finite numbers .*, got 'here'"),
        ({"pose": ("0", "1", "2")}, r"\['pose'\] must be finite numbers"),
        ({"pose": (True, False, True)}, r"\['pose'\] must be finite numbers"),
        ({"pose": (np.nan, 0, 0)}, r"\['pose'\] must be finite"),
        ({"pose": (9e4, 0, 0)}, "keep 'landmarks' in the observation space, up to"),
        ({"landmarks": [[1, 2]]}, r"\['landmarks'\] must be .* of shape \(30, 2\)"),
        ({"scenario": "nowhere"}, "scenario must be a preset"),
        ({"scenario": "loop"}, r"\['scenario'\] must have dt = 0.5, as the env.* 1.0"),
        (
            {"scenario": make(sensor={"std": (0.1, 900.0)}).scenario},
            "keep 'landmarks' in the observation space",
        ),
    ],
)
def test_wrong_options_are_refused_and_leave_the_episode_alone(options, message):
    env, twin = make(), make()
    episode(env, count=3)
    episode(twin, count=3)
    with pytest.raises(ValueError, match=message):
        env.reset(seed=9, options=options)
    assert_same([env.step([1, 0])[::4]], [twin.step([1, 0])[::4]])
    assert_same(episode(env, seed=None), episode(twin, seed=None))


def test_a_start_is_allowed_as_far_as_its_readings_fit_the_observation_space():
    world = load_scenario("six_landmarks").with_changes(start={"pose": (1.0, 2.0, 0.0)})
    env = LandmarkWorldEnv(world)
    places = place_landmarks(world.landmarks, np.random.default_rng(0))
    longest = env.observation_space["landmarks"].high[0, 1]
    least, most = 0.0, 1000.0  # to the left of the map
    for _ in range(50):
        middle = (least + most) / 2
        reach = np.hypot(*(places - [-middle, 2.0]).T).max() + 10 * world.sensor.std[1]
        least, most = (middle, most) if reach < longest else (least, middle)
    env.reset(options={"pose": (-least + 0.01, 2.0, 0.0)})
    with pytest.raises(ValueError, match="keep 'landmarks' in the observation space"):
        env.reset(options={"pose": (-least - 0.01, 2.0, 0.0)})


def test_an_option_of_reset_equals_the_setting_for_one_episode():
    places = np.random.default_rng(1).uniform(-8, 8, (30, 2))
    walled = load_scenario("six_landmarks").with_changes(**ROAMING, walls=WALLS)
    start = {"start": {"pose": (1.0, 2.0, 0.5), "std": (0.1, 0.1, 0.1)}}
    points = {"landmarks": {"layout": "points", "points": places}}
    for options, changes in (
        ({"pose": np.array([1.0, 2.0, 0.5])}, start),
        ({"landmarks": places}, points),
        ({"scenario": walled.with_changes(sensor={"dropout": 0.3})},
         {"walls": WALLS, "sensor": {"dropout": 0.3}}),
        ({"scenario": walled, "landmarks": places}, {"walls": WALLS, **points}),
    ):  # fmt: skip
        own = {"start": {"std": (0.1, 0.1, 0.1)}} if "pose" in options else {}
        env, twin = make(**own), make(**{**own, **changes})
        assert_same(episode(env, 5), episode(make(**own), 5))
        moments = [env.reset(seed=7, options=options)]
        moments += [env.step(action)[::4] for action in actions(100)]
        assert_same(moments, episode(twin))
        assert_same(episode(env), episode(make(**own)))  # the next one is as before


def test_options_of_reset_replace_what_ranges_draw():
    env = make(randomise={"start_x": (-5.0, -4.0), "landmark_shift": 0.5},
               landmarks={"layout": "points", "points": [(2.0, 1.0), (3.0, 0.0)]},
               start={"std": (0.0, 0.0, 0.0)})  # fmt: skip
    _, info = env.reset(seed=1, options={"pose": (1, 0, 0), "landmarks": np.eye(2)})
    assert info["pose"].tolist() == [1, 0, 0]
    assert env.landmarks.tolist() == np.eye(2).tolist()
    assert -5 <= env.reset()[1]["pose"][0] <= -4


def test_a_state_of_an_episode_with_options_can_be_restored():
    env = make()
    walled = env.scenario.with_changes(walls=WALLS, motion={"std": (0.1, 0.1, 0.0)})
    env.reset(seed=3, options={"scenario": walled, "pose": (0, 0, 0.1)})
    state = env.state()
    ahead = [env.step([1.0, 0.0])[::4] for _ in range(20)]
    assert any(info["collision"] for _, info in ahead)
    env.reset()
    env.restore(state)
    assert_same([env.step([1.0, 0.0])[::4] for _ in range(20)], ahead)


def test_a_frame_shows_the_walls_of_the_option():
    walled = load_scenario("six_landmarks").with_changes(**ROAMING, walls=WALLS)
    env, twin = (make(render_mode="rgb_array", **w) for w in ({}, {"walls": WALLS}))
    env.reset(seed=3)
    before = env.render()
    env.reset(seed=3, options={"scenario": walled})
    twin.reset(seed=3)
    np.testing.assert_array_equal(env.render(), twin.render())
    env.reset(seed=3)
    np.testing.assert_array_equal(env.render(), before)


@pytest.mark.parametrize(
    "use",
    [
        lambda env: env.step([0.0, 0.0]), lambda env: env.render(),
        lambda env: env.pose, lambda env: env.landmarks,
        lambda env: env.start_estimate, lambda env: env.state(),
        lambda env: env.restore(()), lambda env: env.drawn_scenario,
    ],
)  # fmt: skip
def test_nothing_works_before_reset(use):
    env = make(render_mode="rgb_array")
    with pytest.raises(ResetNeeded, match="call reset"):
        use(env)


# --- pictures ---


class Recorder:
    """Stands in for the renderer and keeps what it is asked to draw."""

    made = ()

    def __init__(self, scenario, landmarks, mode, *, fps):
        self.landmarks, self.mode, self.fps = landmarks, mode, fps
        self.snapshots, self.closed = [], False
        Recorder.made += (self,)

    def render(self, snapshot):
        self.snapshots.append(snapshot)

    def close(self):
        self.closed = True


@pytest.fixture
def recorder(monkeypatch):
    monkeypatch.setattr("slamgym.envs.rendering.renderer.WorldRenderer", Recorder)
    monkeypatch.setattr(Recorder, "made", ())
    return Recorder


def test_the_window_shows_every_moment_as_it_is(recorder):
    env = make(render_mode="human", walls=WALLS)
    moments = episode(env, count=30)
    assert env.render() is None
    (view,) = recorder.made
    assert (view.mode, view.fps) == ("human", env.metadata["render_fps"])
    np.testing.assert_array_equal(view.landmarks, env.landmarks)
    assert len(view.snapshots) == len(moments)
    for k, (snapshot, (observation, info)) in enumerate(
        zip(view.snapshots, moments, strict=True)
    ):
        np.testing.assert_array_equal(snapshot.pose, info["pose"])
        np.testing.assert_array_equal(snapshot.path, poses(moments)[: k + 1, :2])
        visible = observation["landmarks"][observation["mask"]]
        np.testing.assert_array_equal(snapshot.measurements, visible)
        assert snapshot.collision == info["collision"]
        assert (snapshot.step, snapshot.time) == (k, k * 0.5)
        assert snapshot.belief is None
    hidden = LandmarkWorldEnv("hidden_identities", render_mode="human")
    observation, info = hidden.reset(seed=2)
    clutter = info["landmark_ids"][observation["mask"]] < 0
    shown = recorder.made[-1].snapshots[0].clutter
    np.testing.assert_array_equal(shown, clutter)


def test_a_belief_is_shown_until_the_episode_ends(recorder):
    env = make(render_mode="human")
    env.reset(seed=0)
    belief = SimpleNamespace()
    make(render_mode="human").show_belief(belief)  # before an episode
    env.show_belief(belief)
    env.step([1.0, 0.0])
    env.reset()
    beliefs = [snapshot.belief for view in recorder.made for snapshot in view.snapshots]
    assert beliefs == [None, belief, belief, None]


def test_a_new_map_gets_a_new_view_and_the_same_map_keeps_it(recorder):
    same = make(render_mode="human", landmarks={**RANDOM_MAP, "seed": 1})
    same.reset(seed=0)
    same.reset()
    same.reset(options={"scenario": same.scenario.with_changes(dt=0.5)})
    assert len(recorder.made) == 1
    new = make(render_mode="human")
    new.reset(seed=0)
    state, places = new.state(), new.landmarks
    new.reset()
    new.restore(state)
    new.step((0.0, 0.0))
    np.testing.assert_array_equal(recorder.made[-1].landmarks, places)
    assert [view.closed for view in recorder.made] == [False, True, True, False]
    new.close()
    new.close()
    assert recorder.made[-1].closed


def test_frames_are_pictures_of_the_present():
    env = make(render_mode="rgb_array")
    env.reset(seed=0)
    before = env.render()
    assert before.dtype == np.uint8
    assert before.shape[2] == 3
    np.testing.assert_array_equal(before, env.render())
    env.step([1.0, 1.0])
    assert (before != env.render()).any()
    env.close()


def test_a_world_without_a_render_mode_warns_and_shows_nothing():
    env = make()
    env.spec = None
    env.reset(seed=0)
    with pytest.warns(UserWarning, match="render shows nothing without a render_mode"):
        assert env.render() is None
    assert env.spec is None


@pytest.mark.slow
def test_worlds_that_are_not_watched_load_no_matplotlib():
    code = f"""{forked.WITHOUT_MATPLOTLIB}
import sys, slamgym, gymnasium
env = gymnasium.make('slamgym/LandmarkWorld-v0')
env.reset(seed=0)
env.step(env.action_space.sample())
print('matplotlib' in sys.modules)
"""
    assert forked.run(code).stdout == "False\n"
