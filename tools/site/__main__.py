"""The manual as web pages, which need no network: `python -m tools.site [--out out/manual]`.

Warnings are errors, and all of them are told before the end. Needs the extra `manual`.
"""

from __future__ import annotations

import argparse
import shutil
import sys
from pathlib import Path

import nerg_mi  # noqa: F401  (chooses the libLLVM, so it comes before what imports Mitsuba)
from tools.imports import ROOT
from tools.site import source


def build(out: Path, html: bool = True) -> int:
    """Assemble the manual's source in ``out``/source and build its pages beside it; the exit code of Sphinx."""
    folder = out / "source"
    shutil.rmtree(folder, ignore_errors=True)
    source.assemble(ROOT, folder)
    if not html:
        return 0
    try:
        from sphinx.cmd.build import build_main
    except ModuleNotFoundError:
        print('the manual is built by Sphinx: pip install "nerg-mi[manual]"', file=sys.stderr)
        return 1
    conf = str(Path(__file__).parent)
    where = ["-c", conf, "-d", str(out / "doctrees"), str(folder), str(out / "html")]
    return build_main(["-b", "html", "-W", "--keep-going", "-q", "-E", *where])


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=ROOT / "out" / "manual", help="folder to write into")
    options = parser.parse_args(arguments)
    code = build(options.out)
    if code == 0:
        print(f"wrote {options.out / 'html' / 'index.html'}")
    return code


if __name__ == "__main__":
    sys.exit(main())
