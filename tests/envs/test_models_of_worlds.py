"""Worlds with other sensors and drives than bearing-range and the unicycle."""

import pickle

import numpy as np
import pytest
from gymnasium.utils import seeding
from gymnasium.utils.env_checker import check_env
from matplotlib.figure import Figure

from slamgym import make_estimator
from slamgym.envs import LandmarkWorldEnv, LandmarkWorldVectorEnv
from slamgym.envs.controllers import Waypoints, make_controller, planned_path
from slamgym.envs.drives import drive_of
from slamgym.envs.rendering.render_state import drawn_readings
from slamgym.envs.rendering.scene import Scene
from slamgym.envs.vector import WorldBatch
from slamgym.estimator.filters.imagine import imagine
from slamgym.estimator.models.motions import find_motion
from slamgym.estimator.models.sensors import find_sensor
from slamgym.sim_configs import ScenarioError, list_presets, load_scenario

LOOP = load_scenario("loop").with_changes(
    motion={"noise_in": "motion", "std": (0.02, 0.01, 0.02)}
)
CAR = {"wheelbase": 0.4, "max_steering": 0.6, "reference": (0.3, 0.1)}
ROBOTS = {
    "unicycle": {},
    "differential": {"drive": "differential", "track_width": 0.4},
    "bicycle": {"drive": "bicycle", **CAR},
}
STDS = {
    "bearing_range": (0.03, 0.1),
    "position": (0.1, 0.2),
    "bearing": (0.03, 0.0),
    "range": (0.1, 0.0),
}
WALLS = [(2, 1, 2, 5), (-3, -1, -3, 6)]


def world(drive, kind, **sensor):
    return LOOP.with_changes(
        robot=ROBOTS[drive],
        sensor={"kind": kind, "std": STDS[kind], "dropout": 0.1, **sensor},
        walls=[] if drive == "bicycle" else WALLS,
    )


def actions(steps, seed=1):
    rng = np.random.default_rng(seed)
    drawn = rng.uniform((0.0, -1.0), 1.0, (steps, 3, 2))
    drawn[::9] = 0.0
    return drawn


@pytest.mark.parametrize("kind", STDS)
@pytest.mark.parametrize("drive", ROBOTS)
def test_a_world_alone_equals_one_among_many_and_its_space_holds_it(drive, kind):
    scenario = world(drive, kind, max_range=12.0, field_of_view=5.0, occlusion=True)
    worlds = WorldBatch(scenario, 3)
    worlds.reset([seeding.np_random(seed)[0] for seed in range(3)])
    envs = [LandmarkWorldEnv(scenario) for _ in range(3)]
    for seed, env in enumerate(envs):
        env.reset(seed=seed)
    for each in actions(60):
        worlds.step(each)
        for k, env in enumerate(envs):
            observation, _, _, _, info = env.step(each[k])
            assert env.observation_space.contains(observation)
            found = observation | {"poses": info["pose"]}
            found["measurements"] = found.pop("landmarks")
            for name, value in found.items():
                np.testing.assert_array_equal(value, getattr(worlds, name)[k])


@pytest.mark.parametrize("drive", ["differential", "bicycle"])
def test_without_noise_the_filters_drive_follows_the_odometry(drive):
    scenario = world(drive, "position").with_changes(motion={"std": (0, 0, 0)})
    motion, env = find_motion(scenario.models["motion"]), LandmarkWorldEnv(scenario)
    _, info = env.reset(seed=0)
    pose = info["pose"]
    for action in actions(80)[:, 0]:
        observation, _, _, _, info = env.step(action)
        dx, dy, turn = motion.displacement(*observation["odometry"])
        cos, sin = np.cos(pose[2]), np.sin(pose[2])
        pose = pose + np.array([cos * dx - sin * dy, sin * dx + cos * dy, turn])
        np.testing.assert_allclose(pose, info["pose"], atol=1e-5)  # walls: 1 µm


@pytest.mark.parametrize("kind", STDS)
def test_without_noise_readings_are_those_of_the_filters_sensor(kind):
    scenario = world("unicycle", kind, std=(0.0, 0.0), max_range=9.0)
    env, sensor = LandmarkWorldEnv(scenario), find_sensor(kind)
    observation, info = env.reset(seed=0)
    seen = observation["mask"]
    expected = sensor.predict(info["pose"], env.landmarks[seen]).measurement
    assert 1 < seen.sum() < len(seen)
    np.testing.assert_allclose(observation["landmarks"][seen], expected, atol=1e-12)


@pytest.mark.parametrize("kind", STDS)
def test_readings_have_the_stated_noise(kind):
    scenario = world("unicycle", kind, max_range=30.0, dropout=0.0).with_changes(
        motion={"std": (0, 0, 0)}
    )
    worlds, sensor = WorldBatch(scenario, 400), find_sensor(kind)
    worlds.reset([np.random.default_rng(seed) for seed in range(400)])
    pose, places = worlds.poses[0], worlds.landmarks[0]
    exact = sensor.predict(pose, places).measurement
    errors = sensor.difference(worlds.measurements, exact)
    found = errors[worlds.mask].std(axis=0)
    np.testing.assert_allclose(found, STDS[kind], rtol=0.03)


@pytest.mark.parametrize("name", ["position", "bearing", "range", "bicycle"])
def test_the_presets_pass_gymnasiums_check(name):
    check_env(LandmarkWorldEnv(name), skip_render_check=True)


def test_a_car_turns_only_while_it_drives_and_within_its_steering():
    env = LandmarkWorldEnv(
        world("bicycle", "position").with_changes(motion={"std": (0, 0, 0)})
    )
    start = env.reset(seed=0)[1]["pose"]
    observation, *_, info = env.step([0.0, 1.0])
    np.testing.assert_array_equal(info["pose"], start)
    np.testing.assert_array_equal(observation["odometry"], 0.0)
    observation, *_, info = env.step([0.1, 1.0])
    assert observation["odometry"][1] == pytest.approx(0.6)
    assert info["pose"][2] == pytest.approx(0.1 * np.tan(0.6) / 0.4)
    narrowest = 0.1 * np.tan(0.6) / 0.4
    backwards = drive_of(env.scenario.robot).feasible(-0.1, 1.0)
    assert backwards == pytest.approx((-0.1, narrowest))
    env.scenario.with_changes(controls={"commands": [(0.1, narrowest, 1)]})
    with pytest.raises(ScenarioError, match="controls must turn by at most"):
        env.scenario.with_changes(controls={"commands": [(0.1, narrowest + 1e-9, 1)]})


def test_the_planned_path_is_that_of_the_drive():
    scenario = load_scenario("bicycle").with_changes(
        motion={"std": (0, 0, 0)}, start={"std": (0, 0, 0)}, steps=40
    )
    env = LandmarkWorldEnv(scenario)
    poses = [env.reset(seed=0)[1]["pose"]]
    driver = make_controller("open_loop", scenario, np.random.default_rng(0))
    poses += [env.step(driver.act(poses[-1], step))[-1]["pose"] for step in range(40)]
    np.testing.assert_allclose(planned_path(scenario), poses, atol=1e-9)


def test_faults_of_the_odometry_pass_through_the_drive():
    scenario = world("differential", "position").with_changes(
        faults={"odometry_scale": 0.1, "odometry_turn": 0.02}, walls=[]
    )
    env = LandmarkWorldEnv(scenario)
    env.reset(seed=0)
    left, right = env.step([0.5, 0.2])[0]["odometry"]
    assert (left + right) / 2 == pytest.approx(1.1 * 0.5)
    assert (right - left) / 0.4 == pytest.approx(0.22)


ENCODERS = {"noise_in": "odometry", "std": (0.1, 0, 0.1)}
SQUARE = {"sequence": "square", "side": 4.0, "speed": 1.0, "turn_steps": 3}


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"robot": {"drive": "differential"}}, "robot.track_width must be given"),
        ({"robot": {"wheelbase": 0.4}}, "robot.wheelbase must not be given"),
        ({"robot": ROBOTS["bicycle"], "walls": WALLS}, "walls must be empty"),
        ({"robot": ROBOTS["differential"], "motion": ENCODERS},
         "motion.noise_in must be 'motion'"),
        ({"robot": ROBOTS["bicycle"], "controls": SQUARE},
         "controls must turn by at most"),
        ({"sensor": {"kind": "sonar"}}, "or 'module:SENSOR', got 'sonar'"),
        ({"sensor": {"kind": "sonar:SONAR"}}, "sensor.std must be given"),
        ({"sensor": {"kind": "bearing"}}, r"sensor.std must be \(σ, 0\)"),
        ({"sensor": {"kind": "position", "identities": False}}, "identities must be"),
        ({"sensor": {"kind": "position", "range_std_per_metre": 0.1}},
         "range_std_per_metre must be 0"),
        ({"sensor": {"kind": "position"}, "faults": {"range_bias": 0.1}},
         "faults.range_bias must be 0"),
    ],
)  # fmt: skip
def test_what_a_model_does_not_have_is_refused(changes, message):
    with pytest.raises(ScenarioError, match=message):
        LOOP.with_changes(**changes)


def test_a_car_has_no_controller_that_turns_at_rest():
    with pytest.raises(ValueError, match="'waypoints' turns the robot at rest"):
        Waypoints.for_scenario("bicycle")


def test_the_unicycle_has_no_drive_of_its_own():
    assert drive_of(LOOP.robot) is None
    assert LOOP.models == {}


def test_models_tell_whether_there_is_noise_at_rest():
    resting = LOOP.with_changes(motion={"noise_at_rest": False})
    assert resting.models == {"noise_at_rest": False}


def test_scenario_and_drive_have_the_same_label():
    for name in ("differential", "bicycle"):
        label = load_scenario(name).models["motion"]
        assert find_motion(label).name == label
    for ahead in (None, (0.5, 0.0), (0.0, 0.25)):
        car = load_scenario("bicycle").with_changes(robot={"reference": ahead})
        where = f", reference=[{ahead[0]}, {ahead[1]}]" if ahead else ""
        label = f"bicycle[wheelbase={car.robot.wheelbase}{where}]"
        assert car.models["motion"] == label
        assert drive_of(car.robot).reference == (ahead or (0.0, 0.0))


@pytest.mark.parametrize("name", list_presets())
def test_models_complete_the_noise_of_every_preset(name):
    preset = load_scenario(name)
    stds = {"motion_std": preset.motion.std, "measurement_std": preset.sensor.std}
    slam, distances = make_estimator("invariant", **stds, **preset.models), [1, 2, 4]
    scenario = LOOP.with_changes(
        motion={"std": (0, 0, 0)},
        start={"std": (0, 0, 0)},
        landmarks={"layout": "points", "points": [(r, 1.0) for r in distances]},
        sensor={
            key: getattr(preset.sensor, key)
            for key in ("kind", "std", "range_std_per_metre")
        },
    )
    worlds = WorldBatch(scenario, 2000)
    worlds.reset([np.random.default_rng(seed) for seed in range(2000)])
    exact = slam.sensor.predict(worlds.poses[0], worlds.landmarks[0]).measurement
    errors = slam.sensor.difference(worlds.measurements, exact)
    stated = slam.sensor.stds(preset.sensor.std, np.hypot(distances, 1.0))
    size = slam.sensor.size  # a sensor of one number fills the second with 0
    np.testing.assert_allclose(errors.std(axis=0)[:, :size], stated[:, :size], rtol=0.1)


def test_pictures_show_a_ray_of_each_reading():
    rows = np.array([[0.5, 0.0]])
    assert drawn_readings("bearing", rows)[0, 0] == 0.5
    np.testing.assert_array_equal(drawn_readings("range", rows), 0.0)
    np.testing.assert_array_equal(drawn_readings("position", rows), [[0.0, 0.5]])
    assert drawn_readings("bearing_range", rows) is rows


SONAR = """
import numpy as np
from slamgym.estimator import Sensor

def h(x, y):
    squared = x * x + y * y
    r = np.sqrt(squared)
    slopes = -y / squared, x / squared, 2 * x / r / 1500, 2 * y / r / 1500
    return (np.arctan2(y, x), 2 * r / 1500), slopes

def inverse(bearing, delay):
    return 750 * delay * np.cos(bearing), 750 * delay * np.sin(bearing)

NAMES = ("bearing", "delay"), ("rad", "s")
ECHO = Sensor("sonar:ECHO", *NAMES, h, inverse, (True, False))
"""


def test_a_world_simulates_a_sensor_of_the_user(tmp_path, monkeypatch):
    (tmp_path / "sonar.py").write_text(SONAR)
    monkeypatch.syspath_prepend(tmp_path)
    own = {"kind": "sonar:ECHO", "std": (0.02, 2e-4)}
    plain, echoes = (
        LandmarkWorldEnv("six_landmarks", sensor=sensor)
        for sensor in ({"kind": "bearing_range", "std": (0.02, 0.15)}, own)
    )
    world = load_scenario("six_landmarks").with_changes(sensor=own)
    noise = {"motion_std": world.motion.std, "measurement_std": world.sensor.std}
    slam = make_estimator("invariant", **noise, **world.models)
    assert slam.sensor is find_sensor("sonar:ECHO")
    first, second = plain.reset(seed=3)[0], echoes.reset(seed=3)[0]
    for _ in range(20):
        assert echoes.observation_space.contains(second)
        scaled = second["landmarks"] * [1.0, 750.0]  # 1500 m/s, there and back
        np.testing.assert_allclose(scaled, first["landmarks"], atol=1e-9)
        first, second = plain.step([0.5, 0.2])[0], echoes.step([0.5, 0.2])[0]


def assert_a_pickled_world_continues(env):
    twin = pickle.loads(pickle.dumps(env))
    for _ in range(10):
        seen, expected = (each.step([0.5, 0.2])[0] for each in (twin, env))
        np.testing.assert_array_equal(seen["landmarks"], expected["landmarks"])


@pytest.mark.parametrize("kind", STDS)
def test_worlds_with_every_kind_of_sensor_can_be_pickled(kind):
    sensor = {"kind": kind, "std": STDS[kind]}
    env = LandmarkWorldEnv("six_landmarks", sensor=sensor)
    env.reset(seed=0)
    assert_a_pickled_world_continues(env)


RANGE_ONLY = """
import numpy as np

from slamgym.estimator import Sensor

def h(x, y):
    r = np.sqrt(x * x + y * y)
    return (r, 0.0), (x / r, y / r, 0.0, 0.0)

ECHO = Sensor("range_only:ECHO", ("range",), ("m",), h)
"""


def test_worlds_simulate_a_sensor_of_the_user_that_reads_one_number(
    tmp_path, monkeypatch
):
    (tmp_path / "range_only.py").write_text(RANGE_ONLY)
    monkeypatch.syspath_prepend(tmp_path)
    changes = {"sensor": {"kind": "range_only:ECHO", "std": (0.1, 0.01)}}
    env = LandmarkWorldEnv("six_landmarks", **changes)
    worlds = LandmarkWorldVectorEnv(3, "six_landmarks", **changes)
    readings = env.reset(seed=3)[0]["landmarks"]
    true = np.linalg.norm(env.landmarks - env.pose[:2], axis=1)
    np.testing.assert_allclose(readings[:, 0], true, atol=0.5)
    np.testing.assert_allclose(readings[:, 1], 0.0, atol=0.05)
    together = worlds.reset(seed=3)[0]["landmarks"]
    np.testing.assert_array_equal(together[0], readings)
    assert_a_pickled_world_continues(env)


def test_worlds_pictures_and_plans_keep_to_the_field_of_view_of_a_sensor():
    camera = {"kind": "camera:AHEAD", "std": (1.0, 0.1), "max_range": 50.0}
    for view, expected in ((2 * np.pi, 1.5), (1.0, 1.0)):
        scenario = LOOP.with_changes(sensor={**camera, "field_of_view": view})
        env, worlds = LandmarkWorldEnv(scenario), LandmarkWorldVectorEnv(2, scenario)
        observation, info = env.reset(seed=0)
        offset = (env.landmarks - info["pose"][:2]) @ np.array([1, 1j])
        bearings = np.angle(offset * np.exp(-1j * info["pose"][2]))
        seen = np.abs(bearings) <= expected / 2
        np.testing.assert_array_equal(observation["mask"], seen)
        assert 0 < seen.sum() < len(seen)
        together = worlds.reset(seed=0)[0]["mask"]
        np.testing.assert_array_equal(together[0], seen)
        assert Scene(Figure(), scenario, env.landmarks)._field_of_view == expected
    slam = make_estimator(
        "ekf", motion_std=(0.1, 0.1, 0.1), measurement_std=(1.0, 0.1),
        sensor="camera:AHEAD",
    )  # fmt: skip
    slam.update([(0.0, 4.0)], [0])
    turns = [[(0.0, 0.3)], [(0.0, 3.0)]]  # the second plan turns the camera away
    after = imagine(slam, turns, LOOP.sensor).worst_variances[0, :, 0]
    assert after[0] < after[1] == pytest.approx(slam.belief().covariance[3, 3])


def test_noise_of_a_number_that_is_no_range_hides_no_landmark():
    wide = {"kind": "camera:SECOND", "std": (0.1, 1e3)}
    observation, _ = LandmarkWorldEnv("six_landmarks", sensor=wide).reset(seed=0)
    assert observation["mask"].all()


def test_a_sensor_that_cannot_be_imported_is_named():
    own = {"kind": "no_such_module:ECHO", "std": (0.02, 2e-4)}
    for module, hint in (
        ("no_such", "; run in the folder of no_such.py,"),
        ("json", ""),
    ):
        own["kind"] = f"{module}.part:ECHO"
        with pytest.raises(
            ValueError, match=rf"named '{module}[a-z_.']*{hint}"
        ) as error:
            LandmarkWorldEnv("six_landmarks", sensor=own)
        assert ("run in the folder" in str(error.value)) == bool(hint)
