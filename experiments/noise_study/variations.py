"""The variations of a noise study: each noise times 10 and divided by 10, in turn."""

from typing import NamedTuple

from ...sim_configs import Scenario
from ..runs.filter_settings import SIGMAS, FilterSettings

FACTORS = (10.0, 0.1)


class Variation(NamedTuple):
    """One noise and its factor."""

    sigma: str
    """One of `SIGMAS`; "none" for the reference."""
    factor: float
    """1 for the reference."""

    def __str__(self) -> str:
        """Return for example "σx × 10"."""
        if self.sigma == "none":
            return "unchanged"
        return f"{self.sigma} {'× 10' if self.factor > 1 else '÷ 10'}"


REFERENCE = Variation("none", 1.0)
CHANGES = tuple(Variation(sigma, factor) for sigma in SIGMAS for factor in FACTORS)


def scaled_scenario(scenario: Scenario, sigma: str, factor: float) -> Scenario:
    """Multiply one of `SIGMAS` of a world by a factor.

    Examples
    --------
    >>> from slamgym.sim_configs import load_scenario
    >>> scaled_scenario(load_scenario("six_landmarks"), "σβ", 10).sensor.std
    (0.1, 0.08)
    """
    settings = FilterSettings("", scenario.motion.std, scenario.sensor.std)
    scaled = settings.scaled(sigma, factor)
    return scenario.with_changes(
        motion={"std": scaled.motion_std}, sensor={"std": scaled.measurement_std}
    )
