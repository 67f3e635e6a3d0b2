"""Time alternatives side by side: interleaved rounds, CPU time of this thread."""

import time
from collections.abc import Callable, Mapping
from statistics import median

import pymunk


def bare_steps(count: int) -> Callable[[], None]:
    """Return a call that takes ``count`` steps of a bare physics world.

    A bare step is `pymunk.Space.step` with one kinematic body.
    """
    space, body = pymunk.Space(), pymunk.Body(body_type=pymunk.Body.KINEMATIC)
    space.add(body)
    body.velocity, body.angular_velocity = (0.1, 0.2), 0.1

    def call() -> None:
        for _ in range(count):
            space.step(1.0)

    return call


def time_interleaved(
    cases: Mapping[str, Callable[[], object]],
    *,
    rounds: int = 15,
    seconds: float = 0.02,
) -> dict[str, list[float]]:
    """Return the CPU seconds per call of each case, one entry per round.

    In every round each case runs for about ``seconds``; ratios are then formed round by
    round, so that whatever else the machine does hits all cases alike.
    """
    counts = {}
    for name, call in cases.items():
        call()
        began = time.thread_time()
        call()
        counts[name] = max(1, int(seconds / max(time.thread_time() - began, 1e-7)))
    times: dict[str, list[float]] = {name: [] for name in cases}
    for _ in range(rounds):
        for name, call in cases.items():
            began = time.thread_time()
            for _ in range(counts[name]):
                call()
            times[name].append((time.thread_time() - began) / counts[name])
    return times


def ratio(times: Mapping[str, list[float]], slow: str, fast: str) -> float:
    """Median over the rounds of how many times longer ``slow`` takes than ``fast``."""
    return median(a / b for a, b in zip(times[slow], times[fast], strict=True))


def microseconds(times: Mapping[str, list[float]], name: str) -> float:
    """Median time of a case [µs]."""
    return 1e6 * median(times[name])


def verdict(value: float, goal: float, *, at_least: bool) -> str:
    """Return "ok" or "MISSED" for a ratio and its goal."""
    return "ok" if (value >= goal if at_least else value <= goal) else "MISSED"
