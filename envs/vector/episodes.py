"""Gymnasium's rules for the episodes of vector environments: seeds, masks, infos."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from ...arrays import BoolArray
from ...sim_configs import Scenario

Infos = dict[str, Any]


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
        raise ValueError(f"options may hold 'reset_mask' alone, got {sorted(unknown)}")
    mask = options["reset_mask"]
    if not isinstance(mask, np.ndarray) or mask.dtype != np.bool_:
        raise TypeError(f"reset_mask must be a bool ndarray, got {mask!r}")
    if mask.shape != (count,) or not mask.any():
        raise ValueError(
            f"reset_mask must have shape ({count},) and be True somewhere, got {mask!r}"
        )
    return mask


def with_masks(infos: Infos, worlds: BoolArray | None, count: int) -> Infos:
    """Add to each key the mask ``_key`` of the worlds that have the info (None: all).

    The values of the other worlds are zeros, as in Gymnasium's own vector environments.

    Examples
    --------
    >>> with_masks({"collision": np.array([True, True])}, np.array([True, False]), 2)
    {'collision': array([ True, False]), '_collision': array([ True, False])}
    """
    masked = {}
    masks = np.ones((len(infos), count), dtype=np.bool_)
    for row, (key, value) in enumerate(infos.items()):
        if worlds is None:
            masked[key], masked[f"_{key}"] = value, masks[row]
        else:
            chosen = np.zeros_like(value)
            chosen[worlds] = value[worlds]
            masked[key], masked[f"_{key}"] = chosen, worlds.copy()
    return masked


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
    count = len(ended)
    last = np.full(count, None, dtype=object)
    for world in np.flatnonzero(ended):
        last[world] = {key: value[world].copy() for key, value in observations.items()}
    return {
        "final_obs": last,
        "_final_obs": ended.copy(),
        "final_info": with_masks(infos, ended, count),
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
    if isinstance(most, bool) or not isinstance(most, int) or most < 1:
        raise ValueError(f"max_episode_steps must be a whole number >= 1, got {most!r}")
    return min(most, scenario.steps)
