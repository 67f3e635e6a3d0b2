"""Many landmark worlds as one native vector environment of Gymnasium.

`LandmarkWorldVectorEnv` steps a batch of worlds. The functions below it apply
Gymnasium's rules for seeds, reset masks and infos of vector environments.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from gymnasium import logger
from gymnasium.envs.registration import EnvSpec
from gymnasium.error import ResetNeeded
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import ArrayLike

from ...arrays import AnyArray, Array, BoolArray, ImageArray
from ...restorable import Restorable, State, copied, put_back, refuse_other_state
from ...sim_configs import Scenario, load_scenario
from ...sim_configs.scenario import refuse_unknown_keywords
from ..landmark_world import OF_A_WORLD, LandmarkWorldEnv, refuse_other_world
from ..rendering.episode_renderer import EpisodeRenderer
from ..rendering.render_state import BeliefLike
from ..spaces import action_space, observation_space
from ..specs import plain_spec
from .world_batch import WorldBatch

Observations = dict[str, Any]
Infos = dict[str, Any]
#: Arguments besides the changes of a scenario.
KEYWORDS = "num_envs", "scenario", "render_mode", "max_episode_steps", "autoreset_mode"


class LandmarkWorldVectorEnv(Restorable, VectorEnv[Observations, AnyArray, AnyArray]):
    """B landmark worlds of one scenario, simulated together in numpy.

    After ``reset(seed=s)`` world i equals, to the bit, a `LandmarkWorldEnv` after
    ``reset(seed=s + i)``, in the first episode and in the following ones. Spaces,
    observations and infos are those of `LandmarkWorldEnv` with a leading world axis.
    ``gymnasium.make_vec("slamgym/LandmarkWorld-v0", B)`` makes this class.

    Parameters
    ----------
    num_envs : int, default 1
        B, the number of worlds.
    scenario : Scenario, mapping, str or Path, default "six_landmarks"
        As for `LandmarkWorldEnv`.
    render_mode : {"human", "rgb_array"}, optional
        "human" opens a window per world; with "rgb_array" `render` returns a frame of
        each.
    max_episode_steps : int, optional
        Truncates episodes earlier than the scenario's own number of steps.
    autoreset_mode : AutoresetMode or str, default ``AutoresetMode.NEXT_STEP``
        When a world whose episode has ended starts a new one: at the next step, in the
        same step (``infos["final_obs"]`` and ``infos["final_info"]`` then hold the end
        of the last one), or at ``reset(options={"reset_mask": …})``.
    **changes
        Fields of the scenario to replace, as in `Scenario.with_changes`.

    Examples
    --------
    >>> import gymnasium, slamgym
    >>> worlds = gymnasium.make_vec("slamgym/LandmarkWorld-v0", 3, scenario="corridor")
    >>> observations, infos = worlds.reset(seed=0)
    >>> observations["landmarks"].shape, infos["pose"].shape
    ((3, 28, 2), (3, 3))
    """

    changing: ClassVar[tuple[str, ...]] = ("_seeds", "_worlds", "_ended")
    _renderers: Sequence[EpisodeRenderer] = ()  # for close after a failed constructor
    _spec: EnvSpec | None = None

    def __init__(
        self,
        num_envs: int = 1,
        scenario: Scenario | Mapping[str, object] | str | Path = "six_landmarks",
        *,
        render_mode: str | None = None,
        max_episode_steps: int | None = None,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        **changes: object,
    ) -> None:
        if isinstance(num_envs, bool) or not isinstance(num_envs, int) or num_envs < 1:
            raise ValueError(f"num_envs must be an integer >= 1, got {num_envs!r}")
        refuse_unknown_keywords(changes, KEYWORDS, where=OF_A_WORLD)
        self.scenario = load_scenario(scenario).with_changes(**changes)
        self.num_envs = num_envs
        self.autoreset_mode = AutoresetMode(autoreset_mode)
        self.metadata = {
            **LandmarkWorldEnv.metadata,
            "autoreset_mode": self.autoreset_mode,
        }
        self.single_action_space = action_space(self.scenario)
        self.single_observation_space = observation_space(self.scenario)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.render_mode = render_mode
        if render_mode is not None:
            fps = float(self.metadata["render_fps"])
            self._renderers = [
                EpisodeRenderer(self.scenario, render_mode, fps)
                for _ in range(num_envs)
            ]
        self._steps = np.array(episode_steps(self.scenario, max_episode_steps))
        self._worlds = WorldBatch(self.scenario, num_envs)
        self._rngs: list[Any] = [None] * num_envs  # generators, once they are needed
        self._seeds: list[int] = [-1] * num_envs
        self._ended = np.zeros(num_envs, dtype=np.bool_)
        self._all = ~self._ended

    @property
    def spec(self) -> EnvSpec | None:
        """The specification it was made from, with the length of its episodes."""
        return self._spec

    @spec.setter
    def spec(self, spec: EnvSpec | None) -> None:
        self._spec = spec and plain_spec(spec, int(self._steps))

    def reset(
        self,
        *,
        seed: int | Sequence[int | None] | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[Observations, Infos]:
        """Start an episode in every world, or in those of a mask.

        Parameters
        ----------
        seed : int >= 0, or list of B of them, optional
            World i has the seed ``seed + i``, or item i of the list. None keeps the
            generators.
        options : dict, optional
            ``{"reset_mask": mask}``, bool ndarray of shape (B,), chooses worlds. The
            others do not change and have no info. These worlds share one scenario; for
            ``pose``, ``landmarks`` and ``scenario``, use ``vectorization_mode="sync"``.

        Raises
        ------
        ValueError, TypeError
            For other options, or an invalid mask or seed.
        gymnasium.error.ResetNeeded
            If a mask leaves out worlds that have never been reset.
        """
        mask = checked_reset_mask(options, self.num_envs)
        seeds = world_seeds(seed, self.num_envs)
        self._begin(np.ones(self.num_envs, np.bool_) if mask is None else mask, seeds)
        infos = self._infos()
        if mask is None:
            return self._observations(), with_masks(infos, self._all)
        return self._observations(), of_worlds(infos, mask)

    def step(
        self, actions: ArrayLike
    ) -> tuple[Observations, Array, BoolArray, BoolArray, Infos]:
        """Take one step in every world.

        Parameters
        ----------
        actions : array_like, shape (B, 2)
            Rows (v, ω) [m/s, rad/s].

        Raises
        ------
        ValueError
            If the actions are not B rows of two finite numbers. The worlds do not
            change.
        gymnasium.error.ResetNeeded
            Before `reset`. Without autoreset also for worlds that have ended.
        """
        resetting = self._ended
        moving, some_begin = self._all, np.count_nonzero(resetting) > 0
        if some_begin:
            moving = ~resetting
            self._refuse_without_autoreset(resetting)
            self._worlds.step(actions, moving, self._generators())
        else:
            self._worlds.step(actions)
        self._show(moving)
        if some_begin:
            self._note_begun(resetting)
        rewards, terminated = self._reward(actions, moving)
        ended, final = terminated | (self._worlds.steps >= self._steps), {}
        truncated = ended ^ terminated
        self._ended = ended
        if self.autoreset_mode == AutoresetMode.SAME_STEP and np.count_nonzero(ended):
            final = final_infos(self._observations(), self._infos(), ended)
            self._begin(ended)
        infos = final | with_masks(self._infos(), self._all)
        return self._observations(), rewards, terminated, truncated, infos

    def state(self) -> State:
        """Return the state of all worlds, for `restore`; see `LandmarkWorldEnv.state`.

        Examples
        --------
        >>> worlds = LandmarkWorldVectorEnv(2, "corridor")
        >>> observations, infos = worlds.reset(seed=0)
        >>> state = worlds.state()
        >>> first = worlds.step([[1.0, 0.2], [0.5, 0.0]])[0]
        >>> worlds.restore(state)
        >>> second = worlds.step([[1.0, 0.2], [0.5, 0.0]])[0]
        >>> all(np.array_equal(first[key], second[key]) for key in first)
        True
        """
        self._begun_worlds()
        own = self.scenario, *self._generators(), *self._renderers
        return (*super().state(), copied(own))

    def restore(self, state: State) -> None:
        """Return to a state of these worlds; see `LandmarkWorldEnv.restore`."""
        self._begun_worlds()
        own = *self._generators(), *self._renderers
        last: Any = state[-1] if isinstance(state, tuple) and state else None
        refuse_other_state(self, last, 1 + len(own))
        scenario, *given = last
        refuse_other_world(self.scenario, scenario)
        self.scenario = scenario  # the same object is compared faster
        super().restore(state[:-1])
        for part, value in zip(own, given, strict=True):
            put_back(part, value)

    def render(self) -> tuple[ImageArray, ...] | None:
        """Return a frame of each world in mode "rgb_array", else None."""
        self._begun_worlds()
        if not self._renderers:
            logger.warn("render shows nothing without a render_mode")
        if self.render_mode != "rgb_array":
            return None
        frames = (renderer.draw() for renderer in self._renderers)
        return tuple(frame for frame in frames if frame is not None)

    def show_beliefs(self, beliefs: Sequence[BeliefLike | None]) -> None:
        """Show belief i in the following frames of world i; None hides it.

        Raises
        ------
        ValueError
            If there is not one belief per world, and a window or frames.
        """
        if self._renderers and len(beliefs) != self.num_envs:
            raise ValueError(
                f"beliefs must be {self.num_envs}, one per world, got {len(beliefs)}"
            )
        for renderer, belief in zip(self._renderers, beliefs, strict=False):
            renderer.show_belief(belief)

    def close_extras(self, **kwargs: Any) -> None:
        """Close the windows, if there are any."""
        for renderer in self._renderers:
            renderer.close()

    @property
    def drawn_scenarios(self) -> list[Scenario]:
        """The scenario of each world, with what its episode drew from ranges."""
        return self._begun_worlds().scenarios

    @property
    def poses(self) -> Array:
        """True (x, y, θ) of the worlds, shape (B, 3) [m, m, rad], a copy."""
        return self._begun_worlds().poses.copy()

    @property
    def landmarks(self) -> Array:
        """True positions of the landmarks, shape (B, N, 2) [m], a copy."""
        return self._begun_worlds().landmarks

    @property
    def start_estimates(self) -> Array:
        """Start poses for filters, shape (B, 3) [m, m, rad], a copy."""
        return self._begun_worlds().start_estimates

    @property  # type: ignore[misc]
    def np_random(  # type: ignore[override]
        self,
    ) -> tuple[np.random.Generator, ...]:
        """The generator of each world."""
        return tuple(self._generators())

    @property
    def np_random_seed(self) -> tuple[int, ...]:  # type: ignore[override]
        """The seed of each world's generator."""
        self._generators()
        return tuple(self._seeds)

    def _generators(self) -> list[np.random.Generator]:
        """Return the generators; the machine's entropy seeds missing ones."""
        if None in self._rngs:
            for world, rng in enumerate(self._rngs):
                if rng is None:
                    self._rngs[world], self._seeds[world] = seeding.np_random()
        return self._rngs

    def _begin(self, worlds: BoolArray, seeds: Sequence[int | None] = ()) -> None:
        fresh = {
            world: seeding.np_random(seed)
            for world, seed in enumerate(seeds)
            if seed is not None and worlds[world]
        }
        for world, (rng, used) in fresh.items():
            self._rngs[world], self._seeds[world] = rng, used
        self._worlds.reset(self._generators(), worlds)
        self._note_begun(worlds)
        self._follow(worlds)

    def _note_begun(self, worlds: BoolArray) -> None:
        self._ended = self._ended & ~worlds
        if self._renderers:
            landmarks = self._worlds.landmarks
            for world in np.flatnonzero(worlds).tolist():
                self._renderers[world].begin(landmarks[world], self.scenario)
            self._show(worlds)

    def _show(self, worlds: BoolArray) -> None:
        """Show the present state of some worlds."""
        if not self._renderers:
            return
        batch = self._worlds
        for world in np.flatnonzero(worlds).tolist():
            mask, ids = batch.mask[world], batch.landmark_ids
            self._renderers[world].add(
                batch.poses[world].copy(),
                batch.measurements[world][mask],
                bool(batch.collisions[world]),
                None if ids is None else ids[world][mask] < 0,
            )

    def _reward(self, actions: ArrayLike, moving: BoolArray) -> tuple[Array, BoolArray]:
        """Return the rewards of a step, and which episodes it terminates.

        Worlds that do not move begin an episode.
        """
        return np.zeros(self.num_envs), np.zeros(self.num_envs, np.bool_)

    def _follow(self, worlds: BoolArray) -> None:
        """Do what else follows the start of episodes in some worlds."""

    def _seen(self) -> Observations:
        """Return the present observations; some may be those of the last step."""
        return self._worlds.observations

    def _observations(self) -> Observations:
        observations = self._seen()
        if self.autoreset_mode != AutoresetMode.DISABLED:
            return observations
        # a partial reset repeats them: the caller must not write into the originals
        return {key: value.copy() for key, value in observations.items()}

    def _infos(self) -> Infos:
        worlds = self._worlds
        infos: Infos = {"pose": worlds.poses, "collision": worlds.collisions}
        if worlds.landmark_ids is not None:
            infos["landmark_ids"] = worlds.landmark_ids
        if worlds.pose_readings is not None:
            infos |= worlds.pose_sensors.by_name(worlds.pose_readings)
        return infos | self._more_infos()

    def _more_infos(self) -> Infos:
        """Return what a subclass adds."""
        return {}

    def _begun_worlds(self) -> WorldBatch:
        if not self._worlds.begun:
            raise ResetNeeded("call reset first: there are no worlds yet")
        return self._worlds

    def _refuse_without_autoreset(self, ended: BoolArray) -> None:
        if self.autoreset_mode == AutoresetMode.DISABLED:
            raise ResetNeeded(
                f"worlds {np.flatnonzero(ended).tolist()} have ended: reset them first "
                '(options={"reset_mask": …})'
            )


def world_seeds(
    seed: int | Sequence[int | None] | None, count: int
) -> list[int | None]:
    """Return the seeds of the worlds as in Gymnasium: s, s + 1 and so on.

    Raises
    ------
    ValueError, TypeError
        If `seed` is neither None, an integer nor a list of `count` of them.

    Examples
    --------
    >>> world_seeds(7, 3)
    [7, 8, 9]
    """
    if seed is None:
        return [None] * count
    if isinstance(seed, int):
        return [seed + world for world in range(count)]
    if not isinstance(seed, list | tuple):
        raise TypeError(f"seed must be None, an int or a list of them, got {seed!r}")
    if len(seed) != count:
        raise ValueError(f"seed must be {count} seeds, one per world, got {len(seed)}")
    return list(seed)


def checked_reset_mask(options: dict[str, Any] | None, count: int) -> BoolArray | None:
    """Return the mask of worlds to reset from the options, None for all.

    Raises
    ------
    ValueError, TypeError
        If there is another option, or if the mask is not a bool ndarray of shape
        (count,) with a True element.
    """
    if not options:
        return None
    unknown = set(options) - {"reset_mask"}
    if unknown:
        raise ValueError(
            "options of worlds that share one scenario may hold 'reset_mask' alone, "
            f"got {sorted(unknown)}: worlds of gymnasium.make_vec with "
            "vectorization_mode='sync' take those of one world"
        )
    mask = options["reset_mask"]
    if not isinstance(mask, np.ndarray) or mask.dtype != np.bool_:
        raise TypeError(f"reset_mask must be a bool ndarray, got {mask!r}")
    if mask.shape != (count,) or not mask.any():
        raise ValueError(
            f"reset_mask must have shape ({count},) and be True somewhere, got {mask!r}"
        )
    return mask


def with_masks(infos: Infos, worlds: BoolArray) -> Infos:
    """Add to each key the mask ``_key`` of the worlds that have the info, a copy.

    Examples
    --------
    >>> with_masks({"collision": np.array([True, False])}, np.array([True, True]))
    {'collision': array([ True, False]), '_collision': array([ True,  True])}
    """
    return infos | {f"_{key}": worlds.copy() for key in infos}


def of_worlds(infos: Infos, worlds: BoolArray) -> Infos:
    """Return the infos of some worlds, with their masks.

    The values of the other worlds are zeros, as in Gymnasium's own vector environments.
    """
    chosen = {key: np.zeros_like(value) for key, value in infos.items()}
    for key, value in infos.items():
        chosen[key][worlds] = value[worlds]
    return with_masks(chosen, worlds)


def final_infos(observations: Infos, infos: Infos, ended: BoolArray) -> Infos:
    """Return ``final_obs`` and ``final_info`` of the worlds whose episodes ended.

    Parameters
    ----------
    observations, infos : dict of ndarray
        Those of all worlds, with the worlds along the first axis.
    ended : bool ndarray, shape (B,)

    Returns
    -------
    dict
        In the form of Gymnasium's same-step mode.
    """
    last = np.full(len(ended), None, dtype=object)
    for world in np.flatnonzero(ended):
        last[world] = {key: value[world].copy() for key, value in observations.items()}
    return {
        "final_obs": last,
        "_final_obs": ended.copy(),
        "final_info": of_worlds(infos, ended),
        "_final_info": ended.copy(),
    }


def episode_steps(scenario: Scenario, most: int | None) -> int:
    """Return the number of steps of an episode, at most ``max_episode_steps``.

    Raises
    ------
    ValueError
        If ``max_episode_steps`` is not a whole number >= 1.
    """
    if most is None or most == -1:  # Gymnasium's value for no limit
        return scenario.steps
    if isinstance(most, bool) or not isinstance(most, int | np.integer) or most < 1:
        raise ValueError(f"max_episode_steps must be a whole number >= 1, got {most!r}")
    return int(min(most, scenario.steps))
