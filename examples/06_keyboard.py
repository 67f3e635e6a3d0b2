"""Drive the robot yourself, and watch the belief of an invariant EKF.

The up and down arrows drive forwards and backwards, left and right turn, Escape ends.
The ellipses show the filter's belief at 3σ: the pose in blue, the map in green. Explore
the corridor, and return to the start.

Run it, with a screen::

    python examples/06_keyboard.py
"""

import sys

import numpy as np
from matplotlib import pyplot
from matplotlib.backend_bases import KeyEvent
from matplotlib.figure import Figure
from numpy.typing import NDArray

from slamgym import LandmarkWorldEnv, Scenario, load_scenario, make_estimator

ARROWS = {
    "up": (1.0, 0.0),
    "down": (-1.0, 0.0),
    "left": (0.0, 1.0),
    "right": (0.0, -1.0),
}


class HeldKeys:
    """The keys that are held down over a figure."""

    def __init__(self, figure: Figure) -> None:
        self._held: set[str] = set()
        manager = figure.canvas.manager
        if manager is not None and manager.key_press_handler_id is not None:
            figure.canvas.mpl_disconnect(manager.key_press_handler_id)  # its shortcuts
        figure.canvas.mpl_connect("key_press_event", self._press)
        figure.canvas.mpl_connect("key_release_event", self._release)

    def action(self, scenario: Scenario) -> NDArray[np.float64]:
        """Add up the arrows that are held: (v, ω) [m/s, rad/s]."""
        speed = sum(ARROWS[key][0] for key in self._held & ARROWS.keys())
        turn_rate = sum(ARROWS[key][1] for key in self._held & ARROWS.keys())
        robot = scenario.robot
        return np.array([speed * robot.max_speed, turn_rate * robot.max_turn_rate])

    def __contains__(self, key: str) -> bool:
        return key in self._held

    def _press(self, event: KeyEvent) -> None:
        self._held.add(str(event.key))

    def _release(self, event: KeyEvent) -> None:
        self._held.discard(str(event.key))


def drivable_corridor() -> Scenario:
    """Make the steps of the corridor short enough for manual control."""
    return load_scenario("corridor").with_changes(
        dt=0.1,
        steps=3000,
        motion={"std": (0.004, 0.0, 0.006)},
        controls={"turn_steps": 20},
    )


def drive(env: LandmarkWorldEnv) -> None:
    """Drive by keyboard until Escape, or until the window or the episode ends."""
    scenario = env.scenario
    slam = make_estimator(
        "invariant",
        motion_std=scenario.motion.std,
        measurement_std=scenario.sensor.std,
        **scenario.models,
        initial_pose=scenario.start.pose,
        initial_pose_std=scenario.start.std,
    )
    observation, _ = env.reset(seed=0)
    figure = pyplot.gcf()
    keys, truncated = HeldKeys(figure), False
    while pyplot.fignum_exists(figure.number) and not truncated:
        seen = np.flatnonzero(observation["mask"])
        slam.update(observation["landmarks"][seen], seen.tolist())
        env.show_belief(slam.belief())
        if "escape" in keys:
            break
        observation, _, _, truncated, _ = env.step(keys.action(scenario))
        slam.predict(observation["odometry"])
    error = np.hypot(*(slam.belief().pose - env.pose)[:2])
    print(f"the filter's last position was off by {error:.2f} m")


def has_screen() -> bool:
    """Whether matplotlib can open a window."""
    figure = pyplot.figure()
    shows_windows = bool(figure.canvas.required_interactive_framework)
    pyplot.close(figure)
    return shows_windows


def main() -> None:
    if not has_screen():
        sys.exit(
            "this example needs a screen: matplotlib's backend "
            f"'{pyplot.get_backend()}' opens no windows"
        )
    env = LandmarkWorldEnv(drivable_corridor(), render_mode="human")
    drive(env)
    env.close()


if __name__ == "__main__":
    main()
