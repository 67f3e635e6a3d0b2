"""The leaves: parts of the package that the core does not need.

A leaf may import the core and other leaves.  The core imports no leaf.  Where the core
uses a leaf, it requests the module from `leaf`, and continues without it if the module
has been deleted.  Public names, registered filters and commands of a deleted leaf are
left out.
"""

from importlib import import_module
from typing import Any

from .public_names import is_here

#: Each leaf with its modules and folders.
LEAVES: dict[str, tuple[str, ...]] = {
    "unscented": ("estimator.filters.unscented",),
    "robocentric": ("estimator.filters.robocentric",),
    "large maps": ("estimator.large_maps",),
    "other libraries": ("estimator.peers",),
    "smoother": (
        "estimator.smoother",
        "experiments.run_and_replay.log_smoothing",
        "experiments.figures.smoothed",
        "experiments.command_line.smooth",
    ),
    "noise of logs": (
        "estimator.filters.drive_likelihood",
        "experiments.noise_fitting",
        "experiments.command_line.fit_noise",
    ),
    "conventions of logs": ("experiments.log_conventions",),
    "judge": (
        "experiments.judging",
        "experiments.estimate_files",
        "experiments.estimate_conventions",
        "experiments.space_poses",
        "experiments.command_line.judge",
    ),
    "benchmark": (
        "experiments.consistency_protocol",
        "experiments.command_line.benchmark",
    ),
    "viewers": ("experiments.viewers",),
    "page of noises": (
        "experiments.noise_explorer",
        "experiments.command_line.explore",
    ),
    "formats of trajectories": (
        "experiments.trajectories.g2o",
        "experiments.trajectories.parquet",
        "experiments.trajectories.minari_dataset",
    ),
    "predicted beliefs": ("estimator.kernels.imagine", "estimator.filters.imagine"),
    "active SLAM": (
        "agents.active_slam",
        "agents.active_slam_baselines",
        "agents.active_slam_kernels",
        "agents.active_slam_scores",
        "agents.active_slam_task",
        "agents.belief_space_planner",
        "agents.landmark_set",
        "agents.wall_routes",
    ),
}


def leaf(module: str) -> Any:
    """Return a module of a leaf, or None if it has been deleted.

    Parameters
    ----------
    module : str
        Its name in the package, such as ``"experiments.viewers"``.
    """
    return import_module(f"{__package__}.{module}") if is_here(module) else None
