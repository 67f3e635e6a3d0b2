"""Run properties on generated inputs: a few in the suite, many with --fuzz-seconds."""

import contextlib
import random
import signal
import time
from collections.abc import Callable, Sequence

import psutil
from hypothesis import HealthCheck, Phase, example, given, seed, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, run_state_machine_as_test

ROUND = 200  # examples between two looks at the clock
PATIENCE = 20.0  # seconds for one input, on a machine that does other work, too
MEMORY = 600e6  # bytes that the process may grow by

NAN, INF = float("nan"), float("inf")
STRANGE = (NAN, INF, -INF, 0.0, -0.0, -1.0, 1e-300, 5e-324, 1e12, -1e12, 1e13, 1e300)
STRANGE_WORDS = (
    *("nan", "inf", "-inf", "0", "-1", "1e12", "1e308", "-1e400", "5e-324", "9" * 30),
    *("", "x", "True", "None", "0x10", "1_0", "1,2", "é", "\x00", "#", "²", "١"),
    *("[", "{", '"', "=", "1.5.2", "--", "\ufeff", "$\\frac{", "%s", "{0}"),
)


class TooSlowError(Exception):
    """An input that took longer than it may."""


class Fuzzer:
    """Runs properties for a time, and counts their inputs.

    Parameters
    ----------
    seconds : float
        How long; 0 for the few inputs of the suite, the same ones each time.
    start : int, optional
        The seed of the first round; drawn by default.
    """

    def __init__(self, seconds: float, start: int | None = None) -> None:
        self.seconds, self.inputs = seconds, 0
        drawn = random.SystemRandom().randrange(10**9)
        self.start = drawn if start is None else start
        self.memory = psutil.Process().memory_info().rss

    def check(
        self,
        body: Callable[..., None],
        *strategies: st.SearchStrategy,
        few: int = 30,
        saved: Sequence[tuple] = (),
    ) -> None:
        """Call a function with generated arguments, after those that are saved."""

        def judged(*arguments: object) -> None:
            self.inputs += 1
            with time_limit(PATIENCE):
                body(*arguments)
            self.refuse_growth()

        def once(options: settings, number: int | None) -> None:
            @given(st.tuples(*strategies))
            def prop(arguments):
                judged(*arguments)

            for each in saved if number in (None, 0) else ():
                prop = example(each)(prop)
            options(prop if number is None else seed(number)(prop))()

        self._in_rounds(once, few)

    def check_machine(
        self, machine: type[RuleBasedStateMachine], few: int = 30, steps: int = 30
    ) -> None:
        """Run sequences of calls."""
        fuzzer = self

        class Counted(machine):
            def check_invariants(self, settings, output=None, runtimes=None):
                fuzzer.inputs += 1
                fuzzer.refuse_growth()
                super().check_invariants(settings, output, runtimes)

        def once(options: settings, number: int | None) -> None:
            kind = type("Calls", (Counted,), {})
            chosen = settings(options, stateful_step_count=steps)
            if number is not None:
                kind = seed(number)(kind)
            run_state_machine_as_test(kind, settings=chosen)

        self._in_rounds(once, few)

    def refuse_growth(self) -> None:
        """Fail if the process has grown too large."""
        if self.inputs % 50:
            return
        grown = psutil.Process().memory_info().rss - self.memory
        assert grown < MEMORY, f"the process grew by {grown / 1e6:.0f} MB"

    def _in_rounds(self, once: Callable[..., None], few: int) -> None:
        options = {
            "deadline": None,
            "database": None,
            "suppress_health_check": list(HealthCheck),
        }
        if not self.seconds:
            quick = {"derandomize": True, "phases": [Phase.explicit, Phase.generate]}
            once(settings(**options, **quick, max_examples=few), None)
            return
        ends, number = time.monotonic() + self.seconds, 0
        phases = [Phase.explicit, Phase.generate, Phase.shrink]
        while time.monotonic() < ends:
            size = min(ROUND, few)
            once(
                settings(**options, max_examples=size, phases=phases),
                self.start + number if number else 0,
            )
            number += 1


@contextlib.contextmanager
def time_limit(seconds: float):
    """Raise `TooSlowError` in the block after so many seconds; main thread only."""

    def stop(*_):
        raise TooSlowError(f"an input took more than {seconds:g} s")

    usual = signal.signal(signal.SIGALRM, stop)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, usual)


numbers = st.one_of(
    st.floats(-5, 5), st.sampled_from(STRANGE), st.floats(), st.integers(-3, 9)
)
sane = st.floats(-3, 3, allow_subnormal=False)
words = st.one_of(
    st.sampled_from(STRANGE_WORDS),
    st.integers(-9, 99).map(str),
    st.floats().map(repr),
    st.text(max_size=5),
)

EDITS = ("replace", "replace", "insert", "drop", "drop line", "twice", "swap", "line")
edits = st.lists(
    st.tuples(
        st.sampled_from((*EDITS, "cut")), st.integers(0, 60), st.integers(0, 9), words
    ),
    max_size=5,
)


def edited(text: str, changes: list[tuple[str, int, int, str]]) -> str:
    """Return a text with words and lines changed, as (what, line, word, new)."""
    for what, number, word, new in changes:
        lines = text.split("\n")
        line = number % len(lines)
        if what == "cut":
            text = text[: len(text) * word // 9]
        elif what in EDITS[4:]:
            here = lines[line]
            lines[line : line + 1] = {
                "drop line": [],
                "twice": [here, here],
                "swap": [*lines[line + 1 : line + 2], here],
                "line": [here, new],
            }[what]
            text = "\n".join(lines)
        else:
            lines[line] = _reworded(lines[line], what, word, new)
            text = "\n".join(lines)
    return text


def _reworded(line: str, what: str, word: int, new: str) -> str:
    separator = next((s for s in (",", " = ", ": ") if s in line), " ")
    parts = line.split(separator)
    at = word % len(parts)
    parts[at : at + (what != "insert")] = [] if what == "drop" else [new]
    return separator.join(parts)


def strange_values(depth: int = 2) -> st.SearchStrategy:
    """Return values as JSON and TOML know them."""
    leaves = st.one_of(
        st.none(), st.booleans(), numbers, words, st.sampled_from([2**63, 10**400, -1])
    )
    return st.recursive(
        leaves,
        lambda inner: st.one_of(
            st.lists(inner, max_size=4), st.dictionaries(words, inner, max_size=3)
        ),
        max_leaves=depth * 3,
    )


def replaced(tree, path: list[int], value):
    """Return a tree of mappings and lists with one place on a path replaced."""
    if not path or not isinstance(tree, dict | list) or not tree:
        return value
    keys = list(tree) if isinstance(tree, dict) else range(len(tree))
    key = keys[path[0] % len(keys)]
    other = tree.copy()
    other[key] = replaced(tree[key], path[1:], value)
    return other
