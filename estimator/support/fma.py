"""The fused multiply-add, said where it is meant and nowhere else.

Left to a compiler's liberty (``fastmath``) what is fused depends on what was inlined
where: the same kernel would give other bits alone than inside another, and other bits
compiled than loaded from the cache.
"""

from collections.abc import Callable
from typing import Any, cast

from numba import config, types
from numba.extending import intrinsic


def _rounded_twice(a: float, b: float, c: float) -> float:
    """Return a b + c, in plain Python."""
    return a * b + c


def _emitted(_typing: Any, _a: Any, _b: Any, _c: Any) -> tuple[Any, Any]:
    def generate(_context: Any, builder: Any, _signature: Any, arguments: Any) -> Any:
        return builder.fma(*arguments)

    return types.float64(types.float64, types.float64, types.float64), generate


fma = cast(
    "Callable[[float, float, float], float]",
    _rounded_twice if getattr(config, "DISABLE_JIT", 0) else intrinsic(_emitted),
)
"""a b + c, rounded once."""
