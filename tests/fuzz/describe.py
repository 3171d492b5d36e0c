"""What a reader is to the fuzzer: how a valid input is made, which of its files are damaged, and how it is read."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class Reader:
    """``make`` writes a small valid input into an empty folder; ``read`` reads that folder and uses what it gets.

    ``targets``: the files in it that are damaged, by name, each with the kinds of structure that damage may keep, of
    "json", "text", "zip", "gzip", "npy", "safetensors", "png", "boxes" (of MP4); bytes are damaged in any case. Both
    functions import what they need themselves. ``needs``: a package that may be missing, without which there is no
    such reader. ``is_command``: it runs a command, which may write files and load what it needs.
    """

    name: str
    make: Callable[[Path], None]
    targets: dict[str, tuple[str, ...]]
    read: Callable[[Path], object]
    needs: str | None = None
    is_command: bool = False

    @property
    def installed(self) -> bool:
        return self.needs is None or importlib.util.find_spec(self.needs) is not None
