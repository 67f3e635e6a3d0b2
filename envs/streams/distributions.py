"""Uniform and normal numbers, each from one random word.

Normal numbers come by the inverse of the distribution function, Φ⁻¹. So every number
needs one word at a fixed position, and none is rejected.
"""

from math import log, sqrt

import numpy as np

from ...arrays import Array
from ...jit import njit_internal
from .philox import Word

_TO_UNIFORM, _TO_NORMAL = Word(11), Word(12)  # bits left out


@njit_internal
def uniform_of(word: Word) -> float:
    """Return u in [0, 1), a multiple of 2⁻⁵³, as numpy does."""
    return np.int64(word >> _TO_UNIFORM) * 2.0**-53


@njit_internal
def shifted(word: Word) -> float:
    """Return q in (-1/2, 1/2), the middle of one of 2⁵² equal parts."""
    return (np.int64(word >> _TO_NORMAL) + 0.5) * 2.0**-52 - 0.5


@njit_internal
def make_normal(numbers: Array) -> None:
    """Turn uniform numbers q of `shifted`, (n,), into z = Φ⁻¹(1/2 + q); |z| < 8.3.

    ::

        z = q A(0.180625 - q²)                    if |q| <= 0.425
        z = sign(q) B(√(-ln r)),  r = 1/2 - |q|   otherwise

    A and B are quotients of polynomials of degree 7, and z is exact to a few units in
    the last place. The centre goes in one loop without a branch, the tails in others.

    Source: Wichura, "Algorithm AS 241: the percentage points of the normal
    distribution", Applied Statistics 37 (1988), routine PPND16. Python's
    ``statistics.NormalDist().inv_cdf`` computes the same.
    """
    places = np.empty(len(numbers), np.int64)
    count = 0
    for place in range(len(numbers)):
        places[count] = place
        count += abs(numbers[place]) > 0.425
    signed, roots = np.empty(count), np.empty(count)
    for tail in range(count):
        signed[tail] = numbers[places[tail]]
        roots[tail] = sqrt(-log(0.5 - abs(signed[tail])))
    for place in range(len(numbers)):
        numbers[place] = _centre(numbers[place])
    for tail in range(count):
        root = roots[tail]
        z = _tail(root - 1.6) if root <= 5.0 else _far_tail(root - 5.0)
        numbers[places[tail]] = z if signed[tail] > 0.0 else -z


@njit_internal
def _centre(q: float) -> float:
    r = 0.180625 - q * q
    upper = 2.5090809287301226727e3
    upper = upper * r + 3.3430575583588128105e4
    upper = upper * r + 6.7265770927008700853e4
    upper = upper * r + 4.5921953931549871457e4
    upper = upper * r + 1.3731693765509461125e4
    upper = upper * r + 1.9715909503065514427e3
    upper = upper * r + 1.3314166789178437745e2
    upper = upper * r + 3.3871328727963666080e0
    lower = 5.2264952788528545610e3
    lower = lower * r + 2.8729085735721942674e4
    lower = lower * r + 3.9307895800092710610e4
    lower = lower * r + 2.1213794301586595867e4
    lower = lower * r + 5.3941960214247511077e3
    lower = lower * r + 6.8718700749205790830e2
    lower = lower * r + 4.2313330701600911252e1
    lower = lower * r + 1.0
    return upper * q / lower


@njit_internal
def _tail(r: float) -> float:
    upper = 7.74545014278341407640e-4
    upper = upper * r + 2.27238449892691845833e-2
    upper = upper * r + 2.41780725177450611770e-1
    upper = upper * r + 1.27045825245236838258e0
    upper = upper * r + 3.64784832476320460504e0
    upper = upper * r + 5.76949722146069140550e0
    upper = upper * r + 4.63033784615654529590e0
    upper = upper * r + 1.42343711074968357734e0
    lower = 1.05075007164441684324e-9
    lower = lower * r + 5.47593808499534494600e-4
    lower = lower * r + 1.51986665636164571966e-2
    lower = lower * r + 1.48103976427480074590e-1
    lower = lower * r + 6.89767334985100004550e-1
    lower = lower * r + 1.67638483018380384940e0
    lower = lower * r + 2.05319162663775882187e0
    lower = lower * r + 1.0
    return upper / lower


@njit_internal
def _far_tail(r: float) -> float:
    upper = 2.01033439929228813265e-7
    upper = upper * r + 2.71155556874348757815e-5
    upper = upper * r + 1.24266094738807843860e-3
    upper = upper * r + 2.65321895265761230930e-2
    upper = upper * r + 2.96560571828504891230e-1
    upper = upper * r + 1.78482653991729133580e0
    upper = upper * r + 5.46378491116411436990e0
    upper = upper * r + 6.65790464350110377720e0
    lower = 2.04426310338993978564e-15
    lower = lower * r + 1.42151175831644588870e-7
    lower = lower * r + 1.84631831751005468180e-5
    lower = lower * r + 7.86869131145613259100e-4
    lower = lower * r + 1.48753612908506148525e-2
    lower = lower * r + 1.36929880922735805310e-1
    lower = lower * r + 5.99832206555887937690e-1
    lower = lower * r + 1.0
    return upper / lower
