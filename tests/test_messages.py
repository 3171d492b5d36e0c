"""What the program says, as text: errors in one plain sentence with their remedy, lines of help in the same way."""

from __future__ import annotations

import ast
import re
from dataclasses import fields, is_dataclass
from importlib import import_module
from pkgutil import iter_modules

import pytest

import nerg_mi as nerg
from tests import messages
from tests.messages import HOLE

LONGEST = 300

AMERICAN = re.compile(
    r"\b(?:colors?|colored|gray|centers?|centered|neighbors?|meters?|behaviou?r(?<!iour)|modeling|labeled|traveled|"
    r"normaliz\w+|optimiz\w+|initializ\w+|recogniz\w+|summariz\w+|organiz\w+|visualiz\w+|minimiz\w+|maximiz\w+|"
    r"polarized|unrecognized|artifacts?|fulfill)\b"
)
PLEADING = re.compile(
    r"!|\bplease\b|\bsorry\b|\boops\b|\bunfortunately\b|\bwe\b|\bour\b|\bI\b|\bcannot be null\b", re.I
)
REMEDY = re.compile(r";|:|,|\bmust\b|\bneeds?\b|\bgive\b|\bis not\b|\bis no\b|\bcan be no\b|\bdoes not\b")

FRAGMENTS = re.compile(r"^(?:it|its|the model has no camera) ")
"""Begin what a caller makes a sentence of: which file or frame it is stands before, what to do behind it."""

NO_REMEDY = {
    "there are no probes to train on": "what calls it has placed probes, and says itself why there is none",
    "there are no pictures to train on": "what calls it has read the pictures, and says itself why there is none",
    f"cascades of {HOLE}^3 cells to a bound of {HOLE} have no torch-ngp form": "that field has no such form at all",
    f'the scene file "{HOLE}" (line {HOLE}) {HOLE}': "the end of the sentence is what is wrong there, and what to do",
    HOLE + HOLE: "the sentence of another error",
    HOLE: "the sentence of another error",
}
"""Messages without a remedy -> why."""

FOREIGN = {
    "graph_uid": "Aria's name of a world",
    "yaw_rads_cpf": "a column of Aria",
    "left_yaw_rads_cpf": "a column of Aria",
    "right_yaw_rads_cpf": "a column of Aria",
    "start_timestamp": "a column of Pupil Cloud",
    "translation_x": "a column of Pupil Cloud",
    "rotation_x": "a column of Pupil Cloud",
    "eye_gaze": "a folder of Aria",
    "applied_transform": "an entry of transforms.json",
    "place_x": "a column of a file of pairs",
    "place_y": "a column of a file of pairs",
    "place_z": "a column of a file of pairs",
    "set_variant": "a function of Mitsuba",
    "load_dict": "a function of Mitsuba",
    "llvm_ad_rgb": "a variant of Mitsuba",
    "cuda_ad_rgb": "a variant of Mitsuba",
    "llvm_ad_mono": "a variant of Mitsuba",
    "to_world": "a parameter of Mitsuba's plugins",
    "crop_width": "a parameter of Mitsuba's films",
    "crop_height": "a parameter of Mitsuba's films",
    "userN_PLACE": "the name of files of EyeNavGS",
    "nerg_mi": "this package",
    "attention_law": "a module that is given as an example",
    "__name__": "Python's own, in the line that a script needs",
    "__main__": "Python's own, in the line that a script needs",
    "emit_capture": "a value of --variant",
    "gaze_std": "an AOV",
    "PRGn_r": "a colour map of matplotlib",
    "RdBu_r": "a colour map of matplotlib",
    "PuOr_r": "a colour map of matplotlib",
    "BrBG_r": "a colour map of matplotlib",
}
"""Names with an underscore that people meet elsewhere -> what they are."""

ERRORS, HELP = messages.errors(), messages.help_lines()


def names_of_options() -> set[str]:
    """The fields of all options, which are keywords of Python's functions, and the names of readers and the API."""
    from nerg_mi.rays.readers.registry import reader_names

    found = {*nerg.__all__, *reader_names()}
    for package in ("nerg_mi.jobs.options", "nerg_mi.training.gaze", "nerg_mi.training.radiance", "nerg_mi.rays"):
        folder = import_module(package)
        for module in (folder, *(import_module(f"{package}.{m.name}") for m in iter_modules(folder.__path__))):
            kinds = [kind for kind in vars(module).values() if isinstance(kind, type) and is_dataclass(kind)]
            found |= {field.name for kind in kinds for field in fields(kind)}
    found |= {name for function in ("split_rays", "place_probes") for name in parameters(function)}
    return found


def parameters(function: str) -> set[str]:
    """The parameters of all functions of that name."""
    found = set()
    for path in (messages.ROOT / "nerg_mi").rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.FunctionDef) and node.name == function:
                found |= {argument.arg for argument in (*node.args.args, *node.args.kwonlyargs)}
    return found


def plain(text: str) -> str:
    """Without what is quoted, which is somebody else's text, and without names of files and options."""
    text = re.sub(r'"[^"]*"', '""', text)
    return re.sub(r"--[\w-]+|\b[\w.]+\.(?:json|csv|gz|npz|tsv|safetensors|bin|py)\b", "", text)


def offending(found, wrong) -> list[tuple[str, str]]:
    return [(message.where, message.text) for message in found if wrong(message.text)]


def test01_they_are_all_found():
    assert len(ERRORS) > 600 and len(HELP) > 300
    code = 'raise NergError(f"a {b} c" + ("; d" if e else f"; {f}"))'
    call = ast.parse(code).body[0].exc.args[0]
    assert list(messages.texts(call)) == [f"a {HOLE} c; d", f"a {HOLE} c; {HOLE}"]


def test02_an_error_is_one_sentence_without_a_full_stop():
    assert offending(ERRORS, lambda t: t.endswith((".", "!")) and not t.endswith(("...", f"{HOLE}."))) == []
    assert offending(ERRORS, lambda t: re.search(r"[a-z)\"]\. +[A-Z]", t)) == []
    assert offending(ERRORS, lambda t: t != t.strip() or "\n" in t or "  " in t) == []


def test03_an_error_begins_as_the_second_half_of_a_line_does():
    """It follows "nerg: "; names and what was given may begin it."""
    own = ("Mitsuba", "Pupil", "LLVM", "Dr.Jit", "COLMAP", "MPS", "EXR", "OpenEXR", "PyAV", "FFmpeg", "Unity")
    assert offending(ERRORS, lambda t: re.match(r"[A-Z]", t) and not t.startswith(own)) == []


def test04_an_error_says_what_to_do():
    def silent(text):
        return not (REMEDY.search(text) or FRAGMENTS.match(text) or text in NO_REMEDY)

    assert offending(ERRORS, silent) == []
    said = {message.text for message in ERRORS}
    assert set(NO_REMEDY) <= said, "the table names messages that are gone"


@pytest.mark.parametrize("found", [ERRORS, HELP], ids=["errors", "help"])
def test05_plain_words_spelt_alike(found):
    assert offending(found, lambda t: AMERICAN.search(plain(t))) == []
    assert offending(found, lambda t: PLEADING.search(plain(t))) == []
    # A formula of names, "--map", is as long as there are names.
    assert offending(found, lambda t: len(t) > LONGEST and "origin=" not in t) == []


@pytest.mark.parametrize("found", [ERRORS, HELP], ids=["errors", "help"])
def test06_no_names_from_inside(found):
    known = names_of_options() | set(FOREIGN)
    inner = lambda t: set(re.findall(r"(?<![\w-])_?[A-Za-z]+(?:_[A-Za-z0-9]+)+\b|__\w+__", plain(t))) - known
    upper = lambda t: {name for name in inner(t) if not name.isupper()}
    assert [(m.where, upper(m.text), m.text) for m in found if upper(m.text)] == []


def test07_help_lines_are_sentences():
    assert offending(HELP, lambda t: not t or not t.endswith((".", "...", ")"))) == []
    # Which preset or kind it is of may stand in front.
    assert offending(HELP, lambda t: re.match(r"[a-z]", t) and not re.match(r"[\w, ]+[:,] ", t)) == []
