"""The smoother with the interface of a filter: it records a drive, then smooths it."""

from __future__ import annotations

from typing import Any

from numpy.typing import ArrayLike

from ..registry import accepted_options, find_estimator, make_estimator, read_label
from .batch_smoother import robust_kernel, smooth
from .recorded_slam import RecordedSlam
from .smoothed_drive import SmoothedDrive


class SmoothingSlam(RecordedSlam):
    """A filter that records its drive, and smooths it at the end.

    During the drive, its beliefs are those of the filter. :meth:`smoothed` returns the
    beliefs about all poses given the whole drive, and experiments use these instead.

    Parameters
    ----------
    motion_std, measurement_std, initial_pose, initial_pose_std
        As every filter takes them.
    follow : str
        The filter, by a name that :func:`~slamgym.estimator.make_estimator` takes.
        Options in brackets override the keywords.
    robust, robust_scale
        As in `batch_smoother.smooth`.
    range_std_per_metre, bearing_std_metres, range_noise_at, noise_at_rest, min_range
        As in :class:`~slamgym.estimator.EkfSlam`; the filter gets those that it takes.
    **options
        Further options of the filter.

    Raises
    ------
    ValueError
        If an argument is refused.
    TypeError
        If the filter does not take an option.
    """

    def __init__(
        self,
        motion_std: ArrayLike,
        measurement_std: ArrayLike,
        *,
        follow: str = "invariant",
        robust: str | None = None,
        robust_scale: float | None = None,
        initial_pose: ArrayLike = (0.0, 0.0, 0.0),
        initial_pose_std: ArrayLike = (0.0, 0.0, 0.0),
        range_std_per_metre: float = 0.0,
        bearing_std_metres: float = 0.0,
        range_noise_at: str = "expected",
        noise_at_rest: bool = True,
        min_range: float = 1e-3,
        **options: Any,
    ) -> None:
        noise: dict[str, Any] = {
            "motion_std": motion_std,
            "measurement_std": measurement_std,
            "initial_pose": initial_pose,
            "initial_pose_std": initial_pose_std,
        }
        name, own = read_label(follow)
        sensor = {
            "range_std_per_metre": range_std_per_metre,
            "bearing_std_metres": bearing_std_metres,
            "range_noise_at": range_noise_at,
            "noise_at_rest": noise_at_rest,
            "min_range": min_range,
        }
        sensor |= {key: own.pop(key) for key in sensor if key in own}
        options |= own
        robust_kernel(robust, robust_scale)
        taken = accepted_options(find_estimator(name), sensor)
        slam = make_estimator(name, **noise, **taken, **options)
        super().__init__(slam, **noise, **sensor)
        self._kernel: dict[str, Any] = {"robust": robust, "robust_scale": robust_scale}

    def smoothed(self) -> SmoothedDrive:
        """Return the beliefs about all poses, given the drive until now."""
        return smooth(self.recorded(), start=self.belief(), **self._kernel)
