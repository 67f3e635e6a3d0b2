"""Objects whose state can be taken, and restored later: worlds that a planner tries."""

from collections.abc import Callable
from typing import Any, ClassVar

import numpy as np

#: What `Restorable.state` returns; it stays as it is, whatever the object does.
State = tuple[Any, ...]


class Restorable:
    """An object that can return to a state that it has had.

    A subclass names the attributes that change in `changing`. Arrays and generators are
    copied, also in tuples and dictionaries, and so are lists and sets, whose elements
    never change. The values of attributes in `replaced` are never changed in place, so
    states share them.
    """

    changing: ClassVar[tuple[str, ...]] = ()
    replaced: ClassVar[tuple[str, ...]] = ()

    def state(self) -> State:
        """Return the present state, for `restore`."""
        changing = [copied(getattr(self, name)) for name in self.changing]
        return (*changing, *(getattr(self, name) for name in self.replaced))

    def restore(self, state: State) -> None:
        """Return to a state of this object, which stays usable for further calls.

        Raises
        ------
        ValueError
            If this is no state of such an object.
        """
        refuse_other_state(self, state, len(self.changing) + len(self.replaced))
        attributes, values = vars(self), iter(state)
        # The names end first: zip then has taken no value too many.
        for name, value in zip(self.changing, values, strict=False):
            if not put_back(attributes[name], value):
                attributes[name] = copied(value)
        attributes.update(zip(self.replaced, values, strict=True))


def refuse_other_state(owner: object, state: object, parts: int) -> None:
    """Refuse what is no state of so many parts."""
    if not isinstance(state, tuple) or len(state) != parts:
        raise ValueError(
            f"state must be what state() of the same {type(owner).__name__} returned, "
            f"got another object ({type(state).__name__})"
        )


def copied(value: Any) -> Any:
    """Return a copy of what a state holds: states of parts, and of generators."""
    copy = _COPIES.get(type(value))
    if copy is not None:
        return copy(value)
    if isinstance(value, Restorable):
        return value.state()
    if isinstance(value, tuple):  # a named one
        return type(value)(*map(copied, value))
    return value


#: By the type itself, because a tree of tests takes longer than most copies.
_COPIES: dict[type, Callable[[Any], Any]] = {
    np.ndarray: np.ndarray.copy,
    list: list.copy,
    set: set.copy,
    np.random.Generator: lambda rng: rng.bit_generator.state,
    tuple: lambda parts: tuple(map(copied, parts)),
    dict: lambda parts: {key: copied(part) for key, part in parts.items()},
}


def put_back(part: object, value: Any) -> bool:
    """Return a part with a state of its own to that state; False if it has none."""
    if isinstance(part, Restorable):
        part.restore(value)
    elif isinstance(part, np.random.Generator):
        part.bit_generator.state = value
    else:
        return False
    return True
