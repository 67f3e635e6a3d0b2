"""The recording for rerun, written by the library itself."""

import sys
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest
from matplotlib.colors import to_rgb

from slamgym.estimator import make_estimator
from slamgym.experiments.figures import style
from slamgym.experiments.logs import OdometryRow, Scan, SlamLog
from slamgym.experiments.monte_carlo_study import figures
from slamgym.experiments.run_and_replay import replay
from slamgym.experiments.run_and_replay.summary import pose_nees
from slamgym.experiments.viewers import (
    RunFrames,
    ViewedRun,
    rerun_recording,
    write_rerun,
)
from slamgym.experiments.viewers.rerun_recording import import_rerun

LOG = SlamLog(
    "little",
    landmark_ids=[4, 9],
    landmarks=[(5.0, 0.0), (2.0, 3.0)],
    events=(
        Scan(0, [(0.0, 5.0), (1.0, 3.6)], [4, 9]),
        OdometryRow(1, 1.0, 0.0, 1),
        Scan(1, [(0.01, 4.1), (1.2, 3.2)], [4, 9]),
    ),
    ground_truth=[(0, 0, 0, 0), (1, 1, 0, 0)],
)


def viewed(label="ekf"):
    frames = RunFrames(LOG)
    noise = {"motion_std": (0.1, 0.1, 0.05), "measurement_std": (0.05, 0.1)}
    slam = make_estimator("ekf", **noise)
    return ViewedRun(replay(LOG, slam, name=label, watch=frames.watch).trace, frames)


def values(content, component):
    """The numbers of a component of what was logged."""
    for batch in content.as_component_batches():
        if batch.component_descriptor().component.endswith(f":{component}"):
            return np.array(batch.as_arrow_array().to_pylist())
    raise AssertionError(component)


@pytest.mark.slow
def test_a_recording_holds_the_beliefs_of_every_step(tmp_path, monkeypatch):
    rerun = pytest.importorskip("rerun", reason="rerun-sdk is not installed")
    logged = []
    log = rerun.RecordingStream.log

    def noting(self, place, content, **options):
        logged.append((place, content))
        return log(self, place, content, **options)

    monkeypatch.setattr(rerun.RecordingStream, "log", noting)
    runs = [viewed(), viewed("invariant[a=1]")]
    write_rerun(tmp_path / "run.rrd", LOG, runs, walls=[(0, 0, 3, 4)])
    assert [file.name for file in tmp_path.iterdir()] == ["run.rrd"]
    assert (tmp_path / "run.rrd").read_bytes()[:3] == b"RRF"
    places = [place for place, _ in logged]
    assert places.count("world/ekf/landmarks") == 2
    assert places.count("world/invariant\\[a\\=1\\]/readings") == 2
    landmarks = [content for place, content in logged if place == "world/ekf/landmarks"]
    trace = runs[0].trace
    ids, means, covariances = trace.map_at(1)
    assert ids.tolist() == [4, 9]
    centres = values(landmarks[1], "centers")
    np.testing.assert_allclose(centres[:, :2], means, atol=1e-6)
    halves = values(landmarks[1], "half_sizes")
    turns = values(landmarks[1], "quaternions")
    for (long, short, _), (*_, z, w), P in zip(halves, turns, covariances, strict=True):
        angle = 2 * np.arctan2(z, w)
        R = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        found = R @ np.diag([long**2, short**2]) @ R.T / 9
        np.testing.assert_allclose(found, P, rtol=1e-5, atol=1e-8)
    robot = [content for place, content in logged if place == "world/ekf/robot"]
    assert len(robot) == 2
    for step, arrow in enumerate(robot):
        place = values(arrow, "origins")[0, :2]
        np.testing.assert_allclose(place, trace.poses[step, :2], atol=1e-6)
    assert trace.poses[1, 0] > 0.5
    nis = [content for place, content in logged if place == "plots/nis/ekf"]
    assert values(nis[0], "scalars") == pytest.approx(trace.nis[1] / trace.nis_dof[1])


def test_a_missing_library_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "rerun", None)
    with pytest.raises(ImportError, match=r"pip install 'slamgym\[viewer\]'"):
        import_rerun()


class Stream(SimpleNamespace):
    """A recording that lists the time, the place and the content of each entry."""

    def __init__(self, name):
        super().__init__(logged=[], now={}, ended=[], name=name)
        self.save = lambda path: path.write_text("saved")
        self.send_recording_name = self.ended.append
        self.flush = partial(self.ended.append, "flushed")
        self.disconnect = partial(self.ended.append, "disconnected")

    def set_time(self, name, **value):
        self.now[name] = value

    def log(self, place, thing, static=False):
        self.logged.append((None if static else dict(self.now), place, thing))


class Library:
    """A substitute for the module rerun that returns the arguments of each call."""

    ViewCoordinates = SimpleNamespace(RIGHT_HAND_Z_UP="z up")

    def __getattr__(self, kind):
        return lambda *given, **named: (kind, given, named)

    def RecordingStream(self, name):  # noqa: N802
        self.stream = Stream(name)
        return self.stream

    def escape_entity_path_part(self, name):
        return f"<{name}>"


def flat(*points):
    return np.column_stack(
        [np.reshape(points, (-1, 2)), np.zeros(np.size(points) // 2)]
    )


def test_a_recording_holds_each_step_of_each_filter_in_place(tmp_path, monkeypatch):
    library = Library()
    monkeypatch.setattr(rerun_recording, "import_rerun", lambda: library)
    log = SlamLog(
        "little",
        landmark_ids=LOG.landmark_ids,
        landmarks=LOG.landmarks,
        events=(*LOG.events, OdometryRow(3, 1.0, 0.3, 2)),
        ground_truth=[(0, 0, 0, 0.1), (1, 1, 0.5, 0.2)],
    )
    frames = RunFrames(log)
    noise = {"motion_std": (0.1, 0.1, 0.05), "measurement_std": (0.05, 0.1)}
    slam = make_estimator("ekf", gate_probability=0.2, **noise)
    trace = replay(log, slam, name="a", watch=frames.watch).trace
    runs = [ViewedRun(trace, frames)] * 5
    write_rerun(tmp_path / "run.rrd", log, runs, walls=[(0, 1, 3, 4)])
    assert (tmp_path / "run.rrd").read_text() == "saved"
    noted = library.stream
    assert noted.ended == ["little", "flushed", "disconnected"]
    still = {place: thing for now, place, thing in noted.logged if now is None}
    grey = [128, 128, 128]
    kind, (strips,), looks = still["world/walls"]
    assert (kind, looks) == ("LineStrips3D", {"colors": grey})
    np.testing.assert_array_equal(strips, [flat((0, 1), (3, 4))])
    kind, (points,), looks = still["world/truth/landmarks"]
    expected = {"labels": ["4", "9"], "colors": grey, "show_labels": False}
    assert (kind, looks) == ("Points3D", expected)
    np.testing.assert_array_equal(points, flat(*LOG.landmarks))
    (path,) = still["world/truth/path"][1][0]
    np.testing.assert_array_equal(path, flat((0, 0), (1, 0.5)))
    assert still["world"] == "z up"
    moving = [each for each in noted.logged if each[0] is not None]
    palette = (style.BLUE, style.ORANGE, style.TEAL, figures.PURPLE, style.BLUE)
    colours = [np.multiply(to_rgb(hue), 255).round().tolist() for hue in palette]
    fifth = len(moving) // 5
    parts = [moving[k : k + fifth] for k in range(0, len(moving), fifth)]
    for colour, part in zip(colours, parts, strict=True):
        assert {now["step"]["sequence"] for now, *_ in part} == {0, 1, 2}
        for step in range(3):
            own = {
                place: (thing, now)
                for now, place, thing in part
                if now["step"] == {"sequence": step}
            }
            _check_step(own, colour, runs[0], step)


def _check_step(own, colour, run, step):
    trace = run.trace
    pose, found = trace.poses[step], {place: thing for place, (thing, _) in own.items()}
    assert {now["time"]["duration"] for _, now in own.values()} == {trace.t[step]}
    expected = {"world/<a>/robot": (pose, colour)}
    if step < 2:  # the truth is known
        expected["world/truth/robot"] = trace.true_poses[step], [128, 128, 128]
    for place, ((x, y, heading), hue) in expected.items():
        kind, _, arrow = found[place]
        assert (kind, arrow["colors"]) == ("Arrows3D", hue)
        np.testing.assert_allclose(arrow["origins"], flat((x, y)))
        direction = [[np.cos(heading), np.sin(heading), 0]]
        np.testing.assert_allclose(arrow["vectors"], direction)
    assert ("world/truth/robot" in found) == (step < 2)
    ((line,),) = found["world/<a>/motion"][1]
    np.testing.assert_array_equal(
        line, flat(*trace.poses[max(step - 1, 0) : step + 1, :2])
    )
    now = trace.map_at(step)
    shown = {
        "world/<a>/robot/ellipse": (
            pose[None, :2], trace.pose_covariances[step][None, :2, :2], ["robot"]
        ),
        "world/<a>/landmarks": (now.means, now.covariances, list(map(str, now.ids))),
    }  # fmt: skip
    for place, (means, covariances, labels) in shown.items():
        kind, _, drawn = found[place]
        assert (kind, drawn["labels"]) == ("Ellipsoids3D", labels)
        assert drawn["colors"] == [colour] * len(means)
        np.testing.assert_allclose(drawn["centers"], flat(*means))
        each = zip(drawn["half_sizes"], drawn["quaternions"], covariances, strict=True)
        for (one, other, up), (*flat_axes, z, w), P in each:
            turn = np.exp(2j * np.arctan2(z, w))
            R = np.array([[turn.real, -turn.imag], [turn.imag, turn.real]])
            shape = R @ np.diag([one**2, other**2]) @ R.T
            np.testing.assert_allclose(shape, 9 * P, atol=1e-12)
            assert (up, flat_axes, z * z + w * w) == (0, [0, 0], pytest.approx(1))
    _check_readings(found, colour, run, step)


def _check_readings(found, colour, run, step):
    """Check the readings, correlations and plots of a step."""
    trace, pose, alarm = run.trace, run.trace.poses[step], [213, 94, 0]
    frame = run.frames.maps[step]
    _, (lines,), style = found["world/<a>/readings"]
    scan = [LOG.scans[0], LOG.scans[1], None][step]
    readings = np.empty((0, 2)) if scan is None else scan.measurements
    ends = pose[:2] + readings[:, 1:] * np.column_stack(
        [np.cos(pose[2] + readings[:, 0]), np.sin(pose[2] + readings[:, 0])]
    )
    assert len(lines) == len(ends)
    for line, end in zip(lines, ends, strict=True):
        np.testing.assert_allclose(line, flat(pose[:2], end))
    names = [rerun_recording.run_frames.OUTCOMES[code] for code in frame.outcomes]
    hues = [colour if name in ("used", "new") else alarm for name in names]
    assert (style["labels"], style["colors"]) == (names or None, hues or None)
    matrix = found["correlations/<a>"][1][0]
    below = run.frames.correlations[step].values
    assert matrix[1, 0] == np.float32(below[0])
    assert matrix[2].tolist() == [*np.float32(below[1:3]), 1]
    np.testing.assert_array_equal(matrix, matrix.T)
    ratio = pose_nees(trace)[step] / 3
    shown = found.get("plots/nees/<a>", (0, (np.nan,)))[1]
    np.testing.assert_array_equal(shown, [ratio])
    nis = trace.nis[step] / trace.nis_dof[step] if trace.nis_dof[step] else None
    assert found.get("plots/nis/<a>", (0, (None,)))[1] == (nis,)
