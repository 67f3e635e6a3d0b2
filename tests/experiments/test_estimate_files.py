"""Files of estimates, read number by number: every one of them differs."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from slamgym.experiments.estimate_files import near_truth, read_estimates, true_path
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
    wrong.write_text("pose,\n")
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
    np.savetxt(path, tum_rows(), fmt="%.17g")
    np.testing.assert_allclose(true_path(path)[:, 1:], POSES, atol=1e-12)
    np.testing.assert_array_equal(true_path(path)[:, 0], TIMES)


@pytest.mark.parametrize("climb", [0.0, 0.5])
def test_a_path_is_spatial_only_if_it_leaves_its_plane(climb, tmp_path):
    path, heights = tmp_path / "run.tum", HEIGHTS + np.array([[0.0], [climb], [0.0]])
    turns = Rotation.from_euler("z", POSES[:, 2:]).as_quat()
    parts = TIMES[:, None], POSES[:, :2], heights, turns, entries(SPATIAL, 21)
    np.savetxt(path, np.hstack(parts), fmt="%.17g")
    assert read_estimates([path])["run"].is_spatial == (climb > 0)


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
    due = np.array([0.0, 1.0, 2.0, 3.0, 9.0, 10.0])
    times = np.array([-0.1, 0.0, 2.5, 3.04, 3.5, 5.0, 8.97, 9.5, 10.0, 10.1])
    near = [False, True, True, True, False, False, True, True, True, False]
    assert near_truth(times, due).tolist() == near
