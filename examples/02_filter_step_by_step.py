"""Run two filters on one drive, step by step, and compare their consistency.

The world is that of the CMU 16-833 homework: six landmarks, long noisy steps, and a
first heading with σθ = 0.1 rad. A rotation of the whole world, robot included, does not
change any reading. The absolute heading is therefore unobservable, and a consistent
filter reports σθ = 0.1 rad at the end as at the start. The standard EKF reports less.

Run it::

    python examples/02_filter_step_by_step.py

It prints the errors of both filters along one episode. Then it compares, over many
episodes, the actual error of the heading with the one that each filter reports.
"""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from slamgym import LandmarkWorldEnv, make_estimator
from slamgym.estimator import SlamEstimator, wrap_angle
from slamgym.sim_configs import action_sequence

Array = NDArray[np.float64]

NAMES = ("ekf", "invariant")
EPISODES = 200


def start_filter(name: str, env: LandmarkWorldEnv) -> SlamEstimator:
    """Make a filter with the noise of the world and the uncertainty of its start."""
    scenario = env.scenario
    return make_estimator(
        name,
        motion_std=scenario.motion.std,
        measurement_std=scenario.sensor.std,
        **scenario.models,
        initial_pose=env.start_estimate,
        initial_pose_std=scenario.start.std,
    )


def drive(env: LandmarkWorldEnv, seed: int) -> Iterator[list[Array]]:
    """Drive an episode; yield each filter's (position error, θ error, σθ) per step."""
    observation, info = env.reset(seed=seed)
    filters = [start_filter(name, env) for name in NAMES]
    for action in [None, *action_sequence(env.scenario)]:
        if action is not None:
            observation, _, _, _, info = env.step(action)
            for slam in filters:
                slam.predict(observation["odometry"])
        seen = np.flatnonzero(observation["mask"])
        for slam in filters:
            slam.update(observation["landmarks"][seen], seen.tolist())
        yield [errors(slam, info["pose"]) for slam in filters]


def errors(slam: SlamEstimator, true_pose: Array) -> Array:
    """Compare a belief with the truth: position error [m], θ error and σθ [rad]."""
    belief = slam.belief()
    x, y, heading = belief.pose - true_pose
    deviation = np.sqrt(belief.pose_covariance[2, 2])
    return np.array([np.hypot(x, y), wrap_angle(heading), deviation])


def main() -> None:
    env = LandmarkWorldEnv("six_landmarks")
    print("One episode")
    for step, rows in enumerate(drive(env, seed=0)):
        for name, (position, heading, deviation) in zip(NAMES, rows, strict=True):
            if step % 7 == 1:
                print(
                    f"  step {step:2} {name:>10}: position off by {position:.2f} m, "
                    f"θ by {heading:+.3f} rad, says σθ = {deviation:.3f} rad"
                )
    ends = np.array([list(drive(env, seed))[-1] for seed in range(EPISODES)])
    real = np.sqrt(np.mean(ends[:, :, 1] ** 2, axis=0))
    said = ends[:, :, 2].mean(axis=0)
    print(f"Ends of {EPISODES} episodes")
    for name, error, deviation in zip(NAMES, real, said, strict=True):
        print(
            f"  {name:>10}: θ off by {error:.3f} rad rms, says σθ = {deviation:.3f} rad"
        )


if __name__ == "__main__":
    main()
