"""Parse which estimators a Monte Carlo compares."""

import hashlib
import inspect
import marshal
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

from ....estimator import registry
from ....estimator.registry import (
    EstimatorFactory,
    find_estimator,
    list_estimators,
    read_label,
    register_estimator,
    split_labels,
)
from ....sim_configs import Scenario
from ...runs.filter_settings import OFFLINE, FilterSettings, settings_for_scenario

_PACKAGE = Path(registry.__file__).resolve().parents[1]
OWN_NAMES = frozenset(list_estimators())
"""Names that stay those of slamgym's own estimators."""


class EstimatorChoice(NamedTuple):
    """An estimator and its label in the results."""

    label: str
    name: str
    """Registered name or "module:Class"."""
    options: Mapping[str, Any] = {}
    """Arguments of its constructor other than the noise."""

    def code(self) -> str:
        """Return a digest of the user's own source; empty for slamgym's estimators."""
        estimator = find_estimator(self.name)
        try:
            source = inspect.getsourcefile(estimator)
        except TypeError:
            return ""
        except OSError:  # written in a notebook or an interpreter: no file
            return _digest(_code_of_methods(estimator))
        if source is None or Path(source).resolve().is_relative_to(_PACKAGE):
            return ""
        return _digest(Path(source).read_bytes())

    def settings(self, scenario: Scenario) -> FilterSettings:
        """Return its settings for the noise of a world."""
        return settings_for_scenario(
            scenario, estimator=self.name, options=self.options
        )


def _digest(code: bytes) -> str:
    return hashlib.sha256(code).hexdigest()[:12]


def _code_of_methods(estimator: object) -> bytes:
    """Return the compiled code of a class's own methods."""
    members = sorted(vars(estimator).items())
    return b"".join(
        marshal.dumps(member.__code__)
        for _, member in members
        if inspect.isfunction(member)
    )


def estimator_choices(
    estimators: str | Iterable[str | EstimatorFactory] | Mapping[str, Any],
) -> tuple[EstimatorChoice, ...]:
    """Parse estimators from names, classes or labels.

    Parameters
    ----------
    estimators : str, iterable of str, or mapping
        Names separated by commas, with optional options in brackets; or several such
        texts or classes; or a mapping from labels to a name, a class, or a pair (name,
        options).

    Raises
    ------
    ValueError
        If there is none, one is unknown or malformed, or a label occurs twice.

    Examples
    --------
    >>> for choice in estimator_choices("ekf,invariant[iterations=3]"):
    ...     print(choice)
    EstimatorChoice(label='ekf', name='ekf', options={})
    EstimatorChoice(label='invariant[iterations=3]', name='invariant', \
options={'iterations': 3})
    """
    if not isinstance(estimators, Iterable):
        raise ValueError(
            "estimators must be names, labels, or labels mapped to classes, "
            f"got {estimators!r}"
        )
    choices = _choices(estimators)
    if not choices:
        raise ValueError("estimators must name at least one, got none")
    labels = [choice.label for choice in choices]
    for choice in choices:
        if labels.count(choice.label) > 1:
            raise ValueError(f"estimators must differ, got '{choice.label}' twice")
    for choice in choices:
        find_estimator(choice.name)
    return tuple(choices)


def _choices(
    estimators: str | Iterable[str | EstimatorFactory] | Mapping[str, Any],
) -> list[EstimatorChoice]:
    if isinstance(estimators, Mapping):
        return [_labelled(label, what) for label, what in estimators.items()]
    several = [estimators] if isinstance(estimators, str) else estimators
    return [choice for one in several for choice in _unlabelled(one)]


def _unlabelled(what: Any) -> list[EstimatorChoice]:
    """Read names separated by commas, or a class, whose name is then its label."""
    if isinstance(what, str):
        return [_read(label) for label in split_labels(what)]
    label = getattr(what, "__name__", None)
    if not (callable(what) and label):
        raise ValueError(f"estimators must be names or classes, got {what!r}")
    return [_labelled(label, what)]


def _read(label: str) -> EstimatorChoice:
    name, options = read_label(label)
    return EstimatorChoice(label, OFFLINE.get(name, name), options)


def _labelled(label: str, what: Any) -> EstimatorChoice:
    if isinstance(what, str):
        return _read(what)._replace(label=label)
    if isinstance(what, tuple) and len(what) == 2:
        name, options = what
        return EstimatorChoice(label, _name_of(label, name), options)
    return EstimatorChoice(label, _name_of(label, what))


def _name_of(label: str, what: str | Callable[..., Any]) -> str:
    """Return the import path of a class, or register what cannot be imported."""
    if isinstance(what, str):
        return OFFLINE.get(what, what)
    module, name = getattr(what, "__module__", ""), getattr(what, "__qualname__", "")
    path = f"{module}:{name}"
    if module != "__main__" and name.isidentifier():
        return path
    name = label if label not in OWN_NAMES else f"{label} of yours"
    register_estimator(name, what)
    return name
