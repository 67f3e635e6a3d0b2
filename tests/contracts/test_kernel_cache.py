"""Compiled kernels on disk: never stale, shared, and not needed."""

import gc
import os
import re
import shutil
import subprocess
import sys
import textwrap
import time
from importlib import import_module
from pathlib import Path
from pkgutil import walk_packages
from types import FunctionType, ModuleType, SimpleNamespace

import forked
import numpy as np
import pytest
from numba import float64, int64
from numba.core.runtime import _nrt_python
from numba.core.runtime.nrt import rtsys
from own_noise import OWN_NOISE

import slamgym
from slamgym import jit as kernel_cache
from slamgym.estimator import list_estimators, list_peers, make_estimator
from slamgym.jit import (
    digest_of_sources,
    jit,
    jit_in_place,
    njit_allocating,
    njit_apart,
    njit_internal,
)
from slamgym.kernel_variants import specialised

CALLER = """
    from ..jit import jit
    from .callee import twice

    @jit
    def answer(x):
        return twice(x) + 1
"""
CALLEE = """
    from ..jit import njit_internal
    from .constants import FACTOR

    @njit_internal
    def twice(x):
        return FACTOR * x
"""
ASK = """
    from slamgym.estimator.caller import answer
    print(answer(3.0), sum(answer.stats.cache_hits.values()))
"""
UNWRITABLE = {"HOME": "/dev/null", "XDG_CACHE_HOME": "", "NUMBA_CACHE_DIR": ""}


def write(folder, **modules):
    """Write modules, all with one date of the past, and no byte code of them."""
    for name, text in modules.items():
        file = folder / f"{name}.py"
        file.write_text(textwrap.dedent(text))
        os.utime(file, (1e9, 1e9))


def write_kernels(site):
    """Copy the package, add two kernels and a constant, and return their folder."""
    shutil.copytree(Path(slamgym.__file__).parent, site / "slamgym")
    room = site / "slamgym/estimator"
    write(room, caller=CALLER, callee=CALLEE, constants="FACTOR = 2")
    return room


def begun(room, code=ASK, **environment):
    """Start a script in a new process, with the package that contains a folder."""
    own = {name: os.environ[name] for name in ("NUMBA_CACHE_DIR", "TMPDIR")}
    code = forked.WITHOUT_SLAMGYM + textwrap.dedent(code)
    return forked.Script(code, room.parents[1], own | environment)


def python(room, code=ASK, **environment):
    """Return what a script in a new process writes: its output, its errors."""
    output, errors = begun(room, code, **environment).output()
    return output.split(), errors


TWO = np.ones(2)  # numba takes it for read-only


def answer(room, code=ASK):
    (value, hits), _ = python(room, code)
    return float(value), int(hits)


@pytest.fixture
def room(tmp_path, monkeypatch):
    """Return a folder with two kernels and a constant, and a cache of their own."""
    forked.start_server()  # it has the usual cache
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "cache"))
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    return write_kernels(tmp_path / "k")


@pytest.mark.slow
def test_an_edit_in_a_callee_is_detected_if_no_date_changes(room):
    assert answer(room) == (7, 0)
    assert answer(room) == (7, 1)
    write(room, callee=CALLEE.replace("* x", "* x * x"))
    assert answer(room) == (19, 0)
    write(room, constants="FACTOR = 3")
    assert answer(room) == (28, 0)
    write(room, callee=CALLEE, constants="FACTOR = 2")
    assert answer(room) == (7, 1)  # the first code is still there


@pytest.mark.slow
def test_an_edit_while_a_process_runs_does_not_reach_the_cache(room):
    code = """
        from pathlib import Path
        from slamgym.estimator import caller, callee
        file = Path(callee.__file__)
        text = file.read_text()
        file.write_text(text.replace("* x", "* x * x"))
        print(caller.answer(3.0), 0)
        file.write_text(text)
    """
    assert answer(room, code) == (7, 0)
    write(room, callee=CALLEE.replace("* x", "* x * x"))
    assert answer(room) == (19, 0)


def test_a_kernel_that_is_called_with_constants_is_compiled_once():
    @njit_internal
    def power(x, k):
        return x**k

    @jit
    def powers(x, k):
        return power(x, k) + power(x, 2) + power(x, k=3)

    assert powers(2.0, 1) == 14
    assert len(power.nopython_signatures) == 1


def test_read_only_arrays_need_no_code_of_their_own():
    @njit_internal
    def sum_of(values):
        return values.sum()

    @jit
    def both(pair, more):
        return sum_of(pair[0]) + sum_of(pair[1]) + sum_of(TWO) + more[0]

    free, fixed = np.ones(2), np.ones(2)
    fixed.flags.writeable = False
    calls = [((free, free), free), ((fixed, free), free), ((fixed, fixed), fixed)]
    assert [both(*arguments) for arguments in calls] == [7.0] * 3
    assert sum(both.stats.cache_misses.values()) == 1
    assert len(sum_of.nopython_signatures) == 1


@pytest.mark.slow
def test_no_kernel_writes_into_a_read_only_array():
    """A compiled kernel would not notice, but plain Python refuses it."""
    code = """
        import gymnasium as gym, numpy as np
        from slamgym import load_scenario, make_estimator
        from slamgym.estimator import make_batch
        from slamgym.estimator.filters.imagine import imagine
        world = load_scenario("hidden_identities")
        noise = {"motion_std": world.motion.std, "measurement_std": world.sensor.std}
        env = gym.make("slamgym:slamgym/LandmarkWorld-v0", scenario=world).unwrapped
        for name in ("submaps", "compressed", "sparse_information"):
            slam = make_estimator(name, management=True, **noise)
            seen, _ = env.reset(seed=1)
            for _ in range(12):
                slam.update(seen["landmarks"][np.flatnonzero(seen["mask"])])
                seen, *_ = env.step(np.array([0.2, 0.1]))
                slam.predict(seen["odometry"])
        batch = make_batch("ekf", runs=2, landmarks=3, **noise)
        imagine(batch, np.zeros((1, 2, 2)), world.sensor)
        env = gym.make("slamgym:slamgym/ActiveSlam-v0").unwrapped
        env.reset(seed=1)
        for action in (env.action_space.sample() for _ in range(3)):
            env.step(action)
    """
    command = [sys.executable, "-c", textwrap.dedent(code)]
    subprocess.run(command, env={**os.environ, "NUMBA_DISABLE_JIT": "1"}, check=True)


PAIR = """
    from typing import NamedTuple

    class Pair(NamedTuple):
        a: float
        b: float
"""


@pytest.mark.slow
def test_a_kernel_is_compiled_anew_if_the_type_of_an_argument_moves(room):
    code = """
        from {} import Pair
        from slamgym.estimator.caller import answer
        print(answer(Pair(1.0, 3.0)), sum(answer.stats.cache_hits.values()))
    """
    site = room.parents[1]
    write(room, callee=CALLEE.replace("* x", "* x.b"))
    write(site, before=PAIR)
    assert answer(room, code.format("before")) == (7, 0)
    assert answer(room, code.format("before")) == (7, 1)
    (site / "before.py").unlink()
    write(site, after=PAIR)
    assert answer(room, code.format("after")) == (7, 0)
    assert answer(room, code.format("after")) == (7, 1)


@pytest.mark.slow
def test_equal_sources_in_two_checkouts_are_compiled_once(room, tmp_path):
    assert answer(room) == (7, 0)
    other = write_kernels(tmp_path / "other")
    os.utime(other / "callee.py")
    assert answer(other) == (7, 1)


@pytest.mark.slow
@pytest.mark.parametrize("where", [UNWRITABLE, {"NUMBA_CACHE_DIR": "/dev/null/x"}])
def test_where_nothing_can_be_written_one_warning_names_another_folder(
    room, tmp_path, where
):
    output, errors = python(room, ASK, **where)
    assert output == ["7.0", "0"]
    assert errors.count("Warning") == 1
    assert "/dev/null" in errors
    assert str(next(tmp_path.glob("slamgym-*"))) in errors
    # the second process finds them there, and does not warn
    assert python(room, ASK, **where) == (["7.0", "1"], "")


@pytest.mark.slow
def test_machine_code_that_others_could_have_written_is_not_loaded(room, tmp_path):
    assert answer(room) == (7, 0)
    (state,) = (tmp_path / "cache/slamgym").iterdir()
    assert state.stat().st_mode & 0o077 == 0
    state.chmod(0o777)
    output, errors = python(room)
    assert output == ["7.0", "0"]
    assert f"{state} can be written by others" in errors
    (private,) = tmp_path.glob("slamgym-*")
    shutil.rmtree(private)
    private.mkdir()
    private.chmod(0o777)
    output, errors = python(room)
    assert output == ["7.0", "0"]
    assert errors.count("Warning") == 1
    assert "every process compiles again" in errors
    assert list(private.iterdir()) == []


@pytest.mark.slow
def test_a_read_only_install_without_a_home_can_be_imported(room, tmp_path):
    prefix = []
    if os.getuid() == 0:  # who may write anywhere, unless it gives up that right
        if not shutil.which("setpriv"):
            pytest.skip("needs setpriv, or a user who is not root")
        prefix = ["setpriv", "--bounding-set=-dac_override,-fowner"]
    home, site = tmp_path / "home", room.parents[1]
    home.mkdir()
    folders = [home, site, *(f for f in site.rglob("*") if f.is_dir())]
    for folder in folders:
        folder.chmod(0o555)
    environment = {**os.environ, **UNWRITABLE, "HOME": str(home)}
    try:
        done = subprocess.run(
            [*prefix, sys.executable, "-c", textwrap.dedent(ASK)],
            env={**environment, "PYTHONPATH": str(site)},
            cwd=site,
            capture_output=True,
            text=True,
            check=True,
        )
    finally:
        for folder in folders:
            folder.chmod(0o755)
    assert done.stdout.split() == ["7.0", "0"]
    assert done.stderr.count("Warning") == 1
    assert str(home) in done.stderr


@pytest.mark.slow
def test_processes_that_compile_for_other_types_at_once_do_not_mix_them(room):
    calls = ["3.0", "3", "3 + 0j", "np.float32(3)"]
    code = """
        import numpy as np, time
        from slamgym.estimator.caller import answer
        while time.time() < {start}:
            pass
        print(complex(answer({call})))
    """
    start = time.time() + 3
    codes = [code.format(start=start, call=call) for call in calls]
    processes = [begun(room, code) for code in codes]
    assert {complex(process.output().stdout) for process in processes} == {7}
    again = """
        import numpy as np
        from slamgym.estimator.caller import answer
        print(*(complex(answer(x)) for x in ({})))
    """
    output, _ = python(room, again.format(", ".join(calls)))
    assert set(map(complex, output)) == {7}


def kept(tmp_path, kind):
    return sorted((tmp_path / "cache/slamgym").glob(f"*/caller.answer-*.{kind}"))


@pytest.mark.slow
def test_a_file_of_other_types_is_not_taken_for_these(room, tmp_path):
    # Two processes that write one file at once can leave this state.
    code = ASK.replace("3.0", "{}")
    assert answer(room, code.format("3.0")) == (7, 0)
    assert answer(room, code.format("3")) == (7, 0)
    floats, integers = kept(tmp_path, "nbc")
    shutil.copy(floats, integers)
    assert answer(room, code.format("3")) == (7, 0)
    assert answer(room, code.format("3")) == (7, 1)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["nbi", "nbc"])
@pytest.mark.parametrize("size", [0, 1000])
def test_a_damaged_file_is_compiled_again(room, tmp_path, kind, size):
    assert answer(room) == (7, 0)
    (file,) = kept(tmp_path, kind)
    file.write_bytes(file.read_bytes()[:-1][:size])
    assert answer(room) == (7, 0)
    assert answer(room) == (7, 1)


@pytest.mark.slow
def test_a_kernel_is_compiled_with_functions_from_the_cache(room, tmp_path):
    code = ASK.replace("import answer", "import answer, twice")
    code = code.replace("answer.stats", "twice.stats")
    assert answer(room, code) == (7, 0)
    (index,) = kept(tmp_path, "nbi")
    index.unlink()
    assert answer(room, code) == (7, 1)


@njit_internal
def unchanged(x):
    return x


class Files:
    """Cache files of a kernel: they hold this code, or are damaged."""

    def __init__(self, found):
        self.found, self.flushes = found, 0

    def load_overload(self, signature, _):
        if isinstance(self.found, Exception):
            raise self.found
        return self.found

    def flush(self):
        self.flushes += 1


def code_for(*types):
    return SimpleNamespace(signature=SimpleNamespace(args=types))


@pytest.mark.parametrize(
    ("found", "is_loaded", "flushes"),
    [
        (code_for(float64), True, 0),
        (code_for(int64), False, 0),
        (None, False, 0),
        (ValueError("damaged"), False, 1),
    ],
)
def test_only_whole_code_for_the_same_types_is_loaded(
    monkeypatch, found, is_loaded, flushes
):
    files = Files(found)
    monkeypatch.setattr(kernel_cache.KernelCache, "_files", files)
    cache = kernel_cache.KernelCache(unchanged)
    loaded = cache.load_overload((float64,), unchanged.targetctx)
    assert loaded is (found if is_loaded else None)
    assert files.flushes == flushes
    monkeypatch.setattr(kernel_cache.KernelCache, "_files", None)
    assert cache.load_overload((float64,), unchanged.targetctx) is None


def test_the_states_used_last_are_kept_and_nothing_of_others_is_deleted(
    tmp_path, monkeypatch
):
    monkeypatch.setattr(kernel_cache, "KEPT_STATES", 3)
    (tmp_path / "src").mkdir()
    os.utime(tmp_path / "src", (1e8, 1e8))
    names = [f"{day:016x}" for day in range(6)]
    for day, name in enumerate(names):
        state = tmp_path / name
        state.mkdir()
        (state / "kernel.nbc").write_bytes(b"x")
        os.utime(state, (1e9 - day * 1e5,) * 2)
    kernel_cache._forget_old_states(tmp_path)
    assert sorted(state.name for state in tmp_path.iterdir()) == [*names[:3], "src"]


def test_options_of_the_compiler_change_the_digest(monkeypatch):
    before = digest_of_sources()
    monkeypatch.setenv("NUMBA_CACHE_DIR", "elsewhere")
    assert digest_of_sources() == before
    for option in ("NUMBA_BOUNDSCHECK", "NUMBA_DEBUGINFO"):
        with monkeypatch.context() as patch:
            patch.setenv(option, "1")
            assert digest_of_sources() != before


def test_lock_files_of_an_editor_are_no_sources(tmp_path, monkeypatch):
    for name in kernel_cache.SOURCES:
        place = tmp_path / name
        place.parent.mkdir(parents=True, exist_ok=True)
        place.touch() if place.suffix else place.mkdir()
    monkeypatch.setattr(kernel_cache, "__file__", str(tmp_path / "jit.py"))
    before = digest_of_sources()
    (tmp_path / "envs" / ".#robot.py").symlink_to("user@host.1234")
    assert digest_of_sources() == before


READING = """
    from ..jit import jit
    from .models.bearing_range import expected_reading_jit

    @jit
    def answer(dx, dy):
        return expected_reading_jit(dx, dy, 0.0)[0]
"""
SENSOR = """
    from helpers import scaled
    from slamgym.estimator import Sensor
    from slamgym.estimator.caller import answer
    from slamgym.estimator.models.sensor_kernels import for_sensor

    def h(x, y):
        return (scaled(x), y), (scaled(1.0), 0.0, 0.0, 1.0)

    def inverse(z0, z1):
        return z0 / scaled(1.0), z1

    answer = for_sensor(answer, Sensor("far", ("x", "y"), ("m", "m"), h, inverse))
    print(answer(3.0, 0.0), sum(answer.stats.cache_hits.values()))
"""
HELPERS = """
    from numba import njit

    FACTOR = {}

    @njit
    def scaled(x):
        return FACTOR * x
"""


@pytest.mark.slow
def test_kernels_of_a_sensor_follow_its_helpers_in_other_files(room):
    site = room.parents[1]
    write(room, caller=READING)
    write(site, helpers=HELPERS.format(2.0))
    assert answer(room, SENSOR) == (6, 0)
    assert answer(room, SENSOR) == (6, 1)
    write(site, helpers=HELPERS.format(4.0))
    assert answer(room, SENSOR) == (12, 0)


USER = """
from typing import NamedTuple
from slamgym import jit as tools
from enum import IntEnum
from slamgym.jit import jit, njit_internal, njit_inlined
import numba
import numpy as np

class Level(IntEnum):
    LOW = 1

@numba.njit
def lowest():
    return Level.LOW

TABLE = np.array([1.0, 2.0])

class Rule(NamedTuple):
    gate: float
    rest: float

@njit_inlined
def inlined(x):
    return tools.fma(x, 2.0, 1.0)

@njit_internal
def called(x):
    return inlined(x) + TABLE[0]

def user(x, scale=2.0, *, shift=1.0):
    if x < 0:
        return user(-x) + lowest() + shift
    return Rule(called(x), scale).gate + np.sqrt(x)
"""


@njit_internal
def replaced(x):
    return x


@jit
def replacing(x):
    return replaced(x)


def name_with(source):
    """Return the name of a kernel that calls a function of a user."""
    names = {"__name__": "of_a_test"}
    exec(source, names)
    changes = {replaced: njit_allocating(names["user"])}
    return specialised(replacing, changes, "test").py_func.__name__


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("[1.0, 2.0]", "[1.0, 3.0]"),  # a constant of a callee
        ("2.0, 1.0)", "2.0, -1.0)"),  # a number in what is copied into a callee
        ("+ TABLE", "- TABLE"),
        ("scale=2.0", "scale=3.0"),
        ("shift=1.0", "shift=2.0"),
        ("LOW = 1", "LOW = 2"),
        ("@numba.njit\n", "@numba.njit(fastmath=True)\n"),
        ("np.sqrt", "np.cbrt"),
        ("tools.fma", "tools._fma"),
        ("    gate: float\n    rest: float", "    rest: float\n    gate: float"),
        ("x < 0", "x <= 0"),
    ],
)
def test_every_edit_of_what_a_user_gives_changes_the_name_of_a_kernel(old, new):
    assert old in USER
    assert name_with(USER.replace(old, new)) != name_with(USER)


def test_comments_and_places_do_not_change_the_name_of_a_kernel():
    moved = "\n\n# a comment\nUNUSED = 3\n" + USER
    assert name_with(moved) == name_with(USER)


def test_a_kernel_has_the_environment_of_the_functions_below_it():
    @njit_allocating
    def refuse(value):
        if value > 3:
            raise ValueError("too large", value)
        return value

    with pytest.raises(ValueError, match="too large") as error:
        jit(lambda value: refuse(value) + 1)(4.0)
    assert error.value.args == ("too large", 4.0)


@pytest.mark.parametrize("decorate", [njit_internal, njit_apart])
def test_the_compiler_knows_which_arrays_are_apart(decorate):
    def add(target, more):
        for i in range(len(target)):
            target[i] += more[i]

    kernel = decorate(add)
    kernel.compile("(float64[::1], float64[::1])")
    (code,) = kernel.inspect_llvm().values()
    apart = [line for line in code.splitlines() if "noalias" in line]
    arrays = [
        line for line in apart if line.count("noalias") > len(["result", "error"])
    ]
    assert bool(arrays) == (decorate is njit_apart)


def test_a_compilation_hardly_looks_for_cyclic_garbage():
    looks, usual = [], gc.get_threshold()
    gc.callbacks.append(lambda phase, _: looks.append(phase))
    try:
        for threshold in (100, 0):
            gc.set_threshold(threshold)
            for _ in range(2):  # the first one loads numba's compiler
                looks.clear()
                assert jit(lambda x: x + 1)(1.0) == 2
            assert gc.get_threshold()[0] == threshold
            assert len(looks) < 10
    finally:
        gc.set_threshold(*usual)
        gc.callbacks.pop()


def modules_of_the_package():
    """Yield the modules of the package, without those of libraries not installed."""
    optional = {peer.library for peer in list_peers()}
    for module in walk_packages(slamgym.__path__, "slamgym."):
        if module.name.split(".")[1] in ("envs", "estimator", "evaluation", "agents"):
            try:
                yield import_module(module.name)
            except ModuleNotFoundError as missing:
                if missing.name not in optional:
                    raise


def kernels_of_the_package():
    for module in modules_of_the_package():
        for value in vars(module).values():
            function = getattr(value, "py_func", None)
            if getattr(function, "__module__", "") == module.__name__:
                yield value


def read_by(function, seen):
    """Yield our modules from which a function reads values, at any depth of calls."""
    function = getattr(function, "py_func", function)
    if isinstance(function, type) or not isinstance(function, FunctionType):
        yield getattr(function, "__module__", None)
    elif id(function) not in seen:
        seen.add(id(function))
        yield function.__module__
        for name in function.__code__.co_names:
            value = function.__globals__.get(name)
            if isinstance(value, ModuleType):
                yield value.__name__
                value = getattr(value, name, None)
            yield from read_by(value, seen)


def test_all_that_a_kernel_reads_counts_in_the_digest():
    seen = set()
    kernels = list(kernels_of_the_package())
    assert len(kernels) > 100
    read = {module for kernel in kernels for module in read_by(kernel, seen)}
    ours = {name.split(".")[1] for name in read if str(name).startswith("slamgym.")}
    assert {"estimator", "agents", "envs", "jit"} <= ours
    assert ours <= {part.removesuffix(".py") for part in kernel_cache.SOURCES}


def test_no_other_file_makes_kernels():
    package = Path(slamgym.__file__).parent
    counted = tuple(str(package / part) for part in kernel_cache.SOURCES)
    decorators = re.compile(r"import .*\b(jit|njit)|@.*jit\b")
    files = [
        Path(f, n) for f, _, names in os.walk(package, followlinks=True) for n in names
    ]
    others = [
        file
        for file in files
        if file.suffix == ".py" and not str(file).startswith(counted)
    ]
    assert len(others) > 50
    makers = [file for file in others if decorators.search(file.read_text())]
    assert makers == []


@njit_internal
def last_of(rows):
    part = rows[1:]
    return part[-1, 0]


@njit_allocating
def lower_part(rows):
    return rows[1:]


@njit_internal
def uncounted_parts(rows):
    return rows[:1], rows[1:]


@jit
def through_views(rows):
    return last_of(rows) + lower_part(rows)[0, 0] + last_of(lower_part(rows))


@jit
def through_uncounted_views(rows):
    return uncounted_parts(rows)[1][0, 0]


@njit_allocating
def copied(rows):
    return rows.copy()


@jit_in_place
def keeps_a_copy(rows):
    return copied(rows)[0, 0]


@jit_in_place
def allocates(rows):
    return np.zeros(len(rows)).sum()


def test_references_to_arrays_are_neither_lost_nor_kept():
    rows = np.arange(6.0).reshape(3, 2)
    before = sys.getrefcount(rows)
    assert [through_views(rows) for _ in range(5)] == [10.0] * 5
    assert sys.getrefcount(rows) == before


@pytest.mark.parametrize("kernel", [through_uncounted_views, keeps_a_copy])
def test_kernel_without_counted_references_hands_on_no_array(kernel):
    for _ in range(2):  # the first call leaves nothing that the second one could use
        with pytest.raises(Exception, match="use njit_allocating"):
            kernel(np.zeros((3, 2)))


@pytest.mark.parametrize(
    "options",
    [
        *({"name": name} for name in list_estimators()),
        {"name": "ekf", "sensor": OWN_NOISE},  # which returns arrays
    ],
    ids=lambda options: "-".join(map(str, options.values()))[:20],
)
def test_no_estimator_loses_an_array(options):
    slam = make_estimator(motion_std=(0.1,) * 3, measurement_std=(0.1,) * 2, **options)
    readings = np.array([[0.5, 2.0], [-1.0, 3.0]])
    _nrt_python.memsys_enable_stats()
    gc.freeze()  # so that the objects of other tests are not searched each time
    alive = []
    for _ in range(6):
        slam.predict((0.0, 0.0))
        slam.update(readings, [1, 2])
        gc.collect()
        stats = rtsys.get_allocation_stats()
        alive.append(stats.alloc - stats.free)
    assert alive[-1] <= alive[1]


def test_kernel_in_place_allocates_nothing():
    with pytest.raises(Exception, match="zeros"):
        allocates(np.zeros((3, 2)))
