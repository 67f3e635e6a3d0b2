"""Fit the noise of simulated logs: how often the intervals contain the true noise."""

import argparse
import time
from collections import Counter, defaultdict

import numpy as np

from slamgym.envs.controllers import OpenLoop
from slamgym.experiments.logs import SlamLog, record_episode
from slamgym.experiments.noise_fitting import NoiseFit, fit_noise
from slamgym.experiments.run_and_replay import settings_for
from slamgym.sim_configs import action_sequence, load_scenario

WORLDS = ("loop", "corridor", "dense")
START = (0.1, 0.1, 0.03), (0.05, 0.3)  # where each search begins, the truth unknown


def simulated(world: str, seed: int) -> SlamLog:
    """Return a log of a world."""
    scenario = load_scenario(world)
    driver = OpenLoop(action_sequence(scenario), scenario.robot)
    return record_episode(scenario, driver, seed)


def fit(log: SlamLog, estimator: str = "invariant") -> NoiseFit:
    """Fit the noise of a log, starting far from it."""
    motion, sensor = START
    settings = settings_for(
        log, estimator=estimator, motion_std=motion, measurement_std=sensor
    )
    return fit_noise(log, settings)


def truth_of(log: SlamLog) -> dict[str, float]:
    """Return the true noise of a simulated log, by name."""
    known = settings_for(log)
    values = (*known.motion_std, *known.measurement_std)
    names = ("σx", "σy", "σα", "σβ", "σr")
    more = {"σr per metre": "range_std_per_metre", "σβ in metres": "bearing_std_metres"}
    growing = {name: known.options.get(key, 0.0) for name, key in more.items()}
    return dict(zip(names, values, strict=True)) | growing


def coverage(world: str, runs: int, seed: int) -> None:
    """Print how often the intervals of a world's logs contain its noise."""
    held: Counter[str] = Counter()
    errors: dict[str, list[float]] = defaultdict(list)
    verdicts: dict[str, Counter[str]] = defaultdict(Counter)
    inflated, started = 0, time.process_time()
    for run in range(runs):
        log = simulated(world, seed + run)
        result, truth = fit(log), truth_of(log)
        for noise in result.noise:
            true = truth[noise.name]
            is_given_up = noise.verdict == "zero" and noise.value == 0
            inside = noise.low <= true <= noise.high or (is_given_up and true == 0)
            held[noise.name] += inside
            verdicts[noise.name][noise.verdict] += 1
            if true:
                errors[noise.name].append(noise.value / true)
        fitted = {noise.name for noise in result.noise}
        held.update(name for name in truth.keys() - fitted if not truth[name])
        inflated += result.suggested.settings != result.fitted.settings
    seconds = (time.process_time() - started) / runs
    for name, true in truth.items():
        ratio = np.array(errors[name] or [np.nan])
        print(
            f"| {world} | {name} | {true:g} | {ratio.mean():.3f} ± {ratio.std():.3f} "
            f"| {held[name] / runs:.0%} | {dict(verdicts[name])} |",
            flush=True,
        )
    print(f"{world}: inflated {inflated} of {runs}; {seconds:.2f} s of CPU a log")


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=100)
    parser.add_argument("--seed", type=int, default=700_000)
    parser.add_argument("--worlds", nargs="*", default=WORLDS)
    arguments = parser.parse_args()
    print("| world | noise | true | fitted / true | in interval | verdicts |")
    print("|---|---|---|---|---|---|")
    for world in arguments.worlds:
        coverage(world, arguments.runs, arguments.seed)


if __name__ == "__main__":
    main()
