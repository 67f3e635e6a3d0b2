"""Logs of simulated drives."""

from slamgym.envs.controllers import OpenLoop
from slamgym.experiments.logs.recording import record_episode
from slamgym.sim_configs import load_scenario


def recorded(scenario, seed=3, **changes):
    """Record the drive of a scenario's own controls, with some settings changed."""
    world = load_scenario(scenario).with_changes(**changes)
    return record_episode(world, OpenLoop.for_scenario(world), seed)
