"""The wheels and their encoders: what a command does, and what the odometry says.

Symbols
-------
u = (d, α)        command: distance driven, then heading turned [m, rad]
ε = (εx, εy, εα)  motion noise in the robot's own frame [m, m, rad]
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..sim_configs import Scenario

Command = tuple[float, float]


class NoisePlacement(NamedTuple):
    """Where the motion noise of one step falls; the other place stays exact."""

    slip: Sequence[float]
    """(εx, εy, εα) added to the true motion [m, m, rad]."""
    error: Sequence[float]
    """(εd, εα) added to the odometry [m, rad]."""


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
    NoisePlacement(slip=(0.1, 0.2, 0.3), error=(0.0, 0.0))
    >>> sensor.read((1.0, 0.2), share=0.5, error=(0.0, 0.1))
    array([0.5, 0.3])
    """

    def __init__(self, scenario: Scenario) -> None:
        self._slips = scenario.motion.noise_in == "motion"
        self._noise_at_rest = scenario.motion.noise_at_rest

    def place_noise(self, command: Command, noise: Sequence[float]) -> NoisePlacement:
        """Decide what the noise (εx, εy, εα) of one step disturbs."""
        if not self._noise_at_rest and command == (0.0, 0.0):
            return NoisePlacement((0.0, 0.0, 0.0), (0.0, 0.0))
        if self._slips:
            return NoisePlacement(noise, (0.0, 0.0))
        return NoisePlacement((0.0, 0.0, 0.0), (noise[0], noise[2]))

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
