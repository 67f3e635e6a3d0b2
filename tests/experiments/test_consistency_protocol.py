"""``slamgym benchmark``: the fixed protocol, with few runs."""

import json

import numpy as np
import pytest
from commands import slamgym

from slamgym.experiments import consistency_protocol as protocol
from slamgym.experiments.monte_carlo_study import monte_carlo, summarise_monte_carlo


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


@pytest.mark.slow
def test_written_scores_are_verified(small):
    assert slamgym("benchmark", "-e", "ekf,invariant", "--out", small).exit_code == 0
    found = json.loads(small.read_text())
    assert found["scores"].keys() == found["microseconds"].keys()
    row = found["worlds"]["anchored"]["invariant"]
    results = monte_carlo("anchored", "invariant", 3, protocol.SEED)
    mean = float(results.pose_nees_invariant[..., 1:].mean()) / 3
    assert row["pose"] == pytest.approx(mean)
    result = slamgym("benchmark", "--verify", small)
    assert (result.exit_code, result.stdout[:9]) == (0, "Same bits")


def test_a_world_is_measured_by_the_summary_of_its_runs():
    found = protocol.run_world("unknown_heading", "ekf,invariant", 2)
    results = monte_carlo("unknown_heading", "ekf,invariant", 2, 1_000_000)
    for label, entry in summarise_monte_carlo(results)["estimators"].items():
        nees = results.sel(estimator=label).pose_nees_invariant[:, 1:].mean() / 3
        assert found[label] == {
            "digest": protocol.digest(results.sel(estimator=label)),
            "verdict": entry["verdict"],
            "pose": pytest.approx(float(nees)),
            "map": entry["nees_end"]["relative_map"],
            "efficiency": entry["efficiency"]["pose"]["value"],
            "failed_runs": [],
        }


def test_the_protocol_runs_five_worlds_and_times_a_step(monkeypatch):
    made, told, clock = [], [], iter([1.0, 4.0, 10.0, 12.0])

    def run_world(*asked):
        made.append(asked)
        row = {"pose": len(made), "map": 1 / len(made), "efficiency": None}
        return {"ekf": row, "invariant": row | {"map": None, "efficiency": 0.5}}

    def filter_runs(settings, runs, threads):
        made.append((settings.estimator, len(runs.true_poses), threads))

    monkeypatch.setattr(protocol, "run_world", run_world)
    monkeypatch.setattr(protocol, "filter_runs", filter_runs)
    monkeypatch.setattr(protocol.time, "process_time", lambda: next(clock))
    found = protocol.score_filters("ekf,invariant", 7, lambda *n: told.append(n))
    names = ["anchored", "six_landmarks", "unknown_heading", "corridor", "loop"]
    assert made[:5] == [(name, "ekf,invariant", 7) for name in names]
    assert made[5:] == [("ekf", 5, 1)] * 2 + [("invariant", 5, 1)] * 2
    assert told == [(done, 5) for done in range(6)]
    assert list(found["worlds"]) == names
    far = pytest.approx(np.log([1, 2, 3, 4, 5]).mean())
    assert found["scores"] == {
        "ekf": {"pose": far, "map": far, "efficiency": None},
        "invariant": {"pose": far, "map": None, "efficiency": 0.5},
    }
    times = {"ekf": 3e6 / (5 * 1005), "invariant": 2e6 / (5 * 1005)}
    assert found["microseconds"] == pytest.approx(times)
    kept = {key: found[key] for key in ("protocol", "estimators", "runs", "seed")}
    assert list(kept.values()) == ["consistency-1", "ekf,invariant", 7, 1_000_000]


FOUND = {
    "scores": {"ekf": {"pose": 0.51234, "map": None, "efficiency": 0.25}},
    "microseconds": {"ekf": 12.345},
}


def test_the_command_prints_and_writes_scores(here, monkeypatch):
    monkeypatch.setattr(protocol, "score_filters", lambda names, progress: FOUND)
    lines = slamgym("benchmark", "-e", "ekf", "--out", "new.json").stdout.splitlines()
    heading, row, *_, last = (line.split() for line in lines)
    assert heading == ["filter", "pose", "map", "efficiency", "µs", "a", "step"]
    assert row == ["ekf", "0.512", "–", "0.25", "12.3"]
    assert last == ["Wrote", "new.json"]
    assert json.loads((here / "new.json").read_text()) == FOUND
    assert json.loads(slamgym("benchmark", "--json").stdout) == FOUND
    monkeypatch.setattr(protocol, "score_filters", None)
    for out, message in (
        ("new.json", "a new .json file, got new.json, which exists"),
        ("new.txt", "a new .json file, got new.txt"),
        ("none/new.json", "--out: the folder of none/new.json does not exist"),
    ):
        result = slamgym("benchmark", "--out", out)
        assert (result.exit_code, result.stderr.strip()[-len(message) :]) == (
            2,
            message,
        )
    assert "did you mean 'ekf'" in slamgym("benchmark", "-e", "ekv").stderr


ROWS = {"ekf": {"digest": "1"}, "invariant": {"digest": "2"}}
STORED = {
    **{"protocol": protocol.PROTOCOL, "seed": protocol.SEED, "runs": 3},
    **{"estimators": "ekf,invariant", "worlds": dict.fromkeys(protocol.VERIFIED, ROWS)},
}


@pytest.mark.parametrize(
    ("ours", "changed"),
    [
        (ROWS, []),
        (ROWS | {"ekf": {"digest": "2"}}, ["ekf in six_landmarks"]),
        ({"ekf": {"digest": "1"}}, ["invariant in six_landmarks"]),
    ],
)
def test_other_bits_are_named_with_their_filter_and_world(
    ours, changed, here, monkeypatch
):
    worlds = {"anchored": ROWS, "six_landmarks": ours}
    monkeypatch.setattr(
        protocol,
        "run_world",
        lambda name, *asked: asked == ("ekf,invariant", 3) and worlds[name],
    )
    told = []
    assert protocol.differences(STORED, lambda *n: told.append(n)) == changed
    assert told == [(0, 2), (1, 2), (2, 2)]
    (here / "scores.json").write_text(json.dumps(STORED))
    result = slamgym("benchmark", "--verify", "scores.json")
    text = f"Other bits: {changed[0]}" if changed else "Same bits"
    assert result.stdout == f"{text} in anchored and six_landmarks: ekf,invariant\n"
    assert result.exit_code == bool(changed)
    result = slamgym("benchmark", "--verify", "scores.json", "--json")
    assert json.loads(result.stdout) == {"same": not changed, "changed": changed}


def test_a_file_to_verify_names_known_filters(here):
    (here / "scores.json").write_text(json.dumps(STORED | {"estimators": "ekv"}))
    result = slamgym("benchmark", "--verify", "scores.json")
    assert "did you mean 'ekf'" in result.stderr


WRONG = [
    *({"protocol": "consistency-2"}, {"seed": 0}, {"estimators": 3}, {"runs": 3.0}),
    *({"runs": 0}, {"runs": 101}, {"worlds": {"anchored": ROWS}}),
    {"worlds": {name: {"ekf": {}} for name in protocol.VERIFIED}},
]
OTHER_FILES = ["", "[]", "{}", *(json.dumps(STORED | wrong) for wrong in WRONG)]


@pytest.mark.parametrize("text", OTHER_FILES)
def test_another_file_is_refused_in_one_sentence(text, tmp_path):
    path = tmp_path / "other.json"
    path.write_text(text)
    result = slamgym("benchmark", "--verify", path)
    expected = f"{path} must be a file that slamgym benchmark --out has written"
    assert result.exit_code == 2
    assert expected in " ".join(result.stderr.split())
