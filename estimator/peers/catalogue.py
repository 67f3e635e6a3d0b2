"""The estimators of other libraries, listed without importing these libraries."""

from importlib.util import find_spec
from typing import NamedTuple

EXTRA = "pip install 'slamgym[peers]'"


class Peer(NamedTuple):
    """An estimator of another library, of the optional extra ``peers``."""

    name: str
    """For :func:`~slamgym.estimator.make_estimator`."""
    library: str
    """Name of the package to import."""
    path: str
    """Its adapter, "module:Class"."""
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


_GTSAM = f"{__package__}.gtsam_graph"
_FILTERPY = f"{__package__}.filterpy_kalman"
_STONESOUP = f"{__package__}.stonesoup_kalman"

PEERS = {
    peer.name: peer
    for peer in (
        Peer(
            "gtsam_isam2",
            "gtsam",
            f"{_GTSAM}:GtsamIsam2Slam",
            "GTSAM's incremental smoother iSAM2.",
        ),
        Peer(
            "gtsam_fixed_lag",
            "gtsam",
            f"{_GTSAM}:GtsamFixedLagSlam",
            "GTSAM's incremental fixed-lag smoother; the landmarks stay in it.",
        ),
        Peer(
            "gtsam_batch",
            "gtsam",
            f"{_GTSAM}:GtsamBatchSlam",
            "GTSAM's Levenberg-Marquardt over the whole drive after every scan.",
        ),
        Peer(
            "filterpy_ekf",
            "filterpy",
            f"{_FILTERPY}:FilterpyEkfSlam",
            "filterpy's extended Kalman filter over pose and map.",
        ),
        Peer(
            "filterpy_ukf",
            "filterpy",
            f"{_FILTERPY}:FilterpyUkfSlam",
            "filterpy's unscented Kalman filter over pose and map.",
        ),
        Peer(
            "stonesoup_ekf",
            "stonesoup",
            f"{_STONESOUP}:StoneSoupEkfSlam",
            "Stone Soup's extended Kalman predictor and updater over pose and map.",
        ),
        Peer(
            "stonesoup_ukf",
            "stonesoup",
            f"{_STONESOUP}:StoneSoupUkfSlam",
            "Stone Soup's unscented Kalman predictor and updater over pose and map.",
        ),
    )
}


def list_peers() -> tuple[Peer, ...]:
    """Return the estimators of other libraries, and whether each is installed.

    Examples
    --------
    >>> [peer.name for peer in list_peers() if peer.library == "gtsam"]
    ['gtsam_isam2', 'gtsam_fixed_lag', 'gtsam_batch']
    """
    return tuple(PEERS.values())
