"""Beliefs in the storage of a batch of filters, for one world or many."""

from collections.abc import Mapping

import numpy as np

from ..arrays import AnyArray, BoolArray
from ..estimator.filters.batch import BatchSlam, BatchStorage
from ..estimator.filters.ekf import EkfSlam
from .estimator_choice import BeliefOfMap


def belief_storage(belief: BeliefOfMap, size: int, *, by_id: bool) -> BatchStorage:
    """Store the belief of one world as a batch of filters does; B = 1.

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
    >>> storage = belief_storage(slam.belief(), size=3, by_id=True)
    >>> storage.slots.tolist(), storage.means[0, 3:5].tolist()
    ([[-1, 0, -1]], [2.0, 0.0])
    """
    ids = belief.landmark_ids
    rows = list(ids) if by_id else list(range(len(ids)))
    if rows and not (min(rows) >= 0 and max(rows) < size):
        what = f"identity {max(rows)}" if by_id else f"{len(rows)} landmarks"
        raise ValueError(
            f"max_landmarks must leave room for the whole map, got {size} rows for a "
            f"map with {what}"
        )
    capacity, used = 3 + 2 * size, 3 + 2 * len(rows)
    means, covariances = np.zeros((1, capacity)), np.zeros((1, capacity, capacity))
    slots = np.full((1, size), -1, dtype=np.int64)
    means[0, :3] = belief.pose
    means[0, 3:used] = np.ravel(belief.landmarks)
    covariances[0, :used, :used] = belief.covariance
    slots[0, rows] = np.arange(len(rows))
    return BatchStorage(means, covariances, slots)


def live_storage(estimator: EkfSlam, size: int) -> BatchStorage:
    """Return the arrays of a filter that can run in batches, without a copy; B = 1."""
    gaussian = estimator.map
    slots = np.full((1, size), -1, dtype=np.int64)
    for landmark, slot in gaussian.slots.items():
        slots[0, landmark] = slot
    return BatchStorage(gaussian.mean[None], gaussian.covariance[None], slots)


def update_batch(
    filters: BatchSlam,
    observations: Mapping[str, AnyArray],
    worlds: BoolArray,
    *,
    moved: BoolArray,
) -> None:
    """Update the filters of some worlds with one observation each.

    Parameters
    ----------
    filters : BatchSlam
        One filter for each of B worlds.
    observations : mapping
        The batched observation of a landmark world, each key with a leading axis B.
    worlds : bool ndarray, shape (B,)
        Worlds whose filters are updated.
    moved : bool ndarray, shape (B,)
        Which of them have moved; the others take the scan from their start.

    Raises
    ------
    numpy.linalg.LinAlgError
        If a filter fails; the message names its world.
    """
    filters.step(
        observations["odometry"],
        observations["landmarks"],
        observations["mask"],
        moved.astype(np.float64),
        runs=worlds,
    )
    failed = filters.failed_at >= 0
    if np.count_nonzero(failed):
        raise np.linalg.LinAlgError(
            f"the filter of world {int(np.argmax(failed))} has failed: its belief or "
            "measurement_std is degenerate, or its observation is not finite"
        )
