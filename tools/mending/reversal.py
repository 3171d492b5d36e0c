"""What a mending is, and how it is undone in a copy of the sources."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass


@dataclass(frozen=True)
class Change:
    """The text ``now`` of a ``file`` of the repository becomes ``then``: what stood there before, or does as wrong."""

    file: str
    now: str
    then: str


@dataclass(frozen=True)
class Reversal:
    """A fault brought back: in a phrase what is undone, the ``changes`` that do so, and the ``tests`` (node ids, of a
    single case where it stands in brackets), each of which must then fail."""

    undone: str
    tests: tuple[str, ...]
    changes: tuple[Change, ...]

    def sources(self, read: Callable[[str], str]) -> dict[str, str]:
        """The contents of each changed file; ``read`` gives what it holds now.

        Raises ``ValueError`` where a text to be replaced does not stand exactly once in its file.
        """
        out: dict[str, str] = {}
        for change in self.changes:
            text = out.get(change.file) or read(change.file)
            count = text.count(change.now)
            if count != 1:
                raise ValueError(
                    f'{change.file} holds {count} times what "{self.undone}" replaces; '
                    f"name a text of tools/mending/ that stands there once: {change.now!r}"
                )
            out[change.file] = text.replace(change.now, change.then)
        return out


@dataclass(frozen=True)
class Mending:
    """What is ``held`` to since a fault was mended, and the ``reversals`` that bring it back."""

    held: str
    reversals: tuple[Reversal, ...]

    @property
    def tests(self) -> list[str]:
        """The tests of all reversals, without the brackets of single cases, each once."""
        return list(dict.fromkeys(t.partition("[")[0] for r in self.reversals for t in r.tests))


def undo(undone: str, tests: Iterable[str], *changes: tuple[str, str, str]) -> Reversal:
    """A `Reversal` of changes that are given as ``(file, now, then)``."""
    return Reversal(undone, tuple(tests), tuple(Change(*c) for c in changes))


def held(text: str, *reversals: Reversal) -> Mending:
    """A `Mending` with its reversals one after the other."""
    return Mending(text, reversals)
