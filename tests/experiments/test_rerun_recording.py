"""The recording for rerun, written by the library itself."""

import sys

import numpy as np
import pytest

from slamgym.estimator import make_estimator
from slamgym.experiments.logs import OdometryRow, Scan, SlamLog
from slamgym.experiments.run_and_replay import replay
from slamgym.experiments.viewers import RunFrames, ViewedRun, write_rerun
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
