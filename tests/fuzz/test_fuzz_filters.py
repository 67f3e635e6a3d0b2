"""Sequences of calls of every filter, with sane and insane arguments."""

import copy

import numpy as np
import pytest
from comparison import digest
from fuzzing import STRANGE, numbers, sane, strange_values
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, rule
from interrupts import is_interrupted, is_marked, lines_of

from slamgym.estimator import list_estimators, make_estimator
from slamgym.estimator.smoother.recorded_slam import (
    HISTORY,
    RecordedSlam,
    SmoothingSlam,
)

NOISES = [
    {"motion_std": (0.1, 0.1, 0.05), "measurement_std": (0.05, 0.1)},
    {"motion_std": (0.01, 0.0, 0.3), "measurement_std": (0.3, 0.01)},
    {"motion_std": (5.0, 5.0, 1.0), "measurement_std": (1.0, 2.0)},
]
OPTIONS = {
    "submaps": {"submap_size": 6},
    "compressed": {"local_size": 6},
    "sparse_information": {"active_bound": 4, "dense_limit": 4},
}
POLICIES = [
    None,
    True,
    {"association": "joint"},
    {"confirm": (2, 3), "backdate": True, "capacity": 4},
    {"merge_within": 0.5, "view": {"max_range": 6.0}, "remove_after": 2},
]

ids = st.one_of(st.integers(0, 9), st.sampled_from([-1, 2**40, 2**63, 2**70, None]))
few_ids = st.lists(st.integers(0, 9), max_size=4, unique=True)
pairs = st.tuples(sane, sane)
insane = st.one_of(
    st.tuples(numbers, numbers), st.lists(numbers, max_size=4), strange_values()
)
scans = st.lists(
    st.tuples(
        st.floats(-3, 3),
        st.one_of(st.floats(0.5, 8), st.sampled_from([0.0, 1e-9, 1e-3, 1e3])),
    ),
    max_size=5,
)


def is_extreme(value):
    """Whether finite numbers span more than the digits of a double can hold."""
    try:
        sizes = np.abs(np.asarray(value, dtype=float))
    except (TypeError, ValueError, OverflowError):
        return False
    return bool((sizes > 1e4).any())


def assert_sound(mean, covariance, extreme):
    """Finite; and unless the inputs were extreme, a covariance."""
    assert np.isfinite(mean).all()
    assert np.isfinite(covariance).all()
    if extreme:
        return
    scale = np.sqrt(np.diagonal(covariance).clip(0))
    assert np.allclose(covariance, covariance.T, rtol=0, atol=1e-9 * scale.max() ** 2)
    assert (np.diagonal(covariance) >= 0).all()
    unit = np.where(scale > 0, scale, 1)
    least = np.linalg.eigvalsh(covariance / np.outer(unit, unit))[0]
    assert least >= -1e-6 * len(mean)


class Calls(RuleBasedStateMachine):
    """One filter, its calls in any order."""

    names = tuple(list_estimators())

    @initialize(
        name=st.data(), noise=st.sampled_from(NOISES), policy=st.sampled_from(POLICIES)
    )
    def make(self, name, noise, policy):
        self.name = name.draw(st.sampled_from(self.names))
        if self.name == "smoother":
            self.slam = SmoothingSlam(**noise)
        else:
            options = OPTIONS.get(self.name, {})
            if self.name == "ideal":
                policy = None
            self.slam = make_estimator(self.name, **noise, management=policy, **options)
        self.extreme = False
        self.saved = [(self.slam.state_dict(), False)]

    def attempt(self, call, *arguments):
        """Make a call: it works, or it refuses and changes nothing.

        Numbers near the bound leave no digits for others; what follows may then fail
        late, with an error of linear algebra.
        """
        before = digest(self.slam)
        try:
            answer = call(self.slam, *arguments)
        except ValueError as error:
            assert str(error)
            late = self.extreme or any(map(is_extreme, arguments))
            late = late and isinstance(error, np.linalg.LinAlgError)
            if digest(self.slam) != before:
                assert late, error
                self.slam.reset((0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
                self.extreme = False
            return None
        self.extreme |= any(map(is_extreme, arguments))
        return answer

    @rule(odometry=pairs)
    def predict(self, odometry):
        self.attempt(lambda s, u: s.predict(u), odometry)

    @rule(odometry=st.one_of(pairs, insane), dt=st.one_of(numbers, strange_values()))
    def predict_anything(self, odometry, dt):
        self.attempt(lambda s, u, t: s.predict(u, t), odometry, dt)

    @rule(readings=scans, first=st.integers(0, 6), data=st.data())
    def update(self, readings, first, data):
        known = list(range(first, first + len(readings)))
        given = known if not self.managed else data.draw(st.sampled_from([known, None]))
        self.attempt(lambda s, z: s.update(z, given), readings)

    @rule(
        readings=st.one_of(scans, insane),
        known=st.one_of(st.none(), st.lists(ids, max_size=5), strange_values()),
    )
    def update_anything(self, readings, known):
        self.attempt(lambda s, z: s.update(z, known), readings)

    @rule(gone=st.one_of(few_ids, st.lists(ids, max_size=3), strange_values()))
    def remove(self, gone):
        self.optional("remove", gone)

    @rule(kept=ids, gone=ids)
    def merge(self, kept, gone):
        self.optional("merge", kept, gone)

    @rule(within=numbers)
    def local_view(self, within):
        view = self.optional("local_view", within)
        if view is not None:
            assert_sound(
                np.asarray(view.mean), np.asarray(view.covariance), self.extreme
            )

    @rule()
    def join(self):
        self.optional("join")

    @rule(pose=st.tuples(sane, sane, sane), std=st.tuples(numbers, numbers, numbers))
    def reset(self, pose, std):
        self.attempt(lambda s, p, d: s.reset(p, d), pose, std)

    @rule()
    def save(self):
        self.saved.append((copy.deepcopy(self.slam.state_dict()), self.extreme))

    @rule(number=st.integers(0, 5))
    def load(self, number):
        state, self.extreme = self.saved[number % len(self.saved)]
        if self.extreme:
            return
        self.slam.load_state_dict(state)
        after = digest(self.slam)
        self.slam.load_state_dict(self.slam.state_dict())
        assert digest(self.slam) == after

    @rule(number=st.integers(0, 40), data=st.data())
    def load_damaged(self, number, data):
        if self.extreme:
            return
        state = dict(self.slam.state_dict())
        key = sorted(state)[number % len(state)]
        value = np.asarray(state[key])
        how = data.draw(st.sampled_from(["drop", "short", "number", "anything"]))
        if how == "drop":
            del state[key]
        elif how == "short" and value.ndim:
            state[key] = value[:-1]
        elif how == "number" and value.dtype.kind == "f" and value.size:
            state[key] = value.copy()
            state[key].flat[number % value.size] = data.draw(st.sampled_from(STRANGE))
        else:
            state[key] = data.draw(strange_values())
        before = self.slam.state_dict()
        self.attempt(lambda s: s.load_state_dict(state))
        self.slam.load_state_dict(before)

    @rule(known=st.one_of(st.none(), few_ids))
    def belief(self, known):
        belief = self.attempt(lambda s: s.belief(known) if known else s.belief())
        if belief is not None:
            assert_sound(belief.mean, belief.covariance, self.extreme)

    def optional(self, name, *arguments):
        if hasattr(self.slam, name):
            return self.attempt(lambda s: getattr(s, name)(*arguments))
        return None

    @property
    def managed(self):
        return hasattr(self.slam, "policy") or self.name == "smoother"

    def teardown(self):
        if hasattr(self, "slam"):
            try:
                belief = self.slam.belief()
            except np.linalg.LinAlgError:
                return
            assert_sound(belief.mean, belief.covariance, self.extreme)


LARGE = ("compressed", "sparse_information", "submaps")


class CallsOfLargeMaps(Calls):
    """The same for the filters of large maps, which have most to keep in step."""

    names = LARGE


@pytest.mark.parametrize("machine", [Calls, CallsOfLargeMaps])
def test_filters_stay_sound_and_errors_change_nothing(fuzzer, machine):
    fuzzer.check_machine(machine, few=8)


LOOPS = {"constellations": True, "merge_within": 0.3, "confirm": (1, 1)}
MANAGED = [None, {"association": "nearest"}, *POLICIES[2:], LOOPS]
MANAGED += [{"association": "hypotheses", "confirm": (1, 2)}]
FILTERS = (*list_estimators(), "ideal with truth", "smoother")
KINDS = [
    (name, policy)
    for name in FILTERS
    for policy in (MANAGED if name not in FILTERS[-2:] else MANAGED[:1])
]
NEAREST = np.array([(2.0, 1.0), (3.0, -2.0), (0.5, 3.0), (5.0, 1.5), (7.0, -1.0)])
PLACES = np.concatenate([np.add(NEAREST, (x, y)) for x in (0, 6) for y in (0, 5)])


def made(name, policy):
    if name == "smoother":
        return SmoothingSlam(**NOISES[0])
    name = name.partition(" ")[0]
    options = OPTIONS.get(name, {})
    return make_estimator(name, **NOISES[0], management=policy, **options)


def a_scan(step, named):
    """The readings of a drive on a circle, and their identities where these are named.

    The managed filters get no identities in most steps.
    """
    pose = 3 * np.sin(0.3 * step), 3 - 3 * np.cos(0.3 * step), 0.3 * step
    dx, dy = (PLACES - pose[:2]).T
    distance = np.hypot(dx, dy)
    seen = np.flatnonzero(distance < 5.0)[:5]
    bearing = np.arctan2(dy, dx)[seen] - pose[2]
    bearing += 0.05 * np.sin(7.0 * step + seen)
    readings = np.column_stack(
        [(bearing + np.pi) % (2 * np.pi) - np.pi, distance[seen]]
    )
    return readings, seen if named else None


def calls_at(name, policy, step, saved):
    """The calls that a drive makes in one step, by name."""
    readings, ids = a_scan(step, policy is None or step % 5 == 4)
    truth = (3 * np.sin(0.3 * step), 3 - 3 * np.cos(0.3 * step), 0.3 * step)
    calls = {"predict": lambda s: s.predict((0.9, 0.3))}
    if name == "ideal with truth":
        told = dict(enumerate(PLACES))
        calls = {"observe_truth": lambda s: s.observe_truth(truth, told)} | calls
    calls |= {
        "belief": lambda s: s.belief(),
        "update": lambda s: s.update(readings, ids),
        "state_dict": lambda s: s.state_dict(),
    }
    if hasattr(saved, "local_view"):
        calls["local_view"] = lambda s: s.local_view(4.0)
    if step % 7 == 6 and (policy is None or name not in LARGE):
        calls["remove"] = lambda s: s.remove(s.landmark_ids[:1])
        calls["merge"] = lambda s: s.merge(*s.landmark_ids[-2:])
    return calls


def look(slam):
    """The state and the belief, to the bit."""
    belief = slam.belief()
    parts = {k: v for k, v in digest(slam).items() if k != HISTORY}
    drive = repr(list(slam._events())) if isinstance(slam, RecordedSlam) else ""
    return parts, belief.mean.tobytes(), belief.covariance.tobytes(), drive


def without_mark(slam, saved):
    """Load the last state where an interrupt has left a mark; return the filter."""
    if is_marked(slam):
        slam.load_state_dict(saved)
    return slam


def interrupt(name, policy, lines, *, steps=12):
    """Interrupt calls of a drive; each changes all or nothing, or marks the filter.

    A filter with a mark loads its last state, and the drive goes on.

    Parameters
    ----------
    name, policy
        The filter and its management.
    lines : callable
        Returns the lines at which to interrupt a call of so many lines.

    Returns
    -------
    int
        How many calls were interrupted.
    """
    slam, twin, count = made(name, policy), made(name, policy), 0
    start = slam.state_dict()
    for step in range(steps):
        calls = calls_at(name, policy, step, slam)
        if step == steps - 1:
            calls["load_state_dict"] = lambda s: s.load_state_dict(start)
            calls["reset"] = lambda s: s.reset((1.0, 2.0, 0.5), (0.1, 0.1, 0.1))
        for label, call in calls.items():
            before, saved = look(slam), slam.state_dict()
            total = lines_of(lambda: call(twin))  # noqa: B023
            after = look(twin)
            is_new = False
            for line in lines(total):
                count += 1
                if not is_interrupted(lambda: call(slam), line):  # noqa: B023
                    is_new = True
                    break
                now = look(without_mark(slam, saved))
                assert now in (before, after), (name, policy, step, label, line, total)
                if now != before:
                    is_new = True
                    break
            if not is_new:
                call(slam)
            assert look(slam) == after, (name, policy, step, label)
    return count


def test_an_interrupted_call_changes_all_or_nothing_or_marks_the_filter(fuzzer):
    def once(kind, seed):
        rng = np.random.default_rng(seed)

        def one_line(total):
            return [int(rng.integers(total))] if total else []

        fuzzer.inputs += interrupt(*KINDS[kind], one_line, steps=9) - 1

    kinds = st.integers(0, len(KINDS) - 1)
    fuzzer.check(once, kinds, st.integers(0, 10**9), few=4)
