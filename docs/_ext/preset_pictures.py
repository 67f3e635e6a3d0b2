"""The gallery of presets: a picture and a short film of each world."""

from pathlib import Path

import gymnasium
import numpy as np
from PIL import Image
from sphinx.util.display import status_iterator

from slamgym.envs.controllers import OpenLoop
from slamgym.sim_configs import Scenario, action_sequence, list_presets, load_scenario

FILMED = ("loop", "active_medium")
FRAMES = 40

INTRODUCTION = """# Presets

The worlds that come with the package, each after half of its drive. A preset is used by
its name: `slamgym run corridor`, or
`gymnasium.make("slamgym/LandmarkWorld-v0", scenario="corridor")`.

::::{grid} 1 2 3 3
:gutter: 3
"""


def page(folder: Path) -> str:
    """Draw all presets into a folder and return the Markdown page that shows them."""
    cards = [INTRODUCTION]
    for name in status_iterator(list_presets(), "drawing presets … "):
        scenario = load_scenario(name)
        if not (folder / f"{name}.png").exists():
            draw(scenario, folder)
        cards.append(
            f":::{{grid-item-card}} {name}\n:img-top: {name}.png\n\n"
            f"{scenario.description}\n:::\n"
        )
    return "\n".join([*cards, "::::"]) + "\n"


def draw(scenario: Scenario, folder: Path) -> None:
    """Drive half of an episode; save its last frame, and a film if asked for."""
    env = gymnasium.make(
        "slamgym/LandmarkWorld-v0", scenario=scenario, render_mode="rgb_array"
    )
    world = env.unwrapped
    controller = OpenLoop(action_sequence(scenario), scenario.robot)
    env.reset(seed=0)
    steps = min(scenario.steps // 2, 400)
    filmed = scenario.name in FILMED
    moments = (
        set(np.linspace(1, steps, FRAMES, dtype=int).tolist()) if filmed else {steps}
    )
    frames = []
    for step in range(1, steps + 1):
        env.step(controller.act(world.pose, step - 1))
        if step in moments:
            frames.append(Image.fromarray(env.render()).resize((480, 480)))
    frames[-1].save(folder / f"{scenario.name}.png")
    if filmed:
        frames[0].save(
            folder / f"{scenario.name}.gif",
            save_all=True,
            append_images=frames[1:],
            duration=80,
            loop=0,
        )
    env.close()
