"""Warnings about one run that need no ground truth."""

import numpy as np

from ...estimator.models.bearing_range import wrap_angle
from ..logs.anonymous import hides_identities
from ..logs.events import Scan
from .log_replay import Replay

MOST_REJECTED = 0.05
"""Share of rejected readings above which a filter may diverge."""

NIS_RANGE = (0.5, 2.0)
"""NIS per degree of freedom that is no reason to worry."""

MANY_SCANS = 10
"""A landmark within reach in this many scans should be in one of them."""

MOST_ABANDONED = 0.25
"""Share of landmarks that scans no longer show above which a map may be split."""


def run_warnings(replay: Replay) -> list[str]:
    """List what is suspicious about a run.

    Returns
    -------
    list of str
        Sentences of one line.
    """
    found = [_rejections(replay), _nis(replay), _crowded_map(replay)]
    return [sentence for sentence in found if sentence]


def _rejections(replay: Replay) -> str:
    counts = replay.readings
    tested = counts.associated + counts.rejected
    if not tested or counts.rejected <= MOST_REJECTED * tested:
        return ""
    return (
        f"The gate rejects {counts.rejected / tested:.0%} of the readings of mapped "
        "landmarks: the filter may have diverged, or assume too little noise."
    )


def _nis(replay: Replay) -> str:
    trace = replay.trace
    freedom = trace.nis_dof.sum()
    if not freedom:
        return ""
    ratio = float(trace.nis[trace.nis_dof > 0].sum() / freedom)
    low, high = NIS_RANGE
    if low <= ratio <= high:
        return ""
    return f"The {nis_suspicion(ratio, associates=hides_identities(replay.log))}"


def nis_suspicion(ratio: float, *, associates: bool) -> str:
    """Write what a NIS per degree of freedom far from 1 means.

    Parameters
    ----------
    ratio : float
        NIS per degree of freedom.
    associates : bool
        Whether the filter associates readings without identity.

    Examples
    --------
    >>> nis_suspicion(3.0, associates=False)
    'NIS is 3 per degree of freedom, where 1 is expected: the filter assumes too ...
    """
    amount = "too much" if ratio < 1 else "too little"
    other = ", or associates wrongly" * associates
    return (
        f"NIS is {ratio:.3g} per degree of freedom, where 1 is expected: the filter "
        f"assumes {amount} noise{other}."
    )


def _crowded_map(replay: Replay) -> str:
    size, abandoned = len(replay.trace.landmark_ids), abandoned_landmarks(replay)
    if not size or abandoned <= MOST_ABANDONED * size:
        return ""
    return (
        f"{abandoned} of the {size} landmarks in the map should have been seen again, "
        "but were not: the map may hold landmarks twice."
    )


def abandoned_landmarks(replay: Replay) -> int:
    """Count landmarks of the final map that scans no longer show.

    A landmark is abandoned if it was within the sensor's reach in `MANY_SCANS` scans
    since its last reading.  The reach is that of three quarters of all readings, and
    their widest bearing to either side but for 5 %.  Where all readings have
    identities, no landmark is.
    """
    log, trace = replay.log, replay.trace
    scans = [event for event in log.events if isinstance(event, Scan)]
    if not scans or not hides_identities(log):
        return 0
    bearings, ranges = np.concatenate([scan.measurements for scan in scans]).T
    reach = np.quantile(ranges, 0.75)
    width = np.quantile(np.abs(wrap_angle(bearings)), 0.95)
    last = np.array([replay.last_seen.get(i, -1) for i in trace.landmark_ids.tolist()])
    steps = np.searchsorted(trace.t, [scan.t for scan in scans], "right") - 1
    in_view = np.zeros(len(last), dtype=np.int64)
    for step in steps.tolist():
        x, y, heading = trace.poses[step]
        dx, dy = (trace.landmarks - (x, y)).T
        bearing = wrap_angle(np.arctan2(dy, dx) - heading)
        is_near = (np.hypot(dx, dy) <= reach) & (np.abs(bearing) <= width)
        in_view += is_near & (step > last)
    return int((in_view >= MANY_SCANS).sum())
