"""Results of Monte Carlo that the tests of summaries, reports and figures share."""

import functools
import json

import numpy as np
import xarray as xr

from slamgym.experiments.monte_carlo_study import monte_carlo
from slamgym.sim_configs import load_scenario


@functools.cache
def typical(scenario="six_landmarks", runs=40, seed=0, steps=None):
    """Results that tests share and must not change: take a ``.copy(deep=True)``."""
    world = load_scenario(scenario)
    if steps is not None:
        world = world.with_changes(steps=steps)
    command = (
        f"slamgym monte-carlo {world.name} --estimators ekf,invariant "
        f"--runs {runs} --seed {seed} --out results/{world.name}"
    )
    results = monte_carlo(world, "ekf,invariant", runs, seed, command=command)
    return results.assign(message=results["message"].astype(object))


def with_failures(dataset, failures):
    """Copy results, with nan from each failure (label, run, step, message) on."""
    changed = dataset.copy(deep=True)
    for label, run, step, message in failures:
        row = {"estimator": label, "run": run}
        for name, values in changed.data_vars.items():
            if values.dtype.kind == "f":
                part = {"step": slice(step, None)} if "step" in values.dims else {}
                changed[name].loc[row | part] = float("nan")
        changed["failed"].loc[row] = True
        changed["failed_at"].loc[row] = step
        changed["message"].loc[row] = message
    return changed


def simulated(nees, looks=(), failed=(), landmarks=None):
    """Results of an estimator "mine" that has NEES, (runs, steps), and nothing else.

    It has a map if given whitened errors of landmarks, (runs, landmarks, 2): nan where
    unknown, infinite where the covariance is singular.
    """
    runs, steps = nees.shape
    flags = np.isin(np.arange(runs), failed)
    over_time = {
        "pose_nees_invariant": np.insert(nees, 0, np.nan, axis=1),
        "nis": np.zeros((runs, steps + 1)),
        "nis_dof": np.zeros((runs, steps + 1), dtype=np.int64),
    }
    per_run = {
        "failed": flags,
        "failed_at": np.where(flags, 1, -1),
        "message": np.where(flags, "boom", "").astype(object),
    }
    dims, each = ("estimator", "run", "step"), {}
    if landmarks is not None:
        squares = (landmarks**2).sum(axis=2)
        each["landmark_deviation_x"], each["landmark_deviation_y"] = landmarks.T
        each = {name: values.T for name, values in each.items()}
        each["landmark_nees_invariant"] = squares
        total = np.nansum(squares, axis=1)
        per_run["relative_map_nees"] = np.where(np.isinf(total), np.nan, total)
        per_run["relative_map_dof"] = 2 * (~np.isnan(squares)).sum(axis=1)
    return xr.Dataset(
        {name: (dims, values[None]) for name, values in over_time.items()}
        | {name: (dims[:2], values[None]) for name, values in per_run.items()}
        | {
            name: ((*dims[:2], "landmark"), values[None])
            for name, values in each.items()
        },
        {"estimator": ["mine"], "run": np.arange(runs)},
        {"looks": json.dumps(looks)} if looks else {},
    )
