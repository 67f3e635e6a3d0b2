"""Data sets of trajectories: right, reproducible, and indifferent to being killed."""

import hashlib
import json
import os
import pickle
import random
import subprocess
import sys
import time
import tracemalloc
from pathlib import Path

import camera
import forked
import gymnasium
import jobs_to_kill
import numpy as np
import pytest
from comparison import tree
from presets import PRESETS

from slamgym.envs.controllers import CONTROLLERS
from slamgym.experiments.command_line.commands import InterruptedRunError, main
from slamgym.experiments.command_line.generate import generate as generate_command
from slamgym.experiments.command_line.options import Options
from slamgym.experiments.job_folders import claimed
from slamgym.experiments.logs.slamlog import write_slamlog
from slamgym.experiments.trajectories import driven_episodes, generate
from slamgym.experiments.trajectories import generate as shard_work
from slamgym.experiments.trajectories.driven_episodes import drive_episodes
from slamgym.experiments.trajectories.formats import (
    FORMATS,
    to_slamlog,
    trajectory_format,
)
from slamgym.experiments.trajectories.generate import (
    default_episodes_per_shard,
    fetched,
    generate_trajectories,
    versions_of,
)
from slamgym.experiments.trajectories.manifest import (
    DamagedShardError,
    digest,
    load_trajectories,
    read_manifest,
)
from slamgym.sim_configs import load_scenario

LOOP = load_scenario("loop").with_changes(steps=30)
KILLS = int(os.environ.get("SLAMGYM_TEST_KILLS", "1"))
RANGES = {"motion_std": [0.5, 2.0], "landmark_shift": 0.5}


def small(out, **changes):
    job = {"episodes": 7, "episodes_per_shard": 3, "seed": 5, **changes}
    scenario = job.pop("scenario", LOOP)
    return generate_trajectories(scenario, out, **job)


def format_or_skip(name):
    try:
        trajectory_format(name)
    except ImportError as error:
        pytest.skip(str(error))


# what is generated


@pytest.mark.parametrize("preset", PRESETS)
def test_an_episode_is_the_log_that_slamgym_run_makes_of_its_seed(preset, tmp_path):
    controller = CONTROLLERS[len(preset) % len(CONTROLLERS)]  # they take turns
    scenario = load_scenario(preset).with_changes(steps=40)
    for drive in drive_episodes(scenario, controller, (3, 9)):
        write_slamlog(to_slamlog(drive), tmp_path / "here.csv")
        given = Options(controller=controller, seed=drive.seed)
        alone = given.record(scenario)
        write_slamlog(alone, tmp_path / "there.csv")
        here, there = (tmp_path / "here.csv"), (tmp_path / "there.csv")
        assert here.read_bytes() == there.read_bytes()


@pytest.mark.parametrize("ranges", [None, RANGES], ids=["fixed", "drawn"])
@pytest.mark.parametrize("preset", ["corridor", "hidden_identities", "slippery"])
def test_a_trajectory_replays_in_its_environment(preset, ranges):
    scenario = load_scenario(preset).with_changes(steps=60, randomise=ranges)
    for drive in drive_episodes(scenario, "random", (1, 2)):
        env = gymnasium.make("slamgym/LandmarkWorld-v0", scenario=drive.scenario)
        observation, info = env.reset(seed=drive.seed)
        assert drive.landmarks.tolist() == env.unwrapped.landmarks.tolist()
        assert drive.start_estimate.tolist() == env.unwrapped.start_estimate.tolist()
        for step, action in enumerate(drive.actions):
            pairs = [(drive.measurements[step], observation["landmarks"])]
            pairs += [(drive.mask[step], observation["mask"])]
            pairs += [(drive.poses[step], info["pose"])]
            if step > 0:
                pairs += [(drive.odometry[step - 1], observation["odometry"])]
                assert drive.collisions[step - 1] == info["collision"]
            ids = info.get("landmark_ids")
            assert (drive.landmark_ids is None) == (ids is None)
            if ids is not None:
                pairs += [(drive.landmark_ids[step], ids)]
            assert all(one.tolist() == other.tolist() for one, other in pairs)
            observation, *_, info = env.step(action)


def test_an_episode_does_not_depend_on_its_shard_or_its_neighbours(tmp_path):
    small(tmp_path / "a", episodes=6, episodes_per_shard=2, controller="random")
    small(tmp_path / "b", episodes=2, episodes_per_shard=9, seed=9, controller="random")
    fifth, sixth = list(load_trajectories(tmp_path / "a"))[4:]
    for one, other in zip(
        (fifth, sixth), load_trajectories(tmp_path / "b"), strict=True
    ):
        assert one.seed == other.seed
        assert one.actions.tolist() == other.actions.tolist()
        assert one.measurements.tolist() == other.measurements.tolist()


def test_ranges_give_every_episode_a_world_of_its_own(tmp_path):
    scenario = LOOP.with_changes(randomise=RANGES)
    small(tmp_path / "out", scenario=scenario)
    drives = list(load_trajectories(tmp_path / "out"))
    assert len({drive.scenario for drive in drives}) == 7
    assert len({drive.landmarks.shape for drive in drives}) == 1
    assert all(drive.scenario.randomise is None for drive in drives)
    again = drive_episodes(scenario, "waypoints", [8])[0]
    assert again.scenario == drives[3].scenario
    assert again.poses.tolist() == drives[3].poses.tolist()


def test_the_manifest_names_shards_seeds_and_checksums(tmp_path):
    manifest = small(tmp_path / "out")
    assert manifest == read_manifest(tmp_path / "out")
    assert manifest.is_complete
    shards = [(s.name, s.first_episode, s.episodes) for s in manifest.shards]
    assert shards == [
        ("shard_00000.npz", 0, 3),
        ("shard_00001.npz", 3, 3),
        ("shard_00002.npz", 6, 1),
    ]
    for shard in manifest.shards:
        data = (tmp_path / "out" / shard.name).read_bytes()
        assert shard.sha256 == hashlib.sha256(data).hexdigest()
    table = json.loads((tmp_path / "out" / "manifest.json").read_text())
    assert table["job"]["seed"] == 5
    assert table["versions"]["numpy"] == np.__version__
    assert [drive.seed for drive in load_trajectories(tmp_path / "out")] == [
        *range(5, 12)
    ]


def test_the_checksum_of_a_folder_is_that_of_what_sha256sum_prints(tmp_path):
    small(tmp_path / "out", format="slamlog")
    shard = tmp_path / "out" / "shard_00000"
    listing = subprocess.run(
        "LC_ALL=C ls -1 | LC_ALL=C sort | xargs sha256sum",
        shell=True,
        cwd=shard,
        capture_output=True,
        check=True,
    ).stdout
    assert digest(shard) == hashlib.sha256(listing).hexdigest()


@pytest.mark.parametrize("name", FORMATS)
def test_the_same_job_gives_the_same_bytes(name, tmp_path):
    format_or_skip(name)
    for folder in ("a", "b"):
        small(tmp_path / folder, format=name, controller="random")
    assert tree(tmp_path / "a") == tree(tmp_path / "b")


@pytest.mark.slow
def test_workers_make_the_bytes_of_one_process_in_every_format(tmp_path):
    for name in FORMATS:
        format_or_skip(name)
        job = {"format": name, "controller": "random", "episodes": 4}
        job["episodes_per_shard"] = 2
        small(tmp_path / name / "one", **job)
        small(tmp_path / name / "two", **job, jobs=2, backend="loky")
        assert tree(tmp_path / name / "one") == tree(tmp_path / name / "two")


def test_a_worker_that_does_not_see_the_folder_sends_its_files(tmp_path):
    for name in ("npz", "slamlog"):
        job = small(tmp_path / name, format=name).job
        staging = tmp_path / f"{name} staging"
        work = shard_work.ShardWork(job, versions_of(job), staging)
        made = work(range(3, 6), None)
        assert made.files
        staging.mkdir()
        staged = fetched(pickle.loads(pickle.dumps(made)), staging)
        assert digest(staged) == made.entry.sha256
        assert made.entry == read_manifest(tmp_path / name).shards[1]


def test_a_worker_with_other_versions_refuses_to_work(tmp_path):
    job = small(tmp_path / "out").job
    work = shard_work.ShardWork(job, {"numpy": "1.0.0"}, tmp_path)
    with pytest.raises(ValueError, match=r"both must be equal, for equal bytes"):
        work(range(3), None)


def test_a_shard_that_a_lost_worker_began_is_made_by_another(tmp_path):
    for name in ("npz", "slamlog"):
        manifest = small(tmp_path / name, format=name)
        job, staging = manifest.job, tmp_path / f"{name} staging"
        staging.mkdir()
        work = shard_work.ShardWork(job, versions_of(job), staging)
        lost, made = work(range(3, 6), None), work(range(3, 6), None)
        assert lost.path != made.path
        assert made.entry == manifest.shards[1]


def test_a_data_set_with_a_gap_is_extended_with_the_bytes_of_one_call(tmp_path):
    small(tmp_path / "whole", episodes=11)
    out = tmp_path / "out"
    small(out, episodes=7)
    table = json.loads((out / "manifest.json").read_text())
    del table["shards"][1]  # as workers may leave it
    (out / "manifest.json").write_text(json.dumps(table))
    small(out, episodes=11)
    assert tree(out) == tree(tmp_path / "whole")


# killed and damaged


def last_listed(out):
    manifest = out / "manifest.json"
    return manifest.stat().st_mtime_ns if manifest.exists() else 0


def run_until_killed(out, name, delay, kind=jobs_to_kill.episodes):
    """Kill the job with SIGKILL a while after some progress."""
    before = last_listed(out)
    job = forked.start(kind, out, name)
    while job.is_alive() and last_listed(out) == before:
        time.sleep(0.005)
    time.sleep(delay)
    job.kill()
    job.join()
    return job.exitcode


@pytest.mark.slow
@pytest.mark.parametrize(("name", "kills"), [("npz", 3), ("slamlog", 2)])
def test_a_job_killed_at_random_ends_with_the_bytes_of_one_that_was_not(
    name, kills, tmp_path
):
    latest = 0.06  # [s]: about two shards
    delays = [random.uniform(0.0, latest) for _ in range(kills)]
    ends = [run_until_killed(tmp_path / "killed", name, delay) for delay in delays]
    assert ends.count(forked.KILLED) >= kills - 1
    for folder in ("killed", "whole"):
        jobs_to_kill.episodes(tmp_path / folder, name)
    assert read_manifest(tmp_path / "whole").is_complete
    assert tree(tmp_path / "killed") == tree(tmp_path / "whole")


@pytest.mark.slow
def test_a_job_of_workers_killed_at_random_ends_with_the_bytes_of_one_process(tmp_path):
    kind = jobs_to_kill.episodes_by_workers
    delays = [random.uniform(0.0, 0.3) for _ in range(KILLS)]
    ends = [
        run_until_killed(tmp_path / "killed", "loky", delay, kind) for delay in delays
    ]
    assert forked.KILLED in ends
    kind(tmp_path / "killed", "loky")
    kind(tmp_path / "whole", None, None)
    assert read_manifest(tmp_path / "whole").is_complete
    assert tree(tmp_path / "killed") == tree(tmp_path / "whole")


@pytest.mark.slow
def test_workers_import_a_sensor_of_the_user_and_no_script_named_random(tmp_path):
    (tmp_path / "random.py").write_text("raise ImportError('a script of the user')")
    text = Path(camera.__file__).read_text().replace("camera:", "of_mine:")
    (tmp_path / "of_mine.py").write_text(text)  # the camera itself is on the path
    program = "from slamgym.experiments.command_line.app import main; main()"
    sensor = ["sensor.kind=of_mine:AHEAD", "sensor.std=[1, .1]", "sensor.max_range=50"]
    options = ["--episodes", "400", "--jobs", "2", "--out", "drives"]
    options += [word for change in sensor for word in ("--set", change)]
    line = [sys.executable, "-P", "-c", program, "generate", "six_landmarks", *options]
    subprocess.run(line, cwd=tmp_path, check=True, capture_output=True)
    assert read_manifest(tmp_path / "drives").is_complete


def test_rests_of_a_killed_job_are_cleared_away_and_nothing_else(tmp_path):
    small(tmp_path / "whole")
    out = tmp_path / "out"
    (out / ".writing-0123abcd").mkdir(parents=True)
    (out / ".writing-0123abcd" / "shard_00000.npz").write_text("half")
    (out / ".manifest.0123abcd.json").write_text("{")
    small(out)
    assert tree(out) == tree(tmp_path / "whole")
    (out / "notes.txt").write_text("mine")  # beside a manifest it may lie
    small(out)
    assert (out / "notes.txt").read_text() == "mine"


def test_whole_shards_are_not_driven_again(tmp_path, monkeypatch):
    small(tmp_path / "out")
    monkeypatch.setattr(driven_episodes, "drive_episodes", None)
    assert small(tmp_path / "out").is_complete


def test_an_error_while_writing_leaves_whole_shards_and_no_rests(tmp_path, monkeypatch):
    written, npz = [], FORMATS["npz"]

    def write_two(trajectories, path):
        path.write_text("half")
        if len(written) == 2:
            raise OSError("disk full")
        written.append(path)
        npz.write(trajectories, path)

    with monkeypatch.context() as patch:
        patch.setitem(FORMATS, "npz", npz._replace(write=write_two))
        with pytest.raises(OSError, match="disk full"):
            small(tmp_path / "out")
    names = sorted(entry.name for entry in (tmp_path / "out").iterdir())
    assert names == ["manifest.json", "shard_00000.npz", "shard_00001.npz"]
    with pytest.warns(UserWarning, match="6 of 7 episodes are there"):
        begun = load_trajectories(tmp_path / "out")
    assert len(begun) == 6
    assert not begun.manifest.is_complete
    small(tmp_path / "out")
    small(tmp_path / "whole")
    assert tree(tmp_path / "out") == tree(tmp_path / "whole")


def damage(path):
    """Flip one bit in a shard."""
    file = path if path.is_file() else sorted(path.rglob("*.csv"))[0]
    data = bytearray(file.read_bytes())
    data[len(data) // 2] ^= 1
    file.write_bytes(data)


def test_a_shard_that_is_gone_counts_as_damaged(tmp_path):
    small(tmp_path / "out")
    (tmp_path / "out" / "shard_00002.npz").unlink()
    with pytest.raises(DamagedShardError, match="shard_00002"):
        list(load_trajectories(tmp_path / "out"))


@pytest.mark.parametrize("name", ["npz", "slamlog"])
def test_a_damaged_shard_is_named_and_the_others_are_usable(name, tmp_path):
    out = tmp_path / "out"
    shards = small(out, format=name).shards
    before = tree(out)
    damage(out / shards[1].name)
    drives = iter(load_trajectories(out))
    assert [next(drives).seed for _ in range(3)] == [5, 6, 7]
    with pytest.raises(DamagedShardError, match=rf"{shards[1].name} .*episodes 3 to 5"):
        next(drives)
    skipping = load_trajectories(out, damaged="skip")
    with pytest.warns(UserWarning, match=rf"{shards[1].name} .*: left out"):
        assert [drive.seed for drive in skipping] == [5, 6, 7, 11]
    assert skipping.damaged_shards() == [shards[1].name]
    assert [drive.seed for drive in skipping.shard(2)] == [11]
    damaged = digest(out / shards[1].name)
    with pytest.warns(UserWarning, match=rf"{shards[1].name} does not .*\.aside"):
        small(out, format=name)  # repairs
    aside = out / f"{shards[1].name}.aside"
    assert digest(aside) == damaged
    aside.rename(tmp_path / "aside")
    assert tree(out) == before


def test_a_file_of_somebody_else_under_the_name_of_a_shard_is_set_aside(tmp_path):
    out, elsewhere = tmp_path / "out", tmp_path / "elsewhere"
    elsewhere.mkdir()
    (elsewhere / "thesis.tex").write_text("years of work")
    small(out, episodes=3, format="slamlog")
    (out / "shard_00001").write_text("mine")
    (out / "shard_00002").symlink_to(elsewhere)
    with pytest.warns(UserWarning, match=r"shard_0000[12] does not match"):
        small(out, format="slamlog")
    assert (out / "shard_00001.aside").read_text() == "mine"
    assert (out / "shard_00002.aside").readlink() == elsewhere
    assert (elsewhere / "thesis.tex").read_text() == "years of work"


@pytest.mark.parametrize("format", ["npz", "slamlog"])
def test_an_extension_killed_before_the_shard_is_listed_goes_on(
    format, tmp_path, monkeypatch
):
    small(tmp_path / "whole", format=format)
    small(tmp_path / "out", episodes=4, format=format)

    def die(*_):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(generate, "write_manifest", die)
        with pytest.raises(KeyboardInterrupt):
            small(tmp_path / "out", format=format)
    assert read_manifest(tmp_path / "out").shards[1].episodes == 1  # as before
    small(tmp_path / "out", format=format)
    assert tree(tmp_path / "out") == tree(tmp_path / "whole")


def test_a_repair_that_gives_other_bits_is_refused(tmp_path, monkeypatch):
    small(tmp_path / "out")
    damage(tmp_path / "out" / "shard_00001.npz")
    before = tree(tmp_path / "out")

    def other(scenario, controller, seeds, progress):
        return drive_episodes(scenario, controller, [seed + 1 for seed in seeds])

    monkeypatch.setattr(driven_episodes, "drive_episodes", other)
    with pytest.raises(OSError, match="does not make the same bits"):
        small(tmp_path / "out")
    assert tree(tmp_path / "out") == before


@pytest.mark.parametrize("first", [3, 4])
@pytest.mark.parametrize("format", ["npz", "slamlog"])
def test_more_episodes_end_with_the_bytes_of_one_call(first, format, tmp_path):
    small(tmp_path / "once", format=format)
    small(tmp_path / "out", episodes=first, format=format)
    small(tmp_path / "out", format=format)
    assert tree(tmp_path / "out") == tree(tmp_path / "once")


def test_more_episodes_keep_the_full_shards(tmp_path, monkeypatch):
    small(tmp_path / "out", episodes=5)
    driven = []

    def drive(scenario, controller, seeds, **options):
        driven.extend(seeds)
        return drive_episodes(scenario, controller, seeds, **options)

    monkeypatch.setattr(driven_episodes, "drive_episodes", drive)
    small(tmp_path / "out")
    assert driven == [8, 9, 10, 11]  # of seeds 5 to 11 in shards of 3


# what is refused


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"seed": 6}, "seed = 5, not 6"),
        ({"controller": "random"}, "controller = 'waypoints', not 'random'"),
        ({"format": "slamlog"}, "format = 'npz', not 'slamlog'"),
        ({"episodes": 6}, "episodes = 7, not 6"),
        ({"episodes_per_shard": 4}, "episodes_per_shard = 3, not 4"),
        ({"scenario": LOOP.with_changes(dt=0.7)}, r"scenario\.dt = .*, not 0\.7"),
        ({"scenario": LOOP.with_changes(randomise=RANGES)},
         r"scenario\.randomise = None"),
    ],
)  # fmt: skip
def test_a_folder_of_another_job_is_refused_and_untouched(changes, message, tmp_path):
    small(tmp_path / "out")
    before = tree(tmp_path / "out")
    with pytest.raises(ValueError, match=f"holds another job, with {message}"):
        small(tmp_path / "out", **changes)
    assert tree(tmp_path / "out") == before


def test_a_job_begun_with_other_versions_is_refused(tmp_path):
    small(tmp_path / "out")
    path = tmp_path / "out" / "manifest.json"
    path.write_text(path.read_text().replace(np.__version__, "1.0.0"))
    with pytest.raises(ValueError, match=r"the version of numpy = '1\.0\.0', not"):
        small(tmp_path / "out")
    assert len(list(load_trajectories(tmp_path / "out"))) == 7  # still readable


def test_a_folder_with_something_else_is_refused_and_untouched(tmp_path):
    (tmp_path / "thesis.tex").write_text("do not lose me")
    with pytest.raises(ValueError, match=r"new or empty folder.* holds thesis\.tex"):
        small(tmp_path)
    assert [entry.name for entry in tmp_path.iterdir()] == ["thesis.tex"]
    with pytest.raises(ValueError, match=r"out must be a folder, got the file"):
        small(tmp_path / "thesis.tex")


def test_a_job_that_failed_before_its_first_shard_does_not_stand_in_the_way(tmp_path):
    crowd = {"layout": "random", "count": 9, "bounds": [0.0, 0.0, 1.0, 1.0]}
    crowded = LOOP.with_changes(landmarks={**crowd, "min_distance": 5.0})
    with pytest.raises(ValueError, match="must leave room for 9 landmarks"):
        small(tmp_path / "out", scenario=crowded)
    small(tmp_path / "out")
    small(tmp_path / "whole")
    assert tree(tmp_path / "out") == tree(tmp_path / "whole")


@pytest.mark.skipif(os.name == "nt", reason="folders are not locked on Windows")
def test_a_second_writer_is_refused(tmp_path):
    with (
        claimed(tmp_path / "out"),
        pytest.raises(ValueError, match="another process is writing to"),
    ):
        small(tmp_path / "out")
    small(tmp_path / "out")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"controller": "waypoint"}, "controller must be one of .*mean 'waypoints'"),
        ({"format": "nzp"}, "format must be one of .*did you mean 'npz'"),
        ({"scenario": "lop"}, "did you mean 'loop'"),
        ({"episodes": 0}, "episodes must be an integer >= 1, got 0"),
        ({"episodes": True}, "episodes must be an integer >= 1, got True"),
        ({"seed": -1}, "seed must be an integer >= 0, got -1"),
        ({"seed": 2**63}, "seed must be at most 9223372036854775807, got 92"),
        ({"seed": 2**63 - 1}, "the seed of the last episode must be at most 9223"),
        ({"episodes_per_shard": 0}, "episodes_per_shard must be an integer >= 1"),
        ({"jobs": 0}, "jobs must be an integer"),
        ({"jobs": -2}, "jobs must be an integer"),
        ({"backend": "dusk"}, "mean 'dask'"),
        ({"scenario": "hidden_identities", "format": "g2o"}, "needs sensor.identities"),
    ],
)
def test_bad_arguments_are_named_and_nothing_is_made(changes, message, tmp_path):
    with pytest.raises(ValueError, match=message):
        small(tmp_path / "out", **changes)
    assert not (tmp_path / "out").exists()


def test_a_folder_without_a_right_manifest_is_named(tmp_path):
    with pytest.raises(ValueError, match=r"must be a data set with a manifest\.json"):
        load_trajectories(tmp_path)
    for text in ("{", "[]", "{}", '{"kind": "slamgym trajectories 9"}'):
        (tmp_path / "manifest.json").write_text(text)
        with pytest.raises(ValueError, match=r"manifest\.json must be a manifest of"):
            load_trajectories(tmp_path)
    with pytest.raises(ValueError, match="damaged must be one of raise, skip"):
        load_trajectories(tmp_path, damaged="skp")


# memory, progress, command


@pytest.mark.slow
@pytest.mark.usefixtures("usual_collector")
def test_memory_stays_flat(tmp_path):
    def peak(shards):
        tracemalloc.start()
        small(tmp_path / str(shards), episodes=10 * shards, episodes_per_shard=10)
        for drive in load_trajectories(tmp_path / str(shards)):
            assert drive.steps == 30
        _, highest = tracemalloc.get_traced_memory()
        tracemalloc.stop()
        return highest

    peak(1)  # imports and caches
    assert peak(12) < 1.2 * peak(2)


def test_a_shard_takes_no_more_than_some_memory():
    large = LOOP.with_changes(
        steps=20_000,
        landmarks={"layout": "grid", "rows": 20, "columns": 20, "spacing": 1.0},
    )
    count = default_episodes_per_shard(large)
    assert 1 <= count <= 256e6 / (20_000 * 400 * 17)
    assert default_episodes_per_shard(large.with_changes(steps=10**9)) == 1
    assert default_episodes_per_shard(LOOP) == 100


def test_progress_counts_all_steps_also_those_done_earlier(tmp_path):
    told = []
    small(tmp_path / "out", progress=lambda *step: told.append(step))
    assert told[-1] == (7 * 30, 7 * 30)
    assert [done for done, _ in told] == sorted({done for done, _ in told})
    (tmp_path / "out" / "shard_00002.npz").unlink()
    told.clear()
    small(tmp_path / "out", progress=lambda *step: told.append(step))
    assert told[0][0] == 6 * 30 + 1
    assert len(told) == 30


def command(out, **changes):
    options = {"episodes": 2, "controller": "random", "as_json": False, **changes}
    generate_command("loop", steps=30, out=out, **options)


def test_the_command_says_where_the_data_lie_and_how_to_load_them(tmp_path, capsys):
    command(tmp_path / "[b]out")
    printed = capsys.readouterr().out
    assert f"{tmp_path / '[b]out'}: 2 episodes of 30 steps as npz" in printed
    lines = printed.splitlines()[-2:]
    scope = {}
    exec("\n".join(lines).replace("...", "last = trajectory"), scope)
    assert scope["last"].seed == 1


def test_the_command_prints_one_object_for_programs(tmp_path, capsys):
    command(tmp_path / "out", as_json=True)
    printed = capsys.readouterr()
    summary = json.loads(printed.out)
    assert printed.err == ""
    assert summary["out"] == str(tmp_path / "out")
    assert (summary["episodes"], summary["steps"], summary["shards"]) == (2, 60, 1)
    assert summary["bytes"] == sum(
        f.stat().st_size for f in (tmp_path / "out").iterdir()
    )


def test_an_interrupted_command_says_that_whole_shards_stay(tmp_path, monkeypatch):
    def interrupt(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr(driven_episodes, "drive_episodes", interrupt)
    arguments = ["generate", "loop", "--episodes", "2", "--out", f"{tmp_path}/out"]
    with pytest.raises(InterruptedRunError, match=r"whole shards stay in .*out"):
        main(arguments, standalone_mode=False)
