"""Which file of tests belongs to which module: `nerg_mi/field/mlp.py` has `tests/field/test_mlp.py`."""

from __future__ import annotations

from pathlib import Path, PurePosixPath

ROOT = Path(__file__).resolve().parents[1]


def test_file_of(source: str) -> str:
    """The file of tests of the source file at this path in the checkout.

    Folders below `nerg_mi/` have theirs in `tests/`; other folders (`plugins/`, `tools/`) keep their name there.
    """
    path = PurePosixPath(source)
    folders = path.parent.parts[1:] if path.parts[0] == "nerg_mi" else path.parent.parts
    return str(PurePosixPath("tests", *folders, f"test_{path.stem.strip('_')}.py"))


def is_test_of(test: str, source: str) -> bool:
    """Whether `test` (a file, or a test's name in it) is of the file of tests of `source`, or of one that was split off
    it, as `test_nerg_shapes.py` off `test_nerg.py`."""
    mirror = test_file_of(source).removesuffix(".py")
    return test.startswith((mirror + ".py", mirror + "_"))


def without_tests(folders: tuple[str, ...], root: Path = ROOT) -> list[str]:
    """The modules below these folders that have no file of tests; files that define nothing need none."""
    tests = [str(path.relative_to(root)) for path in sorted((root / "tests").rglob("test_*.py"))]
    sources = [path for folder in folders for path in sorted((root / folder).rglob("*.py"))]
    return [
        source
        for path in sources
        if not _is_empty(path) and not any(is_test_of(t, source := str(path.relative_to(root))) for t in tests)
    ]


def _is_empty(path: Path) -> bool:
    return path.name == "__init__.py" and len(path.read_text(encoding="utf-8").splitlines()) < 5
