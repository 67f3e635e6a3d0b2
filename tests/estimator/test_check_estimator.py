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


class TurnsBeforeItDrives(EkfSlam):
    def predict(self, odometry, dt=1.0):
        d, turn = odometry
        super().predict((0.0, turn), dt)
        super().predict((d, 0.0), 0.0)


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


class AcceptsNan(EkfSlam):
    def predict(self, odometry, dt=1.0):
        super().predict(np.nan_to_num(odometry), dt)


class ForgetsItsMap(EkfSlam):
    def state_dict(self):
        fresh = EkfSlam(**NOISE)
        return fresh.state_dict() | {"estimator": "ForgetsItsMap"}


class IgnoresBearings(EkfSlam):
    def update(self, measurements, landmark_ids=None):
        turned = np.array(measurements, dtype=float).reshape(-1, 2)
        turned[:, 0] *= -1
        return super().update(turned, landmark_ids)


class Overconfident(EkfSlam):
    def belief(self):
        belief = super().belief()
        if not belief.landmark_ids:
            return belief
        return Belief(belief.mean, belief.covariance / 400, belief.landmark_ids)


class AddsNoNoise(EkfSlam):
    def predict(self, odometry, dt=1.0):
        super().predict(odometry, 0.0)


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


class CountsItsLandmarks(EkfSlam):
    def belief(self):
        belief = super().belief()
        ids = tuple(range(len(belief.landmark_ids)))
        return Belief(belief.mean, belief.covariance, ids)


class IsSkewed(EkfSlam):
    def belief(self):
        belief = super().belief()
        skew = np.zeros_like(belief.covariance)
        skew[0, 1] = 1e-3
        return Belief(belief.mean, belief.covariance + skew, belief.landmark_ids)


class IsNegative(EkfSlam):
    def belief(self):
        belief = super().belief()
        less = belief.covariance - 0.05 * np.eye(len(belief.mean))
        return Belief(belief.mean, less, belief.landmark_ids)


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


class NeedsAStart(EkfSlam):
    def __init__(self, *, initial_pose, **settings):
        super().__init__(initial_pose=initial_pose, **settings)


class NeedsIds(EkfSlam):
    def update(self, measurements, landmark_ids):
        return super().update(measurements, list(landmark_ids))


class StartsTooCertain(EkfSlam):
    def __init__(self, **settings):
        super().__init__(**{**settings, "initial_pose_std": (0, 0, 0)})


class NeverGrowsCertain(EkfSlam):
    def update(self, measurements, landmark_ids=None):
        n = self.map.size
        before = self.map.covariance[:n, :n].copy()
        report = super().update(measurements, landmark_ids)
        self.map.covariance[:n, :n] = before
        return report


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
        (TurnsBeforeItDrives, "drive d along the old heading"),
        (answers_with_live("mean"), "snapshot"),
        (answers_with_live("covariance"), "snapshot"),
        (answers_with_live("mean", "covariance", "landmark_ids"), "snapshot"),
        (IgnoresBearings, "new landmarks: the bearing has the wrong sign: mean"),
        (Overconfident, "the covariance is multiplied by 0.0025: "),
        (NeverGrowsCertain, r"update\(\): the covariance is not updated: "),
        (AddsNoNoise, "noise"),
        (KeepsItsMapOnReset, r"after reset\(pose, pose_std\) must have no landmarks"),
        (ReturnsNothing, "must return an UpdateReport, got NoneType"),
        (CountsItsLandmarks, r"ids given to update\(\), here 9 and 4, got \(0, 1\)"),
        (IsSkewed, "must be symmetric, got elements that differ by 0.001"),
        (IsNegative, "must be positive semidefinite, got the eigenvalue -0.0"),
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


def textbook_module(old="", new=""):
    """Import the example, with one text of it in place of another."""
    source = TEXTBOOK.read_text(encoding="utf-8")
    assert not old or source.count(old) == 1
    module = ModuleType("textbook")
    code = compile(source.replace(old, new) if old else source, TEXTBOOK, "exec")
    exec(code, module.__dict__)
    return module


INDENT = " " * 8
READ = "d, alpha = np.asarray(odometry, dtype=float)\n" + INDENT
COUNT = "self.n = getattr(self, 'n', 0) + 1\n" + INDENT
MISTAKES = {
    "sign of -d sin in G": ("G[:2, 2] = -d * s, d * c", "G[:2, 2] = d * s, d * c",
        r"predict\(\): ∂x'/∂θ has the wrong sign: covariance\[0, 1\], of x and y, must "
        r"be 3\.15e-06, got 5\.24e-06"),
    "sign of d cos in G": ("G[:2, 2] = -d * s, d * c", "G[:2, 2] = -d * s, -d * c",
        r"predict\(\): ∂y'/∂θ has the wrong sign: covariance\[1, 2\]"),
    "G is the identity": ("G[:2, 2] = -d * s, d * c", "",
        r"predict\(\): ∂x'/∂θ and ∂y'/∂θ are missing: covariance\[1, 1\]"),
    "sign of a sine in F": ("F[:2, :2] = (c, -s), (s, c)",
        "F[:2, :2] = (c, s), (s, c)", r"predict\(\): ∂x'/∂εy has the wrong sign"),
    "noise along the axes of the world": ("F[:2, :2] = (c, -s), (s, c)", "",
        r"predict\(\): the motion noise is not rotated by the heading"),
    "half dt": ("F.T * dt", "F.T * dt / 2",
        r"predict\(\): the variance of the motion noise is multiplied by 0\.5: "
        r"covariance\[\d, \d\]"),
    "dt squared": ("F.T * dt", "F.T * dt**2", "motion noise is multiplied by dt²"),
    "no dt": ("F.T * dt", "F.T", "motion noise is not multiplied by dt"),
    "deviations for variances of the motion": ("np.diag(np.square(motion_std))",
        "np.diag(motion_std)",
        "standard deviations of the motion noise are used as variances"),
    "cross-covariance does not move": (
        "self.P = G @ self.P @ G.T + F @ self.R @ F.T * dt",
        "A, B = G[:3, :3], F[:3]\n"
        "        self.P[:3, :3] = A @ self.P[:3, :3] @ A.T + B @ self.R @ B.T * dt",
        r"predict\(\): the covariance of pose and landmarks is not multiplied by G: "
        r"covariance\[\d, \d\], of .*l\d[xy], must be .*, got"),
    "new landmark without cross-covariance": ("self.ids.append(landmark)",
        "self.ids.append(landmark); self.P[-2:, :-2] = 0; self.P[:-2, -2:] = 0",
        "new landmarks: all covariances with the pose and other landmarks are missing"),
    "new landmark without the pose's covariance": (
        "J[-2:, :3] = (1, 0, -r * s), (0, 1, r * c)", "",
        "new landmarks: the uncertainty of the pose is left out"),
    "new landmarks without each other's covariance": ("self.ids.append(landmark)",
        "self.ids.append(landmark); self.P[-2:, 3:-2] = 0; self.P[3:-2, -2:] = 0",
        "the covariance of two new landmarks is missing"),
    "sign in the Jacobian of a new landmark": ("(1, 0, -r * s), (0, 1, r * c)",
        "(1, 0, r * s), (0, 1, r * c)", "new landmarks: ∂lx/∂θ has the wrong sign"),
    "new landmark without the noise of the reading": (" + B @ self.Q @ B.T", "",
        "new landmarks: the sensor noise is missing"),
    "reading of a new landmark used again": ("self._add(i, *scan[i])\n",
        "self._add(i, *scan[i])\n        if new: self.update(*zip(*[(scan[i], i) for "
        "i in new]))\n", "new landmarks: every reading is used twice"),
    "scan used twice": (
        "S = H @ self.P @ H.T + np.kron(np.eye(len(known)), self.Q)\n",
        "H, nu = np.vstack([H, H]), np.append(nu, nu)\n"
        "        S = H @ self.P @ H.T + np.kron(np.eye(2 * len(known)), self.Q)\n",
        r"update\(\): every reading is used twice: "),
    "sign of the heading in H": ("-dx / r**2, -1)", "-dx / r**2, 1)",
        r"update\(\): ∂β/∂θ has the wrong sign"),
    "no heading in H": ("-dx / r**2, -1)", "-dx / r**2, 0)",
        r"update\(\): ∂β/∂θ is missing"),
    "sign in the landmark's Jacobian": ("(dx / r, dy / r)", "(dx / r, -dy / r)",
        r"update\(\): ∂r/∂ly has the wrong sign"),
    "deviations of the readings swapped": ("np.diag(np.square(measurement_std))",
        "np.diag(np.square(measurement_std)[::-1])",
        "standard deviations of the sensor noise are in another order"),
    "covariance not updated": ("self.P - K @ S @ K.T", "self.P",
        r"update\(\): the covariance is not updated"),
    "map not corrected": ("K = np.linalg.solve(S, H @ self.P).T",
        "K = np.linalg.solve(S, H @ self.P).T; K[3:] = 0",
        r"update\(\): the gain of the landmarks is missing"),
    "innovation against the readings": ("self.x + K @ nu", "self.x - K @ nu",
        r"update\(\): the innovation has the wrong sign: mean\[\d\]"),
    "NIS without the noise": ("nu @ np.linalg.solve(S, nu)",
        "nu @ np.linalg.solve(S / 2, nu)", r"update\(\)\.nis must be νᵀ S⁻¹ ν"),
    "never drives backward": (READ, READ + "d = abs(d)\n" + INDENT,
        r"predict\(\): it drives forward where d < 0: mean\[0\], x, .* \(in steps"),
    "every eighth odometry lost": (READ, READ + COUNT + "if self.n % 8 == 0: return\n"
        + INDENT, r"predict\(\): the call changes nothing: .* \(in steps 8, 16 of 20"),
    "elementwise product": ("G @ self.P @ G.T", "G * self.P * G.T",
        r"predict\(\): G P Gᵀ is an elementwise product"),
    "transposed G": ("G @ self.P @ G.T", "G.T @ self.P @ G", "G is transposed"),
    "noise that grows with the distance": ("F.T * dt", "F.T * dt * abs(d)",
        r"the motion noise is multiplied by \|d\|"),
    "no noise at rest": ("F.T * dt", "F.T * dt * (d != 0)",
        "the motion noise is missing where d = 0"),
    "arctan for arctan2": ("np.arctan2(dy, dx)", "np.arctan(dy / dx)",
        r"update\(\): arctan in place of arctan2: mean\["),
    "landmark mapped without the pose": ("self.x[:2] + np.array", "np.array",
        r"new landmarks: the position of the robot is not added: mean\[3\], l1x"),
    "only the first reading": ("known = tuple(i for i in scan if i in self.ids)",
        "known = tuple(i for i in scan if i in self.ids)[:1]",
        "only the first reading of a scan is used"),
    "covariance downdated twice": ("self.P - K @ S @ K.T",
        "self.P - 2 * K @ S @ K.T + K @ H @ K @ S @ K.T",
        r"\(I − K H\) is multiplied twice"),
    "correlations of one decimal": ("return Belief(self.x, self.P,",
        "o = np.sqrt(np.outer(*[self.P.diagonal()] * 2)) + 1e-300; "
        "self.P = (self.P / o).round(1) * o; return Belief(self.x, self.P,",
        "correlations are rounded to 1 decimals"),
    "inflated covariance": ("F.T * dt", "F.T * dt; self.P *= 1.05",
        "the covariance is multiplied by 1.05"),
}  # fmt: skip


@pytest.mark.parametrize("mistake", MISTAKES)
def test_a_wrong_covariance_is_named_with_the_entry_and_its_value(mistake):
    old, new, complaint = MISTAKES[mistake]
    textbook = textbook_module(old, new)
    findings = find_breaches(textbook.TextbookEkf, ("correct",))
    assert any(re.search(complaint, each.message) for each in findings), findings


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
    textbook = textbook_module("np.arctan2(dy, dx)", "np.arctan(dy / dx)")
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
