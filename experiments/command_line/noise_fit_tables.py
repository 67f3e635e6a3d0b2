"""The result of a noise fit as tables for the terminal."""

from typing import Any

from rich.table import Table
from rich.text import Text

from .tables import named_rows, significant

_VERDICTS = {
    "fitted": "",
    "zero": "may be zero",
    "unknown": "no reading depends on it: not fitted",
}


def noise_table(summary: dict[str, Any]) -> Table:
    """Lay out the standard deviations with their intervals."""
    table = Table(box=None, pad_edge=False)
    for heading in ("noise", "before", "most likely", "95 % interval", "suggested", ""):
        is_text = heading in ("noise", "")
        table.add_column(Text(heading), justify="left" if is_text else "right")
    suggested = _noise_by_name(summary["runs"]["suggested"]["settings"])
    for row in summary["noise"]:
        table.add_row(
            f"{row['name']} [{row['unit']}]".replace("[", "\\["),
            significant(row["before"]),
            "-" if row["verdict"] == "unknown" else significant(row["value"]),
            _interval(row),
            significant(suggested[row["name"]]),
            _VERDICTS[row["verdict"]],
        )
    return table


def comparison_table(summary: dict[str, Any]) -> Table:
    """Lay out the results of filters under each noise."""
    table, runs = Table(box=None, pad_edge=False), summary["runs"]
    for heading in ("", *runs):
        table.add_column(Text(heading), justify="right" if heading else "left")
    for name, path in (
        ("log likelihood", ("log_likelihood",)),
        ("readings rejected", ("readings", "rejected")),
        ("NIS per degree, 1 expected", ("nis", "per_degree")),
        ("pose NEES per degree, 1 expected", ("nees", "per_degree")),
        ("path error, raw [m RMS]", ("ate", "raw")),
        ("path error, aligned [m RMS]", ("ate", "aligned")),
        ("map error, aligned [m RMS]", ("landmark_rmse", "aligned")),
        ("bearing innovations white, p", ("whiteness", "bearing", "p")),
        ("range innovations white, p", ("whiteness", "range", "p")),
    ):
        values = [_at(run, path) for run in runs.values()]
        if any(value is not None for value in values):
            table.add_row(name, *map(_figure, values))
    return table


def advice(summary: dict[str, Any]) -> Table:
    """Describe the suggested inflation of the sensor noise, and its reason."""
    factors = summary["inflation"]
    inflated = [
        f"{sigma} × {factors[name]:.3g}"
        for sigma, name in (("σβ", "bearing"), ("σr", "range"))
        if factors[name] > 1
    ]
    text = "none needed"
    if inflated:
        text = f"{', '.join(inflated)}: the errors of readings are correlated in time"
    rows = [("inflation", text)]
    if summary["calibration"] is not None:
        factor, low, high = (
            f"{summary['calibration'][key]:.3g}" for key in ("factor", "low", "high")
        )
        text = f"× {factor} ({low} … {high}) of the most likely σβ and σr"
        rows.append(("by the truth", f"{text} would make the pose NEES 1 per degree"))
    return named_rows(rows)


def _interval(row: dict[str, Any]) -> str:
    if row["verdict"] == "unknown" or row["high"] is None:
        return "-"
    return f"{significant(row['low'])} … {significant(row['high'])}"


def _noise_by_name(settings: dict[str, Any]) -> dict[str, float]:
    sigmas = ("σx", "σy", "σα", "σβ", "σr")
    noise = dict(
        zip(sigmas, settings["motion_std"] + settings["measurement_std"], strict=True)
    )
    options = settings["options"]
    noise["σr per metre"] = options.get("range_std_per_metre", 0.0)
    noise["σβ in metres"] = options.get("bearing_std_metres", 0.0)
    return noise


def _at(run: dict[str, Any], path: tuple[str, ...]) -> Any:
    value: Any = run
    for key in path:
        value = None if value is None else value[key]
    return value


def _figure(value: float | None) -> str:
    if value is None:
        return "-"
    return str(value) if isinstance(value, int) else f"{value:.4g}"
