"""Run filters many times over a scenario, and test their consistency.

scenario → simulated runs → filtered runs → run measures → result blocks → results
→ scores → summary, table, plots, html report
"""

from lazy_loader import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
