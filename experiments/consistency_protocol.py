"""The protocol `consistency-1`: scores of filters that others can verify.

`score_filters` runs filters in five presets, with fixed seeds, and returns scores and a
digest of all results. `differences` repeats two of the worlds and compares digests.
"""

from __future__ import annotations

import hashlib
import json
import math
import platform
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from ..sim_configs import load_scenario
from .monte_carlo_study import monte_carlo, summarise_monte_carlo
from .monte_carlo_study.filtered_runs import filter_runs
from .monte_carlo_study.results import provenance
from .run_and_replay.filter_settings import estimator_choices, settings_for_scenario
from .run_and_replay.simulated_runs import simulate_runs

PROTOCOL = "consistency-1"
WORLDS = ("anchored", "six_landmarks", "unknown_heading", "corridor", "loop")
#: The worlds that `differences` repeats.
VERIFIED = ("anchored", "six_landmarks")
RUNS, SEED = 100, 1_000_000
_TIMED_RUNS = 5

World = dict[str, dict[str, Any]]
"""Digest and measures of each filter, by its label."""


def score_filters(
    estimators: str,
    runs: int = RUNS,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> dict[str, Any]:
    """Run the protocol.

    Scores are averages over the worlds: |ln ratio| of the NEES of the pose over all
    steps, and of the map relative to the robot at the end, where 0 is best; and the
    efficiency of the position. A score is None where a measure of a world is unknown.

    Parameters
    ----------
    estimators : str
        Names separated by commas, as in `monte_carlo`.
    runs : int
        100 in the protocol; tests use fewer.
    progress : callable, optional
        Called with (worlds done, worlds).

    Returns
    -------
    dict
        The content of the file that ``slamgym benchmark`` writes.
    """
    worlds = {}
    for done, name in enumerate(WORLDS):
        progress(done, len(WORLDS))
        worlds[name] = run_world(name, estimators, runs)
    progress(len(WORLDS), len(WORLDS))
    return {
        "protocol": PROTOCOL,
        "estimators": estimators,
        "runs": runs,
        "seed": SEED,
        "versions": json.loads(provenance("")["versions"]),
        "machine": platform.machine(),
        "worlds": worlds,
        "scores": {label: scores(worlds, label) for label in worlds[WORLDS[0]]},
        "microseconds": step_times(estimators),
    }


def run_world(name: str, estimators: str, runs: int) -> World:
    """Run the filters in one world."""
    results = monte_carlo(name, estimators, runs, SEED, progress=False)
    found = {}
    for label, entry in summarise_monte_carlo(results)["estimators"].items():
        efficiency = (entry["efficiency"] or {}).get("pose")
        found[label] = {
            "digest": digest(results.sel(estimator=label)),
            "verdict": entry["verdict"],
            "pose": entry["pose_nees"]["invariant"]["mean"],
            "map": entry["nees_end"]["relative_map"],
            "efficiency": efficiency and efficiency["value"],
            "failed_runs": entry["failed_runs"],
        }
    return found


def digest(results: xr.Dataset) -> str:
    """Return the SHA-256 of the names, shapes and bytes of all numbers."""
    sha = hashlib.sha256()
    for name in sorted(map(str, results.data_vars)):
        values = results[name].values
        if values.dtype != object:  # messages may name paths of the machine
            sha.update(f"{name}{values.shape}{values.dtype.str}".encode())
            sha.update(np.ascontiguousarray(values).tobytes())
    return sha.hexdigest()


def scores(worlds: dict[str, World], label: str) -> dict[str, float | None]:
    """Average the measures of one filter over the worlds."""
    rows = [world[label] for world in worlds.values()]
    distances = {
        key: [row[key] and abs(math.log(row[key])) for row in rows]
        for key in ("pose", "map")
    }
    return {
        "pose": _average(distances["pose"]),
        "map": _average(distances["map"]),
        "efficiency": _average([row["efficiency"] for row in rows]),
    }


def _average(values: list[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return sum(known) / len(known) if len(known) == len(values) else None


def step_times(estimators: str) -> dict[str, float]:
    """Measure the CPU time of a step in `loop`, after a run that compiles [µs]."""
    scenario, found = load_scenario("loop"), {}
    made = simulate_runs(scenario, _TIMED_RUNS, SEED)
    for choice in estimator_choices(estimators):
        settings = settings_for_scenario(
            scenario, estimator=choice.name, options=choice.options
        )
        filter_runs(settings, made, threads=1)
        began = time.process_time()
        filter_runs(settings, made, threads=1)
        seconds = time.process_time() - began
        found[choice.label] = 1e6 * seconds / (_TIMED_RUNS * scenario.steps)
    return found


def differences(
    stored: dict[str, Any],
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> list[str]:
    """Repeat two worlds of a file, and name each filter and world with other bits."""
    found = []
    for done, name in enumerate(VERIFIED):
        progress(done, len(VERIFIED))
        ours = run_world(name, stored["estimators"], stored["runs"])
        for label, row in stored["worlds"][name].items():
            if label not in ours or ours[label]["digest"] != row["digest"]:
                found.append(f"{label} in {name}")
    progress(len(VERIFIED), len(VERIFIED))
    return found


def read_scores(path: Path) -> dict[str, Any]:
    """Read a file of ``slamgym benchmark``.

    Raises
    ------
    ValueError
        If it is another file.
    """
    try:
        stored: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
        rows = [row for name in VERIFIED for row in stored["worlds"][name].values()]
        is_right = stored["protocol"] == PROTOCOL and stored["seed"] == SEED
        is_right &= (
            isinstance(stored["estimators"], str) and type(stored["runs"]) is int
        )
        is_right &= 1 <= stored["runs"] <= RUNS and all("digest" in row for row in rows)
    except (ValueError, KeyError, TypeError, AttributeError):
        is_right = False
    if not is_right:
        raise ValueError(
            f"{path} must be a file that slamgym benchmark --out has written, "
            f"by the protocol {PROTOCOL}"
        )
    return stored
