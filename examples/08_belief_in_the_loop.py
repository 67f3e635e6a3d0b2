"""Put a filter into an agent's loop: observe its belief, and reward information.

One wrapper runs a filter on the observations of the world, and adds its belief to them.
Another one rewards the decrease of the map's uncertainty. With both, an agent that
returns when it is lost takes a few lines. Two robots drive around the walls of a floor.
One drives on in any case. The other returns to the start whenever its position is
uncertain, until it is certain again.

Run it::

    python examples/08_belief_in_the_loop.py

It prints the rewards of both, and the uncertainty of their maps and positions. It
writes ``results/08_belief_in_the_loop.png``, the uncertainty of their positions over
the drive. Then it runs 64 worlds side by side, each with its own filter.
"""

import argparse
from pathlib import Path
from typing import NamedTuple

import gymnasium as gym
import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from slamgym import Waypoints
from slamgym.agents import BeliefObservation, BeliefObservationVector, InformationReward

PICTURE = Path("results/08_belief_in_the_loop.png")
ROUND = [(6, -6), (6, 6), (-6, 6), (-6, -6)]
HOME = [(0, 0)]
UNSURE, SURE = 0.3, 0.15  # standard deviations of the position [m]


class Drive(NamedTuple):
    """The result of one drive."""

    earned: float
    """Information gained [nats per landmark]."""
    known: float
    """Median standard deviation of the mapped landmarks [m]."""
    position_std: list[float]
    """At every step [m]."""


def drive(*, goes_home: bool) -> Drive:
    """Drive 200 steps, controlled by the belief alone."""
    world = gym.make("slamgym:slamgym/LandmarkWorld-v0", scenario="active_medium")
    believing = BeliefObservation(world, estimator="invariant")
    env = InformationReward(believing, criterion="D")
    scenario = believing.scenario
    onward, homeward = (
        Waypoints(points, scenario.robot, dt=scenario.dt, tolerance=0.5, loop=True)
        for points in (ROUND, HOME)
    )
    env.reset(seed=0)
    earned, stds, lost = 0.0, [], False
    for step in range(scenario.steps):
        belief = believing.belief
        std = float(np.sqrt(np.linalg.eigvalsh(belief.pose_covariance[:2, :2])[-1]))
        lost = goes_home and std > (SURE if lost else UNSURE)
        driver = homeward if lost else onward
        earned += float(env.step(driver.act(belief.pose, step))[1])
        stds.append(std)
    return Drive(earned, median_std(believing.beliefs.landmark_covariances), stds)


def median_std(covariances: NDArray[np.float64]) -> float:
    """Worst standard deviation of each landmark, and the median of these [m]."""
    worst = np.linalg.eigvalsh(covariances)[..., -1]
    return float(np.median(np.sqrt(worst[worst > 0])))


def many_worlds() -> tuple[int, ...]:
    """Step 64 worlds with a filter each; return the shape of the observations."""
    vector = gym.make_vec(
        "slamgym:slamgym/LandmarkWorld-v0", 64, scenario="active_medium"
    )
    worlds = BeliefObservationVector(vector, estimator="invariant")
    worlds.reset(seed=0)
    observations, *_ = worlds.step(worlds.action_space.sample())
    return np.shape(observations["belief_landmarks"])


def draw(drives: dict[str, Drive]) -> Figure:
    """Draw the uncertainty of the robots' positions."""
    figure = Figure((7, 3.5), layout="constrained")
    axes = figure.add_subplot()
    colours = "#999999", "#222222"
    for (name, each), colour in zip(drives.items(), colours, strict=True):
        axes.plot(each.position_std, color=colour, label=name)
    axes.set(xlabel="step", ylabel="σ of the position [m]", ylim=(0, None))
    axes.legend(frameon=False)
    axes.spines[["top", "right"]].set_visible(False)
    return figure


def main() -> None:
    argparse.ArgumentParser(description=__doc__.splitlines()[0]).parse_args()
    drives = {
        "drives on": drive(goes_home=False),
        "goes home when unsure": drive(goes_home=True),
    }
    for name, each in drives.items():
        print(
            f"{name:22} earns {each.earned:5.2f} nats per landmark, "
            f"knows them to {100 * each.known:3.0f} cm, "
            f"its place at worst to {100 * max(each.position_std):3.0f} cm"
        )
    print(f"64 worlds observe landmarks of shape {many_worlds()}")
    PICTURE.parent.mkdir(exist_ok=True)
    draw(drives).savefig(PICTURE, dpi=100)
    print(f"wrote {PICTURE}")


if __name__ == "__main__":
    main()
