"""Tests of the actual noise of a world: its size, its mean and its tails.

If the truth is known, all noise values are known: the motion noise is the true motion
minus the odometry, and the sensor noise is the reading minus the true bearing or range.
`noise_sums` divides each by the standard deviation that the filter assumes. In a world
without faults, the resulting numbers are independent and standard normal, over time as
well as over runs. Every test of `noise_findings` therefore has a known distribution for
any number of runs or steps.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import chdtr, chdtrc, ndtr, stdtr

from .. import argument_checks
from ..arrays import SMALLEST, Array, BoolArray, IntArray
from ..estimator.models.bearing_range import wrap_angle
from ..estimator.models.sensors import Sensor, only_bearing_range

#: The five noises: εx, εy, εα of the motion, εβ, εr of the readings.
CHANNELS = ("along", "sideways", "turn", "bearing", "range")
_SYMBOLS = dict(zip(CHANNELS, ("σx", "σy", "σα", "σβ", "σr"), strict=True))
_BIASES = {
    "along": "odometry scale",
    "turn": "odometry turn",
    "bearing": "bearing bias",
    "range": "range bias",
}
HEAVY_TAILS, CORRELATED = "heavy tails", "correlated noise"
_LEAST_VARIANCE = 0.05
_LEAST_CORRELATION = 0.05
_LEAST_BIAS = 0.1
_LEAST_KURTOSIS = 0.5
_LEAST_GROWTH = 0.2
_FEWEST = 30  # numbers, for the distribution of the kurtosis


class NoiseFinding(NamedTuple):
    """The result of one test on one noise."""

    cause: str
    #: Two-sided, not adjusted for other tests.
    p_value: float
    #: Estimate of the relative change in NEES; ranks findings.
    impact: float
    #: Whether it is large enough to change NEES.
    matters: bool
    #: What is wrong, to follow "because".
    text: str
    #: 1 if it makes errors larger than the covariances state, -1 if smaller, else 0.
    sign: int = 1
    #: Largest ratio of the NEES that it explains in a linear filter.
    at_most: float = np.inf


def noise_findings(sums: Array) -> list[NoiseFinding]:
    """Test each noise that has numbers.

    ::

        size   (n − 1) s² ~ χ²(n − 1),    matters if |s² − 1| ≥ .05
        mean   b = Σ g w / Σ g²,  b √(Σ g²) / s ~ t(n − 1),
               matters if b² Σ g², averaged over runs, ≥ .1
        tails  kurtosis of n numbers [1]_,  matters if it is .5 above that of a normal
        time   correlation ρ of m pairs of successive numbers, without their mean,
               ρ √m ~ N(0, 1),  matters if |ρ| ≥ .05
        far    correlation ρ of w² and the distance of the landmark, ρ √n ~ N(0, 1)
               [2]_,  matters if the variances at one deviation of the distances below
               and above their mean differ by .2 of the variance

    A variance that depends on the distance makes the kurtosis of all numbers larger;
    this part of it does not count as tails.

    Parameters
    ----------
    sums : ndarray, shape (B, 5, 12)
        Of :func:`noise_sums`.

    References
    ----------
    .. [1] F. J. Anscombe, W. J. Glynn, Distribution of the kurtosis statistic b2 for
       normal samples, Biometrika 70(1), 1983.
    .. [2] R. Koenker, A note on studentizing a test for heteroscedasticity, Journal of
       Econometrics 17(1), 1981.
    """
    return [
        finding
        for index, channel in enumerate(CHANNELS)
        if sums[:, index, 0].sum() >= _FEWEST
        for finding in _tests(channel, sums[:, index].sum(axis=0), len(sums))
    ]


def significant_findings(sums: Array, error_rate: float) -> list[NoiseFinding]:
    """Return what is wrong with the noise, the largest effect first.

    The p-values are adjusted for the number of tests.
    """
    findings = noise_findings(sums)
    adjusted = [f._replace(p_value=f.p_value * len(findings)) for f in findings]
    guilty = [f for f in adjusted if f.p_value < error_rate and f.matters]
    return sorted(guilty, key=lambda f: -f.impact)


def _tests(channel: str, total: Array, runs: int) -> Iterator[NoiseFinding]:
    known = dict(zip(MOMENTS, total.tolist(), strict=False))
    found = dict.fromkeys(MOMENTS, 0.0) | known  # earlier results have no distances
    count = found["count"]
    mean = found["first"] / count
    variance = (found["second"] - count * mean**2) / (count - 1)
    if channel in _BIASES and found["leverage"] > 0:
        yield _bias(channel, found, variance, runs)
    growth = _growth(channel, found, variance)
    is_growing = growth is not None and growth.matters and growth.p_value < 1e-4
    kurtosis = _kurtosis(found, mean, variance, is_growing)
    tails = None if kurtosis is None else _tails(channel, count, variance, kurtosis)
    if tails is not None:
        yield tails
    if growth is not None:
        yield growth
    has_tails = tails is not None and tails.matters and tails.p_value < 1e-4
    if kurtosis is not None and has_tails and not is_growing:
        yield _size_beside_tails(channel, count, variance, kurtosis)
    elif not is_growing:
        yield _size(channel, count, variance)
    if found["pairs"] >= _FEWEST and variance > 0:
        yield _correlation(channel, found, mean, variance)


def _correlation(
    channel: str, found: dict[str, float], mean: float, variance: float
) -> NoiseFinding:
    pairs = found["pairs"]
    rho = (found["lagged"] / pairs - mean**2) / variance
    return NoiseFinding(
        CORRELATED,
        float(2 * ndtr(-abs(rho) * np.sqrt(pairs))),
        abs(float(np.log((1 + min(rho, 0.99)) / (1 - min(rho, 0.99))))),
        abs(rho) >= _LEAST_CORRELATION,
        f"successive errors of {_SYMBOLS[channel]} have a correlation of {rho:.2g}, "
        "where the filter assumes none",
        sign=0,
    )


def _growth(
    channel: str, found: dict[str, float], variance: float
) -> NoiseFinding | None:
    """Test whether the variance depends on the distance; None for motion."""
    count, mean = found["count"], found["distance"] / found["count"]
    spread = found["distance²"] / count - mean**2  # of distances
    second, fourth = found["second"] / count, found["fourth"] / count
    if spread <= _ROUNDING * mean**2 or fourth <= second**2:
        return None
    joint = found["distance w²"] / count - mean * second
    rho = joint / np.sqrt(spread * (fourth - second**2))
    step = joint / np.sqrt(spread)  # of the variance, for one deviation of distances
    near, far = (max(variance + way * step, 0.0) for way in (-1, 1))
    which = "too small" if max(near, far) > 1 + _LEAST_VARIANCE else "too large"
    where = [f"{mean + way * np.sqrt(spread):.2g} m" for way in (-1, 1)]
    return NoiseFinding(
        f"{channel} noise {which}",
        float(2 * ndtr(-abs(rho) * np.sqrt(count))),
        max(abs(float(np.log(max(x, SMALLEST)))) for x in (near, far, variance)),
        abs(2 * step) >= _LEAST_GROWTH * variance,
        f"{_SYMBOLS[channel]} is {np.sqrt(far):.3g} times what it assumes at distances "
        f"of {where[1]}, and {np.sqrt(near):.3g} times at {where[0]}",
        0 if near < 1 < far or far < 1 < near else 1 if variance > 1 else -1,
    )


def _size(channel: str, count: float, variance: float) -> NoiseFinding:
    below = chdtr(count - 1, (count - 1) * variance)
    above = chdtrc(count - 1, (count - 1) * variance)
    which = "too small" if variance > 1 else "too large"
    of = channel if channel in ("bearing", "range") else "motion"
    return NoiseFinding(
        f"{of} noise {which}",
        float(min(1.0, 2 * min(below, above))),
        abs(float(np.log(max(variance, SMALLEST)))),
        abs(variance - 1) >= _LEAST_VARIANCE,
        f"{_SYMBOLS[channel]} is {np.sqrt(variance):.3g} times what it assumes",
        1 if variance > 1 else -1,
        max(variance, 1.0),
    )


def _bias(
    channel: str, found: dict[str, float], variance: float, runs: int
) -> NoiseFinding:
    bias = found["slope"] / found["leverage"]
    strength = bias**2 * found["leverage"] / max(variance, SMALLEST)
    p_value = 2 * stdtr(found["count"] - 1, -np.sqrt(strength))
    return NoiseFinding(
        _BIASES[channel],
        float(p_value),
        strength / runs / 3,
        strength / runs >= _LEAST_BIAS,
        _bias_text(channel, bias),
    )


def _bias_text(channel: str, bias: float) -> str:
    if channel == "along":  # true minus odometry
        way = "long" if bias < 0 else "short"
        return f"the odometry reads distances {abs(bias):.2%} too {way}"
    if channel == "turn":
        way = "left" if bias < 0 else "right"
        size = np.degrees(abs(bias))
        return f"the odometry reads turns {size:.2g}° per step too far to the {way}"
    way = "large" if bias > 0 else "small"
    if channel == "bearing":
        return f"bearings are {np.degrees(abs(bias)):.2g}° too {way}"
    return f"ranges are {abs(bias):.2g} m too {way}"


def _size_beside_tails(
    channel: str, count: float, variance: float, kurtosis: float
) -> NoiseFinding:
    """Test whether tails leave a part of the variance unexplained.

    Noise that is large only at times also has tails, but its size counts.  Student
    noise of scale 1 with the same kurtosis has a variance above 1.  The tails explain
    an s² up to this variance.  The standard error of s² is s² √((κ − 1) / n).
    """
    explained = min(max(variance, 1.0), _student_variance(kurtosis))
    error = variance * np.sqrt((kurtosis - 1) / count)
    return _size(channel, count, variance)._replace(
        p_value=float(2 * ndtr(-abs(variance - explained) / error)),
        impact=abs(float(np.log(variance / explained))),
        matters=abs(variance / explained - 1) >= _LEAST_GROWTH,
    )


def _student_variance(kurtosis: float) -> float:
    """Return the variance of Student's t of scale 1 with a kurtosis above 3."""
    freedom = 4 + 6 / (kurtosis - 3)
    return freedom / (freedom - 2)


def _kurtosis(
    found: dict[str, float], mean: float, variance: float, grows: bool
) -> float | None:
    """Return the fourth moment about the mean; None where all numbers are equal.

    If the variance grows with the distance, the part of the kurtosis of a linear growth
    is left out.
    """
    count = found["count"]
    second = variance * (count - 1) / count
    if second <= 0:
        return None
    fourth = (
        found["fourth"] - 4 * mean * found["third"] + 6 * mean**2 * found["second"]
    ) / count - 3 * mean**4
    share = 1 + _spread_of_variance(found) if grows else 1.0
    return fourth / second**2 / share


def _tails(
    channel: str, count: float, variance: float, kurtosis: float
) -> NoiseFinding:
    """Test the kurtosis; its effect is at most that of Student noise."""
    excess = kurtosis - 3
    most = _student_variance(kurtosis) if excess > 0 else 1.0
    return NoiseFinding(
        HEAVY_TAILS,
        float(2 * ndtr(-abs(_kurtosis_score(kurtosis, count)))),
        max(float(np.log(min(max(variance, 1.0), most))), excess / 10),
        excess >= _LEAST_KURTOSIS,
        f"the noise of {_SYMBOLS[channel]} has a kurtosis of {kurtosis:.3g}, a normal "
        "one 3",
        sign=0,
    )


def _spread_of_variance(found: dict[str, float]) -> float:
    """Return the squared relative deviation of a variance linear in the distance."""
    count, mean = found["count"], found["distance"] / found["count"]
    spread, second = found["distance²"] / count - mean**2, found["second"] / count
    joint = found["distance w²"] / count - mean * second
    return float(joint**2 / (spread * second**2))


def _kurtosis_score(kurtosis: float, n: float) -> float:
    """Return a standard normal number for the kurtosis of n normal ones."""
    expected = 3 * (n - 1) / (n + 1)
    variance = 24 * n * (n - 2) * (n - 3) / ((n + 1) ** 2 * (n + 3) * (n + 5))
    x = (kurtosis - expected) / np.sqrt(variance)
    skew = (
        6 * (n * n - 5 * n + 2) / ((n + 7) * (n + 9))
        * np.sqrt(6 * (n + 3) * (n + 5) / (n * (n - 2) * (n - 3)))
    )  # fmt: skip
    a = 6 + 8 / skew * (2 / skew + np.sqrt(1 + 4 / skew**2))
    cube = (1 - 2 / a) / max(1 + x * np.sqrt(2 / (a - 4)), SMALLEST)
    return float((1 - 2 / (9 * a) - np.cbrt(cube)) / np.sqrt(2 / (9 * a)))


#: Sums over w, the standardised noise of a channel in a run: 1, w, w², w³, w⁴, and g w,
#: g², where a bias b adds b g: g = d/σx along, so that b is a scale, else 1/σ. That of
#: d which has no noise counts, odometry or true distance. Then the number of pairs of
#: successive steps, of the same landmark, and the sum of w w' over them.  The last are
#: r, r², r w², where r is the true distance of a landmark, else 0.
MOMENTS = (
    *("count", "first", "second", "third", "fourth"),
    *("slope", "leverage", "pairs", "lagged"),
    *("distance", "distance²", "distance w²"),
)
#: Values up to the sum of both are rounding: a constant, and spacings of floating-point
#: numbers at the largest coordinate.
_ROUNDING, _SPACINGS = 1e-9, 4
_LEAST_STD = 1e-6  # in place of 0, where the world has noise


class _Noise(NamedTuple):
    """Numbers of one channel, all runs; each is of the run in ``runs``."""

    values: Array
    std: Array | float
    lever: Array | float
    runs: IntArray
    #: Whether a number, but the first, is of the step after that of the one before.
    follows: BoolArray
    distance: Array | float = 0.0


def noise_sums(
    true_poses: ArrayLike,
    landmarks: ArrayLike,
    odometry: ArrayLike,
    measurements: ArrayLike,
    visible: ArrayLike,
    *,
    motion_std: ArrayLike,
    measurement_std: ArrayLike,
    sensor: str | Sensor = "bearing_range",
    noise_in: Literal["motion", "odometry"] = "motion",
    noisy_steps: ArrayLike | None = None,
) -> Array:
    """Sum powers of the standardised noise of B runs of T scans among L landmarks.

    With Δ the true displacement and d, α the odometry::

        (εx, εy) = R(θ)ᵀ Δ − (d, 0),    εα = Δθ − α,    (εβ, εr) = z − h(x, l)

    Parameters
    ----------
    true_poses : array_like, shape (B, T, 3)
        At each scan [m, m, rad].
    landmarks : array_like, shape (B, L, 2)
        True positions [m].
    odometry : array_like, shape (B, T, 2) or (B, T, 3)
        (d, α) before each scan [m, rad], or the displacement (dx, dy, α) of a drive;
        that before the first is not used.
    measurements : array_like, shape (B, T, L, 2)
        Rows (β, r) [rad, m].
    visible : array_like of bool, shape (B, T, L)
        Which of them are readings.
    motion_std, measurement_std, sensor
        What the filter assumes, as in :func:`~slamgym.estimator.make_estimator`.
    noise_in : {"motion", "odometry"}
        Whether the robot slips, or its encoders err: the other one is exact.
    noisy_steps : array_like of bool, shape (B, T), optional
        Steps whose motion noise counts; all by default.

    Returns
    -------
    ndarray, shape (B, 5, 12)
        By run, `CHANNELS` and `MOMENTS`.  A channel has zeros if it has no noise and
        the filter assumes none.

    Raises
    ------
    ValueError
        If shapes do not fit, or a deviation is negative.
    """
    argument_checks.one_of("noise_in", noise_in, ("motion", "odometry"))
    poses = argument_checks.as_floats("true_poses", true_poses)
    if poses.ndim != 3 or poses.shape[-1] != 3:
        raise ValueError(f"true_poses must have shape (B, T, 3), got {poses.shape}")
    shape = poses.shape[:2]
    points = argument_checks.as_floats("landmarks", landmarks)
    seen = np.asarray(visible, dtype=np.bool_)
    moved = argument_checks.as_floats("odometry", odometry)
    if moved.shape == (*shape, 2):
        moved = np.insert(moved, 1, 0.0, axis=2)
    moved = argument_checks.shaped("odometry", moved, (*shape, 3))
    if seen.shape != (*shape, points.shape[1]) or len(points) != len(poses):
        raise ValueError(
            f"visible must have shape {(*shape, points.shape[1])}, got {seen.shape}"
        )
    readings = argument_checks.shaped("measurements", measurements, (*seen.shape, 2))
    motion = argument_checks.standard_deviations("motion_std", motion_std, 3)
    stds = argument_checks.standard_deviations("measurement_std", measurement_std, 2)
    read = only_bearing_range(sensor, "noise_sums")
    steps = np.ones(shape, bool) if noisy_steps is None else np.asarray(noisy_steps)
    channels = [
        *_motion_noise(poses, moved, steps, motion, noise_in == "motion"),
        *_sensor_noise(poses, points, readings, seen, read, stds),
    ]
    largest = np.abs(poses[..., :2]).max(initial=1.0)
    exact = _ROUNDING + _SPACINGS * float(np.spacing(largest))
    return np.stack([_summed(noise, len(poses), exact) for noise in channels], axis=1)


def _motion_noise(
    poses: Array, odometry: Array, steps: BoolArray, std: Array, slips: bool
) -> list[_Noise]:
    run, step = np.nonzero(steps[:, 1:])
    before, after = poses[run, step], poses[run, step + 1]
    driven, aside, turned = odometry[run, step + 1].T
    dx, dy = (after - before)[:, :2].T
    cos, sin = np.cos(before[:, 2]), np.sin(before[:, 2])
    ahead = cos * dx + sin * dy
    errors = (
        ahead - driven,
        cos * dy - sin * dx - aside,
        wrap_angle(after[:, 2] - before[:, 2] - turned),
    )
    levers = driven if slips else ahead, 1.0, 1.0
    follows = (np.diff(run) == 0) & (np.diff(step) == 1)
    return [
        _Noise(error, sigma, lever, run, follows)
        for error, sigma, lever in zip(errors, std.tolist(), levers, strict=True)
    ]


def _sensor_noise(
    poses: Array,
    points: Array,
    readings: Array,
    seen: BoolArray,
    sensor: Sensor,
    std: Array,
) -> list[_Noise]:
    run, landmark, step = np.nonzero(seen.transpose(0, 2, 1))
    follows = (np.diff(run) == 0) & (np.diff(landmark) == 0) & (np.diff(step) == 1)
    dx, dy = (points[run, landmark] - poses[run, step, :2]).T
    bearing, distance = readings[run, step, landmark].T
    expected = np.arctan2(dy, dx) - poses[run, step, 2], np.hypot(dx, dy)
    bearing_error = wrap_angle(bearing - expected[0])
    bearing_std, range_std = sensor.stds(std, np.maximum(expected[1], SMALLEST)).T
    return [
        _Noise(bearing_error, bearing_std, 1.0, run, follows, expected[1]),
        _Noise(distance - expected[1], range_std, 1.0, run, follows, expected[1]),
    ]


def _summed(noise: _Noise, count: int, exact: float) -> Array:
    """Sum the moments of a channel by run, shape (count, 12)."""
    std = np.broadcast_to(noise.std, noise.values.shape)
    if not std.any() and (np.abs(noise.values) < exact).all():
        return np.zeros((count, len(MOMENTS)))
    std = np.where(std > 0, std, _LEAST_STD)
    w, g = noise.values / std, noise.lever / std
    square = w * w  # a product takes a hundredth of the time of w**3
    terms = [np.ones_like(w), w, square, square * w, square * square, g * w, g * g]
    terms += [
        np.append(of, 0.0) for of in (noise.follows, noise.follows * w[1:] * w[:-1])
    ]
    r = np.broadcast_to(noise.distance, w.shape)
    terms += [r, r * r, r * square]
    return np.column_stack(
        [np.bincount(noise.runs, term[: len(w)], minlength=count) for term in terms]
    )
