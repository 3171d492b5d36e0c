"""A checkout that nobody has installed: everything of it is found from its root, and by PYTHONPATH from elsewhere."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import textwrap
from pathlib import Path

import numpy
import pytest

from tests.conftest import ROOT

# Where the dependencies are: without the site module nothing of that folder's .pth files, and so no editable
# installation, counts.
SITE = Path(numpy.__file__).parents[1]


@pytest.fixture
def clone(tmp_path):
    """The checkout as it is cloned."""
    for name in ("nerg_mi", "plugins", "scenes"):
        shutil.copytree(ROOT / name, tmp_path / name, ignore=shutil.ignore_patterns("__pycache__", "build"))
    return tmp_path


def uninstalled(code: str, folder: Path, **environment):
    """Run ``code`` in ``folder`` by a Python that knows the dependencies, and no installation of the package."""
    begin = f"import sys\nsys.path.append({str(SITE)!r})\n"
    begin += "assert not any('editable' in repr(f).lower() for f in sys.meta_path)\n"
    kept = {k: v for k, v in os.environ.items() if k != "PYTHONPATH"}
    return subprocess.run(
        [sys.executable, "-S", "-c", begin + textwrap.dedent(code)],
        cwd=folder,
        env=kept | environment,
        capture_output=True,
        text=True,
        timeout=300,
    )


USE = """
    import nerg_mi, mitsuba as mi
    mi.set_variant("llvm_ad_rgb")
    mi.set_variant("llvm_ad_mono")
    mi.set_variant("llvm_ad_rgb")
    print(type(mi.load_dict({"type": "nerg", "density": {"type": "constvolume"}})).__name__)
    from nerg_mi.scenes.store import layout
    from nerg_mi.plugins import nerg
    print(nerg.__file__, layout.__file__)
"""


@pytest.mark.parametrize("elsewhere", [False, True])
def test01_plugins_and_scenes_are_found(clone, elsewhere):
    done = uninstalled(USE, Path("/"), PYTHONPATH=str(clone)) if elsewhere else uninstalled(USE, clone)
    assert done.returncode == 0, done.stderr
    kind, files = done.stdout.strip().splitlines()[-2:]
    assert kind == "NergIntegrator"
    assert files.split() == [str(clone / "plugins" / "nerg.py"), str(clone / "scenes" / "store" / "layout.py")]
