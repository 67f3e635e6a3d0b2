"""Calls that change several parts of a filter: an interrupt midway leaves a mark."""

from collections.abc import Callable
from typing import Any


class Interruptible:
    """A filter whose calls change several of its parts, one after the other."""

    #: The call that an interrupt has ended midway, if any.
    interrupted_in = ""

    def refuse_interrupted(self) -> None:
        """Refuse a call if an interrupt has ended an earlier one midway."""
        if self.interrupted_in:
            raise RuntimeError(
                f"{type(self).__name__} was interrupted in {self.interrupted_in}: "
                "reset it or load a state"
            )


class changing:  # noqa: N801 (reads as a verb, in a with statement)
    """A block that changes several parts of a filter, and marks it until its end.

    Its ``steps`` must count a step as soon as the first part has taken it.  An error
    before that is a refusal, and nothing has changed.  An interrupt, or an error after
    that, leaves the mark, since the parts may belong to different steps: the filter
    refuses calls until it is reset or loads a state.

    Parameters
    ----------
    slam : Interruptible
        The filter.
    call : str
        The name of the call, for the message.
    undo : callable, optional
        Takes back what the block may change before a refusal.
    anew : bool
        Whether the block replaces the whole state, and so ends an earlier mark.

    Examples
    --------
    >>> slam = Interruptible()
    >>> slam.steps = 0
    >>> try:
    ...     with changing(slam, "update"):
    ...         raise KeyboardInterrupt
    ... except KeyboardInterrupt:
    ...     slam.refuse_interrupted()
    Traceback (most recent call last):
    RuntimeError: Interruptible was interrupted in update: reset it or load a state
    """

    __slots__ = "_anew", "_before", "_call", "_slam", "_steps", "_undo"

    def __init__(
        self,
        slam: Any,
        call: str,
        undo: Callable[[], object] | None = None,
        *,
        anew: bool = False,
    ) -> None:
        self._slam, self._call, self._undo, self._anew = slam, call, undo, anew

    def __enter__(self) -> None:
        """Refuse a filter with a mark, unless its state is replaced; mark it."""
        slam = self._slam
        self._before, self._steps = slam.interrupted_in, slam.steps
        if self._before and not self._anew:
            slam.refuse_interrupted()
        slam.interrupted_in = self._call

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        """Remove the mark, unless parts may belong to different steps."""
        slam = self._slam
        if kind is None:
            slam.interrupted_in = ""
        elif issubclass(kind, Exception) and slam.steps == self._steps:
            if self._undo is not None:
                self._undo()
            slam.interrupted_in = self._before
