"""Options of a data set that depend on its format or its scenario."""

from ...envs.spaces import count_rows
from ...sim_configs import Scenario
from .formats import TrajectoryFormat

_MOST_EPISODES = 100
_MOST_MEMORY = 256e6  # [bytes] of a shard


def checked_smallest_std(
    format: str, layout: TrajectoryFormat, given: float | None
) -> float | None:
    """Return the smallest standard deviation that a format writes, if it has one."""
    usual = layout.OPTIONS.get("smallest_std")
    if given is None:
        return usual
    if usual is None:
        raise ValueError(
            f"smallest_std is of the format 'g2o': format '{format}' writes no noise"
        )
    if not 0 < given < float("inf"):
        raise ValueError(f"smallest_std must be a finite number > 0, got {given!r}")
    return float(given)


def check_estimator(
    world: Scenario, format: str, layout: TrajectoryFormat, estimator: str | None
) -> None:
    """Refuse a filter that cannot be, and a format that does not hold beliefs."""
    if estimator is None:
        return
    if not isinstance(estimator, str):
        raise TypeError(f"estimator must be the name of a filter, got {estimator!r}")
    if not layout.HOLDS_BELIEFS:
        raise ValueError(
            f"estimator must be None for format '{format}', which holds no beliefs "
            f"(npz, parquet and minari do), got {estimator!r}"
        )
    from .beliefs import belief_settings  # noqa: PLC0415 (loads the filters)

    belief_settings(world, estimator).make((0.0, 0.0, 0.0))


def default_episodes_per_shard(scenario: Scenario, *, beliefs: bool = False) -> int:
    """Return how many episodes of a scenario a shard holds by default.

    Examples
    --------
    >>> from slamgym.sim_configs import load_scenario
    >>> default_episodes_per_shard(load_scenario("loop"))
    100
    """
    row = 25 * count_rows(scenario) + 57  # bytes of one moment
    if beliefs:
        row += 56 * count_rows(scenario) + 96
    return int(max(1, min(_MOST_EPISODES, _MOST_MEMORY // (row * scenario.steps))))
