"""Nothing in the package writes a file but through `nerg_mi.files.atomic`: found in the source, so that none comes
back."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
SOURCES = sorted(p for room in ("nerg_mi", "plugins", "scenes") for p in (ROOT / room).rglob("*.py"))

METHODS = {
    "write",
    "write_async",
    "write_bitmap",
    "savefig",
    "savez",
    "savez_compressed",
    "tofile",
    "savetxt",
    "to_csv",
    "to_parquet",
    "to_file",
    "write_table",
    "export",
    "imsave",
    "mkdir",
    "makedirs",
    "rename",
    "touch",
    "writelines",
    "copyfile",
    "dump",
}
"""Methods and functions of modules that write, or make something, where they are given a name."""
OPENERS = {"open", "ZipFile", "GzipFile", "fdopen", "TarFile"}

EXCEPTIONS = {
    "nerg_mi/files/atomic.py": "the writer itself",
    "nerg_mi/files/images.py:_raise_if_full": "finds out why the file that `replacing` has named takes no more",
    "nerg_mi/formats/torch_files.py:write_torch": "has torch write to memory",
    "nerg_mi/cli/ending.py:write": "is a standard stream",
    "nerg_mi/files/images.py": "encodes in memory",
    "nerg_mi/figures/style.py:encode": "encodes in memory",
    "nerg_mi/photos/structure_worker.py": "fills a folder that `replacing_folder` has named, in its own process",
    "nerg_mi/rays/readers/skeleton.py:_written": "is given the name that `replacing` has chosen",
}


def direct_writers(text: str) -> list[tuple[str, int, str]]:
    """``(function, line, source)`` of what writes without `replacing` about it."""
    found = []

    def visit(node, function, safe):
        if isinstance(node, (ast.FunctionDef, ast.Lambda)):
            function = getattr(node, "name", function)
        if isinstance(node, ast.With) and any("replacing" in ast.unparse(item.context_expr) for item in node.items):
            safe = True
        if isinstance(node, ast.Call) and not safe and _writes(node):
            found.append((function, node.lineno, ast.unparse(node)))
        for child in ast.iter_child_nodes(node):
            visit(child, function, safe)

    visit(ast.parse(text), "", False)
    return found


def _writes(call: ast.Call) -> bool:
    name = call.func.attr if isinstance(call.func, ast.Attribute) else getattr(call.func, "id", "")
    owner = ast.unparse(call.func.value) if isinstance(call.func, ast.Attribute) else ""
    if name in OPENERS:
        given = [*call.args, *(k.value for k in call.keywords if k.arg == "mode")]
        modes = [a.value for a in given if isinstance(a, ast.Constant) and isinstance(a.value, str)]
        return any(set(mode) <= set("rwaxbt+") and set(mode) & set("wax+") for mode in modes)
    if name in ("write_text", "write_bytes"):
        return bool(owner)  # of a Path; ours are functions
    if name in ("save", "replace") and owner in ("np", "numpy", "torch", "image", "os"):
        return True
    if name == "write" and not owner:
        return False  # a function that somebody was given
    return name in METHODS and not owner.startswith(("sys.", "json"))


def test_files_are_written_atomically():
    found = []
    for path in SOURCES:
        name = str(path.relative_to(ROOT))
        for function, line, text in direct_writers(path.read_text(encoding="utf-8")):
            if not {name, f"{name}:{function}"} & set(EXCEPTIONS):
                found.append(f"{name}:{line}: {text}")
    assert len(SOURCES) > 100 and not found, "write through nerg_mi.files.atomic:\n" + "\n".join(found)


def test_exceptions_are_still_needed():
    for name in EXCEPTIONS:
        path, _, function = name.partition(":")
        found = direct_writers((ROOT / path).read_text(encoding="utf-8"))
        assert [f for f in found if not function or f[0] == function], f"{name} writes nothing any more"


@pytest.mark.parametrize(
    "text",
    [
        'open(path, "w")',
        'path.open("ab")',
        "path.write_text(text)",
        "np.save(path, x)",
        "figure.savefig(path)",
        "bitmap.write(str(path))",
        'zipfile.ZipFile(path, mode="w")',
        "os.replace(a, b)",
        "mesh.export(path)",
        "folder.mkdir()",
        'gzip.open(path, "wt")',
    ],
)
def test_writing_calls_are_detected(text):
    assert direct_writers(text)
    assert not direct_writers(f"with replacing(path) as temporary:\n    {text}")


@pytest.mark.parametrize(
    "text",
    [
        "open(path)",
        'path.open("rb")',
        "write_text(path, text)",
        "rays.save(path)",
        "text.replace(a, b)",
        "sys.stdout.write(x)",
    ],
)
def test_other_calls_are_ignored(text):
    assert not direct_writers(text)
