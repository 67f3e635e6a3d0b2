import math
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.io import savemat

from slamgym.experiments.logs.importers import read_log
from slamgym.experiments.logs.slamlog import LogError, OdometryRow, Scan, write_slamlog

COURSE_FIRST_SCAN = (
    "1.1072 6.7060 1.3257 12.3812 0.8520 10.6270 "
    "1.1071 15.6513 0.4995 12.5422 0.8289 16.2816"
)
FREIBURG = """ODOMETRY 0.1 2 -0.3
SENSOR 1 1.5 0.4
SENSOR 2 -0.03 3.3
ODOMETRY 0 1 0.2
SENSOR 1 1.4 -0.5
"""
ISAM = """ODOMETRY 0 1 1 0 0.5 100 0 0 500 0 500
LANDMARK 1 2 3 4 1.5 0 1.5
ODOMETRY 1 3 -2 1 -0.25 100 0 0 500 0 500
LANDMARK 3 2 0 -2 1.5 0 1.5
LANDMARK 3 4 -1 0 1.5 0 1.5
"""
EPOCH = 1248444187.5
UTIAS = {
    "Barcodes.dat": "# Subject # Barcode #\n 3 \t 41\n 6 \t 63\n 7 \t 81\n",
    "Landmark_Groundtruth.dat": "# comment\n6 1.5 -4 1e-4 1e-4\n7 2 3 1e-4 1e-4\n",
    "Robot3_Odometry.dat": (
        f"# comment\n{EPOCH:.3f} \t 0.5 \t 0.0\n{EPOCH + 0.15:.3f} 1.0 -0.2\n"
        f"{EPOCH + 0.15:.3f} 2.0 0.4\n{EPOCH + 0.45:.3f} 0 0\n"
    ),
    "Robot3_Measurement.dat": (
        f"# comment\n{EPOCH - 1:.3f} 63 1 0\n{EPOCH + 0.25:.3f} 63 7.05 -0.036\n"
        f"{EPOCH + 0.25:.3f} 41 2 0\n{EPOCH + 0.25:.3f} 81 7.2 4\n"
        f"{EPOCH + 0.3:.3f} 99 1 0\n{EPOCH + 0.3:.3f} 41 3 0\n{EPOCH + 9:.3f} 63 1 0\n"
    ),
    "Robot3_Groundtruth.dat": f"{EPOCH - 0.2:.3f} 1 2 3\n{EPOCH + 0.8:.3f} 2 2 -3\n",
}


@pytest.fixture
def file(tmp_path):
    def save(text, name="log.txt"):
        path = tmp_path / name
        path.write_text(text)
        return path

    return save


@pytest.fixture
def utias(tmp_path):
    for name, text in UTIAS.items():
        (tmp_path / name).write_text(text)
    return tmp_path


def rotated(angle):
    cos, sin = math.cos(angle), math.sin(angle)
    return np.array([(cos, -sin), (sin, cos)])


def odometry_rows(log):
    return [event for event in log.events if isinstance(event, OdometryRow)]


def scans(log):
    return [event for event in log.events if isinstance(event, Scan)]


def turn_last_pose(rows):
    x = y = heading = 0.0
    for row in rows:
        x, y = x + row.d * math.cos(heading), y + row.d * math.sin(heading)
        heading += row.alpha
    return x, y, heading


def assert_events_agree(ours, theirs, tolerance):
    assert [type(event) for event in ours] == [type(event) for event in theirs]
    for a, b in zip(ours, theirs, strict=True):
        if isinstance(a, OdometryRow):
            np.testing.assert_allclose(
                (a.t, a.d, a.alpha, a.dt), (b.t, b.d, b.alpha, b.dt), 0, tolerance
            )
        else:
            assert a.t == pytest.approx(b.t, abs=tolerance)
            np.testing.assert_array_equal(a.landmark_ids, b.landmark_ids)
            np.testing.assert_allclose(a.measurements, b.measurements, 0, tolerance)


# Course data.txt


def test_course_lines_alternate_between_readings_and_odometry(file):
    log = read_log(file("0.1\t2\t-0.3\t4\t\n3\t0.5\t\n0.2\t3\t-0.2\t5\t\n", "data.txt"))
    first, row, second = log.events
    assert (log.name, log.motion, first.t, second.t) == ("data", "turn-last", 0, 1)
    assert row == OdometryRow(t=1.0, d=3.0, alpha=0.5, dt=1.0)
    np.testing.assert_array_equal(first.measurements, [[0.1, 2], [-0.3, 4]])
    np.testing.assert_array_equal(second.measurements, [[0.2, 3], [-0.2, 5]])
    assert second.landmark_ids.tolist() == [0, 1]


def test_course_bearing_is_wrapped(file):
    (scan,) = read_log(file("3.5 2\n")).events
    assert scan.measurements[0, 0] == pytest.approx(3.5 - 2 * math.pi)


def test_course_readings_of_one_landmark_are_not_taken_for_odometry(file):
    log = read_log(file("0.1 2\n3 0.5\n0.2 3\n"))
    assert [type(event) for event in log.events] == [Scan, OdometryRow, Scan]


def test_published_ground_truth_is_attached_to_the_published_log(file):
    log = read_log(file(COURSE_FIRST_SCAN))
    np.testing.assert_array_equal(
        log.landmarks, [[3, 6], [3, 12], [7, 8], [7, 14], [11, 6], [11, 12]]
    )
    assert log.header["truth"] == "CMU 16-833 course, matched to the first scan"


@pytest.mark.parametrize(
    "scan",
    [
        COURSE_FIRST_SCAN.replace("6.7060", "7.8"),  # 1.1 m off
        COURSE_FIRST_SCAN.replace("1.1072", "-1.1072"),
        COURSE_FIRST_SCAN.rsplit(" ", 2)[0],
    ],
)
def test_published_ground_truth_is_not_guessed_for_another_world(file, scan):
    log = read_log(file(scan))
    assert log.landmarks.shape == (0, 2)
    assert log.header["truth"] == "none"


def test_world_file_beside_a_course_log_gives_its_truth(file):
    file("1 5 6\n0 3 4\n", "world.dat")
    log = read_log(file("0.1 2 -0.3 4\n"))
    assert log.landmark_ids.tolist() == [1, 0]
    np.testing.assert_array_equal(log.landmarks, [[5, 6], [3, 4]])
    assert log.header["truth"] == "world.dat"


def test_landmarks_of_the_caller_come_before_all_others(file):
    log = read_log(file(COURSE_FIRST_SCAN), landmarks=[[1, 2], [3, 4]])
    assert log.landmark_ids.tolist() == [0, 1]
    np.testing.assert_array_equal(log.landmarks, [[1, 2], [3, 4]])
    assert log.header["truth"] == "landmarks given by the caller"


@pytest.mark.parametrize(
    ("raw", "name", "tolerance"),
    [
        ("cmu16833/data.txt", "cmu16833", 0),
        ("freiburg/sensor_data.dat", "freiburg9", 5e-6),  # some ranges are negative
    ],
)
def test_a_public_log_equals_its_slamlog(public_logs, raw, name, tolerance):
    log = read_log(public_logs / "raw" / raw)
    reference = read_log(public_logs / f"{name}.csv")
    assert_events_agree(log.events, reference.events, tolerance=tolerance)
    for part in "landmark_ids", "landmarks", "start":
        np.testing.assert_array_equal(getattr(log, part), getattr(reference, part))


# Freiburg sensor.dat


def test_freiburg_step_is_a_turn_and_a_drive_with_turn(file):
    rows = odometry_rows(read_log(file(FREIBURG)))
    assert rows == [
        OdometryRow(t=1.0, d=0.0, alpha=0.1, dt=0.0),
        OdometryRow(t=1.0, d=2.0, alpha=-0.3, dt=1.0),
        OdometryRow(t=2.0, d=0.0, alpha=0.0, dt=0.0),
        OdometryRow(t=2.0, d=1.0, alpha=0.2, dt=1.0),
    ]


def test_freiburg_readings_put_range_first_and_are_wrapped(file):
    first, second = scans(read_log(file(FREIBURG)))
    assert (first.t, second.t) == (1, 2)
    assert first.landmark_ids.tolist() == [1, 2]
    np.testing.assert_allclose(
        first.measurements, [[0.4, 1.5], [3.3 - 2 * np.pi, -0.03]], atol=1e-15
    )


def test_freiburg_landmarks_come_from_the_world_file_beside(file):
    assert read_log(file(FREIBURG)).landmarks.shape == (0, 2)
    file("1 2 1\n2 0 4\n", "world.dat")
    log = read_log(file(FREIBURG))
    assert log.landmark_ids.tolist() == [1, 2]
    np.testing.assert_array_equal(log.landmarks, [[2, 1], [0, 4]])


def test_reading_before_the_first_odometry_is_at_time_zero(file):
    scan, *_ = read_log(file("SENSOR 1 1.5 0.4\nODOMETRY 0 1 0\n")).events
    assert scan.t == 0


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("0.1 2 0.3\n", "line 1: expected pairs of bearing and range, got 3 numbers"),
        ("0.1 2\n3 0 1\n", "line 2: expected odometry d α, got 3 fields"),
        ("0.1 2\n3 0\n0.1 2 0.2 3\n", "line 3: expected 1 pairs of bearing and range"),
        ("0.1 2\n\n3 east\n", "line 3: expected a finite number, got 'east'"),
        ("0.1 nan\n", "line 1: expected a finite number, got 'nan'"),
        ("SENSOR 1 2\n", "line 1: expected SENSOR id range bearing"),
        ("ODOMETRY 0 1 0\nSONAR 1 2 3\n",
         "line 2: expected ODOMETRY r1 t r2 or SENSOR"),
        ("SENSOR 1 2 0\nSENSOR 1 2 0\n",
         "line 2: expected each landmark once per scan"),
        ("ODOMETRY 0 inf 0\n", "line 1: expected a finite number, got 'inf'"),
        ("LANDMARK 3 7 1 1\n", "line 1: expected odometry"),
        ("EDGE2 0 1 1 0 0\nEDGE2 1 2 1 0 0\nEDGE2 2 0 -2 0 0\n",
         "line 3: expected readings of landmarks, as a"),
        ("", "expected rows, got an empty file"),
    ],
)  # fmt: skip
def test_a_wrong_line_of_a_log_is_named(file, text, message):
    with pytest.raises(LogError, match=message):
        read_log(file(text))


@pytest.mark.parametrize(
    ("log", "world", "message"),
    [
        (FREIBURG, "1 2\n", r"world.dat, line 1: expected id x y"),
        (FREIBURG, "1 2 3\n1 2 3\n", "world.dat, line 2: expected each landmark once"),
        ("0.1 2 -0.3 4\n", "1 5 6\n2 3 4\n", "expected landmarks 0 to 1 .* got 1, 2"),
    ],
)
def test_a_wrong_world_file_is_named(file, log, world, message):
    file(world, "world.dat")
    with pytest.raises(LogError, match=message):
        read_log(file(log))


@pytest.mark.parametrize(
    ("option", "message"),
    [
        ({"robot": 3}, "robot needs a UTIAS folder, but .*log.txt is none"),
        ({"noise_from_file": True}, "noise_from_file needs a graph"),
    ],
)
def test_an_option_of_another_format_is_refused(file, option, message):
    with pytest.raises(ValueError, match=message):
        read_log(file(FREIBURG), **option)


# iSAM and g2o


def test_isam_increments_compose_to_the_same_pose(file):
    x, y, heading = turn_last_pose(odometry_rows(read_log(file(ISAM))))
    expected = (
        1 - 2 * math.cos(0.5) - math.sin(0.5),
        -2 * math.sin(0.5) + math.cos(0.5),
        0.25,
    )
    np.testing.assert_allclose((x, y, heading), expected, atol=1e-15)


def test_isam_backward_increment_is_a_negative_distance(file):
    *_, turn, drive = odometry_rows(read_log(file(ISAM)))
    assert (turn.d, turn.dt, drive.dt) == (0, 0, 1)
    assert drive.d == pytest.approx(-math.sqrt(5))
    assert abs(turn.alpha) < math.pi / 2


def test_isam_poses_are_counted_anew_and_landmarks_keep_their_ids(file):
    log = read_log(file(ISAM))
    assert [row.t for row in odometry_rows(log)] == [1, 1, 2, 2]
    assert [(s.t, s.landmark_ids.tolist()) for s in scans(log)] == [
        (1, [2]),
        (2, [2, 4]),
    ]


def test_isam_landmark_becomes_bearing_and_range(file):
    first, second = scans(read_log(file(ISAM)))
    np.testing.assert_allclose(first.measurements, [[math.atan2(4, 3), 5]])
    np.testing.assert_allclose(second.measurements, [[-np.pi / 2, 2], [-np.pi, 1]])


def test_isam_readings_join_their_pose_wherever_they_stand(file):
    lines = ISAM.splitlines()
    ordered = read_log(file(ISAM)).events
    assert_events_agree(
        read_log(file("\n".join([*lines[::2], *lines[1::2]]))).events[:3],
        ordered[:3],
        0,
    )


def test_g2o_words_mean_the_same(file):
    g2o = ISAM.replace("ODOMETRY", "EDGE_SE2").replace("LANDMARK", "EDGE_SE2_XY")
    log = read_log(file("VERTEX_SE2 0 0 0 0\nFIX 0\n" + g2o))
    assert_events_agree(log.events, read_log(file(ISAM)).events, tolerance=0)


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("EDGE2 1 5 1 0 0 1 0 0 1 0 1",
         "expected odometry between the consecutive poses 3 and 5, got no such edge"),
        ("EDGE2 3 3 1 0 0", "expected odometry to a new pose, got to pose 3"),
        ("BR 3 7 1 2 3", r"expected BR i j bearing range \[σβ σr\]"),
        ("LANDMARK 9 4 1 0 1 0 1", "expected a pose of the odometry, got pose 9"),
        ("LANDMARK 3 4 1 0 1 0 1",
         "expected each landmark once per scan, got id 4 again"),
        ("LANDMARK 3 7 1", "expected LANDMARK i j x y"),
        ("EDGE_SE3 3 5 0 0 0", "expected ODOMETRY or EDGE_SE2 or"),
        ("LANDMARK 3 7 east 1", "expected a finite number, got 'east'"),
    ],
)  # fmt: skip
def test_wrong_isam_line_is_named(file, line, message):
    with pytest.raises(LogError, match=f"line 6: {message}"):
        read_log(file(ISAM + line + "\n"))


def turning_graph(rng, poses=9):
    """Return the lines of a drive with three landmarks, and of closures."""
    edges, readings = [], []
    for i in range(poses):
        dx, dy, turn = rng.normal(size=3)
        information = "100 0 0 100 0 900"
        if i + 1 < poses:
            edges.append(f"EDGE_SE2 {i} {i + 1} {dx} {dy} {turn} {information}")
        if i > 2:
            edges.append(f"EDGE_SE2 {i - 2} {i} {dy} {dx} {turn} {information}")
        readings += [
            f"EDGE_SE2_XY {i} {j} {rng.normal()} {rng.normal()} 9 0 9"
            for j in (20, 21, 22)
        ]
    return [f"VERTEX_SE2 {i} 0 0 0" for i in range(poses)], edges, readings


def test_a_shuffled_graph_is_the_same_drive_to_the_bit(file):
    rng = np.random.default_rng(0)
    lines = [line for part in turning_graph(rng) for line in part]
    first = read_log(file("\n".join(lines)), noise_from_file=True)
    assert first.header["left_out"] == "6 loop closures between poses"
    for _ in range(5):
        rng.shuffle(lines)
        again = read_log(file("\n".join(lines)), noise_from_file=True)
        assert again.header == first.header
        assert_events_agree(again.events, first.events, tolerance=0)


def test_loop_closures_may_lead_ahead_of_the_odometry(file):
    _, edges, readings = turning_graph(np.random.default_rng(1))
    drive = [edge for edge in edges if int(edge.split()[2]) == int(edge.split()[1]) + 1]
    closures = [edge for edge in edges if edge not in drive]
    ahead = read_log(file("\n".join([*closures, *drive, *readings])))
    assert_events_agree(
        ahead.events, read_log(file("\n".join([*drive, *readings]))).events, 0
    )


def test_a_reversed_edge_is_the_inverse_motion(file):
    turned = rotated(-0.5) @ (-1, -0.25)
    text = ISAM.replace("0 1 1 0 0.5", "0 1 1 0.25 0.5")
    back = f"1 0 {turned[0]!r} {turned[1]!r} -0.5".replace("np.float64", "")
    back = back.replace("(", "").replace(")", "")
    reversed_edge = text.replace("0 1 1 0.25 0.5", back)
    assert reversed_edge != text
    log = read_log(file(text))
    assert_events_agree(read_log(file(reversed_edge)).events, log.events, 1e-15)


@pytest.mark.parametrize(
    ("odometry", "closure"),
    [
        ("ODOMETRY 1 0 1 0 0", "EDGE2 0 1 2 0 0"),
        ("EDGE2 0 1 2 0 0", "EDGE2 1 0 1 0 0"),
        ("EDGE2 0 1 2 0 0 1 0 0 1 0 1", "EDGE2 0 1 1 0 0"),
    ],
)
def test_of_several_edges_the_odometry_does_not_depend_on_their_order(
    file, odometry, closure
):
    reading = "LANDMARK 1 2 3 4"
    alone = read_log(file(f"{odometry}\n{reading}")).events
    for lines in ([odometry, closure, reading], [closure, odometry, reading]):
        assert_events_agree(read_log(file("\n".join(lines))).events, alone, tolerance=0)


def test_odometry_whose_ids_do_not_grow_is_followed_from_line_to_line(file):
    falling = ISAM.replace("ODOMETRY 0 1", "ODOMETRY 9 1").replace("1 3 -2", "1 5 -2")
    log = read_log(file(falling.replace("LANDMARK 3", "LANDMARK 5")))
    assert_events_agree(log.events, read_log(file(ISAM)).events, tolerance=0)


def test_bearings_and_ranges_of_gtsam_are_those_of_positions(file):
    polar = ISAM.replace("LANDMARK 1 2 3 4 1.5 0 1.5", f"BR 1 2 {math.atan2(4, 3)} 5")
    log = read_log(file(polar))
    assert_events_agree(log.events, read_log(file(ISAM)).events, tolerance=0)


COMMENTED = {
    "course": "0.1 2 -0.3 4\n3 0.5\n0.2 3 -0.2 5\n",
    "freiburg": FREIBURG,
    "isam": ISAM,
    "slamlog": "# format: slamlog 1\nodometry,1,3,0,1\nmeasurement,1,4,0.1,2\n",
}


@pytest.mark.parametrize("name", COMMENTED)
@pytest.mark.parametrize(
    "change",
    [
        lambda text: "# recorded by hand, in the hall\n\n" + text,
        lambda text: text.replace("\n", "\n# later\n\n"),
        lambda text: "\ufeff" + text.replace("\n", "\r\n"),
        lambda text: text.replace("\n", "\r"),
        lambda text: text.encode("utf-16"),
    ],
    ids=["top", "later", "windows", "old mac", "utf-16"],
)
def test_comments_blank_lines_and_line_ends_change_nothing(file, name, change):
    log = read_log(file(COMMENTED[name]))
    changed = change(COMMENTED[name])
    path = file("")
    path.write_bytes(changed if isinstance(changed, bytes) else changed.encode())
    assert_events_agree(read_log(path).events, log.events, tolerance=0)


@pytest.mark.parametrize("name", ["course", "freiburg", "isam"])
def test_other_comments_and_a_row_of_names_change_nothing(file, name):
    text = COMMENTED[name]
    log = read_log(file("a b c d\n% later\n// and\n" + text.replace("\n", " # end\n")))
    assert_events_agree(log.events, read_log(file(text)).events, tolerance=0)


def test_comments_in_the_world_of_freiburg_change_nothing(file):
    file("# the world\nid x y\n1 0 2  # first\n\n# and\n3 4 5\n", "world.dat")
    log = read_log(file(FREIBURG))
    assert log.landmarks.tolist() == [[0, 2], [4, 5]]


def test_a_landmark_of_a_graph_that_no_edge_reads_is_named(tmp_path):
    path = tmp_path / "graph.g2o"
    path.write_text(
        "VERTEX_XY 2 3 1\nVERTEX_XY 3 4 1\n"
        "EDGE_SE2 0 1 1 0 0 100 0 0 100 0 1000\nEDGE_SE2_XY 0 2 3 1 50 0 50\n"
    )
    log = read_log(path)
    assert log.header["left_out"] == "landmark 3, which no edge reads"


@pytest.mark.parametrize(
    ("first", "edge", "last", "left_out"),
    [
        ("", "EDGE2", "EDGE2 3 0 9 9 9\nEDGE2 0 1 8 8 8\n", "2 loop closures between"),
        ("", "EDGE_SE2", "EDGE_SE2 3 0 9 9 9\n", "1 loop closures between poses"),
        ("EDGE2 1 0 9 9 9\n", "EDGE2", "", "1 loop closures between poses"),
        ("PARAMS_SE2OFFSET 0 0 0 0\nEDGE_PRIOR_SE2 0 1 2 3\n", "ODOMETRY", "",
         "1 measured poses"),
    ],
)  # fmt: skip
def test_loop_closures_and_measured_poses_are_left_out_and_counted(
    file, first, edge, last, left_out
):
    log = read_log(file(first + ISAM.replace("ODOMETRY", edge) + last))
    assert_events_agree(log.events, read_log(file(ISAM)).events, tolerance=0)
    assert log.header["left_out"].startswith(left_out)


@pytest.mark.parametrize("vertex", ["VERTEX2", "VERTEX_SE2"])
def test_true_poses_of_a_graph_are_taken_by_id(file, vertex):
    rows = ["3 5 6 0.5", "0 1 2 0.25", "1 3 4 -0.5"]
    text = "".join(f"{vertex} {row}\n" for row in rows) + "VERTEX_XY 2 7 8\n"
    log = read_log(file(ISAM), truth=file(text, "true.g2o"))
    expected = [(0, 1, 2, 0.25), (1, 3, 4, -0.5), (2, 5, 6, 0.5)]
    np.testing.assert_array_equal(log.ground_truth, expected)
    np.testing.assert_array_equal(log.start, (1, 2, 0.25))
    assert (log.landmark_ids.tolist(), log.landmarks.tolist()) == ([2], [[7, 8]])
    assert log.header["truth"] == "graph true.g2o"


def test_a_start_that_the_log_states_is_kept_beside_a_true_path(file, tmp_path):
    log, own = read_log(file(ISAM)), np.array([1.0, 2.0, 0.5])
    for name, start in (("own", own), ("none", np.zeros(3))):
        write_slamlog(replace(log, start=start), tmp_path / f"{name}.csv")
    poses = "timestamp,x,y,theta\n0,7,8,0.25\n1,7,8,0.25\n2,9,8,0.25\n"
    truth = file(poses, "truth.csv")
    kept, taken = (
        read_log(tmp_path / f"{n}.csv", truth=truth) for n in ("own", "none")
    )
    np.testing.assert_array_equal(kept.start, own)
    np.testing.assert_array_equal(taken.start, (7, 8, 0.25))


def test_true_poses_follow_from_exact_edges(file):
    exact = (
        f"EDGE2 0 1 2 0 {math.pi / 2}\nLANDMARK 1 2 1 2\nEDGE2 1 3 -3 1 0\n"
        "LANDMARK 3 2 4 1\nLANDMARK 0 4 -4 -3\n"
    )
    log = read_log(file(ISAM), truth=file(exact, "true.txt"))
    expected = [(0, 0, 0, 0), (1, 2, 0, np.pi / 2), (2, 1, -3, np.pi / 2)]
    np.testing.assert_allclose(log.ground_truth, expected, atol=1e-15)
    assert log.landmark_ids.tolist() == [2, 4]
    np.testing.assert_allclose(log.landmarks, [(0, 1), (-4, -3)], atol=1e-15)


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        ("01", "true.txt: expected the true poses of the 3 poses of the log, got 2"),
        ("0123", "true.txt: expected the true poses of the 3 poses of the log, got 4"),
        ("012", "true.txt: expected the poses of the log, found no pose 3"),
    ],
)
def test_truth_of_other_poses_is_refused(file, rows, message):
    truth = file("".join(f"VERTEX2 {row} 0 0 0\n" for row in rows), "true.txt")
    with pytest.raises(LogError, match=message):
        read_log(file(ISAM), truth=truth)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("0 1 2", "expected ODOMETRY or EDGE_SE2 or EDGE2 or"),
        ("VERTEX2 3 1 0", "expected VERTEX2 i x y θ"),
        ("VERTEX_XY 3 1", "expected VERTEX_XY i x y"),
        ("VERTEX2 0 1 2 3", "expected each vertex once, got VERTEX2 0 again"),
    ],
)
def test_wrong_line_of_the_truth_is_named(file, text, message):
    truth = file(f"VERTEX2 0 0 0 0\n{text}\n", "true.txt")
    with pytest.raises(LogError, match=f"true.txt, line 2: {message}"):
        read_log(file(ISAM), truth=truth)


TORO = (
    "VERTEX2 0 0 0 0\nEDGE2 0 1 0 1 0.5 400 0 2500 10000 0 0\n"
    "LANDMARK 1 2 3 4 10 0 10\n"
)
NOISE_OF_INFORMATION = [
    # iSAM: the square root of the information, in the frame of the first pose
    ("ODOMETRY 0 1 1 0 0.5 50 0 0 20 0 100\nLANDMARK 1 2 3 4 10 0 10\n"),
    ("EDGE2 0 1 1 0 0.5 50 0 0 20 0 100\nLANDMARK 1 2 3 4 10 0 10\n"),
    # TORO: information in another order, for a turn of the drive by 90°
    TORO,
    TORO.replace(" ", "\t"),
    # the same drive as a reversed edge, in the frame of its own second pose
    "EDGE_SE2 1 0 0 1 -1.5707963267948966 2500 0 0 400 0 10000\n"
    f"BR 1 2 {math.atan2(4, 3)} 5 0.02 0.1\n",
    # g2o: information in the frame of the second pose
    f"EDGE_SE2 0 1 1 0 {math.pi / 2} 400 0 0 2500 0 10000\n"
    "EDGE_SE2_XY 1 2 3 4 100 0 100\n",
]


def numbers(text):
    return [float(number) for number in text.split(",")]


@pytest.mark.parametrize("text", NOISE_OF_INFORMATION)
def test_noise_is_that_of_the_information_matrices(file, text):
    header = read_log(file(text), noise_from_file=True).header
    assert numbers(header["motion_std"]) == pytest.approx((0.02, 0.05, 0.01))
    assert numbers(header["measurement_std"]) == pytest.approx((0.1 / 5, 0.1))
    assert header["noise"] == "from the file, by its information matrices"


def test_noise_of_correlated_errors_is_that_along_and_across(file):
    turned = rotated(math.atan2(4, 3))
    covariance = turned @ np.diag([0.3**2, 0.1**2]) @ turned.T
    xx, xy, _, yy = np.linalg.inv(covariance).ravel()
    sighted = f"EDGE_SE2_XY 1 2 3 4 {xx} {xy} {yy}\n"
    edge = "EDGE_SE2 0 1 1 0 0 1 0 0 1 0 1\n"
    header = read_log(file(edge + sighted), noise_from_file=True).header
    assert numbers(header["measurement_std"]) == pytest.approx((0.1 / 5, 0.3))


def test_square_roots_of_information_are_upper_triangular(file):
    # R = [2 3; 0 4], so that (Rᵀ R)⁻¹ = [25/64 -3/32; -3/32 1/16]
    text = "EDGE2 0 1 1 0 0 1 0 0 1 0 1\nLANDMARK 1 2 5 0 2 3 4\n"
    header = read_log(file(text), noise_from_file=True).header
    assert numbers(header["measurement_std"]) == pytest.approx((1 / 4 / 5, 5 / 8))


def test_noise_of_positions_becomes_bearing_noise_in_metres(file):
    far = ISAM.replace("LANDMARK 3 4 -1 0", "LANDMARK 3 4 -9 0")
    header = read_log(file(far), noise_from_file=True).header
    assert numbers(header["measurement_std"]) == pytest.approx((0, 1 / 1.5))
    assert float(header["bearing_std_metres"]) == pytest.approx(1 / 1.5)


def test_bearing_noise_that_falls_with_the_range_is_in_metres(file):
    near, far = "BR 1 2 0.1 2 0.25 0.3\n", "BR 1 3 0.2 10 0.05 0.3\n"
    text = f"EDGE_SE2 0 1 1 0 0 1 0 0 1 0 1\n{near}{far}"
    header = read_log(file(text), noise_from_file=True).header
    assert numbers(header["measurement_std"]) == pytest.approx((0, 0.3))
    assert float(header["bearing_std_metres"]) == pytest.approx(0.5)


def test_noise_of_differing_information_is_the_median(file):
    edges = [
        f"ODOMETRY {k} {k + 1} 1 0 0 {w} 0 0 {w} 0 100\n"
        for k, w in enumerate((50, 10, 20))
    ]
    header = read_log(file("".join(edges)), noise_from_file=True).header
    assert header["motion_std"] == "0.05,0.05,0.01"
    assert "measurement_std" not in header
    assert header["noise"].startswith("from the file, by the medians of its differing")


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("ODOMETRY 3 5 1 0 0", "expected information at the end of the line, got none"),
        ("EDGE_SE2 3 5 1 0 0 1 2 0 1 0 1", "expected positive definite information"),
        ("ODOMETRY 3 5 1 0 0 1 0 0 1 0 0", "expected positive definite information"),
        ("ODOMETRY 3 5 1 0 0 2e154 0 0 1 0 1", r"expected a number up to 1e\+100"),
        ("LANDMARK 3 7 0 0 1 0 1", "expected a landmark away from its pose"),
    ],
)
def test_noise_that_a_line_does_not_specify_is_refused(file, line, message):
    with pytest.raises(LogError, match=f"line 6: {message}"):
        read_log(file(f"{ISAM}{line}\n"), noise_from_file=True)


def test_public_isam_sample_has_all_its_lines(public_logs):
    log = read_log(public_logs / "raw" / "isam" / "victoria_park_first400.txt")
    assert len(odometry_rows(log)) == 2 * 237
    assert sum(len(scan.measurements) for scan in scans(log)) == 163
    assert log.events[-1].t == 237


# UTIAS MR.CLAM


def test_utias_velocities_are_held_between_their_stamps(utias):
    rows = odometry_rows(read_log(utias))
    assert [row.t for row in rows] == [0, 0.1, 0.2, 0.25, 0.3, 0.4, 0.45]
    np.testing.assert_allclose(
        [row.dt for row in rows], [0, 0.1, 0.1, 0.05, 0.05, 0.1, 0.05], atol=1e-12
    )
    distances = [0, 0.05, 0.025 + 0.1, 0.1, 0.1, 0.2, 0.1]
    np.testing.assert_allclose([row.d for row in rows], distances, atol=1e-12)
    turns = [0, 0, 0.02, 0.02, 0.02, 0.04, 0.02]
    np.testing.assert_allclose([row.alpha for row in rows], turns, atol=1e-12)


def test_utias_scan_follows_the_odometry_of_its_time(utias):
    events = read_log(utias).events
    (k,) = (k for k, event in enumerate(events) if isinstance(event, Scan))
    assert events[k].t == events[k - 1].t == 0.25


def test_utias_barcodes_become_subjects_and_bearings_are_wrapped(utias):
    (scan,) = scans(read_log(utias))
    assert scan.landmark_ids.tolist() == [6, 7]
    np.testing.assert_allclose(
        scan.measurements, [[-0.036, 7.05], [4 - 2 * np.pi, 7.2]], atol=1e-15
    )


def test_utias_readings_at_the_first_odometry_are_kept(utias):
    file = utias / "Robot3_Measurement.dat"
    comment, before, *rows = file.read_text().splitlines()
    rows = [comment, before, f"{EPOCH:.3f} 63 2.5 0.1", *rows]
    file.write_text("\n".join(rows))
    first, _ = scans(read_log(utias))
    assert (first.t, first.measurements.tolist()) == (0.0, [[0.1, 2.5]])


def test_utias_counts_what_it_leaves_out(utias):
    assert read_log(utias).header["left_out"] == (
        "2 readings of robots, 1 of unknown barcodes, "
        "2 outside the time of the odometry"
    )


def test_utias_truth_is_interpolated_across_the_jump_of_the_heading(utias):
    log = read_log(utias)
    turned = 2 * math.pi - 6  # from 3 to -3 within the second from t = -0.2
    np.testing.assert_allclose(log.start, [1.2, 2, 3 + 0.2 * turned], atol=1e-6)
    np.testing.assert_allclose(log.ground_truth[:, 0], [0, 0.2, 0.4], atol=1e-12)
    np.testing.assert_allclose(log.ground_truth[:, 1], [1.2, 1.4, 1.6], atol=1e-6)
    assert log.motion == "midpoint"


def test_utias_landmarks_are_those_of_the_folder(utias):
    log = read_log(utias)
    assert log.landmark_ids.tolist() == [6, 7]
    np.testing.assert_array_equal(log.landmarks, [[1.5, -4], [2, 3]])
    write_slamlog(log, utias / "kept.csv")  # a folder can be kept, too
    assert_events_agree(read_log(utias / "kept.csv").events, log.events, tolerance=0)


def test_utias_without_truth_starts_at_the_origin_and_says_so(utias):
    (utias / "Robot3_Groundtruth.dat").unlink()
    log = read_log(utias)
    np.testing.assert_array_equal(log.start, np.zeros(3))
    assert log.ground_truth.shape == (0, 4)
    assert "origin" in log.header["start_from"]


def test_utias_robot_can_be_chosen_and_the_lowest_is_the_default(utias):
    for name in ("Odometry", "Measurement"):
        text = (utias / f"Robot3_{name}.dat").read_text()
        (utias / f"Robot5_{name}.dat").write_text(text)
    assert read_log(utias).name.endswith("_r3")
    assert read_log(utias, robot=5).name.endswith("_r5")
    with pytest.raises(LogError, match="expected one of the robots 3, 5, got 4"):
        read_log(utias, robot=4)


@pytest.mark.parametrize("name", sorted(set(UTIAS) - {"Robot3_Groundtruth.dat"}))
def test_missing_utias_file_is_named(utias, name):
    (utias / name).unlink()
    expected = rf"expected {name}, got no such file"
    if name == "Robot3_Odometry.dat":
        expected = r"with Robot<k>_Odometry\.dat .* got another folder"
    with pytest.raises(LogError, match=expected):
        read_log(utias)


@pytest.mark.parametrize(
    ("name", "line", "message"),
    [
        ("Robot3_Odometry.dat", "1 0 0",
         "line 6: expected t >= 1248444187.95, the time"),
        ("Robot3_Odometry.dat", "1 0", "line 6: expected t v ω, got 2 fields"),
        ("Robot3_Measurement.dat", f"{EPOCH + 0.1} 63 1 0",
         "line 9: expected t >= 1248444196.5, the"),
        ("Robot3_Measurement.dat", f"{EPOCH + 10} code 1 0", "line 9: expected an id"),
        ("Barcodes.dat", "8 x", "line 5: expected an id"),
        ("Landmark_Groundtruth.dat", "8 1 2", "line 4: expected subject x y σx σy"),
        ("Robot3_Groundtruth.dat", "2e9 2 3 nan", "line 3: expected a finite number"),
    ],
)  # fmt: skip
def test_wrong_utias_line_is_named(utias, name, line, message):
    path = utias / name
    path.write_text(path.read_text() + line + "\n")
    with pytest.raises(LogError, match=f"{name}, {message}"):
        read_log(utias)


@pytest.mark.slow
def test_public_utias_log_equals_its_slamlog(public_logs):
    end = 89.9  # the sample holds 90 s
    log = read_log(public_logs / "raw" / "utias_d6")
    reference = read_log(public_logs / "utias_d6_r3.csv")
    ours = [event for event in log.events if event.t <= end]
    first, *others = [event for event in reference.events if event.t <= end]
    # The grid of the reference runs 1e-6 fast: a scan on the grid leaves a rest.
    others = [e for e in others if isinstance(e, Scan) or e.dt > 1.5e-4]
    assert len(ours) > 1300
    assert_events_agree(ours, [first, *others], tolerance=1.5e-4)
    np.testing.assert_allclose(log.start, reference.start, atol=1e-5)
    np.testing.assert_allclose(log.landmarks, reference.landmarks, atol=1e-5)
    np.testing.assert_allclose(
        log.ground_truth, reference.ground_truth[: len(log.ground_truth)], atol=1e-4
    )


# Telling the formats apart


def test_slamlog_is_recognised(file):
    log = read_log(file("# format: slamlog 1\nodometry,1,3,0,1\n", "drive.csv"))
    assert log.events == (OdometryRow(1.0, 3.0, 0.0, 1.0),)


@pytest.mark.parametrize(
    "text",
    [COURSE_FIRST_SCAN + "\n3 0\n", FREIBURG, ISAM],
    ids=["course", "frei", "isam"],
)
def test_an_imported_log_can_be_kept_as_slamlog(file, tmp_path, text):
    log = read_log(file(text))
    write_slamlog(log, tmp_path / "kept.csv")
    kept = read_log(tmp_path / "kept.csv")
    assert_events_agree(kept.events, log.events, tolerance=0)
    assert kept.header == log.header


@pytest.mark.parametrize("text", ["hello world\n", "{}\n", "\x00\x01\n", "1.0 two\n"])
def test_what_is_no_log_is_refused_with_the_known_formats(file, text):
    with pytest.raises(LogError, match=r"line 1: .*; the nearest formats are .* and "):
        read_log(file(text))


def test_another_folder_and_a_missing_file_are_refused(tmp_path):
    expected = r"expected a log, or a folder with Robot<k>_.* got another folder"
    with pytest.raises(LogError, match=f"{expected}$"):
        read_log(tmp_path)
    (tmp_path / "log.csv").touch()  # the folder of a run
    with pytest.raises(LogError, match=rf"{expected}; did you mean .*log\.csv\?$"):
        read_log(tmp_path)
    with pytest.raises(FileNotFoundError, match=r"nowhere\.csv"):
        read_log(tmp_path / "nowhere.csv")


# --------------------------------------------------------------------------------------
# Victoria Park by its own drive.

PARK = Path(os.environ.get("SLAMGYM_DATA") or ".")


def write_park(folder, at=2.0, steered=0.3, **changes):
    """Write a drive of 2 s at constant speed and steering, and one tree."""
    time = np.arange(20967, 22968, 25)
    drive = {
        "time": time[:, None],
        "speed": np.full((len(time), 1), at),
        "steering": np.full((len(time), 1), steered),
    }
    gps = {
        "timeGps": [[20967], [22000]],
        "Lo_m": [[1.0], [2.0]],
        "La_m": [[3.0], [5.0]],
    }
    folder.mkdir(exist_ok=True)
    savemat(folder / "aa3_dr.mat", drive | changes)
    savemat(folder / "aa3_gpsx.mat", gps)
    (folder / "victoria_park.csv").write_text(
        "# format: slamlog 1\nodometry,0.5,9,9,0.5\nmeasurement,0.512,,0.1,7\n"
        "measurement,9,,0.1,7\n"
    )
    return folder


def test_the_car_of_victoria_park_drives_a_circle_about_its_rear_axle(tmp_path):
    """The encoder is on the left rear wheel, which turns on another radius."""
    log = read_log(write_park(tmp_path / "park"))
    rows = [event for event in log.events if isinstance(event, OdometryRow)]
    assert [event.t for event in log.scans] == [0.512]
    assert log.header["left_out"].startswith("1 scan")
    x = y = heading = 0.0
    for row in rows:  # chords of the circle
        x += row.d * math.cos(heading + row.alpha / 2)
        y += row.d * math.sin(heading + row.alpha / 2)
        heading += row.alpha
    radius = 2.83 / math.tan(0.3)  # of the middle of the axle, turning left
    turned = 2.0 * 2.0 / (radius - 0.76)  # the left wheel runs inside
    assert heading == pytest.approx(turned, rel=1e-12)
    assert (x, y) == pytest.approx(
        (radius * math.sin(turned), radius * (1 - math.cos(turned))), rel=1e-9
    )
    assert sum(row.dt for row in rows) == pytest.approx(2.0)
    assert log.ground_truth[:, :3].tolist() == [[0, 1, 3], [1.033, 2, 5]]
    before = [row for row in rows if row.t <= 0.512]
    assert before[-1].t == 0.512
    assert sum(row.alpha for row in before) == pytest.approx(turned * 0.512 / 2)


def test_a_car_that_stands_or_backs_does_so(tmp_path):
    twice = np.arange(20967, 22968, 25)[:, None] // 50 * 50  # each time
    still = read_log(write_park(tmp_path / "still", 0.0, 0.78, time=twice))
    assert all(e.d == 0 for e in still.events if isinstance(e, OdometryRow))
    back = read_log(write_park(tmp_path / "back", at=-1.0, steered=0.0))
    driven = sum(e.d for e in back.events if isinstance(e, OdometryRow))
    assert driven == pytest.approx(-2.0)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"speed": np.ones((3, 1))}, "equal length"),
        ({"steering": np.full((81, 1), np.nan)}, "finite numbers in steering"),
        ({"steering": np.full((81, 1), -0.79)}, "steering within"),
        ({"time": np.append(np.arange(20967, 22967, 25), 20967)}, "never decreases"),
    ],
)
def test_a_damaged_drive_of_victoria_park_is_named(tmp_path, changes, message):
    with pytest.raises(LogError, match=message):
        read_log(write_park(tmp_path / "park", **changes))


@pytest.mark.parametrize("name", ["aa3_gpsx.mat", "victoria_park.csv"])
def test_a_missing_file_of_victoria_park_is_named(tmp_path, name):
    folder = write_park(tmp_path / "park")
    (folder / name).unlink()
    with pytest.raises(LogError, match=name):
        read_log(folder)


def test_a_file_that_is_no_matlab_file_is_named(tmp_path):
    folder = write_park(tmp_path / "park")
    (folder / "aa3_dr.mat").write_text("speed")
    with pytest.raises(LogError, match="MATLAB"):
        read_log(folder)


@pytest.mark.skipif(
    not (PARK / "raw" / "victoria_park").is_dir(),
    reason="SLAMGYM_DATA names no folder with raw/victoria_park",
)
def test_the_drive_of_victoria_park_is_that_of_the_converted_log(tmp_path):
    for file in (PARK / "raw" / "victoria_park").iterdir():
        (tmp_path / file.name).symlink_to(file)
    (tmp_path / "victoria_park.csv").symlink_to(PARK / "victoria_park.csv")
    own, converted = read_log(tmp_path), read_log(PARK / "victoria_park.csv")
    assert len(own.scans) == len(converted.scans) == 7230
    paths = []
    for log in (own, converted):
        rows = [event for event in log.events if isinstance(event, OdometryRow)]
        t, d, alpha = np.array([(row.t, row.d, row.alpha) for row in rows]).T
        heading = np.cumsum(alpha)
        steps = d * np.exp(1j * (heading - alpha / 2))
        paths.append((t, np.cumsum(steps), heading))
    at = np.arange(0, 1500, 10.0)
    one, other = (np.interp(at, t, path) for t, path, _ in paths)
    assert np.abs(one - other).max() < 1.0  # of 4 km
    assert abs(paths[0][2][-1] - paths[1][2][-1]) < 1e-3
