"""
A world of your own
===================

A TOML file or a mapping in Python describes a world. In this tutorial, you write one in a dozen lines.
:doc:`/generated/fields` lists every field.
"""

# %%
# The smallest world
# ------------------
from pathlib import Path

MINIMAL = """
name = "my_world"

[motion]
std = [0.02, 0.0, 0.02]  # per step: ahead [m], aside [m], turn [rad]

[sensor]
std = [0.02, 0.1]  # bearing [rad], range [m]

[landmarks]
layout = "random"
count = 12
bounds = [-6.0, -6.0, 6.0, 6.0]
"""
Path("my_world.toml").write_text(MINIMAL)

from slamgym import load_scenario

world = load_scenario("my_world.toml")
print(world)

# %%
# On the command line, use ``slamgym run my_world.toml``. A misspelt field causes an error that suggests the right one:

try:
    world.with_changes(sensor={"max_rage": 5.0})
except ValueError as error:
    print(error)

# %%
# Change it and look at it
# ------------------------
# ``with_changes`` replaces fields. On the command line, ``--set sensor.max_range=5`` does the same.

import gymnasium
import matplotlib.pyplot as plt


near = world.with_changes(
    sensor={"max_range": 5.0, "field_of_view": 3.0}, walls=[[-7, -7, 7, -7]]
)
env = gymnasium.make("slamgym/LandmarkWorld-v0", scenario=near, render_mode="rgb_array")
env.reset(seed=0)
for _ in range(60):
    observation, *_ = env.step([1.0, 0.4])

figure, axes = plt.subplots(figsize=(4.5, 4.5), layout="constrained")
axes.imshow(env.render())
axes.axis("off")
print(int(observation["mask"].sum()), "landmarks in view")
