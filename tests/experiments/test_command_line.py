import csv
import json
import os
import re
import shlex
import subprocess
import sys
import warnings
from io import StringIO

import numpy as np
import pytest
from commands import slamgym
from matplotlib.figure import Figure
from PIL import Image
from rich.console import Console
from typer.main import get_command
from typer.testing import CliRunner

from slamgym.envs import LandmarkWorldEnv
from slamgym.experiments import figures
from slamgym.experiments.command_line import commands, run_files, tables
from slamgym.experiments.command_line.app import main
from slamgym.experiments.job_folders import MANIFEST
from slamgym.experiments.logs import read_log
from slamgym.experiments.noise_study import NoiseEffect
from slamgym.experiments.run_and_replay.filter_settings import (
    estimator_choices,
    settings_for,
)
from slamgym.experiments.run_and_replay.log_replay import replay
from slamgym.jit import jit
from slamgym.sim_configs import list_presets, load_scenario
from slamgym.sim_configs.scenario import Gps, Randomise, SensorTable
from slamgym.suggestions import imported

pytestmark = pytest.mark.usefixtures("here")
COMMANDS = "run replay smooth fit-noise generate judge monte-carlo noise-study render"
COMMANDS = (*COMMANDS.split(), "benchmark", "scenarios", "estimators")
LOG = """# format: slamlog 1
# name: little
# motion_std: 0.1,0.1,0.05
# measurement_std: 0.02,0.1
landmark,7,5,0
measurement,0,7,0.01,5.1
odometry,1,1,0,1
measurement,1,7,-0.01,4.1
measurement,1,9,1.0,3.0
"""


@pytest.fixture
def log(here):
    path = here / "little.csv"
    path.write_text(LOG)
    return path


@pytest.fixture
def without_pictures(monkeypatch):
    def leave_a_mark(folder, trace, **_):
        (folder / "map.png").write_text("a picture")

    monkeypatch.setattr(run_files, "write_figures", leave_a_mark)


@pytest.fixture
def without_figure(monkeypatch):
    """Draw no figure of a noise study, where only its rows count."""
    for name in ("noise_study_figure", "map_figure"):
        monkeypatch.setattr(figures, name, lambda _: Figure())
    monkeypatch.setattr(figures, "save_figure", lambda _, path, **__: path.touch())


def printed(*arguments):
    """What a command prints for people; it must succeed."""
    result = slamgym(*arguments)
    assert result.exit_code == 0, result.stderr
    return result.stdout


def answered(*arguments):
    """The one object a command prints for programs; it must succeed."""
    text = printed(*arguments, "--json")
    assert text.count("\n") == 1
    return json.loads(text)


def refused(*arguments, code=2):
    """The one line of an error; nothing may be left behind."""
    before = sorted(os.walk("."))
    result = slamgym(*arguments)
    assert result.exit_code == code
    assert result.stdout == ""
    assert result.stderr.count("\n") == 1
    assert sorted(os.walk(".")) == before
    return result.stderr.removeprefix("slamgym: ").strip()


@pytest.fixture(scope="module")
def finished_run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("run")
    summary = answered(
        "run", "six_landmarks", "--seed", 2, "--steps", 2, "--out", folder / "out"
    )
    return folder / "out", summary


@pytest.mark.slow
def test_a_run_writes_pictures_log_scenario_and_numbers(finished_run):
    folder, summary = finished_run
    steps = [f"map_steps/step_{k:03d}.png" for k in range(3)]
    names = ["covariance.png", "errors.png", "map.png", "truth.png", *steps]
    for name in names:
        with Image.open(folder / name) as picture:
            assert min(picture.size) > 300
    texts = ["belief.npz", "log.csv", "run.html", "scenario.toml", "summary.json"]
    texts += ["covariance_final.csv", "covariance_first.csv"]
    found = [p.relative_to(folder).as_posix() for p in folder.rglob("*.*")]
    assert summary["files"] == sorted(names + texts)
    assert sorted(found) == sorted([MANIFEST, *summary["files"]])
    world = load_scenario("six_landmarks").with_changes(steps=2)
    assert load_scenario(folder / "scenario.toml") == world


def test_a_simulated_log_is_not_searched_for_broken_conventions(
    here, without_pictures, monkeypatch
):
    searched = []
    monkeypatch.setattr(run_files, "mistake_in", lambda log, _: searched.append(log))
    summary = answered("run", "six_landmarks", "--steps", 2, "--out", "out")
    assert summary["mistake"] is None
    assert not searched
    answered("replay", "out/log.csv", "--out", "again")
    assert searched


def test_a_run_without_identities_prints_and_saves_its_scores(here, without_pictures):
    world = ("hidden_identities", "--steps", 30, "--estimator", "invariant")
    drive = (*world, "--option", 'management={association="joint"}', "--out", "out")
    text = printed("run", *drive, "--resolution", 0.5)
    summary = json.loads((here / "out/summary.json").read_text())
    scores = summary["association"]
    assert scores["resolution"] == 0.5
    assert f"{scores['correct']} correct, {scores['wrong']} wrong" in text
    assert "GOSPA of the map" in text
    again = answered("replay", "out/log.csv", *drive[3:7], "--out", "again")
    assert again["association"]["correct"] > 0.9 * scores["correct"]


def test_every_score_of_an_association_has_its_place():
    names = "correct wrong missed clutter_used new_correct duplicate ghost map_size"
    scores = {name: 10 + k for k, name in enumerate(names.split())}
    scores |= {"true_map_size": 18, "precision": 0.9, "recall": 0.8}
    of = {"distance": 1.5, "missed_count": 3, "false_count": 2, "localisation": 0.25}
    gospa = {"raw": of, "aligned": of | {"distance": 1.2}, "cutoff": 1.0}
    scores |= {"oracle_errors": 0.0123, "resolution": 0.5, "gospa": gospa}
    table = tables.association_table(scores)
    assert table.title == "Association, landmarks nearer than 0.5 m counted as one"
    assert cells(table) == [
        "readings | 10 correct, 11 wrong, 12 not used, 13 of clutter used",
        "new landmarks | 14 correct, 15 duplicates, 16 of clutter",
        "map size | 17; 18 were seen often enough",
        "precision | 0.900, recall 0.800",
        "at best | a filter that knew pose and map would assign 1.2% wrongly",
        "GOSPA of the map | 1.2 m: 3 missed, 2 false, localisation 0.5 m after "
        "alignment",
        "… raw | 1.5 m: 3 missed, 2 false, localisation 0.5 m; cut-off 1 m",
    ]


def cells(table):
    """Return the rows of a table, joined to texts."""
    columns = (list(column.cells) for column in table.columns)
    return [" | ".join(map(str, row)) for row in zip(*columns, strict=True)]


def test_every_key_figure_of_a_run_has_its_place():
    counts = dict.fromkeys(tables._FATES, 0) | {"rejected": 3, "ambiguous": 4}
    error = {"raw": 0.5, "aligned": 0.25}
    summary = {
        **{"readings": counts | {"associated": 7, "added": 2}, "landmarks": [None] * 2},
        **{"steps": 9, "scans": 8, "map_changes": {"confirmed": 1, "removed": 0}},
        **{"pose": (1.0, None, 0.5), "pose_covariance": np.diag([4.0, 1.0, 0.25])},
        **{"ate": error, "landmark_rmse": None, "never_placed": [*range(3, 15)]},
        "nees": {"per_degree": 2.5, "frame": "invariant", "singular": 1},
        "nis": {"per_degree": 0.4},
    }
    summary["map_changes"]["merged"] = 5
    rows = [
        "steps | 9, with 8 scans",
        "readings | 7 of known landmarks, 2 of new ones, 3 rejected by the gate, "
        "4 ambiguous",
        "map | 2 landmarks, 1 confirmed, 5 merged",
        "never placed | 12 landmarks: 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, …",
        "final pose | x 1.000 ± 2.000 m, y - ± 1.000 m, θ 0.500 ± 0.500 rad",
        "path error | 0.5 m RMS; 0.25 m after alignment",
        "pose NEES, invariant | 2.5 per degree of freedom; 1 is expected; 1 pose "
        "without it, whose covariance is singular: overconfident",
        "NIS | 0.4 per degree of freedom; 1 is expected: the filter assumes too much "
        "noise",
    ]
    assert cells(tables.key_figures(summary)) == rows
    for key, hidden in (("others", rows[5]), ("mistake", None)):
        found = cells(tables.key_figures(summary | {key: [1]}))
        changed = [row for row in rows if row not in found]
        assert changed == ([hidden] if hidden else rows[6:])
    assert len(found) == len(rows)


def test_the_table_of_a_study_has_a_row_for_each_change_and_a_column_for_each_filter():
    figures = {"nees_per_degree": 1.234, "nees_per_degree_error": 0.1, "failed": 0}
    others = dict.fromkeys(NoiseEffect._fields, 0.0)
    effects = [
        NoiseEffect(
            **others | figures | {"changed": place, "sigma": sigma, "factor": factor}
        )._replace(estimator=name, failed=failed, nees_per_degree_error=error)
        for place, sigma, factor in (("nothing", "none", 1.0), ("both", "σx", 0.1))
        for name, failed, error in (("ekf", 0, np.nan), ("invariant", 2, 0.1))
    ]
    assert cells(tables.effects_table("loop", 3, effects)) == [
        "nothing |  | 1.23 | 1.23 ± 0.1 (2 failed)",
        "both | σx ÷ 10 | 1.23 | 1.23 ± 0.1 (2 failed)",
    ]


def test_a_replay_writes_the_covariance_of_the_whole_state(log, without_pictures):
    answer = answered("replay", log, "--out", "out")
    drive = read_log(log)
    run = replay(drive, settings_for(drive).make(drive.start))
    with np.load("out/belief.npz") as saved:
        np.testing.assert_array_equal(saved["covariance"], run.belief.covariance)
        np.testing.assert_array_equal(saved["mean"], run.belief.mean)
        assert saved["mean"][:3].tolist() == pytest.approx(answer["pose"])
        assert saved["landmark_ids"].tolist() == [7, 9]
        assert len(saved["pose_covariances"]) == len(saved["t"]) == answer["steps"] + 1
    for count, is_written in ((20, True), (21, False)):
        scan = [f"measurement,2,{i},0.1,9\n" for i in range(count)]
        log.write_text(LOG.replace(",7,", ",0,").replace(",9,", ",1,") + "".join(scan))
        files = answered("replay", log, "--out", "text")["files"]
        assert ("covariance_final.csv" in files) == is_written


def test_a_log_can_be_replayed_without_its_identities(log, without_pictures):
    rows = [f"odometry,{t},0,0,1\nmeasurement,{t},7,-0.01,4.1\n" for t in range(2, 9)]
    log.write_text(LOG + "".join(rows))
    assert answered("replay", log)["association"] is None
    scores = answered("replay", log, "--hide-identities", "--out", "hidden")
    assert scores["settings"]["options"]["management"] is True
    assert scores["association"]["map_size"] == 1
    assert scores["association"]["true_map_size"] == 1
    assert ",,-0.01,4.1,,7" in (log.parent / "hidden/log.csv").read_text()


GRAPH = """EDGE2 0 1 1 0 0 50 0 0 50 0 100
LANDMARK 1 7 3 4 10 0 10
EDGE2 1 2 1 0 0 50 0 0 50 0 100
LANDMARK 2 7 2 4 10 0 10
EDGE2 0 2 2 0 0 50 0 0 50 0 100
"""
GRAPH_NOISE = ("--motion-std", ".02,.02,.01", "--measurement-std", ".02,.1")


def test_a_graph_is_replayed_against_the_truth_of_another_file(here, without_pictures):
    (here / "graph.txt").write_text(GRAPH)
    (here / "true.g2o").write_text("".join(f"VERTEX2 {k} {k} 0.5 0\n" for k in "012"))
    result = slamgym("replay", "graph.txt", *GRAPH_NOISE, "--truth", "true.g2o")
    assert "note: left out of the log: 1 loop closures between poses\n" in result.stderr
    summary = json.loads((here / "results/graph-invariant/summary.json").read_text())
    assert summary["ate"]["raw"] == pytest.approx(0, abs=1e-9)
    assert summary["pose"] == pytest.approx([2, 0.5, 0], abs=1e-9)
    result = slamgym("replay", "graph.txt", "--noise-from-file")
    assert "note: noise from the file, by its information matrices\n" in result.stderr
    settings = json.loads((here / "results/graph-invariant/summary.json").read_text())
    assert settings["settings"]["motion_std"] == pytest.approx((0.02, 0.02, 0.01))
    assert settings["settings"]["measurement_std"] == pytest.approx((0, 0.1))
    assert settings["settings"]["options"]["bearing_std_metres"] == pytest.approx(0.1)
    message = refused("replay", "graph.txt", *GRAPH_NOISE, "--truth", "nowhere.g2o")
    assert message == "cannot read the log nowhere.g2o: No such file or directory"


@pytest.mark.slow
def test_the_log_of_a_run_replays_to_the_same_numbers(finished_run, without_pictures):
    folder, summary = finished_run
    again = answered("replay", folder / "log.csv", "--out", "again")
    for key in ("landmarks", "pose", "pose_covariance", "nis", "nees", "ate"):
        assert again[key] == summary[key]


def test_a_replay_of_a_run_does_not_replace_it(here, without_pictures):
    answered("run", "six_landmarks", "--steps", 2)
    place = here / "results/six_landmarks-invariant"
    before = (place / "summary.json").read_text()
    for log in (place, place.with_name("replay-six_landmarks-invariant")):
        assert "scenario.toml" not in answered("replay", log / "log.csv")["files"]
        assert (place / "summary.json").read_text() == before
        assert (place / "scenario.toml").exists()


def test_a_replay_prints_every_landmark_with_both_distances(log, without_pictures):
    lines = printed("replay", log).splitlines()
    rows = [line.split() for line in lines if line.strip().startswith(("7 ", "9 "))]
    path = log.parent / "results/little-invariant/summary.json"
    seven = json.loads(path.read_text())["landmarks"][0]
    forms = {"x": ".4f", "y": ".4f", "euclidean": ".4g", "mahalanobis": ".4g"}
    assert rows[0] == ["7", *(format(seven[key], form) for key, form in forms.items())]
    assert rows[1][3:] == ["-", "-"]
    assert "Wrote results/little-invariant/" in lines


def test_the_course_log_is_replayed_with_its_published_noise(
    public_logs, without_pictures
):
    data = public_logs / "raw" / "cmu16833" / "data.txt"
    full = answered("replay", data, "-e", "ekf")["landmarks"]
    independent = answered("replay", data, "-e", "ekf[landmark_init=independent]")
    assert full[0]["euclidean"] == pytest.approx(0.0042047, abs=1e-6)
    first = independent["landmarks"][0]
    assert first["euclidean"] == pytest.approx(0.0024197, abs=1e-6)
    assert first["mahalanobis"] == pytest.approx(0.05452, abs=1e-5)


@pytest.mark.parametrize("flag", ["--every-step", "--no-every-step"])
def test_every_map_is_kept_where_every_step_is_drawn(log, flag, monkeypatch):
    histories = []
    monkeypatch.setattr(
        run_files,
        "write_figures",
        lambda folder, trace, **_: histories.append(trace.landmark_history),
    )
    rows = "".join(f"odometry,{t},0.1,0,1\n" for t in range(2, 602))
    log.write_text(LOG + rows)
    answered("replay", log, flag)
    distinct = {id(landmarks.means) for landmarks in histories[0]}
    assert len(histories[0]) == 602
    assert (len(distinct) == 602) == (flag == "--every-step")


@pytest.mark.parametrize(("steps", "are_drawn"), [(60, True), (61, False)])
def test_each_of_few_steps_is_drawn_by_default(log, steps, are_drawn, monkeypatch):
    told = []
    monkeypatch.setattr(
        run_files, "write_figures", lambda *_, every_step, **__: told.append(every_step)
    )
    log.write_text(
        LOG + "".join(f"odometry,{t},0.1,0,1\n" for t in range(2, steps + 1))
    )
    answered("replay", log)
    assert told == [are_drawn]


def test_a_random_controller_wanders_the_same_way_for_the_same_seed(without_pictures):
    options = ("run", "loop", "--steps", 5, "--controller", "random")
    assert answered(*options)["pose"] == answered(*options)["pose"]
    assert answered(*options)["pose"] != answered(*options, "--seed", 1)["pose"]


def test_several_filters_share_a_page_and_a_table(log, without_pictures):
    names = "ekf,invariant[gate_probability=0.9]"
    text = printed("replay", log, "-e", names, "--out", "both")
    summary = json.loads((log.parent / "both/summary.json").read_text())
    assert summary["estimator"] == "ekf"
    (other,) = summary["others"]
    for estimate in (summary, other):
        assert f" {estimate['landmark_rmse']['raw']:.3g} " in text
    assert other["estimator"] == "invariant[gate_probability=0.9]"
    assert other["settings"]["options"]["gate_probability"] == 0.9
    page = (log.parent / "both/run.html").read_text()
    assert "<title>little: ekf, invariant[gate_probability=0.9]" in page
    alone = answered("replay", log, "-e", "ekf")
    assert alone["out"].endswith("little-ekf")
    assert alone["pose"] == summary["pose"]
    assert alone["others"] == []


@pytest.mark.slow
def test_several_filters_are_compared_in_a_picture_with_the_walls(monkeypatch):
    drawn = {}

    def keep(figure, path, **_):
        drawn[path.name] = figure

    monkeypatch.setattr(figures, "save_figure", keep)
    answered("run", "corridor", "--steps", 5, "--no-every-step", "-e", "ekf,invariant")
    shown = [axes.get_title(loc="left") for axes in drawn["comparison.png"].axes]
    assert shown == ["ekf", "invariant"]
    for name in ("map.png", "truth.png", "comparison.png"):
        labels = [artist.get_label() for artist in drawn[name].axes[0].collections]
        assert "wall" in labels, name


def test_a_recording_for_rerun_is_checked_before_the_work(log, monkeypatch):
    message = refused("replay", log, "--rerun", "out.bin")
    assert message == "--rerun must end in .rrd, got out.bin"
    message = refused("replay", log, "--rerun", "nowhere/out.rrd")
    assert "the folder of nowhere/out.rrd does not exist" in message
    monkeypatch.setitem(sys.modules, "rerun", None)
    message = refused("replay", log, "--rerun", "out.rrd", code=1)
    assert "pip install 'slamgym[viewer]'" in message


PLAIN = """
import numpy as np
from slamgym.estimator import Belief, EkfSlam, UpdateReport

class Broken:
    def __init__(self, motion_std, measurement_std, initial_pose, initial_pose_std):
        self.pose = initial_pose

    def predict(self, odometry):
        return self.speed

    def update(self, measurements, landmark_ids):
        return None

    def belief(self):
        return {"pose": self.pose}

class Plain:
    def __init__(self, ekf=EkfSlam, **settings):
        self.ekf = ekf(**settings)

    def reset(self, pose, pose_std):
        self.ekf.reset(pose, pose_std)

    def predict(self, odometry, dt=1.0):
        self.ekf.predict(odometry, dt)

    def update(self, measurements, landmark_ids):
        self.ekf.update(measurements, landmark_ids)
        return UpdateReport()

    def belief(self):
        belief = self.ekf.belief()
        ids = list(belief.landmark_ids)
        return Belief(belief.mean[:, None], belief.covariance, ids)
"""


@pytest.fixture
def of_a_user(here, monkeypatch):
    (here / "of_a_user.py").write_text(PLAIN)
    monkeypatch.syspath_prepend(here)
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    yield "of_a_user:Plain"
    sys.modules.pop("of_a_user", None)


def test_modules_of_the_user_are_looked_for_only_if_named(here, of_a_user, monkeypatch):
    monkeypatch.setattr(sys, "path", [each for each in sys.path if each != os.getcwd()])
    assert slamgym("estimators").exit_code == 0
    assert os.getcwd() not in sys.path  # a script gtsam.py is not taken for the library
    (here / "slamgym_of_a_user.py").write_text("NUMBER = 3\n")
    assert imported("slamgym_of_a_user:NUMBER", "") == 3
    assert imported(of_a_user, "").__name__ == "Plain"


@pytest.mark.parametrize(
    "command",
    [
        ("run", "six_landmarks"),
        ("replay", "little.csv"),
        ("monte-carlo", "six_landmarks"),
        ("noise-study", "six_landmarks"),
        ("render", "six_landmarks", "--out", "film.mp4"),
        ("generate", "six_landmarks", "--episodes", 2),
    ],
    ids=lambda command: command[0],
)
def test_a_filter_of_the_user_that_cannot_run_is_refused_with_all_that_it_lacks(
    log, of_a_user, command
):
    before = sorted(os.walk("."))
    option = "--estimator" if command[0] != "monte-carlo" else "--estimators"
    result = slamgym(*command, option, "of_a_user:Broken")
    assert (result.exit_code, result.stdout) == (2, "")
    assert sorted(os.walk(".")) == before
    first, *breaches = result.stderr.splitlines()[:6]
    assert first == "slamgym: Broken cannot run in slamgym:"
    assert [line.split(",")[0] for line in breaches] == [
        "- Broken has no method reset(pose",
        "- Broken has predict(odometry) in place of predict(odometry",
        "- belief() must return a Belief(mean",
        "- update() must return an UpdateReport",
        "- predict((0.3",
    ]
    expected = "has no attribute 'speed' (of_a_user.py, line 10: return self.speed)"
    assert breaches[-1].endswith(expected)
    if command[0] not in ("monte-carlo", "generate"):  # the others take options
        text = slamgym(*command, option, of_a_user, "--option", "ekf=3").stderr
        assert text.startswith("slamgym: Plain cannot run in slamgym:\n")


@pytest.mark.usefixtures("_no_figures_in_reports", "without_pictures")
def test_a_filter_of_the_user_without_reports_and_saving_runs(log, of_a_user):
    pose = answered("replay", log, "-e", f"{of_a_user},ekf")["others"][0]["pose"]
    assert answered("replay", log, "-e", of_a_user)["pose"] == pose
    assert "the filter reports none" in slamgym("replay", log, "-e", of_a_user).stdout
    world = ("six_landmarks", "--steps", 3)
    summary = answered("monte-carlo", *world, "-e", of_a_user, "--runs", 2)
    message = refused("run", "hidden_identities", "-e", of_a_user)
    assert "needs the method remove, or state_dict() and load" in message
    assert summary["estimators"][of_a_user]["good_runs"] == 2


def test_an_older_output_is_replaced_as_a_whole(log, without_pictures, monkeypatch):
    def other_pictures(folder, trace, **_):
        (folder / "map_steps" / "deep").mkdir(parents=True)
        (folder / "map_steps" / "deep" / "step.png").write_text("an old picture")

    with monkeypatch.context() as patch:
        patch.setattr(run_files, "write_figures", other_pictures)
        first = answered("replay", log, "--out", "out")
    second = answered("replay", log, "--out", "out", "--measurement-std", "1,1")
    assert first["pose_covariance"] != second["pose_covariance"]
    assert "map_steps/deep/step.png" in first["files"]
    assert sorted(os.listdir("out")) == [MANIFEST, *second["files"]]
    assert sorted(os.listdir()) == ["little.csv", "out"]


@pytest.fixture
def no_work(monkeypatch):
    """Let the work of a command fail the test: it must be refused before."""

    def work(*_, **__):
        raise AssertionError("the command began its work")

    monkeypatch.setattr(run_files, "filter_and_write", work)


def test_a_file_that_was_changed_since_is_refused_at_once(log, here, request):
    request.getfixturevalue("without_pictures")
    answered("replay", log, "--out", "out")
    (here / "out" / "map.png").write_text("my picture")  # as long as before
    request.getfixturevalue("no_work")
    message = refused("replay", log, "--out", "out")
    assert message == (
        f"{here / 'out'} holds map.png, which was changed since: "
        "move it away, or choose another --out"
    )
    assert (here / "out" / "map.png").read_text() == "my picture"


def test_a_summary_does_not_decide_what_may_be_removed(log, here, no_work):
    (here / "out").mkdir()
    (here / "out" / "thesis.tex").write_text("years of work")
    files = json.dumps({"files": ["thesis.tex", "summary.json"]})
    (here / "out" / "summary.json").write_text(files)
    assert "which slamgym did not write there" in refused("replay", log, "--out", "out")
    (here / "out" / "summary.json").unlink()
    assert "holds thesis.tex, which slamg" in refused("replay", log, "--out", "out")


@pytest.mark.parametrize("out", [".", "..", "link"])
def test_the_folder_itself_stays(out, log, here, without_pictures, monkeypatch):
    for folder in ("deep/inner", "target"):
        (here / folder).mkdir(parents=True)
    if out == "link":
        (here / "deep" / "inner" / "link").symlink_to(here / "target")
    place = {".": "deep/inner", "..": "deep", "link": "target"}[out]
    before = (here / place).stat().st_ino
    monkeypatch.chdir(here / "deep" / "inner")
    for _ in range(2):
        files = answered("replay", log, "--out", out)["files"]
    assert (here / place).stat().st_ino == before
    there = {name for name in os.listdir(here / place) if name != "inner"}
    assert there == {MANIFEST, *files}
    assert os.path.samefile(".", here / "deep" / "inner")


def test_a_belief_that_degenerates_is_a_failure_and_no_wrong_input(log):
    noise = ("--motion-std", "0,0,0", "--measurement-std", "0,0")
    message = refused("replay", log, *noise, code=1)
    assert message.startswith("little, t = 1: the innovation covariance is not")


@pytest.mark.parametrize(
    ("command", "work"),
    [
        ("replay", "command_line.run_files.replay"),
        ("smooth", "run_and_replay.smooth_log"),
        ("fit-noise", "noise_fitting.fit_noise"),
    ],
)
def test_a_numerical_failure_is_explained_by_the_mistake_of_the_log(
    command, work, log, monkeypatch
):
    def mistake(log, settings):
        return f"{log.name} is clockwise, with σx {settings.motion_std[0]}"

    def fail(*_, **__):
        raise np.linalg.LinAlgError("P is singular")

    experiments = "slamgym.experiments"
    monkeypatch.setattr(f"{experiments}.log_conventions.mistake_in_log", mistake)
    monkeypatch.setattr(f"{experiments}.{work}", fail)
    message = refused(command, log, code=1)
    assert message.endswith("P is singular. little is clockwise, with σx 0.1")


def test_a_folder_with_other_things_is_left_alone(log, without_pictures):
    answered("replay", log, "--out", "out")
    (log.parent / "out" / "notes.txt").write_text("mine")
    message = refused("replay", log, "--out", "out")
    assert "notes.txt, which slamgym did not write there" in message


def test_ctrl_c_leaves_the_older_output_as_it_was(log, without_pictures, monkeypatch):
    answered("replay", log, "--out", "out")

    def interrupt(log, path):
        raise KeyboardInterrupt

    monkeypatch.setattr(run_files, "write_slamlog", interrupt)
    message = refused("replay", log, "--out", "out", code=130)
    assert message == "interrupted; nothing was written"
    message = refused("replay", log, "--out", "deep/down/out", code=130)
    assert message == "interrupted; nothing was written"


@pytest.mark.parametrize(
    ("error", "code"), [(KeyboardInterrupt, 130), (commands.TerminationError, 143)]
)
def test_an_interrupt_before_the_command_begins_is_reported(error, code, monkeypatch):
    def interrupt(*_):
        raise error

    monkeypatch.setattr(commands.OneLineErrors, "parse_args", interrupt)
    assert refused("scenarios", code=code) == "interrupted; nothing was written"


def test_an_error_in_a_clean_up_does_not_hide_the_interrupt(
    log, without_pictures, monkeypatch
):
    def interrupt(log, path):
        try:
            raise KeyboardInterrupt
        finally:
            raise ValueError("the cluster is closed")

    monkeypatch.setattr(run_files, "write_slamlog", interrupt)
    message = refused("replay", log, "--out", "out", code=130)
    assert message == "interrupted; nothing was written"


def test_a_bug_is_one_line_too(log, monkeypatch):
    def stumble(folder, trace, **_):
        raise KeyError("oops")

    monkeypatch.setattr(run_files, "write_figures", stumble)
    message = refused("replay", log, code=1)
    assert message.startswith("internal error: KeyError: 'oops'")


def test_a_bug_of_the_users_filter_is_not_called_internal(of_a_user):
    with open("of_a_user.py", "a") as file:
        file.write("""
class Late(Plain):
    def predict(self, odometry, dt=1.0):
        super().predict(odometry, dt)
        self.steps = getattr(self, "steps", 0) + 1
        if self.steps == 20:
            raise KeyError("oops")
""")
    message = refused("run", "loop", "-e", "of_a_user:Late", code=1)
    assert message.startswith("the estimator failed, loop, t = 20: KeyError: 'oops'")


@pytest.mark.parametrize("out", ["little.csv/out", "little.csv/deep/out"])
def test_a_folder_that_cannot_be_written_is_refused(log, out):
    message = refused("replay", log, "--out", out, code=1)
    expected = f"the folder {log.parent / out} cannot be written: Not a directory"
    assert message == expected


def test_a_log_of_unknown_noise_asks_for_it(log):
    log.write_text(LOG.replace("# motion_std", "# other_std"))
    message = refused("replay", log)
    assert message.startswith(
        "little does not specify its motion_std: give it, for example --motion-std "
        "0.1,0.1,0.05, or estimate it by slamgym fit-noise"
    )
    assert "'other_std' is not read; known keys are motion_std," in message
    log.write_text(LOG.replace("# motion_std", "# licence"))
    assert "known keys" not in refused("replay", log)


@pytest.mark.usefixtures("without_pictures", "without_figure")
def test_the_noise_of_a_log_is_noted_unless_it_is_given(log):
    noise = "note: noise of little: motion_std 0.1"
    assert noise in slamgym("replay", log).stderr.replace("\n", " ")
    for command in ("replay", "smooth", "noise-study"):
        options = "--motion-std", "1,1,1", "--range-std-per-metre", ".02"
        given = slamgym(command, log, *options).stderr
        assert "motion_std" not in given
        assert "range_std_per_metre" not in given
        assert "measurement_std" in given


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ("odometry,1,1,0", "little.csv, line 7: expected odometry,t,d,alpha,dt"),
        ("odometry,1,east,0,1", "line 7: expected a finite number, got 'east'"),
        ("odometry,-1,1,0,1", "line 7: expected t >= 0.0, the time before, got -1.0"),
    ],
)
def test_a_malformed_log_is_refused_with_its_line(log, wrong, message):
    log.write_text(LOG.replace("odometry,1,1,0,1", wrong))
    assert message in refused("replay", log)


OF_A_SCENARIO = "{} is for the noise study of a scenario"
OF_ONE_RUN = "--controller is for the noise study of one run of a scenario"
WRONG_FILTERS = {
    "--motion-std -1,0,0":
        "--motion-std must be 3 numbers >= 0 with commas between, got '-1,0,0'",
    "--measurement-std 1,2,3":
        "--measurement-std must be 2 numbers >= 0 with commas between, got '1,2,3'",
    "--initial-pose-std a,b,c": "--initial-pose-std must be 3 numbers >= 0",
    "--gate-probability 2": "gate_probability must lie between 0 and 1",
    "--landmark-init half": "landmark_init must be 'full' or 'independent'",
    "--estimator ekv": "unknown estimator 'ekv'; did you mean 'ekf'?",
    "--option gate": "--option must be KEY=VALUE, got 'gate'",
    "--option gate=": "--option must be KEY=VALUE, got 'gate='",
    "--option a=1 --option a=2": "--option must name each key once, got a twice",
    "--option gate=1": "has no option 'gate'; did you mean 'gate_prob",
    "-e ekf[iteration=3]": "ekf has no option 'iteration' (there are",
    "-e invariant[iteration=3]": "'iteration'; did you mean 'iterations'?",
    "-e ekf,ekf": "estimators must",
    "-e ,": "estimators must",
    "-e ekf[x": "an estimator must be like ekf or",
    "--every-steps": "No such option: --every-steps",
    "--out little.csv": "--out must be a folder, got the file",
    "--out a\udcff": "--out must be text in UTF-8",
}  # fmt: skip
WRONG_WORLDS = {
    "six_landmark": "got 'six_landmark'; did you mean 'six_landmarks'?",
    "nowhere.toml": "cannot read the scenario 'nowhere.toml'",
    "loop --set sensor.max_rage=4":
        "unknown key 'max_rage' in sensor; did you mean 'max_range'?",
    "loop --set sensor.std=[-1,0.1]": "sensor.std must be 2 ",
    "loop --set motion.std=[0.1,0.1]": "motion.std must be 3 ",
    "loop --set sensor": "--set must be KEY=VALUE, got 'sensor'",
    "loop --steps 1": "steps must be an integer >= 2, got 1",
    "loop --controller waypoint": "did you mean 'waypoints'?",
    "loop --estimator EKF": "'EKF'; did you mean 'ekf'?",
    "loop --seed -1": "Invalid value for '--seed'",
    "loop --motion-std 1,1,1": "; for the world: --set motion.std=[0.1",
    "little.csv": "to filter a log: slamgym replay little.csv",
}  # fmt: skip
WRONG_STUDIES = {
    "lop": "no log and no scenario 'lop'; did you mean 'loop'?",
    "loop --motion-std 1,1,1": "--motion-std is for the noise study of a log",
    "little.csv --set steps=3": OF_A_SCENARIO,
    "little.csv --runs 1": OF_A_SCENARIO,
    "little.csv --seed 0": OF_A_SCENARIO,
    "little.csv --change all": OF_A_SCENARIO,
    "little.csv --jobs 1": OF_A_SCENARIO,
    "little.csv --controller random": OF_ONE_RUN,
    "loop --change world": OF_A_SCENARIO,
    "loop --runs 3 --change filtre": "--change must be one of all, both, wo",
    "loop --runs 3 --controller random": OF_ONE_RUN,
    "loop --noise-at-rest": "of a log; for the world: --set motion.noise_at",
}
WRONG_LOGS = {
    "nowhere.csv": "cannot read the log nowhere.csv: No such file or directory",
    "loop": "; loop is a scenario: slamgym run loop",
    "/dev/zero": "/dev/zero must be a file or a pipe, got a device",
}
WRONG = {
    **{f"replay little.csv {words}": text for words, text in WRONG_FILTERS.items()},
    **{f"run {words}": text for words, text in WRONG_WORLDS.items()},
    **{f"noise-study {words}": text for words, text in WRONG_STUDIES.items()},
    **{f"replay {words}": text for words, text in WRONG_LOGS.items()},
    "generate loop --episodes 0": "Invalid value for '--episodes'",
    "generate loop --episodes 1 --shard 0": "Invalid value for '--shard'",
    "explore loop --runs 1": "Invalid value for '--runs'",
}


@pytest.mark.parametrize("command", WRONG)
def test_a_wrong_command_is_refused(command, log):
    words = command.split()
    option = next((word for word in words if word.startswith("--")), "")
    assert WRONG[command].format(option) in refused(*words)


def test_an_empty_name_of_a_scenario_is_quoted(here):
    assert "or a .toml file, got ''" in refused("run", "")


def test_several_mistakes_of_a_scenario_stand_in_one_line(here):
    (here / "mine.toml").write_text("name = 'mine'\ndt = 0\nsteps = 1\n")
    message = refused("run", "mine.toml")
    assert "mine.toml: dt must be" in message
    assert "; mine.toml: steps must be" in message


@pytest.mark.slow
def test_the_covariances_of_a_run_are_written_with_the_names_of_their_entries(
    finished_run,
):
    folder, _ = finished_run
    with (folder / "covariance_final.csv").open() as stream:
        (_, *entries), *rows = csv.reader(stream)
    with np.load(folder / "belief.npz") as saved:
        names = [f"l{i}{axis}" for i in saved["landmark_ids"] for axis in "xy"]
        assert entries == [row[0] for row in rows] == ["x", "y", "θ", *names]
        values = np.array([row[1:] for row in rows], dtype=float)
        np.testing.assert_array_equal(values, saved["covariance"])
    first = (folder / "covariance_first.csv").read_text().splitlines()
    assert 3 < len(first) <= len(rows) + 1


@pytest.mark.usefixtures("without_figure")
def test_a_noise_study_draws_one_figure_and_tables_eleven_runs(log):
    summary = answered("noise-study", log, "--out", "study")
    sigmas = ("alpha", "beta", "r", "x", "y")
    changed = [f"sigma_{s}_{way}_10" for s in sigmas for way in ("by", "times")]
    maps = [f"maps/{name}.png" for name in (*changed, "unchanged")]
    texts = ["noise_study.csv", "noise_study.png", "summary.json"]
    assert summary["files"] == [*maps, *texts]
    with (log.parent / "study" / "noise_study.csv").open() as stream:
        table = list(csv.DictReader(stream))
    for saved, row in zip(table, summary["rows"], strict=True):
        del row["title"]
        assert saved == {k: "" if v is None else str(v) for k, v in row.items()}


def test_a_film_has_one_frame_per_step_and_one_of_the_start():
    summary = answered("render", "dropout", "--steps", 3, "--out", "film.gif")
    assert summary == {"out": "film.gif", "frames": 4, "fps": 4.0}
    with Image.open("film.gif") as film:
        assert film.n_frames == 4


def test_a_film_shows_the_belief_of_a_replay(without_pictures, monkeypatch):
    shown = []
    monkeypatch.setattr(
        LandmarkWorldEnv, "show_belief", lambda self, belief: shown.append(belief)
    )
    options = ("six_landmarks", "--steps", 3, "--seed", 5)
    printed("render", *options, "--out", "film.gif")
    summary = answered("run", *options)
    assert len(shown) == 4
    assert shown[-1].pose.tolist() == summary["pose"]


def test_a_world_that_hides_identities_is_filmed_with_and_without_a_filter(monkeypatch):
    shown = []
    monkeypatch.setattr(
        LandmarkWorldEnv, "show_belief", lambda self, belief: shown.append(belief)
    )
    film = ("render", "hidden_identities", "--steps", 8, "--out", "film.gif")
    printed(*film)
    assert len(shown[-1].landmarks) > 0
    printed(*film, "-e", "none")
    assert len(shown) == 9


def test_a_film_that_cannot_be_written_is_refused(monkeypatch):
    there = ("render", "dropout", "--steps", 2, "--out", "nowhere/film.gif")
    message = "the folder of nowhere/film.gif does not exist"
    assert refused(*there, code=1) == message
    monkeypatch.setattr(run_files, "warm_up", None)  # before anything compiles
    message = "a film's file must end in .gif or .mp4, got 'film.webm'"
    assert refused("render", "loop", "--out", "film.webm") == message


def test_every_scenario_and_estimator_is_listed():
    worlds = [load_scenario(name) for name in list_presets()]
    assert answered("scenarios")["scenarios"] == [
        {
            **{"name": name, "landmarks": world.landmarks.count},
            **{"steps": world.steps, "description": world.description},
        }
        for name, world in zip(list_presets(), worlds, strict=True)
    ]
    heading, *rows = printed("scenarios").splitlines()
    for name, world in zip(list_presets(), worlds, strict=True):
        (row,) = (row for row in rows if row.startswith(f"{name} "))
        for key, count in (
            ("landmarks", world.landmarks.count),
            ("steps", world.steps),
        ):
            assert row[: heading.index(key) + len(key)].endswith(f" {count}")
    estimators = {row.pop("name"): row for row in answered("estimators")["estimators"]}
    text = "Extended Kalman filter over the robot pose and a growing landmark map."
    ekf = {"library": "slamgym", "installed": True, "description": text}
    assert estimators["ekf"] == ekf
    assert re.search(f"^ekf +slamgym +yes +{text[:20]}", printed("estimators"), re.M)


def test_without_a_command_the_help_is_shown():
    assert printed() == printed("--help")
    assert all(command in printed() for command in COMMANDS)


@pytest.mark.parametrize("name", ["loop", "bicycle", "active_hard"])
def test_a_scenario_is_explained_as_a_file_that_gives_the_same_world(name, tmp_path):
    path = tmp_path / "mine.toml"
    assert slamgym("scenarios", name, "--new", path).exit_code == 0
    assert load_scenario(path) == load_scenario(name)
    assert printed("scenarios", name) == path.read_text()
    assert answered("scenarios", name) == {"scenario": path.read_text()}
    for part in (SensorTable, Gps, Randomise):  # set or not
        for key, field in part.model_fields.items():
            assert re.search(rf"^(# )?{key} =", path.read_text(), re.MULTILINE)
            assert field.description in path.read_text()
    for line in path.read_text().splitlines():
        if re.search("^[^[]* =.*  #", line) and " # one of " not in line:
            assert len(line) < 104
    layout = r'^layout = "\w+"  # one of corridor, grid, points, random, ring, streets$'
    assert re.search(layout, path.read_text(), re.MULTILINE)
    assert "which exists" in slamgym("scenarios", name, "--new", path).output


@pytest.mark.slow
def test_the_program_loads_no_numba_for_its_lists_and_answers_errors_with_one_line():
    program = (
        "import sys\n"
        "from slamgym.experiments.command_line.app import main\n"
        "main(['scenarios', '--json'], standalone_mode=False)\n"
        "heavy = {'numba', 'matplotlib', 'scipy', 'pymunk'} & set(sys.modules)\n"
        "assert not heavy, heavy\n"
        "main()"
    )
    command = [sys.executable, "-c", program, "run", "lop"]
    result = subprocess.run(command, check=False, capture_output=True, text=True)
    assert result.returncode == 2
    assert result.stdout.count("\n") == 1  # the list
    assert result.stderr.count("\n") == 1
    assert "did you mean 'loop'" in result.stderr


def test_a_compilation_is_noted_once_and_nothing_else_is(capsys):
    @jit
    def double(x):
        return 2 * x

    report = commands.Reporter(as_json=True)
    for kinds, note in (((1.0, 1), "compiling the kernel, once"), ((1.0, 1), "")):
        with report.note_if_compiling("the kernel"):
            assert [double(x) for x in kinds] == [2, 2]
        output = capsys.readouterr()
        assert output.out == ""
        assert output.err.startswith(note)
        assert output.err.count("\n") == bool(note)


@pytest.mark.parametrize("estimators", ["invariant", "ekf,invariant[iterations=3]"])
def test_a_run_fits_on_a_screen_whatever_the_map(
    estimators, without_pictures, monkeypatch
):
    monkeypatch.setenv("COLUMNS", "80")
    small = ("--set", "landmarks.count=80", "--set", "sensor.identities=false")
    text = printed("run", "dense", *small, "--steps", 30, "-e", estimators)
    lines = text.splitlines()
    assert len(lines) <= 40
    assert max(map(len, lines[:-1])) <= 80
    shown = 3 if "," in estimators else 5
    assert f"the {shown} largest errors of " in text
    assert lines[-1].startswith("slamgym monte-carlo dense --set=landmarks.count=80 ")


def test_a_run_ends_with_the_command_that_tests_its_filter(without_pictures):
    last = printed("run", "loop", "--steps", 3).splitlines()[-1]
    assert last == "slamgym monte-carlo loop --steps=3 -e ekf,invariant"


def test_the_command_that_tests_a_filter_gives_it_the_options_of_the_run(
    without_pictures,
):
    options = ("--option", "gate_probability=0.9", "--option", "landmark_init=full")
    filters = "ekf[gate_probability=0.8],invariant"
    text = printed("run", "six_landmarks", "--steps", 3, "-e", filters, *options)
    *_, names = shlex.split(text.splitlines()[-1])
    assert [(each.name, each.options) for each in estimator_choices(names)] == [
        ("ekf", {"gate_probability": 0.8, "landmark_init": "full"}),
        ("invariant", {"gate_probability": 0.9, "landmark_init": "full"}),
    ]


def test_the_worst_landmarks_of_a_large_map_are_shown():
    rows = [
        {"id": k, "x": 0.0, "y": 0.0, "euclidean": k % 7, "mahalanobis": None}
        for k in range(12)
    ]
    table = tables.landmark_table({"landmarks": rows})
    assert list(table.columns[0].cells) == ["6", "5", "4", "11", "3"]
    rows[2]["mahalanobis"] = 0.5
    table = tables.landmark_table({"landmarks": rows})
    assert next(iter(table.columns[0].cells)) == "2"
    del rows[10:]
    rows[2] |= {"euclidean": None, "mahalanobis": None}  # its truth is unknown
    few = tables.landmark_table({"landmarks": rows})
    assert list(few.columns[0].cells) == [str(k) for k in range(10)]


@pytest.mark.parametrize("command", COMMANDS)
def test_help_fits_into_80_columns_with_an_example(command, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    text = printed(command, "--help")
    assert "Usage:" in text
    assert max(map(len, text.splitlines())) <= 80
    assert f"slamgym {command} " in text.partition("Examples:")[2] + " "
    assert not re.search("<(str|path|file|dir|int|float)", text)  # words of Python


@pytest.mark.parametrize("command", COMMANDS)
def test_every_option_of_a_command_has_a_help(command):
    parameters = get_command(main).commands[command].params
    assert parameters
    assert not [each.name for each in parameters if not (each.help or "").strip()]


@pytest.mark.slow
def test_python_without_docstrings_prints_the_same_help():
    program = "from slamgym.experiments.command_line.app import main; main()"
    for command in ("run --help", "--help"):
        printed = [
            subprocess.run(
                [sys.executable, *flags, "-c", program, *command.split()],
                capture_output=True,
                check=True,
            ).stdout
            for flags in ([], ["-OO"])
        ]
        assert printed[0] == printed[1]


def test_submaps_may_lie_in_a_folder(here, without_pictures):
    summary = answered(
        *("run", "six_landmarks", "--steps", 4, "--estimator", "submaps"),
        *("--option", "folder=maps", "--out", "out"),
    )
    assert len(summary["landmarks"]) == 6
    assert (here / "maps" / "submaps.txt").exists()


@pytest.mark.parametrize("encoding", ["ascii", "latin-1"])
@pytest.mark.parametrize("form", [(), ("--json",)])
def test_a_command_works_in_any_encoding(encoding, form, log, without_figure):
    command = ["noise-study", str(log), "--out", "study", *form]
    done = CliRunner(charset=encoding).invoke(main, command)
    assert done.exit_code == 0, done.stderr
    if form:
        assert json.loads(done.stdout)["rows"][1]["sigma"] == "σx"
    else:
        assert "?x" in done.stdout


def test_a_log_too_large_for_memory_is_named(log, monkeypatch):
    def fail(*_, **__):
        raise MemoryError

    monkeypatch.setattr("slamgym.experiments.logs.slamlog.Path.read_bytes", fail)
    message = refused("replay", log)
    assert message == f"the log {log} does not fit into memory"


@pytest.mark.parametrize(
    ("error", "code", "message"),
    [
        (MemoryError(), 1, "there is not enough memory"),
        (
            PermissionError(13, "Permission denied", "a.csv"),
            1,
            "a.csv: Permission denied",
        ),
        (ValueError("dt is 0\n  steps is 1"), 2, "dt is 0; steps is 1"),
        (ImportError("pip install rerun"), 1, "pip install rerun"),
        (np.linalg.LinAlgError("P is singular"), 1, "P is singular"),
        (commands.BrokenFilterError("it lacks\n- a"), 2, "it lacks\n- a"),
        (commands.InterruptedRunError("kept"), 130, "kept"),
        (
            *(KeyError("x"), 1),
            "internal error: KeyError: 'x' (SLAMGYM_TRACEBACK=1 shows where)",
        ),
    ],
)
def test_every_error_has_a_message_and_an_exit_code(error, code, message):
    assert commands.message_of(error) == message
    assert commands.exit_code_of(error) == code


@pytest.mark.slow
def test_a_run_whose_association_failed_names_the_command_that_repairs_it(
    here, without_pictures
):
    hidden = ("run", "loop", "--set", "sensor.identities=false", "--steps")
    clutter = ("--set", "sensor.clutter=1", "--set", "sensor.max_clutter=5")
    wrong = ("-e", 'invariant[management={association="nearest"}]', "--seed", 71006)
    shown = slamgym(*hidden, 40, "--out", "good").stdout
    assert "--associate" not in shown
    shown = slamgym(*hidden, 400, *clutter, *wrong, "--out", "a b").stdout
    assert "slamgym smooth 'a b/log.csv' --associate\n" in shown
    words = " ".join(shown.split())
    assert "a filter that knew pose and map would assign 0.3% wrongly" in words
    assert re.search(r"failed: .* readings have a wrong landmark; .* map, 0.3%", words)
    assert slamgym("smooth", "a b/log.csv", "--associate").exit_code == 0
    noise = "--measurement-std=0.0349,0.1", "--option=range_std_per_metre=0.001"
    shown = slamgym("replay", "a b/log.csv", *wrong[:2], *noise, "--out", "c").stdout
    assert f"slamgym smooth c/log.csv --associate {' '.join(noise)}\n" in shown


def test_the_comparison_of_many_filters_cuts_no_number_at_80_columns():
    error, nees = {"raw": 1234.5, "aligned": 0.00123}, {"per_degree": 71600.0}
    row = {"ate": error, "landmark_rmse": error, "nees": nees}
    labels = [f"filter_{k}[gate_probability=0.999,landmark_init=x]" for k in range(11)]
    console = Console(width=80, file=StringIO())
    console.print(tables.comparison_table(dict.fromkeys(labels, row)))
    shown = console.file.getvalue()
    assert "…" not in shown
    assert shown.count("7.16e+04") == 11
    assert shown.count("0.00123") == 22


def test_written_files_are_listed_in_order_before_folders_of_pictures():
    files = ["b/2.png", "z.csv", "b/1.png", "a/1.png", "c.json"]
    shown = tables.written("out", files).plain.replace("\N{NO-BREAK SPACE}", " ")
    assert shown == "Wrote out/\n  c.json, z.csv, a/ (1 pictures), b/ (2 pictures)"


def test_skipped_readings_are_explained():
    counts = dict.fromkeys(("associated", "added", *tables._FATES), 0) | {"skipped": 1}
    text = tables._and_counts("7 of known landmarks", counts, tables._FATES)
    assert text == "7 of known landmarks, 1 with range ≤ 0 or too near"


def test_landmarks_that_were_never_placed_are_named(here, without_pictures):
    shown = slamgym("run", "range", "--steps", 40, "--out", "few").stdout
    summary = json.loads((here / "few/summary.json").read_text())
    placed = {row["id"] for row in summary["landmarks"]}
    scans = read_log("few/log.csv").scans
    never = sorted({i for scan in scans for i in scan.landmark_ids.tolist()} - placed)
    assert never
    assert summary["never_placed"] == never
    text = f"never placed {len(never)} landmarks: {', '.join(map(str, never[:10]))}"
    words = " ".join(shown.split())
    assert text in words
    counts = summary["readings"]
    waiting = sum(len(scan.landmark_ids) for scan in scans)
    waiting -= counts["associated"] + counts["added"]
    assert counts["waiting"] == waiting > 0
    assert f"{waiting} of ones not placed yet" in words


@pytest.mark.parametrize(
    ("line", "code", "message"),
    [
        ("scenarios --json >&-", 1, "slamgym: standard output is closed"),
        ("scenarios nonsense 2>&-", 2, ""),
        ("scenarios nonsense 2>/dev/full", 2, ""),
        ("scenarios <&-", 0, ""),
    ],
)
def test_closed_streams_neither_lose_results_nor_change_the_exit_code(
    line, code, message
):
    program = "from slamgym.experiments.command_line.app import main; main()"
    shell = f"{shlex.quote(sys.executable)} -c {shlex.quote(program)} {line}"
    done = subprocess.run(
        shell, shell=True, check=False, capture_output=True, text=True
    )
    assert (done.returncode, done.stderr[: len(message)]) == (code, message)
    assert bool(done.stdout) == (code == 0)


@pytest.mark.parametrize("command", ["scenarios", "scenarios --json"])
def test_results_for_a_closed_output_are_an_error(command, monkeypatch, capsys):
    monkeypatch.setattr(sys, "stdout", None)
    with pytest.raises(SystemExit, match="1"):
        main(command.split())
    message = "standard output is closed: there is no place for the results"
    assert capsys.readouterr().err == f"slamgym: {message}\n"


def test_an_interrupt_names_the_work_of_the_block_that_it_ends(monkeypatch):
    def interrupt(_):
        with commands.interruptible("the runs are kept"):
            with commands.interruptible("the table is kept"):
                pass
            raise KeyboardInterrupt

    monkeypatch.setattr(commands.Reporter, "finish", lambda *_: interrupt(_))
    assert refused("scenarios", "--json", code=130) == "the runs are kept"


def test_every_warning_is_a_note_also_if_it_comes_again(capsys):
    with commands.Reporter(as_json=True).warnings():
        for _ in range(2):
            warnings.warn("the log has no truth", stacklevel=1)
    assert capsys.readouterr().err == "note: the log has no truth\n" * 2


@pytest.mark.parametrize("place", [".", "rc"])
def test_settings_of_matplotlib_do_not_change_the_pictures_of_a_command(
    place, tmp_path, monkeypatch
):
    (tmp_path / place).mkdir(exist_ok=True)
    (tmp_path / place / "matplotlibrc").write_text("axes.facecolor: black\n")
    monkeypatch.setenv("MATPLOTLIBRC", str(tmp_path / place))
    program = (
        "from slamgym.experiments.command_line import commands, options\n"
        "@commands.command\n"
        "def look() -> None:\n"
        "    'Look.'\n"
        "    import matplotlib\n"
        "    print(matplotlib.rcParams['axes.facecolor'])\n"
        "commands.main(['look'])"
    )
    command = [sys.executable, "-c", program]
    done = subprocess.run(
        command, cwd=tmp_path, check=True, capture_output=True, text=True
    )
    assert done.stdout == "white\n"


def test_a_tilde_after_an_equals_sign_is_the_home_of_the_user(tmp_path, monkeypatch):
    monkeypatch.setenv("HOME", str(tmp_path))
    assert slamgym("generate", "loop", "--episodes=1", "--out=~/drives").exit_code == 0
    assert (tmp_path / "drives" / "manifest.json").exists()
