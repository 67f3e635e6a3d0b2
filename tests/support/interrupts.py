"""Raise `KeyboardInterrupt` at a chosen Python line of the library."""

import sys
from collections.abc import Callable
from copy import deepcopy
from typing import Any

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


def assert_all_or_nothing(slam: Any, call: Callable[[Any], object]) -> None:
    """Interrupt a call before each of its lines; belief and report change together."""
    after = deepcopy(slam)
    lines, found = lines_of(lambda: call(after)), set()
    for line in range(lines):
        other = deepcopy(slam)
        assert is_interrupted(lambda: call(other), line)  # noqa: B023
        expected = after if other.steps != slam.steps else slam
        assert digest(other) == digest(expected), line
        assert other.report() == expected.report(), line
        found.add(expected is after)
    assert found == {False, True}


def _traced(call: Callable[[], object], lines: _Lines) -> None:
    usual = sys.gettrace()
    sys.settrace(lines)
    try:
        call()
    finally:
        sys.settrace(usual)
