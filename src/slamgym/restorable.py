"""Objects whose state can be taken, and restored later: worlds that a planner tries."""

from typing import Any, ClassVar

import numpy as np

#: What `Restorable.state` returns; it stays as it is, whatever the object does.
State = tuple[Any, ...]


class Restorable:
    """An object that can return to a state that it has had.

    A subclass names the attributes that change in `changing`. Arrays and generators are
    copied, also in tuples and dictionaries, and so are lists, whose elements never
    change.
    """

    changing: ClassVar[tuple[str, ...]]

    def state(self) -> State:
        """Return the present state, for `restore`."""
        return tuple(copied(getattr(self, name)) for name in self.changing)

    def restore(self, state: State) -> None:
        """Return to a state of this object, which stays usable for further calls."""
        for name, value in zip(self.changing, state, strict=True):
            if not put_back(getattr(self, name), value):
                setattr(self, name, copied(value))


def copied(value: Any) -> Any:
    """Return a copy of what a state holds: states of parts, and of generators."""
    if isinstance(value, np.ndarray | list):
        return value.copy()
    if isinstance(value, Restorable):
        return value.state()
    if isinstance(value, np.random.Generator):
        return value.bit_generator.state
    if isinstance(value, tuple):
        parts = map(copied, value)
        return type(value)(*parts) if hasattr(value, "_fields") else tuple(parts)
    if isinstance(value, dict):
        return {key: copied(part) for key, part in value.items()}
    return value


def put_back(part: object, value: Any) -> bool:
    """Return a part with a state of its own to that state; False if it has none."""
    if isinstance(part, Restorable):
        part.restore(value)
    elif isinstance(part, np.random.Generator):
        part.bit_generator.state = value
    else:
        return False
    return True
