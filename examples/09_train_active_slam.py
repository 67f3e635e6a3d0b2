"""Train an agent to explore: PPO on ``slamgym/ActiveSlam-v0``, with the baselines.

The agent observes only the belief of a filter. It learns to find all landmarks, to
return to known places before it is lost, and to avoid walls. 64 worlds, each with its
filter, run side by side in one process. The example needs Stable-Baselines3::

    pip install torch==2.13.0 stable-baselines3

Run it::

    python examples/09_train_active_slam.py      # about seven minutes of CPU time
    python examples/09_train_active_slam.py --steps 100000 --maps 10    # a short trial

It writes into ``results/09_train_active_slam``: ``policy.zip``, which the example then
loads and evaluates; ``learning_curve.csv`` and ``.png``; ``scores.txt``, the scores of
policy and baselines on held-out maps, with the differences between the policy and each
baseline on the same maps; and ``trajectories.png``, their paths on one of these maps.

docs/active_slam_scores.md has the scores of five seeds, which benchmarks/learning.py
trains.
"""

import argparse
import csv
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium.spaces import flatten
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from slamgym.agents import BASELINES, ActiveSlamEnv, ActiveSlamVectorEnv, make_baseline
from slamgym.agents import active_slam_scores as scores
from slamgym.envs import FlattenBatch, to_stable_baselines

FOLDER = Path("results/09_train_active_slam")
SETTINGS: dict[str, Any] = {
    "n_steps": 64,
    "batch_size": 1024,
    "n_epochs": 5,
    "gamma": 0.995,
    "policy_kwargs": {"net_arch": [128, 128], "log_std_init": -0.5},
}
LEARNING_RATE = 5e-4  # falls to 0 in proportion to the steps left
INK, PALE, RED = "#222222", "#bbbbbb", "#c0392b"


def make_learner(scenario: str, worlds: int, seed: int = 0) -> Any:
    """Make PPO on worlds of the seeds from ``worlds * seed`` on."""
    import torch  # noqa: PLC0415 (an extra)
    from stable_baselines3 import PPO  # noqa: PLC0415
    from stable_baselines3.common.vec_env import VecMonitor  # noqa: PLC0415

    torch.set_num_threads(1)  # small networks: more threads wait for each other
    vector = ActiveSlamVectorEnv(worlds, scenario, autoreset_mode="SameStep")
    adapted = to_stable_baselines(FlattenBatch(vector))
    return PPO(
        "MlpPolicy",
        VecMonitor(adapted, info_keywords=("success",)),
        learning_rate=lambda left: LEARNING_RATE * left,
        device="cpu",
        seed=worlds * seed,
        **SETTINGS,
    )


def train(scenario: str, steps: int, worlds: int) -> list[dict[str, float]]:
    """Train PPO, save the policy, and return the learning curve."""
    model = make_learner(scenario, worlds)
    curve: list[dict[str, float]] = []
    began = time.perf_counter()

    def note(*_: Any) -> bool:
        ended = model.ep_info_buffer
        if ended and model.num_timesteps >= (len(curve) + 1) * steps / 60:
            curve.append(
                {
                    "steps": model.num_timesteps,
                    "seconds": round(time.perf_counter() - began, 1),
                    "return": float(np.mean([each["r"] for each in ended])),
                    "success": float(np.mean([each["success"] for each in ended])),
                }
            )
            if len(curve) % 6 == 0:
                print(
                    "after {steps:8.0f} steps, {seconds:5.0f} s: return {return:6.2f}, "
                    "success {success:.2f}".format(**curve[-1]),
                    flush=True,
                )
        return True

    model.learn(steps, callback=note)
    model.save(FOLDER / "policy.zip")
    return curve


def load_policy(path: Path) -> scores.Policy:
    """Read a saved policy; it acts deterministically."""
    from stable_baselines3 import PPO  # noqa: PLC0415 (an extra)

    model = PPO.load(path, device="cpu")

    def act(observation: dict[str, Any], env: ActiveSlamEnv) -> NDArray[np.float64]:
        flat = flatten(env.observation_space, observation)
        action, _ = model.predict(np.asarray(flat), deterministic=True)
        return np.asarray(action, dtype=np.float64)

    return act


def play_everyone(
    env: ActiveSlamEnv, policy: scores.Policy, maps: int
) -> dict[str, list[scores.Episode]]:
    """Run policy and baselines on the same maps, which were not used for training."""
    seeds = range(scores.HELD_OUT, scores.HELD_OUT + maps)
    players = {"ppo": policy}
    for name in BASELINES:
        baseline = make_baseline(name, env.scenario, np.random.default_rng(0))
        players[name] = scores.baseline_policy(baseline)
    return {
        name: scores.run_episodes(env, each, seeds) for name, each in players.items()
    }


def draw_curve(
    curve: list[dict[str, float]], played: dict[str, list[scores.Episode]]
) -> Figure:
    """Draw return against steps, the baselines as lines."""
    figure = Figure((7, 4), layout="constrained")
    axes = figure.add_subplot()
    axes.plot([row["steps"] for row in curve], [row["return"] for row in curve], c=INK)
    end = curve[-1]["steps"] if curve else 1  # no episode may have ended yet
    for k, name in enumerate(BASELINES):
        mean = scores.mean_of(played[name], "total").value
        axes.axhline(mean, color=PALE, linestyle="--", zorder=0)
        beside = (0.6 + 0.12 * (k % 3)) * end  # lines can be close
        axes.annotate(name, (beside, mean), color="#777777", va="bottom", fontsize=9)
    axes.set(xlabel="steps of training", ylabel="return of an episode")
    axes.spines[["top", "right"]].set_visible(False)
    return figure


def draw_trajectories(
    env: ActiveSlamEnv, played: dict[str, list[scores.Episode]]
) -> Figure:
    """Draw the paths of all policies on the first map, side by side."""
    figure = Figure((3 * len(played), 3.4), layout="constrained")
    env.reset(seed=scores.HELD_OUT)
    landmarks = env.landmarks
    for axes, (name, episodes) in zip(
        np.ravel(figure.subplots(1, len(played))), played.items(), strict=True
    ):
        draw_episode(axes, env, landmarks, episodes[0])
        axes.set_title(f"{name}: {outcome(episodes[0])}", fontsize=10)
    return figure


def draw_episode(
    axes: Axes,
    env: ActiveSlamEnv,
    landmarks: NDArray[np.float64],
    episode: scores.Episode,
) -> None:
    """Draw walls, landmarks and one path."""
    for x0, y0, x1, y1 in env.scenario.walls:
        axes.plot([x0, x1], [y0, y1], color=INK, linewidth=2)
    axes.plot(*landmarks.T, "+", color=RED, markersize=8)
    axes.plot(*episode.path.T, color=INK, linewidth=0.9)
    axes.plot(*episode.path[0], "o", color=INK, markersize=5)
    axes.plot(
        *episode.path[-1], "X" if episode.crashed else "s", color=INK, markersize=6
    )
    axes.set_aspect("equal")
    axes.set_axis_off()


def outcome(episode: scores.Episode) -> str:
    """Describe the end of an episode in a few words."""
    if episode.success:
        return f"all known in {episode.steps} steps"
    how = "crashed" if episode.crashed else "time is up"
    return f"{how}, {100 * episode.known:.0f} % known"


def arguments() -> argparse.Namespace:
    """Read the command line; refuse invalid options before the training."""
    parser = argparse.ArgumentParser(
        description=__doc__.splitlines()[0],
        formatter_class=argparse.ArgumentDefaultsHelpFormatter,
    )
    add = parser.add_argument
    add("--scenario", default="active_medium", help="a preset or .toml file with walls")
    add("--steps", type=int, default=2_000_000, help="of training, in all worlds")
    add("--worlds", type=int, default=64, help="side by side, a multiple of 16")
    add("--maps", type=int, default=100, help="that everyone is judged on")
    given = parser.parse_args()
    for name, least in (("steps", 1), ("worlds", 16), ("maps", 1)):
        if (value := getattr(given, name)) < least:
            parser.error(f"argument --{name}: must be >= {least}, got {value}")
    if given.worlds % 16:
        parser.error(f"argument --worlds: must be a multiple of 16, got {given.worlds}")
    try:
        env = ActiveSlamEnv(given.scenario)
        for name in BASELINES:
            make_baseline(name, env.scenario, np.random.default_rng(0))
    except (OSError, ValueError) as error:
        parser.error(f"argument --scenario: {error}")
    return given


def main() -> None:
    given = arguments()
    FOLDER.mkdir(parents=True, exist_ok=True)
    try:
        curve = train(given.scenario, given.steps, given.worlds)
    except ImportError as error:
        sys.exit(f"{error}: pip install torch==2.13.0 stable-baselines3")
    with (FOLDER / "learning_curve.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, ["steps", "seconds", "return", "success"])
        writer.writeheader()
        writer.writerows(curve)
    env = ActiveSlamEnv(given.scenario)
    played = play_everyone(env, load_policy(FOLDER / "policy.zip"), given.maps)
    table = f"{scores.score_table(played)}\n{scores.difference_lines(played, 'ppo')}"
    print(f"{given.scenario}, {given.maps} maps that training never saw:\n{table}")
    (FOLDER / "scores.txt").write_text(table + "\n", encoding="utf-8")
    draw_curve(curve, played).savefig(FOLDER / "learning_curve.png", dpi=120)
    draw_trajectories(env, played).savefig(FOLDER / "trajectories.png", dpi=100)
    print(f"wrote {FOLDER}")


if __name__ == "__main__":
    main()
