"""Structure from motion, as seen from outside: which photos can be used, which are compared, and the process that
reconstructs."""

from __future__ import annotations

import hashlib
import importlib.util
import io
import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import warnings
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np

from nerg_mi.errors import NergError, sanitize
from nerg_mi.files.atomic import write_bytes, write_text
from nerg_mi.files.images import check_image
from nerg_mi.files.safe_read import read_bytes, translate_read_errors

from .colmap import UpEstimate
from .posed import UnusedFrame, check_inside

# ---- Which pictures are compared with which ----

MATCHING = ("auto", "exhaustive", "sequential")

MAX_EXHAUSTIVE = 100
"""Of so many pictures, by default, each is compared with each: the work grows with their square."""

# Neighbours, and after them steps of 16, 32, ...; and pictures, evenly over all, of which each is compared with each:
# they find out where a walk comes back to.
_NEIGHBOURS, _LANDMARKS = 10, 60


def select_pairs(count: int, matching: str = "auto") -> list[tuple[int, int]]:
    """Pairs (i, j), i < j, of ``count`` pictures in the order in which they were taken; sorted."""
    if matching not in MATCHING:
        raise NergError(f'matching must be {", ".join(MATCHING)}, got "{matching}"')
    if matching == "exhaustive" or (matching == "auto" and count <= MAX_EXHAUSTIVE):
        return list(combinations(range(count), 2))
    steps = [*range(1, _NEIGHBOURS + 1), *(1 << k for k in range(4, 32) if 1 << k < count)]
    near = {(i, i + step) for step in steps for i in range(count - step)}
    landmarks = range(0, count, -(-count // _LANDMARKS))
    return sorted(near | set(combinations(landmarks, 2)))


# ---- Pictures ----
#
# Pictures as structure from motion takes them: upright copies for the capture, small ones to find features in.

MAX_SIDE = 65_500  # longest side of a picture in pixels: that of a JPEG file

# As good as telephones write them; colours are not stored more coarsely than brightness.
_JPEG = dict(format="JPEG", quality=95, subsampling=0)


@dataclass(frozen=True)
class PhotoCopy:
    """A picture of the capture. ``name``: its file in ``images/``; ``size``, ``small``: width and height of it and of
    the copy that features are found in, in pixels; ``made_by``: what else pictures of one camera have in common (its
    maker, model and focal length, as far as it is told); ``focal``: focal length in pixels of ``size``, None where it
    is not known; ``seconds``: when a video showed it."""

    name: str
    size: tuple[int, int]
    small_size: tuple[int, int]
    camera_key: tuple = ()
    focal: float | None = None
    seconds: float | None = None


@dataclass(frozen=True)
class PhotoFolders:
    """Where copies go: ``images`` of the capture, and ``small``, whose files are called by `small_name`."""

    images: Path
    small_images: Path


def small_file_name(index: int) -> str:
    """File of the small copy of the so-many-th picture: no letter of its own name can be in the way of COLMAP."""
    return f"{index:06d}.png"


def fit_size(size: tuple[int, int], max_side: int) -> tuple[int, int]:
    """``size`` with a longer side of at most ``longest`` pixels."""
    factor = min(1.0, max_side / max(size))
    return max(1, round(size[0] * factor)), max(1, round(size[1] * factor))


def encode_image(image: Any, suffix: str) -> bytes:
    """A Pillow image as the bytes of a PNG or JPEG file, by its ``suffix``."""
    out = io.BytesIO()
    _rgb(image).save(out, **(dict(format="PNG") if suffix.lower() == ".png" else _JPEG))
    return out.getvalue()


def _rgb(image: Any) -> Any:
    # Pillow copies a picture that is RGB already.
    return image if image.mode == "RGB" else image.convert("RGB")


def encode_small_image(image: Any, size: tuple[int, int]) -> bytes:
    """A Pillow image at ``size``, by averaging, as the bytes of a PNG file."""
    from PIL import Image

    out = io.BytesIO()
    small = _rgb(image)
    if small.size != size:
        small = small.resize(size, Image.Resampling.LANCZOS)
    small.save(out, format="PNG", compress_level=1)
    return out.getvalue()


def assign_cameras(pictures: Iterable[PhotoCopy], share_cameras: bool = True) -> list[int]:
    """Number, from 0, of the camera of each picture: those of equal size, maker, model and focal length ``share`` one.

    A telephone held upright and held across has two: each with its principal point at the centre of its pictures.
    """
    found: dict[object, int] = {}
    return [
        found.setdefault((p.size, p.camera_key) if share_cameras else k, len(found) if share_cameras else k)
        for k, p in enumerate(pictures)
    ]


# ---- Photos ----
#
# A folder of photos: which can be used, copied as they are to be looked at.

PHOTO_SUFFIXES = (".jpg", ".jpeg", ".png")  # of the files that are taken for photos, in small letters

# Pictures that a camera writes and that are not read here: to be named, not passed over.
_OTHERS = (".heic", ".heif", ".tif", ".tiff", ".webp", ".dng", ".raw", ".cr2", ".nef", ".arw", ".avif", ".exr", ".bmp")
_ORIENTATION, _MAKE, _MODEL, _DETAILS = 0x0112, 0x010F, 0x0110, 0x8769
_FOCAL, _FOCAL_AS_35 = 0x920A, 0xA405
# The diagonal of the film of 36 x 24 mm, to which the equivalent focal length refers.
_DIAGONAL_35 = 43.267
# So many pixels a photo may have that its bytes do not warrant, and so many bytes: those of large panoramas.
_PIXELS, _BYTES = 1 << 26, 1 << 28
# What makes pictures of the EXIF orientations 2 to 8 upright, as Pillow calls it.
_TURNS = "FLIP_LEFT_RIGHT ROTATE_180 FLIP_TOP_BOTTOM TRANSPOSE ROTATE_270 TRANSVERSE ROTATE_90".split()
# Modes of Pillow whose files other programs read as they are.
_KEPT = ("L", "RGB", "RGBA", "I;16")


def list_photos(folder: str | Path) -> tuple[list[Path], list[UnusedFrame]]:
    """Photos directly in ``folder``, by name, and pictures of other kinds. `NergError` where there is no photo."""
    folder = Path(folder)
    with translate_read_errors(folder, "folder of photos"):
        files = sorted(p for p in folder.iterdir() if not (p.is_dir() or p.name.startswith(".")))
    photos = [p for p in files if p.suffix.lower() in PHOTO_SUFFIXES]
    others = [
        UnusedFrame(p.name, "only JPEG and PNG photos are read; convert it") for p in files if p.suffix.lower() in _OTHERS
    ]
    if not photos:
        if others:
            raise NergError(
                f'"{folder}" holds {len(others)} pictures such as "{sanitize(others[0].name)}" but no JPEG or PNG; '
                "convert them"
            )
        below = folder / "images"
        hint = f'; did you mean "{below}"?' if below.is_dir() else "; name the folder that holds them"
        raise NergError(f'the folder "{folder}" holds no photos (.jpg, .jpeg or .png){hint}')
    return photos, others


def copy_photos(
    photos: list[Path],
    folders: PhotoFolders,
    max_side: int,
    on_progress: Callable[[int, int], None],
    allow_outside: bool = False,
) -> tuple[list[PhotoCopy], list[UnusedFrame]]:
    """Copy each of the ``photos`` to ``folders``, turned as its EXIF orientation says, and those that cannot be used.

    A photo that stands upright as it is stored is copied byte for byte; another is stored anew, a JPEG at quality 95, a
    PNG in 8 bits. ``longest``: side of the small copies in pixels. ``progress(done, of)`` is told after each.
    ``allow_outside``: follow links that lead out of the photos' folder.
    """
    pictures: list[PhotoCopy] = []
    unused: list[UnusedFrame] = []
    seen: dict[str, str] = {}
    for k, path in enumerate(photos):
        try:
            if not path.name.isprintable():
                raise NergError("its name holds what is no character, which COLMAP cannot store; rename it")
            pictures.append(_copied(path, folders, len(pictures), max_side, seen, allow_outside))
        except NergError as error:
            unused.append(UnusedFrame(path.name, str(error)))
        on_progress(k + 1, len(photos))
    return pictures, unused


def _copied(
    path: Path, folders: PhotoFolders, index: int, longest: int, seen: dict[str, str], allow_outside: bool
) -> PhotoCopy:
    """``seen``: names of the photos before by their content, to which this one is added."""
    photo = read_photo(path if allow_outside else check_inside(path.parent, path, "photo"))
    image, name = photo.image, path.name
    before = seen.setdefault(hashlib.sha256(photo.raw).hexdigest(), name)
    if before != name:
        raise NergError(f'it is the same file as "{before}"')
    write_bytes(folders.images / name, photo.raw if photo.is_upright else encode_image(image, path.suffix))
    size = (image.width, image.height)
    small = fit_size(size, longest)
    write_bytes(folders.small_images / small_file_name(index), encode_small_image(image, small))
    focal = photo.focal_35mm / _DIAGONAL_35 * float((size[0] ** 2 + size[1] ** 2) ** 0.5) if photo.focal_35mm else None
    return PhotoCopy(name, size, small, photo.camera_key, focal)


@dataclass(frozen=True)
class Photo:
    """``raw``: the bytes of the file; ``image``: of Pillow, as it is to be looked at; ``stays``: whether that
    is how it is stored; ``made_by``: what its notes tell of its camera; ``as_35``: its focal length in terms of film of
    36 x 24 mm."""

    raw: bytes
    image: Any
    is_upright: bool
    camera_key: tuple = ()
    focal_35mm: float | None = None


def read_photo(path: Path) -> Photo:
    """The photo ``path``; `NergError` for what is none, is damaged, or claims more pixels than its bytes warrant."""
    from PIL.Image import Transpose
    from PIL.JpegImagePlugin import JpegImageFile
    from PIL.PngImagePlugin import PngImageFile

    # Pillow takes four bytes a pixel, and as many again to turn it.
    header = check_image(path, "photo", _PIXELS, _BYTES)
    kind = header.format
    if max(header.size) > MAX_SIDE:
        raise NergError(f'the photo "{path}" has a side of {max(header.size):,} pixels, more than {MAX_SIDE:,}; cut it')
    if kind not in ("jpeg", "png"):
        raise NergError(f'the photo "{path}" is of the kind "{kind}", whatever its name; convert it to JPEG or PNG')
    raw = read_bytes(path, "photo", _BYTES)
    with warnings.catch_warnings(), translate_read_errors(path, "photo"):
        # What is odd about its notes does not matter.
        warnings.simplefilter("ignore")
        # Not by Image.open, which has a limit of its own, below what telephones take by now.
        image = (JpegImageFile if kind == "jpeg" else PngImageFile)(io.BytesIO(raw))
        image.load()
        orientation, made_by, as_35 = _notes(image)
        is_turned = 2 <= orientation <= 8
        upright = image.transpose(Transpose[_TURNS[orientation - 2]]) if is_turned else image
    return Photo(raw, upright, not is_turned and image.mode in _KEPT, made_by, as_35)


def _notes(image: Any) -> tuple[int, tuple, float | None]:
    """The EXIF orientation, what is told of the camera, and the focal length in terms of film of 36 x 24 mm."""
    try:
        notes = image.getexif()
        details = notes.get_ifd(_DETAILS)
        orientation = int(notes.get(_ORIENTATION, 1))
        made_by = (*(str(notes.get(k, "")) for k in (_MAKE, _MODEL)), str(details.get(_FOCAL, "")))
        as_35 = float(details.get(_FOCAL_AS_35, 0))
    except Exception:  # Pillow raises many kinds on damaged notes, without which a photo is as good
        return 1, (), None
    return orientation, made_by, as_35 if 5 <= as_35 <= 2000 else None


# ---- Reconstruction ----
#
# Structure from motion, as seen from outside: starts the process of `worker`, listens, and reads what it found.

LENSES = {"auto": None, "radial": "SIMPLE_RADIAL", "opencv": "OPENCV"}
"""Names of lenses -> COLMAP's model that is refined; auto: by how many pictures a camera has."""


@dataclass(frozen=True)
class StructureSettings:
    """``lens``: one of `LENSES`; ``matching``: as `chosen_pairs` has it; ``share``: pictures share cameras; ``orient``:
    turn the model so that up is +z; ``threads``: None for all."""

    lens: str = "auto"
    matching: str = "auto"
    share_cameras: bool = True
    orient: bool = True
    seed: int = 0
    threads: int | None = None


@dataclass(frozen=True)
class Reconstruction:
    """``parts``: names of the pictures of each model that was found, of which the first, the largest, is the one that
    was kept; ``error``: its mean reprojection error in pixels of the small pictures; ``points``: how many it has;
    ``up``: None where it was not asked for; ``lenses``: its cameras (JSON); ``to_world``: (N, 4, 4) OpenGL poses, in
    the order of the first part; ``surface``, ``colors``: points (M, 3) that three pictures see, and their colours
    (M, 3), uint8."""

    models: list[list[str]]
    error: float
    num_points: int
    up: UpEstimate | None
    lenses: list[dict]
    to_world: np.ndarray
    point_positions: np.ndarray
    point_colors: np.ndarray


def check_installed() -> None:
    """Raise ``ImportError``, with the remedy, where pycolmap is not installed."""
    if importlib.util.find_spec("pycolmap") is None:
        raise ImportError('poses of photos need pycolmap, which is not installed: pip install "nerg-mi[poses]"')


def reconstruct(
    pictures: list[PhotoCopy], work: Path, settings: StructureSettings, on_progress: Callable[[str, int, int], None]
) -> Reconstruction | None:
    """Find the poses of ``pictures``, whose small copies lie in ``work``/small; None where no three fit together.

    The model is written to ``work``/sparse/0. ``progress(stage, done, of)``: stages are features, matching, mapping.
    Raises `NergError` where COLMAP ends otherwise than by itself, ``ImportError`` where it is not installed.
    """
    check_installed()
    if settings.lens not in LENSES:
        raise NergError(f'lens must be {", ".join(LENSES)}, got "{settings.lens}"')
    select_pairs(0, settings.matching)
    write_text(work / "job.json", json.dumps(_job(pictures, settings)))
    _run(work, settings.threads, on_progress)
    with np.load(work / "result.npz", allow_pickle=False) as found:
        result, arrays = json.loads(str(found["result"])), {k: found[k] for k in found.files if k != "result"}
    if not result["parts"]:
        return None
    up = result.get("up")
    return Reconstruction(
        [[pictures[k].name for k in sorted(part)] for part in result["parts"]],
        result["error"],
        result["points"],
        None if up is None else UpEstimate(np.array(up["direction"]), up["roll"], up["plane"], up["between"]),
        result["lenses"],
        arrays["to_world"],
        arrays["points"],
        arrays["colors"],
    )


def _job(pictures: list[PhotoCopy], settings: StructureSettings) -> dict[str, Any]:
    numbers = assign_cameras(pictures, settings.share_cameras)
    cameras = []
    for number in range(max(numbers) + 1):
        own = [p for p, n in zip(pictures, numbers) if n == number]
        focal = [p.focal * p.small_size[0] / p.size[0] for p in own if p.focal is not None]
        cameras.append(
            {
                "size": own[0].size,
                "small": own[0].small_size,
                "focal": float(np.median(focal)) if focal else None,
                "pictures": len(own),
            }
        )
    return {
        **asdict(settings),
        "pictures": [{"name": p.name, "camera": n} for p, n in zip(pictures, numbers)],
        "cameras": cameras,
        "lens": LENSES[settings.lens],
        "threads": settings.threads or -1,
    }


def _run(work: Path, threads: int | None, progress: Callable[[str, int, int], None]) -> None:
    """Run the process to its end; it ends with this block at the latest."""
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(p for p in sys.path if p)}
    if threads:
        environment |= {name: str(threads) for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS")}
    command = [sys.executable, "-m", "nerg_mi.photos.structure_worker", str(work)]
    with tempfile.TemporaryFile() as words:
        # In a session of its own: Ctrl-C is for this process, which then ends the other.
        process = subprocess.Popen(
            command,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=words,
            env=environment,
            start_new_session=True,
        )
        try:
            assert process.stdout is not None
            for line in process.stdout:
                progress(*json.loads(line))
            code = process.wait()
        finally:
            process.kill()
            process.wait()
        if code:
            words.seek(0)
            raise NergError(_ended(code, words.read().decode("utf-8", "replace"), work))


def _ended(code: int, words: str, work: Path) -> str:
    """Why the process ended with ``code``, as far as it is known."""
    if shutil.disk_usage(work).free < 1 << 20:
        return f'COLMAP ended early, since the disk of "{work.parent.parent}" is full; free some space'
    if code == -signal.SIGKILL:
        return "COLMAP was ended from outside, probably for want of memory; give a smaller --size or fewer pictures"
    lines = [line for line in words.splitlines() if line.strip()]
    # A trace follows the sentence where a library aborts, and precedes it where Python raises.
    said = next((line for line in lines if "Check failed" in line or "] " in line[:80]), lines[-1] if lines else "")
    return (
        f"COLMAP ended early, with code {code} ({sanitize(said, 200)}); try again with --threads 1, or with other photos"
    )
