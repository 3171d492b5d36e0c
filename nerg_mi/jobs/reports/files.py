"""What the files are that a report is made of, found from the files themselves."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from nerg_mi.errors import MissingFile, NergError
from nerg_mi.files.atomic import file_sha256
from nerg_mi.jobs.reporter import SILENT
from nerg_mi.jobs.scenes.files import KINDS, PLACES, GivenFiles, kind_of_file, recognise
from nerg_mi.rays.dataset import is_dataset
from nerg_mi.rays.dataset_open import rays_digest

RESULTS = "gaze.json"
"""The file of an evaluation that is read."""

_ROLES = {"field": "radiance field", "mesh": "mesh", "hits": "hit points", "scene": "scene"}


@dataclass(frozen=True)
class ReportFiles:
    """``scene``: the place and the gaze field, as a scene is written for; ``gaze``; ``rays``: file or dataset, or None;
    ``results``: files of evaluations."""

    scene: GivenFiles
    gaze: Path
    rays: Path | None
    results: tuple[Path, ...]

    @property
    def shown(self) -> list[Path]:
        """What `nerg scene` is given."""
        return [self.gaze] if self.scene.place is None else [self.scene.place, self.gaze]

    def inputs(self) -> list[tuple[str, str, str]]:
        """Role, name and SHA-256 of each file."""
        out = [("gaze field", self.gaze.name, file_sha256(self.gaze))]
        if self.scene.place is not None:
            role = "splats" if self.scene.splats else _ROLES[self.scene.kind]
            out.append((role, self.scene.place.name, file_sha256(self.scene.place)))
        if self.rays is not None:
            out.append(("rays", self.rays.name, rays_digest(self.rays)))
        return out + [("evaluation", f"{p.parent.name}/{p.name}", file_sha256(p)) for p in self.results]


def sort_files(files: Sequence[Path]) -> ReportFiles:
    """What ``files`` are, in any order: a gaze field, its place (found beside it where it is not given), rays,
    evaluations (``gaze.json``, or the folder that holds one). Any other folder stands for what lies in it.

    Raises `NergError` for what does not make a report.
    """
    found: dict[str, Path] = {}
    results: list[Path] = []
    for path in _unfolded(files):
        if path.suffix.lower() == ".json":
            results.append(path)
            continue
        kind = "rays" if is_dataset(path) else kind_of_file(path)
        role = "place" if kind in PLACES else kind
        if role in found and found[role].resolve() != path.resolve():
            raise NergError(
                f'"{found[role]}" and "{path}" are both a {role}; a report is of one of them: name the files'
            )
        found.setdefault(role, path)
    if "gaze" not in found:
        raise NergError("a report is of a gaze field, and there is none among these files; name its checkpoint")
    shown = [found[role] for role in ("place", "gaze") if role in found]
    return ReportFiles(recognise(shown, None, SILENT), found["gaze"], found.get("rays"), tuple(results))


def _unfolded(files: Sequence[Path]) -> list[Path]:
    """``files`` with what lies in folders in place of these."""
    out: list[Path] = []
    for path in files:
        if not path.exists():
            raise MissingFile(f'there is no file or folder "{path}"; correct its name')
        if not path.is_dir() or is_dataset(path):
            out.append(path)
        elif (path / RESULTS).is_file():
            out.append(path / RESULTS)
        else:
            out += _within(path)
    return out


def _within(folder: Path) -> list[Path]:
    """What a folder holds of which a report is made, in the order of names: checkpoints, rays, evaluations."""
    found = sorted(folder.iterdir())
    kept = [p for p in found if p.suffix.lower() == ".safetensors" and p.is_file()]
    kept += [p for p in found if KINDS.get(p.suffix.lower()) == "rays" and (p.is_file() or is_dataset(p))]
    kept += [p / RESULTS for p in found if p.is_dir() and (p / RESULTS).is_file()]
    if not kept:
        raise NergError(f'the folder "{folder}" holds no checkpoint, rays or evaluation; name others')
    return kept
