"""Many runs of a scenario, and whether the filters told the truth.

scenario → simulated runs → filtered runs → run measures → result blocks → results
→ scores → summary, table, plots, html report
"""

from .report.summary import consistency_of, summarise_monte_carlo
from .runner import monte_carlo
from .store.result_blocks import merge_blocks
from .store.results import load_results

__all__ = [
    "consistency_of",
    "load_results",
    "merge_blocks",
    "monte_carlo",
    "summarise_monte_carlo",
]
