"""The trees of Victoria Park, whose identities nobody tells, by a managed filter."""

import math
import os
from dataclasses import replace
from pathlib import Path

import pytest

from slamgym.experiments.logs.importers import read_log
from slamgym.experiments.logs.slamlog import Scan
from slamgym.experiments.run_and_replay.filter_settings import settings_for
from slamgym.experiments.run_and_replay.log_replay import replay
from slamgym.experiments.run_and_replay.summary import summarise

DATA = os.environ.get("SLAMGYM_DATA")
LOG = Path(DATA or ".") / "victoria_park.csv"
pytestmark = pytest.mark.skipif(
    DATA is None or not LOG.exists(),
    reason="SLAMGYM_DATA names no folder with victoria_park.csv",
)

# Trees within 20 m ahead are seen again and again, unless one hides another.
POLICY = {
    "association": "nearest",  # in a tenth of the time of hypotheses
    "backdate": False,
    "confirm": [3, 19],
    "view": {"max_range": 20.0, "angle": math.pi, "shadow": 0.05, "range_margin": 0.0},
    "remove_after": 20,
}


@pytest.fixture(scope="module")
def log():
    return read_log(LOG)


def filtered(log, management, estimator="ekf"):
    settings = settings_for(
        log,
        estimator=estimator,
        motion_std=(0.075, 0.15, 0.0318),
        measurement_std=(0.0098, 0.04),
        options={"range_std_per_metre": 0.009, "management": management},
    )
    return summarise(replay(log, settings.make(log.start)), settings)


def before(log, end):
    return replace(log, events=tuple(event for event in log.events if event.t < end))


@pytest.mark.slow
@pytest.mark.parametrize("name", ["ekf", "invariant"])
def test_management_keeps_the_map_small_and_the_path_true(log, name):
    part = before(log, 500.0)
    summary = filtered(part, POLICY, name)
    assert 175 <= len(summary["landmarks"]) <= 210
    assert summary["map_changes"]["most"] <= 210
    assert summary["map_changes"]["removed"] > 40
    assert summary["ate"]["aligned"] < 1.5  # against GPS

    counts = summary["readings"]  # every one is accounted for
    scans = [event for event in part.events if isinstance(event, Scan)]
    fates = ("associated", "added", "tentative", "ambiguous", "skipped", "rejected")
    assert sum(counts[fate] for fate in fates) == sum(
        len(scan.measurements) for scan in scans
    )


@pytest.mark.slow
def test_without_confirmation_and_removal_the_map_grows_far_larger(log):
    beginning = before(log, 200.0)
    managed = filtered(beginning, POLICY)
    bare = filtered(beginning, {"association": "nearest", "confirm": [1, 1]})
    assert len(bare["landmarks"]) > 1.6 * len(managed["landmarks"])
