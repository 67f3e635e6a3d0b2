"""
An agent that uses the belief of a filter
=========================================

A wrapper runs a filter on the readings of a world and adds its belief to the observation. The agent of this tutorial
drives around a square. It returns to the start whenever the standard deviation of its position exceeds 30 cm.
"""

# %%
# The belief in the observation
# -----------------------------
import gymnasium
import numpy as np

from slamgym import Waypoints
from slamgym.agents import BeliefObservation, InformationReward

world = gymnasium.make("slamgym/LandmarkWorld-v0", scenario="active_medium")
believing = BeliefObservation(world, estimator="invariant")
observation, info = believing.reset(seed=0)
for key, value in observation.items():
    print(f"{key:28} {np.shape(value)}")

# %%
# A reward for information
# ------------------------
# ``InformationReward`` adds the decrease of the map's uncertainty in each step to the reward.

env = InformationReward(believing, criterion="D")
robot = believing.scenario.robot
dt = believing.scenario.dt
around = Waypoints(
    [(6, -6), (6, 6), (-6, 6), (-6, -6)], robot, dt=dt, tolerance=0.5, loop=True
)
home = Waypoints([(0, 0)], robot, dt=dt, tolerance=0.5, loop=True)


def drive(limit):
    """Drive 200 steps; return the reward and the standard deviations of the position."""
    env.reset(seed=0)
    earned, stds = 0.0, []
    for step in range(200):
        belief = believing.belief
        std = np.sqrt(np.linalg.eigvalsh(belief.pose_covariance[:2, :2])[-1])
        driver = home if std > limit else around
        earned += env.step(driver.act(belief.pose, step))[1]
        stds.append(std)
    return earned, stds


# %%
import matplotlib.pyplot as plt

figure, axes = plt.subplots(figsize=(7, 3.2), layout="constrained")
for name, limit in {"drives on": np.inf, "goes home when unsure": 0.3}.items():
    earned, stds = drive(limit)
    print(f"{name:22} earns {earned:.2f} nats per landmark")
    axes.plot(stds, label=name)
axes.set(xlabel="step", ylabel="σ of the position [m]", ylim=(0, None))
axes.legend(frameon=False)

# %%
# :doc:`/active_slam` describes the task ``slamgym/ActiveSlam-v0`` with reference scores, a planner that predicts beliefs,
# and vector worlds for reinforcement learning.
