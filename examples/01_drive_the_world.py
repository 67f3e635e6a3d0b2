"""Drive a robot around a square corridor, and draw its path.

The world is an ordinary Gymnasium environment: ``reset``, ``step``, ``render``. The
observation holds what the robot measures: odometry, and the bearing and range of the
landmarks in view. Only ``info`` holds the truth. Here the truth steers the robot from
waypoint to waypoint, so the example needs no filter.

Run it::

    python examples/01_drive_the_world.py

It writes ``results/01_drive_the_world.png``: the path of the robot, and its last
readings.
"""

from pathlib import Path

import gymnasium as gym
from matplotlib.image import imsave

import slamgym  # noqa: F401 (registers slamgym/LandmarkWorld-v0)
from slamgym import Waypoints, load_scenario

CORNERS = [(12.0, 0.0), (12.0, 12.0), (0.0, 12.0), (0.0, 2.0)]
PICTURE = Path("results/01_drive_the_world.png")


def main() -> None:
    scenario = load_scenario("corridor").with_changes(steps=140)
    driver = Waypoints(CORNERS, scenario.robot, dt=scenario.dt, tolerance=0.4)
    env = gym.make(
        "slamgym/LandmarkWorld-v0", scenario=scenario, render_mode="rgb_array"
    )
    observation, info = env.reset(seed=0)
    readings, bumps, truncated = int(observation["mask"].sum()), 0, False
    for step in range(scenario.steps):
        action = driver.act(info["pose"], step)
        observation, _, _, truncated, info = env.step(action)
        readings += int(observation["mask"].sum())
        bumps += info["collision"]
    PICTURE.parent.mkdir(exist_ok=True)
    imsave(PICTURE, env.render())  # type: ignore[arg-type]
    env.close()
    print(f"{step + 1} steps, {readings} readings of landmarks, {bumps} bumps")
    print(f"episode over: {truncated}; true pose (x, y, θ): {info['pose'].round(2)}")
    print(f"wrote {PICTURE}")


if __name__ == "__main__":
    main()
