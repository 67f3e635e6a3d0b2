"""``slamgym benchmark``: the fixed protocol, with few runs."""

import json

import numpy as np
import pytest
from commands import slamgym

from slamgym.experiments import consistency_protocol as protocol
from slamgym.experiments.monte_carlo_study import monte_carlo


@pytest.fixture
def small(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(protocol, "WORLDS", protocol.VERIFIED)
    monkeypatch.setattr(protocol.score_filters, "__defaults__", (3, lambda *_: None))
    return tmp_path / "scores.json"


def test_a_digest_changes_with_one_bit_of_one_number():
    results = monte_carlo("anchored", "ekf", 2).sel(estimator="ekf")
    other = results.copy(deep=True)
    assert protocol.digest(other) == protocol.digest(results)
    other.ate[0] = np.nextafter(other.ate[0], 1.0)
    assert protocol.digest(other) != protocol.digest(results)


def test_a_score_is_the_mean_distance_from_ratio_1():
    worlds = {
        "a": {"ekf": {"pose": 2.0, "map": 1.0, "efficiency": 0.5}},
        "b": {"ekf": {"pose": 0.5, "map": None, "efficiency": 1.0}},
    }
    found = protocol.scores(worlds, "ekf")
    assert found["pose"] == pytest.approx(np.log(2))
    assert found["map"] is None
    assert found["efficiency"] == 0.75


@pytest.mark.slow
def test_scores_are_written_verified_and_refused_with_another_digest(small):
    done = slamgym("benchmark", "-e", "ekf,invariant", "--out", small, "--json")
    found = json.loads(small.read_text())
    assert json.loads(done.stdout) == found
    assert found["scores"].keys() == found["microseconds"].keys()
    row = found["worlds"]["anchored"]["invariant"]
    results = monte_carlo("anchored", "invariant", 3, protocol.SEED)
    assert row["pose"] == pytest.approx(
        float(results.pose_nees_invariant[..., 1:].mean()) / 3
    )
    result = slamgym("benchmark", "--verify", small)
    assert (result.exit_code, result.stdout[:9]) == (0, "Same bits")
    result = slamgym("benchmark", "--out", small)
    assert (result.exit_code, "which exists" in result.stderr) == (2, True)

    row["digest"] = "0"
    small.write_text(json.dumps(found))
    result = slamgym("benchmark", "--verify", small)
    assert result.exit_code == 1
    assert result.stdout.startswith("Other bits: invariant in anchored")


def test_a_folder_that_does_not_exist_is_refused_before_the_runs(tmp_path):
    result = slamgym("benchmark", "--out", tmp_path / "none" / "scores.json")
    assert result.exit_code == 2
    assert "--out: the folder of" in result.stderr


@pytest.mark.parametrize("text", ["", "{}", "[]", '{"protocol": "consistency-1"}'])
def test_another_file_is_refused_in_one_sentence(text, tmp_path):
    path = tmp_path / "other.json"
    path.write_text(text)
    result = slamgym("benchmark", "--verify", path)
    expected = f"{path} must be a file that slamgym benchmark --out has written"
    assert result.exit_code == 2
    assert expected in " ".join(result.stderr.split())
