"""Where the present submap begins, from the submaps before it, one after the other."""

import numpy as np
from numpy.typing import NDArray

from .factor import compose

Array = NDArray[np.float64]


class Chain:
    """The frame of the present submap in the world, at no cost.

    The composition of what the submaps say of their last poses, from where the run
    began or from the last join on: with an honest covariance, which knows of no loop
    closed since.

    Parameters
    ----------
    pose, covariance : ndarray, shapes (3,) and (3, 3)
        Where the run began, in the world.
    """

    def __init__(self, pose: Array, covariance: Array) -> None:
        self.start = (pose.copy(), covariance.copy())
        self.pose, self.covariance = self.start
        self.joined = pose[None].copy()
        """Frames as of the last join, shape (J + 1, 3)."""

    def extend(self, pose: Array, covariance: Array) -> None:
        """Append a submap: its last pose (3,), and the covariance of its error."""
        self.pose, by_start, by_pose = compose(self.pose, pose)
        moved = by_start @ self.covariance @ by_start.T
        self.covariance = moved + by_pose @ covariance @ by_pose.T

    def rebase(self, joined: Array, pose: Array, covariance: Array) -> None:
        """Take over frames, and the last of them with its covariance."""
        self.joined = joined.copy()
        self.pose, self.covariance = pose.copy(), covariance.copy()

    def state_dict(self) -> dict[str, Array]:
        """Return copies of everything, as arrays."""
        return {
            "start": np.vstack(self.start),
            "present": np.vstack([self.pose, self.covariance]),
            "joined": self.joined.copy(),
        }

    @classmethod
    def restored(cls, state: dict[str, Array]) -> "Chain":
        """Make a chain from what :meth:`state_dict` returned."""
        chain = cls(state["start"][0], state["start"][1:])
        chain.rebase(state["joined"], state["present"][0], state["present"][1:])
        return chain
