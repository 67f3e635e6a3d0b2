"""Association of readings without identity: gated nearest neighbours."""

from typing import NamedTuple

import numpy as np

from ...arrays import Array, IntArray
from ...jit import jit
from ..models.bearing_range import wrap_angle_jit


class Noise(NamedTuple):
    """Noise of a sensor: a reading of range r has σβ + b / r and σr + k r.

    Examples
    --------
    >>> Noise(0.1, 0.5, bearing_std_metres=0.4).variances(np.array([4.0])).round(2)
    array([[0.04, 0.25]])
    """

    bearing_std: float
    """σβ [rad]."""
    range_std: float
    """σr [m]."""
    range_std_per_metre: float = 0.0
    """k."""
    bearing_std_metres: float = 0.0
    """b [m]."""

    def variances(self, ranges: Array) -> Array:
        """Return the variances of bearing and range at ranges (m,) > 0, (m, 2)."""
        std = np.empty((len(ranges), 2))
        std[:, 0] = self.bearing_std
        if self.bearing_std_metres:
            std[:, 0] += self.bearing_std_metres / ranges
        std[:, 1] = self.range_std + self.range_std_per_metre * ranges
        return np.asarray(std**2)


# What a reading is of, where it is not a slot of the map.
NEW, AMBIGUOUS = -1, -2


class Distances(NamedTuple):
    """How well each of m readings fits each of n landmarks."""

    squared: Array
    """νᵀ S⁻¹ ν, shape (m, n); infinite where beyond what was asked for."""
    unlikelihood: Array
    """νᵀ S⁻¹ ν + ln det S, shape (m, n): −2 ln of the likelihood, but for a constant.

    Of two landmarks at the same distance in σ, the more certain one is more likely.
    """


def innovation_distances(
    mean: Array,
    covariance: Array,
    landmarks: int,
    readings: Array,
    noise: Noise,
    largest: float,
) -> Distances:
    """Compare every reading with every landmark of a belief.

    ::

        ν = z − h(x),    S = H P Hᵀ + Q

    at the estimate.  The range alone excludes most pairs without their H: where
    ν_r² > largest (tr C + σr²) with C the covariance of l − p, νᵀ S⁻¹ ν is too large,
    whatever the bearing.

    Parameters
    ----------
    mean, covariance : ndarray
        (x, y, θ, l1x, …) and P; there may be more behind the landmarks.
    landmarks : int
        How many landmarks these hold, n.
    readings : ndarray, shape (m, 2)
        Rows (β, r) [rad, m].
    noise : Noise
        Of the sensor.
    largest : float
        Pairs with a νᵀ S⁻¹ ν above this may be left infinite.

    Examples
    --------
    >>> mean = np.array([0, 0, 0, 5.0, 0, 0, 5.0])
    >>> readings = np.array([(0.0, 5.2), (1.57, 4.9)])
    >>> P = 0.01 * np.eye(7)
    >>> fit = innovation_distances(mean, P, 2, readings, Noise(0.1, 0.1), largest=25)
    >>> (fit.squared < 9.21).tolist()
    [[True, False], [False, True]]
    """
    shape = (len(readings), landmarks)
    fit = Distances(np.full(shape, np.inf), np.full(shape, np.inf))
    if fit.squared.size:
        variances = noise.variances(readings[:, 1])
        _compare(mean, covariance, readings, variances, largest, fit)
    return fit


@jit
def _compare(
    mean: Array,
    covariance: Array,
    readings: Array,
    variances: Array,
    largest: float,
    fit: Distances,
) -> None:
    squared, unlikelihood = fit
    P, x, y, heading = covariance, mean[0], mean[1], mean[2]
    for j in range(squared.shape[1]):
        c = 3 + 2 * j
        dx, dy = mean[c] - x, mean[c + 1] - y
        distance = np.sqrt(dx * dx + dy * dy)
        if not distance > 0:
            continue
        xx = P[0, 0] + P[c, c] - 2 * P[0, c]
        yy = P[1, 1] + P[c + 1, c + 1] - 2 * P[1, c + 1]
        is_complete = False
        for k in range(len(readings)):
            nu_r = readings[k, 1] - distance
            if nu_r * nu_r > largest * (xx + yy + variances[k, 1]):
                continue
            if not is_complete:  # what the readings share, for few landmarks only
                is_complete = True
                xy = P[0, 1] + P[c, c + 1] - P[0, c + 1] - P[1, c]
                gx, gy = P[2, c] - P[2, 0], P[2, c + 1] - P[2, 1]
                ex, ey = dx / distance, dy / distance
                ax, ay = -ey / distance, ex / distance
                s_rr = ex * ex * xx + 2 * ex * ey * xy + ey * ey * yy
                s_br = ax * ex * xx + (ax * ey + ay * ex) * xy + ay * ey * yy
                s_br -= ex * gx + ey * gy
                s_bb = ax * ax * xx + 2 * ax * ay * xy + ay * ay * yy
                s_bb += P[2, 2] - 2 * (ax * gx + ay * gy)
                bearing = np.arctan2(dy, dx) - heading
            nu_b = wrap_angle_jit(readings[k, 0] - bearing)
            rr = s_rr + variances[k, 1]
            bb = s_bb + variances[k, 0]
            determinant = rr * bb - s_br * s_br
            if not determinant > 0:
                continue
            d = nu_b * nu_b * rr - 2 * nu_b * nu_r * s_br + nu_r * nu_r * bb
            d /= determinant
            if d <= largest:
                squared[k, j] = d
                unlikelihood[k, j] = d + np.log(determinant)


def nearest_neighbours(
    fit: Distances, *, match: float, new: float, ambiguity: float = 0.0
) -> IntArray:
    """Give each reading at most one landmark, and each landmark at most one reading.

    A reading belongs to the landmark under which it is most likely, among those whose
    νᵀ S⁻¹ ν is within the gate, if it is also that landmark's most likely reading.

    Parameters
    ----------
    fit : Distances
        Of m readings and n landmarks.
    match : float
        The gate: largest νᵀ S⁻¹ ν of a pair, χ² of 2 degrees of freedom.
    new : float
        A reading farther than this from every landmark is of none of them.
    ambiguity : float
        Where the runner-up within the gate is less likely by no more than this in
        −2 ln of the likelihood, the reading is left out.

    Returns
    -------
    ndarray of int64, shape (m,)
        A slot of the map, `NEW`, or `AMBIGUOUS`: not to be used.

    Examples
    --------
    >>> d = np.array([[1.0, np.inf], [4.0, np.inf], [np.inf, 12.0], [np.inf, np.inf]])
    >>> nearest_neighbours(Distances(d, d), match=9.21, new=25.0).tolist()
    [0, -2, -2, -1]
    """
    rows, landmarks = fit.squared.shape
    chosen = np.full(rows, NEW, dtype=np.int64)
    if not fit.squared.size:
        return chosen
    scores = np.where(fit.squared <= match, fit.unlikelihood, np.inf)
    chosen[fit.squared.min(axis=1) <= new] = AMBIGUOUS
    best = scores.argmin(axis=1)
    every = np.arange(rows)
    score = scores[every, best]
    is_clear = np.isfinite(score) & (scores.argmin(axis=0)[best] == every)
    if landmarks > 1 and ambiguity > 0:
        others = scores.copy()
        others[every, best] = np.inf
        is_clear &= others.min(axis=1) - np.where(is_clear, score, 0.0) > ambiguity
    chosen[is_clear] = best[is_clear]
    return chosen
