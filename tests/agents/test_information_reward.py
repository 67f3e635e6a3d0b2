"""What knowledge is worth: the criteria, and a reward that adds up."""

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.envs.registration import EnvSpec
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import multivariate_normal

import slamgym  # noqa: F401 (registers the environments)
from slamgym.agents import BeliefObservation, BeliefObservationVector, InformationReward
from slamgym.agents.belief_features import belief_storage
from slamgym.agents.information_reward import (
    CRITERIA,
    a_optimality,
    d_optimality,
    e_optimality,
    effort,
    landmark_prior_std,
    map_covariances,
    uncertainty,
)
from slamgym.estimator import EkfSlam
from slamgym.sim_configs import load_scenario

ID = "slamgym/LandmarkWorld-v0"


def random_covariance(size, seed=0):
    factor = np.random.default_rng(seed).standard_normal((size, size + 2))
    return factor @ factor.T


@pytest.fixture(scope="module")
def slam():
    slam = EkfSlam((0.1, 0.05, 0.05), (0.02, 0.1), initial_pose_std=(0.1, 0.1, 0.1))
    slam.update([(0.3, 2.0), (-0.3, 3.0)], landmark_ids=[2, 0])
    slam.predict((1.0, 0.2))
    slam.update([(0.1, 2.0)], landmark_ids=[2])
    return slam


def test_d_optimality_is_the_entropy_but_for_a_constant():
    covariance = random_covariance(6)
    entropy = multivariate_normal(cov=covariance).entropy()
    constant = 3 * (1 + np.log(2 * np.pi))
    assert d_optimality(covariance) == pytest.approx(entropy - constant)


def test_a_and_e_optimality_are_sum_and_largest_of_the_variances_of_the_axes():
    covariance = random_covariance(5)
    variances = np.linalg.svd(covariance, compute_uv=False)
    assert a_optimality(covariance) == pytest.approx(variances.sum())
    assert e_optimality(covariance) == pytest.approx(variances[0])


@pytest.mark.parametrize("measure", [d_optimality, a_optimality, e_optimality])
def test_criteria_take_many_covariances_at_once(measure):
    several = np.stack([random_covariance(4, seed) for seed in range(3)])
    np.testing.assert_allclose(measure(several), [measure(each) for each in several])


def test_a_singular_covariance_has_no_entropy():
    assert d_optimality(np.diag([1.0, 0.0])) == -np.inf


def test_landmarks_not_yet_mapped_count_with_the_prior(slam):
    rows = belief_storage(slam.belief(), 4, by_id=True).beliefs()
    first, joint = (map_covariances(rows, (3.0, 2.0))[0] for _ in range(2))
    np.testing.assert_array_equal(first, joint)  # nothing adds up over calls
    covariance = slam.belief().covariance
    order = [5, 6, 3, 4]  # the map holds landmark 2, then landmark 0
    seen = [0, 1, 4, 5]
    np.testing.assert_array_equal(
        joint[np.ix_(seen, seen)], covariance[np.ix_(order, order)]
    )
    np.testing.assert_array_equal(np.diag(joint)[[2, 3, 6, 7]], [9.0, 4.0, 9.0, 4.0])
    unseen = joint[np.ix_([2, 3, 6, 7], seen)]
    assert not unseen.any()


def test_the_prior_of_a_landmark_is_as_long_and_as_wide_as_the_world():
    world = load_scenario("loop").with_changes(walls=[[0, 0, 12, 0], [0, 6, 12, 6]])
    assert landmark_prior_std(world) == pytest.approx((12**0.5, 3**0.5))


def test_a_first_sight_is_worth_what_a_measurement_of_the_prior_is():
    """Known pose, prior N(0, σ²): the gain is the mutual information of the two."""
    prior, noise = 50.0, 0.1
    slam = EkfSlam((0, 0, 0), (noise / 2.0, noise))
    before = belief_storage(slam.belief(), 1, by_id=True).beliefs()
    slam.update([(0.0, 2.0)], landmark_ids=[0])
    after = belief_storage(slam.belief(), 1, by_id=True).beliefs()
    gain = uncertainty(before, "D", prior) - uncertainty(after, "D", prior)
    assert gain.item() == pytest.approx(2 * np.log(prior / noise))


@pytest.mark.parametrize("criterion", CRITERIA)
def test_to_look_again_never_makes_a_known_pose_less_sure(criterion):
    slam = EkfSlam((0, 0, 0), (0.05, 0.1))
    measures = []
    for _ in range(5):
        slam.update([(0.0, 2.0), (0.5, 3.0)], landmark_ids=[0, 1])
        rows = belief_storage(slam.belief(), 3, by_id=True).beliefs()
        measures.append(uncertainty(rows, criterion, 5.0).item())
    if criterion == "E":  # the third landmark is still anywhere
        assert measures == [25.0] * 5
    else:
        assert (np.diff(measures) < 0).all()


def test_measures_are_per_landmark(slam):
    rows = belief_storage(slam.belief(), 4, by_id=True).beliefs()
    joint = map_covariances(rows, 2.0)[0]
    for criterion, whole in (("D", d_optimality), ("A", a_optimality)):
        assert uncertainty(rows, criterion, 2.0)[0] == whole(joint) / 4
    assert uncertainty(rows, "E", 2.0)[0] == e_optimality(joint)


@given(st.floats(-3, 3), st.floats(-3, 3), st.floats(0.1, 3), st.floats(0.1, 3))
def test_effort_is_between_rest_and_both_limits(v, w, fastest, quickest):
    spent = effort([v, w], (fastest, quickest)).item()
    assert 0 <= spent <= 1
    assert effort([-v, -w], (fastest, quickest)).item() == spent
    if abs(v) <= fastest and abs(w) <= quickest:
        assert spent == pytest.approx(((v / fastest) ** 2 + (w / quickest) ** 2) / 2)


def wrapped(criterion="D", scenario="loop", **options):
    env = gym.make(ID, scenario=scenario)
    return InformationReward(BeliefObservation(env, "ekf"), criterion, **options)


@pytest.mark.parametrize("criterion", CRITERIA)
@pytest.mark.parametrize("prior_std", [None, 3.0])
def test_rewards_add_up_to_the_first_uncertainty_minus_the_last(criterion, prior_std):
    env = wrapped(criterion, prior_std=prior_std)
    env.reset(seed=0)
    prior = landmark_prior_std(load_scenario("loop")) if prior_std is None else 3.0
    first = uncertainty(env.get_wrapper_attr("beliefs"), criterion, prior).item()
    total = sum(env.step([0.25, 0.025])[1] for _ in range(150))
    last = uncertainty(env.get_wrapper_attr("beliefs"), criterion, prior).item()
    assert total == pytest.approx(first - last, abs=1e-9)
    if criterion != "E":  # the worst landmark is still unseen
        assert first - last > 0


def test_collisions_and_effort_cost_what_they_are_said_to():
    plain = wrapped(scenario="corridor")
    costly = wrapped(scenario="corridor", gain=2.0, collision_cost=5.0, effort_cost=3.0)
    plain.reset(seed=0)
    costly.reset(seed=0)
    bumps = 0
    for step in range(40):
        action = [0.8, 0.1 * (step % 3)]
        gain = plain.step(action)[1]
        reward, info = costly.step(action)[1], costly.unwrapped
        bump = reward - 2 * gain + 3 * effort(action, (0.8, 1.0)).item()
        assert bump == pytest.approx(0, abs=1e-9) or bump == pytest.approx(-5)
        bumps += bump < -1
        assert info.scenario.robot.max_speed == 0.8
    assert bumps > 0


def test_a_new_episode_begins_with_a_new_uncertainty():
    env = wrapped()
    rewards = []
    for _ in range(2):
        env.reset(seed=4)
        rewards.append([env.step([0.25, 0.1])[1] for _ in range(20)])
    assert rewards[0] == rewards[1]


def test_what_the_uncertainty_of_many_worlds_falls_by_is_the_reward_of_each():
    worlds = BeliefObservationVector(gym.make_vec(ID, 3, scenario="loop"), "ekf")
    envs = [wrapped() for _ in range(3)]
    prior = landmark_prior_std(worlds.scenario)
    worlds.reset(seed=7)
    for k, env in enumerate(envs):
        env.reset(seed=7 + k)
    before = uncertainty(worlds.beliefs, "D", prior)
    for actions in np.random.default_rng(0).uniform(-0.25, 0.25, (20, 3, 2)):
        worlds.step(actions)
        after = uncertainty(worlds.beliefs, "D", prior)
        rewards = [env.step(a)[1] for env, a in zip(envs, actions, strict=True)]
        np.testing.assert_allclose(before - after, rewards, atol=1e-9)
        before = after
    assert max(rewards) > 0


def test_the_wrapper_survives_a_spec_written_as_json():
    env = wrapped("A", collision_cost=2.0)
    rebuilt = gym.make(EnvSpec.from_json(env.spec.to_json()))
    env.reset(seed=0)
    rebuilt.reset(seed=0)
    assert env.step([0.25, 0.0])[1] == rebuilt.step([0.25, 0.0])[1]


@pytest.mark.parametrize(
    ("name", "value"),
    [("prior_std", 0), ("prior_std", np.nan), ("collision_cost", -1),
     ("effort_cost", np.nan), ("gain", np.inf)],
)  # fmt: skip
def test_nonsense_is_refused(name, value):
    env = BeliefObservation(gym.make(ID), "ekf")
    with pytest.raises(ValueError, match=f"{name} must be finite"):
        InformationReward(env, **{name: value})
    with pytest.raises(ValueError, match="criterion must be one of D, A, E, got 'T'"):
        wrapped("T")
    with pytest.raises(ValueError, match="env must have a BeliefObservation"):
        InformationReward(gym.make(ID))


def test_the_gain_adds_up_where_the_filter_associates():
    world = gym.make(ID, scenario="hidden_identities", steps=25)
    env = InformationReward(BeliefObservation(world, "invariant"))
    env.reset(seed=3)
    prior = landmark_prior_std(load_scenario("hidden_identities"))
    start = uncertainty(env.get_wrapper_attr("beliefs"), "D", prior)[0]
    total = sum(env.step(np.array([0.8, 0.2]))[1] for _ in range(25))
    beliefs = env.get_wrapper_attr("beliefs")
    assert beliefs.mapped.sum() > 5
    assert total == pytest.approx(start - uncertainty(beliefs, "D", prior)[0])
    assert total > 1.0
