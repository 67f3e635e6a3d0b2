"""One world with six landmarks in other simulators: ir-sim and the Robotics Toolbox.

Each call is one step of a robot and one reading of bearings and ranges of the same six
landmarks, without drawing. Neither simulator returns the same readings as ours. ir-sim
has no landmark sensor, so the benchmark uses the objects in view of its robot and their
positions. The Toolbox reads all landmarks and returns one of them, with noise, and
odometry.
"""

import importlib
import importlib.util
import math
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np

from slamgym.sim_configs import load_scenario, place_landmarks

Call = Callable[[], object]
SPEED, TURN = 0.5, 0.3  # [m/s, rad/s]: round a circle that meets no landmark


def six_landmarks() -> list[tuple[float, float]]:
    layout = load_scenario("six_landmarks").landmarks
    points = place_landmarks(layout, np.random.default_rng(0))
    return [(float(x), float(y)) for x, y in points]


def irsim_world() -> Call:
    """Step ir-sim's differential drive among six circles; read the objects in view."""
    irsim = importlib.import_module("irsim")
    tools = importlib.import_module("irsim.util.util")
    text = (
        "world: {height: 40, width: 40, offset: [-20, -20], step_time: 1.0}\n"
        "robot: {kinematics: {name: diff, noise: true}, state: [0, 0, 0],\n"
        "  shape: {name: circle, radius: 0.2}, vel_max: [1, 1],\n"
        f"  fov: {2 * math.pi}, fov_radius: 100}}\n"
        "obstacle:\n"
    )
    for x, y in six_landmarks():
        text += f"  - {{shape: {{name: circle, radius: 0.05}}, state: [{x}, {y}, 0]}}\n"
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "world.yaml"
        path.write_text(text, encoding="utf-8")
        world = irsim.make(str(path), headless=True, log_level="ERROR", seed=0)
    action = np.array([[SPEED], [TURN]])

    def step() -> list[tuple[float, float]]:
        world.step(action)
        robot = world.robot
        readings = []
        for each in robot.get_fov_detected_objects():
            distance, angle = tools.relative_position(robot.state, each.state)
            readings.append((tools.WrapToPi(angle - robot.state[2, 0]), distance))
        return readings

    return _all_in_view(step)


def toolbox_world() -> Call:
    """Step the Robotics Toolbox's unicycle, and read its range-and-bearing sensor."""
    toolbox = importlib.import_module("roboticstoolbox")
    robot = toolbox.Unicycle(covar=np.diag([0.1, 0.1]) ** 2, x0=(0, 0, 0), dt=1.0)
    landmarks = toolbox.LandmarkMap(np.transpose(six_landmarks()), workspace=20)
    noise = np.diag([0.08, 0.01]) ** 2
    sensor = toolbox.RangeBearingSensor(robot, landmarks, covar=noise)

    def step() -> object:
        robot.step((SPEED, TURN), animate=False)
        return sensor.reading()

    return step


def _all_in_view(step: Callable[[], list[tuple[float, float]]]) -> Call:
    if len(step()) != 6:
        raise RuntimeError(f"ir-sim should have six circles in view, got {step()}")
    return step


PEERS = {
    # name: (module, what makes its world)
    "ir-sim, step and what is in view": ("irsim", irsim_world),
    "Robotics Toolbox, step and reading": ("roboticstoolbox", toolbox_world),
}


def peer_calls() -> dict[str, Call | None]:
    """Make the world of each simulator; None if it is not installed."""
    return {
        name: make() if importlib.util.find_spec(module) else None
        for name, (module, make) in PEERS.items()
    }
