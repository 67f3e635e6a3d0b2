"""Success and the truth: what `info` reveals of the map's error."""

import math
from dataclasses import replace

import numpy as np
import pytest

from slamgym.agents import ActiveSlamEnv, ActiveSlamVectorEnv
from slamgym.agents.active_slam_scores import Episode, mean_of, run_episode
from slamgym.estimator import InvariantEkfSlam

RING = {"layout": "ring", "count": 5, "radius": 2.0}


class Shifted(InvariantEkfSlam):
    """Believes every landmark half a metre to the right of where it should."""

    def belief(self):
        belief = super().belief()
        mean = belief.mean.copy()
        mean[3::2] += 0.5
        return replace(belief, mean=mean)


def stand_until_the_end(env, seed=0):
    return run_episode(env, lambda *_: np.zeros(2), seed)


def test_the_error_is_that_of_the_belief_against_the_true_landmarks():
    env = ActiveSlamEnv("active_medium")
    _, info = env.reset(seed=3)
    rng = np.random.default_rng(0)
    for _ in range(30):
        belief = env.knowledge.belief
        truth = env.landmarks[list(belief.landmark_ids)]
        error = ((belief.landmarks - truth) ** 2).sum(axis=1).mean() ** 0.5
        assert info["true_rmse"] == pytest.approx(error, rel=1e-12)
        info = env.step(rng.uniform([0.0, -0.5], [0.5, 0.5]))[4]


def test_an_empty_map_has_no_error():
    env = ActiveSlamEnv(
        "active_easy", landmarks=RING, sensor={"max_range": 0.5}, steps=2
    )
    assert env.reset(seed=0)[1]["true_rmse"] == 0.0
    episode = stand_until_the_end(env)
    assert math.isnan(episode.true_rmse)
    assert (episode.steps, episode.path.shape) == (2, (3, 2))


@pytest.mark.parametrize("estimator", ["invariant", Shifted])
def test_a_success_is_honest_where_the_truth_agrees(estimator):
    settings = {"landmarks": RING, "accuracy": 0.08, "estimator": estimator}
    episode = stand_until_the_end(ActiveSlamEnv("active_easy", **settings), seed=1)
    assert episode.success
    assert episode.honest == (estimator == "invariant")
    assert episode.true_rmse <= 0.08 if episode.honest else episode.true_rmse > 0.3


def test_success_far_from_the_truth_is_told_apart_in_many_worlds():
    settings = {"landmarks": RING, "start": {"std": [0.15, 0.15, 0.001]}}
    worlds = ActiveSlamVectorEnv(
        16, "active_easy", accuracy=0.17, autoreset_mode="Disabled", **settings
    )
    worlds.reset(seed=0)
    *_, infos = worlds.step(np.zeros((16, 2)))
    honest = infos["success"] & (infos["true_rmse"] <= 0.17)
    np.testing.assert_array_equal(infos["honest_success"], honest)
    assert 0 < honest.sum() < infos["success"].sum()


def test_episodes_without_a_map_do_not_count_in_the_mean_error():
    ends = [Episode(1.0, *[1.0] * 5, 0, []) for _ in range(2)]
    ends.append(ends[0]._replace(true_rmse=math.nan))
    assert mean_of(ends, "true_rmse").value == 1.0
