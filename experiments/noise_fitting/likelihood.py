"""The likelihood of a log's readings as a function of its noise."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ...arrays import Array, BoolArray
from ...estimator.filters.drive_likelihood import GATE, drive_likelihood
from ...estimator.filters.ekf import EkfSlam
from ...estimator.kernels.drive_likelihood import DriveEvents, DriveRecord
from ...estimator.kernels.scan_rows import GATED
from .log_events import without_readings


@dataclass(frozen=True, eq=False)
class LogLikelihood:
    """The log likelihood of a drive's readings under a noise, from the innovations."""

    filter: EkfSlam
    """At its start."""
    events: DriveEvents
    gate: float = GATE
    threads: int | None = None

    def of(self, noises: Array) -> Array:
        """Return the log likelihoods of the steps (B, S) under noises (B, 7)."""
        return drive_likelihood(
            self.filter, self.events, noises, gate=self.gate, threads=self.threads
        ).log_likelihoods

    def record(self, noises: Array) -> DriveRecord:
        """Return the full records of the passes under noises (B, 7)."""
        return drive_likelihood(
            self.filter,
            self.events,
            noises,
            gate=self.gate,
            keep_beliefs=True,
            threads=self.threads,
        )

    def rejected(self, noise: Array) -> BoolArray:
        """Return which readings the gate rejects under a noise (7,), shape (M,)."""
        return np.asarray(self.record(noise[None]).outcomes[0] == GATED)

    def without(self, dropped: BoolArray) -> LogLikelihood:
        """Return the likelihood of all but some readings, without a gate.

        It is smooth: no reading is rejected here and accepted there.
        """
        kept = without_readings(self.events, dropped)
        return replace(self, events=kept, gate=np.inf)
