"""The simulated robot: its body, its walls, its odometry and its drive.

`UnicycleBody` drives, turns and stops at walls in the physics engine; `UnicycleBodies`
moves many robots in numpy. `OdometrySensor` decides which noise disturbs the motion,
and what the encoders report.

Symbols
-------
p = (x, y, θ)     true robot pose in the world frame [m, m, rad]
u = (d, α)        command: distance driven, then heading turned [m, rad]
ε = (εx, εy, εα)  slip, in the frame of the old heading [m, m, rad]

::

    x' = x + (d + εx) cos θ - εy sin θ
    y' = y + (d + εx) sin θ + εy cos θ
    θ' = θ + (α + εα)

This is the unicycle. Other `drives` replace (d, 0) by the displacement of an arc, and
convert (d, α) to what their odometry reports.

The filters' motion model and their arithmetic on angles are separate code in
`estimator`, which `envs` does not import. A simulator that shared the filter's model
could not reveal an error in it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, TypeVar

import numpy as np
import pymunk

from ..arrays import Array, BoolArray, ComplexArray, IndexArray, IntArray
from ..jit import jit_in_place, njit_internal
from ..restorable import Restorable, State
from ..sim_configs import Scenario
from .drives import RobotDrive, drive_of

_NO_SLIP = (0.0, 0.0, 0.0)


class UnicycleBody(Restorable):
    """A round body that moves by one displacement and one turn per step.

    The engine's body is kinematic and has no shape. Only its velocity moves it, so one
    `Space.step` of unit time adds the displacement of the drive equation exactly. The
    contacts of a disc do not depend on its heading, so θ is kept here and not in the
    engine. `WallContacts` shortens the displacement before each step.

    Parameters
    ----------
    radius : float
        Of the body [m].
    walls : sequence of (x0, y0, x1, y1)
        Ends of straight walls [m].
    drive : RobotDrive, optional
        How it moves (a unicycle).

    Attributes
    ----------
    frame : ndarray, shape (5, 1)
        x, y, θ, cos θ and sin θ; every step overwrites it.

    Examples
    --------
    >>> body = UnicycleBody(radius=0.5, walls=[(2.0, -1.0, 2.0, 1.0)])
    >>> body.drive((1.0, 0.3))
    1.0
    >>> body.pose
    array([1. , 0. , 0.3])
    """

    def __init__(
        self, radius: float, walls: Sequence[Wall] = (), drive: RobotDrive | None = None
    ) -> None:
        self._radius = radius
        self._walls = tuple(walls)
        self._drive = drive
        self._space = pymunk.Space()
        self._body = pymunk.Body(body_type=pymunk.Body.KINEMATIC)
        self._space.add(self._body)
        self._contacts = WallContacts(radius, self._walls)
        self.frame = np.zeros((5, 1))
        self.place((0.0, 0.0, 0.0))

    def state(self) -> State:
        """Return the pose, for `restore`."""
        return self._pose

    def restore(self, state: State) -> None:
        """Return to a pose."""
        self.place(state)

    @property
    def pose(self) -> Array:
        """(x, y, θ), shape (3,) [m, m, rad], a fresh array; θ is not wrapped."""
        return np.array(self._pose)

    def place(self, pose: Sequence[float]) -> None:
        """Put the body at (x, y, θ) [m, m, rad]."""
        x, y, heading = map(float, pose)
        self._body.position = x, y
        self._arrive(x, y, heading)

    def drive(
        self, command: Sequence[float], slip: Sequence[float] = _NO_SLIP
    ) -> float:
        """Move along the old heading, then turn.

        Parameters
        ----------
        command : (float, float)
            u = (d, α) [m, rad].
        slip : (float, float, float), default zeros
            ε [m, m, rad].

        Returns
        -------
        float
            Share of the displacement, in [0, 1], that the walls allowed. Walls do not
            affect the turn.
        """
        forward, sideways = command[0] + slip[0], slip[1]
        if self._drive is not None:
            ahead, aside = self._drive.path(*command)
            forward, sideways = ahead + slip[0], aside + slip[1]
        dx, dy = displacement(forward, sideways, self._cos, self._sin)
        share = 1.0
        if self._walls:
            (x, y, _), contacts = self._pose, self._contacts
            if is_near(x, y, dx, dy, contacts.ends, contacts.reach):
                share = contacts.free_share(x, y, dx, dy)
        if share < 1.0:
            dx, dy = share * dx, share * dy
        self._body.velocity = dx, dy
        self._space.step(1.0)
        self._arrive(*self._body.position, self._pose[2] + (command[1] + slip[2]))
        return share

    def _arrive(self, x: float, y: float, heading: float) -> None:
        """Set position and heading."""
        cos, sin = float(np.cos(heading)), float(np.sin(heading))
        self._pose = x, y, heading
        self._cos, self._sin = cos, sin
        self.frame[:, 0] = x, y, heading, cos, sin

    def __reduce__(self) -> tuple[Any, ...]:
        return UnicycleBody, (self._radius, self._walls, self._drive), self._pose

    def __setstate__(self, pose: tuple[float, float, float]) -> None:
        self.place(pose)


# --------------------------------------------------------------------------------------
# Contacts of a round body with straight walls, by queries of the physics engine.

Wall = tuple[float, float, float, float]

_SKIN = 1e-6  # distance kept from every wall [m]
_NEAR = 1e-3  # walls farther away than this on the whole way are not queried [m]
_ANYTHING = pymunk.ShapeFilter()


def wall_distances(points: ComplexArray, start: ComplexArray, along: Any) -> Array:
    """Compute the distances of points from walls.

    Parameters
    ----------
    points : complex ndarray, shape (…)
        x + iy [m].
    start, along : complex ndarray, shape (W,)
        One end of each wall, and the vector from it to the other end [m].

    Returns
    -------
    ndarray, shape (…, W)
        [m].
    """
    apart = points[..., None] - start
    squared = along.real**2 + along.imag**2
    foot = np.clip((apart * along.conj()).real / squared, 0.0, 1.0)
    return np.asarray(np.abs(apart - foot * along))


class WallContacts:
    """Computes how far a disc can move before walls stop it.

    The queries use walls inflated by the radius of the disc (a thick segment with a
    disc at either end), because Chipmunk's own queries with a radius miss contacts.

    Parameters
    ----------
    radius : float
        Of the disc [m].
    walls : sequence of (x0, y0, x1, y1)
        Ends of straight walls [m].

    Examples
    --------
    >>> contacts = WallContacts(radius=0.5, walls=[(2.0, -1.0, 2.0, 1.0)])
    >>> round(contacts.free_share(0.0, 0.0, dx=3.0, dy=0.0), 6)
    0.5
    """

    def __init__(self, radius: float, walls: Sequence[Wall] = ()) -> None:
        self._radius = radius
        self._walls = tuple(walls)
        self._space = pymunk.Space()
        for wall in self._walls:
            self._space.add(*_inflated(wall, radius, self._space.static_body))
        #: Ends of the walls, shape (W, 4) [m].
        self.ends = np.array(self._walls, dtype=np.float64).reshape(-1, 4)
        #: A way that stays farther than this from a wall does not touch it [m].
        self.reach = radius + _NEAR

    def free_share(self, x: float, y: float, dx: float, dy: float) -> float:
        """Return the share of a displacement up to 1 µm before the first contact.

        A wall does not stop a body that moves away from it, even from inside. So the
        body can always leave a wall.

        Parameters
        ----------
        x, y, dx, dy : float
            Start and displacement [m].

        Returns
        -------
        float
            In [0, 1].
        """
        share = 1.0
        for hit in self._space.segment_query((x, y), (x + dx, y + dy), 0.0, _ANYTHING):
            nx, ny = _outward(hit, (x, y))
            approach = -(dx * nx + dy * ny)
            if approach > 0.0:
                share = min(share, hit.alpha - _SKIN / approach)
        return max(share, 0.0)

    def __reduce__(self) -> tuple[Any, ...]:
        return WallContacts, (self._radius, self._walls)


def _inflated(wall: Wall, radius: float, ground: pymunk.Body) -> list[pymunk.Shape]:
    """Make the shapes that the centre of the body must not enter."""
    a, b = wall[:2], wall[2:]
    return [
        pymunk.Segment(ground, a, b, radius),
        pymunk.Circle(ground, radius, a),
        pymunk.Circle(ground, radius, b),
    ]


def _outward(
    hit: pymunk.SegmentQueryInfo, start: tuple[float, float]
) -> tuple[float, float]:
    """Return the outward normal; that of a path from inside points inwards."""
    if hit.alpha > 0.0 or hit.shape is None:
        return hit.normal
    return hit.shape.point_query(start).gradient


@jit_in_place
def is_near(
    x: float, y: float, dx: float, dy: float, walls: Array, reach: float
) -> bool:
    """Return whether a way from (x, y) comes within reach of a wall.

    A wall beyond the length of the way from its start is out of reach at once.
    """
    way, length = (x, y, x + dx, y + dy), math.sqrt(dx * dx + dy * dy)
    for w in range(len(walls)):
        wall = walls[w, 0], walls[w, 1], walls[w, 2], walls[w, 3]
        if _gap(way[0], way[1], wall) <= reach + length and _meet(way, wall, reach):
            return True
    return False


@njit_internal
def _meet(way: Wall, wall: Wall, reach: float) -> bool:
    """Return whether two segments come within reach of each other."""
    if _has_ends_apart(way, wall) and _has_ends_apart(wall, way):
        return True
    gap = min(_gap(way[0], way[1], wall), _gap(way[2], way[3], wall))
    return min(gap, _gap(wall[0], wall[1], way), _gap(wall[2], wall[3], way)) <= reach


@njit_internal
def _gap(x: float, y: float, segment: Wall) -> float:
    """Compute the distance of a point from a segment."""
    ax, ay, bx, by = segment
    along_x, along_y, apart_x, apart_y = bx - ax, by - ay, x - ax, y - ay
    squared = along_x * along_x + along_y * along_y
    share = (apart_x * along_x + apart_y * along_y) / squared if squared > 0.0 else 0.0
    share = min(max(share, 0.0), 1.0)
    apart_x, apart_y = apart_x - share * along_x, apart_y - share * along_y
    return math.sqrt(apart_x * apart_x + apart_y * apart_y)


@njit_internal
def _has_ends_apart(segment: Wall, other: Wall) -> bool:
    """Return whether the ends of a segment lie on both sides of another, or on it."""
    ax, ay, bx, by = other
    first = (segment[0] - ax) * (by - ay) - (segment[1] - ay) * (bx - ax)
    last = (segment[2] - ax) * (by - ay) - (segment[3] - ay) * (bx - ax)
    return first * last <= 0.0


class UnicycleBodies(Restorable):
    """B round bodies, each in its own world.

    The results equal those of `UnicycleBody` to the bit: sums, products and queries of
    walls are the same.

    Parameters
    ----------
    count : int
        B.
    radius : float
        Of every body [m].
    walls : sequence of (x0, y0, x1, y1)
        Ends of straight walls, the same in every world [m].
    drive : RobotDrive, optional
        How they move (unicycles).

    Attributes
    ----------
    frame : ndarray, shape (5, B)
        Rows x, y, θ, cos θ and sin θ; every step replaces it.

    Examples
    --------
    >>> bodies = UnicycleBodies(2, radius=0.5, walls=[(2.0, -1.0, 2.0, 1.0)])
    >>> bodies.drive(np.array([[1.0, 0.3], [3.0, 0.0]]), np.zeros((2, 3))).round(3)
    array([1. , 0.5])
    >>> bodies.poses().round(3)
    array([[1. , 0. , 0.3],
           [1.5, 0. , 0. ]])
    """

    changing = ()
    replaced = ("frame",)

    def __init__(
        self,
        count: int,
        radius: float,
        walls: Sequence[Wall] = (),
        drive: RobotDrive | None = None,
    ) -> None:
        self._drive = drive
        self._contacts = WallContacts(radius, walls)
        self._all, self._near = np.ones(count, np.bool_), np.zeros(count, np.int64)
        self._no_path = np.empty((0, 2))
        self.frame: Array = np.zeros((5, count))
        self._arrive(self.frame)

    def poses(self) -> Array:
        """(x, y, θ), shape (B, 3) [m, m, rad], a fresh array; θ is not wrapped."""
        return self.frame[:3].T.copy()

    def place(self, worlds: IndexArray, poses: Array) -> None:
        """Put some bodies at poses, rows (x, y, θ) [m, m, rad]."""
        frame = self.frame.copy()
        frame[:3, worlds] = poses.T
        self._arrive(frame)

    def drive(
        self, commands: Array, slip: Array, moving: BoolArray | None = None
    ) -> Array | None:
        """Move along the old headings, then turn.

        Parameters
        ----------
        commands : ndarray, shape (B, 2)
            u = (d, α) [m, rad].
        slip : ndarray, shape (B, 3)
            ε [m, m, rad].
        moving : bool ndarray, shape (B,), optional
            Which bodies move (all).

        Returns
        -------
        ndarray, shape (B,), or None
            Shares of the displacements, in [0, 1], that the walls allowed, 1 for bodies
            that do not move; None without walls.
        """
        path = self._no_path
        if self._drive is not None:
            path = np.column_stack(self._drive.path(*commands.T))
        frame, after = self.frame, np.empty(self.frame.shape)
        contacts, near = self._contacts, self._near
        bodies = frame, self._all if moving is None else moving, commands, path, slip
        walls, reach = contacts.ends, contacts.reach
        count = _move(*bodies, walls, reach, after, near)
        share = np.ones(len(commands)) if len(walls) else None
        if share is not None:
            for k in near[:count].tolist():
                (x, y), (dx, dy) = frame[:2, k].tolist(), after[:2, k].tolist()
                share[k] = free = contacts.free_share(x, y, dx, dy)
                after[0, k], after[1, k] = free * dx + x, free * dy + y
        self._arrive(after)
        return share

    def _arrive(self, frame: Array) -> None:
        """Adopt a frame with new rows x, y and θ, and compute its other rows."""
        heading = frame[2]
        np.cos(heading, frame[3])
        np.sin(heading, frame[4])
        self.frame = frame


@jit_in_place
def _move(  # noqa: PLR0917 (numba takes arrays more quickly than tuples of them)
    frame: Array,
    moving: BoolArray,
    commands: Array,
    path: Array,
    slip: Array,
    walls: Array,
    reach: float,
    after: Array,
    near: IntArray,
) -> int:
    """Move B bodies, and list those that come within reach of a wall instead.

    Parameters
    ----------
    frame, moving, commands, slip
        See `UnicycleBodies`.
    path : ndarray, shape (B, 2), or (0, 2) for unicycles
        Displacements in the robots' frames without slip [m].
    walls : ndarray, shape (W, 4)
        Ends of the walls [m].
    reach : float
        See `WallContacts`.
    after : ndarray, shape (5, B)
        Receives x, y and θ; for listed bodies dx, dy and θ.
    near : int64 ndarray, shape (B,)
        Receives the indices of the listed bodies at its front.

    Returns
    -------
    int
        The number of listed bodies.
    """
    count = 0
    for b in range(len(moving)):
        x, y, after[2, b] = frame[0, b], frame[1, b], frame[2, b]
        after[0, b], after[1, b] = x, y
        if not moving[b]:
            continue
        forward, sideways = commands[b, 0] + slip[b, 0], slip[b, 1]
        if len(path) > 0:
            forward, sideways = path[b, 0] + slip[b, 0], path[b, 1] + slip[b, 1]
        dx, dy = displacement_jit(forward, sideways, frame[3, b], frame[4, b])
        after[2, b] += commands[b, 1] + slip[b, 2]
        if dx * dx + dy * dy > 0.0 and is_near(x, y, dx, dy, walls, reach):
            after[0, b], after[1, b] = dx, dy
            near[count] = b
            count += 1
        else:
            after[0, b], after[1, b] = dx + x, dy + y
    return count


def displacement(
    forward: Number, sideways: Number, cos: Number, sin: Number
) -> tuple[Number, Number]:
    """Rotate a displacement from the robot's frame to the world frame.

    Parameters
    ----------
    forward, sideways : float, or ndarray of shape (…,)
        d + εx and εy [m].
    cos, sin : float, or ndarray of shape (…,)
        Of the old heading θ.

    Returns
    -------
    (x' - x, y' - y)
        World frame [m].

    Examples
    --------
    >>> displacement(2.0, 0.5, cos=0.0, sin=1.0)
    (-0.5, 2.0)
    """
    return forward * cos - sideways * sin, forward * sin + sideways * cos


displacement_jit = njit_internal(displacement)


# --------------------------------------------------------------------------------------
# The odometry.
#
# With ``noise_in = "motion"`` the robot slips and the odometry reports the command.
# With ``"odometry"`` the robot follows the command and the encoders have the noise.
# With ``noise_at_rest`` off, a step with the command (0, 0) has no noise. The faults of
# the scenario change what the encoders report of a step that moves: s scales its
# distance, b is added to its turn.

Command = tuple[float, float]
_NO_ERROR = (0.0, 0.0)
_NO_ERRORS = np.array(0.0)


class _Odometry:
    """The settings of the odometry of a scenario's robots."""

    def __init__(self, scenario: Scenario) -> None:
        self._slips = scenario.motion.noise_in == "motion"
        self._noise_at_rest = scenario.motion.noise_at_rest
        faults = scenario.present_faults
        self._gain, self._turn = 1.0 + faults.odometry_scale, faults.odometry_turn
        self._drive = drive_of(scenario.robot)


class OdometrySensor(_Odometry):
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
            Odometry ((1 + s) share d + εd, α + b + εα) [m, rad], or what the drive
            reports of it. Walls do not affect the turn.
        """
        distance, turn = command
        bias = self._turn if command != (0.0, 0.0) else 0.0
        driven, turned = self._gain * (share * distance) + error[0], turn + bias
        if self._drive is not None:
            return np.array(self._drive.reading(driven, turned))
        return np.array([driven, turned + error[1]])


class VectorOdometrySensor(_Odometry):
    """The odometry of B robots; the vector form of `OdometrySensor`.

    Parameters
    ----------
    scenario : Scenario
        Source of the motion's settings.
    count : int
        B.
    """

    def __init__(self, scenario: Scenario, count: int) -> None:
        super().__init__(scenario)
        self._no_slip = np.zeros((count, 3))

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
        if self._drive is not None:
            odometry = np.column_stack(self._drive.reading(*odometry.T))
        return odometry


Number = TypeVar("Number", float, Array)


def wrap_angle(angle: Number) -> Number:
    """Wrap an angle, or an array of angles, to [-π, π) up to rounding.

    Examples
    --------
    >>> wrap_angle(3 * math.pi / 2) == -math.pi / 2
    True
    """
    return (angle + math.pi) % (2 * math.pi) - math.pi


@njit_internal
def wrapped_bearing(angle: float) -> float:
    """Wrap an angle to [-π, π); one inside the interval keeps every bit."""
    if not (angle >= math.pi or angle < -math.pi):
        return angle
    wrapped = (angle + math.pi) % (2 * math.pi) - math.pi
    return wrapped if wrapped < math.pi else -math.pi  # a remainder rounds up to 2π
