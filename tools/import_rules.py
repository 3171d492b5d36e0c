"""Check the import rules of pyproject.toml.

    python -m tools.import_rules

Runs import-linter on a copy of the sources laid out as the installed package, with `plugins/` and `scenes/` inside it.
The exit code is 1 if a contract is broken.
"""

from __future__ import annotations

import os
import shutil
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
FOLDERS = {"nerg_mi": "nerg_mi", "plugins": "nerg_mi/plugins", "scenes": "nerg_mi/scenes"}
"""Folder of the checkout -> folder in the installed package, as pyproject.toml maps them."""


def main() -> int:
    from importlinter.cli import lint_imports

    with tempfile.TemporaryDirectory(prefix="nerg-imports-") as folder:
        for source, installed in FOLDERS.items():
            for path in (ROOT / source).rglob("*.py"):
                target = Path(folder) / installed / path.relative_to(ROOT / source)
                target.parent.mkdir(parents=True, exist_ok=True)
                shutil.copyfile(path, target)
        # import-linter searches the package in the working directory first.
        os.chdir(folder)
        return lint_imports(config_filename=str(ROOT / "pyproject.toml"), no_cache=True)


if __name__ == "__main__":
    sys.exit(main())
