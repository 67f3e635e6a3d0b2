"""Sequences of calls of every filter, with sane and insane arguments."""

import copy

import numpy as np
import pytest
from fuzzing import STRANGE, numbers, sane, strange_values
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, rule

from slamgym.estimator import list_estimators, make_estimator
from slamgym.estimator.smoother.smoothing_slam import SmoothingSlam

NOISES = [
    {"motion_std": (0.1, 0.1, 0.05), "measurement_std": (0.05, 0.1)},
    {"motion_std": (0.01, 0.0, 0.3), "measurement_std": (0.3, 0.01)},
    {"motion_std": (5.0, 5.0, 1.0), "measurement_std": (1.0, 2.0)},
]
OPTIONS = {"submaps": {"submap_size": 6}, "compressed": {"local_size": 6}}
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


def digest(slam):
    """The whole state, to the bit."""
    return {
        key: (str(np.asarray(value).dtype), np.asarray(value).tobytes())
        for key, value in slam.state_dict().items()
    }


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
