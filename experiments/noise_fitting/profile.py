"""Profile likelihood: that of one parameter, with the others fitted for each value.

With the score g, the information I about θ, and the other parameters o, it is to second
order ::

    ℓ_p = ℓ + ½ g_oᵀ I_oo⁻¹ g_o,    dℓ_p/dθ_i = g_i − I_io I_oo⁻¹ g_o

(Venzon, Moolgavkar, Applied Statistics 37(1), 1988).
"""

from __future__ import annotations

import numpy as np

from ...arrays import Array
from .scoring import FAINT, LEAST, Likelihoods, maximise, restricted, scores

MOST = 20  # iterations
CLOSE = 2e-3  # in ℓ and in θ, where they end
FARTHEST = 1.0  # the most that one changes θ
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
    for _ in range(MOST):
        found = scores(along, theta)
        information, g = found.information + FAINT * np.eye(len(theta)), found.gradient
        inverse = np.linalg.inv(information[np.ix_(o, o)])
        rise = 0.5 * float(g[o] @ inverse @ g[o])
        slope = float(g[at] - information[at, o] @ inverse @ g[o])
        step = _newton_step(level - found.value - rise, slope, up=up)
        change = inverse @ (g[o] - information[o, at] * step)
        theta[o] += np.clip(change, -FARTHEST, FARTHEST)
        theta[at] += step
        if not np.log(LEAST) < theta[at] < np.log(GREATEST):
            return np.inf if up else 0.0
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
