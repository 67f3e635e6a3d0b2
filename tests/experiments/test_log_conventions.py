"""Mistakes in the conventions of a log are named, and nothing else is."""

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from commands import slamgym
from recordings import recorded

from slamgym.estimator.filters.drive_likelihood import drive_likelihood
from slamgym.estimator.models.bearing_range import wrap_angle
from slamgym.experiments.log_conventions import (
    _Comparison,
    events_of,
    mistake_in_log,
    part_of,
)
from slamgym.experiments.logs import (
    OdometryRow,
    Scan,
    SlamLog,
    read_log,
    read_slamlog,
    write_slamlog,
)
from slamgym.experiments.run_and_replay.filter_settings import (
    noise_or_assumed,
    settings_for,
)
from slamgym.sim_configs import load_scenario

DATA = os.environ.get("SLAMGYM_DATA")
PUBLIC = ("cmu16833", "utias_d6_r3")
HALF = np.pi / 2
NOISE = {"motion_std": (0.05, 0.02, 0.03), "measurement_std": (0.02, 0.1)}


def simulated(name, seed, steps=200, **changes):
    return recorded(name, seed, steps=min(steps, load_scenario(name).steps), **changes)


@pytest.fixture(scope="module")
def corridor():
    return simulated("corridor", seed=0)


@pytest.fixture(scope="module", params=PUBLIC)
def public(request):
    if DATA is None:
        pytest.skip("SLAMGYM_DATA does not name the folder of the public logs")
    return read_slamlog(Path(DATA) / f"{request.param}.csv")


def of_rows(change):
    """Return the change of a log whose rows (d, α, dt) change together."""

    def changed(log):
        rows = [event for event in log.events if isinstance(event, OdometryRow)]
        table = np.array([(row.d, row.alpha, row.dt) for row in rows])
        new = dict(zip(map(id, rows), change(*table.T, log), strict=True))
        events = [
            OdometryRow(event.t, *map(float, new[id(event)]), event.dt)
            if id(event) in new
            else event
            for event in log.events
        ]
        return replace(log, events=events)

    return changed


def of_scans(change):
    """Return the change of a log whose rows (β, r) change one by one."""

    def changed(log):
        events = [
            replace(event, measurements=np.column_stack(change(*event.measurements.T)))
            if isinstance(event, Scan)
            else event
            for event in log.events
        ]
        return replace(log, events=events)

    return changed


def velocities(d, alpha, dt, log):
    seconds = 0.1 if (dt == 1).all() else np.where(dt > 0, dt, 1)
    return np.column_stack([d / seconds, alpha / seconds])


def headings(d, alpha, dt, log):
    return np.column_stack([d, wrap_angle(log.start[2] + np.cumsum(alpha))])


def turned_first(log):
    """Write the drive of a robot that turns first: its scans come before the turn."""
    last, events = 0.0, []
    for event in log.events:
        if isinstance(event, OdometryRow):
            events.append(replace(event, alpha=last))
            last = event.alpha
        else:
            readings = event.measurements + np.array([last, 0.0])
            events.append(replace(event, measurements=readings))
    return replace(log, events=events)


def with_the_ids_of_the_row_before(log):
    ids = np.roll(np.concatenate([scan.landmark_ids for scan in log.scans]), 1)
    events, done = [], 0
    for event in log.events:
        if isinstance(event, Scan):
            named = ids[done : done + len(event.landmark_ids)]
            done += len(named)
            first = np.sort(np.unique(named, return_index=True)[1])
            events.append(Scan(event.t, event.measurements[first], named[first]))
        else:
            events.append(event)
    return replace(log, events=events)


def with_scans_a_row_late(log):
    late, waiting = [], []
    for event in log.events:
        if isinstance(event, OdometryRow):
            late.append(event)
            late += [replace(scan, t=event.t) for scan in waiting]
            waiting = []
        else:
            waiting.append(event)
    return replace(log, events=late)


FAR = {  # a mistake, and the words that name it
    "clockwise": (of_scans(lambda b, r: (-b, r)), "bearings are clockwise"),
    "degrees": (of_scans(lambda b, r: (np.degrees(b), r)), "bearings are in degrees"),
    "turned degrees": (
        of_rows(lambda d, a, dt, log: np.column_stack([d, np.degrees(a)])),
        "turns of the odometry are in degrees",
    ),
    "exchanged": (of_scans(lambda b, r: (r, b)), "the range stands before"),
    "velocities": (of_rows(velocities), "holds velocities"),
    "headings": (of_rows(headings), "holds headings"),
    "clockwise turns": (
        of_rows(lambda d, a, dt, log: np.column_stack([d, -a])),
        "turns of the odometry are clockwise",
    ),
    "left": (of_scans(lambda b, r: (b - HALF, r)), "from the left of the robot"),
    "right": (of_scans(lambda b, r: (b + HALF, r)), "from the right of the robot"),
    "compass": (of_scans(lambda b, r: (HALF - b, r)), "clockwise from the left"),
}
SHIFTED = {  # and a world whose motions differ enough to show it
    "turn first": (turned_first, "turns before it drives", "six_landmarks"),
    "ids": (with_the_ids_of_the_row_before, "ids stand one row too late", "dense"),
    "stamps": (with_scans_a_row_late, "odometry too late", "six_landmarks"),
}


def mistake_of(log):
    return mistake_in_log(log, settings_for(log, **noise_or_assumed(log, {})))


@pytest.mark.parametrize("name", FAR)
def test_a_mistake_in_a_simulated_log_is_named(corridor, name):
    change, words = FAR[name]
    assert words in mistake_of(change(corridor)).name


@pytest.mark.parametrize("name", SHIFTED)
def test_a_shift_in_a_simulated_log_is_named(name):
    change, words, world = SHIFTED[name]
    assert words in mistake_of(change(simulated(world, seed=1, steps=60))).name


@pytest.mark.parametrize("name", FAR)
@pytest.mark.filterwarnings("ignore:.*does not specify")
def test_a_mistake_in_a_public_log_is_named(public, name):
    change, words = FAR[name]
    assert words in mistake_of(change(public)).name


@pytest.mark.filterwarnings("ignore:.*does not specify")
def test_nothing_is_named_of_a_public_log(public):
    assert mistake_of(public) is None


@pytest.mark.parametrize("factor", [1 / 3, 1, 3])
@pytest.mark.parametrize("name", ["corridor", "loop", "six_landmarks"])
def test_a_wrong_noise_is_no_mistake_of_conventions(name, factor):
    log = simulated(name, seed=3)
    right = settings_for(log)
    motion, sensor = (
        tuple(factor * s for s in std)
        for std in (right.motion_std, right.measurement_std)
    )
    settings = replace(right, motion_std=motion, measurement_std=sensor)
    assert mistake_in_log(log, settings) is None


def test_outliers_are_no_mistake_of_conventions(corridor):
    rng = np.random.default_rng(4)

    def spoilt(b, r):
        is_wrong = rng.random(len(b)) < 0.15
        return np.where(is_wrong, rng.uniform(-3, 3, len(b)), b), r

    assert mistake_of(of_scans(spoilt)(corridor)) is None


@pytest.mark.parametrize(
    ("name", "change", "words"),
    [
        ("loop", turned_first, "the robot turns before it drives"),
        ("corridor", turned_first, "the robot turns before it drives"),
        ("corridor", with_scans_a_row_late, "the measurements stand one row of"),
    ],
)
def test_a_mistake_that_nis_does_not_show_is_named(name, change, words):
    found = mistake_of(change(simulated(name, seed=11, steps=1000)))
    assert found.name.startswith(words)


@pytest.mark.parametrize("factors", [(1, 1), (2, 2), (0.5, 2), (2, 0.5)])
@pytest.mark.parametrize("name", ["loop", "corridor", "slippery", "dropout"])
def test_nothing_is_named_where_only_the_noise_is_wrong(name, factors):
    log = simulated(name, seed=12, steps=1000)
    right = settings_for(log)
    motion, sensor = (
        tuple(factor * s for s in std)
        for factor, std in zip(
            factors, (right.motion_std, right.measurement_std), strict=True
        )
    )
    settings = replace(right, motion_std=motion, measurement_std=sensor)
    assert mistake_in_log(log, settings) is None


def test_a_mistake_is_named_where_a_scan_shows_many_landmarks():
    log = simulated("dense", seed=1, steps=60, sensor={"max_range": 12.0})
    assert min(len(scan.measurements) for scan in log.scans) > 40
    for name in ("clockwise", "degrees"):
        change, words = FAR[name]
        assert words in mistake_of(change(log)).name
    assert mistake_of(log) is None
    assert "ids stand" in mistake_of(with_the_ids_of_the_row_before(log)).name


@pytest.mark.filterwarnings("ignore:.*does not specify")
def test_a_log_without_a_scan_in_its_first_part_has_nothing_to_name():
    landmarks, late = 3, 9000
    ids, readings = np.arange(landmarks), np.full((landmarks, 2), (0.1, 5.0))
    events = [OdometryRow(float(k), 0.1, 0.0, 1.0) for k in range(1, late + 20)]
    for k in reversed(range(late, late + 19)):
        events.insert(k, Scan(float(k), readings, ids))
    assert mistake_of(SlamLog("drive", events=events)) is None


def test_the_nis_of_a_fit_is_near_1_and_falls_with_the_square_of_the_noise(corridor):
    """The start is certain, so that a factor of all noise changes no estimate."""
    given = part_of(corridor)
    comparison = _Comparison(corridor, settings_for(corridor), given)
    fit = comparison.fit(given, np.array([[1.0, 1.0], [2.0, 2.0]]))
    assert 0.7 < fit.nis[0] < 1.3
    assert fit.nis[1] == pytest.approx(fit.nis[0] / 4, rel=1e-3)
    assert not fit.rejected.any()
    quarter = np.full((1, 2), 0.25)
    few, events = comparison.fit(given, quarter), events_of(given)
    record = drive_likelihood(comparison.filter, events, comparison.noises(quarter))
    again = len(events.readings) - len(set(events.landmarks.tolist()))
    assert 0.1 < few.rejected[0] == pytest.approx(record.rejected.sum() / again)
    assert few.likelihoods[0] == pytest.approx(record.log_likelihoods.sum() / again)
    unusable = given.measurements.copy()
    unusable[::100, 1] = 0.0
    lost = comparison.fit(given._replace(measurements=unusable), np.ones((1, 2)))
    assert lost.rejected[0] > 0
    assert fit.likelihoods[0] - lost.likelihoods[0] > 9 * lost.rejected[0]


def test_a_mirrored_log_is_consistent(corridor):
    both = of_rows(lambda d, a, dt, log: np.column_stack([d, -a]))(corridor)
    assert mistake_of(of_scans(lambda b, r: (-b, r))(both)) is None


def test_mirror_images_are_both_named_where_no_truth_tells_them_apart(corridor):
    log = FAR["clockwise"][0](corridor)
    nothing = {"landmark_ids": [], "landmarks": np.empty((0, 2))}
    blind = replace(log, ground_truth=np.empty((0, 4)), **nothing)
    found = mistake_of(blind)
    assert FAR["clockwise"][1] in found.name
    assert FAR["clockwise turns"][1] in found.name


def csv_of(log, folder):
    """Write a log as csv files with named columns, without its header."""
    folder.mkdir()
    rows = [event for event in log.events if isinstance(event, OdometryRow)]
    lines = [f"{row.t},{row.d},{row.alpha}" for row in rows]
    (folder / "odometry.csv").write_text("\n".join(["t,d,alpha", *lines, ""]))
    lines = [
        f"{scan.t},{name},{bearing},{distance}"
        for scan in log.events
        if isinstance(scan, Scan)
        for name, (bearing, distance) in zip(
            scan.landmark_ids.tolist(), scan.measurements.tolist(), strict=True
        )
    ]
    (folder / "measurements.csv").write_text(
        "\n".join(["t,id,bearing,range", *lines, ""])
    )
    return folder


@pytest.mark.parametrize("name", ["degrees", "exchanged", "clockwise"])
def test_a_mistake_in_csv_files_of_ones_own_is_named(corridor, name, tmp_path):
    change, words = FAR[name]
    log = read_log(csv_of(change(corridor), tmp_path / "own"))
    settings = settings_for(log, **NOISE)
    assert words in mistake_in_log(log, settings).name


def test_commands_name_the_mistake_and_suggest_no_noise(corridor, tmp_path):
    file = tmp_path / "log.csv"
    write_slamlog(FAR["clockwise"][0](corridor), file)
    text = file.read_text()
    for command in ("replay", "smooth", "fit-noise"):
        write = ["--write"] if command == "fit-noise" else []
        shown = slamgym(command, file, *write, "--out", tmp_path / command).output
        told = " ".join(shown.split())
        assert "the bearings are clockwise" in told
        assert "Remedy: multiply the bearings by -1." in told
        assert "too little noise" not in told
        assert "--motion-std" not in told or command != "fit-noise"
        assert "inflation" not in told
    assert file.read_text() == text
