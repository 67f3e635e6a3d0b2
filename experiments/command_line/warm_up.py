"""Compile a filter by its first steps."""

from dataclasses import replace

from ..runs.filter_settings import FilterSettings
from .reporter import Reporter


def warm_up(settings: FilterSettings, reporter: Reporter) -> None:
    """Take a filter's first steps, and print a note if it compiles.

    Raises
    ------
    ValueError
        If the estimator refuses its settings.
    """
    origin = (0.0, 0.0, 0.0)
    settings.make(origin)
    usual = replace(settings, motion_std=(0.1,) * 3, measurement_std=(0.1,) * 2)
    with reporter.note_if_compiling("the filter"):
        estimator = usual.make(origin)
        try:
            for _ in range(2):
                estimator.predict((0.1, 0.0))
                estimator.update([(0.0, 5.0)], [0])
            if settings.options.get("management"):
                estimator.update([(0.0, 5.0)])
        finally:
            estimator.reset(origin, (0.0, 0.0, 0.0))  # deletes the files it wrote
