"""The wheels and their encoders: what a command does, and what the odometry says.

Symbols
-------
u = (d, α)        command: distance driven, then heading turned [m, rad]
ε = (εx, εy, εα)  motion noise in the robot's own frame [m, m, rad]
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ...sim_configs import Scenario

Command = tuple[float, float]
_NO_SLIP = (0.0, 0.0, 0.0)
_NO_ERROR = (0.0, 0.0)


class OdometrySensor:
    """Reports the command, or measures the motion, as the scenario says.

    With ``noise_in = "motion"`` the robot slips and the odometry reports the command;
    with ``"odometry"`` the robot obeys and the encoders err. With ``noise_at_rest``
    off, a step commanded (0, 0) has no noise.

    Parameters
    ----------
    scenario : Scenario
        Whose `motion` is meant.

    Examples
    --------
    >>> from slamgym.sim_configs import load_scenario
    >>> sensor = OdometrySensor(load_scenario("six_landmarks"))
    >>> sensor.place_noise((1.0, 0.0), (0.1, 0.2, 0.3))
    ((0.1, 0.2, 0.3), (0.0, 0.0))
    >>> sensor.read((1.0, 0.2), share=0.5, error=(0.0, 0.1))
    array([0.5, 0.3])
    """

    def __init__(self, scenario: Scenario) -> None:
        self._slips = scenario.motion.noise_in == "motion"
        self._noise_at_rest = scenario.motion.noise_at_rest

    def place_noise(
        self, command: Command, noise: Sequence[float]
    ) -> tuple[Sequence[float], Sequence[float]]:
        """Decide what the noise of one step disturbs.

        Parameters
        ----------
        command : (float, float)
            u = (d, α) [m, rad].
        noise : sequence of float, length 3
            ε [m, m, rad].

        Returns
        -------
        slip : sequence of float, length 3
            Added to the true motion [m, m, rad].
        error : sequence of float, length 2
            Added to the odometry [m, rad]. One of the two is zero.
        """
        if not self._noise_at_rest and command == (0.0, 0.0):
            return _NO_SLIP, _NO_ERROR
        if self._slips:
            return noise, _NO_ERROR
        return _NO_SLIP, (noise[0], noise[2])

    def read(
        self, command: Command, share: float, error: Sequence[float]
    ) -> NDArray[np.float64]:
        """Read the encoders after one step.

        Parameters
        ----------
        command : (float, float)
            u = (d, α) [m, rad].
        share : float
            Share of the motion, in [0, 1], that no wall held back: the wheels stall.
        error : (float, float)
            Of the encoders [m, rad].

        Returns
        -------
        ndarray, shape (2,)
            Odometry (share d + εd, α + εα) [m, rad]; the turn is never held back.
        """
        distance, turn = command
        return np.array([share * distance + error[0], turn + error[1]])
