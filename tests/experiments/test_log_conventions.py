"""Mistakes in the conventions of a log are named, and nothing else is."""

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from commands import slamgym
from recordings import recorded

from slamgym.estimator.filters.drive_likelihood import GATE, drive_likelihood
from slamgym.estimator.models.bearing_range import wrap_angle
from slamgym.evaluation.trajectory_error import position_accuracy
from slamgym.experiments import figures
from slamgym.experiments.command_line import run_files
from slamgym.experiments.log_conventions import (
    LogAsRead,
    WrongConvention,
    _Comparison,
    _is_far_off,
    _LogFit,
    _named,
    _rise,
    events_of,
    is_used,
    mistake_in_log,
    others,
    part_of,
    unbroken,
)
from slamgym.experiments.logs import (
    OdometryRow,
    Scan,
    SlamLog,
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


@pytest.mark.parametrize("name", ["degrees", "headings", "compass"])
@pytest.mark.filterwarnings("ignore:.*does not specify")
def test_a_mistake_in_a_public_log_is_named(public, name):
    change, words = FAR[name]
    assert words in mistake_of(change(public)).name


@pytest.mark.filterwarnings("ignore:.*does not specify")
def test_nothing_is_named_of_a_public_log(public):
    assert mistake_of(public) is None


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


@pytest.mark.parametrize(
    "factors", [(1, 1), (3, 3), (1 / 3, 1 / 3), (0.5, 2), (2, 0.5)]
)
@pytest.mark.parametrize("name", ["loop", "corridor", "slippery", "six_landmarks"])
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
    given = given._replace(measurements=unusable, log_volume=3.0, moved=-1)
    lost, events = comparison.fit(given, quarter), events_of(given)
    record = drive_likelihood(comparison.filter, events, comparison.noises(quarter))
    without = again - record.used.sum()
    skipped = without - record.rejected.sum()
    assert skipped == (unusable[is_used(given), 1] == 0).sum() > 0
    total = record.log_likelihoods.sum() - 10 * skipped
    assert lost.likelihoods[0] == pytest.approx(3 + total / again)
    nis = record.nis.sum() + GATE * without
    assert lost.nis[0] == pytest.approx(nis / (2 * again))
    later = np.roll(record.log_likelihoods[0], 1)
    np.testing.assert_array_equal(lost.by_step[0], later)


def test_the_error_of_a_reading_is_that_of_its_path_and_its_landmarks(corridor):
    given = part_of(corridor)
    comparison, one = _Comparison(corridor, settings_for(corridor), given), np.ones(2)
    events = events_of(given)
    noise = comparison.noises(one[None])
    record = drive_likelihood(comparison.filter, events, noise, keep_beliefs=True)
    seen, true = [], []
    places = dict(zip(corridor.landmark_ids.tolist(), corridor.landmarks, strict=True))
    for step, z, i in zip(
        given.steps, given.measurements, given.landmarks, strict=True
    ):
        if i in places and given.is_read[step]:
            x, y, heading = record.poses[0, step]
            angle = heading + z[0]
            seen.append((x + z[1] * np.cos(angle), y + z[1] * np.sin(angle)))
            true.append(places[i])
    path = corridor.ground_truth[: len(given.is_read), 1:3]
    pairs = np.vstack([seen, record.poses[0, :, :2]]), np.vstack([true, path])
    expected = position_accuracy(*pairs).aligned_rmse
    assert comparison.error(given, one) == pytest.approx(expected)


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


def test_commands_name_the_mistake_and_suggest_no_noise(
    corridor, tmp_path, monkeypatch
):
    monkeypatch.setattr(run_files, "write_figures", lambda *_, **__: None)
    monkeypatch.setattr(figures, "save_figure", lambda _, path: path.touch())
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


# ---- a log of four steps, written by hand

ROWS = np.array(
    [[1, 0.5, 0.1], [2, -0.4, 0.2], [3, 0.3, 0.1], [4, -2, 0.3], [5, 3, 0.1]]
)
READ = np.column_stack([np.linspace(-3, 3, 9), np.linspace(2, 6, 9)])
PART = LogAsRead(
    ROWS,
    np.array([1, 1, 2, 3, 3]),
    READ,
    np.array([7, 4, 7, 4, 4, -1, 9, 7, 4]),
    np.array([0, 0, 1, 1, 1, 2, 2, 3, 3]),
    np.array([True, True, False, True]),
    "turn-last",
    0.25,
)


def test_each_convention_is_read_as_its_remedy_says():
    (b, r), (d, alpha, dt), degree = READ.T, ROWS.T, np.pi / 180
    turned = [0.25 + alpha[PART.row_steps <= step].sum() for step in PART.steps]
    late = {"measurements": READ[:-1], "steps": PART.steps[:-1]}
    early = {"measurements": READ[1:], "steps": PART.steps[1:]}
    expected = {
        "the bearings are clockwise": (-b, r, 1),
        "the bearings are in degrees": (b * degree, r, degree),
        "bearings and turns are in degrees": (b * degree, r, degree),
        "the range stands before the bearing": (r, b, 1),
        "the bearings are measured from the left of the robot": (b + HALF, r, 1),
        "the bearings are measured from the right of the robot": (b - HALF, r, 1),
        "the bearings are measured from the rear of the robot": (b + np.pi, r, 1),
        "the bearings are clockwise from the left of the robot, its y axis": (
            (HALF - b, r, 1)
        ),
        "the bearings are measured from the x axis of the world": (b - turned, r, 1),
        "the ranges are in centimetres": (b, r / 100, 1 / 100),
        "the ranges are in millimetres": (b, r / 1000, 1 / 1000),
    }
    turns = np.diff(alpha, prepend=0.25)
    rows = {
        "bearings and turns are in degrees": (d, alpha * degree),
        "the distances driven are in centimetres": (d / 100, alpha),
        "the distances driven are in millimetres": (d / 1000, alpha),
        "the turns of the odometry are clockwise": (d, -alpha),
        "the turns of the odometry are in degrees": (d, alpha * degree),
        "the odometry holds headings in place of turns": (d, wrap_angle(turns)),
        "the odometry holds velocities in place of increments": (d * dt, alpha * dt),
    }
    changes = {
        "the robot drives arcs": {"motion": "midpoint"},
        "the robot turns before it drives": {"motion": "turn-first"},
        "the ids stand one row too late": late | {"landmarks": PART.landmarks[1:]},
        "the ids stand one row too early": early | {"landmarks": PART.landmarks[:-1]},
        "the measurements stand one row of odometry too late": {
            "steps": PART.steps - 1,
            "is_read": PART.is_read[[1, 2, 3, 0]],
            "moved": -1,
        },
        "the measurements stand one row of odometry too early": {
            "steps": PART.steps + 1,
            "is_read": PART.is_read[[3, 0, 1, 2]],
            "moved": 1,
        },
    }
    found = {it.name: it.reading for it in others(PART)}
    assert set(found) == {*expected, *rows, *changes}
    for name, reading in found.items():
        whole = PART._asdict() | changes.get(name, {})
        if name in expected:
            bearing, distance, volume = expected[name]
            whole["measurements"] = np.column_stack([wrap_angle(bearing), distance])
            whole["log_volume"] = np.log(volume)
        if name in rows:
            whole["rows"] = np.column_stack([*rows[name], dt])
        for field, value in whole.items():
            if isinstance(value, str):
                assert getattr(reading, field) == value
            else:
                np.testing.assert_allclose(getattr(reading, field), value, atol=1e-12)


@pytest.mark.parametrize("dt", [0.0, 1.0])
def test_velocities_without_durations_are_tried_with_usual_ones(dt):
    rows = ROWS * [1, 1, 0] + [0, 0, dt]
    rates = [it for it in others(PART._replace(rows=rows)) if "veloc" in it.name]
    tried = [it.reading.rows[0, 0] for it in rates]
    durations = [0.5, 0.25, 0.2, 0.1, 0.05, 0.04, 1 / 30, 0.02, 0.01]
    assert tried == pytest.approx(durations)
    for it, duration in zip(rates, durations, strict=True):
        np.testing.assert_allclose(it.reading.rows, rows * [duration, duration, 1])
        assert f"by {duration:.3g}, the duration" in it.remedy


def test_pairs_of_rows_are_read_in_the_frame_of_the_world_and_exchanged():
    rows = np.array([[0, 0.5, 0], [2, 0.1, 0.2], [0, -0.3, 0], [4, 0.2, 0.1]])
    part = PART._replace(rows=rows, row_steps=np.array([1, 1, 2, 2]))
    found = {it.name: it.reading.rows for it in others(part)}
    seen = found["the increments are in the frame of the world"]
    heading = 0.25 + 0.6
    expected = [0.5 - 0.25, 0.1 + 0.25, -0.3 - heading, 0.2 + heading]
    np.testing.assert_allclose(
        seen, np.column_stack([rows[:, 0], expected, rows[:, 2]])
    )
    name = "the rows of a turn stand before those of the drive that it follows"
    np.testing.assert_array_equal(found[name], rows[[1, 0, 3, 2]])
    assert "the robot drives arcs" not in found
    for broken in ([3, 0.5, 0], [0, 0.5, 0.1]):
        other = np.vstack([rows[:2], [broken], rows[3:]])
        assert name not in {it.name for it in others(part._replace(rows=other))}
    still = rows * [1, 1, 0]
    assert name not in {it.name for it in others(part._replace(rows=still))}


def test_events_hold_the_first_reading_of_each_landmark_in_scans_that_are_read():
    used = [True, True, True, True, False, False, False, True, True]
    assert is_used(PART).tolist() == used
    (d, alpha, dt), none = ROWS.T, np.zeros(5)
    halves = np.column_stack([none, alpha / 2, none, d, alpha / 2, dt])
    first = np.column_stack([none, alpha, none, d, none, dt])
    for motion, table in (
        ("turn-last", ROWS),
        ("midpoint", halves),
        ("turn-first", first),
    ):
        events = events_of(PART._replace(motion=motion))
        many = 1 if motion == "turn-last" else 2
        np.testing.assert_array_equal(events[0], np.reshape(table, (-1, 3)))
        assert events[1].tolist() == [0, 0, 2 * many, 3 * many, 5 * many]
        np.testing.assert_array_equal(events[2], READ[used])
        assert events[3].tolist() == [1, 0, 1, 0, 1, 0]
        assert events[4].tolist() == [0, 2, 4, 4, 6]
    assert unbroken(PART).is_read.all()
    outside = PART._replace(landmarks=np.array([7, 4, 7, -1, -1, -1, -1, -1, -1]))
    assert unbroken(outside).is_read.tolist() == [True, True, False, False]


def test_a_rise_is_compared_with_its_scatter_over_the_pieces():
    rng = np.random.default_rng(0)
    before, after = rng.normal(size=(2, 1, 400))
    for shift in (0.0, 0.5, 2.0):
        after = before + rng.normal(shift, 1.0, (1, 400))
        before[0, ::7] = 0.0  # steps without a scan
        steps = np.flatnonzero(before[0])
        rises = (after - before)[0, steps]
        pieces = np.array([piece.sum() for piece in np.array_split(rises, 30)])
        large = pieces[abs(pieces) > 2]
        fits = (_LogFit(*[np.zeros(1)] * 3, each) for each in (after, before))
        errors, share = _rise(*fits)
        error = np.sqrt(((pieces - pieces.mean()) ** 2).mean() * 30)
        assert errors == pytest.approx(rises.sum() / error)
        assert share == (large > 0).mean()
    lost = _LogFit(*[np.zeros(1)] * 3, np.full((1, 400), -np.inf))
    assert _rise(lost, _LogFit(*[np.zeros(1)] * 3, before)) == (0, 0)


@pytest.mark.parametrize(
    ("nis", "rejected", "loss", "is_far"),
    [
        *((1.0, 0.0, 0.0, False), (0.59, 0.0, 0.0, True), (0.61, 0.0, 0.0, False)),
        *((1.39, 0.0, 0.0, False), (1.41, 0.0, 0.0, True), (1.0, 0.3, 0.0, True)),
        *((1.0, 0.0, 0.11, True), (1.0, 0.0, 0.09, False)),
    ],
)
def test_a_log_is_far_off_by_nis_rejections_or_likelihood(nis, rejected, loss, is_far):
    likelihoods = np.zeros(25)
    likelihoods[3] = loss
    as_given = np.arange(25) == 12  # 5 factors of the motion by 5 of the sensor
    fit = _LogFit(
        likelihoods,
        np.where(as_given, nis, 5.0),
        np.where(as_given, rejected, 0.9),
        np.zeros((25, 3)),
    )
    assert _is_far_off(fit) == is_far


def test_a_mistake_is_written_with_its_numbers_and_those_as_given():
    after = _LogFit(np.array([-3.0, -1.5]), np.array([4.0, 1.1]), np.array([0.5, 0.04]),
                    np.zeros((2, 1)))  # fmt: skip
    before = _LogFit(
        np.array([-9.0, -4.0]),
        np.array([9.0, 55.5]),
        np.array([0.9, 0.3]),
        np.zeros((2, 1)),
    )
    pair = [each for each in others(PART) if "clockwise" in each.name][::2]
    found = _named([(after, each) for each in pair], before, np.array([1.0, 4.0]))
    name = f"{pair[0].name} or {pair[1].name}"
    remedy = f"{pair[0].remedy}, or {pair[1].remedy}"
    plain = WrongConvention(name, remedy, 2.5, (1.1, 55.5), (0.04, 0.3), (1.0, 4.0))
    assert found == plain
    text = (
        f"The log breaks a convention: {name}. Without this mistake and with 1 × the "
        "noise of the motion, 4 × that of the sensor, NIS is 1.1 per degree of "
        "freedom, not 55.5, 4% of the readings are rejected, not 30%, and the log "
        f"likelihood rises by 2.5 per reading. Remedy: {remedy}."
    )
    assert str(found) == text
    assert found.as_dict() == {**found._asdict(), "text": text}
    assert "noise" not in str(found._replace(factors=(1.0, 1.0)))
