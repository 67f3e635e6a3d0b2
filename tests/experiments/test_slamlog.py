import math
import os
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from slamgym.experiments.logs import log_lines
from slamgym.experiments.logs.decimals import texts
from slamgym.experiments.logs.ground_truth import hides_identities, without_identities
from slamgym.experiments.logs.slamlog import (
    LogError,
    OdometryRow,
    Scan,
    SlamLog,
    read_slamlog,
    write_slamlog,
)

TEXT = """# format: slamlog 1
# name: corner
# motion: midpoint
# start: 1,-2,0.5
# groundtruth_offset: 3.78,0.5
landmark,4,3,6
landmark,2,3,12
measurement,0,4,1.1,6.7
measurement,0,2,1.3,12.4

odometry,1,3,0.1,1
measurement,1,4,1.5,-0.2
odometry,1,0,0.2,0
measurement,1,4,1.2,5.9
measurement,2.5,,0.3,9,0.35
groundtruth,0,1,2,3
groundtruth,0.5,1,2,
"""
FINITE = st.floats(-1e100, 1e100)


def saved(folder, text):
    path = folder / "drive.csv"
    path.write_text(text)
    return path


def logged(*rows, header="# format: slamlog 1"):
    return "\n".join([header, *rows]) + "\n"


def assert_same_log(one, other):
    for name in ("name", "header", "motion"):
        assert getattr(one, name) == getattr(other, name)
    for name in ("start", "landmark_ids", "landmarks", "ground_truth"):
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name))
    assert len(one.events) == len(other.events)
    for a, b in zip(one.events, other.events, strict=True):
        assert type(a) is type(b)
        if isinstance(a, OdometryRow):
            assert a == b
        else:
            for name in ("t", "measurements", "landmark_ids", "sizes", "true_ids"):
                np.testing.assert_equal(getattr(a, name), getattr(b, name))


def test_header_is_parsed_and_its_other_keys_are_kept(tmp_path):
    log = read_slamlog(saved(tmp_path, TEXT))
    assert (log.name, log.motion) == ("corner", "midpoint")
    np.testing.assert_array_equal(log.start, [1, -2, 0.5])
    assert log.header == {"groundtruth_offset": "3.78,0.5"}


def test_a_bare_header_means_file_name_turn_last_and_origin(tmp_path):
    log = read_slamlog(saved(tmp_path, logged("odometry,1,3,0,1")))
    assert (log.name, log.motion, log.header) == ("drive", "turn-last", {})
    np.testing.assert_array_equal(log.start, np.zeros(3))


def test_landmarks_keep_the_order_of_the_file(tmp_path):
    log = read_slamlog(saved(tmp_path, TEXT))
    assert log.landmark_ids.tolist() == [4, 2]
    np.testing.assert_array_equal(log.landmarks, [[3, 6], [3, 12]])


def test_equal_times_are_one_scan_until_an_odometry_row_comes(tmp_path):
    events = read_slamlog(saved(tmp_path, TEXT)).events
    kinds = [len(e.measurements) if isinstance(e, Scan) else "u" for e in events]
    assert kinds == [2, "u", 1, "u", 1, 1]


def test_fields_land_in_their_places(tmp_path):
    first, row, *_, last = read_slamlog(saved(tmp_path, TEXT)).events
    np.testing.assert_array_equal(first.measurements, [[1.1, 6.7], [1.3, 12.4]])
    assert first.landmark_ids.tolist() == [4, 2]
    assert row == OdometryRow(t=1.0, d=3.0, alpha=0.1, dt=1.0)
    assert (last.t, last.landmark_ids, last.sizes.tolist()) == (2.5, None, [0.35])


def test_spaces_around_fields_and_the_largest_numbers_are_read(tmp_path):
    rows = "odometry , 1, 1e100,\t-1e100,1\nmeasurement,1, 5,0.5 , 1e100"
    row, scan = read_slamlog(saved(tmp_path, logged(rows))).events
    assert (row.d, row.alpha, row.dt) == (1e100, -1e100, 1.0)
    assert scan.landmark_ids.tolist() == [5]
    assert scan.measurements.tolist() == [[0.5, 1e100]]


def test_true_ids_stand_behind_the_size_and_are_no_ids(tmp_path):
    rows = "measurement,0,,0.1,5,,7", "measurement,0,,0.2,4,,-1"
    sized = "measurement,1,,0.1,5,0.3,7"
    path = saved(tmp_path, logged(*rows, "odometry,1,0,0,1", sized))
    log = read_slamlog(path)
    first, _, second = log.events
    assert first.landmark_ids is first.sizes is second.landmark_ids is None
    assert (first.true_ids.tolist(), second.true_ids.tolist()) == ([7, -1], [7])
    assert second.sizes.tolist() == [0.3]
    write_slamlog(log, tmp_path / "copy.csv")
    assert_same_log(read_slamlog(tmp_path / "copy.csv"), log)
    assert "measurement,0.0,,0.2,4.0,,-1" in (tmp_path / "copy.csv").read_text()


def test_a_file_written_before_true_ids_is_read_and_written_as_it_was(tmp_path):
    old = "measurement,0.0,4,1.1,6.7\nmeasurement,0.0,2,1.3,12.4\n"
    old += "odometry,1.0,3.0,0.1,1.0\nmeasurement,2.5,,0.3,9.0,0.35\n"
    header = "# format: slamlog 1\n# name: old\n# motion: turn-last\n"
    path = saved(tmp_path, header + "# start: 0.0,0.0,0.0\n" + old)
    log = read_slamlog(path)
    assert all(e.true_ids is None for e in log.events if isinstance(e, Scan))
    write_slamlog(log, tmp_path / "again.csv")
    assert (tmp_path / "again.csv").read_bytes() == path.read_bytes()


def test_hidden_identities_become_true_ids(tmp_path):
    log = read_slamlog(saved(tmp_path, TEXT))
    hidden = without_identities(log)
    assert hides_identities(hidden)
    assert hidden.header["identities"] == "false"
    for before, after in zip(log.events, hidden.events, strict=True):
        if isinstance(before, Scan):
            assert after.landmark_ids is None
            np.testing.assert_equal(after.true_ids, before.landmark_ids)
            np.testing.assert_array_equal(after.measurements, before.measurements)
        else:
            assert after is before


def test_texts_of_numbers_are_those_of_repr():
    rng = np.random.default_rng(0)
    two, ten = 2.0 ** np.arange(-20, 60), 10.0 ** np.arange(-6, 19)
    near = [np.nextafter(each, end) for each in (two, ten) for end in (0, np.inf)]
    whole = rng.integers(-(2**54), 2**54, 20_000).astype(float)
    drawn = rng.integers(-(2**63), 2**63 - 1, 5_000).view(np.float64)
    usual = rng.standard_normal(100_000) * 10.0 ** rng.integers(-5, 18, 100_000)
    short = np.round(usual[:20_000], 3)
    special = [0.0, -0.0, np.inf, -np.inf, 5e-324]
    for some in (two, ten, *near, whole, whole / 1024, drawn, usual, short, special):
        values = np.asarray(some)[~np.isnan(some)]
        assert texts(values) == [*map(repr, values.tolist())]
        assert texts(-values[::2]) == [*map(repr, (-values[::2]).tolist())]
    assert texts(np.array([1.0, np.nan])) == ["1.0", ""]


def test_unknown_true_heading_is_nan(tmp_path):
    truth = read_slamlog(saved(tmp_path, TEXT)).ground_truth
    np.testing.assert_array_equal(truth, [[0, 1, 2, 3], [0.5, 1, 2, math.nan]])


def test_windows_line_ends_and_byte_order_mark_change_nothing(tmp_path):
    plain = read_slamlog(saved(tmp_path, TEXT))
    path = tmp_path / "windows.csv"
    path.write_bytes(b"\xef\xbb\xbf" + TEXT.replace("\n", "\r\n").encode())
    assert_same_log(plain, read_slamlog(path))
    write_slamlog(plain, tmp_path / "copy.csv")  # reads back equal, too
    assert_same_log(plain, read_slamlog(tmp_path / "copy.csv"))


@given(numbers=st.tuples(*[FINITE] * 12), dt=st.floats(0, 1e100))
def test_every_float_survives_the_round_trip(tmp_path_factory, numbers, dt):
    t, d, alpha, bearing, distance, x, y, theta, *start, size = numbers
    log = SlamLog(
        name="any",
        start=np.array(start),
        landmark_ids=np.array([7]),
        landmarks=np.array([[x, y]]),
        events=(
            OdometryRow(np.float64(t), np.float64(d), alpha, dt),
            Scan(t, [[bearing, distance]], [7], [size]),
        ),
        ground_truth=np.array([[t, x, y, theta]]),
    )
    path = tmp_path_factory.getbasetemp() / "any.csv"
    write_slamlog(log, path)
    assert_same_log(log, read_slamlog(path))


@pytest.mark.parametrize(
    ("row", "message"),
    [
        ("odometry,1,east,0,1", "expected a finite number, got 'east'"),
        ("odometry,1,nan,0,1", "expected a finite number, got 'nan'"),
        ("odometry,1,1e999,0,1", "expected a finite number, got '1e999'"),
        ("odometry,1,1_0,0,1", "expected a finite number, got '1_0'"),
        ("odometry,1,3,0", "expected odometry,t,d,alpha,dt, got 3 fields"),
        ("odometry,1,3,0,-1", "expected dt >= 0, got -1.0"),
        ("odometry,0.5,3,0,1", "expected t >= 1.0, the time before, got 0.5"),
        ("measurement,0.5,1,0,1", "expected t >= 1.0, the time before, got 0.5"),
        ("measurement,1,0,0.1", "expected measurement,t,id,bearing,range"),
        ("measurement,1,0,0.1,2,3,4,5", "expected measurement,t,id,bearing,range"),
        ("measurement,1,6,0.1,2,,-2", "expected an id (a whole number >= 0 of"),
        ("measurement,1,6,0.1,2,", "expected a finite number, got ''"),
        ("measurement,1,6,0,2,,6", "expected true ids in all rows of a scan or in no"),
        ("measurement,1,-3,0.1,2", "expected an id (a whole number >= 0 of"),
        ("measurement,1,1.0,0.1,2", "expected an id (a whole number >= 0 of"),
        (f"measurement,1,{'9' * 30},0,2", "expected an id (a whole number >= 0 of at"),
        ("measurement,1,5,0,2", "expected each landmark once per scan, got id 5 again"),
        ("measurement,1,,0,2",
         "expected ids in all rows of a scan or in none, got both"),
        ("measurement,1,6,0,2,0.3", "expected sizes in all rows of a scan or in none"),
        ("landmark,9,1,2", "expected each landmark once, got id 9 again"),
        ("landmark,1,inf,2", "expected a finite number, got 'inf'"),
        ("groundtruth,0.5,1,2,3",
         "expected t >= 1.0, the ground truth before, got 0.5"),
        ("groundtruth,1,,2,3", "expected a finite number, got ''"),
        ("odometer,1,3,0,1", "expected a row of landmark, odometry, measurement"),
        ("# motion_std .1,.1,0", "expected # key: value, got '# motion_std .1,.1,0'"),
        ("# unit: m", "expected each key of the header once, got unit again"),
        ("# motion: arc", "expected turn-last, midpoint or a drive, got 'arc'"),
        ("# motion_std: 0.1,oops,0", "expected a finite number, got 'oops'"),
        ("# start: 0,0", "expected # start: x,y,theta, got 2 fields"),
        ("# start: 0,0,north", "expected a finite number, got 'north'"),
    ],
)  # fmt: skip
def test_a_wrong_row_is_named_with_file_line_and_reason(tmp_path, row, message):
    before = "# unit: mm\nlandmark,9,0,0\ngroundtruth,1,0,0,0\nodometry,1,3,0,1\n"
    path = saved(tmp_path, logged(before + "measurement,1,5,0.1,2", row))
    with pytest.raises(LogError) as caught:
        read_slamlog(path)
    assert str(caught.value).startswith(f"{path}, line 7: {message}")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "line 1: expected rows, got an empty file"),
        (b"\n \n", "line 1: expected rows, got an empty file"),
        (b"odometry,1,3,0,1\n", "line 1: expected # format: slamlog 1, got 'odometry"),
        (b"# format: slamlog 2\n", "line 1: expected # format: slamlog 1, got"),
        (b"# format: slamlog 1\nodometry\xff\n",
         "line 2: expected UTF-8 text, got byte"),
        (b"\x00\x01\x02\x03" * 50, r"line 1: expected # format: slamlog 1, got '\x00"),
    ],
)  # fmt: skip
def test_what_is_no_log_is_refused(tmp_path, content, message):
    path = tmp_path / "junk.csv"
    path.write_bytes(content)
    with pytest.raises(LogError) as caught:
        read_slamlog(path)
    assert f"{path}, {message}" in str(caught.value)
    assert len(str(caught.value)) < len(str(path)) + 150


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"events": (OdometryRow(1.0, math.nan, 0.0, 1.0),)},
         "expected a finite number"),
        ({"events": (Scan(1.0, [[0, 1]]), Scan(1.0, [[0, 2]]))},
         "scans must differ in t"),
        ({"header": {"name": "twice"}}, "expected each key of the header once"),
        ({"header": {"note": "two\nlines"}}, "expected a row of landmark"),
        ({"header": {"note": " margin"}}, "single lines without spaces at the ends"),
        ({"header": {"a:b": "c"}}, "single lines without spaces at the ends"),
        ({"motion": "arc"}, "expected turn-last, midpoint or a drive"),
    ],
)  # fmt: skip
def test_a_log_that_would_not_read_back_is_not_written(tmp_path, change, message):
    path = tmp_path / "bad.csv"
    with pytest.raises(LogError, match=message):
        write_slamlog(replace(SlamLog("bad"), **change), path)
    assert list(tmp_path.iterdir()) == []


def test_failure_while_writing_leaves_the_old_file_and_no_other(tmp_path, monkeypatch):
    path = saved(tmp_path, TEXT)

    def full_disk(_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full_disk)
    with pytest.raises(LogError, match=r"drive\.csv: cannot be written: No space left"):
        write_slamlog(SlamLog("new"), path)
    assert path.read_text() == TEXT
    assert list(tmp_path.iterdir()) == [path]


def test_writing_into_a_missing_folder_or_over_a_folder_is_refused(tmp_path):
    missing = r"new\.csv: cannot be written: the folder of .* does not exist"
    with pytest.raises(LogError, match=missing):
        write_slamlog(SlamLog("new"), tmp_path / "missing" / "new.csv")
    with pytest.raises(LogError, match="cannot be written: not a regular file"):
        write_slamlog(SlamLog("new"), tmp_path)


def test_writing_through_a_link_keeps_the_link(tmp_path):
    target, link = tmp_path / "target.csv", tmp_path / "link.csv"
    target.write_text("old")
    link.symlink_to(target)
    write_slamlog(SlamLog("new"), link)
    assert link.is_symlink()
    assert read_slamlog(target).name == "new"


def test_a_scan_without_readings_or_with_more_ids_than_readings_is_refused():
    with pytest.raises(ValueError, match="measurements must be m >= 1 rows"):
        Scan(1.0, np.empty((0, 2)))
    with pytest.raises(ValueError, match=r"landmark_ids must have one entry per"):
        Scan(1.0, [[0.1, 2.0]], [1, 2])


@pytest.mark.parametrize(
    ("name", "array"),
    [("start", np.zeros(2)), ("landmarks", np.zeros((1, 3))),
     ("landmark_ids", np.arange(2)), ("ground_truth", np.zeros((5, 3)))],
)  # fmt: skip
def test_a_log_of_wrong_shapes_is_refused(name, array):
    with pytest.raises(ValueError, match=f"{name} must"):
        SlamLog("odd", **{name: array})


@pytest.mark.slow
def test_public_logs_survive_the_round_trip(public_logs, tmp_path):
    for name in ("cmu16833", "freiburg9", "mrpt_kfslam_demo", "utias_d6_r3"):
        log = read_slamlog(public_logs / f"{name}.csv")
        write_slamlog(log, tmp_path / "copy.csv")
        assert_same_log(log, read_slamlog(tmp_path / "copy.csv"))


@pytest.mark.slow
def test_victoria_park_has_sizes_and_no_identities(public_logs):
    log = read_slamlog(public_logs / "victoria_park.csv")
    scans = [event for event in log.events if isinstance(event, Scan)]
    assert len(scans) == 7230
    assert sum(len(scan.measurements) for scan in scans) == 52974
    assert all(s.landmark_ids is None and s.sizes is not None for s in scans)
    assert np.isnan(log.ground_truth[:, 3]).all()


def test_texts_in_errors_are_cut_and_ids_have_18_digits():
    assert log_lines.shown("x" * 58) == f"'{'x' * 58}'"
    assert log_lines.shown("x" * 59) == f"'{'x' * 59}…"
    line = log_lines.LogLine("file", 3, "")
    assert line.to_id("9" * 18) == 10**18 - 1
    with pytest.raises(LogError, match="file, line 3: expected an id"):
        line.to_id("9" * 19)


def test_a_row_without_any_number_above_others_is_a_header():
    for text, rest in (
        ("x y\n1 a", ["1 a"]),
        ("x 1\n2 3", ["x 1", "2 3"]),
        ("x", ["x"]),
    ):
        lines = log_lines.content_of(log_lines.to_lines(text, "file"))
        assert [line.text for line in lines] == rest


def test_rows_that_are_not_all_plain_numbers_are_read_one_by_one():
    for other in "", " ", "-1e101 1", "1 1e101", "1 nan", "1 x":
        assert log_lines.plain_rows(["1 2", other]) is None
    assert log_lines.plain_rows(["1 2", "-1e100 1e100"])[1].tolist() == [-1e100, 1e100]


def test_a_device_and_other_text_than_utf_8_are_refused(tmp_path):
    with pytest.raises(LogError, match="/dev/null must be a file or a pipe, got a dev"):
        log_lines.read_text("/dev/null")
    (tmp_path / "log").write_bytes(b"\n\n\xff")
    with pytest.raises(LogError, match=r"log, line 3: .* got byte 0xff: save the file"):
        log_lines.read_text(tmp_path / "log")
