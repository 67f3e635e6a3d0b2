"""Files of estimates, read number by number: every one of them differs."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from slamgym.experiments.estimate_files import (
    near_truth,
    paired,
    paths_by_label,
    read_estimates,
    true_path,
)
from slamgym.experiments.logs import LogError

RNG = np.random.default_rng(0)
TIMES = np.array([0.5, 1.5, 2.0])
POSES = RNG.uniform(-2, 2, (3, 3))
SPATIAL = np.array([(A := RNG.normal(size=(6, 6))) @ A.T for _ in TIMES])
PLANAR = SPATIAL[:, [0, 1, 5]][:, :, [0, 1, 5]]  # of x, y, yaw
MAP = {12: RNG.uniform(-9, 9, 5), 0: RNG.uniform(-9, 9, 5)}
HEIGHTS = 7.0 + np.zeros((3, 1))


def tum_rows(*more):
    """Return rows t x y z qx qy qz qw …; the robot is tilted about both axes."""
    tilted = Rotation.from_euler("z", POSES[:, 2:]) * Rotation.from_euler(
        "YX", (0.3, 0.2)
    )
    return np.hstack([TIMES[:, None], POSES[:, :2], HEIGHTS, tilted.as_quat(), *more])


def entries(matrices, count):
    """Return all entries by rows, or those of the upper triangle."""
    upper = np.triu_indices(matrices.shape[1])
    whole = count == matrices.shape[1] ** 2
    return matrices.reshape(-1, count) if whole else matrices[:, *upper]


def assert_poses(estimate, times=TIMES):
    np.testing.assert_allclose(estimate.poses, POSES, atol=1e-12)
    np.testing.assert_allclose(estimate.covariances, PLANAR, rtol=1e-12)
    if times is not None:
        np.testing.assert_array_equal(estimate.times, times)


@pytest.mark.parametrize(("count", "of_map"), [(6, 3), (9, 4)])
def test_a_csv_is_read_number_by_number(count, of_map, tmp_path):
    path = tmp_path / "seed_0000012.csv"
    rows = np.hstack([TIMES[:, None], POSES, entries(PLANAR, count)])
    lines = [f"pose,{','.join(map(repr, row))}" for row in rows.tolist()]
    for i, (x, y, xx, xy, yy) in MAP.items():
        own = (xx, xy, yy) if of_map == 3 else (xx, xy, xy, yy)
        lines.append(f"landmark,{i},{','.join(str(v) for v in (x, y, *own))}")
    path.write_text("\n".join(["# mine", *lines]))
    found = read_estimates([tmp_path])[12]
    assert_poses(found)
    assert not found.in_seconds
    assert found.landmark_ids.tolist() == [12, 0]
    for (x, y, xx, xy, yy), place, P in zip(
        MAP.values(), found.landmarks, found.landmark_covariances, strict=True
    ):
        assert place.tolist() == [x, y]
        assert P.tolist() == [[xx, xy], [xy, yy]]
    few = found.at(np.array([2, 0]))
    for name in ("poses", "covariances", "times"):
        assert (getattr(few, name) == getattr(found, name)[[2, 0]]).all(), name


def test_lines_of_a_csv_are_read_alike_at_once_and_one_by_one(tmp_path):
    """A blank before a comma makes the reader look at each line by itself."""
    rows = np.hstack([TIMES[:, None], POSES, entries(PLANAR, 6)]).tolist()
    lines = [f"pose,{','.join(map(repr, row))}" for row in rows]
    lines.insert(2, "landmark,3,1,2,1,0,1")
    plain, spaced, wrong = (tmp_path / f"{name}.csv" for name in ("a", "b", "c"))
    plain.write_text("\n".join(lines))
    spaced.write_text("\n".join([*lines[:-1], lines[-1].replace(",", " ,")]))
    wrong.write_text("\n".join([*lines, "landmark,3,1,2,1,0,1"]))
    one, other = (read_estimates([path])[path.stem] for path in (plain, spaced))
    for found, expected in zip(one[1:], other[1:], strict=True):
        np.testing.assert_array_equal(found, expected)
    with pytest.raises(LogError, match="line 5: expected each landmark once"):
        read_estimates([wrong])
    wrong.write_text("\n".join([*lines[:3], f"{lines[3]}x"]))
    with pytest.raises(LogError, match="line 4: expected a finite number"):
        read_estimates([wrong])
    for place in (0, 2, 4):
        wrong.write_text("\r\n".join([*lines[:place], "pose,", *lines[place:]]))
        with pytest.raises(LogError, match=f"line {place + 1}: expected pose,t,x"):
            read_estimates([wrong])
    for text in "pose,\n", f"pose{14 * ',1'}\n":
        wrong.write_text(text)
        with pytest.raises(LogError, match="line 1: expected pose,t,x"):
            read_estimates([wrong])


@pytest.mark.parametrize("count", [6, 9, 21, 36])
def test_a_tum_file_is_read_number_by_number(count, tmp_path):
    path = tmp_path / "run.tum"
    matrices = SPATIAL if count > 9 else PLANAR
    np.savetxt(path, tum_rows(entries(matrices, count)), fmt="%.17g")
    found = read_estimates([path])["run"]
    assert_poses(found)
    assert found.in_seconds
    assert found.is_spatial == (count > 9)
    last = path.read_text().splitlines()[-1]
    np.savetxt(path, tum_rows(), fmt="%.17g")
    for text in path.read_text(), "\n".join([*path.read_text().split("\n")[:2], last]):
        path.write_text(text)  # rows of one length, or of two
        np.testing.assert_allclose(true_path(path)[:, 1:], POSES, atol=1e-12)
        np.testing.assert_array_equal(true_path(path)[:, 0], TIMES)


@pytest.mark.parametrize(
    ("climb", "tilt", "known", "is_spatial"),
    [
        (0.04, 0, 1, False),
        (0.06, 0, 1, True),
        (0, 0.048, 1, False),
        (0, -0.052, 1, True),
        *((0.06, 0, np.arange(6) != k, False) for k in (2, 3, 4)),  # one is certain
        (0.06, 0, np.array([[[1]], [[0]], [[0]]]), True),
    ],
)
def test_a_path_is_spatial_only_if_it_leaves_its_plane(
    climb, tilt, known, is_spatial, tmp_path
):
    path = tmp_path / "run.tum"
    places = np.column_stack([[0, 3, 9], [0, 2, 1], [7, 7 + 9 * climb, 7]])
    turns = Rotation.from_euler("x", [[0.0], [0.0], [tilt]]).as_quat()
    parts = TIMES[:, None], places, turns, entries(known * SPATIAL, 21)
    np.savetxt(path, np.hstack(parts), fmt="%.17g")
    assert read_estimates([path])["run"].is_spatial == is_spatial


def test_an_npz_is_read_by_its_seeds_and_holds_the_final_map(tmp_path):
    ids = np.array([[[4, -1], [4, -1], [4, -1]], [[0, -1], [0, 5], [6, 0]]])
    places, their = RNG.normal(size=(2, 3, 2, 2)), RNG.normal(size=(2, 3, 2, 2, 2))
    arrays = {
        "belief_poses": np.array([POSES + 1, POSES]),
        "belief_pose_covariances": np.array([2 * PLANAR, PLANAR]),
        "belief_landmarks": places,
        "belief_landmark_covariances": their,
        "belief_landmark_ids": ids,
    }
    np.savez(tmp_path / "all.npz", seed=[3, 8], **arrays)
    found = read_estimates([tmp_path])
    assert set(found) == {3, 8}
    assert_poses(found[8], times=None)
    assert found[8].landmark_ids.tolist() == [6, 0]
    assert found[3].landmark_ids.tolist() == [4]
    np.testing.assert_array_equal(found[8].landmarks, places[1, -1])
    np.testing.assert_array_equal(found[3].landmark_covariances, their[0, -1, :1])


def test_times_outside_a_true_path_or_in_its_gap_are_not_near_it():
    due = np.array([0.0, 1.0, 2.0, 3.0, 9.0, 10.0, 13.0])
    times = np.array([-0.1, 0.0, 2.5, 3.04, 3.07, 5.0, 8.97, 9.5, 11.5, 13.0, 13.1])
    near = [False, True, True, True, False, False, True, True, True, True, False]
    for unit in 0.5, 2.0:
        assert near_truth(unit * times, unit * due).tolist() == near


def test_estimates_keep_the_labels_of_a_mapping(tmp_path):
    assert paths_by_label({"a": tmp_path, 2: [tmp_path]}) == {
        "a": [tmp_path], "2": [tmp_path]
    }  # fmt: skip
    with pytest.raises(ValueError, match="at least one file or folder, got none"):
        paths_by_label({"a": tmp_path, "b": []})


@pytest.mark.parametrize("names", [["run1", "run01", "run2"], ["run2", "run1"]])
@pytest.mark.parametrize("estimates", [["e1", "e01", "e2"], ["e1", "e2"]])
def test_names_are_paired_only_if_what_differs_is_unique(names, estimates):
    read = {name: k for k, name in enumerate(estimates)}
    is_unique = len(names) == len(estimates) == 2
    expected = {"run2": 1, "run1": 0} if is_unique else read
    assert paired(read, names) == expected


def tilted(degrees):
    return Rotation.from_euler("ZY", (0.5, np.radians(degrees))).as_quat()


@pytest.mark.parametrize(
    ("turn", "message"),
    [
        (tilted(31), "line 2: .*, tilted by 31°; --space judges"),
        (tilted(25)[[3, 0, 1, 2]], "line 2: .*: qw comes first; write it last"),
        (tilted(35)[[3, 0, 1, 2]], "line 2: .*, tilted by"),
    ],
)
def test_a_true_path_is_tilted_by_at_most_30_degrees(turn, message, tmp_path):
    path, rows = tmp_path / "run.tum", np.eye(8)[[7, 7]]
    rows[1, 0], rows[1, 4:] = 1.0, tilted(29)
    np.savetxt(path, rows)
    assert true_path(path)[1, 3] == pytest.approx(0.5)
    rows[1, 4:] = turn
    np.savetxt(path, rows)
    with pytest.raises(LogError, match=message):
        true_path(path)


@pytest.mark.parametrize(
    ("counts", "message"),
    [
        ((0, 0, 0), "line 1: expected t x y z .*, got no covariance"),
        ((1, 1, 1), "line 1: expected t x y z .*, got 9 fields in"),
        ((6, 0, 9), "line 2: expected t x y z .*, got no covariance"),
        ((6, 6, 9), "expected lines t x y z .*, all alike, got lines of several"),
    ],
)
def test_rows_of_tum_without_the_same_covariance_are_refused(counts, message, tmp_path):
    path, rows = tmp_path / "run.tum", tum_rows(entries(PLANAR, 9)).tolist()
    lines = [row[: 8 + n] for row, n in zip(rows, counts, strict=True)]
    path.write_text("\n".join(" ".join(map(repr, line)) for line in lines))
    with pytest.raises(LogError, match=message):
        read_estimates([path])
