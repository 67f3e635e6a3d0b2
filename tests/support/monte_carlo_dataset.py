"""Results of a Monte Carlo in the runner's schema, made here step by step, slowly.

Of numpy and the estimators' beliefs alone, so that the report is tested without the
runner; `monte_carlo` returns the same variables.
"""

import functools
import json
import tempfile
from pathlib import Path

import numpy as np
import xarray as xr

from slamgym import __version__
from slamgym.estimator import make_batch
from slamgym.estimator.models.bearing_range import wrap_angle
from slamgym.estimator.models.rigid_motion import invariant_error
from slamgym.evaluation import nees as c
from slamgym.evaluation.error_bound import posterior_bound
from slamgym.evaluation.noise_findings import noise_sums
from slamgym.evaluation.trajectory_error import position_accuracy
from slamgym.experiments.runs.simulated_runs import simulate_runs
from slamgym.sim_configs import load_scenario
from slamgym.sim_configs.scenario_files import save_scenario

RUN, STEP = ("estimator", "run"), ("estimator", "run", "step")
LANDMARK = ("estimator", "run", "landmark")
NOISE = ("estimator", "run", "noise", "moment")
FILTERS = {
    "ekf": {"name": "ekf", "options": {}},
    "invariant": {"name": "invariant", "options": {}},
}


@functools.cache
def typical(scenario="six_landmarks", runs=40, seed=0, steps=None):
    """Results that tests share and must not change: take a ``.copy(deep=True)``."""
    return make_dataset(scenario, runs, seed, FILTERS, steps=steps)


def make_dataset(scenario, runs, seed, filters, *, steps=None, command=None):
    world = load_scenario(scenario)
    if steps is not None:
        world = world.with_changes(steps=steps)
    drives = simulate_runs(world, runs, seed)
    parts = [scores_of(world, drives, **entry) for entry in filters.values()]
    variables = {
        name: (dims, np.stack([part[name][1] for part in parts]))
        for name, (dims, _) in parts[0].items()
    }
    labels = ",".join(filters)
    attrs = {
        "scenario": toml_of(world),
        "scenario_name": world.name,
        "seed": seed,
        "runs": runs,
        "estimators": json.dumps(filters),
        "versions": json.dumps({"slamgym": __version__, "numpy": np.__version__}),
        "command": f"slamgym monte-carlo {world.name} --estimators {labels} "
        f"--runs {runs} --seed {seed} --out results/{world.name}"
        if command is None
        else command,
    }
    coords = {"estimator": list(filters), "run": np.arange(runs)}
    coords["step"] = np.arange(world.steps + 1)
    coords["landmark"] = np.arange(drives.landmarks.shape[1])
    return xr.Dataset(variables, coords, attrs)


def scores_of(world, drives, name, options):
    runs, _, landmarks = drives.visible.shape
    batch = make_batch(
        name,
        runs=runs,
        landmarks=landmarks,
        initial_poses=drives.initial_poses,
        motion_std=world.motion.std,
        measurement_std=world.sensor.std,
        range_std_per_metre=world.sensor.range_std_per_metre,
        noise_at_rest=world.motion.noise_at_rest,
        initial_pose_std=world.start.std,
        **options,
    )
    trace = batch.run(drives.odometry, drives.measurements, drives.visible, drives.dt)
    bound = posterior_bound(
        drives.true_poses,
        drives.landmarks,
        drives.visible,
        drives.dt,
        motion_std=world.motion.std,
        measurement_std=world.sensor.std,
        start_std=world.start.std,
        range_std_per_metre=world.sensor.range_std_per_metre,
    )
    sums = noise_sums(
        drives.true_poses,
        drives.landmarks,
        drives.odometry,
        drives.measurements,
        drives.visible,
        motion_std=world.motion.std,
        measurement_std=world.sensor.std,
        range_std_per_metre=world.sensor.range_std_per_metre,
        noise_in=world.motion.noise_in,
    )
    bounds = {
        "position_bound": (STEP, bound.position),
        "position_bound_raw": (STEP, bound.raw_position),
        "heading_bound": (STEP, bound.heading),
        "map_bound": (RUN, bound.map),
        "noise_sums": (NOISE, sums),
    }
    return over_time(drives, trace) | at_the_end(drives, trace, batch) | bounds


def over_time(drives, trace):
    poses = drives.true_poses, trace.poses, trace.pose_covariances
    errors = drives.true_poses - trace.poses
    variance = np.diagonal(trace.pose_covariances, axis1=2, axis2=3)
    found = {
        f"{what}_nees_{frame}": measure(*poses, frame=frame)
        for what, measure in (("pose", c.pose_nees), ("position", c.position_nees))
        for frame in ("invariant", "additive")
    }
    with np.errstate(divide="ignore", invalid="ignore"):
        found["heading_nees"] = c.heading_nees(*poses)
    found["nis"], found["nis_dof"] = trace.nis, trace.degrees_of_freedom
    found["position_error"] = np.hypot(errors[..., 0], errors[..., 1])
    invariant = invariant_error(drives.true_poses, trace.poses)
    found["position_error_invariant"] = np.hypot(invariant[..., 0], invariant[..., 1])
    found["heading_error"] = wrap_angle(errors[..., 2])
    found["heading_std"] = np.sqrt(variance[..., 2])
    found["position_std"] = np.sqrt(variance[..., :2].sum(axis=2))
    return {name: (STEP, values) for name, values in found.items()}


def at_the_end(drives, trace, batch):
    rows = [run_end(drives, trace, batch.belief(run), run) for run in range(batch.runs)]
    dims = {name: LANDMARK if np.ndim(rows[0][name]) else RUN for name in rows[0]}
    found = {name: (dims[name], np.array([row[name] for row in rows])) for name in dims}
    found["failed"] = RUN, batch.failed_at >= 0
    found["failed_at"] = RUN, np.asarray(batch.failed_at)
    found["readings"] = RUN, drives.visible.sum(axis=(1, 2))
    found["message"] = RUN, np.full(batch.runs, "", dtype=object)
    return found


def run_end(drives, trace, belief, run):
    seen, true = np.array(belief.landmark_ids), drives.landmarks[run]
    states = np.concatenate([drives.true_poses[run, -1], true[seen].ravel()])
    state = states, belief.mean, belief.covariance
    path = position_accuracy(trace.poses[run, :, :2], drives.true_poses[run, :, :2])
    world = position_accuracy(belief.landmarks, true[seen])
    blocks = [belief.covariance[i : i + 2, i : i + 2] for i in range(3, len(states), 2)]
    places = invariant_error(states, belief.mean)[3:].reshape(-1, 2)
    centred = np.linalg.norm(places - places.mean(axis=0), axis=1)
    areas = [9 * np.pi * np.sqrt(np.linalg.det(block)) for block in blocks]
    row = {
        "state_dof": len(states),
        "relative_map_nees": c.relative_map_nees(*state),
        "relative_map_dof": len(states) - 3,
        "landmark_rmse": world.raw_rmse,
        "landmark_rmse_aligned": world.aligned_rmse,
        "map_error_centred": np.sqrt(np.mean(centred**2)),
        "ate": path.raw_rmse,
        "ate_aligned": path.aligned_rmse,
        "pose_area": 9 * np.pi * np.sqrt(np.linalg.det(belief.covariance[:2, :2])),
        "landmark_area": np.mean(areas),
    }
    each = {
        "landmark_error": world.raw_errors,
        "landmark_mahalanobis": np.sqrt(c.landmark_nees(*state, frame="additive")),
    }
    for frame in ("invariant", "additive"):
        row[f"state_nees_{frame}"] = c.state_nees(*state, frame=frame)
        each[f"landmark_nees_{frame}"] = c.landmark_nees(*state, frame=frame)
    for name, values in each.items():
        row[name] = np.full(len(true), np.nan)
        row[name][seen] = values
    return row


def toml_of(world):
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "scenario.toml"
        save_scenario(world, path)
        return path.read_text(encoding="utf-8")


def with_failures(dataset, failures):
    """Copy results, with nan from each failure (label, run, step, message) on."""
    changed = dataset.copy(deep=True)
    for label, run, step, message in failures:
        row = {"estimator": label, "run": run}
        for name, values in changed.data_vars.items():
            if values.dtype.kind == "f":
                part = {"step": slice(step, None)} if "step" in values.dims else {}
                changed[name].loc[row | part] = np.nan
        changed["failed"].loc[row] = True
        changed["failed_at"].loc[row] = step
        changed["message"].loc[row] = message
    return changed
