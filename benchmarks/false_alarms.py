"""How often decisions reject a filter that is exactly consistent; nominal 5 %.

    python benchmarks/false_alarms.py          # tests with 50 runs
    python benchmarks/false_alarms.py looks    # tests at every look up to 400 runs
    python benchmarks/false_alarms.py filters  # 60 verdicts on filters of slamgym

Two linear Kalman filters, 50 runs. One forgets its errors within a few steps. The other
estimates three constants and never forgets. All figures are shares of 2000 repetitions,
with a statistical error of half a percentage point.

With ``looks``, the same filters are watched after every run. Each has a map of up to
six landmarks, whose errors contain the final error of the first two numbers. A ratio
multiplies the squared errors of pose or map. "extended" is a study whose verdict is
read after 50, 100, 200, 400 runs. A second table shows how many runs real filters need.

With ``filters``, each study has 100 runs. All filters run in four worlds whose noise
is reduced to 10 % or 30 %, so that every filter is nearly linear. The invariant filter
also runs in three worlds with all their noise. A number after ``looks`` or ``filters``
changes the seeds.
"""

import sys
from collections import Counter
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slamgym import load_scenario, monte_carlo
from slamgym.evaluation import evaluate_consistency
from slamgym.evaluation.hypothesis_tests import (
    average_band,
    bootstrap_test,
    family_test,
    final_step_test,
    nis_test,
    time_average_test,
    whiteness_test,
)
from slamgym.experiments import summarise_monte_carlo
from slamgym.experiments.monte_carlo_study.looks import Look, Watch, error_rate_after
from slamgym.experiments.monte_carlo_study.runner import with_less_noise
from slamgym.sim_configs import Scenario

Array = NDArray[np.float64]
Accepts = Callable[[Array, Array], bool]
REPETITIONS, RUNS, STEPS, DOF = 2000, 50, 60, 3
GRID = np.arange(STEPS // 10, STEPS + 1, STEPS // 10) - 1
ONES = np.ones((RUNS, STEPS), dtype=np.int64)
BAND = average_band(RUNS, DOF)


def scores(
    rng: np.random.Generator, noise: float, shape: tuple[int, int] = (REPETITIONS, RUNS)
) -> tuple[Array, Array, Array]:
    """NEES and NIS of three random walks, read in turn: (repetitions, runs, STEPS).

    Also return their final errors in standard deviations, shape (repetitions, runs, 3).
    """
    runs = shape[0] * shape[1]
    variance = np.ones(3)
    error = rng.standard_normal((runs, 3))
    nees, nis = np.empty((runs, STEPS)), np.empty((runs, STEPS))
    for step in range(STEPS):
        read = step % 3
        error += np.sqrt(noise) * rng.standard_normal((runs, 3))
        variance += noise
        total = variance[read] + 1.0
        innovation = error[:, read] + rng.standard_normal(runs)
        nis[:, step] = innovation**2 / total
        error[:, read] -= variance[read] / total * innovation
        variance[read] /= total
        nees[:, step] = (error**2 / variance).sum(axis=1)
    last = (error / np.sqrt(variance)).reshape(*shape, 3)
    return nees.reshape(*shape, STEPS), nis.reshape(*shape, STEPS), last


def inside(nees: Array) -> float:
    averages = nees.mean(axis=0)
    return float(np.mean((averages >= BAND.low) & (averages <= BAND.high)))


def bootstrap(nees: Array, _: Array) -> bool:
    averages, rng = nees.mean(axis=1), np.random.default_rng(0)
    return bootstrap_test(averages, DOF, rng=rng, resamples=399).accepted


DECISIONS: dict[str, Accepts] = {
    "final step, χ²": lambda x, _: final_step_test(x[:, -1], DOF).accepted,
    "time averages, t": lambda x, _: time_average_test(x.mean(axis=1), DOF).accepted,
    "time averages, bootstrap": bootstrap,
    "grid of 10 steps, Holm": lambda x, _: family_test(x[:, GRID], DOF).accepted,
    "NIS pooled, χ²": lambda _, y: nis_test(y, ONES).accepted,
    "NIS whiteness, Ljung-Box": lambda _, y: whiteness_test(y, ONES).accepted,
    "not offered: NEES pooled over time": lambda x, _: (
        final_step_test(x.ravel(), DOF).accepted
    ),
    "not offered: 95 % of steps inside the band": lambda x, _: inside(x) >= 0.95,
    "not offered: all steps inside the band": lambda x, _: inside(x) == 1.0,
}


def main() -> None:
    rng = np.random.default_rng(1)
    worlds = {"forgets": scores(rng, 1.0), "never forgets": scores(rng, 0.0)}
    print("| decision | " + " | ".join(worlds) + " |")
    print("|---|" + "---|" * len(worlds))
    for name, accepts in DECISIONS.items():
        rates = [
            1 - np.mean([accepts(x, y) for x, y in zip(nees, nis, strict=True)])
            for nees, nis, _ in worlds.values()
        ]
        print(f"| {name} | " + " | ".join(f"{rate:.1%}" for rate in rates) + " |")


MOST, LOOKS, CHUNK, FEW = 400, (50, 100, 200, 400), 50, 200
LANDMARKS, UNSEEN = 6, 0.2
#: Ratios of pose and map; the first three in all repetitions, others in `FEW`.
CASES = {
    "honest": (1.0, 1.0),
    "pose 1.25": (1.25, 1.0),
    "map 1.25": (1.0, 1.25),
    "pose 0.8": (0.8, 1.0),
    "map 0.8": (1.0, 0.8),
    "pose 0.5": (0.5, 1.0),
    "pose 1.5": (1.5, 1.0),
    "pose 2": (2.0, 1.0),
    "map 0.5": (1.0, 0.5),
    "map 1.5": (1.0, 1.5),
    "map 2": (1.0, 2.0),
}


def maps_from(rng: np.random.Generator, last: Array) -> dict[str, Array]:
    """Honest maps of runs with these final errors, shape (runs, 3).

    The errors of all landmarks contain those of the position, so their covariance is
    I + 11ᵀ. Each run lacks some landmarks.
    """
    own = rng.standard_normal((len(last), LANDMARKS, 2))
    own[rng.random(own.shape[:2]) < UNSEEN] = np.nan
    number = np.isfinite(own[:, :, 0]).sum(axis=1)
    errors = own + last[:, None, :2]
    common = (np.nansum(errors, axis=1) ** 2).sum(axis=1) / (1 + number)
    return {
        "landmarks": errors / np.sqrt(2),
        "map_nees": np.nansum(errors**2, axis=(1, 2)) - common,
        "map_dof": 2 * number,
        "landmark_nees": (own**2).sum(axis=2),
    }


def watched(nees: Array, maps: dict[str, Array], of_map: float = 1.0) -> Watch:
    """Look after every run at NEES of shape (runs, STEPS), and at maps with a ratio."""
    watch, good = Watch(), np.ones(len(nees), dtype=np.bool_)
    factors = np.sqrt(of_map), of_map, 1, of_map
    scaled = {k: f * maps[k] for k, f in zip(maps, factors, strict=True)}
    watch.update(np.insert(nees, 0, np.nan, axis=1), good, 1, **scaled)
    return watch


def p_value(nees: Array, nis: Array, maps: dict[str, Array], runs: int) -> float:
    """p-value of a verdict on a number of runs that was chosen beforehand."""
    scans = nis[:runs], ONES[:1].repeat(runs, axis=0)
    options: Any = {name: values[:runs] for name, values in maps.items()}
    options |= {"frame": "invariant", "rng": np.random.default_rng(0)}
    return evaluate_consistency(nees[:runs], *scans, **options).p_value


def looks(seed: int) -> None:
    rng = np.random.default_rng(seed)
    columns = [column(rng, noise) for noise in (1.0, 0.0)]
    print("| | forgets | never forgets |\n|---|---|---|")
    for name in columns[0]:
        print(f"| {name} | " + " | ".join(each[name] for each in columns) + " |")
    print(
        "\n| filter | studies | decision | runs, median | 90 % |\n|---|---|---|---|---|"
    )
    runs_needed("loop", "ekf", 32, 40, seed)
    runs_needed("six_landmarks", "invariant", 240, 40, seed)


def column(rng: np.random.Generator, noise: float) -> dict[str, str]:
    watches: dict[str, list[Watch]] = {case: [] for case in CASES}
    first: list[bool] = []
    later: list[bool] = []
    plain: list[bool] = []
    for _ in range(REPETITIONS // CHUNK):
        for nees, nis, last in zip(*scores(rng, noise, (CHUNK, MOST)), strict=True):
            maps, many = maps_from(rng, last), len(first) >= FEW
            for case in list(CASES)[: 3 if many else None]:
                of_pose, of_map = CASES[case]
                watches[case].append(watched(of_pose * nees, maps, of_map))
            verdicts = [
                p_value(nees, nis, maps, runs) for runs in LOOKS[: 1 if many else None]
            ]
            first.append(verdicts[0] < 0.05)
            left = -np.log(error_rate_after([Look(0, LOOKS[0], "")]))
            rejected = watches["honest"][-1].log_evidence >= left
            later.append(verdicts[0] < 0.04 or rejected)
            if len(plain) < FEW:
                plain.append(min(verdicts) < 0.05)
    cells = {
        f"{case}: {key}": cell for case in CASES for key, cell in decided(watches[case])
    }
    for name, rejections in {
        "first verdict, 50 runs": first,
        "extended to 400 runs": later,
        "extended, each verdict as if it was the first": plain,
    }.items():
        cells[f"honest: rejected, {name}"] = f"{np.mean(rejections):.1%}"
    return cells


def decided(watches: list[Watch]) -> list[tuple[str, str]]:
    rejected = np.array([watch.rejected_after or np.inf for watch in watches])
    shown = np.array([watch.shown_after or np.inf for watch in watches])
    accepted = np.where(shown < rejected, shown, np.inf)
    found = []
    for what, after in ("rejected", rejected), ("accepted", accepted):
        cell = f"{np.isfinite(after).mean():.1%}"
        median, high = np.quantile(after, [0.5, 0.9], method="higher")
        if np.isfinite(high):
            cell += f", after {median:.0f} (90 %: {high:.0f})"
        found.append((what, cell))
    return found


def runs_needed(world: str, name: str, most: int, studies: int, seed: int) -> None:
    results = monte_carlo(world, name, runs=most * studies, seed=10**6 * seed)
    found = []
    for start in range(0, most * studies, most):
        study, watch = (
            results.isel(estimator=0, run=slice(start, start + most)),
            Watch(),
        )
        watch.add_block({str(name): each.values for name, each in study.items()})
        found.append(watch)
    rejected = [watch.rejected_after for watch in found if watch.rejected_after]
    shown = [watch.shown_after for watch in found if not watch.rejected_after]
    for what, after in ("rejected", rejected), ("consistent", [n for n in shown if n]):
        if after:
            median, high = np.quantile(after, [0.5, 0.9])
            print(
                f"| {name} in {world} | {len(after)} of {studies} | {what} "
                f"| {median:.0f} | {high:.0f} |"
            )


FILTERS = (
    "ekf",
    "iterated",
    "invariant",
    "invariant[iterations=1]",
    "invariant[management={}]",
    "first_estimates",
    "observability_constrained",
    "unscented",
    "robocentric",
    "compressed",
    "sparse_information",
    "submaps",
)


def honest_studies() -> Iterator[tuple[str, str, Scenario]]:
    """Yield filters that are consistent by design, with names and worlds."""
    worlds = {
        "six_landmarks, noise × .1": ("six_landmarks", 29, 0.1),
        "anchored, noise × .3": ("anchored", 29, 0.3),
        "loop, 100 steps, noise × .3": ("loop", 100, 0.3),
        "corridor, 70 steps, noise × .3": ("corridor", 70, 0.3),
    }
    for name, (preset, steps, factor) in worlds.items():
        small = with_less_noise(load_scenario(preset).with_changes(steps=steps), factor)
        yield from ((label, name, small) for label in FILTERS)
    for preset, steps in ("anchored", 29), ("loop", 250), ("corridor", 100):
        world = load_scenario(preset).with_changes(steps=steps)
        yield from [("invariant", f"{preset}, {steps} steps", world)] * 4


def filters(seed: int) -> None:
    print("| filter | world | NEES / 3 | of the map | verdict | cause |")
    print("|---|---|---|---|---|---|")
    words: Counter[str] = Counter()
    by_map = 0
    for number, (label, name, world) in enumerate(honest_studies()):
        results = monte_carlo(world, label, 100, 10**7 * seed + 100 * number)
        (entry,) = summarise_monte_carlo(results)["estimators"].values()
        word, maps = entry["verdict"], entry["decisions"]["map"]
        words[word] += 1
        by_map += word == "not consistent" and not maps["accepted"]
        nees, cause = entry["pose_nees"]["invariant"]["mean"], entry["diagnosis"]
        ratios = f"{nees:.3f} | {maps['statistic']:.3f}"
        print(
            f"| `{label}` | {name} | {ratios} | {word} | {cause['cause']} |", flush=True
        )
    found = ", ".join(f"{word} {count}" for word, count in words.most_common())
    print(f"\n{words.total()} studies: {found}; rejected because of the map: {by_map}")


if __name__ == "__main__":
    if sys.argv[1:2] == ["looks"]:
        looks(int((sys.argv[2:] or ["4"])[0]))
    elif sys.argv[1:2] == ["filters"]:
        filters(int((sys.argv[2:] or ["1"])[0]))
    else:
        main()
