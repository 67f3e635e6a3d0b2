# pyright: reportMissingImports=false
"""PPO of RLlib learns in every environment.

Not part of the suite, as Ray asks for an older Gymnasium and for two gigabytes; in an
environment of its own::

    python3 -m venv .rllib && . .rllib/bin/activate
    pip install torch==2.13.0 "ray[rllib]==2.60.0" pytest -e .
    pytest tests/on_rllib.py

RLlib takes our environments in three ways, all of them tried here: a function that
makes one world, already flat, which RLlib puts side by side; the id alone, flattened by
a connector of RLlib's; and a function that makes the native vector of worlds.
"""

import gymnasium as gym
import numpy as np
import pytest

import slamgym  # noqa: F401 (registers the environments)

IDS = sorted(each for each in gym.registry if each.startswith("slamgym/"))
STEPS = 20
CHANGES = {"scenario": "active_easy", "steps": STEPS}  # every environment accepts it

pytestmark = pytest.mark.filterwarnings("default")  # Ray's own warnings


@pytest.fixture(scope="module")
def cluster():
    """Start a cluster of two cores on this machine."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("RAY_USAGE_STATS_ENABLED", "0")
        import ray

        options = {"include_dashboard": False, "log_to_driver": False}
        ray.init(num_cpus=2, object_store_memory=200_000_000, **options)
        yield ray
        ray.shutdown()


def flat_world(config, each):
    """Let a worker of RLlib's, which has imported nothing of ours, make the worlds."""
    from ray.tune.registry import register_env

    def make(_):  # inside: Ray sends it to its workers whole
        return gym.wrappers.FlattenObservation(gym.make(f"slamgym:{each}", **CHANGES))

    register_env("worlds", make)
    return config.environment("worlds").env_runners(
        num_env_runners=1, num_envs_per_env_runner=2
    )


def id_and_connector(config, each):
    from ray.rllib.connectors.env_to_module import FlattenObservations

    return config.environment(f"slamgym:{each}", env_config=CHANGES).env_runners(
        num_env_runners=0,
        num_envs_per_env_runner=2,
        env_to_module_connector=lambda *_, **__: FlattenObservations(),
    )


def native_vector(config, each):
    from ray.tune.registry import register_env

    from slamgym.envs.vector import FlattenBatch

    def make(context):
        count = context["num_envs"]
        return FlattenBatch(gym.make_vec(f"slamgym:{each}", count, **CHANGES))

    register_env("worlds", make)
    return config.environment("worlds").env_runners(
        num_env_runners=0,
        num_envs_per_env_runner=8,
        gym_env_vectorize_mode="vector_entry_point",
    )


def weights(algorithm):
    state = algorithm.get_module().get_state()
    return np.concatenate([np.ravel(state[key]) for key in sorted(state)])


@pytest.mark.parametrize("set_up", [flat_world, id_and_connector, native_vector])
@pytest.mark.parametrize("each", IDS)
def test_ppo_learns(cluster, each, set_up):
    from ray.rllib.algorithms.ppo import PPOConfig

    config = set_up(PPOConfig(), each).debugging(seed=0)
    batch = {"train_batch_size_per_learner": 256, "minibatch_size": 64}
    algorithm = config.training(num_epochs=1, **batch).build_algo()
    before = weights(algorithm)
    first, second = (algorithm.train()["env_runners"] for _ in range(2))
    for told in (first, second):
        assert told["num_env_steps_sampled"] >= 256
        assert told["num_episodes"] >= 8
        assert np.isfinite(told["episode_return_mean"])
    # Of an episode cut in two by the end of an iteration RLlib counts a step too many,
    # in Pendulum too.
    assert first["episode_len_max"] == STEPS
    after = weights(algorithm)
    algorithm.stop()
    assert np.isfinite(after).all()
    assert (after != before).any()
