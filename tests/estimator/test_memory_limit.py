"""A map that memory does not hold is refused with the figures, and nothing is lost."""

import re

import numpy as np
import psutil
import pytest
from comparison import assert_same_bits
from town_drives import TOWN_MOTION_STD, map_all, town, wander

from slamgym.estimator import EkfSlam, IteratedEkfSlam, SubmapSlam
from slamgym.estimator.guards import argument_checks as memory_limit
from slamgym.estimator.interface import Belief
from slamgym.estimator.large_maps.compressed.compressed_slam import CompressedEkfSlam
from slamgym.estimator.models.bearing_range import predict_measurement
from slamgym.experiments.command_line.app import main
from slamgym.experiments.logs.slamlog import OdometryRow, Scan, SlamLog
from slamgym.experiments.run_and_replay.filter_settings import (
    refuse_large_map,
    refuse_large_maps,
)
from slamgym.experiments.run_and_replay.simulated_runs import simulate_runs

NOISE = (TOWN_MOTION_STD, (0.01, 0.05))
FILTERS = {
    "ekf": lambda: EkfSlam(*NOISE),
    "iterated": lambda: IteratedEkfSlam(*NOISE),
    "compressed": lambda: CompressedEkfSlam(*NOISE),
    "compressed, of a fixed size": lambda: CompressedEkfSlam(*NOISE, local_size=60),
}


@pytest.fixture
def leave(monkeypatch):
    """Leave so many bytes of memory, and except no map for being small."""
    monkeypatch.setattr(memory_limit, "SMALL", 0)

    def left(size):
        monkeypatch.setattr(memory_limit, "available_memory", lambda: float(size))

    left(np.inf)
    return left


def scans(count):
    """Read a town from the origin, its identities apart from those of `map_all`."""
    readings = predict_measurement(np.zeros(3), town(count)[0]).measurement
    for first in range(0, count, 50):
        yield readings[first : first + 50], range(1000 + first, 1050 + first)


def grow_until_refused(slam, count):
    """Return how many scans a filter took, and what it said of the next one."""
    for taken, (readings, ids) in enumerate(scans(count)):
        try:
            slam.update(readings, ids)
        except MemoryError as error:
            return taken, str(error)
    raise AssertionError("never refused")


@pytest.mark.parametrize("name", FILTERS)
def test_a_map_beyond_memory_is_refused_and_the_filter_goes_on(name, leave):
    refused, untroubled = FILTERS[name](), FILTERS[name]()
    for each in (refused, untroubled):
        map_all(each, 200)
    leave(0)
    taken, message = grow_until_refused(refused, 2000)
    assert "of memory, and 0.0 GB are available" in message
    leave(np.inf)
    for readings, ids in list(scans(2000))[:taken]:
        untroubled.update(readings, ids)
    assert_same_bits(refused.belief(), untroubled.belief())
    for odometry, readings, ids in wander(200, 5):
        for each in (refused, untroubled):
            each.predict(odometry)
            each.update(readings, ids)
    assert_same_bits(refused.belief(), untroubled.belief())


def test_a_full_filter_takes_room_for_what_fits_and_no_more(leave):
    """It asks for twice the landmarks it has, and takes less where there is less."""
    slam = map_all(EkfSlam(*NOISE), 250)
    free = 8 * (3 + 2 * 560) ** 2
    leave(free)
    taken, message = grow_until_refused(slam, 2000)
    assert message.startswith("a covariance of 600 landmarks takes 0.0 GB of memory")
    assert 250 + 50 * taken == 550
    assert slam.map.covariance.nbytes <= free + 8 * 1200 * 8


def test_the_figures_are_those_of_the_map_and_of_the_machine(leave):
    leave(1.5e9)
    readings = np.tile((0.1, 5.0), (9000, 1))
    with pytest.raises(
        MemoryError,
        match=r"a covariance of 9000 landmarks takes 2\.6 GB of memory, and 1\.5 GB "
        r"are available: 'submaps' and 'sparse_information' take less",
    ):
        EkfSlam(*NOISE).update(readings, range(9000))


@pytest.mark.slow
def test_what_a_map_takes_is_what_its_filter_holds():
    slam = map_all(CompressedEkfSlam(*NOISE), 1000)
    map_all(slam, 1000)
    assert 0.8 * slam.nbytes < slam.memory_for(1000) <= slam.nbytes
    full = EkfSlam(*NOISE)
    map_all(full, 300)
    assert full.memory_for(300) == full.belief().covariance.nbytes


def test_compressed_counts_what_it_holds_as_its_own(monkeypatch):
    slam = map_all(CompressedEkfSlam(*NOISE), 1000)
    room = slam.memory_for(1200)
    monkeypatch.setattr(memory_limit, "SMALL", room // 4)  # its local map is small
    monkeypatch.setattr(memory_limit, "available_memory", lambda: room - slam.nbytes)
    assert room - slam.nbytes < room / 2
    _, message = grow_until_refused(slam, 2000)
    assert re.match(r"half a covariance of 1(1[5-9]|2[0-9])\d landmarks", message)


def test_a_belief_that_memory_does_not_hold_is_refused(leave):
    slam = map_all(CompressedEkfSlam(*NOISE), 300)
    leave(1e6)
    with pytest.raises(MemoryError, match=r"belief\(\) of 300 landmarks takes .*give"):
        slam.belief()
    assert slam.belief([1, 2]).landmark_ids == (1, 2)


@pytest.fixture
def _system(tmp_path, monkeypatch):
    """Read what a folder tells of the machine and its container."""
    monkeypatch.setattr(psutil, "PROCFS_PATH", str(tmp_path))
    monkeypatch.setattr(memory_limit, "_CONTAINER", tmp_path)


@pytest.mark.usefixtures("_system")
@pytest.mark.parametrize(
    ("limit", "current", "expected"),
    [("max", "9", 4096e3), ("3000000", "2500000", 900e3), (None, None, 4096e3)],
)
def test_what_is_available_is_that_of_machine_and_container(
    limit, current, expected, tmp_path
):
    sizes = {"MemTotal": 9000, "MemFree": 1000, "MemAvailable": 4000}
    others = ("Buffers", "Cached", "Shmem", "Active", "Inactive", "Slab")
    sizes |= dict.fromkeys(others, 100)
    lines = [f"{name}: {size} kB\n" for name, size in sizes.items()]
    (tmp_path / "meminfo").write_text("".join(lines))
    if limit:
        (tmp_path / "memory.max").write_text(f"{limit}\n")
        (tmp_path / "memory.current").write_text(f"{current}\n")
        (tmp_path / "memory.stat").write_text("anon 2100000\nfile 400000\n")
    assert memory_limit.available_memory() == expected


@pytest.mark.usefixtures("_system")
def test_where_the_system_does_not_tell_nothing_is_refused():
    assert memory_limit.available_memory() == np.inf
    memory_limit.refuse_beyond_memory("a map", 1e15, "take less")


def log_of(landmarks, *, named=True):
    ids = np.arange(landmarks) if named else None
    scan = Scan(0.0, np.tile((0.1, 5.0), (landmarks, 1)), ids)
    return SlamLog("drive", events=(scan, OdometryRow(1.0, 1.0, 0.0, 1), scan))


@pytest.mark.parametrize("name", FILTERS)
def test_a_log_is_refused_before_the_run(name, leave):
    slam = FILTERS[name]()
    leave(slam.memory_for(900) + 8 * 1803**2)
    refuse_large_map(log_of(900), slam)
    with pytest.raises(
        MemoryError, match=r"a map of the 901 landmarks that drive reads takes"
    ):
        refuse_large_map(log_of(1000 - 99), slam)
    assert slam.belief().landmark_ids == ()


def test_what_a_log_or_a_filter_does_not_tell_is_not_refused(leave):
    full, submaps = EkfSlam(*NOISE), SubmapSlam(*NOISE)
    leave(0)
    refuse_large_map(log_of(900, named=False), full)
    refuse_large_map(log_of(900), submaps)
    refuse_large_map(SlamLog("empty"), full)


def test_a_block_of_runs_is_refused_before_its_filters_run(leave):
    runs = simulate_runs("six_landmarks", 3, seed=0)
    read = [len(set(np.flatnonzero(seen) % 6)) for seen in runs.visible]
    maps = sum(Belief(np.zeros(3 + 2 * n), np.eye(3 + 2 * n), tuple(range(n)))
               .covariance.nbytes for n in read)  # fmt: skip
    leave(2 * maps)
    refuse_large_maps(runs, EkfSlam(*NOISE), at_once=True)
    leave(2 * maps - 1)
    refuse_large_maps(runs, EkfSlam(*NOISE), at_once=False)
    with pytest.raises(MemoryError, match="a block of 3 runs that read up to 6 land"):
        refuse_large_maps(runs, EkfSlam(*NOISE), at_once=True)


def test_more_landmarks_than_the_final_belief_may_hold_are_refused_before_the_run():
    submaps = SubmapSlam(*NOISE, belief_limit=900)
    refuse_large_map(log_of(900), submaps)
    with pytest.raises(ValueError, match="belief_limit is 900: take fewer steps, or"):
        refuse_large_map(log_of(901), submaps)
    runs = simulate_runs("six_landmarks", 1, seed=0)
    with pytest.raises(ValueError, match="belief_limit is 5: take fewer steps, or"):
        refuse_large_maps(runs, SubmapSlam(*NOISE, belief_limit=5), at_once=False)


@pytest.mark.parametrize(
    ("command", "message"),
    [
        ("run", r"the \d+ landmarks that loop reads takes .* take fewer steps"),
        ("monte-carlo", r"64 runs of \d+ scans .* take fewer runs at a time"),
    ],
)
def test_a_command_says_in_one_line_that_memory_will_not_suffice(
    command, message, leave, capsys, tmp_path
):
    leave(6e3)  # enough for what is filtered to get the filters ready
    with pytest.raises(SystemExit) as end:
        main([command, "loop", "--out", str(tmp_path / "out")])
    assert end.value.code == 1
    assert re.search(message, capsys.readouterr().err.splitlines()[-1])
