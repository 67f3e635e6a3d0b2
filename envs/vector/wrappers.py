"""Wrappers of vector environments that process the whole batch at once.

`to_stable_baselines` converts a vector environment to the interface of
Stable-Baselines3, which its first call imports and slamgym does not require.
`FlattenBatch` flattens observations.
"""

import importlib
from collections.abc import Callable, Iterable, Sequence
from functools import cache
from typing import Any

import numpy as np
from gymnasium import Wrapper, spaces
from gymnasium.spaces.utils import flatten_space
from gymnasium.vector import AutoresetMode, VectorEnv, VectorWrapper
from gymnasium.vector.utils import batch_space

from ...arrays import AnyArray, Array, ImageArray

Info = dict[str, Any]


def to_stable_baselines(worlds: VectorEnv[Any, Any, Any]) -> Any:
    """Wrap a vector environment as a ``VecEnv`` of Stable-Baselines3.

    Unlike ``DummyVecEnv`` it steps all worlds in one call. As Stable-Baselines3
    expects, a world whose episode ends starts a new one in the same step. Its info then
    has the last observation as ``"terminal_observation"``, and
    ``"TimeLimit.truncated"``.

    Parameters
    ----------
    worlds : gymnasium.vector.VectorEnv
        With ``autoreset_mode=AutoresetMode.SAME_STEP``. `get_attr` and `env_method` use
        the vector environment itself. They distribute a tuple or an array with one item
        per world to the worlds, and repeat any other value for each world.

    Returns
    -------
    stable_baselines3.common.vec_env.VecEnv

    Raises
    ------
    ImportError
        If Stable-Baselines3 is not installed.
    ValueError
        For any other autoreset mode.

    Examples
    --------
    >>> import gymnasium, slamgym
    >>> worlds = gymnasium.make_vec(
    ...     "slamgym/LandmarkWorld-v0", 64, autoreset_mode="SameStep"
    ... )
    >>> from stable_baselines3 import PPO  # doctest: +SKIP
    >>> PPO("MultiInputPolicy", to_stable_baselines(worlds))  # doctest: +SKIP
    """
    mode = worlds.metadata.get("autoreset_mode")
    if mode != AutoresetMode.SAME_STEP:
        raise ValueError(
            f"worlds must have autoreset_mode=AutoresetMode.SAME_STEP, got {mode}"
        )
    return _adapter_class()(worlds)


@cache
def _adapter_class() -> Any:
    try:
        vec_env: Any = importlib.import_module("stable_baselines3.common.vec_env")
    except ImportError as error:
        raise ImportError(
            "to_stable_baselines needs Stable-Baselines3: pip install stable-baselines3"
        ) from error

    class StableBaselinesWorlds(_Adapter, vec_env.VecEnv):  # type: ignore[misc]
        """A vector environment of Gymnasium as a ``VecEnv``."""

    return StableBaselinesWorlds


class _Adapter:
    """The methods of ``VecEnv``, which is the next class in the method order."""

    num_envs: int
    _seeds: Any  # list of int or None
    _options: list[Info]
    _get_indices: Callable[[Any], Iterable[int]]
    _reset_seeds: Callable[[], None]
    _reset_options: Callable[[], None]

    def __init__(self, worlds: VectorEnv[Any, Any, Any]) -> None:
        self.worlds = worlds
        super().__init__(  # type: ignore[call-arg]
            worlds.num_envs, worlds.single_observation_space, worlds.single_action_space
        )
        self.metadata = worlds.metadata
        self._actions: AnyArray | None = None

    def reset(self) -> Any:
        """Start an episode in every world, with the seeds given to `seed`."""
        seeds, options = self._seeds, _common(self._options)
        observations, infos = self.worlds.reset(seed=seeds, options=options)
        self.reset_infos = _split([{} for _ in seeds], infos)
        self._reset_seeds()
        self._reset_options()
        return observations

    def step_async(self, actions: AnyArray) -> None:
        """Store the actions for `step_wait`."""
        self._actions = actions

    def step_wait(self) -> tuple[Any, AnyArray, AnyArray, list[Info]]:
        """Take the step."""
        observations, rewards, terminated, truncated, infos = self.worlds.step(
            self._actions
        )
        cut = (truncated & ~terminated).tolist()
        each = _split([{"TimeLimit.truncated": ends} for ends in cut], infos)
        dones = terminated | truncated
        if np.count_nonzero(dones):
            self._end(each, np.flatnonzero(dones).tolist())
        return observations, rewards.astype(np.float32), dones, each

    def _end(self, each: list[Info], ended: list[int]) -> None:
        """Put the last infos of ended episodes in place of those of the new ones."""
        for world in ended:
            final = each[world].pop("final_info")
            last = each[world].pop("final_obs")
            self.reset_infos[world] = {key: each[world][key] for key in final}
            each[world].update(final, terminal_observation=last)

    def close(self) -> None:
        """Close the worlds."""
        self.worlds.close()

    def get_images(self) -> Sequence[ImageArray | None]:
        """Return a frame of every world, or None for each."""
        frames: Any = self.worlds.render()
        return [None] * self.num_envs if frames is None else list(frames)

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """Return an attribute for each of the chosen worlds."""
        return self._per_world(self.worlds.__getattribute__(attr_name), indices)

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Set an attribute of the vector environment, the same for all worlds."""
        if sorted(self._get_indices(indices)) != list(range(self.num_envs)):
            raise ValueError(f"indices must be all worlds, got {indices!r}")
        setattr(self.worlds, attr_name, value)

    def env_method(
        self,
        method_name: str,
        *method_args: Any,
        indices: Any = None,
        **method_kwargs: Any,
    ) -> list[Any]:
        """Call a method of the vector environment once."""
        result = getattr(self.worlds, method_name)(*method_args, **method_kwargs)
        return self._per_world(result, indices)

    def env_is_wrapped(self, wrapper_class: Any, indices: Any = None) -> list[bool]:
        """Return whether a wrapper of this class is around the vector environment."""
        wrapped = any(isinstance(env, wrapper_class) for env in layers(self.worlds))
        return [wrapped for _ in self._get_indices(indices)]

    def _per_world(self, value: Any, indices: Any) -> list[Any]:
        own = isinstance(value, tuple | np.ndarray) and len(value) == self.num_envs
        return [value[i] if own else value for i in self._get_indices(indices)]


def layers(env: Any) -> Iterable[Any]:
    """Yield an environment, or a vector of them, and what it wraps, layer by layer."""
    while isinstance(env, Wrapper | VectorWrapper):
        yield env
        env = env.env
    yield env


def _split(each: list[Info], infos: Info) -> list[Info]:
    """Split batched infos of Gymnasium, and add them to one dict per world."""
    for key, value in infos.items():
        if key[0] == "_" and key[1:] in infos:
            continue  # a mask of another key
        items, mask = _items(value, len(each)), infos.get(f"_{key}")
        if mask is None or np.count_nonzero(mask) == len(each):
            for info, item in zip(each, items, strict=True):
                info[key] = item
        else:
            for world in np.flatnonzero(mask).tolist():
                each[world][key] = items[world]
    return each


def _items(value: Any, count: int) -> list[Any]:
    """Return the values of one info, one per world."""
    if isinstance(value, dict):
        return _split([{} for _ in range(count)], value)
    if isinstance(value, np.ndarray) and value.ndim == 1:
        numbers: list[Any] = value.tolist()
        return numbers
    return list(value)


def _common(options: list[Info]) -> Info | None:
    if any(each != options[0] for each in options):
        raise ValueError("options must be the same for all worlds")
    return options[0] or None


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

    def reset(self, *, seed: Any = None, options: Any = None) -> tuple[Array, Info]:
        """Start episodes in the wrapped environment."""
        observations, infos = self.env.reset(seed=seed, options=options)
        return self._flatten(observations), infos

    def step(
        self, actions: AnyArray
    ) -> tuple[Array, AnyArray, AnyArray, AnyArray, Info]:
        """Take a step in every world."""
        observations, rewards, terminated, truncated, infos = self.env.step(actions)
        if "final_obs" in infos:
            infos["final_obs"] = self._flatten_final(infos["final_obs"])
        return self._flatten(observations), rewards, terminated, truncated, infos

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
