"""Many worlds, simulated together in numpy: those of one scenario in a `WorldBatch`.

`MixedWorlds` are worlds that draw their own settings from the ranges of a scenario;
`DrawnWorlds` holds these settings as arrays.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from gymnasium.error import ResetNeeded
from numpy.typing import ArrayLike

from ...arrays import (
    AnyArray,
    Array,
    BoolArray,
    ComplexArray,
    IndexArray,
    IntArray,
    WordArray,
)
from ...restorable import Restorable
from ...sim_configs import Scenario
from ...sim_configs.scenario_files import widest_scenario
from ..bearing_range import BearingRangeSensor, hide_identities
from ..drives import drive_of
from ..noise_streams import PoseSensors, SensorSettings, WorldNoise
from ..random_numbers import EpisodeStarts, drawn_scenarios, episode_keys
from ..robot import UnicycleBodies, VectorOdometrySensor
from ..spaces import commands_of, count_rows

Generators = Sequence[np.random.Generator]
Scan = tuple[Array, BoolArray, IntArray | None]

_READINGS_AT_ONCE = 8192


class WorldBatch(Restorable):
    """B independent worlds of one scenario.

    World i equals, to the bit, a `LandmarkWorldEnv` whose ``np_random`` is generator i.

    Parameters
    ----------
    scenario : Scenario
        The scenario of every world. A random layout without a seed differs per world.
        With ranges, every world draws its settings anew for every episode.
    count : int
        B, the number of worlds.
    drawn : sequence of Scenario, length B, optional
        What each world has drawn from the ranges already, and keeps in every episode.

    Attributes
    ----------
    measurements : ndarray, shape (B, M, 2)
        Rows (β in [-π, π), r), zeros where unseen [rad, m].
    mask : bool ndarray, shape (B, M)
        Rows with a measurement.
    odometry : ndarray, shape (B, 2)
        Measured (d, α) [m, rad].
    poses : ndarray, shape (B, 3)
        True (x, y, θ) [m, m, rad], θ not wrapped.
    collisions : bool ndarray, shape (B,)
        Whether a wall stopped the robot.
    steps : int64 ndarray, shape (B,)
        Steps of the present episodes so far; every step changes it.
    pose_readings : ndarray, shape (B, 3), or None without compass and GPS
        Readings of (x, y, θ) [m, m, rad], nan where there is none.
    landmark_ids : int64 ndarray, shape (B, M), or None with identities
        The true landmark of each row, -1 for clutter and empty rows.
    begun : bool
        Whether `reset` has been called.

    Notes
    -----
    `reset` and `step` assign new arrays and never write into earlier ones. Writing into
    an array does not move a robot. A world that takes no part in a `reset` keeps its
    rows of the last arrays.

    Examples
    --------
    >>> from slamgym.sim_configs import load_scenario
    >>> worlds = WorldBatch(load_scenario("six_landmarks"), count=2)
    >>> worlds.reset([np.random.default_rng(seed) for seed in (0, 1)])
    >>> worlds.step(np.array([[1.0, 0.0], [0.5, 0.1]]))
    >>> worlds.odometry
    array([[3. , 0. ],
           [1.5, 0.3]])
    """

    changing = (
        *("measurements", "mask", "odometry", "poses", "collisions", "landmark_ids"),
        "pose_readings",
        *("_drawn", "_keys", "steps", "_bodies", "_start_estimates", "_landmarks"),
    )

    def __init__(
        self, scenario: Scenario, count: int, drawn: Sequence[Scenario] = ()
    ) -> None:
        if count < 1:
            raise ValueError(f"count must be >= 1, got {count}")
        self.scenario = scenario
        self.count = count
        self._drawn = None
        if scenario.randomise is not None:
            self._drawn = DrawnWorlds(scenario, count, drawn)
        self._starts, widest = EpisodeStarts(scenario), widest_scenario(scenario)
        self._noise = WorldNoise(widest)
        self.pose_sensors = PoseSensors(scenario)
        self.pose_readings: Array | None = None
        self._keys = np.zeros((count, 2), dtype=np.uint64)
        self.steps = np.zeros(count, dtype=np.int64)
        self._sensor = BearingRangeSensor(widest)
        self._odometer = VectorOdometrySensor(scenario, count)
        robot = scenario.robot
        self._robot_drive = drive_of(robot)
        self._bodies = UnicycleBodies(
            count, robot.radius, scenario.walls, self._robot_drive
        )
        self._limits = np.array([robot.max_speed, robot.max_turn_rate])
        self._all = np.ones(count, np.bool_)
        self._hides_identities = not scenario.sensor.identities
        self.begun, rows = False, count_rows(scenario)
        self.measurements = np.zeros((count, rows, 2))
        self.mask = np.zeros((count, rows), dtype=np.bool_)
        self.odometry = np.zeros((count, 2))
        self.poses = np.zeros((count, 3))
        self.collisions = np.zeros(count, dtype=np.bool_)
        self.landmark_ids: IntArray | None = None
        if self._hides_identities:
            self.landmark_ids = np.full((count, rows), -1)
        self._start_estimates = np.zeros((count, 3))
        self._landmarks = np.zeros((count, scenario.landmarks.count), np.complex128)

    @property
    def observations(self) -> dict[str, AnyArray]:
        """Readings, mask and odometry, as `LandmarkWorldEnv` observes them."""
        return {
            "landmarks": self.measurements,
            "mask": self.mask,
            "odometry": self.odometry,
        }

    @property
    def landmarks(self) -> Array:
        """True positions, shape (B, N, 2) [m], a copy."""
        return self._landmarks.copy().view(np.float64).reshape(self.count, -1, 2)

    @property
    def complex_landmarks(self) -> ComplexArray:
        """True positions x + iy, shape (B, N) [m]; not a copy."""
        return self._landmarks

    @property
    def scenarios(self) -> list[Scenario]:
        """The scenario of each world, with what its episode drew from ranges."""
        if self._drawn is None:
            return [self.scenario] * self.count
        return list(self._drawn.scenarios)

    @property
    def start_estimates(self) -> Array:
        """Start poses for filters, shape (B, 3) [m, m, rad], a copy."""
        return self._start_estimates.copy()

    def reset(self, generators: Generators, worlds: BoolArray | None = None) -> None:
        """Start an episode in some worlds, and measure from its start.

        Parameters
        ----------
        generators : sequence of numpy.random.Generator, length B
            Generator i corresponds to ``np_random`` of a single world. Only those of
            the chosen worlds draw: the key of the episode.
        worlds : bool ndarray, shape (B,), optional
            Worlds to reset (None: all). The first call must reset all.

        Raises
        ------
        ValueError
            If there are not B generators, or `worlds` is not a mask of B worlds.
        gymnasium.error.ResetNeeded
            If a world that has never been reset is not chosen.
        """
        chosen = self._chosen(worlds)
        self.odometry, self.collisions = self.odometry.copy(), self.collisions.copy()
        self._begin(chosen, generators)
        self._measure_some(chosen)
        self._read_poses()

    def _read_poses(self) -> None:
        """Read compass and GPS; worlds that did not move read the same again."""
        if self.pose_sensors.present:
            at = self._keys, self.steps, self.poses
            self.pose_readings = self.pose_sensors.read(*at)

    def _begin(self, chosen: IndexArray, generators: Generators) -> None:
        """Start an episode in some worlds, without a scan.

        Writes into the odometry and the collisions.
        """
        self._check_number(generators)
        keys = episode_keys([generators[world] for world in chosen.tolist()])
        poses, estimates = self._start(chosen, keys)
        self._keys[chosen], self.steps[chosen] = keys, 0  # a start has sensor noise
        self._start_estimates[chosen] = estimates
        self._bodies.place(chosen, poses)
        self.poses = self._bodies.poses()
        self.odometry[chosen], self.collisions[chosen] = 0.0, False
        self.begun = True

    def _start(self, chosen: IndexArray, keys: WordArray) -> tuple[Array, Array]:
        """Place landmarks; return true and estimated start poses, each (b, 3)."""
        if self._drawn is not None:
            self._landmarks[chosen], *starts = self._drawn.begin(chosen, keys)
            return starts[0], starts[1]
        if self._starts.redraws_landmarks or not self.begun:
            self._landmarks[chosen] = self._starts.landmarks(keys)
        return self._starts.poses(keys)

    def step(
        self,
        actions: ArrayLike,
        moving: BoolArray | None = None,
        generators: Generators | None = None,
    ) -> None:
        """Drive and turn for one step, then measure.

        Parameters
        ----------
        actions : array_like, shape (B, 2)
            (v, ω) [m/s, rad/s], clipped to the limits of the robot.
        moving : bool ndarray, shape (B,), optional
            Worlds that take the step (None: all); actions of others are ignored.
        generators : sequence of numpy.random.Generator, length B, optional
            With them, the other worlds start an episode, as in `reset`.

        Raises
        ------
        ValueError
            If an action of a moving world is not finite. Then no world moves.
        gymnasium.error.ResetNeeded
            Before `reset`.
        """
        if not self.begun:
            raise ResetNeeded("call reset before step")
        if moving is not None:
            moving = self._truth_values(moving, "moving")
            if np.count_nonzero(moving) == self.count:
                moving = None
        if generators is not None:
            self._check_number(generators)
        commands = commands_of(
            *(actions, self._limits, self.scenario.dt),
            *(self._all if moving is None else moving, self.steps),
        )
        if self._robot_drive is not None:
            commands = np.column_stack(self._robot_drive.feasible(*commands.T))
        before = self.odometry, self.collisions
        self._drive(commands, moving)
        if moving is not None and generators is not None:
            self._begin(np.flatnonzero(~moving), generators)
        elif moving is not None:
            self.odometry = np.where(moving[:, None], self.odometry, before[0])
            self.collisions = np.where(moving, self.collisions, before[1])
        self.measurements, self.mask, self.landmark_ids = self._scan_all()
        self._read_poses()

    def _truth_values(self, value: BoolArray, name: str) -> BoolArray:
        array = np.asarray(value)
        if array.shape != (self.count,) or array.dtype != np.bool_:
            raise ValueError(
                f"{name} must be a bool array of shape ({self.count},), "
                f"got {array.dtype} of shape {array.shape}"
            )
        return array

    def _check_number(self, generators: Generators) -> None:
        if len(generators) != self.count:
            raise ValueError(
                f"generators must be {self.count}, one per world, got {len(generators)}"
            )

    def _chosen(self, worlds: BoolArray | None) -> IndexArray:
        if worlds is None:
            return np.arange(self.count)
        chosen = self._truth_values(worlds, "worlds")
        if not self.begun and not chosen.all():
            raise ResetNeeded("reset all worlds first: some have never begun")
        return np.flatnonzero(chosen)

    def _drive(self, commands: Array, moving: BoolArray | None) -> None:
        std = None if self._drawn is None else self._drawn.motion_std
        noise = self._noise.motion(self._keys, self.steps, std)
        slip, error = self._odometer.split_noise(commands, noise)
        share = self._bodies.drive(commands, slip, moving)
        odometry = self._odometer.read(commands, share, error)
        collisions = np.zeros(self.count, np.bool_) if share is None else share < 1.0
        self.odometry, self.collisions = odometry, collisions
        self.poses = self._bodies.poses()

    def _measure_some(self, worlds: IndexArray) -> None:
        measurements, mask, ids = self._scan(worlds)
        self.measurements = _replaced(self.measurements, worlds, measurements)
        self.mask = _replaced(self.mask, worlds, mask)
        if self.landmark_ids is not None:
            self.landmark_ids = _replaced(self.landmark_ids, worlds, ids)

    def _scan_all(self) -> Scan:
        """Scan in blocks of worlds whose arrays fit the cache.

        Worlds that did not move have the noise of their last scan, and so its readings.
        """
        size = max(1, _READINGS_AT_ONCE // self.mask.shape[1])
        if self.count <= size:
            return self._scan()
        starts = range(0, self.count, size)
        blocks = [self._scan(slice(first, first + size)) for first in starts]
        measurements, masks, ids = zip(*blocks, strict=True)
        all_ids = np.concatenate(ids) if self._hides_identities else None
        return np.concatenate(measurements), np.concatenate(masks), all_ids

    def _scan(self, worlds: IndexArray | slice | None = None) -> Scan:
        frame, drawn = self._bodies.frame, self._drawn
        settings = None if drawn is None else drawn.settings
        keys, steps, landmarks = self._keys, self.steps, self._landmarks
        if worlds is not None:
            keys, steps, landmarks = keys[worlds], steps[worlds], landmarks[worlds]
            frame = np.ascontiguousarray(frame[:, worlds])
            if settings is not None:
                settings = SensorSettings(*(each[worlds] for each in settings))
        noise = self._noise.sensor(keys, steps, settings)
        scan = self._sensor.scan(landmarks, frame, noise, settings)
        hides = self._hides_identities
        return hide_identities(*scan, noise) if hides else (*scan, None)


def _replaced(old: AnyArray, worlds: IndexArray, value: Any) -> AnyArray:
    """Return a copy with new values for some worlds."""
    new = old.copy()
    new[worlds] = value
    return new


class DrawnWorlds(Restorable):
    """The scenarios that B worlds drew for their episodes.

    Parameters
    ----------
    scenario : Scenario
        With ranges.
    count : int
        B.
    given : sequence of Scenario, length B, optional
        What each world keeps, instead of drawing from the ranges.

    Attributes
    ----------
    scenarios : list of Scenario, length B
        The present draws.
    motion_std : ndarray, shape (B, 3)
        Their (σx, σy, σα) [m, m, rad].
    settings : SensorSettings
        Those of their sensors.
    """

    changing = ("scenarios", "motion_std", "settings")

    def __init__(
        self, scenario: Scenario, count: int, given: Sequence[Scenario] = ()
    ) -> None:
        self._family, self._given = scenario, given
        self.scenarios = [scenario] * count
        self.motion_std = np.zeros((count, 3))
        rows = SensorSettings.of(scenario.sensor)
        self.settings = SensorSettings(*(part.repeat(count, axis=0) for part in rows))

    def begin(
        self, worlds: IndexArray, keys: WordArray
    ) -> tuple[ComplexArray, Array, Array]:
        """Draw the scenarios of the episodes with these keys, (b, 2), in some worlds.

        Returns
        -------
        landmarks, poses, estimates : ndarray, shapes (b, N), (b, 3), (b, 3)
            See `EpisodeStarts`.
        """
        if self._given:
            drawn = [self._given[world] for world in worlds.tolist()]
        else:
            drawn = drawn_scenarios(self._family, keys)
        for world, scenario in zip(worlds.tolist(), drawn, strict=True):
            self.scenarios[world] = scenario
            self.motion_std[world] = scenario.motion.std
            values = SensorSettings.of(scenario.sensor)
            for rows, value in zip(self.settings, values, strict=True):
                rows[world] = value[0]
        return _starts(drawn, keys)


def _starts(
    scenarios: list[Scenario], keys: WordArray
) -> tuple[ComplexArray, Array, Array]:
    rows = []
    for scenario, key in zip(scenarios, keys, strict=True):
        starts = EpisodeStarts(scenario)
        parts = starts.landmarks(key[None]), *starts.poses(key[None])
        rows.append([part[0] for part in parts])
    landmarks, poses, estimates = map(np.array, zip(*rows, strict=True))
    return landmarks, poses, estimates
