"""Names in docstrings, comments and pages exist.

    python -m tools.backticks

lists the names in the tracked Python and Markdown files, in backticks or with underscores, that are not defined: as a
function, class, attribute, parameter, module, file, key or option of the project, or in a package that it uses. In a
Python file they may also be variables of that file. Exit code 1 where a name is missing.
"""

from __future__ import annotations

import ast
import importlib
import io
import keyword
import re
import subprocess
import sys
import tokenize
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]

SKIPPED = {"CHANGELOG.md", "tools/words.py", "tools/backticks.py"}
"""Files that name what does not exist, or are generated from strings."""

PACKAGES = ("builtins", "dataclasses", "drjit", "io", "mitsuba", "numpy", "os", "scipy", "typing")
"""Packages whose names need not occur in the code."""

EXTERNAL = set(
    """
    array_like concurrent futures mutmut noqa pyright ssh trapz
    align_corners also_copy coverage.py data_range gaussian_weights general_roc geo_feat get_depth_image_from_path
    get_grid_index hook_type jit_llvm_set_target pkg_resources projectaria_tools pytest_add_cli_args_test_selection
    install_completion render_sample show_completion source_paths use_sample_covariance vector_width
    CUDA_VISIBLE_DEVICES CameraHandle DeviceCadExtrinsics EyeGazeReader GazeColumns GazeValidity GaussianMixture
    GetGazeRay NeRFNetwork RBIntegrator gaze_prediction.py network.py processPlyBuffer projectPoints
    _test _val black_transparent exiftool left_eye_validity nerfw nerg_ep ngp_ep sharpen shutter_close
    Anna YourConfig mps_anna_vrs mutants our_lab stem_x stem_y stemx userN without_person
    """.split()
)
"""Names of other software, of its options and files, and of examples."""

_QUOTED = re.compile(r"(?<!`)(``?)(?!`)(.+?)(?<!`)\1(?!`)", re.DOTALL)
_WORD = re.compile(r"[^\W\d]\w+")
_NAME = re.compile(r"(?<![\w\\{-])(?:--[a-z]+(?:-\w+)*|[^\W\d]\w*(?:\.[^\W\d]\w*)*)")
_PATH = re.compile(r"(?<![\w./{}*<>-])(?:\w+/)*\w+\.py\b")
_UNDERSCORED = re.compile(r"(?<![\w./*{<-])[a-z]\w+_\w\w+(?![\w./*}>-])")
_PLACEHOLDER = re.compile(r"([a-z]\w*_)?[A-Z]+|(d?[^\W\d_]_\w+²?)|\w+_([ij]+|[xyz])|.*\d.*|.*_")
_PHRASE = re.compile(r"[a-z]+ [a-z]")
_CODE = re.compile(r"^ *```.*?^ *```", re.DOTALL | re.MULTILINE)


class PythonFile:
    """Names that a file defines and uses, and its docstrings and comments with their first lines."""

    def __init__(self, source: str) -> None:
        tree = ast.parse(source)
        self.defined: set[str] = {name for statement in tree.body for name in _stored(statement)}
        self.used: set[str] = set()
        self.classes: dict[str, tuple[set[str], list[ast.expr]]] = {}
        nodes = list(ast.walk(tree))
        documents = [node.value for node in nodes if isinstance(node, ast.Expr) and _is_text(node.value)]
        self.sentences = [(node.lineno, node.value) for node in documents]
        strings = {id(node): node.value for node in nodes if _is_text(node)}
        for text in [strings[node] for node in strings.keys() - {id(node) for node in documents}]:
            words = _WORD.findall(text)
            self.used.update(words)
            self.defined.update(word for word in words if "_" in word or not _PHRASE.search(text))
        for node in nodes:
            if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef, ast.ClassDef)):
                self.defined.add(node.name)
            elif isinstance(node, (ast.arg, ast.keyword)):
                self.defined.add(node.arg or "")
            elif isinstance(node, ast.Attribute):
                self.defined.add(node.attr)
            elif isinstance(node, ast.alias):
                self.defined.update(node.name.split("."), [node.asname or ""])
            elif isinstance(node, ast.Name):
                self.used.add(node.id)
            if isinstance(node, ast.ClassDef):
                members = {name for statement in node.body for name in _stored(statement)}
                self.defined |= members
                members |= {n.attr for n in ast.walk(node) if isinstance(n, ast.Attribute) and _stores(n)}
                self.classes[node.name] = members, node.bases
        block, first = list[str](), 0
        for token in tokenize.generate_tokens(io.StringIO(source).readline):
            if token.type == tokenize.COMMENT:
                first = first if block else token.start[0]
                block.append(token.string.lstrip("#: "))
            elif block and token.type != tokenize.NL:
                self.sentences.append((first, "\n".join(block)))
                block = []


def _is_text(node: ast.AST) -> bool:
    return isinstance(node, ast.Constant) and isinstance(node.value, str)


def _stores(node: ast.AST) -> bool:
    return isinstance(getattr(node, "ctx", None), ast.Store)


def _stored(statement: ast.stmt) -> set[str]:
    """Names that a statement of a module or class defines."""
    if isinstance(statement, (ast.FunctionDef, ast.AsyncFunctionDef, ast.ClassDef)):
        return {statement.name}
    return {node.id for node in ast.walk(statement) if isinstance(node, ast.Name) and _stores(node)}


class Names:
    """Everything that a sentence may name."""

    def __init__(self, tracked: list[str]) -> None:
        self.paths = set(tracked)
        self.python = {n: PythonFile((ROOT / n).read_text(encoding="utf-8")) for n in tracked if n.endswith(".py")}
        self.classes: dict[str, list[tuple[set[str], list[ast.expr]]]] = {}
        for name, definition in [item for file in self.python.values() for item in file.classes.items()]:
            self.classes.setdefault(name, []).append(definition)
        self.words = EXTERNAL.union(keyword.kwlist, *(file.defined for file in self.python.values()))
        for name in tracked:
            self.words.update(_WORD.findall(name))
            if not name.endswith((".py", ".md")):
                self.words.update(_WORD.findall((ROOT / name).read_text(encoding="utf-8", errors="ignore")))
        for package in PACKAGES:
            for name, value in vars(importlib.import_module(package)).items():
                self.words |= {name, *(dir(value) if isinstance(value, type) else ())}

    def has_member(self, owner: str, name: str) -> bool:
        """Whether a class ``owner`` has ``name``, or a parent that is not of the project."""
        if owner not in self.classes:
            return True
        return any(
            name in members or any(self.has_member(getattr(base, "id", ""), name) for base in bases)
            for members, bases in self.classes[owner]
        )

    def find_missing(self, sentence: str, variables: set[str]) -> Iterator[tuple[int, str]]:
        """Position and name of what ``sentence`` names and neither the project nor ``variables`` define."""
        for quote in _QUOTED.finditer(sentence):
            text, is_phrase = quote.group(2), _PHRASE.search(quote.group(2))
            for match in () if "\\" in text else _NAME.finditer(text):
                parts = re.sub("^--(no-)?", "", match.group()).replace("-", "_").split(".")
                for owner, part in zip(["", *parts], parts):
                    if owner in self.classes and not self.has_member(owner, part):
                        yield quote.start(), f"{owner}.{part}"
                    elif not ((is_phrase and "_" not in part) or self.is_name(part, variables)):
                        yield quote.start(), part
        plain = _QUOTED.sub(lambda match: "." * len(match.group()), sentence)
        for match in _UNDERSCORED.finditer(plain):
            if not self.is_name(match.group(), variables):
                yield match.start(), match.group()
        for match in _PATH.finditer(sentence):
            if match.group() not in self.words and not any(f"/{p}".endswith(f"/{match.group()}") for p in self.paths):
                yield match.start(), match.group()

    def is_name(self, word: str, variables: set[str]) -> bool:
        return word in self.words or word in variables or bool(_PLACEHOLDER.fullmatch(word))


def main() -> int:
    output = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, check=True).stdout
    names = Names([name for name in output.decode().split("\0") if (ROOT / name).is_file()])
    count = 0
    for path in sorted(names.paths - SKIPPED):
        file = names.python.get(path)
        if file:
            sentences = file.sentences
        elif path.endswith(".md"):
            sentences = [(1, _CODE.sub(lambda match: "\n" * match.group().count("\n"), (ROOT / path).read_text()))]
        else:
            continue
        for line, sentence in sentences:
            for position, name in names.find_missing(sentence, file.used if file else set()):
                print(f"{path}:{line + sentence.count(chr(10), 0, position)}: {name!r} does not exist")
                count += 1
    return int(count > 0)


if __name__ == "__main__":
    sys.exit(main())
