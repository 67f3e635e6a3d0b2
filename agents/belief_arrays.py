"""Beliefs as arrays of a fixed size, for one world or many."""

from typing import NamedTuple

import numpy as np

from ..arrays import AnyArray, Array, BoolArray
from ..estimator.filters.batch import BatchSlam
from ..estimator.filters.batch_results import BatchStorage
from .estimator_choice import BeliefOfMap


class BeliefArrays(NamedTuple):
    """Beliefs of B worlds over a pose and N landmarks; row i is landmark i.

    The state is (x, y, θ, l0x, l0y, l1x, …).
    """

    means: Array
    """Shape (B, 3 + 2N), zeros where a landmark is not mapped; θ in [-π, π)."""
    covariances: Array
    """Of the additive error, shape (B, 3 + 2N, 3 + 2N), zeros where not mapped."""
    mapped: BoolArray
    """Landmarks in the map, shape (B, N)."""

    @property
    def poses(self) -> Array:
        """(x, y, θ), shape (B, 3) [m, m, rad]."""
        return self.means[:, :3]

    @property
    def landmarks(self) -> Array:
        """Positions, shape (B, N, 2) [m], zeros where not mapped."""
        return self.means[:, 3:].reshape(len(self.means), -1, 2)

    @property
    def landmark_covariances(self) -> Array:
        """Marginal covariance of each landmark, shape (B, N, 2, 2) [m²]."""
        count = self.mapped.shape[1]
        blocks = self.covariances[:, 3:, 3:].reshape(-1, count, 2, count, 2)
        each = np.arange(count)
        return np.moveaxis(blocks[:, each, :, each, :], 0, 1)


def as_storage(beliefs: BeliefArrays) -> BatchStorage:
    """Convert beliefs to the storage format of a batch of filters."""
    rows = np.arange(beliefs.mapped.shape[1])
    return BatchStorage.of(
        np.ascontiguousarray(beliefs.means),
        np.ascontiguousarray(beliefs.covariances),
        np.where(beliefs.mapped, rows, -1),
    )


def beliefs_of_batch(batch: BatchSlam) -> BeliefArrays:
    """Return the beliefs of a batch of filters."""
    return BeliefArrays(*batch.beliefs())


def belief_arrays(belief: BeliefOfMap, size: int, *, by_id: bool) -> BeliefArrays:
    """Convert the belief of one world to arrays of a fixed size; B = 1.

    Parameters
    ----------
    belief : Belief
        Of any estimator.
    size : int
        N, the number of landmark rows.
    by_id : bool
        If True, row i is the landmark with identity i. Else the rows are in the order
        of the map, for estimators that assign their own identities.

    Raises
    ------
    ValueError
        If the map holds more landmarks than there are rows.

    Examples
    --------
    >>> from slamgym.estimator import EkfSlam
    >>> slam = EkfSlam((0.1, 0.1, 0.1), (0.1, 0.1))
    >>> _ = slam.update([(0.0, 2.0)], landmark_ids=[1])
    >>> rows = belief_arrays(slam.belief(), size=3, by_id=True)
    >>> rows.mapped.tolist(), rows.landmarks[0, 1].tolist()
    ([[False, True, False]], [2.0, 0.0])
    """
    ids = belief.landmark_ids
    at = list(ids) if by_id else list(range(len(ids)))
    if at and not (min(at) >= 0 and max(at) < size):
        what = f"identity {max(at)}" if by_id else f"{len(at)} landmarks"
        raise ValueError(
            f"max_landmarks must leave room for the whole map, got {size} rows for a "
            f"map with {what}"
        )
    state = [0, 1, 2, *(3 + 2 * row + axis for row in at for axis in (0, 1))]
    means = np.zeros((1, 3 + 2 * size))
    covariances = np.zeros((1, 3 + 2 * size, 3 + 2 * size))
    mapped = np.zeros((1, size), dtype=np.bool_)
    means[0, state[:3]] = belief.pose
    means[0, state[3:]] = np.ravel(belief.landmarks)
    covariances[0, np.array(state)[:, None], state] = belief.covariance
    mapped[0, at] = True
    return BeliefArrays(means, covariances, mapped)


def update_filters(
    filters: BatchSlam,
    observations: dict[str, AnyArray],
    worlds: BoolArray,
    *,
    moved: bool,
) -> None:
    """Update the filters of some worlds with one observation each.

    Parameters
    ----------
    filters : BatchSlam
        One filter for each of B worlds.
    observations : dict
        The batched observation of a landmark world, each key with a leading axis B.
    worlds : bool ndarray, shape (B,)
        Worlds whose filters are updated.
    moved : bool
        Whether the worlds have moved. False for the scan from the start.

    Raises
    ------
    numpy.linalg.LinAlgError
        If a filter fails; the message names its world.
    """
    filters.run(
        observations["odometry"][:, None],
        observations["landmarks"][:, None],
        observations["mask"][:, None],
        float(moved),
        runs=worlds,
    )
    failed = filters.failed_at >= 0
    if failed.any():
        raise np.linalg.LinAlgError(
            f"the filter of world {int(np.argmax(failed))} has failed: its belief or "
            "measurement_std is degenerate, or its observation is not finite"
        )
