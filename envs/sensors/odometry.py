"""The odometry: which noise disturbs the motion, and what the encoders report.

Symbols
-------
u = (d, α)        command: distance driven, then heading turned [m, rad]
ε = (εx, εy, εα)  motion noise in the robot's own frame [m, m, rad]

With ``noise_in = "motion"`` the robot slips and the odometry reports the command. With
``"odometry"`` the robot follows the command and the encoders have the noise. With
``noise_at_rest`` off, a step with the command (0, 0) has no noise. The faults of the
scenario change what the encoders report of a step that moves: s scales its distance, b
is added to its turn.
"""

from collections.abc import Sequence

import numpy as np

from ...arrays import Array
from ...sim_configs import Scenario

Command = tuple[float, float]

_NO_SLIP = (0.0, 0.0, 0.0)
_NO_ERROR = (0.0, 0.0)
_NO_ERRORS = np.array(0.0)


class OdometrySensor:
    """The odometry of one robot.

    Parameters
    ----------
    scenario : Scenario
        Source of the motion's settings.

    Examples
    --------
    >>> from slamgym.sim_configs import load_scenario
    >>> sensor = OdometrySensor(load_scenario("six_landmarks"))
    >>> sensor.split_noise((1.0, 0.0), (0.1, 0.2, 0.3))
    ((0.1, 0.2, 0.3), (0.0, 0.0))
    >>> sensor.read((1.0, 0.2), share=0.5, error=(0.0, 0.1))
    array([0.5, 0.3])
    """

    def __init__(self, scenario: Scenario) -> None:
        self._slips = scenario.motion.noise_in == "motion"
        self._noise_at_rest = scenario.motion.noise_at_rest
        faults = scenario.present_faults
        self._gain, self._turn = 1.0 + faults.odometry_scale, faults.odometry_turn

    def split_noise(
        self, command: Command, noise: Sequence[float]
    ) -> tuple[Sequence[float], Sequence[float]]:
        """Split the noise of one step into slip and odometry error; one is zero.

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
            Added to the odometry [m, rad].
        """
        if not self._noise_at_rest and command == (0.0, 0.0):
            return _NO_SLIP, _NO_ERROR
        if self._slips:
            return noise, _NO_ERROR
        return _NO_SLIP, (noise[0], noise[2])

    def read(self, command: Command, share: float, error: Sequence[float]) -> Array:
        """Return the reading of the encoders after one step.

        Parameters
        ----------
        command : (float, float)
            u = (d, α) [m, rad].
        share : float
            Share of the displacement, in [0, 1], that the walls allowed. The wheels
            stall for the rest.
        error : (float, float)
            Of the encoders [m, rad].

        Returns
        -------
        ndarray, shape (2,)
            Odometry ((1 + s) share d + εd, α + b + εα) [m, rad]. Walls do not affect
            the turn.
        """
        distance, turn = command
        bias = self._turn if command != (0.0, 0.0) else 0.0
        return np.array(
            [self._gain * (share * distance) + error[0], turn + bias + error[1]]
        )


class VectorOdometrySensor:
    """The odometry of B robots; the vector form of `OdometrySensor`.

    Parameters
    ----------
    scenario : Scenario
        Source of the motion's settings.
    count : int
        B.
    """

    def __init__(self, scenario: Scenario, count: int) -> None:
        self._slips = scenario.motion.noise_in == "motion"
        self._noise_at_rest = scenario.motion.noise_at_rest
        self._no_slip = np.zeros((count, 3))
        faults = scenario.present_faults
        self._gain, self._turn = 1.0 + faults.odometry_scale, faults.odometry_turn

    def split_noise(self, commands: Array, noise: Array) -> tuple[Array, Array]:
        """Split noise, (B, 3), into slip, (B, 3), and odometry error, (B, 2) or ().

        Overwrites the noise of robots at rest.
        """
        if not self._noise_at_rest:
            noise[~commands.any(axis=1)] = 0.0
        if self._slips:
            return noise, _NO_ERRORS
        return self._no_slip, noise[:, ::2]

    def read(self, commands: Array, share: Array | None, error: Array) -> Array:
        """Return the readings (B, 2) after one step; `share` is None without walls.

        Overwrites the commands.
        """
        if self._turn:
            commands[commands.any(axis=1), 1] += self._turn
        if share is not None:
            commands[:, 0] *= share
        if self._gain != 1.0:
            commands[:, 0] *= self._gain
        odometry: Array = commands + error
        return odometry
