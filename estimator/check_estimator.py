"""Hold anybody's estimator against the contract of :class:`SlamEstimator`."""

from collections.abc import Callable

from .contract.state_checks import (
    check_refusals,
    check_reset,
    check_save_and_restore,
    check_saved_state_is_a_copy,
    check_snapshots,
)
from .contract.step_checks import (
    check_empty_scan,
    check_interface,
    check_mapping,
    check_motion,
    check_second_reading,
    check_start,
    check_update,
)
from .contract.trial_drive import EstimatorContractError, Factory

__all__ = ["EstimatorContractError", "check_estimator"]

CHECKS: tuple[Callable[[Factory], None], ...] = (
    check_interface,
    check_start,
    check_motion,
    check_mapping,
    check_update,
    check_second_reading,
    check_empty_scan,
    check_snapshots,
    check_refusals,
    check_save_and_restore,
    check_saved_state_is_a_copy,
    check_reset,
)


def check_estimator(factory: Factory) -> None:
    """Check that an estimator works wherever slamgym uses one.

    Drives a small known world and looks at interface, beliefs, reports, independence
    of snapshots, refusal of bad input, and save and restore.

    Parameters
    ----------
    factory : callable
        Makes the estimator from the keywords ``motion_std``, ``measurement_std``,
        ``initial_pose``, ``initial_pose_std``; a class will do.

    Raises
    ------
    EstimatorContractError
        At the first breach, naming the method and what is expected of it.

    Examples
    --------
    >>> from slamgym.estimator import EkfSlam
    >>> check_estimator(EkfSlam)
    """
    for check in CHECKS:
        check(factory)
