"""Raise `KeyboardInterrupt` at a chosen Python line of the library."""

import pickle
import sys
from collections.abc import Callable, Iterable
from copy import deepcopy
from typing import Any

import pytest
from comparison import digest


class _Lines:
    """Counts the lines of the library that a call runs; interrupts one of them."""

    def __init__(self, stop: int = -1) -> None:
        self.stop, self.count = stop, 0

    def __call__(self, frame, event, _):
        name = frame.f_globals.get("__name__", "")
        if event == "call":
            return self if name.startswith("slamgym.") else None
        if event == "line":
            self.count += 1
            if self.count - 1 == self.stop:
                raise KeyboardInterrupt
        return self


def lines_of(call: Callable[[], object]) -> int:
    """Make a call; return how many lines of the library it runs."""
    lines = _Lines()
    _traced(call, lines)
    return lines.count


def is_interrupted(call: Callable[[], object], line: int) -> bool:
    """Make a call, interrupted before a line of the library; return whether it was."""
    try:
        _traced(call, _Lines(line))
    except KeyboardInterrupt:
        return True
    return False


def is_marked(slam: Any) -> bool:
    """Return whether a filter refuses its calls because of an interrupt."""
    return bool(getattr(slam, "interrupted_in", ""))


def found_after_interrupts(
    slam: Any,
    call: Callable[[Any], object],
    lines: Callable[[int], Iterable[int]] = range,
) -> set[str]:
    """Interrupt a call before its lines; return how it leaves copies of a filter.

    They are as "before" the call or as "after" it, or "marked": they then refuse all
    calls until they load a state.

    Parameters
    ----------
    slam
        The filter.
    call : callable
        The call.
    lines : callable
        Returns the lines at which to interrupt a call of so many lines.
    """
    after, saved, found = deepcopy(slam), slam.state_dict(), set()
    total = lines_of(lambda: call(after))
    before, result = _seen(slam), _seen(after)
    for line in lines(total):
        other = deepcopy(slam)
        if not is_interrupted(lambda: call(other), line):  # noqa: B023
            continue  # a copy has fewer lines: it shares caches
        if is_marked(other):
            for next_call in () if "marked" in found else NEXT_CALLS:
                with pytest.raises(RuntimeError, match="was interrupted in"):
                    next_call(other)
            other.load_state_dict(saved)
            assert digest(other) == before[0], line
            found.add("marked")
        else:
            assert _seen(other) in (before, result), line
            found.add("before" if _seen(other) == before else "after")
    return found


NEXT_CALLS = (
    lambda slam: slam.predict((0.1, 0.0)),
    lambda slam: slam.update([(0.5, 4.0)], [5]),
    lambda slam: slam.belief(),
    lambda slam: slam.landmark_ids,
    lambda slam: slam.report(),
    lambda slam: deepcopy(slam).state_dict(),
    lambda slam: pickle.loads(pickle.dumps(slam)).belief(),
)


def _seen(slam: Any) -> tuple[Any, ...]:
    return digest(slam), slam.report()


def _traced(call: Callable[[], object], lines: _Lines) -> None:
    usual = sys.gettrace()
    sys.settrace(lines)
    try:
        call()
    finally:
        sys.settrace(usual)
