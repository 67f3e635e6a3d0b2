"""What would be known after a plan: open-loop beliefs of filters of the family."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike

from ... import argument_checks
from ...arrays import Array, IntArray
from ..kernels.imagine import Imagined, as_view, imagine_plans
from ..kernels.scan_update import AFTER_STDS, FIRST_STD, workspace_for
from ..models.motions import only_unicycle
from ..models.sensor_kernels import for_sensor
from .batch import BatchSlam, can_batch
from .ekf import EkfSlam


class SensorLimits(Protocol):
    """What a sensor sees; ``Scenario.sensor`` has these attributes."""

    #: Nearest visible landmark [m].
    min_range: float
    #: Farthest visible landmark [m].
    max_range: float
    #: Full angle of view, centred on the heading [rad].
    field_of_view: float
    #: Whether walls hide landmarks.
    occlusion: bool
    #: Probability of losing a reading.
    dropout: float


_LIMITS = tuple(SensorLimits.__annotations__)


def imagine(
    filters: EkfSlam | BatchSlam,
    plans: ArrayLike,
    sensor: SensorLimits,
    *,
    walls: ArrayLike = (),
    density: tuple[ArrayLike, ArrayLike] | None = None,
    horizons: ArrayLike | None = None,
) -> Imagined:
    """Predict the beliefs after given plans, without driving them.

    From its present belief, the filter predicts with the odometry of a plan, and
    updates with the readings that it expects: those of the mapped landmarks that the
    sensor sees from the estimated pose. Their innovations are zero, so the means follow
    the plan and only the covariances depend on the readings. No filter changes.

    If readings can drop out, their variance is divided by 1 - dropout, which gives
    them the expected share of their information.

    Parameters
    ----------
    filters : EkfSlam or BatchSlam
        One filter, or B filters side by side, of the kinds that run in batches: their
        beliefs, rules and noise.
    plans : array_like, shape (K, T, 2) or (B, K, T, 2)
        Odometry (d, α) of T steps [m, rad]; the same plans for all filters, or K for
        each.
    sensor : SensorLimits
        ``scenario.sensor``, or any object with its attributes.
    walls : array_like, shape (W, 4)
        Rows (x0, y0, x1, y1) [m]. They hide landmarks if ``sensor.occlusion`` is set.
    density : (points, counts), optional
        Points where unmapped landmarks may be, (C, 2) [m], and the expected number of
        them at each point, (C,) or (B, C). A point counts once it is in view.
    horizons : array_like of int, shape (H,), optional
        Increasing numbers of steps, from 1 to T. The certainty of the map is then
        returned after each of them, along an axis that follows that of the plans.

    Returns
    -------
    Imagined
        L is the number of landmarks of a batch, or that of a filter's map, in the
        order of its belief. B is 1 for one filter. nan where an update fails.

    Raises
    ------
    TypeError
        If the filter has another type, or the sensor lacks an attribute.
    ValueError
        If an array has a wrong shape or is not finite, there is no plan or no step, or
        a horizon is not a step of the plans or not after the one before.

    Examples
    --------
    >>> from slamgym.sim_configs import load_scenario
    >>> slam = EkfSlam((0.1, 0.05, 0.05), (0.02, 0.1))
    >>> _ = slam.update([(0.0, 2.0)], landmark_ids=[7])
    >>> ahead, back = np.full((5, 2), (0.2, 0.0)), np.full((5, 2), (-0.2, 0.0))
    >>> sensor = load_scenario("active_medium").sensor
    >>> after = imagine(slam, [ahead, back], sensor)
    >>> after.worst_variances.shape
    (1, 2, 1)
    >>> bool((after.worst_variances[0, 0] < slam.belief().covariance[3, 3]).all())
    True
    """
    if missing := [name for name in _LIMITS if not hasattr(sensor, name)]:
        raise TypeError(
            f"sensor must have {', '.join(_LIMITS)}, as scenario.sensor has, but "
            f"{type(sensor).__name__} has no {missing[0]}"
        )
    means, covariances, references, slots = _beliefs(filters)
    only_unicycle(filters.motion, "imagine")
    count, landmarks = slots.shape
    driven = _checked_plans(plans, count)
    ends = _checked_walls(walls)
    dropout = float(sensor.dropout)
    rules = filters.rule_values.copy()
    rules[FIRST_STD:AFTER_STDS] /= max(1.0 - dropout, 1e-9) ** 0.5
    view = as_view(
        float(sensor.max_range),
        min(float(sensor.field_of_view), filters.sensor.field_of_view),
        ends if sensor.occlusion else ends[:0],
    )
    min_range = float(sensor.min_range)
    settings = tuple(view), min_range, dropout, filters.motion_values, rules
    plans_each, steps = driven.shape[1:3]
    ending = _checked_horizons(horizons, steps)
    results = Imagined(
        np.full((count, plans_each, steps, 3), np.nan),
        np.full((count, plans_each, steps, 3, 3), np.nan),
        np.full((count, plans_each, len(ending)), np.nan),
        np.full((count, plans_each, len(ending), landmarks), np.nan),
        np.full((count, plans_each, steps), np.nan),
    )
    workspace = workspace_for(filters.rules, landmarks, means.shape[1])
    for_sensor(imagine_plans, filters.sensor)(
        (means, covariances, references, slots),
        driven,
        ending,
        _checked_density(density, count),
        settings,
        tuple(workspace),
        tuple(results),
    )
    if horizons is not None:
        return results
    return results._replace(
        log_det=results.log_det[:, :, 0],
        worst_variances=results.worst_variances[:, :, 0],
    )


def _beliefs(filters: EkfSlam | BatchSlam) -> tuple[Array, Array, Array, IntArray]:
    """Return means, covariances, references and slots, live."""
    if isinstance(filters, BatchSlam):
        means, covariances, slots = filters.storage()
        return means, covariances, filters.references, slots
    if not can_batch(filters):
        raise TypeError(
            "filters must be a BatchSlam, or a filter that can run in batches, "
            f"got {type(filters).__name__}"
        )
    gaussian = filters.map
    slots = np.arange(len(gaussian.slots))[None]
    means, covariances, references = (array[None] for array in gaussian.arrays)
    return means, covariances, references, slots


def _checked_plans(plans: ArrayLike, count: int) -> Array:
    """Return plans (B, K, T, 2)."""
    given = argument_checks.as_floats("plans", plans)
    if given.ndim not in (3, 4) or given.shape[-1] != 2 or 0 in given.shape:
        raise ValueError(
            "plans must have shape (K, T, 2) or (B, K, T, 2) with at least one plan of "
            f"one step, got {given.shape}"
        )
    if given.ndim == 4 and len(given) != count:
        raise ValueError(
            f"plans must be those of {count} filters along the first axis, "
            f"got {given.shape}"
        )
    if not np.isfinite(given).all():
        raise ValueError("plans must be finite")
    return given if given.ndim == 4 else given[None].repeat(count, axis=0)


def _checked_horizons(horizons: ArrayLike | None, steps: int) -> IntArray:
    """Return increasing numbers of steps (H,), by default that of all steps."""
    if horizons is None:
        return np.array([steps])
    given = np.asarray(horizons)
    if given.ndim != 1 or not given.size or given.dtype.kind not in "iu":
        raise ValueError(f"horizons must be whole numbers of steps, got {horizons!r}")
    ends = given.astype(np.int64)
    if ends[0] < 1 or ends[-1] > steps or (np.diff(ends) <= 0).any():
        raise ValueError(
            f"horizons must increase from 1 to at most {steps}, got {ends.tolist()}"
        )
    return ends


def _checked_walls(walls: ArrayLike) -> Array:
    ends = argument_checks.as_floats("walls", walls)
    if ends.size and (ends.ndim != 2 or ends.shape[1] != 4):
        raise ValueError(
            f"walls must have shape (W, 4), rows (x0, y0, x1, y1), got {ends.shape}"
        )
    if not np.isfinite(ends).all():
        raise ValueError("walls must be finite")
    return ends.reshape(-1, 4)


def _checked_density(
    density: tuple[ArrayLike, ArrayLike] | None, count: int
) -> tuple[Array, Array]:
    """Return points (2, C) and expected counts (B, C)."""
    if density is None:
        return np.zeros((2, 0)), np.zeros((count, 0))
    points, weights = (argument_checks.as_floats("density", part) for part in density)
    cells = len(points) if points.shape[1:] == (2,) else -1
    if weights.shape not in ((cells,), (count, cells)):
        raise ValueError(
            f"density must be points (C, 2) and counts (C,) or ({count}, C), "
            f"got {points.shape} and {weights.shape}"
        )
    usable = np.isfinite(points).all() and np.isfinite(weights).all()
    if not usable or (weights < 0).any():
        raise ValueError("density must be finite points and finite counts >= 0")
    spread = np.broadcast_to(weights, (count, cells))
    return np.ascontiguousarray(points.T), np.ascontiguousarray(spread)
