"""Specifications of environments, which JSON can hold."""

import math
from collections.abc import Mapping
from dataclasses import fields
from enum import Enum
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium.envs.registration import EnvSpec

from ..sim_configs.field_types import ScenarioTable
from ..sim_configs.scenario import plain


def plain_spec(spec: EnvSpec, steps: int | None = None) -> EnvSpec:
    """Return a specification that JSON can hold, with the length of the episodes."""
    values = {each.name: getattr(spec, each.name) for each in fields(spec) if each.init}
    values["max_episode_steps"] = spec.max_episode_steps or steps
    return EnvSpec(**values | {"kwargs": json_value(spec.kwargs)})


def json_value(value: Any) -> Any:
    """Return what JSON can hold in place of a keyword of an environment.

    A scenario becomes its fields; those that are inf have this default, and are left
    out. A class or function becomes its import path.

    Examples
    --------
    >>> json_value({"std": np.ones(2), "scenario": Path("mine.toml"), "ids": (1, 2)})
    {'std': [1.0, 1.0], 'scenario': 'mine.toml', 'ids': [1, 2]}
    >>> json_value({"dtype": np.dtype("float32"), "estimator": Path})
    {'dtype': 'float32', 'estimator': 'pathlib:Path'}
    """
    return plain(value, _replaced)


def _replaced(value: Any) -> Any:
    if isinstance(value, ScenarioTable):
        return _without_inf(value.model_dump())
    if "<" not in (name := getattr(value, "__qualname__", "<")):
        return f"{value.__module__}:{name}"
    if isinstance(value, Enum):
        value = value.value
    return str(value) if isinstance(value, Path | np.dtype) else value


def _without_inf(table: Mapping[str, Any]) -> dict[str, Any]:
    return {
        key: _without_inf(value) if isinstance(value, Mapping) else value
        for key, value in table.items()
        if not (isinstance(value, float) and math.isinf(value))
    }
