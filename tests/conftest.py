"""What all tests share: one thread a process, bytecode files, the public logs."""

import contextlib
import gc
import hashlib
import os
import sys
from pathlib import Path
from unittest.mock import patch

import pytest

# Before numpy and torch are loaded: threads that wait for a core which others use make
# small products fifty times slower.  Subprocesses inherit it.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")

# Some tests start Python anew.  Without bytecode files each of these processes, and
# each worker of pytest-xdist, compiles every module again.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
sys.dont_write_bytecode = False

# Subprocesses of tests import the modules in tests/support, too.
_SUPPORT = str(Path(__file__).parent / "support")
os.environ["PYTHONPATH"] = os.pathsep.join(
    [_SUPPORT, *filter(None, [os.environ.get("PYTHONPATH")])]
)

# No tests: with --doctest-modules, each worker would load them, and compile what
# `forked_preload` compiles for the processes that are forked.
collect_ignore = ["support", "mutate.py", "on_rllib.py"]

# The many objects of modules and tests live to the end: the search for garbage need not
# go through them again and again.
gc.disable()
_USUAL, _SELDOM = gc.get_threshold(), (50_000, 20, 20)


@pytest.hookimpl(tryfirst=True)
def pytest_runtestloop():
    """Collect garbage from here on, seldom, and only among objects made later."""
    gc.freeze()
    gc.set_threshold(*_SELDOM)  # a compilation makes millions of objects
    gc.enable()


# Where little is compiled.  Each worker begins with its share of the list.  The last
# one compiles the filters while the others run these tests; otherwise all do.  The
# examples need most kernels, and would wait for them in the middle of the list.
_FIRST = ("tests/envs/", "tests/sim_configs/", "src/", "tests/experiments/")
_LAST = "tests/contracts/test_examples.py"


def pytest_collection_modifyitems(config, items):
    """Move the tests that compile much behind the others; keep the remaining ones."""
    items.sort(key=lambda item: not item.nodeid.startswith(_FIRST))
    items.sort(key=lambda item: item.nodeid.startswith(_LAST))
    if config.getoption("--remaining"):
        passed = set(config.cache.get(_PASSED, []))
        config.hook.pytest_deselected(items=[i for i in items if i.nodeid in passed])
        items[:] = [item for item in items if item.nodeid not in passed]


class Passed:
    """Write which tests have passed into pytest's cache, for the option --remaining."""

    def __init__(self, config):
        self.config, self.names = config, []

    def pytest_runtest_logreport(self, report):
        if report.when == "call" and report.passed:
            self.names.append(report.nodeid)

    def pytest_sessionfinish(self):
        self.config.cache.set(_PASSED, self.names)


_PASSED = "slamgym/passed"


def pytest_configure(config):
    """Note in the main process what passes, unless only the remaining tests run."""
    is_worker, has_cache = hasattr(config, "workerinput"), hasattr(config, "cache")
    if has_cache and not is_worker and not config.getoption("--remaining"):
        config.pluginmanager.register(Passed(config))


def pytest_addoption(parser):
    """Add the choice of the remaining tests, and how long tests/fuzz goes on."""
    parser.addoption(
        "--remaining",
        action="store_true",
        help="run the tests that have not passed in the last run without this option, "
        "as those skipped for want of a library that has been installed since",
    )
    parser.addoption(
        "--fuzz-seconds",
        type=float,
        default=0.0,
        help="how long each test in tests/fuzz generates inputs, beyond the usual few",
    )
    parser.addoption(
        "--fuzz-seed",
        type=int,
        help="where these inputs begin; by default, somewhere else each time",
    )


def pytest_terminal_summary(terminalreporter):
    """Print how many inputs the tests in tests/fuzz have generated."""
    counts = {
        each.nodeid.rpartition("::")[2]: dict(each.user_properties)["inputs"]
        for reports in terminalreporter.stats.values()
        for each in reports
        if "inputs" in dict(getattr(each, "user_properties", ()))
    }
    for name, inputs in counts.items():
        terminalreporter.write_line(f"{inputs:9,} inputs  {name}")
    if counts:
        terminalreporter.write_line(f"{sum(counts.values()):9,} inputs")


@pytest.fixture
def fuzzer(request, record_property):
    """Return what generates inputs for a test, for as long as the option says."""
    from fuzzing import Fuzzer

    options = request.config.getoption
    fuzzer = Fuzzer(options("--fuzz-seconds"), options("--fuzz-seed"))
    yield fuzzer
    record_property("inputs", fuzzer.inputs)


@pytest.fixture(scope="session", autouse=True)
def _one_worker_compiles(request, tmp_path_factory):
    """Let workers wait for a kernel that one of them compiles, and load it then."""
    if not hasattr(request.config, "workerinput") or "numba" not in sys.modules:
        yield
        return
    from filelock import FileLock, Timeout
    from numba.core.dispatcher import Dispatcher

    from slamgym.jit import KernelCache

    folder = tmp_path_factory.getbasetemp().parent / "kernels"
    folder.mkdir(exist_ok=True)
    compiled = Dispatcher.compile

    def compiled_once(kernel, signature):
        if isinstance(kernel._cache, KernelCache):
            key = f"{kernel.py_func.__module__}.{kernel.__name__} {signature}"
            name = hashlib.sha256(key.encode()).hexdigest()
            with contextlib.suppress(Timeout), FileLock(folder / name, timeout=100):
                return compiled(kernel, signature)
        return compiled(kernel, signature)

    with patch.object(Dispatcher, "compile", compiled_once):
        yield


@pytest.fixture
def here(tmp_path, monkeypatch):
    """Run a test in an empty folder, and return it."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def usual_collector():
    """Search for garbage as often as a program does, where memory is measured."""
    gc.set_threshold(*_USUAL)
    yield
    gc.set_threshold(*_SELDOM)


@pytest.fixture
def own_registry():
    """Forget at the end of a test the estimators that it registers."""
    from slamgym.estimator import registry

    with patch.dict(registry._factories):
        yield


@pytest.fixture
def public_logs():
    """Return the folder of public logs, which are not part of the repository."""
    folder = os.environ.get("SLAMGYM_DATA", "")
    if not folder or not Path(folder).is_dir():
        pytest.skip("SLAMGYM_DATA names no folder of public logs")
    return Path(folder)


@pytest.fixture(scope="session")
def browser():
    """Return a page in Chromium, which tests open their files in one by one."""
    from browser import find_chromium, open_browser

    if find_chromium() is None:
        pytest.skip("no chromium here (SLAMGYM_CHROMIUM may name one)")
    with open_browser() as page:
        yield page


@pytest.fixture(scope="session")
def torch():
    """Return PyTorch on one thread."""
    library = pytest.importorskip("torch", reason="needs torch")
    library.set_num_threads(1)
    return library


@pytest.fixture(scope="session")
def sb3(torch):
    """Return Stable-Baselines3, which is slow to load."""
    return pytest.importorskip("stable_baselines3", reason="needs stable-baselines3")


REPORT = "slamgym.experiments.monte_carlo_study.report"


@pytest.fixture
def _no_figures_in_reports(monkeypatch):
    """Leave out of report.html what takes most of its time, where only words count."""
    monkeypatch.setattr(f"{REPORT}.report_figures", lambda *_: {})


@pytest.fixture
def _figures_in_reports_are_blank(monkeypatch):
    """Make the figures of report.html, but do not render them."""
    monkeypatch.setattr(f"{REPORT}.inline_svg", lambda *_: "")
