"""Name the convention that estimates break: `mistake_in_estimates`.

A program that writes degrees, another order, or the covariance of another error is
wrong in a way that its NEES shows but does not name. `mistake_in_estimates` reads the
estimates in every other convention, and names the one that makes their errors honest,
or far smaller. An honest filter has nothing to name, nor has one that is wrong in any
reading.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import permutations
from typing import Any, NamedTuple

import numpy as np

from ..arrays import Array, IntArray
from ..estimator.models import rigid_motion
from ..estimator.models.bearing_range import wrap_angle
from ..evaluation.nees import pose_nees
from ..suggestions import counted

#: Drives from which on covariances are read in other conventions.
FEWEST_DRIVES = 5
#: Drives that are read so.
MOST_DRIVES = 200
_STEPS, _SHIFT = 24, 3
#: An honest square is within a factor _NEAR of 1 or _ERRORS standard errors, not beyond
#: the factor _FAR.
_NEAR, _FAR, _ERRORS = 1.5, 2.5, 3.0
_ROUNDED = 1e-9  # difference of poses that is rounding [m, m, rad]
_GAIN = 1.0  # of log-likelihood of a pose [nats]
#: NEES / 3 of a drive that another truth may fit, and how many of them are compared.
_LOST, _MOST_LOST = 10.0, 50
#: NEES / 3 of a pose that is no error of a filter, and the largest share of such.
_STRAY, _FEW = 100.0, 0.1
_SMALLER = 4.0  # by which errors fall in the right convention
_TURN = np.diag([1.0, 1.0, np.pi / 180])  # of headings in degrees


class PosesAsRead(NamedTuple):
    """Poses (B, K, 3) and covariances (B, K, 3, 3) as read in some convention."""

    #: What the file has; empty as it was declared.
    name: str
    poses: Array
    #: Of the additive error.
    covariances: Array
    #: Whether their error is exactly the additive one, not one to first order.
    is_additive: bool = False
    #: True poses of its own times; None if those are the declared ones.
    truth: Array | None = None


class _Agreement(NamedTuple):
    """How well a reading agrees with the truth."""

    #: Divided by 3; nan for what is no covariance.
    nees: float
    is_honest: bool
    #: Mean logarithm of the density of a pose, without constants.
    likelihood: float
    #: Root of the median squared error of position [m] and heading [rad].
    errors: tuple[float, float]


def mistake_in_estimates(
    truth: Array,
    poses: Array,
    claims: Array,
    starts: Array,
    frame: str = "additive",
    *,
    decides: str = "invariant",
    truth_at: Callable[[float], Array] | None = None,
) -> str:
    """Return the convention that poses of B drives break as a sentence; empty if none.

    Parameters
    ----------
    truth, poses : ndarray, shape (B, T, 3)
        True and estimated (x, y, θ) [m, m, rad], as in the file.
    claims : ndarray, shape (B, T, 3, 3)
        Covariances of the estimates, as in the file.
    starts : ndarray, shape (B, 3)
        Poses at which the drives start according to their files.
    frame : {"additive", "invariant", "left"}
        The error whose covariance the file is declared to hold.
    decides : {"invariant", "additive"}
        The error whose NEES counts where covariances are of the additive error.
    truth_at : callable, optional
        ``truth_at(steps)`` returns the true poses (B, T, 3) that number of steps later,
        nan where unknown. By default, they are interpolated.

    Examples
    --------
    >>> rng = np.random.default_rng(0)
    >>> truth = rng.uniform(-9, 9, (20, 50, 3))
    >>> poses = truth + rng.normal(0, 0.1, truth.shape)
    >>> claims = np.broadcast_to(np.eye(3) * 0.1, (20, 50, 3, 3))
    >>> print(mistake_in_estimates(truth, poses, claims, truth[:, 0]))
    standard deviations in place of variances: read so, NEES / 3 is 1.0..., not ...
    """
    if _are_same(truth, poses):
        return "the poses are the true ones to the last digit, not estimates."
    drives = np.flatnonzero(np.isfinite(poses).all(axis=(1, 2)))[:MOST_DRIVES]
    if not len(drives) or truth.shape[1] < 2:
        return ""
    posed = truth[drives], poses[drives], claims[drives]
    later = None if truth_at is None else lambda steps: truth_at(steps)[drives]
    exact, read = _all_readings(*posed, starts[drives], _Errors(frame, decides, later))
    (declared, *its_own), others = read[0], read[1:]
    before = _fit(exact, declared)
    if before.is_honest:
        return ""
    found = None
    if len(drives) >= FEWEST_DRIVES:
        groups = its_own, [r for own in others for r in own[:2]]
        both = [r for own in others if _gain(exact, own[0], before) for r in own[2:]]
        for group in (*groups, both):
            found = found or _honest(exact, group, before)
    if found is not None:
        reading, fit = found
        was = f"{before.nees:.3g}" if np.isfinite(before.nees) else "undefined"
        return f"{reading.name}: read so, NEES / 3 is {fit.nees:.2f}, not {was}."
    return _nearer(exact, [own[0] for own in others], before)


def _are_same(truth: Array, poses: Array) -> bool:
    """Whether poses are the true ones, except for the rounding of an interpolation."""
    gaps = abs(rigid_motion.additive_error(truth, poses))
    known = np.isfinite(gaps)
    return bool(known.any() and (gaps[known] < _ROUNDED).all())


class _Errors(NamedTuple):
    """The error of the covariances in a file, and the one whose NEES counts."""

    frame: str
    decides: str
    #: As in `mistake_in_estimates`.
    truth_at: Callable[[float], Array] | None = None


def _all_readings(
    truth: Array, poses: Array, claims: Array, starts: Array, errors: _Errors
) -> tuple[Array, list[list[PosesAsRead]]]:
    """Return true poses at some steps, and the readings by those of the poses."""
    last = claims.shape[1] - 1
    reach = min(_SHIFT, (last - 1) // 2)
    steps = np.unique(np.linspace(1 + reach, last - reach, _STEPS).round().astype(int))

    def at(shift: int) -> tuple[Array, Array]:
        return poses[:, steps + shift], claims[:, steps + shift]

    exact = truth[:, steps]
    shifts = [shift for shift in range(-reach, reach + 1) if shift]
    by_pose = list(_pose_readings(*at(0), starts, {k: at(k) for k in shifts}))
    by_pose += list(_in_other_units(exact, *at(0)))
    read = [list(_readings(*each, errors)) for each in by_pose]
    if reach:
        read += _between_steps(truth, steps, at(0), reach, errors)
    return exact, read


def swapped_drives(
    truth: Array, poses: Array, covariances: Array, names: Sequence[object]
) -> str:
    """Return a sentence if estimates are honest with the truth of other drives.

    Parameters
    ----------
    truth, poses : ndarray, shape (B, K, 3)
        Poses of B drives, nan where there are none.
    covariances : ndarray, shape (B, K, 3, 3)
        Of the additive error.
    names : sequence
        Of the drives.
    """
    swaps = []
    with np.errstate(invalid="ignore"):  # drives without estimates
        own = _mean_ratio(truth, poses, covariances)
        bad = np.flatnonzero(own > _LOST)
        for k in bad[:_MOST_LOST]:
            ratios = _mean_ratio(truth[bad], poses[k], covariances[k])
            if np.nanmin(ratios) < min(own[k] / _LOST, _LOST):
                swaps.append((names[k], names[bad[np.nanargmin(ratios)]]))
    if not swaps:
        return ""
    fits = "the estimate of drive {} fits the truth of drive {}"
    said = " and ".join(fits.format(*pair) for pair in swaps[:2])
    return f"estimates or truths of {len(swaps)} drives are swapped: {said}."


def _mean_ratio(truth: Array, poses: Array, covariances: Array) -> Array:
    """Return NEES / 3 averaged over the steps that have one; nan if none has."""
    ratios = pose_nees(truth, poses, covariances, frame="invariant") / 3
    known = np.isfinite(ratios)
    return np.asarray(np.where(known, ratios, 0).sum(axis=-1) / known.sum(axis=-1))


def stray_poses(ratios: Array, names: Sequence[object]) -> str:
    """Return a sentence if single poses between good ones make the errors large.

    The errors of a filter last; those of rows that are swapped or damaged do not.

    Parameters
    ----------
    ratios : ndarray, shape (B, T)
        NEES / 3 of each pose; nan where there is none.
    names : sequence
        Of the drives.
    """
    far = ratios > _STRAY
    good = np.pad(ratios < _LOST, ((0, 0), (2, 2)))
    before, after = good[:, :-4] | good[:, 1:-3], good[:, 3:-1] | good[:, 4:]
    lone = far & before & after
    rest = ratios[np.isfinite(ratios) & ~lone]
    if not lone.any() or lone.sum() > _FEW * lone.size or rest.mean() > _FAR:
        return ""
    run, step = np.argwhere(lone)[0]
    return (
        f"{lone.sum()} poses are far from the truth although their neighbours are not, "
        f"as in swapped rows; the first is step {step} of drive {names[run]}, and "
        f"without these poses, NEES / 3 is {rest.mean():.2f}."
    )


def _honest(
    truth: Array, readings: Sequence[PosesAsRead], before: _Agreement
) -> tuple[PosesAsRead, _Agreement] | None:
    """Return the honest reading of the largest likelihood; the first of equal ones."""
    fits = ((reading, _fit(truth, reading)) for reading in readings)
    least = before.likelihood + _GAIN
    found = [it for it in fits if it[1].is_honest and not it[1].likelihood < least]
    return max(found, key=lambda it: round(it[1].likelihood, 6), default=None)


def _gain(truth: Array, reading: PosesAsRead, before: _Agreement) -> float:
    """Return by how much the errors of poses fall [nats]; 0 if it is not far."""
    fits = before, _fit(truth, reading)
    was, now = (np.log(np.maximum(fit.errors, 1e-9)).sum() for fit in fits)
    gain = float(was - now)
    return gain if gain > np.log(_SMALLER) else 0.0


def _nearer(truth: Array, readings: Sequence[PosesAsRead], before: _Agreement) -> str:
    """Name the reading whose errors are far smaller, though not honest."""
    gains = [_gain(truth, reading, before) for reading in readings]
    reading = readings[int(np.argmax(gains))]
    if not max(gains) > 0:
        return ""
    (place, turn), (was_place, was_turn) = _fit(truth, reading).errors, before.errors
    return (
        f"{reading.name}: read so, the median errors are {place:.2g} m and {turn:.2g} "
        f"rad instead of {was_place:.2g} m and {was_turn:.2g} rad."
    )


def _fit(truth: Array, reading: PosesAsRead) -> _Agreement:
    """Compare a reading with the truth, by its own error of the pose."""
    truth = truth if reading.truth is None else reading.truth
    plain = rigid_motion.additive_error(truth, reading.poses)
    errors, covariances = plain, reading.covariances
    if not reading.is_additive:
        there, here = (
            rigid_motion.seen_from(reading.poses[..., :2], poses)
            for poses in (truth, reading.poses)
        )
        errors = rigid_motion.invariant_error(there, here)
        covariances = rigid_motion.invariant_covariance(here, covariances)
    order = [2, 0, 1]  # the heading first: no frame changes it
    middle = (
        float(np.sqrt(np.nanmedian((plain[..., :2] ** 2).sum(axis=-1)))),
        float(np.sqrt(np.nanmedian(plain[..., 2] ** 2))),
    )
    ordered = covariances[..., order, :][..., order]
    white, log_det = _whitened(errors[..., order], ordered)
    squares = (white**2).mean(axis=1)  # (B, 3): one number per run, and component
    mean = squares.mean(axis=0)
    if not np.isfinite(mean).all() or not mean.all():
        return _Agreement(np.nan, False, -np.inf, middle)
    likelihood = -0.5 * float(((white**2).sum(axis=-1) + log_det).mean())
    spread = squares.std(axis=0) / np.sqrt(len(squares)) / mean
    limit = np.minimum(np.log(_NEAR) + _ERRORS * spread, np.log(_FAR))
    is_honest = bool((np.abs(np.log(mean)) <= limit).all())
    return _Agreement(float(mean.mean()), is_honest, likelihood, middle)


def _whitened(errors: Array, covariances: Array) -> tuple[Array, Array]:
    """Return L⁻¹ e and log |P|, P = L Lᵀ; nan where P is no covariance."""
    P = covariances
    with np.errstate(invalid="ignore", divide="ignore"):
        l00 = np.sqrt(P[..., 0, 0])
        l10, l20 = P[..., 1, 0] / l00, P[..., 2, 0] / l00
        l11 = np.sqrt(P[..., 1, 1] - l10**2)
        l21 = (P[..., 2, 1] - l20 * l10) / l11
        l22 = np.sqrt(P[..., 2, 2] - l20**2 - l21**2)
        w0 = errors[..., 0] / l00
        w1 = (errors[..., 1] - l10 * w0) / l11
        w2 = (errors[..., 2] - l20 * w0 - l21 * w1) / l22
        log_det = 2 * np.log(l00 * l11 * l22)
    return np.stack([w0, w1, w2], axis=-1), log_det


# --------------------------------------------------------------------------------------
# The conventions: of the poses, and of the covariances beside them.

_ORDERS = {
    f"the order ({', '.join(name)}) instead of (x, y, θ)": np.eye(3)[
        [name.index(entry) for entry in "xyθ"]
    ]
    for name in permutations("xyθ")
    if name != tuple("xyθ")
}
FRAMES = {
    "additive": "the additive error",
    "left": "the left-invariant error (the robot's frame)",
    "invariant": "the right-invariant error (the world's frame)",
}
_LINEAR = {
    "headings in degrees instead of radians": _TURN,
    "headings that grow clockwise": np.diag([1.0, 1.0, -1.0]),
    "y to the right of x": np.diag([1.0, -1.0, 1.0]),
    "y to the right of x, and headings that grow clockwise": np.diag([1.0, -1.0, -1.0]),
    **_ORDERS,
}
_TURNED = {
    np.pi / 2: "headings that are 90° too small",
    np.pi: "headings that are 180° off",
    -np.pi / 2: "headings that are 90° too large",
}
#: Metres.
_UNITS = {"millimetres": 1e-3, "centimetres": 1e-2, "inches": 0.0254, "feet": 0.3048}
#: Units of the standard deviations of positions, as matrices that convert them.
_COVARIANCE_UNITS = {
    what: np.diag([scale, scale, 1.0])
    for unit, size in (("centimetres", 1e-2), ("millimetres", 1e-3))
    for what, scale in ((unit, size), (f"metres, but poses in {unit}", 1 / size))
}
_ALIKE = 0.1  # logarithm of two scales that are the same
_FINEST = 0.15  # part of a step by which a shift differs from whole steps


#: Name, poses, covariances as in the file, and the Jacobian of the poses by its own.
_Read = tuple[str, Array, Array, Array]


def _pose_readings(
    poses: Array, covariances: Array, starts: Array, shifted: Mapping[int, Any]
) -> Iterator[_Read]:
    """Yield the poses in all conventions, as declared first."""
    yield "", poses, covariances, np.eye(3)
    flipped = np.diag([1.0, 1.0, -1.0])
    for name, matrix in _LINEAR.items():
        yield name, poses @ matrix.T, covariances, matrix
    for angle, name in _TURNED.items():
        turned = np.concatenate([poses[..., :2], poses[..., 2:] + angle], axis=-1)
        yield name, turned, covariances, np.eye(3)
    compass = poses @ flipped + [0, 0, np.pi / 2]
    yield "headings clockwise from the y axis", compass, covariances, flipped
    turn = _rotations(-poses[..., 2])
    back = -(turn @ poses[..., None])[..., 0]
    by = -turn
    by[..., 0, 2], by[..., 1, 2] = back[..., 1], -back[..., 0]
    name = "poses of the world as the robot sees it (inverse)"
    yield name, back, covariances, by
    start = starts[:, None, :]
    turn = _rotations(start[..., 2])
    moved = start + (turn @ poses[..., None])[..., 0]
    yield "poses in the frame of the start", moved, covariances, turn
    for shift, (others, theirs) in shifted.items():
        late, count = "late" if shift > 0 else "early", abs(shift)
        name = f"time stamps that are {counted(count, 'step')} too {late}"
        yield name, others, theirs, np.eye(3)


def _in_other_units(truth: Array, poses: Array, covariances: Array) -> Iterator[_Read]:
    """Yield the poses in the unit that brings their paths to the size of the true ones.

    The scale is ‖g'‖ / ‖e'‖ of the true positions g' and the estimates e' about the
    centres of their drives.
    """
    spread = [
        np.square(each[..., :2] - each[..., :2].mean(axis=1, keepdims=True)).sum()
        for each in (truth, poses)
    ]
    with np.errstate(divide="ignore", invalid="ignore"):
        scale = float(np.sqrt(spread[0] / spread[1]))
    if not (np.isfinite(scale) and scale > 0 and abs(np.log(scale)) > _ALIKE):
        return
    name, scale = unit_of(scale)
    matrix = np.diag([scale, scale, 1.0])
    yield name, poses @ matrix.T, covariances, matrix


def unit_of(scale: float) -> tuple[str, float]:
    """Return the name and size of the known unit nearest to a scale of positions.

    Examples
    --------
    >>> unit_of(0.0102), unit_of(0.7)
    (('positions in centimetres', 0.01), ('positions in a unit of 0.7 m', 0.7))
    """
    known = {f"positions in {unit}": size for unit, size in _UNITS.items()}
    known |= {f"a truth in {unit}": 1 / size for unit, size in _UNITS.items()}
    for name, size in known.items():
        if abs(np.log(scale / size)) < _ALIKE:
            return name, size
    return f"positions in a unit of {scale:.3g} m", scale


def _between_steps(
    truth: Array,
    steps: IntArray,
    estimates: tuple[Array, Array],
    reach: int,
    of: _Errors,
) -> list[list[PosesAsRead]]:
    """Read the estimates at the times between steps that fit their positions best."""
    poses, claims = estimates
    offsets = np.arange(-10 * reach + 1, 10 * reach) / 10
    moved = [_truth_at(truth, steps - offset) for offset in offsets]
    if of.truth_at is not None:
        known = [of.truth_at(-float(offset))[:, steps] for offset in offsets]
        moved = [
            np.where(np.isfinite(exact), exact, between)
            for exact, between in zip(known, moved, strict=True)
        ]
    gaps = [np.nanmean(np.square(each - poses)[..., :2]) for each in moved]
    best = int(np.argmin(gaps))
    offset = float(offsets[best])
    if abs(offset - round(offset)) < _FINEST:
        return []
    side = "late" if offset > 0 else "early"
    name = f"time stamps that are {abs(offset):.1f} steps too {side}"
    found = _readings(name, poses, claims, np.eye(3), of)
    return [[each._replace(truth=moved[best]) for each in found]]


def _truth_at(truth: Array, places: Array) -> Array:
    """Return true poses (B, K, 3) between steps, on the arcs that join them."""
    before = np.floor(places).astype(int)
    start, end = truth[:, before], truth[:, before + 1]
    error = rigid_motion.invariant_error(end, start) * (places - before)[:, None]
    turn = error[..., 2]
    point = np.exp(1j * turn) * (start[..., 0] + 1j * start[..., 1])
    point += rigid_motion.left_jacobian(turn) * (error[..., 0] + 1j * error[..., 1])
    heading = start[..., 2] + turn
    return np.stack([point.real, point.imag, heading], axis=-1)


def _transported(claims: Array, poses: Array) -> Iterator[tuple[str, Array, str]]:
    """Yield covariances P of an error for C = Jᵀ P J, J from that error to another."""
    kinds = tuple(FRAMES)
    to_additive = {kind: _jacobian(poses, kind) for kind in kinds}
    for kind, target in permutations(kinds, 2):
        back = np.linalg.solve(to_additive[kind], to_additive[target])  # J⁻¹
        title = FRAMES[kind]
        name = f"covariances of {title} transported by Jᵀ P J instead of J P Jᵀ"
        yield name, np.swapaxes(back, -1, -2) @ claims @ back, kind


def additive_covariances(poses: Array, covariances: Array, frame: str) -> Array:
    """Return covariances of the additive error for those of another error.

    To first order, with the rotation R of θ̂ and J = [0 −1; 1 0]::

        left        e = diag(R, 1) ξ
        invariant   e = ξ + (J p̂, 0) ξ_θ

    Parameters
    ----------
    poses : ndarray, shape (..., 3)
        Estimates (x̂, ŷ, θ̂) [m, m, rad].
    covariances : ndarray, shape (..., 3, 3)
        Of the error in the frame.
    frame : {"additive", "invariant", "left"}
        The error of the covariances.
    """
    if frame == "additive":
        return covariances
    jacobian = _jacobian(poses, frame)
    return np.asarray(jacobian @ covariances @ np.swapaxes(jacobian, -1, -2))


def _jacobian(poses: Array, frame: str) -> Array:
    """Return ∂e/∂ξ of the additive error by that of a frame, shape (..., 3, 3)."""
    jacobian = _rotations(poses[..., 2] * (frame == "left"))
    if frame == "invariant":
        jacobian[..., 0, 2], jacobian[..., 1, 2] = -poses[..., 1], poses[..., 0]
    return jacobian


def _rotations(angles: Array) -> Array:
    """Return R of each angle for poses, shape (..., 3, 3)."""
    cos, sin, zero = np.cos(angles), np.sin(angles), np.zeros_like(angles)
    rows = cos, -sin, zero, sin, cos, zero, zero, zero, zero + 1
    return np.stack(rows, axis=-1).reshape(*angles.shape, 3, 3)


def _readings(
    name: str, poses: Array, claims: Array, jacobian: Array, of: _Errors
) -> Iterator[PosesAsRead]:
    """Yield poses with their covariances in all conventions.

    As declared first, and where the convention of the poses is another, then those that
    follow it.
    """
    poses = np.concatenate([poses[..., :2], wrap_angle(poses[..., 2:])], axis=-1)

    def read(what: str, matrices: Array, kind: str = of.frame) -> PosesAsRead:
        whole = f"{name}; {what}" if name and what else name or what
        claimed = additive_covariances(poses, matrices, kind)
        return PosesAsRead(whole, poses, claimed, kind == of.decides == "additive")

    yield read("", claims)
    if name:
        yield read("", jacobian @ claims @ np.swapaxes(jacobian, -1, -2))
    if np.triu(claims, 1).any():  # covariances of other errors are not diagonal
        others = [kind for kind in FRAMES if kind != of.frame]
        found = [(f"covariances of {FRAMES[kind]}", claims, kind) for kind in others]
        for what, matrices, kind in (*found, *_transported(claims, poses)):
            yield read(what, matrices, kind)
    yield read("covariances with headings in degrees", _TURN @ claims @ _TURN)
    for what, D in _COVARIANCE_UNITS.items():
        yield read(f"covariances with positions in {what}", D @ claims @ D)
    for order, matrix in _ORDERS.items():
        yield read(f"covariances with {order}", matrix @ claims @ matrix.T)
    xx, xy, xt, yy, yt, tt = np.moveaxis(claims[..., *np.triu_indices(3)], -1, 0)
    lower = np.stack([xx, xy, yy, xy, xt, yt, yy, yt, tt], axis=-1)
    by_rows = lower.reshape(claims.shape)
    yield read("the lower triangle of the covariance, row by row", by_rows)
    yield read("standard deviations in place of variances", np.sign(claims) * claims**2)
    known = np.isfinite(claims).all(axis=(-2, -1)) & (np.linalg.det(claims) > 0)
    information = np.linalg.inv(np.where(known[..., None, None], claims, np.eye(3)))
    yield read("information matrices in place of covariances", information)
