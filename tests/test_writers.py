"""The package writes files only through `nerg_mi.files.atomic`, which is checked in the source code."""

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
"""Methods and functions that write or create a file."""
OPENERS = {"open", "ZipFile", "GzipFile", "fdopen", "TarFile"}

EXCEPTIONS = {
    "nerg_mi/files/atomic.py": "the writer itself",
    "nerg_mi/files/images.py:_raise_if_full": "determines why a file of `replace_atomically` cannot be extended",
    "nerg_mi/formats/torch_files.py:write_torch": "torch writes to memory",
    "nerg_mi/cli/ending.py:write": "is a standard stream",
    "nerg_mi/cli/building.py:format_help_text": "writes help to memory",
    "nerg_mi/files/images.py": "encodes in memory",
    "nerg_mi/figures/style.py:encode": "encodes in memory",
    "nerg_mi/photos/structure_worker.py": "writes to a folder of `create_folder_atomically`, in its own process",
    "nerg_mi/viewer/compilation.py:compile_stream": "is the standard output of a process",
    "nerg_mi/tracking/readers/skeleton.py:_open_text": "writes to the path of `replace_atomically`",
}


def direct_writers(text: str) -> list[tuple[str, int, str]]:
    """Return ``(function, line, source)`` of calls that write outside of a `replace_atomically` block."""
    calls = []

    def visit(node, function, safe):
        if isinstance(node, (ast.FunctionDef, ast.Lambda)):
            function = getattr(node, "name", function)
        if isinstance(node, ast.With) and any("_atomically" in ast.unparse(item.context_expr) for item in node.items):
            safe = True
        if isinstance(node, ast.Call) and not safe and _writes(node):
            calls.append((function, node.lineno, ast.unparse(node)))
        for child in ast.iter_child_nodes(node):
            visit(child, function, safe)

    visit(ast.parse(text), "", False)
    return calls


def _writes(call: ast.Call) -> bool:
    name = call.func.attr if isinstance(call.func, ast.Attribute) else getattr(call.func, "id", "")
    owner = ast.unparse(call.func.value) if isinstance(call.func, ast.Attribute) else ""
    if name in OPENERS:
        arguments = [*call.args, *(k.value for k in call.keywords if k.arg == "mode")]
        modes = [a.value for a in arguments if isinstance(a, ast.Constant) and isinstance(a.value, str)]
        return any(set(mode) <= set("rwaxbt+") and set(mode) & set("wax+") for mode in modes)
    if name in ("write_text", "write_bytes"):
        return bool(owner)  # a method of Path; the functions of this package are safe
    if name in ("save", "replace") and owner in ("np", "numpy", "torch", "image", "os"):
        return True
    if name == "write" and not owner:
        return False  # a function passed as an argument
    return name in METHODS and not owner.startswith(("sys.", "json"))


def test_files_are_written_atomically():
    violations = []
    for path in SOURCES:
        name = str(path.relative_to(ROOT))
        for function, line, text in direct_writers(path.read_text(encoding="utf-8")):
            if not {name, f"{name}:{function}"} & set(EXCEPTIONS):
                violations.append(f"{name}:{line}: {text}")
    assert len(SOURCES) > 100 and not violations, "write through nerg_mi.files.atomic:\n" + "\n".join(violations)


def test_exceptions_are_still_needed():
    for name in EXCEPTIONS:
        path, _, function = name.partition(":")
        calls = direct_writers((ROOT / path).read_text(encoding="utf-8"))
        assert [c for c in calls if not function or c[0] == function], f"{name} no longer writes anything"


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
    assert not direct_writers(f"with replace_atomically(path) as temporary:\n    {text}")


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
