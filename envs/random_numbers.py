"""Random numbers by position: any number of any stream of an episode, in any order.

`episode_keys` names the episodes, and `EpisodeStarts` draws their start and map.
`draw_normals` and `draw_uniforms` fill arrays with the numbers of many steps or worlds
in one compiled pass. Below them are the transformations of random words to numbers,
and the generator of the words, `random_block`.
"""

from collections.abc import Sequence
from math import log, sqrt

import numpy as np

from ..arrays import Array, ComplexArray, IntArray, WordArray
from ..jit import (
    add_words,
    jit_in_place,
    multiply_words,
    njit_allocating,
    njit_internal,
)
from ..sim_configs import Scenario, place_landmarks
from ..sim_configs.landmarks_and_controls import TRIES_PER_LANDMARK, RandomLayout
from ..sim_configs.scenario import RANGES
from ..sim_configs.scenario_files import copied_draw

# the independent streams of an episode: plain integers, which numba takes quickly
START, MAP, MOTION, MEASUREMENT, DROPOUT, CLUTTER, ORDER, DRAWN = range(8)
POSE = 8


def episode_keys(generators: Sequence[np.random.Generator]) -> WordArray:
    """Draw the key of one episode from each generator, shape (K, 2).

    Two words of the bit generator make a key. So a generator with the same state gives
    the same episode.

    Examples
    --------
    >>> rng = np.random.default_rng(0)
    >>> before = rng.bit_generator.state
    >>> keys = episode_keys([rng])
    >>> rng.bit_generator.state = before
    >>> bool((keys == episode_keys([rng])).all())
    True
    """
    keys = np.empty((len(generators), 2), dtype=np.uint64)
    for world, rng in enumerate(generators):
        keys[world] = rng.bit_generator.random_raw(2)
    return keys


def drawn_scenarios(scenario: Scenario, keys: WordArray) -> list[Scenario]:
    """Return the scenarios of the episodes with these keys, (K, 2).

    A scenario with ranges (``randomise``) draws every setting from a stream of its own.
    """
    if scenario.randomise is None:
        return [scenario] * len(keys)
    drawn = np.empty((len(keys), len(RANGES) + 2 * scenario.landmarks.count))
    draw_uniforms(keys, np.zeros(len(keys), dtype=np.int64), DRAWN, drawn)
    directions = 2.0 * drawn[:, len(RANGES) :].reshape(len(keys), -1, 2) - 1.0
    shares = drawn[:, : len(RANGES)].tolist()
    return [
        copied_draw(scenario, dict(zip(RANGES, share, strict=True)), direction)
        for share, direction in zip(shares, directions, strict=True)
    ]


class EpisodeStarts:
    """Draws the start poses and the landmarks of the episodes of a scenario.

    Parameters
    ----------
    scenario : Scenario
        Source of the start and the layout.
    """

    def __init__(self, scenario: Scenario) -> None:
        start, self._layout = scenario.start, scenario.landmarks
        self._pose, self._std = np.array([start.pose]), np.array([start.std])
        self._draws_truth = start.drawn == "truth"
        #: Whether every episode has new landmarks.
        self.redraws_landmarks = self._layout.is_redrawn

    def poses(self, keys: WordArray) -> tuple[Array, Array]:
        """Return true and estimated start poses, each of shape (K, 3) [m, m, rad]."""
        unit = np.empty((len(keys), 3))
        draw_normals(keys, np.zeros(len(keys), dtype=np.int64), START, unit)
        drawn, centre = unit * self._std + self._pose, self._pose.repeat(len(keys), 0)
        return (drawn, centre) if self._draws_truth else (centre, drawn)

    def landmarks(self, keys: WordArray) -> ComplexArray:
        """Return the landmarks x + iy, shape (K, N) [m], drawn anew if random.

        They equal those of `place_landmarks` with numpy's ``Philox`` at the same
        position.

        Raises
        ------
        ScenarioError
            If the layout has no room for its landmarks.
        """
        layout = self._layout
        out = np.empty((len(keys), layout.count, 2))
        if isinstance(layout, RandomLayout) and self.redraws_landmarks:
            rules = layout.bounds, layout.min_distance, TRIES_PER_LANDMARK
            left_out = throw_darts(keys, MAP, *rules, out)
            if left_out >= 0:
                raise layout.no_room(left_out)
        else:
            out[:] = place_landmarks(layout, np.random.default_rng(0))  # draws nothing
        return out.view(np.complex128)[..., 0]


@jit_in_place
def draw_normals(keys: WordArray, steps: IntArray, stream: int, out: Array) -> None:
    """Fill an array with standard normal numbers, row k from step ``steps[k]``.

    Parameters
    ----------
    keys : uint64 ndarray, shape (K, 2) or (1, 2)
        The key of each row, or of all.
    steps : int64 ndarray, shape (K,)
    stream : int
        Its number, as `MOTION`.
    out : ndarray, shape (K, W)
        Contiguous.
    """
    _fill(keys, steps, stream, out, True)
    make_normal(out.reshape(-1))


@jit_in_place
def draw_uniforms(keys: WordArray, steps: IntArray, stream: int, out: Array) -> None:
    """Fill an array, (K, W), with uniform numbers in [0, 1); see `draw_normals`."""
    _fill(keys, steps, stream, out, False)


@njit_internal
def _fill(
    keys: WordArray, steps: IntArray, stream: int, out: Array, is_shifted: bool
) -> None:
    """Fill an array with `uniform_of` or `shifted` of random words, step by step."""
    rows, width = out.shape
    for row in range(rows):
        (k0, k1), step = keys[min(row, len(keys) - 1)], steps[row]
        column = 0
        for block in range((width + 3) // 4):
            for word in random_block(k0, k1, block + 1, step, stream):
                if column < width:
                    out[row, column] = shifted(word) if is_shifted else uniform_of(word)
                    column += 1


@jit_in_place
def throw_darts(
    keys: WordArray,
    stream: int,
    bounds: tuple[float, float, float, float],
    min_distance: float,
    tries: int,
    out: Array,
) -> int:
    """Draw landmarks in turn; reject one that is too near to an earlier one.

    Parameters
    ----------
    keys : uint64 ndarray, shape (K, 2)
        The key of each world.
    stream : int
        Its number; its step 0 gives x, y, x, y, …
    bounds : (xmin, ymin, xmax, ymax)
        [m].
    min_distance : float
        [m].
    tries : int
        Most tries per landmark.
    out : ndarray, shape (K, N, 2)
        The landmarks of each world [m].

    Returns
    -------
    int
        -1, or the index of a landmark that found no place.
    """
    left, bottom, right, top = bounds
    width, height, nearest = right - left, top - bottom, min_distance * min_distance
    for row in range(len(keys)):
        k0, k1 = keys[row, 0], keys[row, 1]
        darts = 0
        words = random_block(k0, k1, 1, 0, stream)
        for index in range(out.shape[1]):
            missed = 0
            while True:
                second = darts % 2 == 1
                x = left + width * uniform_of(words[2] if second else words[0])
                y = bottom + height * uniform_of(words[3] if second else words[1])
                darts += 1
                if second:
                    words = random_block(k0, k1, darts // 2 + 1, 0, stream)
                if _is_free(out[row, :index], x, y, nearest):
                    break
                missed += 1
                if missed == tries:
                    return index
            out[row, index, 0], out[row, index, 1] = x, y
    return -1


@njit_internal
def _is_free(placed: Array, x: float, y: float, nearest: float) -> bool:
    """Return whether no placed landmark is nearer; `nearest` is squared [m²]."""
    for index in range(len(placed)):
        right, up = placed[index, 0] - x, placed[index, 1] - y
        if right * right + up * up < nearest:
            return False
    return True


Word = np.uint64


# --------------------------------------------------------------------------------------
# Uniform and normal numbers, each from one random word.
#
# Normal numbers come by the inverse of the distribution function, Φ⁻¹. So every number
# needs one word at a fixed position, and none is rejected.

_TO_UNIFORM, _TO_NORMAL = Word(11), Word(12)  # bits left out


@njit_internal
def uniform_of(word: Word) -> float:
    """Return u in [0, 1), a multiple of 2⁻⁵³, as numpy does."""
    return np.int64(word >> _TO_UNIFORM) * 2.0**-53


@njit_internal
def shifted(word: Word) -> float:
    """Return q in (-1/2, 1/2), the middle of one of 2⁵² equal parts."""
    return (np.int64(word >> _TO_NORMAL) + 0.5) * 2.0**-52 - 0.5


@njit_allocating
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
        q = numbers[place]
        numbers[place] = _ratio(_CENTRE, 0.180625 - q * q, q)
    for tail in range(count):
        r, sign = roots[tail], 1.0 if signed[tail] > 0.0 else -1.0
        near = r <= 5.0
        z = _ratio(_TAIL, r - 1.6, sign) if near else _ratio(_FAR_TAIL, r - 5.0, sign)
        numbers[places[tail]] = z


def _columns(*rows: tuple[float, float]) -> tuple[tuple[float, ...], ...]:
    return tuple(zip(*rows, strict=True))


# The rational functions: coefficients of numerator and denominator, from r⁷ down to 1.
_CENTRE = _columns(
    (2.5090809287301226727e3, 5.2264952788528545610e3),
    (3.3430575583588128105e4, 2.8729085735721942674e4),
    (6.7265770927008700853e4, 3.9307895800092710610e4),
    (4.5921953931549871457e4, 2.1213794301586595867e4),
    (1.3731693765509461125e4, 5.3941960214247511077e3),
    (1.9715909503065514427e3, 6.8718700749205790830e2),
    (1.3314166789178437745e2, 4.2313330701600911252e1),
    (3.3871328727963666080e0, 1.0),
)
_TAIL = _columns(
    (7.74545014278341407640e-4, 1.05075007164441684324e-9),
    (2.27238449892691845833e-2, 5.47593808499534494600e-4),
    (2.41780725177450611770e-1, 1.51986665636164571966e-2),
    (1.27045825245236838258e0, 1.48103976427480074590e-1),
    (3.64784832476320460504e0, 6.89767334985100004550e-1),
    (5.76949722146069140550e0, 1.67638483018380384940e0),
    (4.63033784615654529590e0, 2.05319162663775882187e0),
    (1.42343711074968357734e0, 1.0),
)
_FAR_TAIL = _columns(
    (2.01033439929228813265e-7, 2.04426310338993978564e-15),
    (2.71155556874348757815e-5, 1.42151175831644588870e-7),
    (1.24266094738807843860e-3, 1.84631831751005468180e-5),
    (2.65321895265761230930e-2, 7.86869131145613259100e-4),
    (2.96560571828504891230e-1, 1.48753612908506148525e-2),
    (1.78482653991729133580e0, 1.36929880922735805310e-1),
    (5.46378491116411436990e0, 5.99832206555887937690e-1),
    (6.65790464350110377720e0, 1.0),
)


@njit_internal
def _ratio(table: tuple[tuple[float, ...], ...], r: float, factor: float) -> float:
    """Evaluate a rational function, times a factor."""
    upper, lower = table
    return _polynomial(upper, r) * factor / _polynomial(lower, r)


@njit_internal
def _polynomial(c: tuple[float, ...], r: float) -> float:
    """Evaluate a polynomial of degree 7; a loop over c would not be vectorised."""
    high = ((c[0] * r + c[1]) * r + c[2]) * r + c[3]
    return (((high * r + c[4]) * r + c[5]) * r + c[6]) * r + c[7]


# --------------------------------------------------------------------------------------
# Philox4x64-10: four random words from a key and a position, without any state.
#
# Symbols
# -------
# key = (k0, k1)          names an episode
# position = (b, t, s)    block b of step t of stream s; a block has four words
#
# The words are those of ``numpy.random.Philox(key=key, counter=[0, t, s, 0])``, which
# takes the blocks b = 1, 2, … in turn.
#
# Source: Salmon, Moraes, Dror, Shaw, "Parallel random numbers: as easy as 1, 2, 3", SC
# 2011, section 3.

Block = tuple[Word, Word, Word, Word]

_ROUNDS = 10
_M0, _M1 = Word(0xD2E7470EE14C6C93), Word(0xCA5A826395121157)
_W0, _W1 = Word(0x9E3779B97F4A7C15), Word(0xBB67AE8584CAA73B)
_NO = Word(0)


@njit_internal
def random_block(k0: Word, k1: Word, block: int, step: int, stream: int) -> Block:
    """Return the four words of one block.

    ::

        (h0, l0) = M0 c0,   (h1, l1) = M1 c2
        c ← (h1 ⊕ c1 ⊕ k0, l1, h0 ⊕ c3 ⊕ k1, l0),   k ← k + W    ten times
    """
    c0, c1, c2, c3 = Word(block), Word(step), Word(stream), _NO
    for _ in range(_ROUNDS):
        h0, l0 = multiply_words(_M0, c0)
        h1, l1 = multiply_words(_M1, c2)
        c0, c1, c2, c3 = h1 ^ c1 ^ k0, l1, h0 ^ c3 ^ k1, l0
        k0, k1 = add_words(k0, _W0), add_words(k1, _W1)
    return c0, c1, c2, c3
