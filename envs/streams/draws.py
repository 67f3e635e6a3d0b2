"""Draw the numbers of many steps or worlds in one compiled pass."""

from ...arrays import Array, IntArray, WordArray
from ...jit import jit, njit_internal
from .distributions import make_normal, shifted, uniform_of
from .philox import random_block


@jit
def draw_normals(keys: WordArray, steps: IntArray, stream: int, out: Array) -> None:
    """Fill an array with standard normal numbers, row k from step ``steps[k]``.

    Parameters
    ----------
    keys : uint64 ndarray, shape (K, 2)
        The key of each row.
    steps : int64 ndarray, shape (K,)
    stream : int
        Its number, see `episodes`.
    out : ndarray, shape (H, K, W)
        Contiguous. Row k of part h takes the numbers h W to (h + 1) W of its step.
    """
    parts, rows, width = out.shape
    for row in range(rows):
        k0, k1, step = keys[row, 0], keys[row, 1], steps[row]
        part, column = 0, 0
        for block in range((parts * width + 3) // 4):
            for word in random_block(k0, k1, block + 1, step, stream):
                if part < parts:
                    out[part, row, column] = shifted(word)
                    column += 1
                    if column == width:
                        part, column = part + 1, 0
    make_normal(out.reshape(-1))


@jit
def draw_uniforms(keys: WordArray, steps: IntArray, stream: int, out: Array) -> None:
    """Fill an array, (K, W), with uniform numbers in [0, 1); see `draw_normals`."""
    rows, width = out.shape
    for row in range(rows):
        k0, k1, step = keys[row, 0], keys[row, 1], steps[row]
        column = 0
        for block in range((width + 3) // 4):
            for word in random_block(k0, k1, block + 1, step, stream):
                if column < width:
                    out[row, column] = uniform_of(word)
                    column += 1


@jit
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
