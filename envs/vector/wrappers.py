"""Wrappers of vector environments that process the whole batch at once."""

from typing import Any

import numpy as np
from gymnasium import spaces
from gymnasium.spaces.utils import flatten_space
from gymnasium.vector import VectorEnv, VectorWrapper
from gymnasium.vector.utils import batch_space

from ...arrays import AnyArray, Array

Infos = dict[str, Any]


class FlattenBatch(VectorWrapper):  # with type parameters since Gymnasium 1.4 only
    """Concatenates the arrays of every world's observation to (B, D) numbers.

    The rows equal those of `gymnasium.wrappers.FlattenObservation`, keys in the order
    of the space. It copies each key once for all worlds, whereas
    `gymnasium.wrappers.vector.FlattenObservation` loops over the worlds in Python. It
    supports every autoreset mode and flattens `final_obs` too.

    Parameters
    ----------
    env : gymnasium.vector.VectorEnv
        Its observation is a flat ``Dict`` of ``Box`` and ``MultiBinary``.

    Raises
    ------
    ValueError
        For any other observation.

    Examples
    --------
    >>> import gymnasium, slamgym
    >>> worlds = gymnasium.make_vec("slamgym/LandmarkWorld-v0", 2)
    >>> flat = FlattenBatch(worlds)
    >>> flat.reset(seed=0)[0].shape  # 6 · 2 readings, 6 mask, 2 odometry
    (2, 20)
    """

    def __init__(self, env: VectorEnv[Any, Any, Any]) -> None:
        super().__init__(env)
        self._keys = _flat_keys(env.single_observation_space)
        flat = flatten_space(env.single_observation_space)
        self.single_observation_space = flat
        self.observation_space = batch_space(flat, env.num_envs)
        self._dtype = flat.dtype

    def reset(self, *, seed: Any = None, options: Any = None) -> tuple[Array, Infos]:
        """Start episodes in the wrapped environment."""
        observations, infos = self.env.reset(seed=seed, options=options)
        return self._flatten(observations), infos

    def step(
        self, actions: AnyArray
    ) -> tuple[Array, AnyArray, AnyArray, AnyArray, Infos]:
        """Take a step in every world."""
        observations, rewards, terminated, truncated, infos = self.env.step(actions)
        if "final_obs" in infos:
            infos["final_obs"] = self._flatten_final(infos["final_obs"])
        flat = self._flatten(observations)
        return flat, rewards, terminated, truncated, infos

    def _flatten(self, observations: dict[str, Any]) -> Array:
        parts = [
            np.reshape(observations[key], (self.num_envs, -1)) for key in self._keys
        ]
        return np.concatenate(parts, axis=1, dtype=self._dtype)

    def _flatten_final(self, final: AnyArray) -> AnyArray:
        flat = np.full_like(final, None)
        for world, last in enumerate(final):
            if last is not None:
                parts = [np.ravel(last[key]) for key in self._keys]
                flat[world] = np.concatenate(parts, dtype=self._dtype)
        return flat


def _flat_keys(space: spaces.Space[Any]) -> list[str]:
    if not isinstance(space, spaces.Dict):
        raise ValueError(f"env must have a Dict observation, got {space}")
    for key, part in space.items():
        if not isinstance(part, spaces.Box | spaces.MultiBinary):
            raise ValueError(
                f"env's observation must hold Box and MultiBinary alone, got {part} "
                f"for {key!r}"
            )
    return list(space)
