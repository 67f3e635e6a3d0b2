"""Associate readings with landmarks by two methods, and score the decisions.

In the world ``hidden_identities``, readings have no landmark id, and one reading per
step is clutter. The world reports the true ids apart from the readings, and the example
scores the filter's decisions with them.

Run it::

    python examples/11_who_is_who.py

"Nearest" associates each reading separately. The default policy follows several
assignments of whole scans, and also uses the readings of a landmark before its
confirmation.
"""

import numpy as np

from slamgym import LandmarkWorldEnv, load_scenario, make_estimator
from slamgym.estimator import SlamEstimator
from slamgym.evaluation import score_association
from slamgym.sim_configs import action_sequence

POLICIES = {"nearest": {"association": "nearest", "backdate": False}, "default": {}}


def main() -> None:
    """Drive once; compare the policies on the same readings."""
    world = load_scenario("hidden_identities")
    print("policy   path error [m]  right  wrong  duplicates  not used")
    for name, policy in POLICIES.items():
        slam = make_estimator(
            "invariant",
            motion_std=world.motion.std,
            measurement_std=world.sensor.std,
            initial_pose=world.start.pose,
            management=policy,
        )
        error, true_ids = drive(LandmarkWorldEnv(world), slam)
        scores = score_association(slam.decisions, true_ids)  # type: ignore[attr-defined]
        right = scores.correct + scores.new_correct
        print(
            f"{name:9}{error:14.3f}{right:7}{scores.wrong:7}"
            f"{scores.duplicate:12}{scores.missed:10}"
        )


def drive(env: LandmarkWorldEnv, slam: SlamEstimator) -> tuple[float, list[list[int]]]:
    """Drive an episode; return the error of the path and the true ids of all scans."""
    observation, info = env.reset(seed=4)
    squared, true_ids = [], []
    for action in [*action_sequence(env.scenario), None]:
        seen = observation["mask"]
        slam.update(observation["landmarks"][seen])
        true_ids.append(info["landmark_ids"][: seen.sum()].tolist())
        offset = slam.belief().pose[:2] - info["pose"][:2]
        squared.append(float(offset @ offset))
        if action is not None:
            observation, *_, info = env.step(action)
            slam.predict(observation["odometry"])
    return float(np.sqrt(np.mean(squared))), true_ids


if __name__ == "__main__":
    main()
