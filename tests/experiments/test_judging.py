"""`judge`: estimates of any program have the verdict of a Monte Carlo."""

import json
import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from commands import slamgym

from slamgym import judge, load_scenario, load_trajectories, make_estimator, monte_carlo
from slamgym.estimator.models.rigid_motion import invariant_covariance, pose_rotation
from slamgym.estimator.smoother import smooth
from slamgym.experiments import (
    estimate_conventions,
    generate_trajectories,
    judging,
    nees_figure,
    read_slamlog,
    runs_figure,
    summarise_monte_carlo,
)
from slamgym.experiments.estimate_conventions import mistake_in_estimates
from slamgym.experiments.judging import NO_FILE
from slamgym.experiments.logs.slamlog import OdometryRow, Scan

ROOT = Path(__file__).parents[2]
RUNS, SEED = 24, 300
JOB = {"episodes": RUNS, "seed": SEED, "controller": "open_loop"}
JOB["episodes_per_shard"] = 10
DEGREES = np.diag([1.0, 1.0, 180 / np.pi])
ORDER = np.eye(3)[[2, 0, 1]]  # (θ, x, y)
ROWS = [*range(5), 6, 5, *range(7, 30)]  # two of the 30 poses are swapped
EXACT = {"rtol": 1e-12, "atol": 0}


@pytest.fixture(scope="module")
def drives(tmp_path_factory):
    """Return a data set that also holds what a consistent filter believes."""
    folder = tmp_path_factory.mktemp("judge") / "drives"
    generate_trajectories("six_landmarks", folder, **JOB, estimator="invariant")
    return folder


@pytest.fixture(scope="module")
def text_drives(tmp_path_factory):
    folder = tmp_path_factory.mktemp("judge") / "text"
    generate_trajectories("six_landmarks", folder, **JOB, format="slamlog")
    return folder


@pytest.fixture(scope="module")
def beliefs(drives):
    """Return seeds, poses (B, T, 3), covariances (B, T, 3, 3) and true poses."""
    data = list(load_trajectories(drives))
    names = ("seed", "belief_poses", "belief_pose_covariances", "poses")
    return tuple(np.array([getattr(d, name) for d in data]) for name in names)


@pytest.fixture
def written(tmp_path, beliefs):
    """Return a function that writes estimates as npz, and gives their folder."""

    def write(poses, covariances):
        folder = tmp_path / "mine"
        folder.mkdir(exist_ok=True)
        arrays = {"belief_poses": poses, "belief_pose_covariances": covariances}
        np.savez(folder / "all.npz", seed=beliefs[0], **arrays)
        return folder

    return write


def rows(poses, covariances, entries=9, landmarks=()):
    """Return the lines of a csv."""
    upper = np.triu_indices(3) if entries == 6 else np.indices((3, 3)).reshape(2, -1)
    lines = ["# x, y, θ", *landmarks]
    for step, (pose, P) in enumerate(zip(poses, covariances, strict=True)):
        numbers = [*pose.tolist(), *P[tuple(upper)].tolist()]
        lines.append(f"pose,{step},{','.join(map(repr, numbers))}")
    return "\n".join([*lines, ""])


def filter_text(path, estimator="invariant", *, one_by_one=False):
    """Read a drive as text and filter it; return the lines of estimates."""
    log = read_slamlog(path)
    keys = {name: name for name in ("motion_std", "measurement_std")}
    keys["initial_pose_std"] = "start_sigma"
    stds = {
        name: [float(part) for part in log.header[key].split(",")]
        for name, key in keys.items()
    }
    slam = make_estimator(estimator, initial_pose=log.start, **stds)
    poses, covariances = [], []
    for event in log.events:
        if isinstance(event, Scan):
            pairs = zip(event.measurements, event.landmark_ids.tolist(), strict=True)
            for reading, landmark in pairs if one_by_one else ():
                slam.update([reading], [landmark])
            if not one_by_one:
                slam.update(event.measurements, event.landmark_ids.tolist())
        elif isinstance(event, OdometryRow):
            poses.append(slam.belief().pose)
            covariances.append(slam.belief().pose_covariance)
            slam.predict((event.d, event.alpha))
    belief = slam.belief()
    parts = belief.landmark_ids, belief.landmarks, belief.landmark_covariances
    landmarks = [
        f"landmark,{i},{','.join(map(repr, [*place.tolist(), *P.ravel().tolist()]))}"
        for i, place, P in zip(*parts, strict=True)
    ]
    poses, covariances = [*poses, belief.pose], [*covariances, belief.pose_covariance]
    return rows(poses, covariances, landmarks=landmarks)


def entry_of(results, **options):
    (entry,) = summarise_monte_carlo(results, **options)["estimators"].values()
    return entry


@pytest.fixture(scope="module")
def study():
    return monte_carlo("six_landmarks", "invariant", RUNS, SEED)


SAME = (
    *("pose_nees_invariant", "pose_nees_additive", "position_nees_invariant"),
    *("heading_nees", "position_error", "heading_std", "ate_aligned", "pose_area"),
    *("landmark_rmse", "landmark_rmse_aligned", "landmark_nees_additive"),
    *("landmark_error", "map_error_centred", "noise_sums"),
)
BOUNDS = "position_bound", "position_bound_raw", "heading_bound", "map_bound"


@pytest.mark.parametrize("way", ["data set", "npz", "csv", "tum"])
def test_a_filter_is_judged_through_files_as_in_a_monte_carlo(
    way, drives, beliefs, written, study, request
):
    seeds, poses, covariances, _ = beliefs
    tmp_path = request.getfixturevalue("tmp_path")
    request.getfixturevalue("monkeypatch").setattr(judging, "_AT_ONCE", 7)
    folder = tmp_path / "estimates"
    folder.mkdir()
    if way == "data set":
        request.getfixturevalue("monkeypatch").delattr(judging, "_deciding")
        results = judge(drives)
    elif way == "npz":
        results = judge(written(poses, covariances), drives)
    elif way == "csv":
        text_drives = request.getfixturevalue("text_drives")
        for path in text_drives.glob("shard_*/seed_*.csv"):
            (folder / path.name).write_text(filter_text(path))
        results = judge(folder, text_drives)
    else:
        for seed, path, P in zip(seeds, poses, covariances, strict=True):
            lines = [
                (3.0 * k, x, y, 0, 0, 0, np.sin(t / 2), np.cos(t / 2), *P[k].ravel())
                for k, (x, y, t) in enumerate(path.tolist())
            ]
            np.savetxt(folder / f"seed_{seed}.tum", lines, fmt="%.17g")
        results = judge(folder, drives)
    has_map = way in ("data set", "csv")
    np.testing.assert_array_equal(results["run"], study["run"])
    assert not results["readings"].any()  # it is not known which corrected anything
    for name in SAME + BOUNDS:
        of_map = name.startswith(("landmark", "map")) or name in BOUNDS
        if has_map or not of_map:
            tolerance = {"rtol": 1e-9, "atol": 1e-12} if way == "tum" else EXACT
            np.testing.assert_allclose(results[name], study[name], **tolerance)
    ours, theirs = entry_of(results), entry_of(study)
    assert ours["verdict"] == theirs["verdict"]
    covered = "; this covers the pose only"  # this start bends errors of the landmarks
    assert ours["reason"] == theirs["reason"] + covered
    assert ours["diagnosis"]["cause"] == theirs["diagnosis"]["cause"]
    assert ours["nis"] is None
    assert (ours["efficiency"]["map"] is not None) == has_map


def to_left(poses, covariances):
    cos, sin = np.cos(poses[..., 2]), np.sin(poses[..., 2])
    turn = np.zeros((*poses.shape, 3))
    turn[..., 0, 0], turn[..., 0, 1] = cos, sin
    turn[..., 1, 0], turn[..., 1, 1], turn[..., 2, 2] = -sin, cos, 1
    return turn @ covariances @ turn.mT


def late(array):
    return np.concatenate([array[:, :1], array[:, :-1]], axis=1)


def std_of(P):
    return np.sqrt(np.einsum("...ii->...i", P))[..., None] * np.eye(3)


def swapped(array):
    return array[[0, 1, 5, 3, 4, 2, *range(6, len(array))]]


def inverse_of(poses):
    """Pose of the world in the robot's frame."""
    x, y, turn = np.moveaxis(poses, -1, 0)
    cos, sin = np.cos(turn), np.sin(turn)
    return np.stack([-cos * x - sin * y, sin * x - cos * y, -turn], axis=-1)


SWAPPED = (
    "estimates or truths of 2 drives are swapped: the estimate of drive "
    f"{SEED + 2} fits the truth of drive {SEED + 5} and the estimate of drive "
    f"{SEED + 5} fits the truth of drive {SEED + 2}."
)
STRAY = (
    f"{2 * RUNS} poses are far from the truth although their neighbours are not, as "
    f"in swapped rows; the first is step 5 of drive {SEED}, and without "
)
LEFT, RIGHT = (
    f"covariances of the {side}-invariant error (the {frame}'s frame): "
    for side, frame in (("left", "robot"), ("right", "world"))
)
IN_DEGREES = "headings in degrees instead of radians: "
OTHER_ORDER = "the order (θ, x, y) instead of (x, y, θ): "
WRONG = {
    "degrees": (lambda x, P: (x @ DEGREES, P), IN_DEGREES),
    "order": (lambda x, P: (x @ ORDER.T, ORDER @ P @ ORDER.T), OTHER_ORDER),
    "left error": (lambda x, P: (x, to_left(x, P)), LEFT),
    "right error": (lambda x, P: (x, invariant_covariance(x, P)), RIGHT),
    "time": (lambda x, P: (late(x), late(P)), "time stamps that are 1 step too late: "),
    "deviations": (
        lambda x, P: (x, std_of(P)),
        "standard deviations in place of variances: ",
    ),
    "millimetres": (lambda x, P: (x * [1e3, 1e3, 1], P), "positions in millimetres: "),
    "another truth": (lambda x, P: (x / [100, 100, 1], P), "a truth in centimetres: "),
    "swapped": (lambda x, P: (swapped(x), swapped(P)), SWAPPED),
    "rows": (lambda x, P: (x[:, ROWS], P[:, ROWS]), STRAY),
}


@pytest.mark.parametrize("wrong", WRONG)
def test_a_broken_convention_is_named_in_one_sentence(
    wrong, drives, beliefs, written, study
):
    change, sentence = WRONG[wrong]
    found = entry_of(judge(written(*change(*beliefs[1:3])), drives))
    said = found["diagnosis"]["sentence"]
    assert said.startswith(f"convention: {sentence}")
    assert said.count(".\n") == 0
    if wrong not in ("swapped", "rows", "deviations"):  # the NEES that it had
        right = float(study["pose_nees_invariant"].mean() / 3)
        stated = float(said.partition("NEES / 3 is ")[2].partition(",")[0])
        assert stated == pytest.approx(right, rel=0.2)


@pytest.mark.parametrize(
    ("preset", "estimator"),
    [
        ("six_landmarks", "ekf"),
        ("six_landmarks", "invariant"),
        pytest.param("coarse_loop", "ekf", marks=pytest.mark.slow),
    ],
)
def test_no_convention_is_blamed_for_what_a_filter_does(preset, estimator, tmp_path):
    job = {"episodes": RUNS, "seed": 7000, "estimator": estimator}
    generate_trajectories(preset, tmp_path / "drives", **job)
    results = judge(tmp_path / "drives")
    assert json.loads(results.attrs["mistakes"]) == {"drives": ""}


@pytest.mark.parametrize("correlation", [0.0, 0.5])
def test_deviations_alone_are_not_read_in_another_frame(correlation):
    """Wrong deviations of a filter can look honest there by chance."""
    rng = np.random.default_rng(4)
    poses = rng.uniform(-9, 9, (20, 50, 3))
    P = np.diag([1e-3, 1e-3, 1e-3])
    P[0, 1] = P[1, 0] = correlation * 1e-3
    xi = rng.multivariate_normal(np.zeros(3), P, (20, 50))
    truth = poses + xi
    truth[..., 0] -= poses[..., 1] * xi[..., 2]
    truth[..., 1] += poses[..., 0] * xi[..., 2]
    said = mistake_in_estimates(
        truth, poses, np.broadcast_to(P, (20, 50, 3, 3)), truth[:, 0]
    )
    frame = "covariances of the right-invariant error (the world's frame): read so"
    assert said.startswith(frame) if correlation else not said


def test_lost_drives_that_are_only_nearer_to_other_truths_are_not_swapped():
    truth, P = np.zeros((2, 5, 3)), np.broadcast_to(np.eye(3), (2, 5, 3, 3))
    truth[1, :, 0] = 40.0
    near = truth[::-1] + np.array([15.0, 0, 0]) * np.array([1, -1])[:, None, None]
    assert estimate_conventions.swapped_drives(truth, near, P, "ab") == ""
    assert estimate_conventions.swapped_drives(truth, truth[::-1], P, "ab")


def test_the_truth_is_not_an_estimate(drives, beliefs, written):
    results = judge(written(beliefs[3], beliefs[2]), drives)
    assert "the poses are the true ones" in entry_of(results)["diagnosis"]["sentence"]
    assert not results.pose_nees_invariant.any()
    for draw in nees_figure, runs_figure:  # on logarithmic axes
        draw(results).draw_without_rendering()


FRAMES = {
    "left": to_left,
    "right": invariant_covariance,
    "invariant": invariant_covariance,
    "additive": lambda _, P: P,
}


@pytest.mark.parametrize("frame", FRAMES)
def test_covariances_of_a_named_error_give_the_same_nees(
    frame, drives, beliefs, written, study
):
    poses, claims = beliefs[1], FRAMES[frame](*beliefs[1:3])
    results = judge(written(poses, claims), drives, covariances=frame)
    for name in ("pose_nees_invariant", "pose_nees_additive", "heading_nees"):
        np.testing.assert_allclose(results[name], study[name], rtol=1e-6)
    assert not json.loads(results.attrs["mistakes"])["mine"]


def changed(first, *entries):
    """Return a function that replaces entries of every line, from the first one on."""

    def change(lines):
        parts = [line.split(",") for line in lines]
        last = first + len(entries)
        return [",".join([*f[:first], *entries, *f[last:]]) for f in parts]

    return change


def stamped(time):
    """Return a function that gives every line another time."""
    return lambda lines: [
        ",".join(["pose", str(time(k)), *line.split(",")[2:]])
        for k, line in enumerate(lines)
    ]


NO_POSE = "it has no pose for {} of the steps 0 to 29; the first of them is step {}"
BROKEN = {
    "missing": (lambda lines: None, "there is no file of estimates"),
    "short": (lambda lines: lines[:-1], NO_POSE.format(1, 29)),
    "without some rows": (lambda lines: lines[:7] + lines[9:], NO_POSE.format(2, 7)),
    "late from the start": (
        stamped(lambda k: k + 1),
        "its time stamps begin at step 1, not at step 0",
    ),
    "seconds": (
        stamped(lambda k: 3 * k),
        "its time stamps are seconds, not steps of 3 s",
    ),
    "a step twice": (lambda lines: [*lines[:-1], lines[-2]], NO_POSE.format(1, 29)),
    "not in order": (
        lambda lines: [*lines[:3], lines[4], lines[3], *lines[5:]],
        "pose 3 is that of step 4; each step needs one",
    ),
    "not symmetric": (changed(6, "0.5"), "the covariance is not symmetric"),
    "negative": (changed(5, "-1"), "a variance is negative"),
    "none": (
        lambda lines: [",".join([*line.split(",")[:5], *"000000"]) for line in lines],
        "all entries of its covariances are 0",
    ),
    "unknown landmark": (
        lambda lines: [*lines, "landmark,6,0,0,1,0,1"],
        "its map has landmark 6, the world has 6 from 0 on",
    ),
}


@pytest.mark.parametrize("what", BROKEN)
def test_a_drive_without_usable_estimates_is_a_failed_run(
    what, drives, beliefs, tmp_path
):
    change, message = BROKEN[what]
    for k, (seed, x, P) in enumerate(zip(*beliefs[:3], strict=True)):
        lines = rows(x, P).splitlines()[1:]
        lines = change(lines) if k == 3 else lines
        if lines is not None:
            (tmp_path / f"seed_{seed:08d}.csv").write_text("\n".join(lines))
    results = judge({"mine": tmp_path}, drives)
    found = entry_of(results)
    assert [failure["run"] for failure in found["failed_runs"]] == [3]
    assert found["failed_runs"][0]["message"] == message
    steps = {"unknown landmark": 29, "not symmetric": 0, "negative": 0, "none": 0}
    assert found["failed_runs"][0]["step"] == steps.get(what, -1)
    assert found["verdict"] == "not shown"
    assert found["reason"].startswith(f"1 of {RUNS} runs failed; of the others, ")
    for name in ("ate", "ate_aligned", "pose_area"):  # an unknown landmark is no pose
        is_none = results.failed & (what != "unknown landmark")
        assert (np.isnan(results[name]) == is_none).all(), name


REFUSED = {
    "pose,0,1,2": "expected pose,t,x,y,θ and 6 or 9 entries of its covariance",
    "pose,0,1,2,east,1,0,0,1,0,1": "line 1: expected a finite number, got 'east'",
    "pose,0,1,2,nan,1,0,0,1,0,1": "line 1: expected a finite number, got 'nan'",
    "place,0": "got 'place'",
    "landmark,0,0,0,1,0,1": "got no pose",
    "": "got an empty file",
    "pose,0,1,2,0,1,0,0,1,0,1\npose,1,1,2,0,1,0,0,0,1,0,0,0,1": "lines of several",
    "landmark,0,0,0,1,0,1\nlandmark,0,0,0,1,0,1": "each landmark once, got 0 again",
}


@pytest.mark.parametrize("text", REFUSED)
def test_a_malformed_csv_is_refused_with_its_line(text, drives, tmp_path):
    path = tmp_path / f"seed_{SEED}.csv"
    path.write_text(text)
    with pytest.raises(ValueError, match=re.escape(REFUSED[text])) as refusal:
        judge(path, drives)
    assert str(path) in str(refusal.value)


def test_a_damaged_or_foreign_npz_is_refused(drives, tmp_path):
    path = tmp_path / "mine.npz"
    for content in b"PK\x03\x04 from a bad disk", b"PK":
        path.write_bytes(content)
        with pytest.raises(
            ValueError, match=r"mine\.npz is truncated, or no npz(?!.*pickle)"
        ):
            judge(path, drives)
    P = np.zeros((1, 3, 3))
    for poses, others, message in (
        (np.zeros((3, 3)), {}, "no belief_pose_covariances"),
        ([[0.0]], {"belief_pose_covariances": P}, r"belief_poses must be \(T, 3\)"),
        (np.zeros((2, 3)), {"seed": [1, 2, 3], "belief_pose_covariances": np.eye(3)},
         "a row for each seed"),
    ):  # fmt: skip
        np.savez(path, belief_poses=poses, **others)
        with pytest.raises(ValueError, match=message):
            judge(path, drives)


def test_what_matches_no_drive_is_refused(drives, beliefs, tmp_path):
    path, empty = tmp_path / "seed_7.csv", tmp_path / "empty"
    path.write_text(rows(beliefs[1][0], beliefs[2][0]))
    empty.mkdir()
    for call, message in (
        (lambda: judge(path, drives), f"such as seed_{SEED:08d}.csv, got .*seed_7"),
        (lambda: judge(path), "got neither"),
        (lambda: judge(path, drives, truth=path),
         "truth must be None where drives are given"),
        (lambda: judge(path, drives, covariances="up"),
         "covariances must be 'additive' or"),
        (lambda: judge(tmp_path / "nowhere", drives), "does not exist"),
        (lambda: judge(empty, drives), "got none in"),
    ):  # fmt: skip
        with pytest.raises(ValueError, match=message):
            call()
    shutil.copy(path, tmp_path / "seed_0007.csv")
    with pytest.raises(ValueError, match="are both of drive 7"):
        judge(tmp_path, drives)


def test_a_data_set_without_beliefs_is_refused(text_drives):
    with pytest.raises(ValueError, match="generated without --estimator"):
        judge(text_drives)


# --------------------------------------------------------------------------------------
# Truth from elsewhere.


@pytest.mark.parametrize(
    ("offset", "claimed", "accepted"),
    [(0.0, 1.0, True), (0.5, 1.0, False), (0.0, 0.01, False), (0.0, 30.0, False)],
)
def test_a_map_in_the_frame_of_the_start_is_judged(offset, claimed, accepted, tmp_path):
    drives = tmp_path / "drives"
    generate_trajectories("anchored", drives, **JOB, estimator="invariant")
    (tmp_path / "mine").mkdir()
    for drive in load_trajectories(drives):
        np.savez(
            tmp_path / "mine" / f"seed_{drive.seed}.npz",
            belief_poses=drive.belief_poses,
            belief_pose_covariances=drive.belief_pose_covariances,
            belief_landmarks=drive.belief_landmarks + np.array([offset, 0.0]),
            belief_landmark_covariances=drive.belief_landmark_covariances * claimed,
            belief_landmark_ids=drive.belief_landmark_ids,
        )
    entry = entry_of(judge(tmp_path / "mine", drives))
    assert entry["decisions"]["final_step"]["accepted"]
    assert entry["decisions"]["map"]["accepted"] == accepted
    assert (entry["verdict"] == "not consistent") == (not accepted)
    assert ("those of the map do not" in entry["reason"]) == (not accepted)


def test_a_map_is_bent_by_an_uncertain_heading_of_the_start_alone(tmp_path):
    drives, mine = tmp_path / "drives", tmp_path / "mine"
    few = JOB | {"episodes": 2, "episodes_per_shard": 2}
    start = {"pose": [4.0, 9.0, 0.3]}
    world = load_scenario("anchored").with_changes(start=start)
    generate_trajectories(world, drives, **few, estimator="invariant")
    mine.mkdir()
    expected = []
    for drive in load_trajectories(drives):
        names = [name for name in vars(drive) if name.startswith("belief_")]
        arrays = {name: np.array(getattr(drive, name)) for name in names}
        ids = arrays["belief_landmark_ids"][-1]
        away = np.linalg.norm(drive.landmarks[ids] - drive.belief_poses[0, :2], axis=1)
        least = np.linalg.eigvalsh(arrays["belief_landmark_covariances"][-1])[:, 0]
        limits = 0.2 * np.sqrt(least) / away  # of the variance
        bent = limits < np.median(limits)
        arrays["belief_pose_covariances"][0, 2, 2] = np.median(limits)
        arrays["belief_pose_covariances"][-1, 2, 2] += 1.0
        np.savez(mine / f"seed_{drive.seed}.npz", **arrays)
        expected.append(np.isin(np.arange(len(drive.landmarks)), ids[~bent]))
    results = judge(mine, drives)
    known = np.isfinite(results.landmark_deviation_x[0])
    np.testing.assert_array_equal(known, expected)


@pytest.fixture
def elsewhere(tmp_path, beliefs):
    """Return folders of true paths and of estimates as TUM."""
    for name in ("truth", "mine"):
        (tmp_path / name).mkdir()
    for seed, x, P, truth in zip(*beliefs, strict=True):
        for name, poses, claims in (("truth", truth, None), ("mine", x, P)):
            half = poses[:, 2] / 2
            zero = np.zeros(len(poses))
            columns = [np.arange(len(poses)) * 0.1, *poses[:, :2].T, zero, zero, zero]
            columns += [np.sin(half), np.cos(half)]
            if claims is not None:
                columns += [*claims.reshape(-1, 9).T]
            path = tmp_path / name / f"drive_{seed}.tum"
            np.savetxt(path, np.column_stack(columns), fmt="%.17g")
    return tmp_path / "mine", tmp_path / "truth"


def test_true_paths_from_elsewhere_give_the_same_nees(elsewhere, study):
    mine, truth = elsewhere
    results = judge(mine, truth=truth)
    for name in ("pose_nees_invariant", "pose_nees_additive", "position_error"):
        np.testing.assert_allclose(results[name], study[name], rtol=1e-6, atol=1e-9)
    found = entry_of(results)
    assert found["verdict"] == entry_of(study)["verdict"]
    assert found["diagnosis"] is None
    assert found["efficiency"] is None


def move(file, at):
    """Move the poses of a TUM file as a whole."""
    rows = np.loadtxt(file)
    places = complex(*at[:2]) + np.exp(1j * at[2]) * (rows[:, 1] + 1j * rows[:, 2])
    half = np.arctan2(rows[:, 6], rows[:, 7]) + at[2] / 2
    rows[:, 1:3] = np.column_stack([places.real, places.imag])
    rows[:, 6:8] = np.column_stack([np.sin(half), np.cos(half)])
    if rows.shape[1] > 8:
        turn = pose_rotation(at[2])
        rows[:, 8:] = (turn @ rows[:, 8:].reshape(-1, 3, 3) @ turn.T).reshape(-1, 9)
    np.savetxt(file, rows, fmt="%.17g")


def test_paths_from_elsewhere_in_the_frame_of_their_start_are_named(
    elsewhere, beliefs, study
):
    mine, truth = elsewhere
    for path, true in zip(sorted(truth.iterdir()), beliefs[3], strict=True):
        move(mine / path.name, inverse_of(true[0]))
        move(path, (3.0, -2.0, 0.7))
    said = entry_of(judge(mine, truth=truth))["diagnosis"]["sentence"]
    start, _, end = said.partition(": read so, NEES / 3 is ")
    assert start == "convention: poses in the frame of the start"
    right = float(study.pose_nees_invariant.mean()) / 3
    assert float(end.partition(",")[0]) == pytest.approx(right, rel=0.2)


BAD_TRUTH = {
    "no rotation": (
        lambda rows: rows * [1, 1, 1, 1, 0, 0, 0, 0],
        "line 1: expected a rotation qx qy qz qw of length 1 in the fields 5 to 8, got "
        "one of length 0",
    ),
    "equal times": (
        lambda rows: rows * [0, *7 * [1]] + [1.6e9, *7 * [0]],
        "line 1: expected time stamps that grow, got 1600000000 in all 30 rows; write "
        "them with more digits",
    ),
    "whole seconds": (
        lambda rows: np.column_stack([rows[:, 0].round(), rows[:, 1:]]),
        "line 2: expected a time stamp after 0, got 0; write all digits",
    ),
    "rows not in order": (
        lambda rows: rows[[0, *range(7), 9, 8, 7, *range(10, 30)]],
        "line 10: expected a time stamp after 0.90000000000000002, got "
        "0.80000000000000004; sort the rows by time",
    ),
    "another clock": (
        lambda rows: rows + np.array([50, *7 * [0]]),
        "and its truth must share at least two times, got 0 to 2.9 s, and 50 to 52.9 s",
    ),
}


@pytest.mark.parametrize("wrong", BAD_TRUTH)
def test_a_wrong_true_path_is_refused_with_its_line(wrong, elsewhere):
    mine, truth = elsewhere
    change, message = BAD_TRUTH[wrong]
    path = truth / f"drive_{SEED}.tum"
    np.savetxt(path, change(np.loadtxt(path)), fmt="%.17g")
    with pytest.raises(ValueError, match=re.escape(message)) as refusal:
        judge(mine / path.name, truth=path)
    assert f"drive_{SEED}.tum" in str(refusal.value)


def test_poses_in_a_gap_of_the_truth_are_left_out_and_counted(elsewhere):
    mine, truth = elsewhere
    before = judge(mine, truth=truth).pose_nees_invariant
    _, *paths = sorted(truth.iterdir())
    for path in paths:
        lines = path.read_text().splitlines()
        path.write_text("\n".join(lines[:9] + lines[21:]))
    results = judge(mine, truth=truth)
    there = [*range(9), *range(21, 30)]
    np.testing.assert_allclose(results.pose_nees_invariant[:, 1:], before[:, 1:, there])
    (note,) = (n for n in summarise_monte_carlo(results)["notes"] if "truth" in n)
    assert note.startswith(f"{12 * (RUNS - 1)} of {30 * RUNS} poses have no truth near")
    assert note.endswith(f"the first file is {mine / paths[0].name}, with 12.")


@pytest.mark.parametrize("start", [0, 1_600_000_000])
def test_nanoseconds_beside_seconds_are_converted_with_a_word(start, elsewhere):
    mine, truth = elsewhere
    for path in [*mine.iterdir(), *truth.iterdir()]:
        rows = np.loadtxt(path)
        rows[:, 0] += start
        np.savetxt(path, rows, fmt="%.17g")
    before = judge(mine, truth=truth)
    for folder, what in ((truth, "of the truth are"), (mine, "")):
        for path in folder.iterdir():
            fields = [line.split() for line in path.read_text().splitlines()]
            for row in fields:
                row[0] = str(round(float(row[0]) * 1e9))
            path.write_text("\n".join(map(" ".join, fields)))
        results = judge(mine, truth=truth)
        np.testing.assert_allclose(
            results.pose_nees_invariant, before.pose_nees_invariant, rtol=1e-3
        )
        notes = summarise_monte_carlo(results)["notes"]
        assert (f"the time stamps {what} nanoseconds" in "".join(notes)) == bool(what)


@pytest.mark.parametrize("unit", [1.0, 1e9])
def test_converted_times_beyond_the_truth_stay_beyond_it(unit):
    """But for what rounding adds to the last one."""
    t = np.arange(10.0)
    path = np.column_stack([1e9 / unit * t, t, t, 0 * t])[:8]
    found, what = judging._in_seconds(unit * t, np.column_stack([t, t, 0 * t]), path)
    np.testing.assert_allclose(found, 1e9 / unit * t)
    assert what == ("of the truth are nanoseconds" if unit == 1 else "are nanoseconds")
    rounded = unit * np.append(t[:7], 7 + 2e-7)
    found, _ = judging._in_seconds(rounded, path[:, 1:], path)
    assert found[-1] == path[-1, 0]


@pytest.mark.parametrize(("noise", "turn"), [(0.41, -0.5), (0.46, 0.0)])
def test_a_fit_turns_what_it_explains_most_of(noise, turn):
    rng = np.random.default_rng(1)
    truth = rng.normal(size=(200, 2))
    turned = truth @ np.array([[np.cos(0.5), np.sin(0.5)], [-np.sin(0.5), np.cos(0.5)]])
    motion = judging._fitted(turned + noise * rng.normal(size=(200, 2)), truth)
    assert motion.angle == pytest.approx(turn, abs=0.1)
    if not turn:
        aside = judging._fitted(np.array([[1.0, 2], [3, 4]]), np.array([[7.0, 7]] * 2))
        assert (aside.angle, aside.translation.tolist()) == (0, [5, 4])


def test_a_start_that_is_certain_is_no_failure():
    claims = np.tile(np.eye(3), (2, 4, 1, 1))
    claims[0, 0], claims[1, 2, 1, 1] = 0.0, -1.0
    assert judging._invalid(claims, claims, {}) == {1: (2, "a variance is negative")}
    claims = np.tile(np.eye(3), (7, 4, 1, 1))
    claims[0, 2, 0, 1], claims[1] = np.nan, 0.0
    claims[2, 1, 0, 1], claims[3, 0, 2, 2] = 2e-6, -1e-9
    claims[4, 3, :2, :2] = [[4, 4.1], [4.1, 4]]  # the correlation is 1.025
    claims[5, 1, 0, 1], claims[6, 3, 1, 1] = 0.9e-6, -5.0
    assert judging._invalid(claims, 9 * claims, {6: "lost before"}) == {
        0: (2, "an entry of the covariance is not finite"),
        1: (0, "all entries of its covariances are 0"),
        2: (1, "the covariance is not symmetric"),
        3: (0, "a variance is negative"),
        4: (3, "the covariance is indefinite: a correlation is too large"),
    }


def test_two_runs_are_enough_to_reject_and_one_is_not():
    nees = np.full((2, 21), 99.0)
    assert judging._is_rejected(nees)
    assert not judging._is_rejected(nees[:1])
    assert not judging._is_rejected(np.full((3, 21), 3.0))


def additive_studies(rng, runs, steps=30, turn=0.1):
    """Return truth, estimates and covariances: errors are exactly additive."""
    turns = rng.normal(0, turn, (runs, steps))
    heading = np.cumsum(turns, axis=1)
    place = np.cumsum(np.stack([np.cos(heading), np.sin(heading)], -1), axis=1)
    truth = np.concatenate([place, heading[..., None]], axis=-1)
    std = np.array([0.05, 0.05, 0.04])
    errors = np.cumsum(std * rng.normal(size=truth.shape), axis=1)
    k = np.arange(1, steps + 1)[:, None, None]
    claims = np.broadcast_to(k * np.diag(std**2), (runs, steps, 3, 3))
    return truth, truth - errors, claims


@pytest.fixture
def additive(tmp_path):
    """Return a function that writes additive studies: estimates, and truth as TUM."""

    def write(rng, late=0.0, turn=0.1):
        for k, (path, poses, P) in enumerate(
            zip(*additive_studies(rng, 60, turn=turn), strict=True)
        ):
            half, zero = path[:, 2] / 2, np.zeros(30)
            columns = [np.arange(30) - late, *path[:, :2].T, zero, zero, zero]
            columns += [np.sin(half), np.cos(half)]
            for name in ("t", "e"):
                (tmp_path / name).mkdir(exist_ok=True)
            np.savetxt(tmp_path / "t" / f"seed_{k}.tum", np.column_stack(columns))
            (tmp_path / "e" / f"seed_{k}.csv").write_text(rows(poses, P))
        return tmp_path / "e", tmp_path / "t"

    return write


def test_additive_errors_are_decided_in_the_additive_frame(additive):
    """Where the heading is uncertain, an arc is no ellipse of the invariant error."""
    estimates, truth = additive(np.random.default_rng(8))
    for covariances in "additive", None:
        results = judge(estimates, truth=truth, covariances=covariances)
        summary = summarise_monte_carlo(results)
        assert summary["frame"] == "additive"
        assert summary["estimators"]["e"]["verdict"] != "not consistent"


@pytest.mark.parametrize("honest", ["additive", "invariant"])
def test_the_error_that_rejects_decides_only_if_both_reject(honest):
    """Even if its mean is nearer to 3, because it errs to both sides."""
    rng = np.random.default_rng(5)
    other = "invariant" if honest == "additive" else "additive"
    nees = rng.chisquare(3, (60, 21))
    nees *= 3.1 / nees[:, 1:].mean()
    uneven = nees * np.where(np.arange(21) > 10, 1.7, 0.3)
    uneven *= 3 / uneven[:, 1:].mean()
    block = {f"pose_nees_{honest}": nees, f"pose_nees_{other}": uneven}
    assert judging._deciding({"mine": [judging._Part(block, ())]}) == (honest, [])
    block[f"pose_nees_{honest}"] = nees * np.where(np.arange(21) > 10, 1.8, 0.3)
    assert judging._deciding({"mine": [judging._Part(block, ())]}) == (other, [])


@pytest.mark.parametrize(
    ("additive", "invariant", "chosen"),
    [(1.4, 2, "additive"), (1.6, 2, "invariant"), (0.7, 1.25, "invariant")],
)
def test_of_two_rejected_errors_the_nearer_decides(additive, invariant, chosen):
    nees = np.random.default_rng(5).chisquare(3, (60, 21))
    nees *= 3 / nees[:, 1:].mean()
    both = {"pose_nees_additive": additive, "pose_nees_invariant": invariant}
    block = {name: factor * nees for name, factor in both.items()}
    assert judging._deciding({"mine": [judging._Part(block, ())]}) == (chosen, [])


def test_an_estimator_that_diverges_does_not_choose_the_error_of_others():
    nees = np.random.default_rng(6).chisquare(3, (60, 21))
    mine = {"pose_nees_additive": nees, "pose_nees_invariant": 1.3 * nees}
    lost = {name: 1e4 * values for name, values in mine.items()}
    parts = {"mine": [judging._Part(mine, ())], "lost": [judging._Part(lost, ())]}
    assert judging._deciding(parts) == ("additive", [])


def test_an_estimator_that_agrees_only_with_the_other_error_is_named():
    """One error decides for all estimators of a call."""
    nees = np.random.default_rng(7).chisquare(3, (60, 21))
    parts = {
        label: [judging._Part({f"pose_nees_{one}": nees, f"pose_nees_{two}": far}, ())]
        for label, one, two, far in (
            ("a", "additive", "invariant", 2 * nees),
            ("b", "invariant", "additive", 3 * nees),
        )
    }
    frame, (note,) = judging._deciding(parts)
    label, other = ("a", "additive") if frame == "invariant" else ("b", "invariant")
    assert note == (
        f"{label}: its covariances agree with the {other} error, but not with the "
        f"{frame} error, which decides for all estimators. Judge {label} in a "
        "separate call."
    )


@pytest.mark.parametrize("turn", [0.1, 0.5])
def test_a_clock_that_is_half_a_step_off_is_named(additive, turn):
    """The robot may turn so much that interpolation of the truth is inaccurate."""
    estimates, truth = additive(np.random.default_rng(9), late=0.5, turn=turn)
    said = entry_of(judge(estimates, truth=truth))["diagnosis"]["sentence"]
    assert said.startswith("convention: time stamps that are 0.5 steps too late: ")


def test_the_truth_given_as_the_estimate_is_named_despite_rounding(elsewhere):
    mine, truth = elsewhere
    for path in truth.iterdir():
        rows = np.loadtxt(path)
        rows[:, 1:8] = np.loadtxt(mine / path.name)[:, 1:8]
        np.savetxt(path, rows, fmt="%.17g")
    said = entry_of(judge(mine, truth=truth))["diagnosis"]["sentence"]
    assert said.startswith("convention: the poses are the true ones to the last digit")


def test_a_truth_with_fewer_poses_than_the_estimate_is_reported(elsewhere):
    mine, truth = elsewhere
    assert not any("fewer poses" in note for note in notes_of(mine, truth))
    for path in truth.iterdir():
        np.savetxt(path, np.loadtxt(path)[::2], fmt="%.17g")
    assert any("fewer poses than the estimate" in n for n in notes_of(mine, truth))


def notes_of(estimates, truth):
    return summarise_monte_carlo(judge(estimates, truth=truth))["notes"]


def test_a_covariance_with_rotations_first_is_refused(elsewhere):
    mine, truth = elsewhere
    path = mine / f"drive_{SEED}.tum"
    rows, whole = np.loadtxt(path), np.zeros((30, 6, 6))
    whole[:, [2, 3, 4], [2, 3, 4]] = 0.01
    np.savetxt(path, np.column_stack([rows[:, :8], whole.reshape(30, 36)]), fmt="%.17g")
    with pytest.raises(ValueError, match=r"line 1: .* write positions before"):
        judge(mine, truth=truth)


def test_one_estimate_and_one_truth_need_no_common_name(elsewhere, tmp_path):
    mine, truth = elsewhere
    path = tmp_path / "path.tum"
    shutil.copy(mine / f"drive_{SEED}.tum", path)
    results = judge(path, truth=truth / f"drive_{SEED}.tum")
    assert results.sizes["run"] == 1
    assert entry_of(results)["verdict"] == "not shown"
    with pytest.raises(ValueError, match="must share their names"):
        judge(path, truth=truth)


def test_drives_from_elsewhere_are_called_by_the_names_of_their_files(elsewhere):
    mine, truth = elsewhere
    first, last = f"drive_{SEED + 3}", f"drive_{SEED + RUNS - 1}"
    (mine / f"{first}.tum").unlink()
    for path in (mine / f"{last}.tum", truth / f"{last}.tum"):
        path.rename(path.with_stem("seed_7"))
    (mine / "seed_7.tum").unlink()
    out = mine.parent / "out"
    done = slamgym("judge", mine, "--truth", truth, "--out", out)
    printed = " ".join(done.stdout.split())
    assert f"the worst first: drives 7, {first}" in printed
    assert f"2 × {NO_FILE} (first: run 7)" in printed
    (entry,) = json.loads((out / "summary.json").read_text())["estimators"].values()
    assert [failure["run"] for failure in entry["failed_runs"]] == ["7", first]
    with xr.open_dataset(out / "results.nc") as saved:
        assert saved["run"].values[0] == "7"
        assert saved.sel(run=first)["failed"].values.tolist() == [1]


def test_an_estimate_is_judged_at_its_own_times(elsewhere):
    mine, truth = elsewhere
    before = judge(mine, truth=truth)
    for path in sorted(mine.iterdir())[:3]:
        lines = path.read_text().splitlines()
        path.write_text("\n".join([*lines[:10:2], *lines[10:]]))
    results = judge(mine, truth=truth)
    assert results.sizes["step"] == before.sizes["step"] - 5
    np.testing.assert_allclose(
        results.pose_nees_invariant[:, 3:, -1], before.pose_nees_invariant[:, 3:, -1]
    )


def test_an_alignment_transforms_the_covariance_with_the_error(
    beliefs, drives, written, study
):
    """T X̂ for each error: additive R P Rᵀ, left P, right Ad P Adᵀ."""
    _, poses, P, _ = beliefs
    x, y, turn = 3.0, -2.0, 0.8
    cos, sin = np.cos(turn), np.sin(turn)
    moved = poses.copy()  # T⁻¹ X̂, so that T brings it back
    moved[..., 0] = cos * (poses[..., 0] - x) + sin * (poses[..., 1] - y)
    moved[..., 1] = cos * (poses[..., 1] - y) - sin * (poses[..., 0] - x)
    moved[..., 2] -= turn
    inverse = np.array([[cos, sin, 0], [-sin, cos, 0], [0, 0, 1]])
    adjoint = np.array([[cos, -sin, y], [sin, cos, -x], [0, 0, 1]])
    back = np.linalg.inv(adjoint)
    claims = {
        "additive": inverse @ P @ inverse.T,
        "left": to_left(poses, P),
        "right": back @ invariant_covariance(poses, P) @ back.T,
    }
    for frame, claim in claims.items():
        folder = written(moved, claim)
        results = judge(folder, drives, covariances=frame, align=(x, y, turn))
        for name in ("pose_nees_invariant", "pose_nees_additive"):
            np.testing.assert_allclose(results[name], study[name], rtol=1e-6)
        found = entry_of(results, frame="invariant")
        assert found["verdict"] == entry_of(study)["verdict"]


def test_a_fitted_alignment_leaves_no_verdict(drives):
    found = entry_of(judge(drives, align="fit"))
    assert found["verdict"] == "not shown"
    assert "an alignment fitted to the errors" in found["reason"]
    assert {found[key] for key in ("accepted", "decisions", "diagnosis")} == {None}
    assert found["ate"]["raw"] == pytest.approx(found["ate"]["aligned"])
    with pytest.raises(ValueError, match="align must be"):
        judge(drives, align="best")


# --------------------------------------------------------------------------------------
# Worlds with ranges and hidden identities, several estimators, the command.


def test_worlds_with_ranges_and_hidden_identities_are_judged(tmp_path):
    changes = {"sensor": {"dropout": 0.1}, "randomise": {"motion_std": [0.5, 2.0]}}
    for name, preset, more in (
        ("ranges", "six_landmarks", changes),
        ("hidden", "hidden_identities", {"steps": 40}),
    ):
        world = load_scenario(preset).with_changes(**more)
        job = {"episodes": 5, "estimator": "invariant"}
        generate_trajectories(world, tmp_path / name, **job)
        results = judge(tmp_path / name)
        found = entry_of(results)
        assert found["good_runs"] == 5
        count, _, squares = results.noise_sums.values[0, ..., :3].sum(axis=1).T
        assert (abs(squares - count) < 5 * np.sqrt(2 * count)).all()  # of each run
        assert 0.2 < found["pose_nees"]["invariant"]["mean"] < 3
        assert (found["landmark_rmse"]["raw"] is None) == (name == "hidden")


@pytest.mark.slow
def test_the_command_judges_two_estimators(drives, beliefs, written, tmp_path):
    mine = written(*beliefs[1:3])
    yours = tmp_path / "yours"
    yours.mkdir()
    for seed, x, P in zip(*beliefs[:3], strict=True):
        (yours / f"seed_{seed}.csv").write_text(rows(x, P / 9, entries=6))
    out = tmp_path / "out"
    done = slamgym("judge", mine, yours, "--drives", drives, "--out", out)
    assert done.exit_code == 0, done.stderr
    assert "yours: not consistent: the squared errors of the pose are" in " ".join(
        done.stdout.split()
    )
    summary = json.loads((out / "summary.json").read_text())
    assert [e["verdict"] for e in summary["estimators"].values()][1] == "not consistent"
    assert {"report.html", "results.nc", "summary.json"} == set(summary["files"])
    assert "yours" in (out / "report.html").read_text()
    again = slamgym("judge", drives, "--frame", "additive", "--json", "--out", out)
    printed = json.loads(again.stdout)
    assert list(printed["estimators"]) == ["drives"]
    assert (printed["out"], printed["frame"]) == (str(out), "additive")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--frame", "up"], "--frame must be one of additive, invariant, got 'up'"),
        (["--align", "1,2"], "--align must be fit or X,Y,THETA, got '1,2'"),
        (["--covariances", "up"], "must be 'additive' or 'invariant' or 'right' or"),
        (["--drives", "nowhere"], "nowhere must be a data set with a manifest.json"),
    ],
)
def test_a_wrong_option_is_refused_in_one_line(arguments, message, drives, tmp_path):
    done = slamgym("judge", drives, *arguments, "--out", tmp_path / "out")
    assert done.exit_code == 2
    assert message in done.stderr
    assert not (tmp_path / "out").exists()


def test_no_usable_estimate_is_a_failure(drives, beliefs, tmp_path):
    path = tmp_path / f"seed_{SEED}.csv"
    path.write_text(rows(beliefs[1][0][:9], beliefs[2][0][:9]))
    done = slamgym("judge", path, "--drives", drives, "--out", tmp_path / "out")
    assert done.exit_code == 1
    assert f"{RUNS} of {RUNS} runs failed" in done.stdout


# --------------------------------------------------------------------------------------
# The examples.


def test_a_program_in_c_is_judged(text_drives, tmp_path):
    compiler = next((c for c in ("cc", "gcc", "clang") if shutil.which(c)), None)
    if compiler is None:
        pytest.skip("there is no C compiler")
    source = ROOT / "examples" / "16_judge_a_program_in_c.c"
    program = tmp_path / "ekf_slam"
    strict = ["-O2", "-std=c99", "-Wall", "-Wextra", "-Werror"]
    subprocess.run([compiler, *strict, source, "-o", program, "-lm"], check=True)
    estimates = tmp_path / "estimates"
    estimates.mkdir()
    files = sorted(text_drives.glob("shard_*/seed_*.csv"))
    subprocess.run([program, estimates, *files], check=True)
    results = judge(estimates, text_drives)
    assert not results.failed.any()
    assert not json.loads(results.attrs["mistakes"])["estimates"]
    same = tmp_path / "same"
    same.mkdir()
    for path in files:
        (same / path.name).write_text(filter_text(path, "ekf", one_by_one=True))
    expected = judge(same, text_drives)
    for name in ("pose_nees_invariant", "landmark_nees_additive", "landmark_rmse"):
        np.testing.assert_allclose(results[name], expected[name], rtol=1e-6)


@pytest.mark.slow
def test_the_example_of_gtsam_names_the_frame(tmp_path):
    pytest.importorskip("gtsam")
    done = subprocess.run(
        [sys.executable, ROOT / "examples" / "14_judge_gtsam.py", "--drives", "24"],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=True,
    )
    left, honest, additive, cause = done.stdout.splitlines()
    assert left.startswith("covariances='left': isam2: ")
    assert "not consistent" not in left
    assert honest.startswith("honest: ")
    assert additive.startswith("covariances='additive': isam2: not consistent: ")
    assert cause.startswith("convention: covariances of the left-invariant error")


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (judge, "estimates must be paths of files, got None"),
        (lambda _: judge({"mine": 3}), "estimates must be paths of files, got 3"),
        (smooth, "drive must be a Drive, got NoneType; smooth_log"),
    ],
)
def test_what_is_no_path_and_no_drive_is_named(call, message):
    with pytest.raises(TypeError, match=message):
        call(None)
