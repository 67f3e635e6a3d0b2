"""Philox4x64-10: four random words from a key and a position, without any state.

Symbols
-------
key = (k0, k1)          names an episode
position = (b, t, s)    block b of step t of stream s; a block has four words

The words are those of ``numpy.random.Philox(key=key, counter=[0, t, s, 0])``, which
takes the blocks b = 1, 2, … in turn.

Source: Salmon, Moraes, Dror, Shaw, "Parallel random numbers: as easy as 1, 2, 3", SC
2011, section 3.
"""

import numpy as np

from ...jit import add_words, multiply_words, njit_internal

Word = np.uint64
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
