"""Which files a data set's folder consists of, and which of its frames are held out."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np

from nerg_mi.errors import MissingFile, NergError
from nerg_mi.files.bounded import plain
from nerg_mi.ranges import LENGTHS, check_number

from .colmap import read_colmap
from .images import split_holdout
from .named_poses import describe_other_models, find_source
from .posed import Frame, PosedImages, Unused, name_some
from .transforms import read_dataparser, read_transforms
from .upright import Up, find_up, turn_to_z

COORDINATES = ("file", "upright", "original")
# Of files that are taken for photos, in small letters.
_PHOTOS = (".png", ".jpg", ".jpeg", ".exr")
# What trainings write, into a capture's folder as well.
_WRITTEN = (".safetensors", ".run", ".preview.png")


@dataclass(frozen=True)
class Split:
    """``posed``: the training file, its frames those to train on; ``held_out``: frames, chosen by the ``rule``, a few
    words for provenance."""

    posed: PosedImages
    held_out: list[Frame]
    rule: str


def read_posed(source: Path, allow_outside: bool = False) -> PosedImages:
    """Read what `find_source` found. ``allow_outside``: use files outside of its folder too (of a COLMAP model: of the
    one that holds its images), to which names and links in it may lead."""
    if source.is_file():
        return read_transforms(source, allow_outside)
    folders = [source, *list(source.resolve().parents)[:3]]
    images = next((f / "images" for f in folders if (f / "images").is_dir()), None)
    if images is None:
        raise MissingFile(
            f'there is no folder "images" beside or above the COLMAP model "{source}"; put the photos there'
        )
    masks = images.with_name("masks")
    posed = read_colmap(source, images, masks if masks.is_dir() else None, allow_outside)
    return replace(posed, notes=[*posed.notes, *describe_other_models(source)])


def read_split(
    dataset: str | Path,
    holdout: int | None = None,
    coordinates: str = "file",
    scale: float = 1.0,
    allow_outside: bool = False,
) -> Split:
    """Read ``dataset`` and set its held-out frames apart.

    ``holdout``: every so many frames, 0 none. None: the frames of a ``transforms_test.json`` or else
    ``transforms_val.json`` beside the file, or those that the file itself lists for testing, or every 8th.
    ``coordinates``: "file"; "upright", those turned about their origin so that up is +z, as cameras and points tell
    (`find_up`; `NergError` where the cameras do not agree); "original", before the writer applied its
    ``applied_transform``; or a ``dataparser_transforms.json``, those that nerfstudio trained in.
    ``scale``: of all lengths, after that.
    ``allow_outside``: as `read_posed` has it.
    """
    source = find_source(dataset)
    posed = read_posed(source, allow_outside)
    whole = posed
    similarity = _similarity(posed, coordinates, scale)
    posed = posed.moved(similarity)
    if posed.spare:
        spare = set(posed.spare)
        posed = replace(
            posed,
            frames=[f for f in posed.frames if f.name not in spare],
            notes=[*posed.notes, f"{len(spare)} frames are in no training or test list of {posed.path.name}"],
        )
    other = _test_file(source) if holdout is None else None
    test = None if other is None else read_transforms(other, allow_outside)
    posed = replace(posed, notes=[*posed.notes, *_describe_leftovers([whole, *([] if test is None else [test])])])
    if test is not None and other is not None:
        test = test.moved(similarity)
        hidden = {f.image.resolve() for f in test.frames}
        both = [f for f in posed.frames if f.image.resolve() in hidden]
        train = [f for f in posed.frames if f.image.resolve() not in hidden]
        if not train:
            raise NergError(
                f'all frames of "{posed.path}" are also in "{other.name}", which holds them out; use holdout 0'
            )
        unused = [*posed.unused, *(Unused(f.name, f"it is held out by {other.name}") for f in both), *test.unused]
        posed = replace(posed, frames=train, unused=unused, notes=[*posed.notes, *test.notes])
        return Split(posed, test.frames, other.name)
    if holdout is None and posed.held_out:
        names = set(posed.held_out)
        train = [f for f in posed.frames if f.name not in names]
        if not train:
            raise NergError(f'"{posed.path}" holds out all of its frames; use holdout 0')
        return Split(
            replace(posed, frames=train), [f for f in posed.frames if f.name in names], f"listed in {posed.path.name}"
        )
    every = 8 if holdout is None else holdout
    train, held = split_holdout(posed.frames, every)
    return Split(replace(posed, frames=train), held, f"every {every}th frame" if every else "none")


def up_of(posed: PosedImages) -> Up:
    """Up, as the cameras of ``posed`` are held and as its points lie."""
    points = np.zeros((0, 3)) if posed.points is None else posed.points
    return find_up(np.stack([f.to_world for f in posed.frames]), points)


def _describe_leftovers(sets: list[PosedImages]) -> list[str]:
    """What lies in the folder of a data set, described by the files of ``sets``, and is not used: photos beside those
    that the files list, and what else the folder holds."""
    resolve = cache(Path.resolve)
    locate = lambda path: resolve(path.parent) / path.name
    listed = {locate(p) for posed in sets for p in posed.images}
    others = {locate(x.path) for posed in sets for f in posed.frames for x in (f.depth, f.mask) if x is not None}
    photos = {
        p
        for folder in {resolve(folder) for posed in sets for folder in posed.folders if folder.is_dir()}
        for p in folder.iterdir()
        if p.suffix.lower() in _PHOTOS and not p.name.startswith((".", "dynamic_mask_"))
    } - others
    stray, notes = sorted(photos - listed), []
    if stray:
        notes.append(
            f"{len(stray)} of {len(photos)} photos have no pose in {sets[0].path.name} and are not used: "
            f"{name_some(p.name for p in stray)}"
        )
    root = sets[0].root.resolve()
    used = {*listed, *others, *stray, *(locate(posed.path) for posed in sets)}
    used = {p.relative_to(root).parts[0] for p in used if p.is_relative_to(root)}
    rest = {p.name for p in root.iterdir() if not (p.name.startswith(".") or p.name.endswith(_WRITTEN))} - used
    if rest:
        notes.append(f'not used of "{plain(root.name)}": {name_some(sorted(rest))}')
    return notes


def _test_file(source: Path) -> Path | None:
    if not source.is_file():
        return None
    for name in ("transforms_test.json", "transforms_val.json"):
        path = source.with_name(name)
        if path.is_file() and path != source:
            return path
    return None


def _similarity(posed: PosedImages, coordinates: str, scale: float) -> np.ndarray:
    """From the file's coordinates to those asked for."""
    check_number(scale, LENGTHS, "scale")
    original = np.eye(4) if posed.original is None else posed.original
    if coordinates == "file":
        to = np.eye(4)
    elif coordinates == "upright":
        up, to = up_of(posed), np.eye(4)
        if not up.sure:
            raise NergError(
                f'the cameras of "{posed.path}" do not agree on what is up (rolled by {up.roll:.0f} degrees), so that '
                'nothing can be turned upright; use the coordinates "file"'
            )
        to[:3, :3] = turn_to_z(up.direction)
    elif coordinates == "original":
        if posed.original is None:
            raise NergError(
                f'"{posed.path}" has no "applied_transform", so that its original coordinates are not known; '
                'use the coordinates "file"'
            )
        to = original
    elif coordinates.endswith(".json"):
        to = read_dataparser(coordinates) @ original
    else:
        raise NergError(
            f"coordinates must be {', '.join(COORDINATES)} or the path of a dataparser_transforms.json, "
            f'got "{coordinates}"'
        )
    return np.diag([scale, scale, scale, 1.0]) @ to
