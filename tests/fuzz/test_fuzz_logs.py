"""Damaged logs of every format: read, refused by line, or read and written alike."""

import numpy as np
from fuzzing import edited, edits
from hypothesis import strategies as st

from slamgym.estimator import make_estimator
from slamgym.experiments.logs.importers import read_log
from slamgym.experiments.logs.slamlog import read_slamlog, write_slamlog
from slamgym.experiments.run_and_replay import replay

SLAMLOG = """# format: slamlog 1
# name: little
# motion_std: 0.1,0.1,0.05
# measurement_std: 0.02,0.1
landmark,7,5,0
start,0,0,0,0
truth,0,0,0,0
measurement,0,7,0.01,5.1
odometry,1,1,0,1
truth,1,1,0,0
measurement,1,7,-0.01,4.1
measurement,1,9,1.0,3.0
odometry,2,1,0.5,1
measurement,2,,1.0,3.0
"""
COURSE = "1 0 " + " ".join(["1.1", "6.7"] * 6) + "\n0.5 0.1 " + "1.3 12.3 " * 6
FREIBURG = "ODOMETRY 0.1 2 -0.3\nSENSOR 1 1.5 0.4\nSENSOR 2 -0.03 3.3\nODOMETRY 0 1 0.2"
ISAM = """ODOMETRY 0 1 1 0 0.5 100 0 0 500 0 500
LANDMARK 1 2 3 4 1.5 0 1.5
ODOMETRY 1 3 -2 1 -0.25 100 0 0 500 0 500
LANDMARK 3 2 0 -2 1.5 0 1.5
"""
G2O = """VERTEX_SE2 0 0 0 0
VERTEX_SE2 1 1 0 0.5
VERTEX_XY 2 3 4
EDGE_SE2 0 1 1 0 0.5 100 0 0 100 0 500
EDGE_SE2_XY 1 2 3 4 1.5 0 1.5
"""
EPOCH = 1248444187.5
UTIAS = {
    "Barcodes.dat": "# Subject # Barcode #\n 3 41\n 6 63\n 7 81\n",
    "Landmark_Groundtruth.dat": "6 1.5 -4 1e-4 1e-4\n7 2 3 1e-4 1e-4\n",
    "Robot3_Odometry.dat": f"{EPOCH} 0.5 0.0\n{EPOCH + 0.15} 1.0 -0.2\n",
    "Robot3_Measurement.dat": f"{EPOCH} 63 1 0\n{EPOCH + 0.1} 81 7.05 -0.036\n",
    "Robot3_Groundtruth.dat": f"{EPOCH} 1 2 3\n{EPOCH + 0.8} 2 2 -3\n",
}
NAMED = "t,v,omega,id,bearing [deg],range\n0,1,0,7,1,5\n1,1,.5,7,1,4\n2,0,0,9,1,3\n"
INCREMENTS = "time;dx;dy;dtheta;bearing;range\n0;1;.1;.2;.1;5\n1;-1;0;0;;\n"
TEXTS = (SLAMLOG, COURSE, FREIBURG, ISAM, G2O, NAMED, INCREMENTS)
PATHS = (
    "0 5 6 0 0 0 0.6 0.8\n1 6 6 0 0 0 0 1\n",
    "1 0 0 5 0 1 0 6 0 0 1 0\n1 0 0 6 0 1 0 6 0 0 1 0\n",
    "#timestamp, p_RS_R_x [m], y, z, q_RS_w [], q_RS_x [], q_RS_y [], q_RS_z []\n"
    "1403636579758555392,1,2,0,1,0,0,0\n1403636580758555392,2,2,0,1,0,0,0\n",
    "t,x,y,yaw [deg]\n0,1,2,3\n1,2,3,\n",
    "VERTEX_SE2 0 0 0 0\nVERTEX_SE2 1 1 0 0.5\n",
    SLAMLOG.replace("truth,", "groundtruth,"),
)
NOISE = {"motion_std": (0.1, 0.1, 0.05), "measurement_std": (0.05, 0.1)}


def assert_usable(log, folder):
    """Written and read again a log is the same, and a filter can follow it."""
    copy = folder / "copy.csv"
    write_slamlog(log, copy)
    again = read_slamlog(copy)
    assert len(again.events) == len(log.events)
    write_slamlog(again, folder / "again.csv")
    assert (folder / "again.csv").read_bytes() == copy.read_bytes()
    trace = replay(log, make_estimator("ekf", **NOISE)).trace
    assert np.isfinite(trace.poses).all()


def attempt(folder, path, **options):
    """Read a log: it is refused in a plain sentence, or it can be used."""
    try:
        assert_usable(read_log(path, **options), folder)
    except (ValueError, OSError, MemoryError) as error:
        assert str(error)


def test_damaged_logs_are_refused_or_usable(fuzzer, tmp_path):
    path = tmp_path / "log.txt"

    def read(text, changes, noise):
        path.write_text(edited(text, changes), encoding="utf-8")
        attempt(tmp_path, path, noise_from_file=noise and "\n" in text)

    texts = st.one_of(st.sampled_from(TEXTS), st.text(max_size=40))
    fuzzer.check(read, texts, edits, st.booleans(), few=50)


def test_damaged_true_paths_are_refused_or_usable(fuzzer, tmp_path):
    log, truth = tmp_path / "log.g2o", tmp_path / "truth.txt"
    log.write_text(G2O, encoding="utf-8")

    def read(text, changes):
        truth.write_text(edited(text, changes), encoding="utf-8")
        attempt(tmp_path, log, truth=truth)

    huge = [(PATHS[2], [("replace", 1, 5, size)]) for size in ("1.34e154", "9e99")]
    fuzzer.check(read, st.sampled_from(PATHS), edits, few=50, saved=huge)


def test_bytes_that_are_no_log_are_refused(fuzzer, tmp_path):
    path = tmp_path / "log.txt"

    def read(junk, text, at):
        raw = text.encode()
        at %= len(raw)
        path.write_bytes(raw[:at] + junk + raw[at:])
        attempt(tmp_path, path)

    fuzzer.check(
        read,
        st.binary(max_size=20),
        st.sampled_from(TEXTS),
        st.integers(0, 400),
        few=40,
        saved=[(b"\xff\xfe", SLAMLOG, 0), (b"\x00", COURSE, 3)],
    )


def test_damaged_folders_of_utias_are_refused_or_usable(fuzzer, tmp_path):
    def read(damaged, changes, robot):
        for name, text in UTIAS.items():
            changed = edited(text, changes) if name == damaged else text
            (tmp_path / name).write_text(changed, encoding="utf-8")
        attempt(tmp_path, tmp_path, robot=robot)

    one_byte = ("Robot3_Odometry.dat", [("replace", 1, 0, "1.3e19")], None)
    fuzzer.check(
        read,
        st.sampled_from(sorted(UTIAS)),
        edits,
        st.sampled_from([None, None, 3, 4, -1]),
        few=40,
        saved=[one_byte],
    )
