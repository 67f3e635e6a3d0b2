"""The page of a run: what it holds, how large it is, and that it is safe."""

import base64
import json
import re
import time
import zlib
from dataclasses import replace

import numpy as np
import pytest
from recordings import recorded
from scipy.stats import chi2

from slamgym.estimator import EkfSlam, make_estimator
from slamgym.estimator.interface import MapView, UpdateReport
from slamgym.experiments.logs import OdometryRow, Scan, SlamLog
from slamgym.experiments.run_and_replay import replay
from slamgym.experiments.run_and_replay.summary import pose_nees
from slamgym.experiments.viewers import RunFrames, ViewedRun, write_run_page
from slamgym.experiments.viewers import run_page as run_frames
from slamgym.experiments.viewers.run_page import (
    PackedArrays,
    ThinnedSteps,
    correlations_of,
    deviation_codes,
    position_codes,
    row_outcomes,
)

HOSTILE = "</script></title><script>document.title = 'taken'</script> & '\"$x$"
NOISE = {"motion_std": (0.1, 0.1, 0.05), "measurement_std": (0.05, 0.1)}


def followed(log, name="ekf", **options):
    frames = RunFrames(log)
    slam = make_estimator(name, **NOISE, initial_pose=log.start, **options)
    return ViewedRun(replay(log, slam, name=name, watch=frames.watch).trace, frames)


def page_of(log, runs, path, **options):
    write_run_page(path / "run.html", log, runs, **options)
    return (path / "run.html").read_text(encoding="utf-8")


def element(page, name):
    return re.search(rf'<script [^>]*id="{name}">(.*?)</script>', page, re.S)[1]


def unpacked(table, text):
    """What the page's script reads: the slow twin of data.js."""
    content = zlib.decompress(base64.b64decode(text))
    arrays, offset = {}, 0
    for name, entry in table.items():
        kind = np.dtype(entry["type"]).newbyteorder("<")
        arrays[name] = np.frombuffer(content, kind, entry["length"], offset)
        offset += -(-arrays[name].nbytes // 4) * 4
        if "counts" in entry:
            arrays[name] = summed(arrays[name], arrays[entry["counts"]])
    assert offset == len(content)
    return arrays


def summed(changes, counts):
    frames, before = [], changes[:0]
    for change in np.split(changes, np.cumsum(counts)[:-1]):
        now = change.copy()
        common = min(len(now), len(before))
        now[:common] += before[:common]
        frames.append(now)
        before = now
    return frames


def arrays_of(page):
    facts = json.loads(element(page, "facts"))
    return facts, unpacked(facts["arrays"], element(page, "arrays"))


@pytest.fixture(scope="module")
def loop():
    return recorded("loop", 0, steps=60)


@pytest.fixture(scope="module")
def viewed(loop):
    return [followed(loop), followed(loop, "invariant")]


@pytest.fixture(scope="module")
def page(loop, viewed, tmp_path_factory):
    return page_of(loop, viewed, tmp_path_factory.mktemp("page"))


def test_packed_arrays_come_back_as_they_were():
    packed, rng = PackedArrays(), np.random.default_rng(1)
    frames = [rng.integers(-128, 127, n).astype(np.int16) for n in (0, 3, 1, 4, 4)]
    bytes_ = [rng.integers(0, 256, n).astype(np.uint8) for n in (2, 5, 0)]
    packed.put("flat", np.array([0.5, np.nan, -1]), "float32")
    packed.put_frames("frames", frames, "int16")
    packed.put_frames("bytes", bytes_, "uint8")
    found = unpacked(packed.table, packed.text())
    np.testing.assert_array_equal(found["flat"], [0.5, np.nan, -1])
    for name, expected in (("frames", frames), ("bytes", bytes_)):
        assert [f.tolist() for f in found[name]] == [f.tolist() for f in expected]


def test_packed_arrays_refuse_other_types():
    with pytest.raises(ValueError, match="kind must be one of float32, int32"):
        PackedArrays().put("x", np.zeros(2), "float64")


def test_codes_of_positions_and_deviations_are_fine_enough():
    x = np.array([-1234.56789, 0.0, 7e4])
    np.testing.assert_allclose(position_codes(x) / 1e4, x, atol=5.1e-5)
    std = np.array([1e-6, 0.1, 30.0])
    np.testing.assert_allclose(np.exp(deviation_codes(std) / 2000), std, rtol=3e-4)
    extremes = position_codes(np.array([np.nan, -np.inf, -3e5, np.inf]))
    assert extremes.tolist() == [-(2**31), *[1 - 2**31] * 2, 2**31 - 1]
    assert deviation_codes(np.array([np.nan, 0.0])).tolist() == [-(2**15)] * 2


def test_the_page_holds_the_beliefs_of_every_step(page, viewed, loop):
    facts, arrays = arrays_of(page)
    assert facts["filters"] == ["ekf", "invariant"]
    assert arrays["step"].tolist() == list(range(61))
    assert arrays["t"].tolist() == viewed[0].trace.t.tolist()
    for number, (trace, _) in enumerate(viewed):
        for k, name in enumerate(("x", "y", "theta")):
            pose = arrays[f"{number}.pose.{name}"]
            np.testing.assert_allclose(pose, trace.poses[:, k], atol=1e-5)
            std = np.sqrt(trace.pose_covariances[:, k, k])
            found = arrays[f"{number}.pose.std_{name}"]
            np.testing.assert_allclose(found, std, atol=1e-6)
        xx, xy, yy = (
            trace.pose_covariances[1:, *ij] for ij in ((0, 0), (0, 1), (1, 1))
        )
        rho = arrays[f"{number}.pose.rho"][1:]
        np.testing.assert_allclose(rho, xy / np.sqrt(xx * yy), rtol=1e-4, atol=1e-6)
        for step in (0, 30, 60):
            ids, means, covariances = trace.map_at(step)
            assert arrays[f"{number}.id"][step].tolist() == ids.tolist()
            rows = [event.landmark_ids for event in loop.scans if event.t == step]
            found = arrays[f"{number}.row_id"][step].tolist()
            assert [found] == [ids.tolist() for ids in rows or [np.array([])]]
            x, y = (arrays[f"{number}.{axis}"][step] / 1e4 for axis in "xy")
            np.testing.assert_allclose(np.column_stack([x, y]), means, atol=1e-4)
            u, v = (
                np.exp(arrays[f"{number}.std_{axis}"][step] / 2000) for axis in "xy"
            )
            std = np.sqrt(np.einsum("nii->in", covariances))
            np.testing.assert_allclose([u, v], std, rtol=3e-4)
            rho = 32000 * covariances[:, 0, 1] / std.prod(axis=0)
            assert arrays[f"{number}.rho"][step].tolist() == rho.round().tolist()
        assert arrays[f"{number}.final.id"].tolist() == trace.landmark_ids.tolist()
        truth = [arrays[f"{number}.final.{axis}"] for axis in "xy"]
        np.testing.assert_allclose(np.transpose(truth), trace.true_landmarks, rtol=1e-6)
    np.testing.assert_allclose(arrays["true.x"], loop.ground_truth[:, 1], atol=1e-5)


def test_the_page_holds_nees_and_nis_by_their_degrees(page, viewed):
    facts, arrays = arrays_of(page)
    trace = viewed[1].trace
    np.testing.assert_allclose(arrays["1.nees"], pose_nees(trace) / 3, rtol=1e-5)
    used = trace.nis_dof > 0
    expected = trace.nis[used] / trace.nis_dof[used]
    np.testing.assert_allclose(arrays["1.nis"][used], expected, rtol=1e-5)
    assert np.isnan(arrays["1.nis"][~used]).all()
    for name, share in (("low", 0.025), ("high", 0.975)):
        dof = trace.nis_dof[used]
        bound = arrays[f"1.nis_{name}"][used]
        np.testing.assert_allclose(bound, chi2.ppf(share, dof) / dof, rtol=1e-5)
    np.testing.assert_allclose(facts["bands"]["nees"], [0.0719, 3.1161], atol=1e-4)


def test_the_page_holds_the_readings_of_every_step(page, loop):
    assert_readings(arrays_of(page)[1], loop)


def assert_readings(arrays, log):
    scans = {event.t: event for event in log.events if isinstance(event, Scan)}
    for place, step in enumerate(arrays["step"]):
        scan = scans.get(step)
        expected = np.empty((0, 2)) if scan is None else scan.measurements
        bearings, ranges = (
            arrays[f"reading.{name}"][place] / 1e4 for name in ("bearing", "range")
        )
        found = np.column_stack([bearings, ranges])
        np.testing.assert_allclose(found, expected, atol=1e-4)


def test_correlations_are_the_largest_over_all_directions():
    rng = np.random.default_rng(2)
    A = rng.normal(size=(11, 11)) * rng.uniform(0.01, 3, 11)[:, None]
    P = A @ A.T
    found = correlations_of(MapView(np.zeros(11), P, (5, 3, 8, 1)))
    parts = [slice(0, 2), *(slice(3 + 2 * k, 5 + 2 * k) for k in range(4))]
    expected = []
    for row in range(5):
        for column in range(row):
            a, b = parts[row], parts[column]
            L, M = np.linalg.cholesky(P[a, a]), np.linalg.cholesky(P[b, b])
            white = np.linalg.inv(L) @ P[a, b] @ np.linalg.inv(M).T
            expected.append(np.linalg.svd(white)[1][0])
    np.testing.assert_allclose(found, expected, rtol=1e-9)
    directions = np.linspace(0, np.pi, 721)
    w = np.stack([np.cos(directions), np.sin(directions)])
    a, b = parts[2], parts[1]
    std = [np.sqrt(np.einsum("ik,ij,jk->k", w, P[p, p], w)) for p in (a, b)]
    most = abs(w.T @ P[a, b] @ w / np.outer(*std)).max()
    assert most == pytest.approx(found[2], 1e-3)


def test_a_certain_position_is_correlated_with_nothing():
    P = np.zeros((7, 7))
    P[3:5, 3:5] = np.eye(2)
    assert correlations_of(MapView(np.zeros(7), P, (1, 2))).tolist() == [0, 0, 0]


def test_the_page_holds_the_correlations(page, viewed):
    _, arrays = arrays_of(page)
    place = arrays["0.pairs.place"].tolist().index(60)
    frame = viewed[0].frames.correlations[60]
    assert arrays["0.pairs.id"][place].tolist() == frame.ids.tolist()
    found = arrays["0.pairs.value"][place] / 255
    np.testing.assert_allclose(found, frame.values, atol=2e-3)
    assert found.max() > 0.5


def test_outcomes_of_readings_with_identity():
    slam = EkfSlam(**NOISE, gate_probability=0.99, min_range=0.5)
    slam.update([(0.0, 5.0), (1.0, 4.0)], [4, 6])
    scan = Scan(1, [(0.0, 5.0), (2.0, 9.0), (0.5, 3.0), (0, 0.1)], [4, 6, 9, 2])
    report = slam.update(scan.measurements, scan.landmark_ids.tolist())
    codes, ids = row_outcomes(scan, report)
    names = [run_frames.OUTCOMES[code] for code in codes]
    assert names == ["used", "rejected", "new", "too close to be used"]
    assert ids.tolist() == [4, 6, 9, 2]


def test_outcomes_of_readings_without_identity():
    scan = Scan(1, [(0.0, 5.0), (1.0, 4.0), (2.0, 4.0), (3.0, 2.0)])
    report = UpdateReport(
        associated_ids=(8,),
        row_ids=(8, None, 5, None),
        tentative_rows=(2,),
        ambiguous_rows=(3,),
    )
    codes, ids = row_outcomes(scan, report)
    names = [run_frames.OUTCOMES[code] for code in codes]
    assert names == ["used", "not used", "tentative", "ambiguous"]
    assert ids.tolist() == [8, -1, 5, -1]
    assert row_outcomes(scan, UpdateReport())[1].tolist() == [-1] * 4


def test_clutter_is_marked():
    log = recorded("hidden_identities", 0, steps=12)
    frames = followed(log, "ekf", management=True).frames
    assert len(frames.maps) == 13
    codes = np.concatenate([frame.outcomes for frame in frames.maps.values()])
    assert {run_frames.OUTCOMES.index("tentative")} <= set(codes.tolist())


def test_names_cannot_break_out_of_the_page(loop, viewed, tmp_path):
    log = SlamLog(HOSTILE, events=loop.events, ground_truth=loop.ground_truth)
    trace, frames = viewed[0]
    named = ViewedRun(replace(trace, estimator=HOSTILE), frames)
    page = page_of(log, [named], tmp_path)
    assert page.count("<script") == page.count("</script>") == 3
    assert HOSTILE not in page
    assert json.loads(element(page, "facts"))["filters"] == [HOSTILE]


def test_the_same_runs_give_the_same_bytes(loop, viewed, page, tmp_path):
    assert page_of(loop, viewed, tmp_path) == page


def test_no_run_is_refused(loop, tmp_path):
    with pytest.raises(ValueError, match="runs must hold at least one run"):
        write_run_page(tmp_path / "run.html", loop, [])
    assert list(tmp_path.iterdir()) == []


def test_thinned_steps_keep_the_first_the_last_and_even_spacing():
    kept = ThinnedSteps(most_steps=10, most_size=1000, last=100)
    for step in range(101):
        if kept.is_due(step):
            kept.put(step, step, size=1)
    assert list(kept.items) == [*range(0, 97, 16), 100]
    assert kept.stride == 16


def test_thinned_steps_stay_below_a_size():
    kept = ThinnedSteps(most_steps=1000, most_size=200, last=200)
    for step in range(100):
        if kept.is_due(step):
            kept.put(step, step, size=step)
    assert 64 < sum(kept.items) <= 200


def test_a_long_run_shows_every_eighth_step_and_says_so(monkeypatch, loop, tmp_path):
    whole = followed(loop, "invariant")
    monkeypatch.setattr(run_frames, "_MOST_FRAMES", 10)
    page = page_of(loop, [whole, followed(loop)], tmp_path)
    assert "one step in 8 of 60." in page
    _, arrays = arrays_of(page)
    assert arrays["step"].tolist() == [*range(0, 57, 8), 60]
    assert arrays["t"].tolist() == whole.trace.t[arrays["step"]].tolist()
    assert len(arrays["0.id"]) == 9
    assert_readings(arrays, loop)


def test_correlations_are_thinned_alone(monkeypatch, loop, tmp_path):
    monkeypatch.setattr(run_frames, "_MOST_PAIRS", 60)
    page = page_of(loop, [followed(loop)], tmp_path)
    _, arrays = arrays_of(page)
    places = arrays["0.pairs.place"]
    assert len(arrays["step"]) == 61 > len(places) > 2
    assert f"one step in {places[1]}." in page
    assert sum(map(len, arrays["0.pairs.value"])) <= 60 + 10


def test_a_large_map_has_no_correlations_and_says_so(monkeypatch, loop, tmp_path):
    viewed = followed(loop)
    for most in viewed.frames.largest, viewed.frames.largest - 1:
        monkeypatch.setattr(run_frames, "MOST_CORRELATED", most)
        page = page_of(loop, [viewed], tmp_path)
        is_large = most < viewed.frames.largest
        assert ("Correlations are omitted: ekf has more than" in page) == is_large
        assert (arrays_of(page)[1]["0.pairs.place"].size == 0) == is_large


def test_a_filter_that_joins_its_map_shows_the_last_joined_one(loop, tmp_path):
    viewed = followed(loop, "submaps")
    page = page_of(loop, [viewed], tmp_path)
    assert "submaps joins its map only sometimes" in page
    assert [len(part) for part in viewed.frames.maps[30][:3]] == [0, 0, 0]
    ids = arrays_of(page)[1]["0.id"]
    assert ids[60].tolist() == viewed.trace.landmark_ids.tolist()


def test_watching_does_not_change_a_run(loop, viewed):
    slam = make_estimator("ekf", **NOISE, initial_pose=loop.start)
    alone = replay(loop, slam).trace
    np.testing.assert_array_equal(alone.poses, viewed[0].trace.poses)
    final = viewed[0].trace.final_covariance
    np.testing.assert_array_equal(alone.final_covariance, final)


@pytest.mark.parametrize("scans", [(), (Scan(1.0, [(0.1, 2.0)], [7]),)])
def test_a_log_without_truth_has_a_page_with_or_without_landmarks(scans, tmp_path):
    log = SlamLog("blind", events=(OdometryRow(1.0, 1.0, 0.0, 1.0), *scans))
    page = page_of(log, [followed(log)], tmp_path, walls=[(0, 0, 3, 4)])
    facts, arrays = arrays_of(page)
    assert np.isnan([*arrays["true.x"], *arrays["0.final.x"]]).all()
    assert len(arrays["0.final.x"]) == len(scans)
    assert facts["walls"] == [[0, 0, 3, 4]]


@pytest.mark.slow
def test_a_thousand_steps_of_twenty_landmarks_are_small_and_written_fast(tmp_path):
    log = recorded("loop", 0, steps=1005)
    started = time.process_time()
    alone = replay(log, make_estimator("ekf", **NOISE, initial_pose=log.start))
    without = time.process_time() - started
    started = time.process_time()
    page = page_of(log, [followed(log)], tmp_path)
    taken = time.process_time() - started - without
    assert len(alone.belief.landmark_ids) == 20
    assert len(page.encode()) < 0.5e6
    assert taken < 2  # about 0.5 s on an idle core
