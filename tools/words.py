"""The language of names and sentences: words that a reader of this field would not understand, with their replacement.

    python -m tools.words

lists each use in the tracked Python and Markdown files. Exit code 1 where there is one. A line that has to use such a
word, such as a quotation, says so with a comment: ``words: ok``.
"""

from __future__ import annotations

import ast
import io
import re
import subprocess
import sys
import tokenize
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]

NAMES = {
    "about": "metadata, description",
    "anew": "again",
    "apart": "distance",
    "asked": "requested, options",
    "foretell": "predict",
    "foretold": "predicted",
    "found": "match, result, hits",
    "given": "options, values, input",
    "kept": "cached, selected, mask",
    "known": "valid, cached, labels",
    "least": "min_",
    "met": "hit",
    "most": "max_",
    "nobody": "no_participants",
    "of": "parent, source",
    "own": "parent, self_",
    "told": "message, reported",
    "way": "path, mode",
    "whoever": "participant, caller",
}
"""Names, or words of names, that say where a value comes from instead of what it is -> what to write."""

WHOLE = {"about", "apart", "least", "most", "of", "own", "way"}
"""Of these, those that are refused only as a whole name: ``of_observer`` and ``two_way`` are plain."""

PHRASES = {
    r"anew": "again",
    r"foretell(s|ing)?|foretold": "predict",
    r"mend(s|ed|ing)?": "fix",
    r"whoever|whomever": "a user who, anyone who",
    r"so many( \w+)? as|as many( \w+)? as there": "each, the number of",
    r"what is of": "what belongs to",
    r"nobody's": "no one's",
    r"at hand": "available",
    r"wherefrom|whereof|thereof|therein|wherein|thereby": "from which, of which, in it",
    r"beside": "next to",
}
"""Regular expressions of words in sentences -> what to write."""

SKIPPED = {"tools/words.py", "CHANGELOG.md"}
"""Files that list such words."""

_PHRASES = {re.compile(rf"\b({pattern})\b", re.IGNORECASE): instead for pattern, instead in PHRASES.items()}
_ALLOWED = "words: ok"


def find_name(name: str) -> str | None:
    """The word of ``NAMES`` that ``name`` uses, or None.

    Predicates (``is_known``), counts (``num_found``) and names of tests use them as ordinary words.
    """
    plain = name.strip("_").lower()
    if plain.startswith(("is_", "num_", "test")):
        return None
    if plain in WHOLE:
        return plain
    return next((word for word in plain.split("_") if word in NAMES and word not in WHOLE), None)


def check_names(tree: ast.AST) -> Iterator[tuple[int, str]]:
    """Line and message of each name that the module ``tree`` defines and that uses a word of ``NAMES``."""
    for node in ast.walk(tree):
        if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef, ast.ClassDef)):
            name = node.name
        elif isinstance(node, ast.arg):
            name = node.arg
        elif isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
            name = node.id
        elif isinstance(node, ast.Attribute) and isinstance(node.ctx, ast.Store):
            name = node.attr
        else:
            continue
        word = find_name(name)
        if word:
            yield node.lineno, f"name {name!r}: instead of {word!r} write e.g. {NAMES[word]}"


def check_sentences(text: str, first: int = 1) -> Iterator[tuple[int, str]]:
    """Line, counted from ``first``, and message of each phrase of ``PHRASES`` in ``text``."""
    for pattern, instead in _PHRASES.items():
        for match in pattern.finditer(text):
            yield first + text.count("\n", 0, match.start()), f"{match.group()!r}: write e.g. {instead}"


def check_file(path: Path) -> list[tuple[int, str]]:
    """Line and message of each finding in the file ``path``."""
    source = path.read_text(encoding="utf-8")
    if path.suffix == ".py":
        findings = list(check_names(ast.parse(source)))
        for token in tokenize.generate_tokens(io.StringIO(source).readline):
            if tokenize.tok_name[token.type] in ("STRING", "COMMENT", "FSTRING_MIDDLE"):
                findings += check_sentences(token.string, token.start[0])
    else:
        findings = list(check_sentences(source))
    lines = source.splitlines()
    return sorted({(line, message) for line, message in findings if _ALLOWED not in lines[line - 1]})


def main() -> int:
    tracked = subprocess.run(["git", "ls-files", "-z", "*.py", "*.md"], cwd=ROOT, capture_output=True, check=True)
    count = 0
    for name in tracked.stdout.decode().split("\0"):
        if name and name not in SKIPPED:
            for line, message in check_file(ROOT / name):
                print(f"{name}:{line}: {message}")
                count += 1
    if count:
        print(f"{count} uses of words that words.py replaces")
    return int(count > 0)


if __name__ == "__main__":
    sys.exit(main())
