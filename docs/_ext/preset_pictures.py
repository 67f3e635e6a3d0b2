"""The gallery of presets: a picture of each world, and films of the environments."""

from collections.abc import Callable
from pathlib import Path

import gymnasium
import numpy as np
from PIL import Image, ImageDraw
from sphinx.util.display import status_iterator

from slamgym.agents import BeliefObservation, make_baseline
from slamgym.envs import OpenLoop
from slamgym.sim_configs import Scenario, action_sequence, list_presets, load_scenario

FRAMES = 40
SIZE = (480, 480)
LARGEST = 500  # landmarks of a world whose picture shows the belief of a filter

INTRODUCTION = """# Presets

The worlds that come with the package, each after half of its drive, with the belief of
`ekf` in worlds of up to 500 landmarks. A preset is used by its name: `slamgym run
corridor`, or
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
            draw(scenario, folder / f"{name}.png")
        cards.append(
            f":::{{grid-item-card}} {name}\n:img-top: {name}.png\n\n"
            f"{scenario.description}\n:::\n"
        )
    return "\n".join([*cards, "::::"]) + "\n"


def draw(scenario: Scenario, path: Path) -> None:
    """Save a picture of a world after half of its drive, with a belief if small."""
    env = gymnasium.make(
        "slamgym/LandmarkWorld-v0", scenario=scenario, render_mode="rgb_array"
    )
    if scenario.landmarks.count <= LARGEST:
        options = {} if scenario.sensor.identities else {"management": True}
        env = BeliefObservation(env, "ekf", estimator_options=options)
    steps = min(scenario.steps // 2, 400)
    picture = _frames(env, _open_loop(env), {steps})[-1]
    if faults := scenario.model_dump(exclude_defaults=True).get("faults"):
        text = "\n".join(f"faults.{name} = {value}" for name, value in faults.items())
        ImageDraw.Draw(picture).text((60, 40), text, "#b42318", font_size=20)
    picture.save(path)


def film(name: str, preset: str, path: Path) -> None:
    """Save a film of an environment; ActiveSlam is driven by a baseline."""
    env = gymnasium.make(f"slamgym/{name}-v0", scenario=preset, render_mode="rgb_array")
    act = _revisiting(env) if name == "ActiveSlam" else _open_loop(env)
    steps = env.unwrapped.scenario.steps // 2
    moments = np.linspace(1, steps, FRAMES, dtype=int).tolist()
    first, *others = _frames(env, act, set(moments))
    first.save(path, save_all=True, append_images=others, duration=80, loop=0)


def _open_loop(env: gymnasium.Env) -> Callable[[int], np.ndarray]:
    scenario = env.unwrapped.scenario
    controller = OpenLoop(action_sequence(scenario), scenario.robot)
    return lambda step: controller.act(env.unwrapped.pose, step)


def _revisiting(env: gymnasium.Env) -> Callable[[int], np.ndarray]:
    world = env.unwrapped
    baseline = make_baseline("revisit", world.scenario, np.random.default_rng(0))
    return lambda _: baseline.act(world.knowledge)


def _frames(
    env: gymnasium.Env, act: Callable[[int], np.ndarray], moments: set[int]
) -> list[Image.Image]:
    """Drive an episode, and return the frames after some of its steps."""
    env.reset(seed=0)
    frames = []
    for step in range(max(moments)):
        *_, terminated, _, _ = env.step(act(step))
        if step + 1 in moments or terminated:
            frames.append(Image.fromarray(env.render()).resize(SIZE))
        if terminated:
            break
    env.close()
    return frames
