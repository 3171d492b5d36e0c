"""The import rules of pyproject.toml, kept or broken.

    python -m tools.import_rules

runs import-linter on a copy of the sources that is laid out as the installed package, with `plugins/` and `scenes/`
within it. Exit code 1 where a contract is broken.
"""

from __future__ import annotations

import os
import sys
import tempfile
from pathlib import Path

from tools.imports import ROOT, assemble


def main() -> int:
    from importlinter.cli import lint_imports

    with tempfile.TemporaryDirectory(prefix="nerg-imports-") as folder:
        # import-linter looks for the package where it is started, before anywhere else.
        os.chdir(assemble(Path(folder)))
        return lint_imports(config_filename=str(ROOT / "pyproject.toml"), no_cache=True)


if __name__ == "__main__":
    sys.exit(main())
