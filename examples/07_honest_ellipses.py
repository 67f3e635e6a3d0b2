"""See overconfidence: one drive, the same readings, two filters.

Four laps of a circle past 20 landmarks.  At the end each filter draws its map, every
landmark with the ellipse that should hold its true place (the cross) in 989 of 1000
cases.  The mistakes of the two maps are much alike, a small turn of the whole; but one
filter knows that it may be turned, and the other does not.

Run it::

    python examples/07_honest_ellipses.py

It writes ``results/07_honest_ellipses.png``, the picture at the head of the README
(there as ``docs/images/honest_ellipses.png``), and counts the crosses inside.
"""

from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from slamgym.envs import LandmarkWorldEnv
from slamgym.estimator import Belief, SlamEstimator, make_estimator
from slamgym.evaluation import landmark_distances
from slamgym.sim_configs import action_sequence

PICTURE = Path("results/07_honest_ellipses.png")
TITLES = {"ekf": "standard EKF", "invariant": "invariant EKF"}


def follow(env: LandmarkWorldEnv) -> list[Belief]:
    """Drive the episode; return what each filter believes at its end."""
    scenario = env.scenario
    observation, _ = env.reset(seed=0)
    filters = [
        make_estimator(
            name,
            motion_std=scenario.motion.std,
            measurement_std=scenario.sensor.std,
            initial_pose=env.start_estimate,
            initial_pose_std=scenario.start.std,
        )
        for name in TITLES
    ]
    for action in action_sequence(scenario):
        look(filters, observation)
        observation, *_ = env.step(action)
        for slam in filters:
            slam.predict(observation["odometry"])
    look(filters, observation)
    return [slam.belief() for slam in filters]


def look(
    filters: list[SlamEstimator], observation: dict[str, NDArray[np.float64]]
) -> None:
    """Give one scan to all filters."""
    seen = np.flatnonzero(observation["mask"])
    for slam in filters:
        slam.update(observation["landmarks"][seen], seen.tolist())


def landmarks_within_3_sigma(belief: Belief, truth: NDArray[np.float64]) -> int:
    """Count the true landmarks inside their 3σ ellipses."""
    distances = landmark_distances(
        belief.landmarks, belief.landmark_covariances, truth[list(belief.landmark_ids)]
    )
    return int((distances.mahalanobis <= 3).sum())


def side_by_side(frames: list[NDArray[np.uint8]], titles: list[str]) -> Figure:
    """Show pictures beside each other, pixel by pixel, each under its title."""
    height, width = frames[0].shape[:2]
    head = 40
    figure = Figure((len(frames) * width / 100, (height + head) / 100), dpi=100)
    for k, (frame, title) in enumerate(zip(frames, titles, strict=True)):
        share = 1 / len(frames)
        axes = figure.add_axes((k * share, 0, share, height / (height + head)))
        axes.set_axis_off()
        axes.imshow(frame, interpolation="nearest", aspect="auto")
        axes.set_title(title, fontweight="bold", fontsize=14, pad=10)
    return figure


def main() -> None:
    env = LandmarkWorldEnv("loop", render_mode="rgb_array")
    frames, titles = [], []
    for belief, title in zip(follow(env), TITLES.values(), strict=True):
        env.show_belief(belief)
        frames.append(np.asarray(env.render(), dtype=np.uint8))
        inside = landmarks_within_3_sigma(belief, env.landmarks)
        count = f"{inside} of {len(belief.landmark_ids)} landmarks inside 3σ"
        titles.append(f"{title}: {count}")
        print(titles[-1])
    PICTURE.parent.mkdir(exist_ok=True)
    side_by_side(frames, titles).savefig(PICTURE)
    env.close()
    print(f"wrote {PICTURE}")


if __name__ == "__main__":
    main()
