"""The scores of a run's association as a table for the terminal."""

from typing import Any

from rich.table import Table

from .tables import named_rows, significant


def association_table(scores: dict[str, Any]) -> Table:
    """Lay out the ``association`` of a summary.

    Parameters
    ----------
    scores : dict
        As in :func:`slamgym.experiments.runs.summary.association_summary`.
    """
    title = "Association"
    if scores["resolution"]:
        title += f", landmarks nearer than {scores['resolution']:g} m counted as one"
    return named_rows(_rows(scores), title)


def _rows(scores: dict[str, Any]) -> list[tuple[str, str]]:
    found = scores["gospa"]
    rows = [("GOSPA of the map", _gospa(found, "aligned") + " once best fitted")]
    rows.append(("… raw", f"{_gospa(found, 'raw')}; cut-off {found['cutoff']:g} m"))
    if scores["correct"] is None:
        return rows
    readings = (
        f"{scores['correct']} correct, {scores['wrong']} wrong, {scores['missed']} "
        f"not used, {scores['clutter_used']} of clutter used"
    )
    new = (
        f"{scores['new_correct']} correct, {scores['duplicate']} duplicates, "
        f"{scores['ghost']} of clutter"
    )
    size = f"{scores['map_size']}; {scores['true_map_size']} were seen often enough"
    shares = f"{_share(scores['precision'])}, recall {_share(scores['recall'])}"
    return [
        ("readings", readings),
        ("new landmarks", new),
        ("map size", size),
        ("precision", shares),
        *rows,
    ]


def _gospa(found: dict[str, Any], which: str) -> str:
    parts = found[which]
    return (
        f"{significant(parts['distance'])} m: {parts['missed_count']} missed, "
        f"{parts['false_count']} false, localisation "
        f"{significant(parts['localisation'] ** 0.5)} m"
    )


def _share(value: float | None) -> str:
    return "-" if value is None else f"{value:.3f}"
