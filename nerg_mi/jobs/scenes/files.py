"""What the files are that a scene is written for, found from the files themselves."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from nerg_mi.errors import MissingFile, NergError, plain
from nerg_mi.files.safe_read import size_of
from nerg_mi.formats.checkpoint import read_metadata
from nerg_mi.formats.fields import is_field
from nerg_mi.formats.meshes import READERS
from nerg_mi.formats.splats import is_splats, refuse_others
from nerg_mi.jobs.gaze_places import align_of_training, file_of_training, place_key
from nerg_mi.jobs.reporter import Reporter
from nerg_mi.maths.geometry import Similarity
from nerg_mi.rays.dataset import is_dataset
from nerg_mi.rays.dataset_open import load_rays

KINDS = {".npz": "rays", ".parquet": "rays", **dict.fromkeys(READERS, "mesh"), ".vol": "hits", ".xml": "scene"}
"""Suffixes of what is not a checkpoint, and what they hold."""

_SOME = 4096
"""Rays of a dataset that tell whether it has hit points."""

PLACES = ("field", "mesh", "hits", "scene")


@dataclass(frozen=True)
class GivenFiles:
    """``place``: the file that shows where people are, of ``kind`` "field", "mesh", "hits", "scene", or None and "none"
    where nothing is known of it; ``gaze``, ``rays``: files or None; ``about``: provenance of the gaze field;
    ``field_about``: metadata of the radiance field; of Gaussian splats, which are a field as well, there are none."""

    place: Path | None
    kind: str
    gaze: Path | None
    rays: Path | None
    about: dict
    field_about: dict

    @property
    def splats(self) -> bool:
        """Whether the field is one of Gaussian splats."""
        return self.kind == "field" and self.place is not None and is_splats(self.place)

    @property
    def align(self) -> Similarity:
        """From the rays to the place, as the gaze field was trained."""
        return align_of_training(self.about)


def kind_of_file(path: Path) -> str:
    """What ``path`` holds: "field", "gaze", or a value of `KINDS`. Raises `NergError` for anything else."""
    if not path.exists():
        raise MissingFile(f'there is no file "{path}"; correct its name')
    if is_dataset(path):
        return "rays"
    size_of(path)
    suffix = path.suffix.lower()
    if suffix == ".safetensors":
        kind = read_metadata(path).get("kind")
        if kind not in ("radiance", "gaze"):
            raise NergError(f'"{path}" holds a {plain(kind, 40)} field; a scene shows radiance and gaze fields')
        return {"radiance": "field", "gaze": "gaze"}[kind]
    if is_splats(path):
        return "field"
    refuse_others(path)
    if suffix in (".pth", ".pt"):
        raise NergError(f'"{path}" is a checkpoint of torch; make fields of it with "nerg import"')
    if suffix not in KINDS:
        raise NergError(
            f"a scene is written for checkpoints (.safetensors), splats, rays and datasets of them, meshes and scenes "
            f'({", ".join(KINDS)}), and "{path}" is none of these'
        )
    return KINDS[suffix]


def recognise(files: Sequence[Path], geometry: str | None, reporter: Reporter) -> GivenFiles:
    """What ``files`` are, and the place that a gaze field without one was trained in, found beside it by its name.

    ``geometry``: "hits" or "none", of rays alone; None: hits where there are any. A place of rays' hit points that has
    to be made yet is of kind "hits" without a file. Raises `NergError` for what does not make a scene.
    """
    if geometry not in (None, "hits", "none"):
        raise NergError(f'--geometry must be "hits" or "none", got "{geometry}"')
    found: dict[str, tuple[str, Path]] = {}
    for path in files:
        kind = kind_of_file(path)
        role = "place" if kind in PLACES else kind
        if role in found:
            raise NergError(f'"{found[role][1]}" and "{path}" are both a {role}; a scene has one of them')
        found[role] = kind, path
    if not found:
        raise NergError("a scene needs a field, a mesh, a scene file, a gaze field or rays; name one at least")
    gaze, rays = (found[role][1] if role in found else None for role in ("gaze", "rays"))
    about = {} if gaze is None else read_metadata(gaze).get("provenance", {})
    kind, place = found.get("place", ("none", None))
    if place is not None and geometry is not None:
        raise NergError(f'--geometry says what rays alone are shown in, and there is "{place}"; leave out one of them')
    if place is not None and gaze is not None:
        _compare(place, gaze, about, reporter)
    elif gaze is not None:
        kind, place = _trained_in(gaze, about)
    elif place is None:
        kind = geometry or ("hits" if _have_hits(rays) else "none")
    trained = kind == "field" and place is not None and not is_splats(place)
    field_about = read_metadata(place) if trained and place is not None else {}
    return GivenFiles(place, kind, gaze, rays, about, field_about)


def _trained_in(gaze: Path, about: dict) -> tuple[str, Path | None]:
    """The place that the ``gaze`` field was trained in."""
    if about.get("geometry") == "none":
        return "none", None
    try:
        key = place_key(gaze, about)
    except NergError as error:
        raise NergError(f"{error}; name its place, too: nerg scene PLACE GAZE") from error
    path = file_of_training(
        gaze,
        about,
        None,
        "put it beside the gaze field, or name the file: nerg scene PLACE GAZE",
        "name that one: nerg scene PLACE GAZE",
    )
    kinds = {"field_file": "field", "scene_file": KINDS.get(path.suffix.lower(), "scene"), "geometry_file": "hits"}
    return kinds[key], path


def _compare(place: Path, gaze: Path, about: dict, reporter: Reporter) -> None:
    """Warn where a gaze field is to be shown in another place than that of its training."""
    known = _place_file(about)
    if known is None:
        if about.get("geometry") == "none":
            reporter.warn(f'"{gaze}" was trained without a place; surfaces of "{place}" are not where it takes them')
        return
    if not is_field(place, known.get("sha256")):
        reporter.warn(
            f'"{gaze}" was trained in another file than "{place}", {plain(known.get("file"), 80)}; gaze is right only '
            "where surfaces and coordinates are the same"
        )


def training_place(about: dict) -> str | None:
    """The checksum of the file of the place that a gaze field was trained in, by its provenance ``about``; None where
    there was none."""
    known = _place_file(about)
    return None if known is None else known.get("sha256")


def _place_file(about: dict) -> dict | None:
    return next((about[k] for k in ("field_file", "scene_file", "geometry_file") if k in about), None)


def _have_hits(rays: Path | None) -> bool:
    import numpy as np

    if rays is None:
        return False
    hit = load_rays(rays, most=_SOME).hit
    return hit is not None and bool(np.isfinite(hit).all(axis=1).any())
