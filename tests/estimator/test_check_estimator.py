import importlib.util
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from slamgym.estimator import (
    Belief,
    EkfSlam,
    EstimatorContractError,
    SlamEstimator,
    check_estimator,
    list_estimators,
    make_estimator,
    register_estimator,
)

TEXTBOOK = Path(__file__).parents[2] / "examples" / "05_your_own_estimator.py"
NOISE = {"motion_std": (0.1, 0.1, 0.1), "measurement_std": (0.1, 0.1)}


@pytest.mark.parametrize("name", list_estimators())
def test_every_registered_estimator_keeps_the_contract(name):
    check_estimator(lambda **settings: make_estimator(name, **settings))
    assert isinstance(make_estimator(name, **NOISE), SlamEstimator)


class LacksUpdate(EkfSlam):
    update = None


class TurnsBeforeItDrives(EkfSlam):
    def predict(self, odometry, dt=1.0):
        d, turn = odometry
        super().predict((0.0, turn), dt)
        super().predict((d, 0.0), 0.0)


class AnswersWithLiveArrays(EkfSlam):
    def belief(self):
        belief = super().belief()
        if not hasattr(self, "_live"):
            self._live = belief
        object.__setattr__(self._live, "mean", belief.mean)
        object.__setattr__(self._live, "covariance", belief.covariance)
        object.__setattr__(self._live, "landmark_ids", belief.landmark_ids)
        return self._live


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
        self.map.arrays = self.map.arrays._replace(mean=state["own"])

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
        (LacksUpdate, r"LacksUpdate has no method update\(\)"),
        (LacksMuch, r"reset\(\); predict\(odometry\) in place of .*belief\(\)"),
        (StartsTooCertain, r"0\.09\]\], got \[\[0\.0, 0\.0, 0\.0\]"),
        (TurnsBeforeItDrives, "drive d along the old heading"),
        (AnswersWithLiveArrays, "snapshot"),
        (AcceptsNan, r"predict\(\(nan, 0\)\) must raise a ValueError"),
        (ForgetsItsMap, "bit for bit"),
        (IgnoresBearings, "must be mapped where it is"),
        (Overconfident, "must fit its covariance"),
        (NeverGrowsCertain, "a second reading of a landmark must shrink"),
        (AddsNoNoise, "noise"),
        (KeepsItsMapOnReset, "reset"),
        (ReturnsNothing, "must return an UpdateReport, got NoneType"),
        (SavesLiveArrays, r"state_dict\(\) must return copies"),
        (SavesALiveReference, r"state_dict\(\) must return copies"),
        (LoadsTheMeanItself, r"load_state_dict\(\) must copy"),
        (SavesADictionary, r"after numpy\.savez, got ValueError: Object arrays"),
        (RaisesAtNan, r"a NaN must raise a ValueError, got RuntimeError: this cannot"),
        (lambda: None, "the factory must accept the keywords"),
    ],
)
def test_a_breach_of_the_contract_is_named(estimator, complaint):
    with pytest.raises(EstimatorContractError, match=complaint):
        check_estimator(estimator)


@pytest.mark.parametrize(
    ("wrap", "bearings"),
    [
        (lambda angle: angle, "3.13 and -3.13"),
        (lambda angle: np.where(angle > np.pi, angle - 2 * np.pi, angle), "3.13 and"),
        (lambda angle: np.where(angle < -np.pi, angle + 2 * np.pi, angle), "-3.13 and"),
    ],
    ids=["not at all", "only above pi", "only below -pi"],
)
def test_a_filter_that_forgets_to_wrap_the_innovation_is_named(
    monkeypatch, wrap, bearings
):
    spec = importlib.util.spec_from_file_location("textbook", TEXTBOOK)
    textbook = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(textbook)
    check_estimator(textbook.TextbookEkf)
    monkeypatch.setattr(textbook, "wrap_angle", wrap)
    complaint = rf"bearings {bearings}.* wrap the innovation to .* NIS 4\.9e\+04"
    with pytest.raises(EstimatorContractError, match=complaint):
        check_estimator(textbook.TextbookEkf)


def test_unknown_estimator_is_refused_with_a_suggestion():
    with pytest.raises(ValueError, match="unknown estimator 'efk'; did you mean 'ekf'"):
        make_estimator("efk", **NOISE)


def test_an_estimator_is_found_by_its_import_path():
    slam = make_estimator("slamgym.estimator:EkfSlam", **NOISE)
    assert isinstance(slam, EkfSlam)
    with pytest.raises(ValueError, match=r"cannot import estimator 'no\.such:Filter'"):
        make_estimator("no.such:Filter", **NOISE)


def test_a_class_that_cannot_run_is_refused_when_it_is_imported(monkeypatch):
    monkeypatch.setitem(sys.modules, "of_a_user", SimpleNamespace(Mine=LacksMuch))
    complaint = r"'of_a_user:Mine' has predict\(odometry\) in place of.*check_estimator"
    with pytest.raises(ValueError, match=complaint):
        make_estimator("of_a_user:Mine", **NOISE)


def test_a_registered_estimator_is_made_by_name():
    class Mine(EkfSlam):
        pass

    register_estimator("mine_for_this_test", Mine)
    try:
        assert isinstance(make_estimator("mine_for_this_test", **NOISE), Mine)
    finally:
        from slamgym.estimator import registry

        del registry._factories["mine_for_this_test"]
    with pytest.raises(TypeError, match="factory must be callable"):
        register_estimator("nothing", 3)
