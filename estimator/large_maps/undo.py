"""Taking back a change of the local map if an error follows it."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager


class Undo:
    """The way back from the first change of a local map within a call."""

    def __init__(self) -> None:
        self._go_back: Callable[[], None] | None = None

    @contextmanager
    def on_error(self) -> Iterator[None]:
        """Take back what has changed since :meth:`save` if an error follows it."""
        self._go_back = None
        try:
            yield
        except Exception:
            if self._go_back is not None:
                self._go_back()
            raise
        finally:
            self._go_back = None

    def save(self, checkpoint: Callable[[], Callable[[], None]]) -> None:
        """Call before a change; the checkpoint returns what takes the change back."""
        if self._go_back is None:
            self._go_back = checkpoint()
