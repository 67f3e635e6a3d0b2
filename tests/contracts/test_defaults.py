"""Compare the defaults of public names and commands, and some limits, with records.

A changed default changes the results of users, so the changelog must mention it.
"""

import importlib
import inspect
import pkgutil
from ast import literal_eval
from dataclasses import fields, is_dataclass
from operator import attrgetter
from pathlib import Path

import pytest

from slamgym.experiments import command_line

RECORDED = Path(__file__).with_name("defaults.txt")
PACKAGES = ("", ".agents", ".envs", ".estimator", ".evaluation", ".experiments")
PACKAGES += (".sim_configs",)


def written(value):
    if isinstance(value, float):
        return f"{value:.12g}"
    if isinstance(value, tuple | list):
        return f"({', '.join(map(written, value))})"
    if is_dataclass(value) and not inspect.isclass(value):
        inside = (f"{f.name}={written(getattr(value, f.name))}" for f in fields(value))
        return f"{type(value).__name__}({', '.join(inside)})"
    return getattr(value, "__qualname__", None) or repr(
        getattr(value, "default", value)
    )


def defaults_of(function):
    """Return the parameters of a call that have a default, as text."""
    try:
        parameters = inspect.signature(function).parameters.values()
    except (TypeError, ValueError):  # a function written in C
        return []
    found = {each.name: each.default for each in parameters}
    if is_dataclass(function):
        made = {f.name: f.default_factory for f in fields(function)}
        for name, default in found.items():
            if "factory" in repr(default):
                found[name] = made[name]()
    return [
        f"{name}={written(default)}"
        for name, default in found.items()
        if default is not inspect.Parameter.empty
    ]


def calls_of(name, thing):
    """Yield a callable, and the public methods of a class, with their names."""
    yield name, thing
    if inspect.isclass(thing) and thing.__module__.startswith("slamgym"):
        for method, function in sorted(vars(thing).items()):
            inner = getattr(function, "__func__", function)
            if inspect.isfunction(inner) and not method.startswith("_"):
                yield f"{name}.{method}", inner


def public_things():
    for package in PACKAGES:
        module = importlib.import_module(f"slamgym{package}")
        for name in module.__all__:
            yield name, getattr(module, name)
    for each in pkgutil.iter_modules(command_line.__path__):
        module = importlib.import_module(f"{command_line.__name__}.{each.name}")
        for name, thing in vars(module).items():
            if getattr(thing, "__module__", "") == module.__name__:
                yield f"{each.name}.{name}", thing


def test_defaults_are_as_recorded():
    found = {
        call: defaults_of(function)
        for name, thing in dict(public_things()).items()
        if callable(thing)
        for call, function in calls_of(name, thing)
    }
    lines = [
        f"{call}({', '.join(found[call])})" for call in sorted(found) if found[call]
    ]
    if not RECORDED.exists():
        RECORDED.write_text("\n".join([*lines, ""]))
        pytest.fail(f"wrote {RECORDED}: check it, and run the test again")
    assert lines == RECORDED.read_text().splitlines()


LIMITS = Path(__file__).with_name("limits.txt").read_text().splitlines()


@pytest.mark.parametrize("line", LIMITS, ids=lambda line: line.split()[0])
def test_limits_without_a_formula_are_as_recorded(line):
    name, *limits = line.split()
    module = importlib.import_module(f"slamgym.{name}")
    for key, _, value in (limit.partition("=") for limit in limits):
        assert attrgetter(key)(module) == literal_eval(value), key
