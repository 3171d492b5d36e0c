"""Where the plugins and the scenes are in a checkout that nobody has installed.

They lie beside the package there, and an installation maps them into it. Without one, ``import nerg_mi`` from the
repository's root finds them by the finder of this module, which knows these two names and no others.
"""

from __future__ import annotations

import importlib.util
import sys
from importlib.machinery import ModuleSpec, PathFinder
from pathlib import Path

FOLDERS = ("plugins", "scenes")


class Beside:
    """An entry of `sys.meta_path` that finds `FOLDERS` of the package `package` in the folder `root`."""

    def __init__(self, package: str, root: Path):
        self.names = {f"{package}.{folder}" for folder in FOLDERS}
        self.root = root

    def find_spec(self, name: str, path=None, target=None) -> ModuleSpec | None:
        return PathFinder.find_spec(name, [str(self.root)], target) if name in self.names else None


def find_folders(package: str, folder: Path) -> None:
    """Have `FOLDERS` found as part of `package`, which lies in `folder`, where nothing else finds them and they lie
    beside it."""
    if (
        importlib.util.find_spec(f"{package}.{FOLDERS[0]}") is None
        and (folder.parent / FOLDERS[0] / "__init__.py").is_file()
    ):
        # Last: whatever an installation has to say comes first.
        sys.meta_path.append(Beside(package, folder.parent))
