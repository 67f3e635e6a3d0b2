"""Compiled kernels on disk: never stale, shared, and not needed."""

import gc
import os
import shutil
import subprocess
import sys
import textwrap
import time
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from pkgutil import walk_packages

import forked
import numpy as np
import pytest
from numba import _dispatcher
from numba.core.runtime import _nrt_python
from numba.core.runtime.nrt import rtsys

import slamgym
from slamgym import jit as kernel_cache
from slamgym.estimator import list_estimators, list_peers, make_estimator
from slamgym.estimator.models.sensors import POSITION
from slamgym.jit import (
    UnknownValueError,
    code_fingerprint,
    fma,
    jit,
    jit_in_place,
    njit_allocating,
    njit_apart,
    njit_internal,
)

CALLER = """
    from callee import twice
    from slamgym.jit import jit

    @jit
    def answer(x):
        return twice(x) + 1
"""
CALLEE = """
    import constants
    from slamgym.jit import njit_internal

    @njit_internal
    def twice(x):
        return constants.FACTOR * x
"""
ASK = """
    from caller import answer
    print(answer(3.0), sum(answer.stats.cache_hits.values()))
"""
UNWRITABLE = {"HOME": "/dev/null", "XDG_CACHE_HOME": "", "NUMBA_CACHE_DIR": ""}


def write(folder, **modules):
    """Write modules, all with one date of the past, and no byte code of them."""
    folder.mkdir(exist_ok=True)
    for name, text in modules.items():
        (folder / f"{name}.py").write_text(textwrap.dedent(text))
    for file in folder.glob("*.py"):
        os.utime(file, (1e9, 1e9))


def python(folder, code=ASK, prefix=(), **environment):
    environment = {"PYTHONDONTWRITEBYTECODE": "1", **environment}
    return subprocess.run(
        [*prefix, sys.executable, "-c", textwrap.dedent(code)],
        env={**os.environ, **environment},
        cwd=folder,
        check=True,
        capture_output=True,
        text=True,
    )


def forked_script(folder, code=ASK, **environment):
    """Begin a script in a process that has loaded numba, but not these kernels."""
    caches = {name: os.environ[name] for name in ("NUMBA_CACHE_DIR", "TMPDIR")}
    return forked.Script(code, folder, {**caches, **environment})


def forked_python(*arguments, **environment):
    return forked_script(*arguments, **environment).output()


def answer(folder, code=ASK, run=forked_python):
    value, hits = run(folder, code).stdout.split()
    return float(value), int(hits)


@pytest.fixture
def kernels(tmp_path, monkeypatch):
    """Return a folder with two kernels and a constant, and a cache of their own."""
    forked.start_server()  # with the usual cache
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "cache"))
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    write(tmp_path / "k", caller=CALLER, callee=CALLEE, constants="FACTOR = 2")
    return tmp_path / "k"


@pytest.mark.slow
def test_an_edit_in_a_callee_is_seen_though_all_dates_are_alike(kernels):
    assert answer(kernels) == (7, 0)
    assert answer(kernels) == (7, 1)
    write(kernels, callee=CALLEE.replace("* x", "* x * x"))
    assert answer(kernels) == (19, 0)
    write(kernels, constants="FACTOR = 3")
    assert answer(kernels) == (28, 0)
    write(kernels, callee=CALLEE, constants="FACTOR = 2")
    assert answer(kernels) == (7, 1)  # the first code is still there


@pytest.mark.slow
def test_an_edit_while_a_process_runs_does_not_reach_the_cache(kernels):
    code = """
        from pathlib import Path
        from caller import answer
        callee = Path("callee.py")
        callee.write_text(callee.read_text().replace("* x", "* x * x"))
        print(answer(3.0), 0)
    """
    assert answer(kernels, code) == (7, 0)
    assert answer(kernels) == (19, 0)


def test_a_kernel_that_is_called_with_constants_is_compiled_once(tmp_path, monkeypatch):
    monkeypatch.setattr(kernel_cache, "cache_folder", lambda: tmp_path)

    @njit_internal
    def power(x, k):
        return x**k

    @jit
    def powers(x, k):
        return power(x, k) + power(x, 2) + power(x, k=3)

    assert powers(2.0, 1) == 14
    assert len(power.nopython_signatures) == 1


@pytest.mark.slow
def test_a_callee_that_moves_to_another_module_is_compiled_anew(kernels):
    assert answer(kernels) == (7, 0)
    write(kernels, renamed=CALLEE, caller=CALLER.replace("callee", "renamed"))
    (kernels / "callee.py").unlink()
    assert answer(kernels) == (7, 0)


PAIR = """
    from typing import NamedTuple

    class Pair(NamedTuple):
        a: float
        b: float
"""


@pytest.mark.slow
def test_a_kernel_is_compiled_anew_if_the_type_of_an_argument_moves(kernels):
    code = """
        from {} import Pair
        from caller import answer
        print(answer(Pair(1.0, 3.0)), sum(answer.stats.cache_hits.values()))
    """
    write(kernels, callee=CALLEE.replace("* x", "* x.b"), before=PAIR)
    assert answer(kernels, code.format("before")) == (7, 0)
    assert answer(kernels, code.format("before")) == (7, 1)
    (kernels / "before.py").unlink()
    write(kernels, after=PAIR)
    assert answer(kernels, code.format("after")) == (7, 0)


@pytest.mark.slow
def test_equal_kernels_in_two_checkouts_are_compiled_once(kernels, tmp_path):
    assert answer(kernels, run=python) == (7, 0)
    write(tmp_path / "other", caller=CALLER, callee=CALLEE, constants="FACTOR = 2")
    os.utime(tmp_path / "other" / "callee.py")
    assert answer(tmp_path / "other", run=python) == (7, 1)


@pytest.mark.slow
@pytest.mark.parametrize("where", [UNWRITABLE, {"NUMBA_CACHE_DIR": "/dev/null/x"}])
def test_where_nothing_can_be_written_one_warning_names_another_folder(kernels, where):
    done = forked_python(kernels, ASK, **where)
    assert done.stdout.split() == ["7.0", "0"]
    assert done.stderr.count("Warning") == 1
    assert "/dev/null" in done.stderr
    assert str(next(kernels.parent.glob("slamgym-*"))) in done.stderr
    again = forked_python(kernels, ASK, **where)  # finds them there: no complaint
    assert (again.stdout.split(), again.stderr) == (["7.0", "1"], "")


@pytest.mark.slow
def test_a_folder_of_somebody_else_is_not_used(kernels):
    private = kernels.parent / kernel_cache._private_path().name
    private.mkdir(mode=0o777)
    private.chmod(0o777)
    done = forked_python(kernels, ASK, **UNWRITABLE)
    assert done.stdout.split() == ["7.0", "0"]
    assert done.stderr.count("Warning") == 1
    assert "every process compiles anew" in done.stderr
    assert list(private.iterdir()) == []


@pytest.mark.slow
def test_a_read_only_install_without_a_home_can_be_imported(kernels, tmp_path):
    prefix = []
    if os.getuid() == 0:  # who may write anywhere, unless it gives up that right
        if not shutil.which("setpriv"):
            pytest.skip("needs setpriv, or a user who is not root")
        prefix = ["setpriv", "--bounding-set=-dac_override,-fowner"]
    home = tmp_path / "home"
    home.mkdir()
    packages = tmp_path / "site-packages"
    shutil.copytree(Path(slamgym.__file__).parent, packages / "slamgym")
    folders = [home, packages, *(f for f in packages.rglob("*") if f.is_dir())]
    for folder in folders:
        folder.chmod(0o555)
    path = os.pathsep.join([str(packages), os.environ["PYTHONPATH"]])
    try:
        done = python(
            kernels,
            "import slamgym; print(slamgym.__file__)" + textwrap.dedent(ASK),
            prefix,
            **{**UNWRITABLE, "HOME": str(home), "PYTHONPATH": path},
        )
    finally:
        for folder in folders:
            folder.chmod(0o755)
    assert done.stdout.split() == [str(packages / "slamgym/__init__.py"), "7.0", "0"]
    assert done.stderr.count("Warning") == 1
    assert str(home) in done.stderr


@pytest.mark.slow
def test_processes_that_compile_for_other_types_at_once_keep_all_of_it(kernels):
    calls = ["3.0", "3", "3 + 0j", "np.float32(3)"]
    code = """
        import numpy as np, os, sys, time
        from caller import answer
        while time.time() < {start}:
            pass
        print(answer({call}))
    """
    start = time.time() + 0.5
    scripts = [
        forked_script(kernels, code.format(start=start, call=call)) for call in calls
    ]
    values = {complex(script.output().stdout) for script in scripts}
    assert values == {7}
    hits = f"""
        import numpy as np
        from caller import answer
        values = {{complex(answer(x)) for x in ({", ".join(calls)})}}
        print(*map(abs, values), sum(answer.stats.cache_hits.values()))
    """
    assert answer(kernels, hits) == (7, 4)


@pytest.mark.slow
def test_a_damaged_file_is_compiled_again(kernels, tmp_path):
    assert answer(kernels) == (7, 0)
    files = list((tmp_path / "cache/slamgym").glob("*.nbc"))
    for file, size in zip(files, (0, 1000), strict=True):
        file.write_bytes(file.read_bytes()[:size])
    assert answer(kernels) == (7, 0)
    assert answer(kernels) == (7, 1)


def test_the_folder_stays_small_and_keeps_what_was_used_last(tmp_path, monkeypatch):
    monkeypatch.setattr(kernel_cache, "MAX_BYTES", 300)
    now = time.time()
    for day in range(6):
        (tmp_path / f"{day}.nbc").write_bytes(b"x" * 100)
        os.utime(tmp_path / f"{day}.nbc", (now - day * 1e5, now - day * 1e5))
    for name, age in (("fresh", 0), ("left", 1e7)):
        (tmp_path / f"{name}.tmp").write_bytes(b"")
        os.utime(tmp_path / f"{name}.tmp", (now - age, now - age))
    kernel_cache._sweep_once(tmp_path)
    left = sorted(file.name for file in tmp_path.iterdir())
    assert left == ["0.nbc", "1.nbc", "2.nbc", "fresh.tmp"]


SOURCE = """
from typing import NamedTuple
from slamgym import jit as tools
from slamgym.jit import jit, njit_apart, njit_internal, njit_inlined
import numpy as np

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

@jit
def kernel(x, scale=2.0):
    if x < 0:
        return kernel(-x)
    return Rule(called(x), scale).gate + np.sqrt(x)
"""


def fingerprint(source):
    names = {"__name__": "of_a_test"}
    exec(source, names)
    return code_fingerprint(names["kernel"])


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("[1.0, 2.0]", "[1.0, 3.0]"),  # a constant of a callee
        ("2.0, 1.0)", "2.0, -1.0)"),  # a number in what is copied into a callee
        ("+ TABLE", "- TABLE"),
        ("scale=2.0", "scale=3.0"),
        ("np.sqrt", "np.cbrt"),
        ("tools.fma", "tools._multiply_add"),
        ("    gate: float\n    rest: float", "    rest: float\n    gate: float"),
        ("@njit_internal\ndef called", "@jit\ndef called"),
        ("@njit_internal\ndef called", "@njit_apart\ndef called"),
        ("x < 0", "x <= 0"),
    ],
)
def test_every_edit_of_what_a_kernel_uses_changes_its_fingerprint(old, new):
    assert old in SOURCE
    assert fingerprint(SOURCE.replace(old, new)) != fingerprint(SOURCE)


@pytest.mark.parametrize("decorate", [njit_internal, njit_apart])
def test_the_compiler_knows_which_arrays_are_apart(decorate, tmp_path, monkeypatch):
    # numba shows the code of what it has compiled itself, not of what it has loaded
    monkeypatch.setattr(kernel_cache, "cache_folder", lambda: tmp_path)

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


def test_the_type_of_a_long_tuple_of_arrays_is_found():
    # numba 0.60 reads memory that was never written there, and calls a kernel that was
    # compiled for other types
    arrays = (np.zeros((2, 2)),) * 6
    long, short = map(_dispatcher.compute_fingerprint, (arrays, arrays[:1]))
    assert long.startswith(short[:-1])


def test_comments_and_places_do_not_change_a_fingerprint():
    moved = "\n\n# a comment\nUNUSED = 3\n" + SOURCE
    assert fingerprint(moved) == fingerprint(SOURCE)


def test_options_of_the_compiler_change_a_fingerprint(monkeypatch):
    before = fingerprint(SOURCE)
    monkeypatch.setenv("NUMBA_CACHE_DIR", "elsewhere")
    assert fingerprint(SOURCE) == before
    monkeypatch.setenv("NUMBA_BOUNDSCHECK", "1")
    assert fingerprint(SOURCE) != before


def test_a_kernel_with_a_value_of_an_unknown_kind_is_not_kept(tmp_path, monkeypatch):
    monkeypatch.setattr(kernel_cache, "cache_folder", lambda: tmp_path)
    unknown = object()

    @jit
    def kernel(x):
        return x if x > 0 else fma(x, 1.0, 1.0)

    @jit
    def odd(x):
        return x if unknown is None else x + 1

    with pytest.raises(UnknownValueError, match="no fingerprint"):
        code_fingerprint(odd)
    assert kernel(1.0) == 1
    assert [file.suffix for file in tmp_path.iterdir()] == [".nbc"]


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


@pytest.mark.slow
def test_every_kernel_has_its_own_fingerprint_and_the_same_in_every_process():
    here = {code_fingerprint(kernel) for kernel in kernels_of_the_package()}
    assert len(here) == len(list(kernels_of_the_package())) > 100
    code = """
        from test_kernel_cache import code_fingerprint, kernels_of_the_package
        print(*map(code_fingerprint, kernels_of_the_package()))
    """
    there = python(Path(__file__).parent, code, PYTHONHASHSEED="7").stdout.split()
    assert set(there) == here


def test_fingerprints_are_quick():
    kernels = list(kernels_of_the_package())
    np.testing.assert_array_less(0, len(kernels))
    began = time.process_time()
    for kernel in kernels:
        code_fingerprint(kernel)
    assert time.process_time() - began < 1  # 0.1 s


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


def two_stds(noise, _):
    return np.array(noise[:2])


@pytest.mark.parametrize(
    "options",
    [
        *({"name": name} for name in list_estimators()),
        {"name": "ekf", "sensor": replace(POSITION, name="arrays", std=two_stds)},
    ],
    ids=lambda options: "-".join(map(str, options.values()))[:20],
)
def test_no_estimator_loses_an_array(options):
    slam = make_estimator(motion_std=(0.1,) * 3, measurement_std=(0.1,) * 2, **options)
    readings = np.array([[0.5, 2.0], [-1.0, 3.0]])
    _nrt_python.memsys_enable_stats()
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
