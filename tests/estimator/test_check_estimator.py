import re
import sys
from functools import partial
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from comparison import assert_close_beliefs

from slamgym.estimator import (
    Belief,
    EkfSlam,
    EstimatorContractError,
    SlamEstimator,
    UpdateReport,
    check_estimator,
    list_estimators,
    make_estimator,
    register_estimator,
)
from slamgym.estimator.check_estimator import find_breaches
from slamgym.estimator.covariance_checks import _drive
from slamgym.estimator.models.bearing_range import predict_measurement
from slamgym.estimator.models.motions import predict_pose

TEXTBOOK = Path(__file__).parents[2] / "examples" / "05_your_own_estimator.py"
NOISE = {"motion_std": (0.1, 0.1, 0.1), "measurement_std": (0.1, 0.1)}


@pytest.mark.parametrize("name", list_estimators())
def test_every_registered_estimator_keeps_the_contract(name):
    assert check_estimator(name) == ()
    assert isinstance(make_estimator(name, **NOISE), SlamEstimator)


class LacksUpdate(EkfSlam):
    update = None


def answers_with_live(*names):
    """Return a filter whose first belief follows its later ones in these arrays."""

    class Answers(EkfSlam):
        def belief(self):
            belief = super().belief()
            self._live = getattr(self, "_live", belief)
            for name in names:
                object.__setattr__(self._live, name, getattr(belief, name))
            return self._live

    return Answers


def shows(change):
    """Return a filter that shows another mean, covariance and ids than it has."""

    class Shows(EkfSlam):
        def belief(self):
            belief = super().belief()
            return Belief(*change(belief.mean, belief.covariance, belief.landmark_ids))

    return Shows


class AcceptsNan(EkfSlam):
    def predict(self, odometry, dt=1.0):
        super().predict(np.nan_to_num(odometry), dt)


class ForgetsItsMap(EkfSlam):
    def state_dict(self):
        fresh = EkfSlam(**NOISE)
        return fresh.state_dict() | {"estimator": "ForgetsItsMap"}


class KeepsItsMapOnReset(EkfSlam):
    def reset(self, pose, pose_std):
        if not hasattr(self, "started"):
            super().reset(pose, pose_std)
        self.started = True
        self.map.mean[:3] = pose


class ReturnsNothing(EkfSlam):
    def update(self, measurements, landmark_ids=None):
        super().update(measurements, landmark_ids)


class SavesLiveArrays(EkfSlam):
    def state_dict(self):
        n, mean, covariance = self.map.size, self.map.mean, self.map.covariance
        live = {"mean": mean[:n], "covariance": covariance[:n, :n]}
        return super().state_dict() | live


class SavesALiveReference(EkfSlam):
    """What it shares shows only in the next steps."""

    def __init__(self, *arguments, **settings):
        super().__init__(*arguments, **settings)
        self.drift = np.zeros(1)

    def predict(self, odometry, dt=1.0):
        super().predict(np.asarray(odometry) + self.drift, dt)

    def state_dict(self):
        return super().state_dict() | {"drift": self.drift}


class LoadsTheMeanItself(EkfSlam):
    def load_state_dict(self, state):
        super().load_state_dict({k: v for k, v in state.items() if k != "own"})
        self.map.parts = self.map.parts._replace(mean=state["own"])

    def state_dict(self):
        return super().state_dict() | {"own": self.map.mean.copy()}


class SavesADictionary(EkfSlam):
    def state_dict(self):
        return super().state_dict() | {"slots": dict(self.map.slots)}

    def load_state_dict(self, state):
        super().load_state_dict(state)
        self.map.slots = state["slots"]


class RaisesAtNan(EkfSlam):
    def update(self, measurements, landmark_ids=None):
        if np.isnan(measurements).any():
            raise RuntimeError("this cannot be")
        return super().update(measurements, landmark_ids)


class LacksMuch:
    """Without the length of a step, and without most methods."""

    def __init__(self, **_):
        pass

    def predict(self, odometry):
        """Ignore a motion."""

    def update(self, measurements, landmark_ids=None):
        """Ignore a scan."""


class ReportsNothing(EkfSlam):
    def update(self, measurements, landmark_ids=None):
        super().update(measurements, landmark_ids)
        return UpdateReport()


class RemembersItsRuns(EkfSlam):
    runs = 0

    def reset(self, pose, pose_std):
        super().reset(pose, pose_std)
        self.runs += 1

    def predict(self, odometry, dt=1.0):
        super().predict(odometry, dt + 1e-9 * self.runs)


class LosesCertainty(EkfSlam):
    scans = 0

    def update(self, measurements, landmark_ids=None):
        report = super().update(measurements, landmark_ids)
        self.scans += len(measurements) > 0
        self.map.covariance[3, 3] += 0.01 * self.scans * (self.map.size > 3)
        return report


class NeedsAStart(EkfSlam):
    def __init__(self, *, initial_pose, **settings):
        super().__init__(initial_pose=initial_pose, **settings)


class NeedsIds(EkfSlam):
    def update(self, measurements, landmark_ids):
        return super().update(measurements, list(landmark_ids))


class StartsTooCertain(EkfSlam):
    def __init__(self, **settings):
        super().__init__(**{**settings, "initial_pose_std": (0, 0, 0)})


@pytest.mark.parametrize(
    ("estimator", "complaint"),
    [
        (
            LacksUpdate,
            r"LacksUpdate has no method update\(measurements, landmark_ids\)",
        ),
        (
            LacksMuch,
            r"no method reset\((?s:.*)predict\(odometry\) in place of(?s:.*)bel",
        ),
        (StartsTooCertain, r"0\.09\]\], got \[\[0\.0, 0\.0, 0\.0\]"),
        (answers_with_live("mean"), "snapshot"),
        (answers_with_live("covariance"), "snapshot"),
        (answers_with_live("mean", "covariance", "landmark_ids"), "snapshot"),
        (
            shows(lambda x, P, ids: (x, P / (400 if ids else 1), ids)),
            "the covariance is multiplied by 0.0025: ",
        ),
        (
            shows(lambda x, P, ids: (x + 7 * P[0] / (P[0, 0] ** 0.5 + 1e-9), P, ids)),
            r"NEES below 30 \(3 is expected\), got \d\d\.\d",
        ),
        (LosesCertainty, r"- update\(\) must not make the belief less certain\n"),
        (LosesCertainty, "certain: a second reading of a landmark must shrink its cov"),
        (KeepsItsMapOnReset, r"after reset\(pose, pose_std\) must have no landmarks"),
        (ReturnsNothing, "must return an UpdateReport, got NoneType"),
        (
            shows(lambda x, P, ids: (x + (not ids) * (np.arange(len(x)) == 2), P, ids)),
            r"after a new estimator must be the pose .* got \[1\.0, -2\.0, 1\.5\]",
        ),
        (
            shows(lambda x, P, ids: (x[:5], P[:5, :5], ids[:1])),
            r"update\(\) of ids 9 and 4 must map them, got \(9,\)",
        ),
        (
            shows(lambda x, P, ids: (x, P, tuple(range(len(ids))))),
            r"ids given to update\(\), here 9 and 4, got \(0, 1\)",
        ),
        (
            shows(lambda x, P, ids: (x, P + 0.001 * np.eye(len(x), k=1), ids)),
            "must be symmetric, got elements that differ by 0.001",
        ),
        (
            shows(lambda x, P, ids: (x, P - 0.05 * np.eye(len(x)), ids)),
            "must be positive semidefinite, got the eigenvalue -0.0",
        ),
        (lambda: None, r"<lambda>\(motion_std=.* raised TypeError: .* unexpected"),
    ],
)
def test_a_breach_of_the_contract_is_named(estimator, complaint):
    with pytest.raises(EstimatorContractError, match=complaint):
        check_estimator(estimator)


def test_an_estimator_in_place_of_its_class_is_refused():
    with pytest.raises(TypeError, match=r"must be callable, .* got EkfSlam"):
        check_estimator(EkfSlam(**NOISE))


@pytest.mark.parametrize(
    ("estimator", "complaint"),
    [
        (
            AcceptsNan,
            r"should raise a ValueError .* predict\(\(nan, 0\)\) raised nothing",
        ),
        (RaisesAtNan, r"but update\(\) with a NaN raised RuntimeError: this cannot be"),
        (ForgetsItsMap, "bit for bit"),
        (SavesLiveArrays, r"state_dict\(\) must return copies"),
        (SavesALiveReference, r"state_dict\(\) must return copies"),
        (LoadsTheMeanItself, r"load_state_dict\(\) must copy"),
        (SavesADictionary, r"what numpy\.savez saves and loads, got ValueError: Ob"),
        (ReportsNothing, r"new landmarks in added_ids, got UpdateReport: NIS 0"),
        (ReportsNothing, r"the 4 readings used: .*, got \(\) and 0"),
        (RemembersItsRuns, r"reset\(\) should forget the run"),
        (NeedsAStart, r"raised TypeError: .*missing .*'initial_pose'"),
        (NeedsIds, r"update\(np\.empty\(\(0, 2\)\), None\) raised TypeError"),
    ],
)
def test_a_recommendation_is_returned_and_raises_nothing(estimator, complaint):
    findings = check_estimator(estimator)
    assert {finding.level for finding in findings} == {"recommended"}
    assert any(re.search(complaint, finding.message) for finding in findings)


class Plain:
    """EKF-SLAM as people write it: plain numpy, ids in a list, no slamgym."""

    def __init__(self, motion_std, measurement_std, initial_pose, initial_pose_std):
        self.R, self.Q = np.diag(motion_std) ** 2, np.diag(measurement_std) ** 2
        self.start(initial_pose, initial_pose_std)

    def start(self, pose, std):
        self.x, self.P, self.ids = np.array(pose, float), np.diag(std) ** 2, []

    def predict(self, odometry):
        d, turn = odometry
        c, s = np.cos(self.x[2]), np.sin(self.x[2])
        self.x[:3] += d * c, d * s, turn
        G = np.eye(len(self.x))
        G[:2, 2] = -d * s, d * c
        F = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
        self.P = G @ self.P @ G.T
        self.P[:3, :3] += F @ self.R @ F.T

    def update(self, measurements, landmark_ids):
        for (bearing, r), i in zip(measurements, landmark_ids, strict=True):
            if i not in self.ids:
                self.add(i, bearing, r)
            self.correct(3 + 2 * self.ids.index(i), bearing, r)

    def add(self, i, bearing, r):
        angle = self.x[2] + bearing
        position = self.x[:2] + r * np.array([np.cos(angle), np.sin(angle)])
        self.x = np.append(self.x, position)
        P, n = np.eye(len(self.x)) * 1e4, len(self.P)
        P[:n, :n] = self.P
        self.P = P
        self.ids.append(i)

    def correct(self, k, bearing, r):
        dx, dy = self.x[k : k + 2] - self.x[:2]
        distance = np.hypot(dx, dy)
        H = np.zeros((2, len(self.x)))
        H[0, [0, 1, 2, k, k + 1]] = *np.array([dy, -dx]) / distance**2, -1, 0, 0
        H[1, [0, 1]] = -dx / distance, -dy / distance
        H[:, k : k + 2] = -H[:, :2]
        nu = np.array([bearing - np.arctan2(dy, dx) + self.x[2], r - distance])
        nu[0] = (nu[0] + np.pi) % (2 * np.pi) - np.pi
        S = H @ self.P @ H.T + self.Q
        K = self.P @ H.T @ np.linalg.inv(S)
        self.x = self.x + K @ nu
        self.P = self.P - K @ H @ self.P

    def belief(self):
        return {"pose": self.x[:3], "covariance": self.P, "landmarks": self.ids}


class PlainForSlamgym(Plain):
    """The same after one round of findings."""

    def reset(self, pose, pose_std):
        self.start(pose, pose_std)

    def predict(self, odometry, dt=1.0):
        R, self.R = self.R, self.R * dt
        super().predict(odometry)
        self.R = R

    def update(self, measurements, landmark_ids):
        super().update(measurements, landmark_ids)
        return UpdateReport()

    def belief(self):
        return Belief(self.x[:, None], self.P, self.ids)

    def state_dict(self):
        return {"x": self.x.copy()}


def test_a_plain_filter_learns_in_one_round_all_that_it_needs():
    with pytest.raises(EstimatorContractError) as caught:
        check_estimator(Plain)
    required = [f.message for f in caught.value.findings if f.level == "required"]
    assert required == [
        "Plain has no method reset(pose, pose_std)",
        "Plain has predict(odometry) in place of predict(odometry, dt)",
        "belief() must return a Belief(mean, covariance, landmark_ids), got dict",
        "update() must return an UpdateReport, got NoneType; UpdateReport() will do if "
        "the estimator computes no NIS",
    ]
    message = str(caught.value)
    assert message.startswith("Plain cannot run in slamgym:\n- Plain has no method")
    assert "\nRecommended, but not needed to run:\n- " in message
    assert "belief()                              returns Belief(mean" in message
    findings = check_estimator(PlainForSlamgym)
    assert {finding.level for finding in findings} == {"recommended"}


def test_a_class_with_another_constructor_learns_what_its_methods_lack():
    class Other(Plain):
        def __init__(self, Q, R):
            pass

    with pytest.raises(EstimatorContractError) as caught:
        check_estimator(Other)
    constructor, reset, predict = caught.value.findings
    assert "raised TypeError" in constructor.message
    assert reset.message == "Other has no method reset(pose, pose_std)"
    assert predict.message.startswith("Other has predict(odometry) in place of")
    with pytest.raises(EstimatorContractError, match="Other cannot run in slamgym"):
        check_estimator(partial(Other, Q=1))


@pytest.mark.parametrize("kind", [list, tuple, np.array, dict.fromkeys])
def test_landmark_ids_may_come_in_any_sequence(kind):
    class Mine(PlainForSlamgym):
        def belief(self):
            return Belief(self.x, self.P, kind(self.ids))

    assert {finding.level for finding in check_estimator(Mine)} == {"recommended"}


CALLS = {
    "__init__": r"Stumbles\(motion_std=\(0.05, 0.02, 0.02\), .* raised ",
    "reset": r"reset\(\[0.0, 0.0, 0.0\], \[0.0, 0.0, 0.0\]\) raised ",
    "predict": r"predict\(\[0.3, 0.1\], 1.0\) raised ",
    "update": r"update\(\[\[0.24, 4.12\], .*\], \[0, 1, 2, 3\]\) raised ",
    "belief": r"belief\(\) raised ",
    "state_dict": r"state_dict\(\) raised ",
    "load_state_dict": r"load_state_dict\(state\) raised ",
}


@pytest.mark.parametrize("error", [TypeError, KeyError, np.linalg.LinAlgError])
@pytest.mark.parametrize("method", CALLS)
def test_an_exception_is_one_finding_with_call_and_line(method, error):
    def stumble(self, *arguments, **keywords):
        raise error("oops")  # here

    class Stumbles(PlainForSlamgym):
        pass

    setattr(Stumbles, method, stumble)
    found = [each for each in find_breaches(Stumbles) if "oops" in each.message]
    assert len(found) == 1
    assert re.match(CALLS[method] + error.__name__, found[0].message)
    line = stumble.__code__.co_firstlineno + 1
    place = f'(test_check_estimator.py, line {line}: raise error("oops")  # here)'
    assert found[0].message.endswith(place)
    is_required = "state_dict" not in method
    assert found[0].level == ("required" if is_required else "recommended")


def test_the_line_of_an_error_inside_a_library_is_that_of_the_caller():
    class Mine(PlainForSlamgym):
        def belief(self):
            return Belief(self.x, self.P, [1, 2, 3, 4, 5, 6])

    message = str(find_breaches(Mine)[0])
    assert message.startswith("required: belief() raised ValueError: a belief with 6")
    assert message.endswith("return Belief(self.x, self.P, [1, 2, 3, 4, 5, 6]))")


@pytest.mark.parametrize(
    ("parts", "complaint"),
    [
        ({"nis": np.eye(1)}, r"nis must be a finite float, got \[\[1"),
        ({"nis": np.nan}, r"nis must be a finite float, got nan"),
        ({"degrees_of_freedom": 2.5}, "must be a finite int, got 2.5"),
        ({"associated_ids": None}, r"associated_ids must be a tuple of .*, got None"),
        ({"added_ids": (7,)}, r"added_ids must be a tuple of given ids, got \(7,\)"),
        ({"skipped_ids": (7,)}, r"skipped_ids must be a tuple of given ids, got \(7"),
        ({"added_ids": ([],)}, r"check_reports\(\) cannot use .* unhashable"),
    ],
)
def test_a_report_that_no_run_can_use_is_a_finding(parts, complaint):
    class Mine(PlainForSlamgym):
        def update(self, measurements, landmark_ids):
            super().update(measurements, landmark_ids)
            return UpdateReport(**parts)

    assert re.search(complaint, find_breaches(Mine, ("required",))[0].message)


def test_a_belief_that_is_not_finite_is_a_finding():
    class Mine(PlainForSlamgym):
        def belief(self):
            return Belief(self.x, self.P * np.nan, self.ids)

    messages = [finding.message for finding in find_breaches(Mine, ("required",))]
    assert messages[0].startswith("belief() must be finite, got the mean [0.3,")


@pytest.mark.parametrize(
    "wrap",
    [
        lambda angle: angle,
        lambda angle: np.where(angle > np.pi, angle - 2 * np.pi, angle),
        lambda angle: np.where(angle < -np.pi, angle + 2 * np.pi, angle),
    ],
    ids=["not at all", "only above pi", "only below -pi"],
)
def test_a_filter_that_forgets_to_wrap_the_innovation_is_named(monkeypatch, wrap):
    textbook = textbook_module()
    assert check_estimator(textbook.CarefulEkf) == ()
    monkeypatch.setattr(textbook, "wrap_angle", wrap)
    complaint = r"innovation of the bearing is not wrapped to \[-π, π\): mean\[\d\]"
    with pytest.raises(EstimatorContractError, match=complaint):
        check_estimator(textbook.CarefulEkf)


def test_the_example_can_be_managed(monkeypatch):
    """Its own state is edited; an EKF with methods for this has the same beliefs."""
    monkeypatch.setitem(sys.modules, "textbook", textbook_module())
    noise = {"motion_std": (0.02, 0.02, 0.01), "measurement_std": (0.03, 0.05)}
    own, shipped = (
        make_estimator(name, management=True, **noise)
        for name in ("textbook:CarefulEkf", "ekf")
    )
    landmarks = np.array([(4.0, 1.0), (2.0, -3.0), (-1.0, 4.0)])
    rng, pose = np.random.default_rng(0), np.zeros(3)
    for _ in range(12):
        scan = predict_measurement(pose, landmarks).measurement
        scan += rng.standard_normal((3, 2)) * noise["measurement_std"]
        for slam in (own, shipped):
            slam.update(scan)
            slam.predict((0.3, 0.2))
        pose = predict_pose(pose, np.array([0.3, 0.2])).pose
    for slam in (own, shipped):
        assert len(slam.belief().landmark_ids) == 3
        one, other, last = slam.belief().landmark_ids
        slam.remove([last])
        slam.merge(one, other)
    assert own.belief().landmark_ids == shipped.belief().landmark_ids == (one,)
    assert_close_beliefs(own.belief(), shipped.belief())


#: Lines of the example after which a statement is added, by the method they are in.
PLACES = {
    "u": "d, alpha = np.asarray(odometry, dtype=float)",
    "c": "c, s = np.cos(self.x[2]), np.sin(self.x[2])",
    "F": "F[:2, :2] = (c, -s), (s, c)",
    "P": "self.P = G @ self.P @ G.T + F @ self.R @ F.T * dt",
    "m": "known = tuple(i for i in scan if i in self.ids)",
    "k": "at, pair = 3 + 2 * self.ids.index(i), slice(2 * k, 2 * k + 2)",
    "H": "H[pair, at : at + 2] = (-dy / r**2, dx / r**2), (dx / r, dy / r)",
    "z": "nu[pair] = scan[i] - (np.arctan2(dy, dx) - self.x[2], r)",
    "ν": "nu[::2] = wrap_angle(nu[::2])",
    "S": "S = H @ self.P @ H.T + np.kron(np.eye(len(known)), self.Q)",
    "K": "K = np.linalg.solve(S, H @ self.P).T",
    "D": "K = np.linalg.solve(S, H @ self.P).T",  # and P − K H P in place of P − K S Kᵀ
    "+": "self.x, self.P = self.x + K @ nu, self.P - K @ S @ K.T",
    "l": "c, s = np.cos(self.x[2] + beta), np.sin(self.x[2] + beta)",
    "J": "J[-2:, :3] = (1, 0, -r * s), (0, 1, r * c)",
    "B": "B[-2:] = (-r * s, c), (r * c, s)",
    "n": "self.ids.append(landmark)",
    "a": "self._add(i, *scan[i])",
    "e": "nis = float(nu @ np.linalg.solve(S, nu))",
    "R": "self.R = np.diag(np.square(motion_std))",
    "Q": "self.Q = np.diag(np.square(measurement_std))",
    "b": '"""Return a snapshot: a Belief copies its arguments."""',
}
METHODS = {
    **dict.fromkeys("ucFPRb", "predict()"), **dict.fromkeys("mkHzνSKD+Q", "update()"),
    **dict.fromkeys("lJBnae", "update() of new landmarks"),
}  # fmt: skip
SHORT = {
    "A": "A = np.eye(len(K)) - K @ H; ",
    "E": "is an elementwise product (*), which must be a matrix product (@)",
    "N": "N = F @ self.R @ F.T * dt; ",
    "Q": "np.kron(np.eye(len(known)), self.Q)",
    "first": "and must drive d along the old heading, then turn",
    "T": "t = self.x[2] + alpha; ",
    "box": "B = np.kron(np.eye(50), np.ones((2, 2)))[1:, 1:][: len(P), : len(P)]; "
    "B[:3, :3] = 1; ",
    "twice": "(I − K H) is multiplied twice, or (I − K H) P (I − K H)ᵀ lacks K Q Kᵀ",
    "o": "o = np.sqrt(np.outer(*[self.P.diagonal()] * 2)) + 1e-300; ",
}
#: The place, the cause that is named, and the statement; P is the covariance before.
MISTAKES = """
u | the odometry is lost, as if d = α = 0 | d = alpha = 0.0
P | the mean does not move | self.x[:3] -= d * c, d * s, alpha
F | the covariance is not predicted | G, dt = np.eye(len(G)), 0.0
u | it drives forward where d < 0 | d = abs(d)
u | it does not drive where d < 0 | d = max(d, 0.0)
u | d has the wrong sign | d = -d
u | the turn α has the wrong sign | alpha = -alpha
u | it turns left where α < 0 | alpha = abs(alpha)
u | the turn α is not added | alpha = 0.0
u | the odometry is multiplied by dt | d, alpha = d * dt, alpha * dt
u | d and α are exchanged | d, alpha = alpha, d
c | it drives along θ + α/2, {first} | t = self.x[2] + alpha / 2; c, s = np.cos(t), np.sin(t)
c | it turns before it moves, {first} | {T}c, s = np.cos(t), np.sin(t)
c | the sine of the heading has the wrong sign | s = -s
c | sine and cosine of the heading are exchanged | c, s = s, c
F | ∂x'/∂θ has the wrong sign | G[0, 2] *= -1
F | ∂y'/∂θ has the wrong sign | G[1, 2] *= -1
F | ∂x'/∂θ and ∂y'/∂θ are missing | G = np.eye(len(G))
F | ∂x'/∂θ and ∂y'/∂θ have the wrong sign | G = 2 * np.eye(len(G)) - G
F | G is transposed, P' = Gᵀ P G | G = G.T
F | the Jacobian G is that of the new heading | {T}G[:2, 2] = -d * np.sin(t), d * np.cos(t)
P | Gᵀ is missing, P' = G P | {N}self.P = G @ P + N
P | G P Gᵀ {E} | {N}self.P = G * P * G.T + N
P | G P Gᵀ {E} | {N}self.P = G @ P * G.T + N
P | G P Gᵀ {E} | {N}self.P = (G * P) @ G.T + N
P | G P Gᵀ {E} | {N}self.P[:3, :3] = (G * P * G.T + N)[:3, :3]
P | G P Gᵀ {E} | {N}self.P[:3, :3] = (G[:3, :3] @ P[:3, :3] * G[:3, :3].T + N[:3, :3])
P | G P Gᵀ {E} | {N}self.P[:3, :3] = ((G * P)[:3, :3] @ G[:3, :3].T + N[:3, :3])
P | F R Fᵀ {E} | self.P = G @ P @ G.T; self.P[:3, :3] += dt * F[:3] * self.R * F[:3].T
P | F R Fᵀ {E} | self.P = G @ P @ G.T; self.P[:3, :3] += dt * (F[:3] @ self.R) * F[:3].T
P | F R Fᵀ {E} | self.P = G @ P @ G.T; self.P[:3, :3] += dt * (F[:3] * self.R) @ F[:3].T
F | F is transposed, the motion noise is rotated by −θ | F[:3] = F[:3].T
F | ∂x'/∂εy has the wrong sign | F[0, 1] *= -1
F | ∂y'/∂εy is missing | F[1, 1] = 0
F | the motion noise is not rotated by the heading | F = np.eye(len(G), 3)
F | the motion noise is rotated by the new heading | {T}C, Z = np.cos(t), np.sin(t); F[:2, :2] = (C, -Z), (Z, C)
F | the variance of the motion noise is not multiplied by dt | dt = 1.0
F | the variance of the motion noise is multiplied by dt² | dt = dt**2
F | the variance of the motion noise is multiplied by √dt | dt = dt**0.5
F | the variance of the motion noise is divided by dt | dt = 1 / dt
F | the motion noise is multiplied by |d| | dt *= abs(d)
F | the motion noise is multiplied by d² | dt *= d**2
F | the motion noise is missing where d = 0 | dt *= d != 0
F | the motion noise is missing | dt = 0.0
F | the variance of the motion noise is multiplied by 0.5 | dt /= 2
F | the variance of the motion noise in εy is multiplied by 0.25 | F[:, 1] /= 2
R | standard deviations of the motion noise are used as variances | self.R **= 0.5
R | standard deviations of the motion noise are in another order | self.R = self.R[::-1, ::-1]
P | the covariance of pose and landmarks is not multiplied by G | self.P[:3, 3:], self.P[3:, :3] = P[:3, 3:], P[3:, :3]
P | the covariance is multiplied by 1.05 | self.P *= 1.05
P | 2e-06 is added to every variance | self.P += 2e-6 * np.eye(len(P))
P | the covariance of pose and landmarks is set to zero | self.P[:3, 3:] = 0; self.P[3:, :3] = 0
P | the covariance of different landmarks is set to zero | {box}B[:3] = B[:, :3] = 1; self.P *= B
P | all covariances of pose and landmarks with each other are set to zero | {box}self.P *= B
P | only the variances are kept, all covariances are set to zero | self.P = np.diag(self.P.diagonal())
P | correlations are rounded to 0 decimals | {o}self.P = (self.P / o).round(0) * o
b | correlations are rounded to 1 decimals | {o}self.P = (self.P / o).round(1) * o
P | the covariance is rounded to 2 decimals | self.P = self.P.round(2)
P | the covariance is rounded to 5 decimals | self.P = self.P.round(5)
P | the covariance is rounded to 6 decimals | self.P = self.P.round(6)
P | the mean is rounded to 0 decimals | self.x = self.x.round(0)
P | the mean is rounded to 2 decimals | self.x = self.x.round(2)
P | the mean is rounded to 3 decimals | self.x = self.x.round(3)
n | the position of the robot is not added | self.x[-2:] -= self.x[:2]
l | the heading is not added to the bearing | c, s = np.cos(beta), np.sin(beta)
l | the heading is subtracted from the bearing | t = beta - self.x[2]; c, s = np.cos(t), np.sin(t)
l | the bearing has the wrong sign | t = self.x[2] - beta; c, s = np.cos(t), np.sin(t)
l | bearing and range are exchanged | t = self.x[2] + r; r = beta; c, s = np.cos(t), np.sin(t)
l | sine and cosine are exchanged | c, s = s, c
n | all covariances with the pose and other landmarks are missing | self.P[-2:, :-2] = 0; self.P[:-2, -2:] = 0
e | the covariance with the pose is missing | self.P[len(P) :, :3] = 0; self.P[:3, len(P) :] = 0
n | the covariance of two new landmarks is missing | self.P[-2:, 3:-2] = 0; self.P[3:-2, -2:] = 0
n | new landmarks get the fixed variance 7, and no covariance | self.P[-2:] = 0; self.P[:, -2:] = 0; self.P[-2:, -2:] = 7 * np.eye(2)
J | the uncertainty of the pose is left out | J[-2:, :3] = 0
J | the uncertainty of the heading is left out | J[-2:, 2] = 0
J | the uncertainty of the position is left out | J[-2:, :2] = 0
J | ∂lx/∂θ has the wrong sign | J[-2, 2] *= -1
J | ∂ly/∂y is missing | J[-1, 1] = 0
B | ∂lx/∂r has the wrong sign | B[-2, 1] *= -1
B | ∂ly/∂β is missing | B[-1, 0] = 0
B | ∂l/∂z is transposed | B[-2:] = B[-2:].T
B | ∂l/∂z is not multiplied by the range | B[:, 0] /= r
B | ∂l/∂z is missing, P_ll = J P Jᵀ + Q | B[-2:] = np.eye(2)
B | ∂l/∂z is missing, P_ll = J P Jᵀ + diag(σr², σβ²) | B[-2:] = np.eye(2)[::-1]
B | the sensor noise is missing | B[:] = 0
B | the variance of the sensor noise is multiplied by 2 | B *= 2**0.5
B | the variance of the sensor noise in r is multiplied by 4 | B[:, 1] *= 2
a | every reading is used twice | self.update([scan[i]], [i])
+ | the call changes nothing | self.x, self.P = self.x - K @ nu, P
+ | the covariance is not updated | self.P = P
+ | the mean is not updated | self.x = self.x - K @ nu
z | arctan in place of arctan2 | nu[2 * k] += np.arctan2(dy, dx) - np.arctan(dy / dx)
z | the arguments of arctan2 are exchanged | nu[2 * k] += np.arctan2(dy, dx) - np.arctan2(dx, dy)
z | the heading is not subtracted from the expected bearing | nu[2 * k] -= self.x[2]
z | the heading is added to the expected bearing | nu[2 * k] -= 2 * self.x[2]
ν | the innovation has the wrong sign | nu = -nu
ν | the innovation of the bearing is not used | nu[::2] = 0
ν | the innovation of the range is not used | nu[1::2] = 0
m | only the first reading of a scan is used | known = known[:1]
m | only the last reading of a scan is used | known = known[-1:]
m | the first reading of a scan is not used | known = known[1:]
m | the last reading of a scan is not used | known = known[:-1]
k | readings are assigned in the order of the map, and not by landmark_ids | at = sorted(3 + 2 * self.ids.index(j) for j in known)[k]
S | every reading is used twice | S -= {Q} / 2
S | the covariance of pose and landmarks is not used | self.P = self.P.copy(); self.P[:3, 3:] = 0; self.P[3:, :3] = 0; S = H @ self.P @ H.T + {Q}
H | ∂β/∂θ has the wrong sign | H[2 * k, 2] = 1
H | ∂β/∂θ is missing | H[2 * k, 2] = 0
H | ∂r/∂ly has the wrong sign | H[2 * k + 1, at + 1] *= -1
Q | standard deviations of the sensor noise are in another order | self.Q = self.Q[::-1, ::-1]
Q | variances of the sensor noise are squared again | self.Q **= 2
Q | the variance of the sensor noise is multiplied by 3 | self.Q *= 3
K | the gain of the pose is missing | K[:3] = 0
K | the gain of the heading is missing | K[2] = 0
K | the gain of the landmarks is missing | K[3:] = 0
K | landmarks that are not in the scan are not corrected | K[3:] *= H[:, 3:].any(axis=0)[:, None]
K | only the diagonal of S is inverted | K = P @ H.T / S.diagonal()
K | the gain is that of half the sensor noise | K = np.linalg.solve(S - {Q} / 2, H @ P).T
K | the gain is that of twice the sensor noise | K = np.linalg.solve(S + {Q}, H @ P).T
K | the gain is that of no sensor noise | K = np.linalg.solve(S - {Q}, H @ P).T
D | the gain of the pose is missing | K[:3] = 0
D | the gain of the heading is missing | K[2] = 0
D | the gain of the landmarks is missing | K[3:] = 0
D | only the diagonal of S is inverted | K = P @ H.T / S.diagonal()
D | the gain is that of twice the sensor noise | K = np.linalg.solve(S + {Q}, H @ P).T
D | the gain is that of no sensor noise | K = np.linalg.solve(S - {Q}, H @ P).T
+ | {twice} | {A}self.P = A @ A @ P
+ | P' lacks (I − K H) P = P − K H P: it is P − K H | self.P = P - K @ H
+ | (I − K H) P {E} | {A}self.P = A * P
+ | K S Kᵀ is added, and must be subtracted | self.P = P + K @ S @ K.T
+ | P' = P − K Kᵀ lacks S | self.P = P - K @ K.T
+ | {twice} | {A}self.P = A @ P @ A.T
+ | only the variances of pose and landmarks are updated | self.P[:3, 3:], self.P[3:, :3] = P[:3, 3:], P[3:, :3]
""".strip().splitlines()  # noqa: E501


def textbook_module(*edits):
    """Import the example with statements added after some of its lines."""
    source = TEXTBOOK.read_text(encoding="utf-8")
    kept = [("G, F = np.eye(len(self.x)), np.eye(len(self.x), 3)", "P = self.P")]
    for line, statement in [*kept, (PLACES["S"], "P = self.P"), *edits]:
        assert source.count(line) == 1
        source = source.replace(line, f"{line}; {statement}")
    module = ModuleType("textbook")
    exec(compile(source, TEXTBOOK, "exec"), module.__dict__)
    return module


@pytest.mark.parametrize("mistake", MISTAKES)
def test_a_mistake_is_named_with_its_method(mistake):
    place, cause, statement = mistake.format(**SHORT).split(" | ")
    more = [(PLACES["+"], "self.P = P - K @ H @ P")] if place == "D" else []
    textbook = textbook_module((PLACES[place], statement), *more)
    findings = find_breaches(textbook.TextbookEkf, ("correct",))
    start = f"{METHODS[place]}: {cause}: "
    assert any(each.message.startswith(start) for each in findings), findings
    if place in "zν":
        others = [each for each in findings if "of new landmarks: " in each.message]
        assert not others


@pytest.mark.parametrize(
    ("place", "statement", "text"),
    [
        ("F", "G[0, 2] *= -1",
            "covariance[0, 1], of x and y, must be 3.15e-06, got 5.24e-06"),
        ("u", "self.n = getattr(self, 'n', 0) + 1; d *= self.n % 8 > 0",
            "mean[0], x, must be 4.15658, got 3.50634 (in steps 8, 16 of 20)"),
        ("+", "self.P[0, 1] *= 1.001",
            "belief(): the covariance is not symmetric: so it is in step 1"),
        *(("b", f"{SHORT['o']}self.P = (self.P / o).round({k}) * o",
            f"belief(): correlations are rounded to {k} decimals: so they are in step ")
            for k in (2, 3, 4)),
        ("ν", "nu = -nu", " (in steps 2, 4, 5, 6, 8, … of 20)"),
        ("e", "nis *= 2", "update().nis must be νᵀ S⁻¹ ν = "),
    ],
)  # fmt: skip
def test_a_finding_names_steps_and_the_entry_that_is_farthest_off(
    place, statement, text
):
    textbook = textbook_module((PLACES[place], statement))
    findings = find_breaches(textbook.TextbookEkf, ("correct",))
    assert any(text in each.message for each in findings), findings


def test_a_mistake_is_named_although_a_later_call_fails():
    class LosesNoiseAndFails(EkfSlam):
        calls = 0

        def predict(self, odometry, dt=1.0):
            super().predict(odometry, 0.0)
            self.calls += 1
            if self.calls == 15:
                raise RuntimeError("the fifteenth call")

    messages = [each.message for each in find_breaches(LosesNoiseAndFails, ["correct"])]
    assert any("the motion noise is missing" in each for each in messages)
    assert any("the fifteenth call" in each for each in messages)


def test_the_readings_of_a_wrong_filter_are_not_called_unwrapped():
    textbook = textbook_module(
        (PLACES["z"], "nu[2 * k] += np.arctan2(dy, dx) - np.arctan(dy / dx)")
    )
    messages = [str(each) for each in find_breaches(textbook.TextbookEkf, ("correct",))]
    assert len(messages) == 1
    assert "wrap" not in messages[0]


def test_every_frequent_mistake_differs_from_the_equations():
    seen = {}
    for made in _drive(lambda settings: EkfSlam(**settings)):
        call = made.call
        method = type(call).__name__
        for text, guess in call.mistakes():
            differs = not call.right().agrees(guess)
            seen[method, text] = seen.get((method, text), False) or differs
    same = {text for (_, text), differs in seen.items() if not differs}
    zeros = ("∂x'/∂y", "∂y'/∂x", "∂θ'/∂x", "∂θ'/∂y", "∂x'/∂εα", "∂y'/∂εα", "∂θ'/∂εx")
    zeros += ("∂θ'/∂εy", "∂lx/∂y", "∂ly/∂x", "∂r/∂θ")
    assert {text for text in same if not text.startswith(zeros)} == {
        "∂θ'/∂εα has the wrong sign"
    }


def test_the_contract_of_an_estimator_is_checked_by_its_name():
    assert check_estimator("invariant[iterations=3]") == ()
    with pytest.raises(EstimatorContractError, match=r"unexpected .* 'iterations'"):
        check_estimator("ekf[iterations=3]")
    with pytest.raises(ValueError, match="unknown estimator 'invarant'"):
        check_estimator("invarant")


def test_unknown_estimator_is_refused_with_a_suggestion():
    with pytest.raises(ValueError, match="unknown estimator 'efk'; did you mean 'ekf'"):
        make_estimator("efk", **NOISE)
    for name in (None, 3, ""):
        with pytest.raises(ValueError, match=f"must be like ekf or .* got '{name}'"):
            make_estimator(name, **NOISE)


def test_an_estimator_is_found_by_its_import_path():
    slam = make_estimator("slamgym.estimator:EkfSlam", **NOISE)
    assert isinstance(slam, EkfSlam)
    with pytest.raises(ValueError, match=r"cannot import estimator 'no\.such:Filter'"):
        make_estimator("no.such:Filter", **NOISE)


def test_a_module_that_fails_at_its_import_is_named(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(tmp_path)
    for text, error in (
        ("Mine = no_such_name", "NameError: name 'no_such_name' is not defined"),
        ("import nowhere", "ModuleNotFoundError: No module named 'nowhere'"),
    ):
        (tmp_path / "fails_at_import.py").write_text(text)
        with pytest.raises(ValueError, match=f"'fails_at_import:Mine', {error}$"):
            make_estimator("fails_at_import:Mine", **NOISE)


@pytest.mark.usefixtures("own_registry")
def test_a_registered_estimator_is_made_by_name():
    class Mine(EkfSlam):
        pass

    register_estimator("mine_for_this_test", Mine)
    assert isinstance(make_estimator("mine_for_this_test", **NOISE), Mine)
    with pytest.raises(TypeError, match="factory must be callable"):
        register_estimator("nothing", 3)
    for name in ("", "mine[x]", "mine,yours", " mine", None):
        with pytest.raises(ValueError, match="without brackets, commas"):
            register_estimator(name, Mine)
