"""Filters by the names that the user gives, with options in brackets."""

import json
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

from ...estimator.check_estimator import find_breaches, listed
from ...estimator.registry import find_estimator, read_label
from ..monte_carlo.measure.estimator_choices import estimator_choices
from ..runs.filter_settings import FilterSettings
from .errors import BrokenFilterError
from .option_values import assignments
from .reporter import Reporter


def chosen_filters(
    estimators: str,
    options: Mapping[str, Any],
    settings: Callable[..., FilterSettings],
) -> dict[str, FilterSettings]:
    """Set up one or more filters, by the labels that the user gave.

    Parameters
    ----------
    estimators : str
        Names separated by commas, such as "ekf,invariant[iterations=3]".
    options : mapping
        Options of all of them; options in brackets take precedence.
    settings : callable
        Called with ``estimator`` and ``options``.

    Raises
    ------
    ValueError
        If there is none, or one is unknown, malformed, named twice, or cannot run.

    Examples
    --------
    >>> from functools import partial
    >>> from slamgym.experiments.runs import settings_for_scenario
    >>> from slamgym.sim_configs import load_scenario
    >>> set_up = partial(settings_for_scenario, load_scenario("loop"))
    >>> list(chosen_filters("ekf,invariant[iterations=3]", {}, set_up))
    ['ekf', 'invariant[iterations=3]']
    """
    refuse_broken(estimators, options)
    return {
        choice.label: settings(
            estimator=choice.name, options={**options, **choice.options}
        )
        for choice in estimator_choices(estimators)
    }


def refuse_broken(estimators: str, options: Mapping[str, Any] | None = None) -> None:
    """Check the user's own filters among some labels, before any work.

    Parameters
    ----------
    estimators : str
        Labels separated by commas.
    options : mapping, optional
        Options of all of them.

    Raises
    ------
    BrokenFilterError
        If a filter cannot run, with all reasons.
    ValueError
        If a label is unknown or malformed.
    """
    for _, name, own in estimator_choices(estimators):
        if ":" in name and not name.startswith("slamgym."):
            given = {**(options or {}), **own}
            given.pop("management", None)  # it is around the filter
            factory = partial(find_estimator(name), **given)
            with Reporter(as_json=False).note_if_compiling("the filter"):
                findings = find_breaches(factory, ("required",))
            if findings:
                raise BrokenFilterError(listed(factory, findings))


def with_options(label: str, texts: Sequence[str]) -> str:
    """Write options of all filters, as "key=value", into the brackets of one label.

    Examples
    --------
    >>> with_options("ekf[iterations=3]", ["iterations=1", "landmark_init=full"])
    'ekf[iterations=3,landmark_init="full"]'
    """
    _, own = read_label(label)
    given = assignments("--option", texts)
    more = [
        f"{key}={json.dumps(value)}" if isinstance(value, str) else text
        for text, (key, value) in zip(texts, given.items(), strict=True)
        if key not in own
    ]
    if not more:
        return label
    name, _, inside = label.removesuffix("]").partition("[")
    return f"{name}[{','.join([inside, *more] if own else more)}]"


def tested_filters(labels: Sequence[str]) -> list[str]:
    """Return the filters for a Monte Carlo that tests these; one gets a companion.

    Examples
    --------
    >>> tested_filters(["invariant"]), tested_filters(["mine:Filter"])
    (['ekf', 'invariant'], ['mine:Filter', 'invariant'])
    """
    if len(labels) > 1:
        return list(labels)
    (label,) = labels
    if label in ("ekf", "invariant"):
        return ["ekf", "invariant"]
    return [label, "invariant"]
