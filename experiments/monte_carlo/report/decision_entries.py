"""The test decisions on an estimator as plain JSON types."""

import math
from typing import Any

from ....evaluation.consistency_report import ConsistencyReport
from ....evaluation.hypothesis_tests import EQUIVALENCE_MARGIN, HypothesisTest
from ...runs.nan_statistics import finite


def decisions_table(report: ConsistencyReport) -> dict[str, Any]:
    """Return the decisions of a report as plain JSON types.

    Returns
    -------
    dict
        ``final_step``, ``time_average``, ``bootstrap``, ``nis``, ``whiteness``, each
        ``{statistic, interval, p_value, accepted, error_rate}`` with the interval that
        is accepted, all None where nothing is decided; ``grid``, with ``steps``,
        ``rejected`` and one ``statistic`` per step;
        ``equivalence``, whose 90 % ``interval`` must lie inside ``margin``;
        ``runs_needed`` to find covariances too small by a factor in 90 % of cases.
    """
    grid, equivalence = report.family, report.equivalence
    return {
        "final_step": _decision(report.final_step),
        "time_average": _decision(report.time_average),
        "bootstrap": _decision(report.bootstrap),
        "grid": {
            "steps": (report.family_steps + 1).tolist(),  # it has not seen step 0
            "statistic": [finite(value) for value in grid.statistic],
            "interval": list(grid.interval),
            "p_value": grid.p_value,
            "rejected": grid.rejected.tolist(),
            "accepted": bool(grid.accepted),
            "error_rate": grid.error_rate,
        },
        "nis": _decision(report.nis),
        "whiteness": _decision(report.whiteness),
        "equivalence": {
            "statistic": finite(equivalence.statistic),
            "interval": [finite(end) for end in equivalence.interval],
            "margin": list(EQUIVALENCE_MARGIN),
            "verdict": equivalence.verdict,
            "accepted": equivalence.accepted,
            "error_rate": equivalence.error_rate,
        },
        "runs_needed": {f"{factor:g}": runs for factor, runs in report.runs_needed},
    }


def _decision(decision: HypothesisTest) -> dict[str, Any]:
    decided = not math.isnan(decision.p_value)
    return {
        "statistic": finite(decision.statistic),
        "interval": [finite(end) for end in decision.interval],
        "p_value": finite(decision.p_value),
        "accepted": bool(decision.accepted) if decided else None,
        "error_rate": decision.error_rate,
    }
