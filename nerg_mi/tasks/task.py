"""A task: a function, its parameters and the bytes of the files that it reads, which together are its name."""

from __future__ import annotations

import hashlib
import importlib
import json
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

from .inputs import InputFile

FORMAT = 1
"""Version of what a key is made of; another one, and nothing that was made before is found."""

FOLDER = "/"
"""The suffix of outputs that are folders."""

_FUNCTION = re.compile(r"[A-Za-z_][\w.]*:[A-Za-z]\w*")
_SUFFIX = re.compile(r"|/|(\.[A-Za-z0-9]+){1,2}")

Work = Callable[[Mapping[str, Any], Mapping[str, Path], Path], Mapping[str, Any] | None]
"""What a task runs: ``work(parameters, inputs, output)`` reads the files ``inputs`` by their names and writes the file
``output``, or fills that folder, which is there and empty. It may give notes about it, a few values as JSON has them.
Output and notes are the same for the same arguments, in any process and in any order; what the user can mend is raised
as a `NergError`."""


@dataclass(frozen=True)
class Task:
    """One part of long work.

    ``function``: a `Work`, as "package.module:name"; ``parameters``: its first argument, as JSON has it; ``inputs``:
    the files that it reads, each by a name of its own; ``suffix``: of its output (".png"), `FOLDER` for a folder;
    ``versions``: of programs and formats on which the output's bytes depend (`code.versions`); ``label``: what people
    call it, which is no part of its name.
    """

    function: str
    parameters: Mapping[str, Any] = field(default_factory=dict)
    inputs: tuple[InputFile, ...] = ()
    suffix: str = ""
    versions: Mapping[str, str] = field(default_factory=dict)
    label: str = "a part"

    def __post_init__(self) -> None:
        if not _FUNCTION.fullmatch(self.function):
            raise ValueError(f'"{self.function}" names no function of a module; write "package.module:name"')
        if not _SUFFIX.fullmatch(self.suffix):
            raise ValueError(f'"{self.suffix}" is no suffix of an output')
        if len({file.name for file in self.inputs}) < len(self.inputs):
            raise ValueError(f'"{self.label}" reads two files by one name')

    @cached_property
    def key(self) -> str:
        """SHA-256 (hex) of everything that its output depends on. Raises ``ValueError`` for parameters that JSON does
        not have, such as NaN."""
        about = {
            "format": FORMAT,
            "function": self.function,
            "parameters": self.parameters,
            "inputs": {file.name: file.sha256 for file in self.inputs},
            "suffix": self.suffix,
            "versions": self.versions,
        }
        return hashlib.sha256(canonical(about).encode()).hexdigest()

    def document(self) -> dict[str, Any]:
        """All of it as JSON has it; see `task_of`."""
        return {
            "function": self.function,
            "parameters": self.parameters,
            "inputs": [file.document() for file in self.inputs],
            "suffix": self.suffix,
            "versions": self.versions,
            "label": self.label,
        }


def task_of(document: Mapping[str, Any]) -> Task:
    """The task that ``document`` describes, as `Task.document` wrote it in another process."""
    inputs = tuple(InputFile(**file) for file in document["inputs"])
    return Task(**{**document, "inputs": inputs})


def canonical(value: Any) -> str:
    """``value`` as JSON, equal for equal values."""
    return json.dumps(value, sort_keys=True, separators=(",", ":"), allow_nan=False)


def find_function(name: str) -> Work:
    """The function "package.module:name". Raises ``ValueError`` where there is none."""
    module, _, attribute = name.partition(":")
    try:
        return getattr(importlib.import_module(module), attribute)
    except (ImportError, AttributeError) as error:
        raise ValueError(f'there is no function "{name}" here: {error}') from error
