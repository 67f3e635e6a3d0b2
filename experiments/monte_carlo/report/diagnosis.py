"""The cause of an inconsistency, as an entry of the summary and as a sentence."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from ....arrays import Array
from ....estimator.models.rigid_motion import ErrorFrame
from ....evaluation.diagnosis import CANNOT_TELL, HONEST, Diagnosis, diagnose
from ...runs.nan_statistics import finite
from ..measure.association_measures import (
    KNOWN_IDS_ATE,
    KNOWN_IDS_NEES,
    PREFIX,
)
from .scores import EstimatorScores

_MISTAKES = ("wrong", "duplicate", "ghost", "clutter_used")


def diagnosis_summary(
    scores: EstimatorScores, frame: ErrorFrame
) -> dict[str, Any] | None:
    """Name the cause for which an estimator is not consistent.

    Returns
    -------
    dict or None
        ``cause``, one of :data:`slamgym.evaluation.CAUSES`, its ``p``, a ``sentence``,
        and ``others``, further causes; see :func:`slamgym.evaluation.diagnose`. None
        for results without noise, which an older version wrote.
    """
    if "noise_sums" not in scores.results:
        return None
    found = _diagnosed(scores, frame)
    return {
        "cause": found.cause,
        "p": finite(found.p_value),
        "sentence": found.sentence,
        "others": list(found.others),
    }


def diagnosis_lines(label: str, entry: Mapping[str, Any]) -> tuple[str, ...]:
    """Write the cause in an entry of the summary as a line, if there is one.

    Examples
    --------
    >>> found = {"cause": "clutter", "sentence": "clutter: it is used."}
    >>> diagnosis_lines("ekf", {"diagnosis": found})
    ('ekf: cause: clutter: it is used.',)
    """
    found = entry.get("diagnosis")
    if found is None or found["cause"] == HONEST:
        return ()
    return (f"{label}: cause: {found['sentence']}",)


def _diagnosed(scores: EstimatorScores, frame: ErrorFrame) -> Diagnosis:
    """Diagnose the runs that succeeded; the noise of all runs counts.

    If runs failed and the others are consistent, the answer is "cannot tell".
    """
    nees = scores.over_time(f"pose_nees_{frame}")[:, scores.first - 1 :]
    heading = scores.over_time("heading_nees")[:, scores.first - 1 :]
    found = diagnose(
        scores.per_run("noise_sums"),
        nees,
        heading,
        nis_ratio=scores.nis_per_degree,
        heading_knowledge=_heading_knowledge(scores),
        mistakes=_mistakes(scores),
        known_nees=_known_nees(scores, frame),
    )
    if found.cause != "honest" or not scores.failures:
        return found
    failed, runs = len(scores.failures), len(scores.good)
    return Diagnosis(
        CANNOT_TELL,
        found.p_value,
        f"cannot tell: {failed} of {runs} runs failed; the others are honest.",
    )


def _heading_knowledge(scores: EstimatorScores) -> Array | None:
    """Divide the variance of the last heading by the least possible one."""
    bound = scores.per_run("heading_bound")[:, -1]
    if scores.nis_per_degree is None or not (bound > 0).all():
        return None
    return np.asarray(scores.per_run("heading_std")[:, -1] ** 2 / bound)


def _mistakes(scores: EstimatorScores) -> Array | None:
    if KNOWN_IDS_ATE not in scores.results:
        return None
    counts = [scores.per_run(f"{PREFIX}{name}") for name in _MISTAKES]
    return np.asarray(np.nan_to_num(np.sum(counts, axis=0)))


def _known_nees(scores: EstimatorScores, frame: ErrorFrame) -> Array | None:
    """Return the NEES of the same filter with known identities, if it failed nowhere.

    Results that an older version wrote have none.
    """
    name = f"{KNOWN_IDS_NEES}_{frame}"
    if name not in scores.results:
        return None
    known = scores.over_time(name)[:, scores.first - 1 :]
    return known if np.isfinite(known).all() else None
