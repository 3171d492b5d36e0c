"""Cases of all readers, identical in each run."""

from __future__ import annotations

import random
from collections.abc import Iterator
from pathlib import Path

from hypothesis import HealthCheck, Phase, given, seed, settings

from tests.fuzz.mutations import mutate
from tests.fuzz.watch import Case, Reader


def make_inputs(readers: list[Reader], folder: Path) -> Path:
    """Write the valid inputs of ``readers``, each into a subfolder of ``folder`` with the name of the reader."""
    for reader in readers:
        (folder / reader.name).mkdir(parents=True)
        reader.make(folder / reader.name)
    return folder


def draw_cases(readers: list[Reader], inputs: Path, count: int, start: int = 0) -> Iterator[Case]:
    """Draw ``count`` cases, equally many for each reader and each of its targets; ``start`` selects other cases."""
    targets = [(r, t, kinds) for r in readers for t, kinds in r.targets.items()]
    for k, (reader, target, kinds) in enumerate(targets):
        share = count * (k + 1) // len(targets) - count * k // len(targets)
        data = (inputs / reader.name / target).read_bytes()
        for damaged in _draw(data, kinds, share, f"{start} {reader.name} {target}"):
            yield Case(reader.name, target, damaged)


def _draw(data: bytes, kinds: tuple[str, ...], count: int, name: str) -> list[bytes]:
    cases: list[bytes] = []

    @seed(name)
    @settings(
        max_examples=count,
        database=None,
        deadline=None,
        phases=[Phase.generate],
        suppress_health_check=list(HealthCheck),
    )
    @given(mutate(data, kinds))
    def collect(changed: bytes) -> None:
        if len(cases) < count:
            cases.append(changed)

    state = random.getstate()
    collect()
    random.setstate(state)
    return cases
