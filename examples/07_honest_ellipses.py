"""Show overconfidence: one drive, the same readings, two filters.

The robot drives four laps of a circle past 20 landmarks. The picture shows the map of
each filter: every landmark with its 3σ ellipse, and the true position as a cross. For a
consistent filter, 989 of 1000 ellipses contain their cross. Both maps are rotated
slightly as a whole. One filter accounts for this rotation in its ellipses, and the
other does not.

Run it::

    python examples/07_honest_ellipses.py

It writes ``results/07_honest_ellipses.png``, the end of the drive, and
``results/07_honest_ellipses.gif``, the film at the head of the README (there as
``docs/images/honest_ellipses.gif``). It also counts the crosses inside.
"""

import argparse
from collections.abc import Iterator
from io import BytesIO
from pathlib import Path

import numpy as np
import PIL.Image
from matplotlib.figure import Figure
from matplotlib.image import imsave
from numpy.typing import NDArray

from slamgym import Belief, LandmarkWorldEnv, make_estimator
from slamgym.envs import write_video
from slamgym.estimator import SlamEstimator
from slamgym.evaluation import landmark_distances
from slamgym.sim_configs import action_sequence

Image = NDArray[np.uint8]

PICTURE = Path("results/07_honest_ellipses.png")
FILM = Path("results/07_honest_ellipses.gif")
FPS = 8
TITLES = {"ekf": "standard EKF", "invariant": "invariant EKF"}


def follow(env: LandmarkWorldEnv) -> Iterator[list[Belief]]:
    """Drive the episode; yield the beliefs of the filters after every scan."""
    scenario = env.scenario
    observation, _ = env.reset(seed=0)
    filters = [
        make_estimator(
            name,
            motion_std=scenario.motion.std,
            measurement_std=scenario.sensor.std,
            **scenario.models,
            initial_pose=env.start_estimate,
            initial_pose_std=scenario.start.std,
        )
        for name in TITLES
    ]
    for action in action_sequence(scenario):
        look(filters, observation)
        yield [slam.belief() for slam in filters]
        observation, *_ = env.step(action)
        for slam in filters:
            slam.predict(observation["odometry"])
    look(filters, observation)
    yield [slam.belief() for slam in filters]


def look(
    filters: list[SlamEstimator], observation: dict[str, NDArray[np.float64]]
) -> None:
    """Update all filters with one scan."""
    seen = np.flatnonzero(observation["mask"])
    for slam in filters:
        slam.update(observation["landmarks"][seen], seen.tolist())


def landmarks_within_3_sigma(belief: Belief, truth: NDArray[np.float64]) -> int:
    """Count the true landmarks inside their 3σ ellipses."""
    distances = landmark_distances(
        belief.landmarks, belief.landmark_covariances, truth[list(belief.landmark_ids)]
    )
    return int((distances.mahalanobis <= 3).sum())


def titles(env: LandmarkWorldEnv, beliefs: list[Belief]) -> list[str]:
    """Name each filter, and count the landmarks that its ellipses hold."""
    return [
        f"{title}: {landmarks_within_3_sigma(belief, env.landmarks)} of "
        f"{len(belief.landmark_ids)} landmarks inside 3σ"
        for belief, title in zip(beliefs, TITLES.values(), strict=True)
    ]


def picture(env: LandmarkWorldEnv, beliefs: list[Belief]) -> Image:
    """Show the beliefs beside each other, each under its title."""
    frames = []
    for belief in beliefs:
        env.show_belief(belief)
        frames.append(np.asarray(env.render(), dtype=np.uint8))
    return under_titles(frames, titles(env, beliefs))


def under_titles(frames: list[Image], titles: list[str]) -> Image:
    """Draw pictures beside each other, pixel by pixel, each under its title."""
    height, width = frames[0].shape[:2]
    head = 40
    figure = Figure((len(frames) * width / 100, (height + head) / 100), dpi=100)
    for k, (frame, title) in enumerate(zip(frames, titles, strict=True)):
        share = 1 / len(frames)
        axes = figure.add_axes((k * share, 0, share, height / (height + head)))
        axes.set_axis_off()
        axes.imshow(frame, interpolation="nearest", aspect="auto")
        axes.set_title(title, fontweight="bold", fontsize=14, pad=10)
    figure.savefig(drawn := BytesIO())
    return np.asarray(PIL.Image.open(drawn).convert("RGB"))


def shrunk(frame: Image) -> Image:
    """Halve the file of a film: two thirds of the size."""
    picture = PIL.Image.fromarray(frame)
    smaller = (2 * picture.width // 3, 2 * picture.height // 3)
    return np.asarray(picture.resize(smaller, PIL.Image.Resampling.LANCZOS))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--every", type=int, default=30, help="steps between frames")
    every = parser.parse_args().every
    env = LandmarkWorldEnv("loop", render_mode="rgb_array")
    frames: list[Image] = []
    beliefs: list[Belief] = []
    for step, beliefs in enumerate(follow(env)):
        if step % every == 0 or step == env.scenario.steps:
            frames.append(picture(env, beliefs))
    print(*titles(env, beliefs), sep="\n")
    PICTURE.parent.mkdir(exist_ok=True)
    imsave(PICTURE, frames[-1])
    smaller = [shrunk(frame) for frame in frames]
    write_video([*smaller, *[smaller[-1]] * 2 * FPS], FILM, FPS)
    env.close()
    print(f"wrote {PICTURE} and {FILM}")


if __name__ == "__main__":
    main()
