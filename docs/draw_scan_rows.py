"""Draw the arrays of one scan, coloured by the function that writes each part.

``python docs/draw_scan_rows.py`` writes docs/images/scan_rows.png from the layout in
``estimator/kernels/scan_update.py``.
"""

from pathlib import Path
from typing import NamedTuple

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch, Rectangle

from slamgym.estimator.kernels import scan_update as layout

PICTURE = Path(__file__).parent / "images" / "scan_rows.png"

COLOURS = {
    "nothing": "white",
    "caller": "#d9d9d9",
    "screen": "#fdd49e",
    "linearise": "#a6cee3",
    "absorb": "#b2df8a",
    "retract, transport": "#cab2d6",
    "correct": "#fb9a99",
}
STATE = 14  # columns drawn for the state
READINGS = 3


class Part(NamedTuple):
    """One rectangle of an array."""

    row: float
    column: float
    height: float
    width: float
    text: str
    writer: str


def state_rows() -> list[Part]:
    """Return the vectors over the whole state."""
    rows = (
        (layout.CORRECTION, "CORRECTION   δ", "absorb"),
        (layout.TRANSPORT, "TRANSPORT   v", "retract, transport"),
        (layout.ITERATE, "ITERATE", "correct"),
        (layout.HEADING, "HEADING   P[:, θ]", "retract, transport"),
        (layout.MEAN_BEFORE, "MEAN_BEFORE", "correct"),
    )
    return [Part(row, 0, 1, STATE, text, writer) for row, text, writer in rows]


def system_rows() -> list[Part]:
    """Return the two rows of each reading: A, then the columns counted from the end."""
    end = STATE + layout.META_WIDTH
    columns = (
        (-layout.META_WIDTH, 5, "padding", "nothing"),
        (layout.JACOBIAN, 5, "JACOBIAN\nH: x y θ lx ly", "linearise"),
        (layout.ROOT, 2, "ROOT\nL", "absorb"),
        (layout.WHITE, 1, "w", "absorb"),
        (layout.INNOVATION, 1, "ν", "linearise"),
        (layout.VARIANCE, 1, "Q", "screen"),
        (layout.READING, 1, "z", "screen"),
    )
    parts = []
    for k in range(READINGS):
        row = layout.FIRST + 2 * k
        text = f"reading {k}:   two rows of A = L⁻¹ H P"
        parts.append(Part(row, 0, 2, STATE, text, "absorb"))
        parts += [
            Part(row, end + column, 2, width, text, writer)
            for column, width, text, writer in columns
        ]
    return parts


def ledger_rows() -> list[Part]:
    """Return the rows of the ledger, one column a reading."""
    rows = (
        (layout.SLOT, "SLOT", "caller"),
        (layout.OUTCOME, "OUTCOME", "screen"),
        (layout.NEAR, "NEAR", "screen"),
        (layout.COLUMN, "COLUMN", "screen"),
        (layout.ORDER, "ORDER", "correct"),
    )
    return [Part(row, 0, 1, 5, text, writer) for row, text, writer in rows]


def draw(axes: Axes, parts: list[Part], title: str) -> None:
    """Draw the parts of one array, its first row at the top."""
    for part in parts:
        corner = (part.column, part.row)
        colour = COLOURS[part.writer]
        axes.add_patch(
            Rectangle(corner, part.width, part.height, fc=colour, ec="black", lw=0.6)
        )
        x, y = part.column + part.width / 2, part.row + part.height / 2
        axes.text(x, y, part.text, ha="center", va="center", fontsize=8)
    axes.set_xlim(-0.1, max(part.column + part.width for part in parts) + 0.1)
    axes.set_ylim(max(part.row + part.height for part in parts) + 0.1, -0.1)
    axes.set_title(title, fontsize=10, loc="left")
    axes.axis("off")


def picture() -> Figure:
    """Draw the rows of the workspace beside the ledger."""
    figure = Figure(figsize=(13, 5.2), layout="constrained")
    rows, ledger = figure.subplots(1, 2, width_ratios=(6, 1))
    state = "columns of the state: x y θ l1x l1y …"
    meta = f"META_WIDTH = {layout.META_WIDTH} columns, counted from the end"
    draw(rows, state_rows() + system_rows(), f"rows      {state}      |      {meta}")
    rows.text(-0.4, layout.FIRST, "FIRST", ha="right", va="center", fontsize=8)
    draw(ledger, ledger_rows(), "ledger")
    ledger.set_ylim(layout.FIRST + 2 * READINGS + 0.1, -0.1)
    handles = [Patch(fc=c, ec="black", label=name) for name, c in COLOURS.items()]
    figure.legend(
        handles=handles, loc="outside lower center", ncols=7, title="written by"
    )
    return figure


if __name__ == "__main__":
    picture().savefig(PICTURE, dpi=100)
