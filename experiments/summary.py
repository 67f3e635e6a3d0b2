"""The numbers of a run, as one dictionary of plain JSON types."""

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .. import __version__
from ..estimator.accuracy import PositionAccuracy, position_accuracy
from .consistency_plots import nis_band, pose_errors
from .filter_settings import FilterSettings
from .replay import Replay
from .trace import RunTrace
from .true_path import path_accuracy

Array = NDArray[np.float64]

_SINGULAR = 1e-10  # smallest eigenvalue of a correlation matrix that counts as one


def summarise(replay: Replay, settings: FilterSettings | None = None) -> dict[str, Any]:
    """Gather what one wants to know of a run.

    Every number is finite; what is not known, for want of ground truth, is None.

    Parameters
    ----------
    replay : Replay
        The run.
    settings : FilterSettings, optional
        How its estimator was set up, to be written down too.

    Returns
    -------
    dict
        ``landmarks``: ``{id, x, y, euclidean, mahalanobis}`` of each, in the order of
        the state, the distances to its true position in metres and in standard
        deviations; ``pose``, ``pose_covariance``; ``steps``, ``scans``, ``readings`` by
        what became of them; ``nis`` and ``nees``, see :func:`nis_summary` and
        :func:`nees_summary`; ``ate``, the root mean square distance of the path from
        the truth, see :func:`~slamgym.experiments.true_path.path_accuracy`, and
        ``landmark_rmse`` the same of the map, both ``{raw, aligned}`` [m]; ``log``,
        ``estimator``, ``settings`` and ``slamgym``, the version.
    """
    log, trace = replay.log, replay.trace
    return {
        "slamgym": __version__,
        "log": log.name,
        "estimator": trace.estimator,
        "settings": None if settings is None else _settings_table(settings),
        "steps": trace.last_step,
        "scans": sum(step is not None for step in replay.scanned),
        "readings": replay.readings._asdict(),
        "pose": trace.poses[-1].tolist(),
        "pose_covariance": trace.pose_covariances[-1].tolist(),
        "landmarks": landmark_table(trace),
        "nis": nis_summary(trace),
        "nees": nees_summary(trace),
        "ate": _rmse(path_accuracy(log, trace.t, trace.poses)),
        "landmark_rmse": _rmse(_map_accuracy(trace)),
    }
