"""The likelihood of a log's readings as a function of its noise."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from ...arrays import Array, BoolArray
from ...estimator.filters.drive_likelihood import GATE, drive_likelihood
from ...estimator.filters.ekf import EkfSlam
from ...estimator.kernels.drive_likelihood import DriveEvents, DriveRecord
from ...estimator.kernels.kalman_gain import GATED
from .log_events import (
    Stretch,
    parts_of,
    sample_of,
    stretches_of,
    without_readings,
)

MOST_LANDMARKS = 100  # of one map
MOST_READINGS = 12_000  # of a sample
SAMPLED_LANDMARKS = 40  # of one map of a sample


@dataclass(frozen=True, eq=False)
class LogLikelihood:
    """The log likelihood of a drive's readings under a noise, from the innovations.

    A pass of a filter takes a time that grows with the square of its map.  A drive past
    many landmarks is therefore cut into parts, and each begins with an empty map.
    """

    filter: EkfSlam
    """At its start."""
    events: DriveEvents
    gate: float = GATE
    threads: int | None = None
    most_landmarks: int = MOST_LANDMARKS
    """Of one part."""
    stretches: Sequence[Stretch] = ()
    """The parts, if they are given."""

    @cached_property
    def parts(self) -> tuple[DriveEvents, ...]:
        """The parts of the drive."""
        stretches = self.stretches or stretches_of(self.events, self.most_landmarks)
        return parts_of(self.events, stretches)

    def sample(self, most_readings: int = MOST_READINGS) -> LogLikelihood:
        """Return the likelihood of evenly spread parts of a drive with many readings.

        A drive with fewer readings is returned whole.
        """
        if len(self.events.readings) <= most_readings:
            return self
        stretches = stretches_of(self.events, SAMPLED_LANDMARKS)
        if len(stretches) == 1:
            return self
        events, chosen = sample_of(self.events, stretches, most_readings)
        return replace(self, events=events, stretches=chosen)

    def of(self, noises: Array) -> Array:
        """Return the log likelihoods of the steps (B, S) under noises (B, 7)."""
        return self._passes(noises, keep_beliefs=False).log_likelihoods

    def record(self, noises: Array) -> DriveRecord:
        """Return the full records of the passes under noises (B, 7).

        The poses of each part begin where the filter does.
        """
        return self._passes(noises, keep_beliefs=True)

    def _passes(self, noises: Array, *, keep_beliefs: bool) -> DriveRecord:
        records = [
            drive_likelihood(
                self.filter,
                part,
                noises,
                gate=self.gate,
                keep_beliefs=keep_beliefs,
                threads=self.threads,
            )
            for part in self.parts
        ]
        if len(records) == 1:
            return records[0]
        rejected = np.sum([record.rejected for record in records], axis=0)
        joined = (
            entries[0] if entries[0].ndim == 1 else np.concatenate(entries, axis=1)
            for entries in zip(*records, strict=True)
        )
        return DriveRecord(*joined)._replace(rejected=rejected)

    def rejected(self, noise: Array) -> BoolArray:
        """Return which readings the gate rejects under a noise (7,), shape (M,)."""
        return np.asarray(self.record(noise[None]).outcomes[0] == GATED)

    def without(self, dropped: BoolArray) -> LogLikelihood:
        """Return the likelihood of all but some readings, without a gate.

        It is smooth: no reading is rejected here and accepted there.
        """
        kept = without_readings(self.events, dropped)
        return replace(self, events=kept, gate=np.inf)
