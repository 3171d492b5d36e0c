"""Old names of options: they keep working on the command line and as keywords in Python, and appear in no help text.

Each command has a table "old name" -> "new name"; the table of "*" holds for all commands. A name with dashes is a
spelling on the command line, and by it also a keyword (``--log-decades`` is ``log_decades``). A name without dashes is
a keyword only. A row applies where a command has the new name and not the old one.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import fields, is_dataclass
from typing import Any

from nerg_mi.ranges import FLAG

ALL = "*"
"""The key of `OLD_NAMES` whose rows hold for all commands."""

_GAZE_TRAINING = {
    "cap": "max_rays",
    "fresh_directions": "resample_directions",
    "fresh": "resample_directions",
    "weights": "ray_weights",
    "mix_kappa": "prior_kappa",
    "--mix-folds": "--prior-folds",
    "integral": "integral_weight",
}

_CAMERA = {"--from": "--camera", "--to": "--target", "camera_from": "camera", "camera_to": "target"}

OLD_NAMES: Mapping[str, Mapping[str, str]] = {
    ALL: {"--variant": "--mode", "--top": "--vmax", "--decades": "--log-decades", "--most": "--max-samples"},
    "demo": {"--out": "--output"},
    "study": {"--out": "--output"},
    "scene": {**_CAMERA, "--times": "--time-range", "--gap": "--max-gap", "--own": "--first-person"},
    "view": {"--name": "--hostname", "names": "hostnames", "--regions": "--aois"},
    "draw floor": {
        "--cut": "--cut-height",
        "--floor": "--floor-height",
        "--rays": "--num-rays",
        "--views": "--num-views",
        "--people": "--participants",
    },
    "draw sheet": {"--width": "--max-width"},
    "draw surface": {"--below": "--clip-above"},
    "rays import": {
        "--place": "--field",
        "--gap": "--max-gap",
        "--place-name": "--environment",
        "--write-align": "--align-output",
    },
    "rays filter": {
        "--from": "--start",
        "--to": "--end",
        "--velocity": "--velocity-threshold",
        "--dispersion": "--dispersion-threshold",
        "--least": "--min-fixation",
        "--one-ray": "--merge-fixations",
    },
    "rays split": {
        "--zones": "--test-zones",
        "--positions": "--test-positions",
        "--people": "--test-participants",
        "--time": "--test-time",
    },
    "rays plot": {"--cell": "--cell-size"},
    "poses": {"--frames": "--num-frames", "--size": "--max-image-size", "--lens": "--camera-model"},
    "align": {
        "--twin": "--tracking-surface",
        "--cameras": "--tracking-cameras",
        "--place-cameras": "--scene-cameras",
        "--start": "--init",
        "--floor": "--floor-height",
        "--place-floor": "--scene-floor-height",
    },
    "train gaze": {
        **_GAZE_TRAINING,
        "--salience-per": "--salience-unit",
        "--voxel": "--voxel-size",
        "--normalized": "--normalize",
        "--semantic-own": "--semantic-concat",
        "--begin": "--init",
        "--test-people": "--test-participants",
        "--zones": "--validation-zones",
    },
    "eval gaze": {"--blind-kappa": "--prior-kappa"},
    "eval folds": {
        **_GAZE_TRAINING,
        "--first": "--seed",
        "--zones": "--test-zones",
        "--positions": "--test-positions",
        "--people": "--test-participants",
    },
    "report": {
        **_CAMERA,
        "--objects": "--aois",
        "--names": "--show-names",
        "--min-persons": "--min-participants",
        "--eyes": "--viewpoints",
        "--points": "--max-points",
    },
    "import": {"--finest": "--finest-resolution"},
    "export mesh": {
        "--density": "--density-threshold",
        "--fill": "--fill-holes",
        "--keep": "--min-component-area",
        "--unseen": "--keep-unseen",
    },
    "export points": {"--density": "--density-threshold", "--count": "--max-points"},
    "export splats": {"--density": "--density-threshold"},
    "bake": {
        "--from": "--source",
        "--path": "--observer-file",
        "--observers": "--num-observers",
        "--weights": "--ray-weights",
        "bundle": "cone_samples",
        "--detail": "--max-edge",
        "--angle": "--max-angle",
        "--halves": "--split-half",
        "--texture": "--texture-size",
    },
    "stats": {
        "--areas": "--aois",
        "samples": "aoi_samples",
        "--gap": "--max-gap",
        "--pause": "--session-gap",
        "--merge": "--merge-gap",
        "--least": "--min-visit",
        "--seen": "--aoi-visibility",
        "--view": "--fov",
        "cell": "cell_size",
        "--eyes": "--viewpoints",
        "glance": "glance_duration",
        "--height": "--eye-height",
        "--floor": "--floor-height",
        "--step": "--grid-step",
        "--min-people": "--min-participants",
        "--names": "--show-names",
    },
}
"""Old name of an option -> its new name, by command."""

_KEYWORDS = "_nerg_mi_old_keywords"


def _rows(command: str) -> dict[str, str]:
    return {**OLD_NAMES[ALL], **OLD_NAMES.get(command, {})}


def find_spelling(command: str, spellings: Collection[str]) -> Callable[[str], str]:
    """Return a function that maps an old spelling of an option of ``command`` to the new one.

    Parameters
    ----------
    command
        Name of the command, as "train gaze".
    spellings
        All spellings that the command accepts, as "--width" and "--no-refit".

    Returns
    -------
    Callable
        Takes and returns a spelling without its leading dashes; any other word is returned as it is.
    """
    rows = {old: new for old, new in _rows(command).items() if old.startswith("--")}
    rows |= {f"--no-{old[2:]}": f"--no-{new[2:]}" for old, new in rows.items()}
    renamed = {old[2:]: new[2:] for old, new in rows.items() if new in spellings and old not in spellings}
    return lambda word: renamed.get(word, word)


def find_keywords(command: str, spellings: Mapping[str, str]) -> dict[str, str]:
    """Return old keyword -> new keyword of the options of ``command``.

    ``spellings`` maps the keyword of each option to its spelling on the command line.
    """
    keyword_of = {spelling: keyword for keyword, spelling in spellings.items()}
    renamed = {}
    for old, new in _rows(command).items():
        keyword = keyword_of.get(new) if new.startswith("--") else new
        old = old.removeprefix("--").replace("-", "_")
        if keyword in spellings and old not in spellings:
            renamed[old] = keyword
    return renamed


def accept_old_keywords(kind: type, command: str) -> None:
    """Let the dataclass of options ``kind`` and its bases take the old keywords of ``command``, too.

    `nerg_mi.workflows.base.command` calls this. Where the command is declared in another module than its options, the
    options' module calls it as well, so that the old keywords do not depend on what else is imported.
    """
    for base in kind.__mro__:
        if not is_dataclass(base) or "__init__" not in vars(base):
            continue
        renamed = find_keywords(command, get_spellings(base))
        if not renamed:
            continue
        if _KEYWORDS in vars(base):
            vars(base)[_KEYWORDS].update(renamed)
            continue
        setattr(base, _KEYWORDS, renamed)
        base.__init__ = _renaming(base.__init__, renamed)


def get_spellings(kind: Any) -> dict[str, str]:
    """Keyword -> spelling on the command line, for the fields of the dataclass of options ``kind``."""
    return {f.name: f.metadata.get(FLAG) or "--" + f.name.replace("_", "-") for f in fields(kind)}


def _renaming(construct: Callable[..., None], renamed: Mapping[str, str]) -> Callable[..., None]:
    @functools.wraps(construct)
    def __init__(self: Any, *values: Any, **keywords: Any) -> None:
        construct(self, *values, **rename_keywords(renamed, keywords))

    return __init__


def rename_keywords(renamed: Mapping[str, str], keywords: Mapping[str, Any]) -> dict[str, Any]:
    """Return ``keywords`` with the names that ``renamed`` maps old names to; an old name replaces the new one."""
    if not any(name in renamed for name in keywords):
        return dict(keywords)
    new = {name: value for name, value in keywords.items() if name not in renamed}
    return new | {renamed[name]: value for name, value in keywords.items() if name in renamed}


def current_keywords(kind: type, keywords: Mapping[str, Any]) -> dict[str, Any]:
    """Return ``keywords`` of the dataclass of options ``kind`` by their current names."""
    return rename_keywords(vars(kind).get(_KEYWORDS, {}), keywords)


def renamed_options(commands: Iterable[str]) -> list[tuple[str, str, str]]:
    """Return the rows (command, old name, new name) of ``commands``, those of all commands first."""
    return [(name, old, new) for name in (ALL, *commands) for old, new in OLD_NAMES.get(name, {}).items()]
