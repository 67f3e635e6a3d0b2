"""Optimality criteria of a belief, and a reward for the gain of information.

The theory of experimental design measures a covariance P by one number:

=====  ==============================  =========================================
D      ½ log det P [nats]              entropy up to a constant
A      trace P [m²]                    mean squared error
E      largest eigenvalue of P [m²]    error in the worst direction
=====  ==============================  =========================================

A map grows, so beliefs of different sizes have to be compared. Every unmapped landmark
has a prior, a variance of ``prior_std``² for each coordinate, uncorrelated with all
other states. So P has a fixed size, and the decreases of a criterion over an episode
add up to its first value minus its last.
"""

from __future__ import annotations

import math
from typing import Any, SupportsFloat

import gymnasium
import numpy as np
from gymnasium.utils import RecordConstructorArgs
from numpy.typing import ArrayLike

from ..arrays import Array
from ..envs.vector.wrappers import layers
from ..estimator.filters.batch import BatchBeliefs
from ..sim_configs import Scenario
from ..sim_configs.field_types import unknown_choice
from .belief_features import world_bounds
from .belief_observation import BeliefObservation


def d_optimality(covariance: ArrayLike) -> Array:
    """Compute ½ log det P of covariances, (…, n, n) to (…) [nats]; -inf if singular.

    Examples
    --------
    >>> float(d_optimality(np.diag([np.e**2, np.e**4])))
    3.0
    """
    sign, log_det = np.linalg.slogdet(np.asarray(covariance, dtype=np.float64))
    return np.asarray(np.where(sign > 0, 0.5 * log_det, -np.inf))


def a_optimality(covariance: ArrayLike) -> Array:
    """Compute trace P of covariances, (…, n, n) to (…).

    Examples
    --------
    >>> float(a_optimality(np.diag([1.0, 2.0])))
    3.0
    """
    matrices = np.asarray(covariance, dtype=np.float64)
    return np.asarray(np.trace(matrices, axis1=-2, axis2=-1))


def e_optimality(covariance: ArrayLike) -> Array:
    """Compute the largest eigenvalue of covariances, (…, n, n) to (…).

    Examples
    --------
    >>> float(e_optimality([[2.0, 1.0], [1.0, 2.0]]))
    3.0
    """
    matrices = np.asarray(covariance, dtype=np.float64)
    return np.asarray(np.linalg.eigvalsh(matrices)[..., -1])


CRITERIA = {"D": d_optimality, "A": a_optimality, "E": e_optimality}


def check_criterion(criterion: str) -> None:
    """Raise a `ValueError` if there is no such criterion."""
    if criterion not in CRITERIA:
        raise ValueError(unknown_choice("criterion", criterion, CRITERIA))


def map_covariances(beliefs: BatchBeliefs, prior_std: ArrayLike) -> Array:
    """Return the joint covariance of all landmarks, mapped or not.

    Parameters
    ----------
    beliefs : BatchBeliefs
        Of B worlds with N landmarks.
    prior_std : float or array_like, shape (2,)
        Of the coordinates of an unmapped landmark [m].

    Returns
    -------
    ndarray, shape (B, 2N, 2N)
    """
    prior = np.broadcast_to(np.asarray(prior_std, dtype=np.float64), (2,)) ** 2
    joint = beliefs.covariances[:, 3:, 3:].copy()
    unmapped = np.repeat(~beliefs.mapped, 2, axis=1)
    diagonal = np.arange(joint.shape[-1])
    joint[:, diagonal, diagonal] += unmapped * np.tile(prior, beliefs.mapped.shape[1])
    return joint


def uncertainty(beliefs: BatchBeliefs, criterion: str, prior_std: ArrayLike) -> Array:
    """Compute the uncertainty of maps.

    Parameters
    ----------
    beliefs : BatchBeliefs
        Of B worlds with N landmarks.
    criterion : {"D", "A", "E"}
        D and A are divided by N, the number of landmarks.
    prior_std : float or array_like, shape (2,)
        Of the coordinates of an unmapped landmark [m].

    Returns
    -------
    ndarray, shape (B,)
        Its decrease from one belief to the next is the information gain.

    Raises
    ------
    ValueError
        If the criterion is unknown.
    """
    check_criterion(criterion)
    measured = CRITERIA[criterion](map_covariances(beliefs, prior_std))
    return measured if criterion == "E" else measured / beliefs.mapped.shape[1]


def effort(actions: ArrayLike, limits: ArrayLike) -> Array:
    """Compute the effort of actions, (…, 2) to (…): 0 at rest, 1 at both limits.

    ::

        ½ (v / v_max)² + ½ (ω / ω_max)²,    each within its limit

    Examples
    --------
    >>> effort([[0.0, 0.0], [1.0, 0.0], [9.0, 9.0]], limits=(1.0, 2.0)).tolist()
    [0.0, 0.5, 1.0]
    """
    bounded = np.minimum(np.abs(np.asarray(actions, float)) / np.asarray(limits), 1.0)
    return np.asarray(0.5 * (bounded[..., 0] ** 2 + bounded[..., 1] ** 2))


def landmark_prior_std(scenario: Scenario) -> tuple[float, float]:
    """Return the σ of a landmark uniform in the world: side / √12 [m].

    Examples
    --------
    >>> from slamgym.sim_configs import load_scenario
    >>> [round(std, 2) for std in landmark_prior_std(load_scenario("corridor"))]
    [4.16, 4.16]
    """
    left, bottom, right, top = world_bounds(scenario)
    return (right - left) / 12**0.5, (top - bottom) / 12**0.5


class InformationReward(gymnasium.Wrapper[Any, Any, Any, Any], RecordConstructorArgs):
    """Rewards information gain, with costs of collisions and effort.

    ::

        reward += gain - collision_cost [collision] - effort_cost effort(action)

    where the gain is the decrease of `uncertainty` in this step. The first scan, in
    `reset`, has no reward.

    Parameters
    ----------
    env : Env
        With a `BeliefObservation` among its wrappers.
    criterion : {"D", "A", "E"}
        See `uncertainty`.
    prior_std : float, optional
        Of the coordinates of an unmapped landmark [m]. The default is that of a
        landmark uniform in the world.
    gain : float
        Factor of the gain.
    collision_cost, effort_cost : float
        Cost of a collision, and of an `effort` of 1.

    Examples
    --------
    >>> import gymnasium, slamgym
    >>> from slamgym.agents import BeliefObservation
    >>> env = gymnasium.make("slamgym/LandmarkWorld-v0", sensor={"max_range": 9.0})
    >>> env = InformationReward(BeliefObservation(env, "ekf"), effort_cost=0.1)
    >>> _ = env.reset(seed=0)
    >>> rewards = [env.step([1.0, 0.0])[1] for _ in range(3)]  # one comes into view
    >>> [reward > 1.0 for reward in rewards]
    [False, True, False]
    """

    def __init__(
        self,
        env: gymnasium.Env[Any, Any],
        criterion: str = "D",
        prior_std: float | None = None,
        *,
        gain: float = 1.0,
        collision_cost: float = 0.0,
        effort_cost: float = 0.0,
    ) -> None:
        factors: dict[str, Any] = {
            "gain": gain,
            "collision_cost": collision_cost,
            "effort_cost": effort_cost,
        }
        RecordConstructorArgs.__init__(
            self, criterion=criterion, prior_std=prior_std, **factors
        )
        super().__init__(env)
        check_criterion(criterion)
        if not any(isinstance(layer, BeliefObservation) for layer in layers(env)):
            raise ValueError(
                "env must have a BeliefObservation among its wrappers, got "
                f"{type(env).__name__}"
            )
        for name, value in factors.items():
            if not 0 <= value < math.inf:
                raise ValueError(f"{name} must be finite and >= 0, got {value!r}")
        if prior_std is not None and not 0 < prior_std < math.inf:
            raise ValueError(f"prior_std must be finite and > 0, got {prior_std!r}")
        scenario = env.get_wrapper_attr("scenario")
        self._criterion = criterion
        self._prior_std: ArrayLike = (
            landmark_prior_std(scenario) if prior_std is None else prior_std
        )
        self._factors = gain, collision_cost, effort_cost
        self._limits = scenario.robot.max_speed, scenario.robot.max_turn_rate
        self._uncertainty = 0.0

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Start an episode, and compute the uncertainty of its first belief."""
        observation, info = self.env.reset(seed=seed, options=options)
        self._uncertainty = self._measure()
        return observation, info

    def step(
        self, action: Any
    ) -> tuple[Any, SupportsFloat, bool, bool, dict[str, Any]]:
        """Take a step, and add the information gain to the reward."""
        observation, reward, terminated, truncated, info = self.env.step(action)
        before, self._uncertainty = self._uncertainty, self._measure()
        gain, collision_cost, effort_cost = self._factors
        total = float(reward) + gain * (before - self._uncertainty)
        total -= collision_cost * bool(info["collision"])
        total -= effort_cost * float(effort(action, self._limits))
        return observation, total, terminated, truncated, info

    def _measure(self) -> float:
        beliefs = self.env.get_wrapper_attr("beliefs")
        return float(uncertainty(beliefs, self._criterion, self._prior_std)[0])
