"""Confidence intervals of the fitted parameters."""

from __future__ import annotations

from typing import Literal, NamedTuple

import numpy as np

from ...arrays import Array, IntArray
from .scoring import (
    FAINT,
    LEAST,
    LITTLE,
    Likelihoods,
    curvature,
    maximise,
    restricted,
    scores,
    totals,
)

Verdict = Literal["fitted", "zero", "unknown"]

WITHIN = 1.92  # ½ χ²(1) at 95 %: how much less likely the ends of an interval are
NOT_ZERO = 1.35  # the same at 90 %, for a parameter that may lie at its end, zero
NORMAL = 1.96
ENDS = np.geomspace(1e-6, 10.0, 71)  # [m, rad] where ends are looked for
AT_ONCE = 10  # of them, in one call


class Interval(NamedTuple):
    """The information of the readings about one parameter."""

    #: Zero: the interval begins at zero; "unknown": nothing depends on it.
    verdict: Verdict
    #: Of the 95 % interval; 0 and infinity where unknown.
    low: float
    high: float


def intervals(
    likelihoods: Likelihoods,
    parameters: Array,
    log_likelihood: float,
    information: Array,
) -> list[Interval]:
    """Return the 95 % intervals of the most likely parameters.

    If the readings determine a parameter, its interval follows from the curvature of
    the log likelihood in log σ. Otherwise, the interval ends where the readings are
    significantly less likely, with the other parameters fitted again (the profile
    likelihood).

    Parameters
    ----------
    likelihoods : callable
        Smooth, see :data:`.scoring.Likelihoods`; of parameters ≥ 0.
    parameters : ndarray, shape (p,)
        Where it has its maximum; some may be zero.
    log_likelihood : float
        The maximum.
    information : ndarray, shape (k, k)
        About the logarithms of the parameters > 0.
    """
    free = np.flatnonzero(parameters > 0)
    whole = np.zeros((len(parameters), len(parameters)))
    whole[np.ix_(free, free)] = information
    of_each = np.diag(whole)
    found = {
        i: _profiled(likelihoods, parameters, i, log_likelihood)
        for i in np.flatnonzero(of_each < LITTLE).tolist()
    }
    sure = np.flatnonzero(of_each >= 1.0)
    widths = _widths(likelihoods, parameters, sure, whole[np.ix_(sure, sure)])
    for i, width in zip(sure.tolist(), widths, strict=True):
        if i not in found:
            spread = np.exp(NORMAL * width)
            low, high = parameters[i] / spread, parameters[i] * spread
            found[i] = Interval("fitted", float(low), float(high))
    return [found[i] for i in range(len(parameters))]


def _profiled(
    likelihoods: Likelihoods, parameters: Array, i: int, most: float
) -> Interval:
    """Judge a poorly determined parameter by its profile likelihood."""
    value, level = parameters[i], most - WITHIN
    low, high = 0.0, np.inf
    above = _first_outside(likelihoods, parameters, i, ENDS[value < ENDS], level)
    if above is not None:
        high = profile_crossing(likelihoods, parameters, i, above, level)
    least = profile_at_zero(likelihoods, parameters, i) if value > 0 else most
    if least < level:
        ends = ENDS[value > ENDS][::-1]
        below = _first_outside(likelihoods, parameters, i, ends, level)
        start = 0.5 * value if below is None else below
        low = profile_crossing(likelihoods, parameters, i, start, level)
    if least < most - NOT_ZERO:
        return Interval("fitted", low, high)
    return Interval("unknown" if above is None else "zero", 0.0, high)


def _first_outside(
    likelihoods: Likelihoods, parameters: Array, i: int, ends: Array, level: float
) -> float | None:
    """Return the first value of a parameter whose likelihood is below a level."""
    for few in np.split(ends, range(AT_ONCE, len(ends), AT_ONCE)):
        tried = np.tile(parameters, (len(few), 1))
        tried[:, i] = few
        outside = np.flatnonzero(totals(likelihoods(tried)) < level)
        if len(outside):
            return float(few[outside[0]])
    return None


def _widths(
    likelihoods: Likelihoods, parameters: Array, chosen: IntArray, information: Array
) -> Array:
    """Return standard deviations of some log σ, by the curvature in them."""
    if not len(chosen):
        return np.empty(0)
    along = restricted(likelihoods, parameters, chosen)
    steps = np.clip(0.5 / np.sqrt(np.diag(information)), 0.005, 0.1)
    bent = curvature(along, np.log(parameters[chosen]), steps)
    if not (np.linalg.eigvalsh(bent) > 0).all():
        bent = information
    return np.asarray(np.sqrt(np.diag(np.linalg.pinv(bent))))


# --------------------------------------------------------------------------------------
# Profile likelihood: that of one parameter, with the others fitted for each value.
#
# With the score g, the information I about θ, and the other parameters o, it is to
# second order ::
#
#     ℓ_p = ℓ + ½ g_oᵀ I_oo⁻¹ g_o,    dℓ_p/dθ_i = g_i − I_io I_oo⁻¹ g_o
#
# (Venzon, Moolgavkar, Applied Statistics 37(1), 1988).  Where the likelihood jumps, the
# others may be most likely just before the jump, and a step across it is not taken.

MOST = 20  # iterations
CLOSE = 2e-3  # in ℓ and in θ, where they end
FARTHEST = 1.0  # the most that one changes θ
OF_OTHERS = np.array([1.0, 0.3, 0.1, 0.0])  # shares of their change that are tried
GREATEST = 100.0  # [m, rad] from which on a parameter has no end


def profile_at_zero(likelihoods: Likelihoods, parameters: Array, i: int) -> float:
    """Return the log likelihood with one parameter at zero, the others > 0 fitted."""
    without = parameters.copy()
    without[i] = 0.0
    others = np.flatnonzero(without > 0)
    along = restricted(likelihoods, without, others)
    try:
        return maximise(along, without[None, others]).log_likelihood
    except np.linalg.LinAlgError:
        return -np.inf


def profile_crossing(
    likelihoods: Likelihoods, parameters: Array, i: int, start: float, level: float
) -> float:
    """Return where the profile likelihood of a parameter is at a level.

    Parameters
    ----------
    likelihoods : callable
        See :data:`.scoring.Likelihoods`.
    parameters : ndarray, shape (p,)
        Where it has its maximum; the others that are zero there stay zero.
    i : int
        The parameter.
    start : float
        Value on the side of the maximum on which the crossing is looked for.
    level : float
        Below the maximum.

    Returns
    -------
    float
        By Newton's method; 0 or infinity where it leaves what parameters can be, or
        does not find the crossing on this side.
    """
    here, up = parameters.copy(), start > parameters[i]
    here[i] = start
    free = np.flatnonzero(here > 0)
    along, theta = restricted(likelihoods, here, free), np.log(here[free])
    at = int(np.flatnonzero(free == i)[0])
    o = np.flatnonzero(free != i)
    moves, known = True, None  # whether other parameters can still gain
    for _ in range(MOST):
        found = scores(along, theta, here=known, beside_jumps=True)
        information, g = found.information + FAINT * np.eye(len(theta)), found.gradient
        inverse = np.linalg.inv(information[np.ix_(o, o)])
        rise = 0.5 * float(g[o] @ inverse @ g[o]) * moves
        slope = float(g[at] - information[at, o] @ inverse @ g[o] * moves)
        step = _newton_step(level - found.value - rise, slope, up=up)
        change = inverse @ (g[o] - information[o, at] * step)
        change /= max(1.0, abs(change).max(initial=0.0) / FARTHEST)  # still uphill
        shares = OF_OTHERS if len(o) else OF_OTHERS[:1]
        tried = np.tile(theta, (len(shares), 1))
        tried[:, o] += np.outer(shares, change)
        tried[:, at] += step
        if not np.log(LEAST) < tried[0, at] < np.log(GREATEST):
            return np.inf if up else 0.0
        by_step = along(np.exp(tried))
        best = int(np.argmax(totals(by_step)))
        theta, known, moves = tried[best], by_step[best], shares[best] > 0
        if abs(step) < CLOSE and rise < CLOSE:
            break
    end = float(np.exp(theta[at]))
    if (end > parameters[i]) == up:
        return end
    return np.inf if up else 0.0  # few readings: it ends on the wrong side


def _newton_step(fall: float, slope: float, *, up: bool) -> float:
    """Return a step of θ towards a level, or outwards before the maximum is passed."""
    if slope == 0 or (slope > 0) == up:
        return FARTHEST if up else -FARTHEST
    return float(np.clip(fall / slope, -FARTHEST, FARTHEST))
