"""Files as other people have them: read, or refused with the remedy."""

import json
import math
from pathlib import Path

import numpy as np
import pytest
from commands import slamgym
from scipy.spatial.transform import Rotation

from slamgym import read_log
from slamgym.estimator.models import predict_pose
from slamgym.experiments.estimate_files import true_path
from slamgym.experiments.logs.slamlog import LogError, OdometryRow, Scan, write_slamlog

ODOMETRY = "t,d,alpha\n1,1,0\n2,1,0.5\n3,2,0\n"
MEASUREMENTS = "t,id,bearing,range\n0,4,0.1,5\n1,4,0.1,4\n1,7,-0.2,3\n3,7,0,1\n"
TRUTH = "t,x,y,theta\n0,5,6,0.25\n1,6,6,0.25\n2,7,6,0.75\n3,8,8,0.75\n"


@pytest.fixture
def folder(tmp_path):
    def save(**texts):
        place = tmp_path / "drive"
        place.mkdir(exist_ok=True)
        for name, text in texts.items():
            (place / f"{name}.csv").write_text(text, encoding="utf-8")
        return place

    return save


@pytest.fixture
def file(tmp_path):
    def save(text, name="file.txt"):
        (tmp_path / name).write_text(text, encoding="utf-8")
        return tmp_path / name

    return save


def own(folder, **changes):
    return read_log(
        folder(**{"odometry": ODOMETRY, "measurements": MEASUREMENTS} | changes)
    )


def stamped(text, name, time):
    """Give a table other stamps, and their column another name."""
    head, *rows = (line.split(",") for line in text.split())
    rows = [[time(float(t)), *others] for t, *others in rows]
    return "\n".join(map(",".join, [[name, *head[1:]], *rows])) + "\n"


def events_of(log):
    return [
        (e.t, e.d, e.alpha, e.dt)
        if isinstance(e, OdometryRow)
        else (e.t, e.landmark_ids.tolist(), e.measurements.tolist())
        for e in log.events
    ]


# csv files with named columns


def test_a_folder_of_two_tables_is_a_log(folder):
    log = own(folder)
    assert (log.name, log.motion, log.start.tolist()) == ("drive", "turn-last", [0] * 3)
    assert events_of(log) == [
        (0, [4], [[0.1, 5]]),
        (1, 1, 0, 1),
        (1, [4, 7], [[0.1, 4], [-0.2, 3]]),
        (2, 1, 0.5, 1),
        (3, 2, 0, 1),
        (3, [7], [[0, 1]]),
    ]


@pytest.mark.parametrize(
    ("odometry", "measurements"),
    [
        ("Time;Dist;Turn\n1;1,0;0\n2;1;0,5\n3;2;0\n", MEASUREMENTS),
        ("time [s],distance [cm],dtheta [deg]\n1,100,0\n"
         f"2,100,{math.degrees(0.5)!r}\n3,200,0\n", MEASUREMENTS),
        ("step\tds\tdyaw\n1\t1\t0\n2\t1\t.5\n3\t2\t0\n", MEASUREMENTS),
        ("# t d alpha\n1 1 0\n2 1 0.5\n3 2 0\n", MEASUREMENTS),
        ('"t","d","alpha","battery"\n1,1,0,9\n2,1,0.5,9\n3,2,0,9\n', MEASUREMENTS),
        (ODOMETRY, "Timestamp,Range_mm,Phi,landmark_id\n0,5000,.1,4\n1,4000,.1,4.0\n"
         "1,3000,-.2,7.0\n3,1000,0,7\n"),
        (ODOMETRY, MEASUREMENTS + "2,,,\n2,7,NaN,nan\n"),
        (ODOMETRY, "t,id,bearing,range\n3,7,0,1\n1,4,.1,4\n1,7,-.2,3\n0,4,.1,5\n"),
        (ODOMETRY, MEASUREMENTS.replace("\n", "  # seen\n").replace("range  #", "r #")),
    ],
    ids=["names", "units", "tabs", "comment", "quotes", "order", "empty", "late", "#"],
)  # fmt: skip
def test_other_spellings_of_the_tables_are_the_same_log(folder, odometry, measurements):
    log = own(folder)
    texts = {"odometry": odometry, "measurements": measurements}
    for ours, theirs in zip(own(folder, **texts).events, log.events, strict=True):
        assert type(ours) is type(theirs)
        if isinstance(ours, Scan):
            np.testing.assert_allclose(ours.measurements, theirs.measurements)
            assert ours.landmark_ids.tolist() == theirs.landmark_ids.tolist()
        else:
            expected = (theirs.t, theirs.d, theirs.alpha, theirs.dt)
            assert (ours.t, ours.d, ours.alpha, ours.dt) == pytest.approx(expected)


@pytest.mark.parametrize(
    ("names", "units"),
    [
        ("omega_deg_s;time;v", (math.pi / 180, 1)),
        ("yaw_rate (deg/sec);stamp;speed_mm_s", (math.pi / 180, 1e-3)),
        ("w_dps;t;v [cm per second]", (math.pi / 180, 1e-2)),
        ("twist.angular.z [mrad/s];t;v_kmh", (1e-3, 1 / 3.6)),
    ],
)
def test_units_of_velocities_are_understood_in_more_spellings(folder, names, units):
    rows = [(0.4, 0, 1.0), (0.2, 1, 2.0), (0, 2, 0)]
    turn, drive = units
    lines = [f"{w / turn!r};{t};{v / drive!r}" for w, t, v in rows]
    log = own(folder, odometry="\n".join([names, *lines]) + "\n")
    ours = own(folder, odometry="t,v,omega\n0,1,.4\n1,2,.2\n2,0,0\n")
    for event, same in zip(log.events, ours.events, strict=True):
        if not isinstance(event, Scan):
            assert (event.d, event.alpha) == pytest.approx((same.d, same.alpha))


def test_two_tables_of_one_kind_are_refused(folder):
    with pytest.raises(LogError, match=r"one file with odometry, got odom.csv and odo"):
        own(folder, odom=ODOMETRY)


def test_one_table_may_hold_both(file):
    text = (
        "t,d,alpha,id,bearing,range\n0,,,4,0.1,5\n1,1,0,4,0.1,4\n1,,,7,-0.2,3\n"
        "2,1,0.5,,,\n3,2,0,7,0,1\n"
    )
    assert [e[0] for e in events_of(read_log(file(text, "all.csv")))] == [
        0, 1, 1, 2, 3, 3,
    ]  # fmt: skip


def test_truth_and_landmarks_are_read_and_the_log_starts_at_the_truth(folder):
    log = own(folder, groundtruth=TRUTH, landmarks="id,x,y\n7,1,2\n4,3,4\n")
    assert log.start.tolist() == [5, 6, 0.25]
    assert log.ground_truth.tolist()[1] == [1, 6, 6, 0.25]
    assert log.landmark_ids.tolist() == [7, 4]
    assert log.header["truth"] == "groundtruth.csv"


def test_velocities_hold_until_the_next_row_and_are_split_at_readings(folder):
    odometry = "t,v,omega\n0,2,0.5\n2,1,0\n3,0,0\n"
    readings = "t,id,bearing,range\n0.5,1,0,4\n3,1,0,2\n"
    log = own(folder, odometry=odometry, measurements=readings)
    assert log.motion == "midpoint"
    assert [e for e in events_of(log) if len(e) == 4] == [
        (0.5, 1, 0.25, 0.5),
        (2, 3, 0.75, 1.5),
        (3, 1, 0, 1),
    ]


def test_increments_with_a_part_to_the_left_turn_drive_and_turn(folder):
    log = own(folder, odometry="t,dx,dy,dtheta\n1,-1,2,0.5\n3,0,0,0\n")
    turn, drive = [e for e in log.events if isinstance(e, OdometryRow)][:2]
    assert (turn.d, turn.dt, drive.dt) == (0, 0, 2)  # the first lasts as the second
    assert turn.alpha == pytest.approx(math.atan2(-2, 1))
    assert drive.d == pytest.approx(-math.sqrt(5))
    assert turn.alpha + drive.alpha == pytest.approx(0.5)


def test_the_durations_of_motions_are_those_of_their_column(folder):
    head, *rows = ODOMETRY.split()
    timed = [f"{head},dt", *(f"{row},{k}" for k, row in enumerate(rows, 1))]
    events = own(folder, odometry="\n".join([*timed, ""])).events
    durations = [event.dt for event in events if isinstance(event, OdometryRow)]
    assert sum(durations) == sum(range(len(rows) + 1))


def test_the_first_increment_is_not_divided_by_earlier_readings(folder):
    odometry = "t,d,alpha\n0.1,1,0.5\n0.2,1,0\n0.3,1,0\n"
    readings = "t,id,bearing,range\n0,4,0.1,5\n0.1,4,0.1,5\n"
    log = own(folder, odometry=odometry, measurements=readings)
    assert [e[0] for e in events_of(log)] == [0, 0.1, 0.1, 0.2, 0.3]
    assert log.events[1].dt == pytest.approx(0.1)
    assert "left_out" not in log.header


@pytest.mark.parametrize(
    ("first", "begin", "known"),
    [("1,1,0", 0, True), ("1,1,0", 1, False), ("1,0,0", 1, True)],
)
def test_the_start_is_the_true_pose_before_the_first_motion(
    folder, first, begin, known
):
    truth = "t,x,y,theta\n" + "".join(f"{k},{k + 5},6,0.25\n" for k in range(begin, 4))
    readings = "t,id,bearing,range\n2,7,0,1\n"
    odometry = ODOMETRY.replace("1,1,0", first)
    log = own(folder, odometry=odometry, measurements=readings, groundtruth=truth)
    assert log.start.tolist() == ([5 + begin, 6, 0.25] if known else [0, 0, 0])


@pytest.mark.parametrize(("unit", "name"), [(1, "t"), (1e3, "t"), (1e9, "stamp [ns]")])
def test_epoch_stamps_count_from_the_first_odometry(folder, unit, name):
    epoch = 1.7e9
    tables = {"odometry": ODOMETRY, "measurements": MEASUREMENTS}
    log = own(
        folder,
        **{
            key: stamped(text, name, lambda t: f"{(t + epoch) * unit:.0f}")
            for key, text in tables.items()
        },
    )
    assert [e.t for e in log.events] == [-1, 0, 0, 1, 2, 2]
    assert float(log.header["epoch"]) == epoch + 1


def test_readings_outside_the_odometry_are_left_out_and_counted(folder):
    log = own(folder, measurements=MEASUREMENTS + "9,4,0,1\n9,7,0,1\n")
    expected = "2 readings outside the time of the odometry"
    assert log.header["left_out"] == expected


def test_readings_without_id_are_hidden(folder):
    log = own(folder, measurements="t,bearing,range\n1,0.1,4\n1,0.2,3\n")
    assert log.scans[0].landmark_ids is None


def test_comments_set_the_noise_the_motion_and_the_start(folder):
    remarks = (
        "# by: me\n# motion_std: 0.1,0.1,0.05\n# motion: midpoint\n# start: 1,2,3\n"
    )
    log = own(folder, odometry=remarks + ODOMETRY)
    assert (log.motion, log.start.tolist()) == ("midpoint", [1, 2, 3])
    assert log.header["motion_std"] == "0.1,0.1,0.05"
    assert "by" not in log.header


def test_a_log_of_tables_can_be_kept_as_slamlog(folder, tmp_path):
    log = own(folder, groundtruth=TRUTH)
    write_slamlog(log, tmp_path / "kept.csv")
    kept = read_log(tmp_path / "kept.csv")
    assert (events_of(kept), kept.header) == (events_of(log), log.header)


def test_the_example_of_the_page_runs(folder, monkeypatch, tmp_path):
    page = (Path(__file__).parents[2] / "docs" / "logs.md").read_text(encoding="utf-8")
    section = page.split("## Your own csv files")[1].split("\n## ")[0]
    odometry, measurements, commands, _ = (
        block.partition("\n")[2] for block in section.split("```")[1::2]
    )
    folder(odometry=odometry, measurements=measurements)
    monkeypatch.chdir(tmp_path)
    for command in commands.splitlines():
        result = slamgym(*command.split()[1:])
        assert result.exit_code == 0, result.output
    replayed = tmp_path / "results" / "drive-invariant" / "summary.json"
    summary = json.loads(replayed.read_text(encoding="utf-8"))
    assert summary["readings"]["rejected"] == 0
    assert 0.1 < summary["nis"]["per_degree"] < 3


def test_the_page_turns_poses_into_odometry(folder, monkeypatch):
    page = (Path(__file__).parents[2] / "docs" / "logs.md").read_text(encoding="utf-8")
    code = page.split("```py\n")[1].split("```")[0]
    place = folder(odom=TRUTH, measurements=MEASUREMENTS)
    with pytest.raises(LogError, match=r"differences: t, dx, dy, dtheta$"):
        read_log(place)
    monkeypatch.chdir(place)
    exec(code, {})
    poses = [np.array([5.0, 6.0, 0.25])]
    for event in read_log(place).events:
        if isinstance(event, OdometryRow):
            moved = predict_pose(poses[-1], (event.d, event.alpha)).pose
            poses = [*poses, moved] if event.dt else [*poses[:-1], moved]
    expected = np.loadtxt(TRUTH.splitlines(), delimiter=",", skiprows=1)[:, 1:]
    np.testing.assert_allclose(poses[-1], expected[-1], atol=1e-12)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"measurements": "t,tag,angle,far\n1,4,0,1\n"},
         "measurements.csv, line 1: expected a first row with the columns t, id, bea"),
        ({"measurements": "t,id,x,y\n1,4,0,1\n"},
         r"measurements.csv, line 1: expected a first row .* got 't,id,x,y'"),
        ({"odometry": "t,d,alpha\n1,1,0\n0.5,1,0\n"},
         r"odometry.csv, line 3: expected t >= 1, the time before, got 0.5"),
        ({"odometry": "t,d,alpha\n1,1,0\n2,1\n"},
         r"odometry.csv, line 3: expected 3 fields, as in line 1, got 2"),
        ({"odometry": "t,d,alpha\n1,1,left\n"},
         r"odometry.csv, line 2: expected a finite number, got 'left'"),
        ({"measurements": "t,id,bearing,range\n1,tree,0,1\n"},
         r"measurements.csv, line 2: expected an id"),
        ({"measurements": MEASUREMENTS + "3,7,0,1\n"},
         r"line 6: expected each landmark once per scan, got id 7 again"),
        ({"odometry": "t,v,omega\n1,1,0\n"}, "expected at least two rows of v and ome"),
        ({"odometry": "t,d,alpha\n1,,\n"},
         "odometry.csv, line 1: expected rows of odometry below it, got empty ones"),
        ({"measurements": "t,id,bearing,range\n8,4,0,1\n9,4,0,1\n"},
         "line 2: expected readings within the time of the odometry, 0 to 3, on one"),
        ({"odometry": "1,1,0\n2,1,0\n"},
         "odometry.csv, line 1: expected a first row with the columns t, d, alpha or"),
        ({"odometry": "# motion: arc\n" + ODOMETRY}, "line 1: expected turn-last, mid"),
        ({"odometry": "t,d,alpha\n50,1,0\n100,1,0\n150,1,0\n"},
         r"odometry.csv, line 1: expected the unit of t in its name, such as 't \[ms\]"
         r"', 't \[us\]' or 't \[s\]', got steps of 50 without a unit"),
        ({"odometry": "t,d,alpha\n1e-7,1,0\n2e-7,1,0\n3e-7,1,0\n"}, "steps of 1e-07"),
        ({"groundtruth": "t,x,y\n0,1,1\n1e5,1,1\n2e5,1,1\n"},
         r"groundtruth.csv, line 1: expected the unit of t in its name"),
        ({"measurements": "t,id,bearing,range\n" + "".join(
            f"{500 * k},4,0,1\n" for k in range(99))},
         "measurements.csv, line 3: expected readings within .* and in one unit, got 98"
         " of 99 outside it, the first at t = 500"),
        ({"measurements": "t,id,bearing,range [ft]\n1,4,0,1\n"},
         r"line 1: expected one of the units m, .* got 'range \[ft\]': convert the"),
    ],
)  # fmt: skip
def test_what_is_wrong_in_a_table_is_named(folder, changes, message):
    with pytest.raises(LogError, match=message):
        own(folder, **changes)


@pytest.mark.parametrize("unit", ["ms", "us", "nanoseconds"])
@pytest.mark.parametrize("form", ["t [{}]", "time_{}"])
def test_the_unit_of_relative_stamps_is_that_of_the_header(folder, unit, form):
    scale = {"ms": 1000, "us": 10**6, "nanoseconds": 10**9}[unit]
    tables = {"odometry": ODOMETRY, "measurements": MEASUREMENTS, "groundtruth": TRUTH}
    name = form.format(unit)
    log = own(
        folder,
        **{
            key: stamped(text, name, lambda t: str(int(t) * scale))
            for key, text in tables.items()
        },
    )
    assert [event.t for event in log.events] == pytest.approx([0, 1, 1, 2, 3, 3])
    assert log.ground_truth[:, 0] == pytest.approx([0, 1, 2, 3])


@pytest.mark.parametrize("step", [4e-4, 6e-4, 4.9, 5.1])
def test_steps_of_plausible_length_need_no_unit(folder, step):
    tables = {"odometry": ODOMETRY, "measurements": MEASUREMENTS}
    tables = {k: stamped(x, "t", lambda t: repr(step * t)) for k, x in tables.items()}
    if 5e-4 <= step <= 5:
        two = "t,x,y\n0,0,0\n99,1,1\n"  # too few to judge their step
        assert len(own(folder, **tables, groundtruth=two).ground_truth) == 2
        return
    with pytest.raises(LogError, match="expected the unit of t in its name"):
        own(folder, **tables)


POSES = TRUTH.replace("t,x,y,theta", "t,{0}x,{0}y,{0}theta")


@pytest.mark.parametrize(
    ("name", "columns", "is_truth"),
    [
        ("poses", "", True),
        ("odom_poses", "", False),
        ("ekf", "", False),
        ("ekf", "true_", True),
        ("odom_truth", "", True),
        ("odom_length", "", False),
        ("odom_xgt", "", True),
    ],
)
def test_poses_in_a_file_named_as_an_estimate_are_not_the_truth(
    folder, name, columns, is_truth
):
    log = own(folder, **{name: POSES.format(columns)})
    assert log.start.tolist() == ([5, 6, 0.25] if is_truth else [0, 0, 0])
    assert log.header["truth"] == (f"{name}.csv" if is_truth else "none")
    note = f"the poses of {name}.csv, since no name marks them as the truth: name"
    assert log.header.get("left_out", "").startswith(note) != is_truth


@pytest.mark.parametrize("prefix", ["", "gt_"])
def test_poses_beside_odometry_are_the_truth_if_a_name_marks_them(file, prefix):
    head = f"t,v,omega,id,bearing,range,{prefix}x,{prefix}y,{prefix}yaw\n"
    log = read_log(file(head + "0,1,0,4,0,9,5,6,0\n1,1,0,4,0,8,6,6,0\n"))
    assert log.start.tolist() == ([5, 6, 0] if prefix else [0, 0, 0])
    assert ("left_out" in log.header) == (not prefix)


@pytest.mark.parametrize("name", ["odometry", "wheels"])
def test_true_poses_beside_odometry_count_in_a_file_of_any_name(folder, name):
    rows = "t,d,alpha,x_true,y_true\n1,0,0,5,6\n2,1,0,6,6\n"
    place = folder(measurements=MEASUREMENTS, **{name: rows})
    assert read_log(place).ground_truth[:, 1:3].tolist() == [[5, 6], [6, 6]]
    (place / "groundtruth.csv").write_text(TRUTH)
    if name == "odometry":  # the file of the truth comes first
        assert read_log(place).header["truth"] == "groundtruth.csv"


def test_poses_that_are_given_as_the_truth_are_the_truth(folder, file):
    place = folder(odometry=ODOMETRY, measurements=MEASUREMENTS, ekf=TRUTH)
    log = read_log(place, truth=place / "ekf.csv")
    assert log.ground_truth.tolist() == [
        [*map(float, row.split(","))] for row in TRUTH.split()[1:]
    ]


def test_commands_name_the_file_that_they_take_for_the_truth(folder, tmp_path):
    place = folder(odometry=ODOMETRY, measurements=MEASUREMENTS, poses=TRUTH)
    shown = " ".join(slamgym("replay", place, "--out", tmp_path / "r").output.split())
    assert "truth: poses.csv; the log starts at the true pose" in shown
    given = "--truth", place / "poses.csv", "--out", tmp_path / "given"
    assert "the log starts at" not in slamgym("replay", place, *given).output


# True paths

TUM = "0 5 6 0 0 0 0 1\n1 6 6 0 0 0 0 1\n2 7 6 0 0 0 0.6 0.8\n3 8 8 0 0 0 0.6 0.8\n"
TURN = 2 * math.atan2(0.6, 0.8)
COS, SIN = math.cos(TURN), math.sin(TURN)
IN_SPACE = [(5, 6, 0), (6, 6, 0), (7, 6, TURN), (8, 8, TURN)]
EUROC_HEAD = (
    "#timestamp, p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], "
    "q_RS_y [], q_RS_z [], v_RS_R_x [m s^-1]\n"
)
EUROC_ROWS = "".join(
    f"{1403636579758555392 + k * 10**9},{x},{y},0.5,{math.cos(a / 2)},0,0,"
    f"{math.sin(a / 2)},0.1\n"
    for k, (x, y, a) in enumerate(IN_SPACE)
)
ROS = (
    "%time,field.header.seq,field.header.stamp,field.header.frame_id,"
    "field.pose.pose.position.x,field.pose.pose.position.y,field.pose.pose.position.z,"
    "field.pose.pose.orientation.x,field.pose.pose.orientation.y,"
    "field.pose.pose.orientation.z,field.pose.pose.orientation.w\n"
) + "".join(
    f"{1700000000 * 10**9 + k * 10**9},{k},{1700000000 * 10**9 + k * 10**9},odom,"
    f"{x},{y},0,0,0,{math.sin(a / 2)},{math.cos(a / 2)}\n"
    for k, (x, y, a) in enumerate(IN_SPACE)
)


COVARIANCES = {
    f"tum, {count} entries": TUM.replace("\n", " 0" * count + "\n")
    for count in (6, 9, 21, 36)
}


def matrices(camera):
    rows = []
    for x, y, a in IN_SPACE:
        cos, sin = math.cos(a), math.sin(a)
        if camera:  # z ahead, x to the right, y down
            rows.append((cos, 0, -sin, -y, 0, 1, 0, 0, sin, 0, cos, x))
        else:
            rows.append((cos, -sin, 0, x, sin, cos, 0, y, 0, 0, 1, 0))
    return "".join(" ".join(map(repr, row)) + "\n" for row in rows)


PATHS = COVARIANCES | {
    "tum": TUM,
    "tum, header": "# timestamp tx ty tz qx qy qz qw\n" + TUM,
    "tum, title": "# ground truth trajectory\n# file: 'x.bag'\n" + TUM,
    "tum, names": "timestamp tx ty tz qx qy qz qw\n" + TUM,
    "tum, commas": TUM.replace(" ", ","),
    "kitti": matrices(camera=True),
    "kitti, z up": matrices(camera=False),
    "euroc": EUROC_HEAD + EUROC_ROWS,
    "euroc, no velocity": EUROC_HEAD.replace("#", "").replace(", v_RS_R_x [m s^-1]", "")
    + EUROC_ROWS.replace(",0.1\n", "\n"),
    "euroc, no header": EUROC_ROWS.replace(",0.1\n", ",0.1" + ",0" * 8 + "\n"),
    "ros": ROS,
    "csv": f"t,x,y,yaw\n0,5,6,0\n1,6,6,0\n2,7,6,{TURN}\n3,8,8,{TURN}\n",
    "utias": f"0 5 6 0\n1 6 6 0\n2 7 6 {TURN}\n3 8 8 {TURN}\n",
    "graph": "".join(
        f"VERTEX_SE2 {k} {x} {y} {a}\n" for k, (x, y, a) in enumerate(IN_SPACE)
    ),
    "slamlog": "# format: slamlog 1\n"
    + "".join(f"groundtruth,{k},{x},{y},{a}\n" for k, (x, y, a) in enumerate(IN_SPACE)),
}


@pytest.mark.parametrize("name", PATHS)
def test_true_paths_of_all_formats_are_the_same(file, name):
    path = file(PATHS[name], "path.txt")
    rows = true_path(path)
    np.testing.assert_allclose(rows[:, 1:], IN_SPACE, atol=1e-12)
    np.testing.assert_allclose(np.diff(rows[:, 0]), 1, atol=1e-5)


@pytest.mark.parametrize("axis", "XY")
@pytest.mark.parametrize("degrees", [29, 31])
def test_poses_tilted_by_at_most_30_degrees_have_a_heading(file, axis, degrees):
    turn = Rotation.from_euler(f"Z{axis}", (1.0, math.radians(degrees)))
    quaternion = ",".join(map(str, 1.02 * turn.as_quat()))
    both = np.array([np.eye(3, 4), np.column_stack([turn.as_matrix(), np.zeros(3)])])
    texts = (
        f"t,x,y,qx,qy,qz,qw\n0,0,0,0,0,0,1\n1,0,0,{quaternion}\n",
        "\n".join(" ".join(map(str, row.ravel())) for row in both),
    )
    for text in texts:
        path = file(text, "path.txt")
        if degrees < 30:
            heading = math.atan2(*both[1, [1, 0], 0])
            assert true_path(path)[1, 3] == pytest.approx(heading)
            continue
        with pytest.raises(LogError, match="pose 1 tilted by more than 30°"):
            true_path(path)


def test_a_true_path_of_numbers_may_have_any_number_of_rows(file):
    rows = np.arange(24.0).reshape(6, 4) / 100
    text = "".join("{} {} {} {}\n".format(*row) for row in rows.tolist())
    np.testing.assert_array_equal(true_path(file(text, "path.txt")), rows)


@pytest.mark.parametrize(
    "name", ["tum", "kitti", "csv", "utias", "graph", "slamlog", *COVARIANCES]
)
@pytest.mark.parametrize("kind", ["csv", "graph"])
def test_the_truth_of_a_log_may_be_in_any_format(folder, file, name, kind):
    log = folder(odometry=ODOMETRY, measurements=MEASUREMENTS)
    if kind == "graph":
        log = file(
            "".join(f"EDGE_SE2 {k} {k + 1} 1 0 0\n" for k in range(3))
            + "EDGE_SE2_XY 0 9 3 1\n",
            "log.g2o",
        )
    truth = read_log(log, truth=file(PATHS[name], "truth.txt"))
    expected = [(float(k), *pose) for k, pose in enumerate(IN_SPACE)]
    np.testing.assert_allclose(truth.ground_truth, expected, atol=1e-12)
    np.testing.assert_allclose(truth.start, IN_SPACE[0], atol=1e-12)


def test_a_truth_with_epoch_stamps_is_set_to_the_clock_of_the_log(folder, file):
    epoch = 1700000000
    odometry = "t,d,alpha\n" + "".join(f"{epoch + k},1,0\n" for k in range(4))
    readings = f"t,id,bearing,range\n{epoch + 2},7,0,1\n"
    times = [0, 1, 2, 2, 3]  # one pose is given twice
    truth = file("".join(f"{epoch + k} {k} 0 0 0 0 0 1\n" for k in times))
    log = read_log(folder(odometry=odometry, measurements=readings), truth=truth)
    assert log.ground_truth[:, 0].tolist() == times


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("0 1 2 3 0.5 0.5 0.5 0.5\n" * 2, "pose 0 tilted by more than 30°: convert"),
        ("0 0 1 0 1 0 0 0 0 1 0 0\n" * 2, "pose 0 tilted by more than 30°: convert"),
        (TUM.replace("\n", "9\n", 1).replace("0 5", "90 5"), "path.txt"),
        ("# format: slamlog 1\nodometry,1,1,0,1\n", "expected a true path with poses"),
        (TUM.replace("7 6", "7 1e101"), "path.txt, line 2: expected"),
        ("t,east,yaw\n0,1,2\n1,1,2\n", "expected truth, a table with the columns t"),
        (matrices(camera=True) * 2, "expected a pose for each of the 4 times of the l"),
        ("".join(f"{k + 50} 1 2 0 0 0 0 1\n" for k in range(3)),
         "expected times of the log, 0 to 3, got 50 to 52: give both on one clock"),
        ("t,x,y,theta\n1,,,\n", "expected a true path with poses, got none"),
        ("t,x,y,qx,qy,qz,qw\n1,0,0,0,0,0,1\n2,0,0,0,0,0,0\n",
         r"path.txt, line 3: expected a quaternion .* of unit length, got \(0.0, 0.0, 0"
         r".0, 0.0\): divide it by its length, or remove its columns"),
        ("t,x,y,qx,qy,qz,qw\n1,0,0,0,0,9e99,1\n", "line 2: expected a quaternion"),
        ("t,x,y,theta\n1,0,0,0\n2,1e308,0,0\n",
         r"path.txt, line 3: expected a number up to 1e\+100, got '1e308'"),
        (TUM + "2.5 8 8 0 0 0 0 1\n",
         "path.txt, pose 4: expected a time >= 3, that of the pose before it, got 2.5"),
    ],
)  # fmt: skip
def test_a_truth_that_does_not_fit_is_refused(folder, file, text, message):
    log = folder(odometry=ODOMETRY, measurements=MEASUREMENTS)
    with pytest.raises(LogError, match=message):
        read_log(log, truth=file(text, "path.txt"))


def test_a_folder_without_a_true_path_is_no_truth(folder):
    log = folder(odometry=ODOMETRY, measurements=MEASUREMENTS)
    with pytest.raises(LogError, match=r"drive: expected a true path with poses, got"):
        read_log(log, truth=log)


# What is no log


@pytest.mark.parametrize("name", ["Robot1_Odometry.dat", "Barcodes.dat"])
def test_a_single_file_of_utias_asks_for_its_folder(file, name):
    with pytest.raises(LogError, match=f"{name}: expected a log, .*: give its folder"):
        read_log(file("1248272262.1 0.1 0\n1248272262.2 0.1 0\n", name))


def test_a_table_without_the_columns_of_odometry_is_shown_with_them(folder):
    place = folder(measurements=MEASUREMENTS, wheels="t,v,gyro\n0,1,2\n", empty="")
    (place / "old.csv").mkdir()
    with pytest.raises(
        LogError, match=r"got measurements.csv .*; wheels.csv with 't,v"
    ):
        read_log(place)


def test_a_folder_of_unknown_tables_names_them(folder):
    with pytest.raises(LogError, match=r"got another folder with fahrt.csv: rename"):
        read_log(folder(fahrt="zeit,weg,winkel\n0,1,2\n"))


@pytest.mark.parametrize(
    ("text", "remedy"),
    [
        (TUM, "expected a log of odometry and readings, got a path in the format of T"),
        (matrices(camera=True), "got a path in the format of KITTI, which --truth rea"),
        (EUROC_HEAD + EUROC_ROWS, "got a path in the format of EuRoC, which --truth r"),
        (ROS, "expected odometry, a table with the columns t, d, alpha or t, v,"),
        ("t,d,alpha\n1,1,0\n", "or give the folder of several such files"),
        ("odometry,1,1,0,1\n", "expected '# format: slamlog 1' above the rows"),
        ("VERTEX_SE3:QUAT 0 0 0 0 0 0 0 1\n", "of a planar graph, got 'VERTEX_SE3:QU"),
        ("VERTEX_SE2 0 0 0 0\nEDGE_SE2 0 1 1 0 0\nEDGE_SE2 1 2 1 0 0\n"
         "EDGE_SE2 2 0 -2 0 0\n", "expected readings of landmarks, as a filter has no"),
        ("1,2,3\n4,5,6\n", "line 1: expected a first row that names the columns"),
        ("1 2 3\n4 5 6\n", "folder of a UTIAS data set, got 3 numbers in each row"),
        ("header: \n  seq: 1\n", r"csv with named col.*\('rostopic echo -p' writes"),
        ("<log/>\n", "csv with named columns .*, got XML, '<log/>': convert it to"),
        ("EDG_SE2 0 1 1 0 0\n", "the nearest formats are iSAM or g2o text .* and "),
        ("ODOMETRIE 0.1 2 0\n", "the nearest formats are .*Freiburg sensor.dat"),
        ("# only\n% remarks\n", "line 1: expected rows, got comments only"),
        ('{"t": 1}\n', "line 1: .*nearest formats"),
        ("zeit,weg,winkel\n0,1,2\n", "line 1: .* csv with named columns .*, got 'zeit"),
    ],
)  # fmt: skip
def test_what_is_no_log_is_refused_with_the_remedy(file, text, remedy):
    with pytest.raises(LogError, match=remedy) as caught:
        read_log(file(text, "stranger.txt"))
    assert "stranger.txt" in str(caught.value)
    assert "\n" not in str(caught.value)
