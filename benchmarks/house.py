"""Count the modules and lines of code that each use loads, and those of the leaves.

    python benchmarks/house.py

Lines are counted without blank lines, comments and docstrings.
"""

import ast
import io
import subprocess
import sys
import tokenize
from pathlib import Path

from rich import print as show
from rich.table import Table

import slamgym
from slamgym.leaves import LEAVES

PACKAGE = Path(slamgym.__file__).parent
NOISE = "motion_std=(.1, .1, .1), measurement_std=(.1, .1)"
USES = {
    "EkfSlam": "from slamgym import EkfSlam",
    'make_estimator("invariant")': (
        f"from slamgym import make_estimator; make_estimator('invariant', {NOISE})"
    ),
    "a world": (
        "import gymnasium; world = gymnasium.make('slamgym:slamgym/LandmarkWorld-v0'); "
        "world.reset(seed=0); world.step([1, 0])"
    ),
    "monte_carlo": (
        "from slamgym import consistency_of, monte_carlo; "
        "monte_carlo('six_landmarks', 'ekf', runs=2)"
    ),
}
LIST = """
import sys
for name, module in [*sys.modules.items()]:
    if name.partition(".")[0] == "slamgym" and getattr(module, "__file__", None):
        print(module.__file__)
"""
NO_CODE = (
    *(tokenize.COMMENT, tokenize.NL, tokenize.NEWLINE),
    *(tokenize.INDENT, tokenize.DEDENT, tokenize.ENDMARKER),
)


def lines_of(file: Path) -> int:
    """Count the lines of code of a module."""
    text = file.read_text()
    texts = {
        line
        for node in ast.walk(ast.parse(text))
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)
        for line in range(node.lineno, (node.end_lineno or node.lineno) + 1)
    }
    tokens = tokenize.generate_tokens(io.StringIO(text).readline)
    code = [token for token in tokens if token.type not in NO_CODE]
    lines = {n for token in code for n in range(token.start[0], token.end[0] + 1)}
    return len(lines - texts)


def files_loaded(statement: str) -> list[Path]:
    """Return the modules of the package that a new process loads for a statement."""
    command = [sys.executable, "-c", statement + LIST]
    done = subprocess.run(command, check=True, capture_output=True, text=True)
    return [Path(name) for name in done.stdout.split("\n") if name.endswith(".py")]


def files_of(places: tuple[str, ...]) -> list[Path]:
    """Return the modules of a leaf."""
    paths = [PACKAGE.joinpath(*place.split(".")) for place in places]
    inside = [file for path in paths for file in path.rglob("*.py")]
    modules = [path.with_suffix(".py") for path in paths]
    return [file for file in modules if file.is_file()] + inside


def main() -> None:
    """Print both tables."""
    loaded, leaves = (
        Table("use", "modules", "lines", title="What a use loads"),
        Table("leaf", "modules", "lines", title="Leaves: not needed by the core"),
    )
    counts = {name: files_loaded(statement) for name, statement in USES.items()}
    rooms = {name: files_of(places) for name, places in LEAVES.items()}
    rooms["all leaves"] = [file for files in rooms.values() for file in files]
    for table, found in ((loaded, counts), (leaves, rooms)):
        for name, files in found.items():
            table.add_row(name, str(len(files)), str(sum(map(lines_of, files))))
        show(table)


if __name__ == "__main__":
    main()
