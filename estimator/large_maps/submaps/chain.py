"""Frame of the active submap, by composition of the submaps before it."""

import numpy as np

from ....arrays import Array
from ...models.rigid_motion import compose


class Chain:
    """The frame of the active submap in the world, without a join.

    The frame is the composition of the last poses of all submaps since the start of the
    run or the last join.  Its covariance is consistent, but does not account for loops
    closed since then.

    Parameters
    ----------
    pose, covariance : ndarray, shapes (3,) and (3, 3)
        Start of the run in the world.
    """

    def __init__(self, pose: Array, covariance: Array) -> None:
        self.start = (pose.copy(), covariance.copy())
        self.pose, self.covariance = self.start
        self.joined = pose[None].copy()
        """Frames of the last join, shape (J + 1, 3)."""

    def extend(self, pose: Array, covariance: Array) -> None:
        """Append a submap by its last pose, shape (3,), and that pose's covariance."""
        self.pose, by_start, by_pose = compose(self.pose, pose)
        moved = by_start @ self.covariance @ by_start.T
        self.covariance = moved + by_pose @ covariance @ by_pose.T

    def rebase(self, joined: Array, pose: Array, covariance: Array) -> None:
        """Replace the frames, and the last of them with its covariance."""
        self.joined = joined.copy()
        self.pose, self.covariance = pose.copy(), covariance.copy()

    def state_dict(self) -> dict[str, Array]:
        """Return copies of the whole state, as arrays."""
        return {
            "start": np.vstack(self.start),
            "present": np.vstack([self.pose, self.covariance]),
            "joined": self.joined.copy(),
        }

    @classmethod
    def restored(cls, state: dict[str, Array]) -> "Chain":
        """Return the chain that :meth:`state_dict` saved."""
        chain = cls(state["start"][0], state["start"][1:])
        chain.rebase(state["joined"], state["present"][0], state["present"][1:])
        return chain
