"""Write many floats at once as `repr` does: with the fewest digits that identify them.

Of the decimal numbers that are rounded to a float x = c 2^q, with integers c and q,
`repr` takes those with the fewest digits, and of these the nearest to x [1]_. With
10^k <= 2^q < 10^(k+1), the interval of the numbers that are rounded to x contains a
multiple of 10^k, and at most one multiple of 10^(k+1).

References
----------
.. [1] R. Giulietti, The Schubfach way to render doubles, 2020.
"""

import numpy as np

from ...arrays import AnyArray, Array, IntArray, WordArray
from ...jit import jit_in_place, multiply_words, njit_internal

#: In this range of sizes, `repr` writes no exponent, and 5^-k fits into 64 bits.
_SMALLEST, _END = 1e-4, 2.0**53
_FIVES = np.array([5**m for m in range(21)], dtype=np.uint64)
_MOST = 25  # bytes of the longest text: sign, 0.000, 17 digits, line feed


def texts(values: Array) -> list[str]:
    """Write numbers, shape (n,), so that reading gives the same bits; nan as "".

    Examples
    --------
    >>> texts(np.array([0.1, 2.0, 1e-7, np.nan]))
    ['0.1', '2.0', '1e-07', '']
    """
    text = np.empty(_MOST * len(values), dtype=np.uint8)
    words = np.ascontiguousarray(values, dtype=np.float64).view(np.int64)
    size = np.abs(values)
    is_plain = ((size >= _SMALLEST) & (size < _END)) | (size == 0)
    end = _write(words, is_plain, _FIVES, text)
    found = text[:end].tobytes().decode("ascii").split("\n")[:-1]
    for row in np.flatnonzero(~is_plain).tolist():
        found[row] = "" if np.isnan(values[row]) else repr(float(values[row]))
    return found


@jit_in_place
def _write(
    words: IntArray, is_plain: AnyArray, fives: WordArray, text: AnyArray
) -> int:
    """Write plain floats from their bits, and others as empty lines; return the end."""
    end = 0
    for i in range(len(words)):
        if is_plain[i]:
            if words[i] < 0:
                text[end] = ord("-")
                end += 1
            digits, power = 0, 0
            if words[i] << 1 != 0:
                digits, power = _shortest(words[i], fives)
            end = _write_digits(digits, power, text, end)
        text[end] = ord("\n")
        end += 1
    return end


@njit_internal
def _shortest(word: int, fives: WordArray) -> tuple[int, int]:
    """Return the integers d and p of the number d 10^p that represents a float.

    Sizes are compared exactly, in multiples of 10^k / 4. An end of the interval is an
    odd multiple of 2^(q - 1), and therefore not a multiple of 10^k. If the float is a
    power of two, the interval is shorter at its lower end, but this changes no text.
    """
    c, q = word & (2**52 - 1) | 2**52, ((word >> 52) & 0x7FF) - 1075
    k = 1262611 * q >> 22  # ⌊q log₁₀ 2⌋
    least, size = _scaled(16 * c - 8, k, q, fives), _scaled(16 * c, k, q, fives)
    most, digits = _scaled(16 * c + 8, k, q, fives), 0
    for more in (1, 0):
        unit = 40 if more else 4
        digits = size // unit
        is_above = (digits + 1) * unit <= most
        if (digits * unit >= least) != is_above:
            return digits + is_above, k + more
    rest = size - 4 * digits
    return digits + (rest > 2 or (rest == 2 and digits & 1 == 1)), k


@njit_internal
def _scaled(size: int, k: int, q: int, fives: WordArray) -> int:
    """Return size 2^(q - 4) in multiples of 10^k / 4.

    It is size 5^-k / 2^(k - q + 2), rounded down. The last bit is set if there was a
    fraction.
    """
    high, low = multiply_words(np.uint64(size), fives[-k])
    down = np.uint64(k - q + 2)
    up = np.uint64(64) - down
    is_whole = low << up == np.uint64(0)
    return int(np.int64((high << up) | (low >> down))) | (not is_whole)


@njit_internal
def _write_digits(digits: int, power: int, text: AnyArray, end: int) -> int:
    """Write d 10^p with a decimal point, the last digit first; return the new end."""
    while power < -1 and digits % 10 == 0:
        digits, power = digits // 10, power + 1
    while power > -1:
        digits, power = 10 * digits, power - 1
    count, limit = 1, 10
    while digits >= limit:
        count, limit = count + 1, 10 * limit
    end += max(count, 1 - power) + 1
    for place in range(max(count, 1 - power) + 1):
        if place == -power:
            text[end - 1 - place] = ord(".")
        else:
            text[end - 1 - place] = ord("0") + digits % 10
            digits //= 10
    return end
