"""The beliefs of a filter beside the truth of generated trajectories."""

from dataclasses import replace

import numpy as np
import pytest

from slamgym.estimator import EkfSlam, make_estimator
from slamgym.estimator.registry import register_estimator
from slamgym.experiments.trajectories import (
    drive_episodes,
    generate,
    generate_trajectories,
    load_trajectories,
)
from slamgym.experiments.trajectories.driven_episodes import with_beliefs
from slamgym.experiments.trajectories.manifest import read_manifest
from slamgym.experiments.trajectories.trajectory import ARRAYS, BELIEFS
from slamgym.sim_configs import load_scenario

KNOWN = load_scenario("corridor").with_changes(steps=12)
HIDDEN = load_scenario("hidden_identities").with_changes(steps=12)


def beliefs_by_hand(drive, slam, ids_of):
    """Drive a filter through a trajectory, scan by scan."""
    out = []
    for step, seen in enumerate(drive.mask):
        if step > 0:
            slam.predict(drive.odometry[step - 1])
        if seen.any():
            slam.update(drive.measurements[step][seen], ids_of(seen))
        out.append(slam.belief())
    return out


def noise(scenario):
    noise = {"motion_std": scenario.motion.std, "measurement_std": scenario.sensor.std}
    return noise | {"initial_pose_std": scenario.start.std}


def test_row_i_is_what_a_filter_driven_by_hand_believes_of_landmark_i():
    (drive,) = drive_episodes(KNOWN, "waypoints", [3])
    found = with_beliefs(drive, "ekf")
    slam = make_estimator("ekf", initial_pose=drive.start_estimate, **noise(KNOWN))
    for step, belief in enumerate(beliefs_by_hand(drive, slam, np.flatnonzero)):
        ids = list(belief.landmark_ids)
        empty = np.setdiff1d(np.arange(len(drive.landmarks)), ids)
        P, blocks = belief.covariance, found.belief_landmark_covariances[step]
        same = np.testing.assert_array_equal
        same(found.belief_poses[step], belief.pose)
        same(found.belief_pose_covariances[step], P[:3, :3])
        same(found.belief_landmarks[step, ids], belief.landmarks)
        for place, row in enumerate(ids):
            block = slice(3 + 2 * place, 5 + 2 * place)
            same(blocks[row], P[block, block])
        same(found.belief_landmark_ids[step, ids], ids)
        assert (found.belief_landmark_ids[step, empty] == -1).all()
        assert not found.belief_landmarks[step, empty].any()
    assert 0 < len(ids) < len(drive.landmarks)


def test_the_truth_and_the_readings_stay_as_they_are():
    (drive,) = drive_episodes(KNOWN, "waypoints", [3])
    found = with_beliefs(drive, "invariant")
    for name in ARRAYS:
        assert getattr(found, name) is getattr(drive, name)


def test_hidden_identities_are_associated_and_maps_stay_within_the_rows():
    (drive,) = drive_episodes(HIDDEN, "waypoints", [3])
    found = with_beliefs(drive, "invariant")
    rows = drive.mask.shape[1]
    assert found.belief_landmark_ids.shape == (13, rows)
    mapped = (found.belief_landmark_ids >= 0).sum(axis=1)
    in_use = found.belief_landmark_ids >= 0
    np.testing.assert_array_equal(in_use, np.arange(rows) < mapped[:, None])
    near = found.belief_landmarks[-1, : mapped[-1]]
    gaps = np.hypot(*(near[:, None] - drive.landmarks).T).min(axis=0)
    assert mapped[-1] >= 4
    assert np.median(gaps) < 0.5


def test_the_filter_knows_the_noise_that_an_episode_drew():
    ranges = {"motion_std": [4.0, 4.0]}
    scenario = KNOWN.with_changes(randomise=ranges)
    (drive,) = drive_episodes(scenario, "waypoints", [3])
    other = with_beliefs(drive, "ekf").belief_pose_covariances[1, 0, 0]
    slam = make_estimator(
        "ekf", initial_pose=drive.start_estimate, **noise(drive.scenario)
    )
    belief = beliefs_by_hand(drive, slam, np.flatnonzero)[1]
    assert other == belief.covariance[0, 0]
    assert drive.scenario.motion.std[0] == 4.0 * KNOWN.motion.std[0]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "scenario"),
    [("npz", HIDDEN), ("parquet", KNOWN), ("minari", HIDDEN)],
    ids=["npz-hidden", "parquet-known", "minari-hidden"],
)
def test_formats_return_every_bit_and_workers_write_equal_bytes(
    name, scenario, tmp_path
):
    job = {"episodes": 4, "format": name, "episodes_per_shard": 2, "estimator": "ekf"}
    alone = generate_trajectories(scenario, tmp_path / "alone", **job)
    shared = generate_trajectories(scenario, tmp_path / "shared", jobs=2, **job)
    assert alone == shared == read_manifest(tmp_path / "alone")
    drives = drive_episodes(scenario, "waypoints", range(4))
    for drive, read in zip(drives, load_trajectories(tmp_path / "alone"), strict=True):
        expected = with_beliefs(drive, "ekf")
        for array in BELIEFS:
            before, after = getattr(expected, array), getattr(read, array)
            assert (after.dtype, after.shape) == (before.dtype, before.shape)
            assert after.tobytes() == before.tobytes()


def test_without_a_filter_neither_manifest_nor_files_name_beliefs(tmp_path):
    manifest = generate_trajectories(KNOWN, tmp_path, episodes=1)
    text = (tmp_path / "manifest.json").read_text()
    assert "estimator" not in text
    assert "numba" not in manifest.versions
    with np.load(tmp_path / "shard_00000.npz") as arrays:
        assert not set(BELIEFS) & set(arrays.files)


def test_a_filter_makes_another_job_of_smaller_shards(tmp_path, monkeypatch):
    monkeypatch.setattr(generate, "_MOST_MEMORY", 1e5)
    job = generate_trajectories(KNOWN, tmp_path, episodes=1, estimator="ekf").job
    sizes = [generate.default_episodes_per_shard(KNOWN, beliefs=b) for b in (1, 0)]
    assert job.episodes_per_shard == sizes[0] < sizes[1]
    with pytest.raises(ValueError, match=r"another job, with estimator = 'ekf', not"):
        generate_trajectories(KNOWN, tmp_path, episodes=1, estimator="invariant")


@pytest.mark.parametrize(
    ("job", "message"),
    [
        ({"estimator": "ekv"}, r"unknown estimator 'ekv'.*'ekf'"),
        ({"estimator": "ekf[nope=1]"}, "nope"),
        ({"estimator": "ekf", "format": "tum"}, "'tum', which holds no beliefs"),
        ({"estimator": "ekf", "format": "g2o"}, "'g2o', which holds no beliefs"),
        ({"estimator": ""}, "estimator"),
        ({"estimator": 5}, "estimator"),
    ],
)
def test_what_cannot_be_is_refused_before_anything_is_written(job, message, tmp_path):
    with pytest.raises((ValueError, TypeError), match=message):
        generate_trajectories(KNOWN, tmp_path / "out", episodes=1, **job)
    assert not (tmp_path / "out").exists()


@pytest.mark.usefixtures("own_registry")
@pytest.mark.parametrize("column", [1, 4])
def test_a_belief_that_is_not_finite_is_named_with_its_seed(column):
    class Diverging(EkfSlam):
        def belief(self, landmark_ids=None):
            belief = super().belief(landmark_ids)
            mean = belief.mean.copy()
            mean[column:] = np.nan if 3 < self.steps < 9 else mean[column:]
            return replace(belief, mean=mean)

    register_estimator("diverging", Diverging)
    (drive,) = drive_episodes(KNOWN, "waypoints", [6])
    message = r"'diverging', seed 6: .*the belief is not finite"
    with pytest.raises(np.linalg.LinAlgError, match=message):
        with_beliefs(drive, "diverging")


def test_a_manifest_with_another_kind_of_estimator_is_refused(tmp_path):
    generate_trajectories(KNOWN, tmp_path, episodes=1, estimator="ekf")
    path = tmp_path / "manifest.json"
    path.write_text(path.read_text().replace('"estimator": "ekf"', '"estimator": 5'))
    with pytest.raises(ValueError, match="estimator must be text, got 5"):
        read_manifest(tmp_path)
