"""Motion models: the pose after one odometry reading, with its Jacobians.

A drive's odometry determines a displacement b(u) in the robot's frame, whatever the
pose.  So a drive is a `Motion`, a value with one small function, and every filter
predicts in the same way from what that function returns::

    g(p, u, ε) = p ⊕ (b(u) + ε)

`UNICYCLE`, `differential` and `bicycle` are shipped; `find_motion` reads their labels,
and `check_motion` tests one of your own.  `predict_pose` is the prediction in numpy.
Kernels call its compiled twin `composed_jit`.

Symbols
-------
p = (x, y, θ)    robot pose in the world frame [m, m, rad]
u = (u0, u1)     odometry, in the columns of the drive
b = (dx, dy, α)  displacement in the robot's frame, then turn [m, m, rad]
ε = (εx, εy, εα) motion noise in the robot's own frame [m, m, rad], ε ~ N(0, R)
"""

from __future__ import annotations

import re
import tomllib
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from ... import argument_checks
from ...arrays import LARGEST, Array
from .rigid_motion import composed

Real = Any  # a number, or an array of any shape


@dataclass(frozen=True)
class Motion:
    """A drive as a value: what its odometry reports, and how the robot moves by it.

    Parameters
    ----------
    name : str
        A label from which `find_motion` makes an equal drive, as ``"unicycle"`` or
        ``"module:NAME"``.
    columns, units : tuple of 2 str
        The two numbers of its odometry, for files and messages.
    displacement : callable
        b(u0, u1) → (dx, dy, α) [m, m, rad], for numbers and for arrays.  (0, 0) is
        rest, and gives zeros.

    Examples
    --------
    An omnidirectional robot that reports its motion ahead and to the left:

    >>> from slamgym.estimator.models import check_motion
    >>> omni = Motion("omni", ("ahead", "left"), ("m", "m"), lambda a, l: (a, l, 0 * a))
    >>> check_motion(omni)
    """

    name: str
    columns: tuple[str, str]
    units: tuple[str, str]
    displacement: Callable[[Real, Real], tuple[Real, Real, Real]]

    def __post_init__(self) -> None:
        for name in ("columns", "units"):
            if len(getattr(self, name)) != 2:
                raise ValueError(
                    f"{name} of motion '{self.name}' must name the two numbers of its "
                    f"odometry, got {getattr(self, name)!r}"
                )
        if not callable(self.displacement):
            raise ValueError(
                f"displacement of motion '{self.name}' must be a function, "
                f"got {self.displacement!r}"
            )
        rest: Any
        try:
            rest = [float(part) for part in self.displacement(0.0, 0.0)]
        except (TypeError, ValueError, ArithmeticError) as error:
            rest = error
        if rest != [0.0, 0.0, 0.0]:
            raise ValueError(
                f"displacement of motion '{self.name}' must return (dx, dy, α), and "
                f"zeros for the odometry (0, 0), got {rest}"
            )

    def moved(self, odometry: ArrayLike) -> tuple[float, float, float]:
        """Return b of one reading, or refuse it."""
        return self.moved_by(*argument_checks.pair("odometry", odometry))

    def moved_by(self, first: float, second: float) -> tuple[float, float, float]:
        """Return b of two numbers of a usable size, or refuse it."""
        if self.displacement is _ahead:  # already checked; three times as fast
            return first, 0.0, second
        dx, dy, turn = map(float, self.displacement(first, second))
        if not (abs(dx) <= LARGEST and abs(dy) <= LARGEST and abs(turn) <= LARGEST):
            raise ValueError(
                f"odometry must give a finite displacement with motion '{self.name}', "
                f"got {(first, second)!r}"
            )
        return dx, dy, turn

    def displacements(self, odometry: Array) -> Array:
        """Return b of many readings, shape (…, 2) → (…, 3)."""
        moved = np.empty((*odometry.shape[:-1], 3))
        parts = self.displacement(odometry[..., 0], odometry[..., 1])
        moved[..., 0], moved[..., 1], moved[..., 2] = parts
        return moved


def _ahead(distance: Real, turn: Real) -> tuple[Real, Real, Real]:
    return distance, 0.0, turn


#: Drive d along the heading, then turn by α: b = (d, 0, α).
UNICYCLE = Motion("unicycle", ("d", "alpha"), ("m", "rad"), _ahead)


def differential(track_width: float) -> Motion:
    """Return the drive of a robot with two wheels on one axle.

    Its odometry is the travel of the wheels, (l, r) [m].  Both turn at constant speeds,
    so the robot follows an arc::

        d = (l + r) / 2,   α = (r − l) / w,   b = (d S(α/2) cos(α/2), d S(α/2) sin(α/2), α)

    with S(t) = sin(t) / t.

    Parameters
    ----------
    track_width : float
        w, the distance of the wheels [m].

    Notes
    -----
    S. Thrun, W. Burgard, D. Fox, Probabilistic Robotics, MIT Press, 2005, section
    5.3, for the arc.

    Examples
    --------
    >>> [round(float(part), 6) for part in differential(0.5).displacement(1.0, 1.0)]
    [1.0, 0.0, 0.0]
    """  # noqa: E501 (an equation)
    width = argument_checks.above("track_width", track_width, 0.0)
    name = f"differential[track_width={width!r}]"
    return Motion(name, ("left", "right"), ("m", "m"), _Differential(width))


def bicycle(wheelbase: float, reference: tuple[float, float] = (0.0, 0.0)) -> Motion:
    """Return the drive of a car, as a bicycle with one steered front wheel.

    Its odometry is the distance driven by the middle of the rear axle, and the steering
    angle, (d, φ) [m, rad].  The axle follows an arc with α = d tan φ / L, and the pose
    is that of the reference point (a, b), where the sensor is::

        b = arc(d, α) + (R(α) − I) (a, b)

    Parameters
    ----------
    wheelbase : float
        L, the distance of the axles [m].
    reference : (float, float)
        Place of the pose, ahead and to the left of the middle of the rear axle [m].

    Notes
    -----
    J. Guivant, E. Nebot, Optimization of the simultaneous localization and map-building
    algorithm for real-time implementation, IEEE T-RA 17(3), 2001, with the arc in
    place of their step along the tangent.

    Examples
    --------
    >>> [round(float(part), 6) for part in bicycle(2.0).displacement(1.0, 0.0)]
    [1.0, 0.0, 0.0]
    """
    length = argument_checks.above("wheelbase", wheelbase, 0.0)
    a, b = argument_checks.pair("reference", reference)
    where = f", reference=[{a!r}, {b!r}]" if a or b else ""
    name = f"bicycle[wheelbase={length!r}{where}]"
    return Motion(name, ("d", "steering"), ("m", "rad"), _Bicycle(length, a, b))


@dataclass(frozen=True)
class _Differential:  # not a closure, so that a motion can be pickled
    width: float

    def __call__(self, left: Real, right: Real) -> tuple[Real, Real, Real]:
        return _arc((left + right) / 2, (right - left) / self.width)


@dataclass(frozen=True)
class _Bicycle:
    wheelbase: float
    ahead: float
    left: float

    def __call__(self, distance: Real, steering: Real) -> tuple[Real, Real, Real]:
        dx, dy, turn = _arc(distance, distance * np.tan(steering) / self.wheelbase)
        sin, versed = np.sin(turn), 2 * np.sin(turn / 2) ** 2  # 1 − cos α
        dx -= versed * self.ahead + sin * self.left
        return dx, dy + sin * self.ahead - versed * self.left, turn


def _arc(distance: Real, turn: Real) -> tuple[Real, Real, Real]:
    """Return the displacement along an arc of this length and angle."""
    chord = distance * np.sinc(turn / (2 * np.pi))
    return chord * np.cos(turn / 2), chord * np.sin(turn / 2), turn


#: The shipped drives by name: functions of their lengths.
MOTIONS: dict[str, Callable[..., Motion]] = {
    "unicycle": lambda: UNICYCLE,
    "differential": differential,
    "bicycle": bicycle,
}


def find_motion(motion: str | Motion) -> Motion:
    """Return a drive from its label; a `Motion` is returned unchanged.

    Parameters
    ----------
    motion : str or Motion
        ``"unicycle"``, ``"differential[track_width=0.4]"``,
        ``"bicycle[wheelbase=2.8, reference=[1.0, 0.0]]"``, or ``"module:NAME"``.

    Raises
    ------
    ValueError
        If there is no such drive, or its lengths are wrong.

    Examples
    --------
    >>> find_motion("differential[track_width=0.4]").columns
    ('left', 'right')
    """
    if isinstance(motion, Motion):
        return motion
    if not isinstance(motion, str):
        raise ValueError(f"motion must be a label or a Motion, got {motion!r}")
    from ...suggestions import closest, imported  # noqa: PLC0415 (for labels)

    if re.fullmatch(r"[\w.]+:\w+", motion):
        return find_motion(imported(motion, f"cannot import motion '{motion}': "))
    match = re.fullmatch(r"\s*(\w+)\s*(?:\[(.*)\])?\s*", motion, re.DOTALL)
    name = match[1] if match else motion
    if match is None or name not in MOTIONS:
        raise ValueError(
            f"motion must be one of {', '.join(MOTIONS)} with its lengths in brackets, "
            f"got '{motion}'{closest(name, MOTIONS)}"
        )
    try:
        lengths = tomllib.loads(f"of = {{ {match[2] or ''} }}")["of"]
        return MOTIONS[name](**lengths)
    except (tomllib.TOMLDecodeError, TypeError) as error:
        raise ValueError(
            "motion must be like differential[track_width=0.4] or "
            f"bicycle[wheelbase=2.8], got '{motion}': {error}"
        ) from None


@dataclass(frozen=True, slots=True)
class MotionNoise:
    """A drive with the variances of its noise, and whether there is noise at rest."""

    #: (σx², σy², σα²) per step of dt = 1, shape (3,) [m², m², rad²].
    variance: Array
    #: False: odometry that moves nothing adds no noise.
    at_rest: bool = True
    motion: Motion = UNICYCLE

    @classmethod
    def checked(
        cls, motion_std: ArrayLike, noise_at_rest: bool, motion: str | Motion = UNICYCLE
    ) -> MotionNoise:
        """Return the noise of these standard deviations (3,), or refuse them."""
        std = argument_checks.standard_deviations("motion_std", motion_std, 3)
        at_rest = argument_checks.flag("noise_at_rest", noise_at_rest)
        return cls(std**2, at_rest, find_motion(motion))

    def weight(self, moved: tuple[float, float, float], dt: float) -> float:
        """Return the factor of the variances for a displacement over dt steps.

        Raises
        ------
        ValueError
            If dt is no number, negative, or too large.
        """
        dt = argument_checks.duration(dt)
        return dt if self.at_rest or any(moved) else 0.0

    def over(self, moved: tuple[float, float, float], dt: float) -> Array:
        """Return the variances (3,) of a displacement over dt steps."""
        return self.variance * self.weight(moved, dt)


def only_unicycle(motion: Motion, part: str) -> None:
    """Refuse other drives where a part takes the unicycle's odometry only."""
    if motion != UNICYCLE:
        raise ValueError(
            f"{part} takes the odometry of a unicycle only, got motion '{motion.name}'"
        )


class MotionPrediction(NamedTuple):
    """Next pose and its first derivatives."""

    pose: Array  # (3,)
    jacobian_pose: Array  # (3, 3), G = ∂g/∂p
    jacobian_noise: Array  # (3, 3), F = ∂g/∂ε


def predict_pose(pose: Array, odometry: Array) -> MotionPrediction:
    """Move a pose by one odometry reading, with both Jacobians.

    The robot moves by (dx, dy) in its old frame, then turns by α; a unicycle drives
    d = dx along its heading, dy = 0::

        g(p, u, ε) = p + (dx + εx) (cos θ,  sin θ, 0)
                       + (dy + εy) (-sin θ, cos θ, 0)
                       + (α + εα) (0, 0, 1)

    All are evaluated at ε = 0.  θ is not wrapped, so that the pose stays
    differentiable: wrap differences of angles, never the state.

    Parameters
    ----------
    pose : ndarray, shape (3,)
        p = (x, y, θ) [m, m, rad].
    odometry : ndarray, shape (2,) or (3,)
        u = (d, α) of a unicycle [m, rad], or the displacement (dx, dy, α) of any drive.

    Returns
    -------
    MotionPrediction
        Predicted pose (3,), G (3, 3) and F (3, 3).  The predicted covariance of the
        pose is G Σ Gᵀ + F R Fᵀ.

    Notes
    -----
    CMU 16-833, EKF-SLAM homework, eqs. 1.1 and 1.2; the model of [1]_, section 5.4,
    without the first of its two rotations.

    References
    ----------
    .. [1] S. Thrun, W. Burgard, D. Fox, Probabilistic Robotics, MIT Press, 2005.

    Examples
    --------
    >>> predict_pose(np.zeros(3), np.array([2.0, 0.5])).pose
    array([2. , 0. , 0.5])
    """
    ahead, *aside, turn = odometry
    left = aside[0] if aside else 0.0
    x, y, heading, cos, sin = composed(pose[0], pose[1], pose[2], ahead, left, turn)
    along, across = ahead * cos - left * sin, ahead * sin + left * cos
    return MotionPrediction(
        pose=np.array([x, y, heading]),
        jacobian_pose=np.array([[1, 0, -across], [0, 1, along], [0, 0, 1]]),
        jacobian_noise=np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]]),
    )
