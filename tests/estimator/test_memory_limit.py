"""A map that memory does not hold is refused with its size, and nothing is lost."""

import re

import numpy as np
import pytest
from comparison import assert_same_bits
from town_drives import TOWN_MOTION_STD, map_all, town, wander

from slamgym.estimator import EkfSlam, IteratedEkfSlam, SubmapSlam
from slamgym.estimator.large_maps.compressed.compressed_slam import CompressedEkfSlam
from slamgym.estimator.models.bearing_range import predict_measurement
from slamgym.experiments import replay
from slamgym.experiments.command_line.commands import message_of
from slamgym.experiments.logs.slamlog import Scan, SlamLog
from slamgym.experiments.monte_carlo_study.filtered_runs import filter_runs
from slamgym.experiments.run_and_replay.filter_settings import (
    FilterSettings,
    refuse_large_map,
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
def allow(monkeypatch):
    """Let numpy allocate no zeros beyond a size [bytes]."""
    usual, largest = np.zeros, np.inf

    def zeros(shape, *arguments, **options):
        if 8 * np.prod(shape) > largest:
            raise MemoryError
        return usual(shape, *arguments, **options)

    def allowed(size):
        nonlocal largest
        largest = size

    monkeypatch.setattr(np, "zeros", zeros)
    return allowed


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
def test_a_map_beyond_memory_is_refused_and_the_filter_goes_on(name, allow):
    refused, untroubled = FILTERS[name](), FILTERS[name]()
    for each in (refused, untroubled):
        map_all(each, 200)
    allow(4e6 if "fixed" not in name else 1e6)
    taken, message = grow_until_refused(refused, 2000)
    assert re.fullmatch(
        r"(half )?a covariance of \d+ landmarks takes 0\.0 GB, and memory does not "
        "hold it: 'submaps' and 'sparse_information' take less",
        message,
    )
    allow(np.inf)
    for readings, ids in list(scans(2000))[:taken]:
        untroubled.update(readings, ids)
    assert_same_bits(refused.belief(), untroubled.belief())
    for odometry, readings, ids in wander(200, 5):
        for each in (refused, untroubled):
            each.predict(odometry)
            each.update(readings, ids)
    assert_same_bits(refused.belief(), untroubled.belief())


def test_a_full_filter_takes_room_for_one_scan_where_there_is_none_for_more(allow):
    slam = map_all(EkfSlam(*NOISE), 250)
    allow(16e6)
    taken, _ = grow_until_refused(slam, 2000)
    assert 8 * (3 + 2 * 2 * 250) ** 2 < 16e6 < 8 * (3 + 2 * 2 * 550) ** 2
    assert 250 + 50 * taken > 550


def test_a_covariance_that_numpy_cannot_allocate_is_one_sentence():
    with pytest.raises(MemoryError) as refused:
        EkfSlam(*NOISE).map.blank(2_100_000)  # beyond 47 bits of address
    assert message_of(refused.value) == (
        "a covariance of 2100000 landmarks takes 141120.2 GB, and memory does not hold "
        "it: 'submaps' and 'sparse_information' take less"
    )


def test_more_landmarks_than_the_final_belief_may_hold_are_refused_before_the_run():
    submaps = SubmapSlam(*NOISE, belief_limit=900)
    refuse_large_map(900, submaps)
    with pytest.raises(ValueError, match="belief_limit is 900: take fewer steps, or"):
        refuse_large_map(901, submaps)
    refuse_large_map(901, EkfSlam(*NOISE))
    log = SlamLog("drive", events=(Scan(0.0, np.ones((6, 2)), np.arange(6)),))
    runs = simulate_runs("six_landmarks", 1, seed=0)
    settings = FilterSettings("submaps", *NOISE, options={"belief_limit": 5})
    with pytest.raises(ValueError, match="belief_limit is 5: take fewer steps, or"):
        filter_runs(settings, runs)
    with pytest.raises(ValueError, match="belief_limit is 5: take fewer steps, or"):
        replay(log, settings.make(np.zeros(3)))
