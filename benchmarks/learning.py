"""PPO on five seeds: evaluation returns, policies and scores that one command repeats.

Run it::

    python benchmarks/learning.py            # about two minutes of CPU time a seed

It trains the PPO of ``examples/09_train_active_slam.py`` once per seed, skips what the
folder already holds, and writes into the folder (docs/learning, as committed):

* ``hyperparameters.json``: all settings, and the versions of the libraries;
* ``evaluations_0.csv``, one per seed: during training, the mean scores of the policy
  without noise on 30 validation maps;
* ``policy_0.npz``, one per seed: the layers of the policy, which `load_actor` reads;
* ``baselines.csv``: the scores of the baselines on the same maps;
* ``held_out.csv``: the episodes of all policies on the held-out maps.

``--figure FILE`` draws the curves. Stable-Baselines3 is needed for training only. One
thread trains, so equal versions on equal processors write equal files.
"""

import argparse
import csv
import json
import platform
import runpy
from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium.spaces import flatten
from matplotlib.figure import Figure
from numpy.typing import NDArray
from scipy import stats

from slamgym.agents import BASELINES, ActiveSlamEnv, make_baseline
from slamgym.agents.active_slam import Observation
from slamgym.agents.active_slam_scores import (
    HELD_OUT,
    VALIDATION,
    Episode,
    Policy,
    baseline_policy,
    mean_of,
    run_episodes,
)

ROOT = Path(__file__).parents[1]
EXAMPLE = ROOT / "examples" / "09_train_active_slam.py"
MEASURES = {
    "return": "total",
    "success": "success",
    "honest_success": "honest",
    "known": "known",
    "steps": "steps",
    "true_rmse": "true_rmse",
    "crashed": "crashed",
}
EVALUATIONS = 20
LINE_HEIGHT = 0.9  # of a name in the picture, in units of the return
VALIDATION_MAPS = 30
INK, BAND, PALE = "#222222", "#c9d7e8", "#999999"
Rows = list[dict[str, float | str]]


def save_actor(model: Any, path: Path) -> None:
    """Write the layers of a policy's mean action, and the limits of actions."""
    policy = model.policy
    linear = [*policy.mlp_extractor.policy_net, policy.action_net]
    arrays: dict[str, Any] = {}
    for k, layer in enumerate(each for each in linear if hasattr(each, "weight")):
        arrays[f"weight_{k}"] = layer.weight.detach().numpy()
        arrays[f"bias_{k}"] = layer.bias.detach().numpy()
    space = model.action_space
    np.savez_compressed(path, low=space.low, high=space.high, **arrays)


def load_actor(path: Path) -> Policy:
    """Read a policy that `save_actor` wrote; it acts without noise."""
    with np.load(path) as file:
        arrays = {name: file[name] for name in file.files}
    layers = [
        (arrays[f"weight_{k}"], arrays[f"bias_{k}"])
        for k in range(len(arrays) // 2 - 1)
    ]

    def act(observation: Observation, env: ActiveSlamEnv) -> NDArray[np.float64]:
        hidden = np.asarray(flatten(env.observation_space, observation), np.float32)
        for weight, bias in layers[:-1]:
            hidden = np.tanh(weight @ hidden + bias)
        weight, bias = layers[-1]
        action = np.clip(weight @ hidden + bias, arrays["low"], arrays["high"])
        return np.asarray(action, dtype=np.float64)

    return act


def scores_of(episodes: Sequence[Episode]) -> dict[str, float | str]:
    """Return the means over episodes, one per column."""
    return {
        title: round(mean_of(episodes, entry).value, 4)
        for title, entry in MEASURES.items()
    }


def train(given: argparse.Namespace, seed: int) -> None:
    """Train a policy, and evaluate it on validation maps while it learns."""
    make_learner = runpy.run_path(str(EXAMPLE))["make_learner"]
    model = make_learner(given.scenario, given.worlds, seed)
    env = ActiveSlamEnv(given.scenario)
    maps = range(VALIDATION, VALIDATION + given.validation_maps)
    trial = given.folder / f"policy_{seed}.part.npz"
    rows: Rows = []

    def evaluate() -> None:
        save_actor(model, trial)
        episodes = run_episodes(env, load_actor(trial), maps)
        rows.append({"training_steps": model.num_timesteps, **scores_of(episodes)})
        print(f"seed {seed}: {rows[-1]}", flush=True)

    def note(*_: Any) -> bool:
        due = len(rows) * given.steps / EVALUATIONS
        if len(rows) < EVALUATIONS and model.num_timesteps >= due:
            evaluate()
        return True

    model.learn(given.steps, callback=note)
    evaluate()
    write_rows(given.folder / f"evaluations_{seed}.csv", rows)
    trial.replace(given.folder / f"policy_{seed}.npz")


def hyperparameters(given: argparse.Namespace) -> dict[str, Any]:
    """Return everything that a training depends on."""
    example = runpy.run_path(str(EXAMPLE))
    packages = ("slamgym", "stable_baselines3", "torch", "numpy", "gymnasium")
    return {
        "scenario": given.scenario,
        "estimator": "invariant",
        "steps": given.steps,
        "worlds": given.worlds,
        "first_seed_of_training": f"{given.worlds} * seed",
        "validation_maps": given.validation_maps,
        "algorithm": "PPO of Stable-Baselines3, MlpPolicy, other settings its own",
        **example["SETTINGS"],
        "learning_rate": f"{example['LEARNING_RATE']} * (share of the steps left)",
        "versions": {
            "python": platform.python_version(),
            **{name: version(name) for name in packages},
        },
    }


def write_rows(path: Path, rows: Rows) -> None:
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, list(rows[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)


def read_rows(path: Path) -> list[dict[str, str]]:
    with path.open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def play_baselines(given: argparse.Namespace) -> None:
    """Play the validation maps that the evaluations use."""
    env = ActiveSlamEnv(given.scenario)
    maps = range(VALIDATION, VALIDATION + given.validation_maps)
    rows: Rows = []
    for name in BASELINES:
        baseline = make_baseline(name, env.scenario, np.random.default_rng(0))
        episodes = run_episodes(env, baseline_policy(baseline), maps)
        rows.append({"baseline": name, **scores_of(episodes)})
    write_rows(given.folder / "baselines.csv", rows)


def play_held_out(given: argparse.Namespace) -> None:
    """Play the held-out maps with every policy."""
    env = ActiveSlamEnv(given.scenario)
    rows: Rows = []
    for seed in given.seeds:
        policy = load_actor(given.folder / f"policy_{seed}.npz")
        for number in range(HELD_OUT, HELD_OUT + given.maps):
            episode = run_episodes(env, policy, [number])
            rows.append({"seed": seed, "map": number, **scores_of(episode)})
    write_rows(given.folder / "held_out.csv", rows)


def mean_over_seeds(values: NDArray[np.float64]) -> tuple[Any, Any]:
    """Return mean and half width of the 95 % Student interval over the first axis."""
    count = len(values)
    spread = values.std(axis=0, ddof=1) / np.sqrt(count)
    return values.mean(axis=0), stats.t.ppf(0.975, count - 1) * spread


def print_scores(given: argparse.Namespace) -> None:
    """Print the means of every policy, and their mean with the interval over seeds."""
    rows = read_rows(given.folder / "held_out.csv")
    table = [
        [
            np.nanmean([float(row[title]) for row in rows if row["seed"] == str(seed)])
            for title in MEASURES
        ]
        for seed in given.seeds
    ]
    print("".join(f"{title:>16}" for title in ("seed", *MEASURES)))
    for seed, means in zip(given.seeds, table, strict=True):
        print(f"{seed:16}" + "".join(f"{mean:16.2f}" for mean in means))
    if len(given.seeds) > 1:
        pairs = zip(*mean_over_seeds(np.array(table)), strict=True)
        cells = [f"{mean:.2f} ± {half:.2f}" for mean, half in pairs]
        print(f"{'mean':>16}" + "".join(f"{cell:>16}" for cell in cells))


def draw(given: argparse.Namespace) -> Figure:
    """Draw the returns of all seeds, their mean and its interval, and the baselines."""
    curves = [
        read_rows(given.folder / f"evaluations_{seed}.csv") for seed in given.seeds
    ]
    steps = np.array([float(row["training_steps"]) for row in curves[0]]) / 1e6
    returns = np.array([[float(row["return"]) for row in curve] for curve in curves])
    figure = Figure((7, 4), layout="constrained")
    axes = figure.add_subplot()
    for values in returns:
        axes.plot(steps, values, color=INK, linewidth=0.5, alpha=0.5)
    if len(curves) > 1:
        mean, half = mean_over_seeds(returns)
        axes.fill_between(steps, mean - half, mean + half, color=BAND, linewidth=0)
        axes.plot(steps, mean, color=INK, linewidth=2)
    baselines = read_rows(given.folder / "baselines.csv")
    lowest = -np.inf  # lines can be close: their names stand apart
    for row in sorted(baselines, key=lambda each: float(each["return"])):
        value = float(row["return"])
        lowest = max(value, lowest + LINE_HEIGHT)
        axes.axhline(value, color=PALE, linestyle="--", linewidth=1, zorder=0)
        axes.annotate(
            row["baseline"],
            (1.0, value),
            (1.03, lowest),
            xycoords=("axes fraction", "data"),
            arrowprops={"arrowstyle": "-", "color": PALE, "linewidth": 0.7},
            color=INK,
            va="center",
        )
    axes.set(xlabel="million steps of training", ylabel="return on validation maps")
    axes.spines[["top", "right"]].set_visible(False)
    return figure


def arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description=__doc__.splitlines()[0],
        formatter_class=argparse.ArgumentDefaultsHelpFormatter,
    )
    add = parser.add_argument
    add("--folder", type=Path, default=ROOT / "docs" / "learning", help="of the files")
    add("--seeds", type=int, nargs="+", default=[0, 1, 2, 3, 4], help="one policy each")
    add("--scenario", default="active_medium", help="a preset or .toml file with walls")
    add("--steps", type=int, default=500_000, help="of training, in all worlds")
    add("--worlds", type=int, default=64, help="side by side, a multiple of 16")
    add("--maps", type=int, default=100, help="held out, to judge by in the end")
    add("--validation-maps", type=int, default=VALIDATION_MAPS, help="for the curves")
    add("--train-only", action="store_true", help="train, and neither play nor judge")
    add("--figure", type=Path, help="draw the curves into this file")
    return parser.parse_args()


def main() -> None:
    given = arguments()
    given.folder.mkdir(parents=True, exist_ok=True)
    for seed in given.seeds:
        if not (given.folder / f"policy_{seed}.npz").exists():
            settings = json.dumps(hyperparameters(given), indent=2) + "\n"
            (given.folder / "hyperparameters.json").write_text(settings)
            train(given, seed)
    if given.train_only:
        return
    if not (given.folder / "baselines.csv").exists():
        play_baselines(given)
    if not (given.folder / "held_out.csv").exists():
        play_held_out(given)
    print_scores(given)
    if given.figure is not None:
        draw(given).savefig(given.figure, dpi=120)


if __name__ == "__main__":
    main()
