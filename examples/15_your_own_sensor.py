"""Plug in a sensor of your own: a sonar that measures the delay of an echo.

A sensor is a function h of the landmark's position in the robot's frame, with its four
partial derivatives, and the inverse of h; both accept numbers and arrays.
`check_sensor` tests them, and every filter of the EKF family accepts the sensor.

Run it::

    python examples/15_your_own_sensor.py
"""

from typing import Any

import numpy as np

from slamgym import InvariantEkfSlam
from slamgym.estimator import Sensor, check_sensor

Pair = tuple[Any, Any]


def h(x: Any, y: Any) -> tuple[Pair, tuple[Any, Any, Any, Any]]:
    """Return the bearing β and the delay of an echo, and their derivatives."""
    r2 = x * x + y * y
    r = np.sqrt(r2)
    return (np.arctan2(y, x), 2 * r / 1500), (
        -y / r2,
        x / r2,
        2 * x / r / 1500,
        2 * y / r / 1500,
    )


def inverse(bearing: Any, delay: Any) -> Pair:
    """Return the position (x, y) of the landmark of a reading."""
    r = 1500 * delay / 2
    return r * np.cos(bearing), r * np.sin(bearing)


SONAR = Sensor(
    "15_your_own_sensor:SONAR",
    columns=("bearing", "delay"),
    units=("rad", "s"),
    h=h,
    inverse=inverse,
    angles=(True, False),
)


def main() -> None:
    """Check the sensor, and map a rock with it and a compass."""
    check_sensor(SONAR, measurement_std=(0.02, 1e-4))
    slam = InvariantEkfSlam(
        motion_std=(0.02, 0.02, 0.02), measurement_std=(0.02, 1e-4), sensor=SONAR
    )
    rng, rock = np.random.default_rng(0), (8.0, 3.0)
    for step in range(20):
        slam.predict((0.2, 0.0))
        (bearing, delay), _ = h(rock[0] - 0.2 * (step + 1), rock[1])
        noise = rng.normal(0.0, (0.02, 1e-4))
        slam.update([(bearing + noise[0], delay + noise[1])], [0])
        slam.observe_pose(rng.normal(0.0, 0.05), [0, 0, 1], 0.05**2)  # a compass
    print(f"position of the rock: {slam.belief().landmarks[0].round(1)}, true: {rock}")


if __name__ == "__main__":
    main()
