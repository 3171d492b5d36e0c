"""Objects of one kind that are chosen by name, so that one more of them is one more object and nothing else."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Generic, Protocol, TypeVar

from nerg_mi.errors import NergError


class Named(Protocol):
    """What can be registered."""

    @property
    def name(self) -> str:
        """As which it is chosen."""
        ...

    @property
    def summary(self) -> str:
        """What it does, in a sentence without its full stop: for the manual."""
        ...


Kind = TypeVar("Kind", bound=Named)


class Registry(Generic[Kind]):
    """Objects by name, in the order in which they were registered. ``parameter``: what chooses among them."""

    def __init__(self, parameter: str):
        self.parameter = parameter
        self._known: dict[str, Kind] = {}

    def register(self, item: Kind) -> Kind:
        """Make ``item`` known. Raises ``ValueError`` for a name that is taken."""
        if item.name in self._known:
            raise ValueError(f'there is already a "{item.name}" for "{self.parameter}"')
        self._known[item.name] = item
        return item

    def unregister(self, name: str) -> None:
        """Forget what is called ``name``. Raises ``KeyError`` where nothing is."""
        del self._known[name]

    def find(self, name: str) -> Kind:
        """What is called ``name``. Raises ``NergError``, which names the others, where nothing is."""
        if name not in self._known:
            raise NergError(f'"{self.parameter}" must be one of {", ".join(self._known)}, got "{name}"')
        return self._known[name]

    def names(self) -> tuple[str, ...]:
        """All names."""
        return tuple(self._known)

    def __iter__(self) -> Iterator[Kind]:
        return iter(self._known.values())

    def manual(self) -> str:
        """One sentence about each, as the manual has it."""
        return " ".join(f"``{item.name}``: {item.summary}." for item in self)
