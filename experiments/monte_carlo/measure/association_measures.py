"""Measure how well a run associated readings without identity.

A run is bad if it fails, or if its path error is more than `MARGIN` above that of the
same filter with known identities on the same readings.
"""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ....arrays import Array
from ....estimator.interface import Belief
from ....estimator.models.rigid_motion import ERROR_FRAMES, ErrorFrame
from ....evaluation.association_scores import AssociationScores, Gospa
from ....evaluation.nees import pose_nees
from ...runs.association import RunAssociation, TrueLandmarks, compare_association
from ...runs.filter_settings import FilterSettings
from ...runs.simulated_runs import SimulatedRuns
from .filtered_runs import FilteredRuns, filter_runs

MARGIN = 1.0
"""Path error above that with known identities [m]."""

COUNTS = AssociationScores._fields
SHARES = ("precision", "recall")
MAPS = ("raw", "aligned")

KNOWN_IDS_ATE = "known_ids_ate"
KNOWN_IDS_NEES = "known_ids_nees"
"""Followed by the error frame."""

PREFIX = "association_"

MEANINGS: dict[str, str] = {
    **{f"{PREFIX}{name}": f"{name.replace('_', ' ')}, see docs" for name in COUNTS},
    f"{PREFIX}precision": "share of right ones among readings given to landmarks",
    f"{PREFIX}recall": "share of right ones among readings of landmarks",
    **{
        f"gospa_{which}_{part}": f"GOSPA of the final map, {which}: {part}"
        for which in MAPS
        for part in Gospa._fields
    },
    KNOWN_IDS_ATE: "path error of the same filter with known identities, raw [m]",
}
"""Of the variables that only a world without identities has; nan where unknown."""


def measure_association(
    runs: SimulatedRuns, filtered: FilteredRuns, run: int, resolution: float
) -> Mapping[str, NDArray[np.generic] | float]:
    """Measure one run; empty if its filter reports no decisions, or failed.

    Parameters
    ----------
    runs : SimulatedRuns
        The runs.
    filtered : FilteredRuns
        The beliefs of a filter in them.
    run : int
        Index of the run.
    resolution : float
        True landmarks nearer to each other count as one place [m].
    """
    made, belief = filtered.decisions.get(run), filtered.beliefs[run]
    if made is None or belief is None:
        return {}
    truth = TrueLandmarks(np.arange(runs.landmarks.shape[1]), runs.landmarks[run])
    found = compare_association(
        made, truth, belief.landmark_ids, belief.landmarks, resolution=resolution
    )
    return _values(found)


def _values(found: RunAssociation) -> dict[str, float]:
    scores = {} if found.scores is None else found.scores.as_dict()
    parts = {"raw": found.raw, "aligned": found.aligned}
    return {
        **{f"{PREFIX}{name}": float(value) for name, value in scores.items()},
        **{
            f"gospa_{which}_{part}": float(value)
            for which, whole in parts.items()
            for part, value in whole._asdict().items()
        },
    }


def identified(belief: Belief, identities: Mapping[int, int]) -> Belief:
    """Return a belief about true landmarks by their identity.

    Of several mapped landmarks that are of one true landmark, the first counts; those
    of none are left out.
    """
    chosen: dict[int, int] = {}
    for landmark in belief.landmark_ids:
        chosen.setdefault(identities.get(landmark, -1), landmark)
    chosen.pop(-1, None)
    slots = {landmark: slot for slot, landmark in enumerate(belief.landmark_ids)}
    part = Belief.marginal(
        belief.mean, belief.covariance, slots, list(chosen.values()), belief.frame
    )
    return replace(part, landmark_ids=tuple(chosen))


def with_known_ids(
    settings: FilterSettings, runs: SimulatedRuns, threads: int | None
) -> dict[str, Array]:
    """Return the scores of the same filter with known identities.

    It has no landmark management.

    Returns
    -------
    dict
        Path errors (B,) [m], and the NEES of the pose (B, T) in both frames; nan in
        runs that fail.
    """
    options = {k: v for k, v in settings.options.items() if k != "management"}
    plain = replace(settings, options=options)
    trace = filter_runs(plain, runs.identified(), threads=threads).trace
    gaps = trace.poses[:, :, :2] - runs.true_poses[:, :, :2]
    errors = np.sqrt((gaps**2).sum(axis=2).mean(axis=1))
    posed = runs.true_poses, trace.poses, trace.pose_covariances
    with np.errstate(all="ignore"):  # a diverged run may overflow
        scores = {
            f"{KNOWN_IDS_NEES}_{frame}": _pose_nees(*posed, frame)
            for frame in ERROR_FRAMES
        }
    return {KNOWN_IDS_ATE: errors, **scores}


def _pose_nees(
    truth: Array, poses: Array, covariances: Array, frame: ErrorFrame
) -> Array:
    """Return the NEES of the pose run by run, (B, T)."""
    return np.array(
        [
            pose_nees(*run, frame=frame)
            for run in zip(truth, poses, covariances, strict=True)
        ]
    )
