"""Check integers that files store."""

import numpy as np

_LARGEST = 2**63 - 1  # of int64


def integer(name: str, value: object, least: int) -> int:
    """Check an integer that fits int64, and return it as int.

    Raises
    ------
    ValueError
        If it is none, or is too small or too large.

    Examples
    --------
    >>> integer("seed", np.int64(3), 0)
    3
    """
    whole = int(value) if isinstance(value, int | np.integer) else None
    if whole is None or isinstance(value, bool) or whole < least:
        raise ValueError(f"{name} must be an integer >= {least}, got {value!r}")
    if whole > _LARGEST:
        raise ValueError(f"{name} must be at most {_LARGEST}, got {whole}")
    return whole
