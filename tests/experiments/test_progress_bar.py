"""Progress bars: on a terminal or in a notebook, and in no log."""

import io
import re
import sys
import time
from types import SimpleNamespace

import pytest

from slamgym.experiments import monte_carlo, noise_effects, progress_bar
from slamgym.experiments.command_line import commands


class Terminal(io.StringIO):
    def isatty(self):
        return True


def terminal(monkeypatch, between=0.0):
    """Make standard error a terminal whose bars move at this interval [s]."""
    screen = Terminal()
    monkeypatch.setattr(sys, "stderr", screen)
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setattr(progress_bar, "_BETWEEN", between)
    return screen


@pytest.mark.parametrize(
    ("unit", "shown"),
    [("steps", r"driving +\S+ 3/4 \d+ steps/s \S+"), ("", r"driving +\S+ 3/4")],
)
def test_the_bar_of_a_command_shows_the_speed_in_its_unit(unit, shown, monkeypatch):
    screen = terminal(monkeypatch)
    with commands.Reporter(as_json=True).progress("driving", unit) as tick:
        for done in range(4):
            tick(done, 4)
            time.sleep(0.05)
    frames = re.sub(r"\x1b[^a-zA-Z]*[a-zA-Z]", "", screen.getvalue()).split("\r")
    *_, last = (frame.strip() for frame in frames if frame.strip())
    assert re.fullmatch(shown, last)


def test_what_was_done_earlier_counts_for_no_speed(monkeypatch):
    screen = terminal(monkeypatch)
    earlier = 10**9
    with commands.Reporter(as_json=True).progress("driving", unit="steps") as tick:
        for done in range(4):
            tick(earlier + done, earlier + 4)
            time.sleep(0.1)
    speeds = re.findall(r"([\d,]+) steps/s", screen.getvalue())
    assert f"{earlier + 3}/{earlier + 4}" in screen.getvalue()
    assert speeds
    assert max(int(speed.replace(",", "")) for speed in speeds) <= 10


def test_a_bar_that_is_moved_all_the_time_looks_up_now_and_then(monkeypatch):
    screen = terminal(monkeypatch, between=60.0)
    with commands.Reporter(as_json=True).progress("driving", unit="steps") as tick:
        for done in range(1, 9):
            tick(done, 9)
        time.sleep(0.3)
        assert "1/9" in screen.getvalue()
        assert not re.search("[2-9]/9", screen.getvalue())
        tick(9, 9)
    assert "9/9" in screen.getvalue()


def test_what_is_printed_below_a_bar_still_goes_to_the_file(monkeypatch, capfd):
    screen = terminal(monkeypatch)
    with progress_bar.progress_bar("running"):
        sys.stdout.write("of a filter\n")
    assert capfd.readouterr().out == "of a filter\n"
    assert "of a filter" not in screen.getvalue()


class Notebook:
    """IPython in the kernel of a notebook; keeps what it has shown."""

    def __init__(self, monkeypatch, shell="ZMQInteractiveShell"):
        self.shown = []
        self.get_ipython = type(shell, (), {})
        self.display = SimpleNamespace(display=self.show)
        monkeypatch.setitem(sys.modules, "IPython", self)
        monkeypatch.setitem(sys.modules, "IPython.display", self.display)

    def show(self, data, *, raw, display_id):
        assert raw
        assert display_id
        self.update(data, raw=raw)
        return self

    def update(self, data, *, raw):
        assert raw
        self.shown.append(data)


def runs():
    return monte_carlo("six_landmarks", "ekf", 4, block_size=2)


def test_monte_carlo_shows_a_bar_on_a_terminal_unless_told_otherwise(monkeypatch):
    screen = terminal(monkeypatch)
    runs()
    assert "4/4" in screen.getvalue()
    assert "running" in screen.getvalue()
    screen.truncate(0)
    for progress in (False, None, lambda done, all_runs: None):
        monte_carlo("six_landmarks", "ekf", 2, progress=progress)
    noise_effects("six_landmarks", "ekf", runs=2, changed=["filter"])
    assert screen.getvalue() == ""


def test_monte_carlo_shows_a_bar_in_a_notebook_and_removes_it(monkeypatch):
    monkeypatch.setattr(progress_bar, "_BETWEEN", 0.0)
    notebook = Notebook(monkeypatch)
    runs()
    texts = [data["text/plain"] for data in notebook.shown]
    steps = [f"running {done}/4 runs" for done in (0, 2, 4)]
    assert texts == ["", *steps, ""]
    assert '<progress value="2" max="4">' in notebook.shown[2]["text/html"]
    assert notebook.shown[-1]["text/html"] == ""


@pytest.mark.parametrize("shell", [None, "TerminalInteractiveShell"])
def test_monte_carlo_writes_nothing_into_a_log(shell, monkeypatch, capfd):
    monkeypatch.setenv("FORCE_COLOR", "1")  # as many services set it
    notebook = shell and Notebook(monkeypatch, shell)
    runs()
    assert capfd.readouterr() == ("", "")
    assert not (notebook and notebook.shown)
