"""The import rules of pyproject.toml, kept or broken.

    python -m tools.import_rules

runs import-linter on a copy of the sources that is laid out as the installed package, with `plugins/` and `scenes/`
within it. Exit code 1 where a contract is broken.
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
        # import-linter looks for the package where it is started, before anywhere else.
        os.chdir(folder)
        return lint_imports(config_filename=str(ROOT / "pyproject.toml"), no_cache=True)


if __name__ == "__main__":
    sys.exit(main())
