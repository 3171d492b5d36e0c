"""Plans: the tasks of a job in the order in which their outputs are combined, and what a store remembers of them."""

from __future__ import annotations

import hashlib
import json
import os
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from nerg_mi.errors import NergError
from nerg_mi.files.atomic import write_text
from nerg_mi.files.safe_read import JSON_BYTES, read_json

from .store import HELD, PLANS, Store
from .task import FORMAT, Task

MOST = 500_000
"""So many tasks a plan may have; each should last a second or more, so that this is a week of work."""

_KEY = re.compile(r"[0-9a-f]{64}")


@dataclass(frozen=True)
class Plan:
    """``tasks`` in the order in which their outputs are taken; ``what`` the job is, as its user calls it, which stays
    the same when the job is started again: another plan of that name takes this one's place in a store."""

    what: str
    tasks: Sequence[Task]

    def __post_init__(self) -> None:
        if len(self.tasks) > MOST:
            raise NergError(f"{self.what} has {len(self.tasks):,} parts, and at most {MOST:,} are planned; divide it")


@dataclass(frozen=True)
class Remembered:
    """A plan as a store has it: the ``keys`` of its tasks with their suffixes, the SHA-256 of the ``inputs`` by path,
    where they were, and the names of the files that the store holds for it, ``held``."""

    what: str
    keys: dict[str, str]
    inputs: dict[str, str]
    held: tuple[str, ...] = ()


def remember(store: Store, plan: Plan) -> Path:
    """Write down in ``store`` what ``plan`` needs, so that its outputs count as wanted."""
    # What other tasks made is in the store itself, and made anew where it has to be.
    inputs = {f.path: f.sha256 for task in plan.tasks for f in task.inputs if store.folder not in Path(f.path).parents}
    own = store.folder / HELD
    held = sorted({Path(f.path).name for task in plan.tasks for f in task.inputs if Path(f.path).parent == own})
    keys = {task.key: task.suffix for task in plan.tasks}
    path = store.folder / PLANS / f"{hashlib.sha256(plan.what.encode()).hexdigest()[:16]}.json"
    about = {"format": FORMAT, "what": plan.what, "inputs": inputs, "keys": keys, "held": held}
    write_text(path, json.dumps(about) + "\n")
    return path


def read_plan(path: str | os.PathLike) -> Remembered:
    """The plan in the file ``path``. Raises `NergError` for one that is damaged or of another version."""
    found = read_json(path, "plan", JSON_BYTES)
    if not isinstance(found, dict) or found.get("format") != FORMAT or not isinstance(found.get("what"), str):
        raise NergError(f'"{path}" is no plan of this version; remove it, and start its job again')
    texts = [found.get("inputs"), found.get("keys")]
    if not all(isinstance(t, dict) and all(isinstance(v, str) for v in t.values()) for t in texts):
        raise NergError(f'the plan "{path}" is damaged; remove it, and start its job again')
    # Outputs are looked for, and removed, by these names: none may lead out of the store.
    good = all(_KEY.fullmatch(key) and "/" not in suffix.rstrip("/") for key, suffix in found["keys"].items())
    if not good:
        raise NergError(f'the plan "{path}" names what is no task; remove it, and start its job again')
    held = found.get("held", [])
    if not isinstance(held, list) or not all(isinstance(name, str) for name in held):
        raise NergError(f'the plan "{path}" is damaged; remove it, and start its job again')
    return Remembered(found["what"], found["keys"], found["inputs"], tuple(held))


def read_plans(store: Store) -> list[Remembered]:
    """All plans of ``store``, by their names. Raises `NergError` for one that is damaged."""
    found = [read_plan(path) for path in sorted((store.folder / PLANS).glob("*.json"))]
    return sorted(found, key=lambda plan: plan.what)
