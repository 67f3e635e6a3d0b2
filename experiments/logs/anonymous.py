"""Logs whose readings have no identity."""

from dataclasses import replace

from ...arrays import IntArray
from .events import Scan
from .slamlog import SlamLog


def without_identities(log: SlamLog) -> SlamLog:
    """Hide the identities of a log's readings, and keep them as true ids for scores.

    Parameters
    ----------
    log : SlamLog
        A log; scans without identities stay as they are.

    Examples
    --------
    >>> scan = Scan(0.0, [(0.1, 5.0)], landmark_ids=[4])
    >>> (hidden,) = without_identities(SlamLog("drive", events=(scan,))).events
    >>> hidden.landmark_ids, hidden.true_ids
    (None, array([4]))
    """
    events = tuple(
        _hidden(event) if isinstance(event, Scan) else event for event in log.events
    )
    return replace(log, events=events, header=log.header | {"identities": "false"})


def hides_identities(log: SlamLog) -> bool:
    """Whether some scan of a log has no identities."""
    scans = (event for event in log.events if isinstance(event, Scan))
    return any(scan.landmark_ids is None for scan in scans)


def true_ids_of(scan: Scan) -> IntArray | None:
    """Return the true landmark of each reading, hidden or not; None if unknown."""
    return scan.landmark_ids if scan.true_ids is None else scan.true_ids


def _hidden(scan: Scan) -> Scan:
    if scan.landmark_ids is None:
        return scan
    return replace(scan, landmark_ids=None, true_ids=true_ids_of(scan))
