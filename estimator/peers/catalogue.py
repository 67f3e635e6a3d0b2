"""The estimators of other libraries, listed without importing these libraries."""

from importlib.util import find_spec
from typing import NamedTuple

EXTRA = "pip install 'slamgym[peers]'"


class Peer(NamedTuple):
    """An estimator of another library, of the optional extra ``peers``."""

    #: For :func:`~slamgym.estimator.make_estimator`.
    name: str
    #: Name of the package to import.
    library: str
    #: Its adapter, "module:Class".
    path: str
    description: str

    @property
    def installed(self) -> bool:
        """Whether Python finds the library."""
        return find_spec(self.library) is not None

    def refuse_missing(self) -> None:
        """Raise an error that says how to install the library, if it is missing."""
        if not self.installed:
            raise ValueError(
                f"estimator '{self.name}' needs {self.library}, which is not "
                f"installed: {EXTRA}"
            )


_ADAPTERS = {
    "gtsam_isam2": ("GtsamIsam2Slam", "GTSAM's incremental smoother iSAM2."),
    "gtsam_fixed_lag": (
        "GtsamFixedLagSlam",
        "GTSAM's incremental fixed-lag smoother; the landmarks stay in it.",
    ),
    "gtsam_batch": (
        "GtsamBatchSlam",
        "GTSAM's Levenberg-Marquardt over the whole drive after every scan.",
    ),
}
PEERS = {
    name: Peer(name, "gtsam", f"{__package__}.gtsam_graph:{adapter}", description)
    for name, (adapter, description) in _ADAPTERS.items()
}


def list_peers() -> tuple[Peer, ...]:
    """Return the estimators of other libraries, and whether each is installed.

    Examples
    --------
    >>> [peer.name for peer in list_peers()]
    ['gtsam_isam2', 'gtsam_fixed_lag', 'gtsam_batch']
    """
    return tuple(PEERS.values())
