"""Pack many arrays into one short text inside a web page.

The arrays become integers or single-precision numbers. Arrays of successive frames hold
differences to the frame before, which deflate shrinks; ``data.js`` unpacks them.
"""

import base64
import zlib
from collections.abc import Sequence
from typing import Any

import numpy as np

from ...arrays import AnyArray, Array

TENTHS = 1e4
"""Positions are integers of a tenth of a millimetre."""
LOG_STEPS = 2000.0
"""Standard deviations σ are integers of 2000 ln σ, a resolution of 0.05 %."""

_ALIGNMENT = 4  # [bytes] of the page's typed arrays
_TYPES = ("float32", "int32", "int16", "uint8")


class PackedArrays:
    """Arrays by name, collected for one page.

    Examples
    --------
    >>> packed = PackedArrays()
    >>> packed.put("t", np.array([0.0, 0.5]), "float32")
    >>> packed.put_frames("ids", [np.array([4]), np.array([4, 9])], "int32")
    >>> packed.table["ids"]
    {'type': 'int32', 'length': 3, 'counts': 'ids.counts'}
    """

    def __init__(self) -> None:
        self.table: dict[str, dict[str, Any]] = {}
        """Type, length and, of frames, the name of their numbers of entries."""
        self._parts: list[bytes] = []

    def put(self, name: str, values: AnyArray, kind: str) -> None:
        """Add a flat array as one of float32, int32, int16, uint8."""
        if kind not in _TYPES:
            raise ValueError(f"kind must be one of {', '.join(_TYPES)}, got {kind!r}")
        flat = np.ascontiguousarray(values, dtype=np.dtype(kind).newbyteorder("<"))
        self.table[name] = {"type": kind, "length": flat.size}
        content = flat.tobytes()
        self._parts.append(content + bytes(-len(content) % _ALIGNMENT))

    def put_frames(self, name: str, frames: Sequence[AnyArray], kind: str) -> None:
        """Add flat arrays of one integer type, one a frame, of any lengths each."""
        counts = f"{name}.counts"
        self.put(counts, np.array([len(frame) for frame in frames]), "int32")
        before = np.empty(0, dtype=kind)
        changes = [before]
        for frame in frames:
            now = np.asarray(frame, dtype=kind)
            change = now.copy()
            common = min(len(now), len(before))
            change[:common] -= before[:common]  # modulo 2ⁿ, as the page adds up
            changes.append(change)
            before = now
        self.put(name, np.concatenate(changes), kind)
        self.table[name]["counts"] = counts

    def text(self) -> str:
        """Return all arrays in the order of the table, deflated, in base64."""
        return base64.b64encode(zlib.compress(b"".join(self._parts))).decode()


def position_codes(metres: Array) -> AnyArray:
    """Return positions as integers, :data:`TENTHS` a metre; nan is the least one."""
    least, most = np.iinfo(np.int32).min, np.iinfo(np.int32).max
    codes = np.clip(np.round(metres * TENTHS), least + 1, most)
    return np.where(np.isnan(codes), least, codes).astype(np.int32)


def deviation_codes(std: Array) -> AnyArray:
    """Return 2000 ln σ as integers; zero and nan are the least one."""
    least, most = np.iinfo(np.int16).min, np.iinfo(np.int16).max
    with np.errstate(divide="ignore", invalid="ignore"):
        codes = np.clip(np.round(LOG_STEPS * np.log(std)), least, most)
    return np.where(np.isnan(codes), least, codes).astype(np.int16)
