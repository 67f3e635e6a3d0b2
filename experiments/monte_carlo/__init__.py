"""Many runs of a scenario, and whether the filters told the truth.

scenario → simulated runs → filtered runs → run measures → result blocks → results
→ scores → summary, table, plots, html report
"""

from .result_blocks import merge_blocks
from .results import load_results
from .runner import monte_carlo
from .summary import consistency_of, summarise_monte_carlo

__all__ = [
    "consistency_of",
    "load_results",
    "merge_blocks",
    "monte_carlo",
    "summarise_monte_carlo",
]
