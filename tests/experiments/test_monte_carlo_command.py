"""``slamgym monte-carlo`` and ``slamgym noise-study --runs``, as a user types them."""

import contextlib
import json
import logging
import signal
import time
from types import SimpleNamespace

import forked
import pytest
import xarray as xr
from commands import slamgym

from slamgym.experiments.command_line import monte_carlo as command
from slamgym.experiments.command_line.commands import LostSchedulerError, terminable
from slamgym.experiments.monte_carlo_study import monte_carlo
from slamgym.experiments.monte_carlo_study.results import load_results

pytestmark = pytest.mark.usefixtures("here")


def refused(*arguments):
    result = slamgym(*arguments)
    assert result.exit_code == 2
    assert result.stderr.count("\n") == 1
    return result.stderr


@pytest.mark.slow
def test_results_summary_and_report_are_written_and_told(here):
    arguments = ("monte-carlo", "six_landmarks", "--runs", 40, "--out", "out")
    result = slamgym(*arguments, "--figures", "pdf")
    assert result.exit_code == 0, result.stderr
    assert "ekf: not consistent" in result.stdout
    assert "report.html" in result.stdout
    with load_results("out") as results:
        expected = monte_carlo("six_landmarks", "ekf,invariant", 40, small_noise=True)
        xr.testing.assert_equal(results.load(), expected)
    summary = json.loads((here / "out" / "summary.json").read_text())
    assert summary["estimators"]["ekf"]["verdict"] == "not consistent"
    page = (here / "out" / "report.html").read_text()
    assert "not consistent" in page
    assert "<svg" in page
    assert '<a href="nees_85mm.pdf" download>' in page
    printed = (here / "out" / "nees_85mm.pdf").read_bytes()
    assert b"/MediaBox [ 0 0 240.9" in printed  # 85 mm in points
    assert b"/FontFile2" in printed  # the fonts themselves, as TrueType


@pytest.mark.slow
@pytest.mark.usefixtures("_no_figures_in_reports")
def test_a_world_without_identities_is_scored_by_places(here):
    world = ("hidden_identities", "--steps", 12, "--runs", 2, "--resolution", 100)
    estimator = 'ekf[management={association="joint"}]'
    result = slamgym("monte-carlo", *world, "-e", estimator, "--out", "out")
    assert result.exit_code == 0, result.stderr
    rows = [" ".join(line.split()) for line in result.stdout.splitlines()]
    assert "bad runs of 2 0 0" in rows
    assert any(row.startswith("landmarks in the map 1.00") for row in rows)
    summary = json.loads((here / "out" / "summary.json").read_text())
    (entry,) = summary["estimators"].values()
    assert entry["association"]["resolution"] == summary["resolution"] == 100.0
    assert "the map has" in " ".join(summary["notes"])


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("lop",), "did you mean 'loop'"),
        (("loop", "-e", "ekg"), "did you mean 'ekf'"),
        (("loop", "--runs", "0"), "runs must be an integer >= 1"),
        (("loop", "--scheduler", "tcp://a:1"), "--scheduler requires"),
        (("loop", "--backend", "spark"), "backend must be one of"),
        (("loop", "--assume", "motion.sdt=1"), "sdt"),
        (("loop", "--until", "done"), "until must be 'decided'"),
        (("loop", "--figures", "gif"), "--figures must be one of pdf, svg, png"),
    ],
)
def test_what_cannot_be_done_is_said_in_one_line(here, arguments, message):
    assert message in refused("monte-carlo", *arguments, "--out", "out")
    assert not (here / "out").exists()


CARELESS = """
from slamgym.estimator import EkfSlam, InvariantEkfSlam

class Good(InvariantEkfSlam):
    pass

class Careless(EkfSlam):
    def predict(self, odometry, dt=1.0):
        super().predict(odometry, 0.0)
"""


@pytest.mark.usefixtures("_no_figures_in_reports")
def test_a_filter_of_ones_own_that_is_not_consistent_is_checked(here, monkeypatch):
    (here / "careless.py").write_text(CARELESS)
    monkeypatch.syspath_prepend(here)
    names = "careless:Good,careless:Careless,ekf"
    result = slamgym("monte-carlo", "anchored", "-e", names, "--runs", 20)
    assert result.exit_code == 0, result.stderr
    words = " ".join(result.stdout.split())
    finding = "careless:Careless: check_estimator finds: predict(): the motion noise is"
    assert finding in words
    assert "careless:Good: check_estimator" not in words
    (file,) = here.glob("results/*/summary.json")
    entries = json.loads(file.read_text())["estimators"]
    assert ["check" in entry for entry in entries.values()] == [False, True, False]
    assert len(entries["careless:Careless"]["check"]) <= 2


SURE_OF_ITS_MAP = """
from slamgym.estimator import Belief, EkfSlam

class Sure(EkfSlam):
    def belief(self, landmark_ids=None):
        own = super().belief(landmark_ids)
        covariance = own.covariance.copy()
        covariance[3:] /= 10
        covariance[:, 3:] /= 10
        return Belief(own.mean, covariance, own.landmark_ids)

    def predict(self, odometry, dt=1.0):
        super().predict(odometry, dt)
"""


@pytest.mark.usefixtures("_no_figures_in_reports")
def test_no_finding_about_the_pose_is_quoted_if_only_the_map_is_wrong(
    here, monkeypatch
):
    (here / "sure.py").write_text(SURE_OF_ITS_MAP)
    monkeypatch.syspath_prepend(here)
    result = slamgym("monte-carlo", "anchored", "-e", "sure:Sure", "--runs", 20)
    assert result.exit_code == 0, result.stderr
    (file,) = here.glob("results/*/summary.json")
    entry = json.loads(file.read_text())["estimators"]["sure:Sure"]
    assert entry["diagnosis"]["cause"] == "map"
    (text,) = entry["check"]
    assert "covariance[5, 5], of l2x and l2x, must be" in text


def test_filters_are_compiled_in_a_small_world_before_the_runs(monkeypatch):
    given = []

    def listen(world, *others, **named):
        given.append((world, *others))
        raise ValueError("that is enough")

    monkeypatch.setattr("slamgym.experiments.monte_carlo_study.monte_carlo", listen)
    slamgym("monte-carlo", "hidden_identities", "-e", "ekf")
    (small, *others), (world, *_) = given
    assert (small.name, small.steps, *others) == ("six_landmarks", 8, "ekf", 1)
    assert not small.sensor.identities
    assert world.name == "hidden_identities"


class Client(contextlib.nullcontext):
    """A client of Dask, with three workers wanted."""

    def __init__(self, status="running"):
        super().__init__(self)
        self.status, self.scaled = status, []
        self.cluster = SimpleNamespace(
            worker_spec=range(3), workers=[1, 2], scale=self.scaled.append
        )
        self.at_the_end = lambda: None

    def __exit__(self, *_):
        self.at_the_end()


@pytest.mark.parametrize("hears", [signal.default_int_handler, signal.SIG_IGN])
def test_a_lost_scheduler_ends_the_block_with_its_address(monkeypatch, hears):
    monkeypatch.setattr(command, "_INTERVAL", 0.01)
    with pytest.raises(ZeroDivisionError), command._naming_loss(Client(), "tcp://a:1"):
        raise ZeroDivisionError
    message = "the Dask scheduler tcp://a:1 is lost; what is finished is kept"
    usual = signal.signal(signal.SIGINT, hears)  # ignored in the background of a shell
    try:
        with (
            terminable(),
            pytest.raises(LostSchedulerError, match=message),
            command._naming_loss(Client("closed"), "tcp://a:1"),
        ):
            all(time.sleep(0.01) is None for _ in range(900))
    finally:
        signal.signal(signal.SIGINT, usual)


def test_an_error_ends_the_workers_of_dask_alone_and_silently():
    logger, calm, levels = logging.getLogger("distributed"), [], []
    usual = logger.level
    worker, other = (forked.start(time.sleep, 60) for _ in range(2))
    client = Client()
    client.at_the_end = lambda: levels.append(logger.level)
    nanny = SimpleNamespace(pid=worker.pid, close_gracefully=lambda: calm.append(1))
    starting = SimpleNamespace(pid=None, close_gracefully=lambda: calm.append(2))
    client.cluster.workers = {"a": nanny, "b": starting}
    with pytest.raises(ZeroDivisionError), command._with_new_workers(lambda: client):
        raise ZeroDivisionError
    worker.join(10)
    assert worker.exitcode == forked.KILLED
    assert other.is_alive()
    other.kill()
    assert calm == [1, 2]
    assert levels == [logging.CRITICAL]
    assert logger.level == usual


def test_workers_that_are_gone_are_replaced_until_the_block_ends(monkeypatch):
    monkeypatch.setattr(command, "_INTERVAL", 0.01)
    client = Client()
    with command._with_new_workers(lambda: client):
        time.sleep(0.1)
        assert set(client.scaled) == {3}
        client.cluster.workers.append(3)
        time.sleep(0.05)
        count = len(client.scaled)
        time.sleep(0.05)
        assert len(client.scaled) == count
        client.cluster.workers.pop()
    count = len(client.scaled)
    time.sleep(0.05)
    assert len(client.scaled) == count
