"""Vector environments as Stable-Baselines3 takes them.

Stable-Baselines3 is imported by the first call alone: it is no requirement of slamgym.
"""

import importlib
from collections.abc import Iterable, Sequence
from functools import cache
from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv, VectorWrapper
from numpy.typing import NDArray

Info = dict[str, Any]


def to_stable_baselines(worlds: VectorEnv[Any, Any, Any]) -> Any:
    """Wrap a vector environment as a ``VecEnv`` of Stable-Baselines3.

    Unlike ``DummyVecEnv`` it steps all worlds in one call. What Stable-Baselines3
    expects of episodes holds: a world that ends begins anew in the same step, and its
    info holds the last observation as ``"terminal_observation"``, and
    ``"TimeLimit.truncated"``.

    Parameters
    ----------
    worlds : gymnasium.vector.VectorEnv
        With ``autoreset_mode=AutoresetMode.SAME_STEP``. Worlds are not objects of their
        own in it: `get_attr` and `env_method` go to the vector environment, and hand a
        tuple or an array with one item per world out one by one, all else to each.

    Returns
    -------
    stable_baselines3.common.vec_env.VecEnv

    Raises
    ------
    ImportError
        If Stable-Baselines3 is not installed.
    ValueError
        If the autoreset mode is another.

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


def _vec_env_module() -> Any:
    try:
        return importlib.import_module("stable_baselines3.common.vec_env")
    except ImportError as error:
        raise ImportError(
            "to_stable_baselines needs Stable-Baselines3: pip install stable-baselines3"
        ) from error


@cache
def _adapter_class() -> Any:  # noqa: C901 (the methods that VecEnv asks for)
    vec_env = _vec_env_module()

    class StableBaselinesWorlds(vec_env.VecEnv):  # type: ignore[misc, name-defined]
        """A vector environment in the words of Stable-Baselines3."""

        def __init__(self, worlds: VectorEnv[Any, Any, Any]) -> None:
            self.worlds = worlds
            super().__init__(
                worlds.num_envs,
                worlds.single_observation_space,
                worlds.single_action_space,
            )
            self.metadata = worlds.metadata
            self._actions: NDArray[Any] | None = None

        def reset(self) -> Any:
            """Begin an episode in every world, seeded as `seed` was told."""
            seeds, options = self._seeds, _common(self._options)
            observations, infos = self.worlds.reset(seed=seeds, options=options)
            self.reset_infos = _tell([{} for _ in seeds], infos)
            self._reset_seeds()
            self._reset_options()
            return observations

        def step_async(self, actions: NDArray[Any]) -> None:
            """Keep the actions for `step_wait`."""
            self._actions = actions

        def step_wait(self) -> tuple[Any, NDArray[Any], NDArray[Any], list[Info]]:
            """Take the step."""
            observations, rewards, terminated, truncated, infos = self.worlds.step(
                self._actions
            )
            cut = (truncated & ~terminated).tolist()
            each = _tell([{"TimeLimit.truncated": ends} for ends in cut], infos)
            dones = terminated | truncated
            if np.count_nonzero(dones):
                self._end(each, np.flatnonzero(dones).tolist())
            return observations, rewards.astype(np.float32), dones, each

        def _end(self, each: list[Info], ended: list[int]) -> None:
            """Tell in the infos of ended worlds how they ended, not how they begin."""
            for world in ended:
                final = each[world].pop("final_info")
                last = each[world].pop("final_obs")
                self.reset_infos[world] = {key: each[world][key] for key in final}
                each[world].update(final, terminal_observation=last)

        def close(self) -> None:
            """Close the worlds."""
            self.worlds.close()

        def get_images(self) -> Sequence[NDArray[np.uint8] | None]:
            """Return a frame of every world, None where there are none."""
            frames: Any = self.worlds.render()
            return [None] * self.num_envs if frames is None else list(frames)

        def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
            """Return an attribute for each of the worlds named."""
            return self._hand_out(self.worlds.__getattribute__(attr_name), indices)

        def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
            """Set an attribute of the vector environment, for all worlds alike."""
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
            return self._hand_out(result, indices)

        def env_is_wrapped(self, wrapper_class: Any, indices: Any = None) -> list[bool]:
            """Tell whether the vector environment is wrapped so."""
            wrapped = any(
                isinstance(env, wrapper_class) for env in _layers(self.worlds)
            )
            return [wrapped for _ in self._get_indices(indices)]

        def _hand_out(self, value: Any, indices: Any) -> list[Any]:
            own = isinstance(value, tuple | np.ndarray) and len(value) == self.num_envs
            return [value[i] if own else value for i in self._get_indices(indices)]

    return StableBaselinesWorlds


def _layers(env: Any) -> Iterable[Any]:
    while isinstance(env, VectorWrapper):
        yield env
        env = env.env
    yield env


def _tell(each: list[Info], infos: Info) -> list[Info]:
    """Split infos, batched as Gymnasium does, and add them to one dict per world."""
    for key, value in infos.items():
        if key[0] == "_" and key[1:] in infos:
            continue  # the mask of another
        items, told = _items(value, len(each)), infos.get(f"_{key}")
        if told is None or np.count_nonzero(told) == len(each):
            for info, item in zip(each, items, strict=True):
                info[key] = item
        else:
            for world in np.flatnonzero(told).tolist():
                each[world][key] = items[world]
    return each


def _items(value: Any, count: int) -> list[Any]:
    """List what each world has of one info."""
    if isinstance(value, dict):
        return _tell([{} for _ in range(count)], value)
    if isinstance(value, np.ndarray) and value.ndim == 1:
        numbers: list[Any] = value.tolist()
        return numbers
    return list(value)


def _common(options: list[Info]) -> Info | None:
    if any(each != options[0] for each in options):
        raise ValueError("options must be the same for all worlds")
    return options[0] or None
