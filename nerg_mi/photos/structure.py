"""Structure from motion: preparation of photos, selection of image pairs, and the subprocess that reconstructs."""

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

from nerg_mi.errors import NergError, parameter, sanitize
from nerg_mi.files.atomic import write_bytes, write_text
from nerg_mi.files.images import check_image
from nerg_mi.files.safe_read import read_bytes, translate_read_errors

from .colmap import UpEstimate
from .posed import UnusedFrame, check_inside

# ---- Selection of image pairs ----

MATCHING = ("auto", "exhaustive", "sequential")

MAX_EXHAUSTIVE = 100
"""Maximum number of images for which all pairs are matched by default; the work grows with their square."""

# Number of neighbours in sequence that are matched (besides steps of 16, 32, ...), and number of evenly spaced landmark
# images that are all matched with each other, to find loop closures.
_NUM_NEIGHBORS, _NUM_LANDMARKS = 10, 60


def select_pairs(count: int, matching: str = "auto") -> list[tuple[int, int]]:
    """Return the sorted pairs (i, j), i < j, of ``count`` images in capture order that are matched."""
    if matching not in MATCHING:
        raise NergError(f'matching must be {", ".join(MATCHING)}, got "{matching}"')
    if matching == "exhaustive" or (matching == "auto" and count <= MAX_EXHAUSTIVE):
        return list(combinations(range(count), 2))
    steps = [*range(1, _NUM_NEIGHBORS + 1), *(1 << k for k in range(4, 32) if 1 << k < count)]
    near = {(i, i + step) for step in steps for i in range(count - step)}
    landmarks = range(0, count, -(-count // _NUM_LANDMARKS))
    return sorted(near | set(combinations(landmarks, 2)))


# ---- Copies of images: upright ones for the data set, small ones for feature extraction ----

MAX_SIDE = 65_500  # maximum side of an image in pixels, the limit of JPEG

# The quality of telephones, without chroma subsampling.
_JPEG = dict(format="JPEG", quality=95, subsampling=0)


@dataclass(frozen=True)
class PhotoCopy:
    """An image of the data set.

    Attributes
    ----------
    name
        File name in ``images/``.
    size
        Width and height in pixels.
    small_size
        Width and height of the copy for feature extraction.
    camera_key
        What images of one camera have in common besides their size: maker, model and focal length, if known.
    focal
        Focal length in pixels of ``size``; None if unknown.
    seconds
        Time in the video, if the image is a frame of one.
    """

    name: str
    size: tuple[int, int]
    small_size: tuple[int, int]
    camera_key: tuple = ()
    focal: float | None = None
    seconds: float | None = None


@dataclass(frozen=True)
class PhotoFolders:
    """Destination folders: ``images`` of the data set, and ``small_images``, whose files are named by
    `small_file_name`.
    """

    images: Path
    small_images: Path


def small_file_name(index: int) -> str:
    """Return the file name of the small copy of an image by its index, independent of characters in the original
    name.
    """
    return f"{index:06d}.png"


def fit_size(size: tuple[int, int], max_side: int) -> tuple[int, int]:
    """Scale ``size`` down to a longer side of at most ``max_side`` pixels."""
    factor = min(1.0, max_side / max(size))
    return max(1, round(size[0] * factor)), max(1, round(size[1] * factor))


def encode_image(image: Any, suffix: str) -> bytes:
    """Encode a Pillow image as PNG or JPEG, depending on ``suffix``."""
    out = io.BytesIO()
    _to_rgb(image).save(out, **(dict(format="PNG") if suffix.lower() == ".png" else _JPEG))
    return out.getvalue()


def _to_rgb(image: Any) -> Any:
    # Image.convert copies an image that is already RGB.
    return image if image.mode == "RGB" else image.convert("RGB")


def encode_small_image(image: Any, size: tuple[int, int]) -> bytes:
    """Resize a Pillow image to ``size`` by averaging, and encode it as PNG."""
    from PIL import Image

    out = io.BytesIO()
    small = _to_rgb(image)
    if small.size != size:
        small = small.resize(size, Image.Resampling.LANCZOS)
    small.save(out, format="PNG", compress_level=1)
    return out.getvalue()


def assign_cameras(pictures: Iterable[PhotoCopy], share_cameras: bool = True) -> list[int]:
    """Return the camera index, from 0, of each image.

    With ``share_cameras``, images of equal size, maker, model and focal length share a camera. A telephone that is held
    in portrait and landscape orientation has two cameras, each with its principal point at the image centre.
    """
    camera_numbers: dict[object, int] = {}
    return [
        camera_numbers.setdefault(
            (p.size, p.camera_key) if share_cameras else k, len(camera_numbers) if share_cameras else k
        )
        for k, p in enumerate(pictures)
    ]


# ---- Folders of photos ----

PHOTO_SUFFIXES = (".jpg", ".jpeg", ".png")  # suffixes of photos, in lower case

# Suffixes of camera images that are not supported; such files are reported.
_UNSUPPORTED_SUFFIXES = (
    ".heic",
    ".heif",
    ".tif",
    ".tiff",
    ".webp",
    ".dng",
    ".raw",
    ".cr2",
    ".nef",
    ".arw",
    ".avif",
    ".exr",
    ".bmp",
)
_ORIENTATION, _MAKE, _MODEL, _EXIF_IFD = 0x0112, 0x010F, 0x0110, 0x8769
_FOCAL, _FOCAL_35MM = 0x920A, 0xA405
# Diagonal of 36 x 24 mm film, to which the equivalent focal length refers.
_DIAGONAL_35 = 43.267
# Maximum number of pixels regardless of the file size, and maximum file size in bytes, sufficient for large panoramas.
_MAX_UNWARRANTED_PIXELS, _MAX_PHOTO_BYTES = 1 << 26, 1 << 28
# Pillow's names of the transforms that make images with the EXIF orientations 2 to 8 upright.
_ORIENTATION_TRANSFORMS = "FLIP_LEFT_RIGHT ROTATE_180 FLIP_TOP_BOTTOM TRANSPOSE ROTATE_270 TRANSVERSE ROTATE_90".split()
# Pillow modes whose files other programs can read.
_PORTABLE_MODES = ("L", "RGB", "RGBA", "I;16")


def list_photos(folder: str | Path) -> tuple[list[Path], list[UnusedFrame]]:
    """List the photos directly in ``folder`` by name, and the images in unsupported formats.

    Raises `NergError` if there is no photo.
    """
    folder = Path(folder)
    with translate_read_errors(folder, "folder of photos"):
        files = sorted(p for p in folder.iterdir() if not (p.is_dir() or p.name.startswith(".")))
    photos = [p for p in files if p.suffix.lower() in PHOTO_SUFFIXES]
    unsupported = [
        UnusedFrame(p.name, "only JPEG and PNG photos are supported; convert it")
        for p in files
        if p.suffix.lower() in _UNSUPPORTED_SUFFIXES
    ]
    if not photos:
        if unsupported:
            raise NergError(
                f'"{folder}" contains {len(unsupported)} images such as "{sanitize(unsupported[0].name)}" but no JPEG '
                "or PNG; "
                "convert them"
            )
        subfolder = folder / "images"
        hint = f'; did you mean "{subfolder}"?' if subfolder.is_dir() else "; specify the folder that contains them"
        raise NergError(f'the folder "{folder}" contains no photos (.jpg, .jpeg or .png){hint}')
    return photos, unsupported


def copy_photos(
    photos: list[Path],
    folders: PhotoFolders,
    max_side: int,
    on_progress: Callable[[int, int], None],
    allow_outside: bool = False,
) -> tuple[list[PhotoCopy], list[UnusedFrame]]:
    """Copy ``photos`` to ``folders`` in upright orientation. Returns the copies, and the photos that cannot be used.

    A photo that is stored upright is copied byte by byte. Another one is rotated according to its EXIF orientation and
    encoded again: JPEG with quality 95, PNG with 8 bits.

    Parameters
    ----------
    photos
        The files.
    folders
        Destination folders.
    max_side
        Maximum side of the small copies in pixels.
    on_progress
        Callback ``on_progress(done, total)`` after each photo.
    allow_outside
        Whether links out of the folder of the photos are followed.
    """
    pictures: list[PhotoCopy] = []
    unused: list[UnusedFrame] = []
    seen: dict[str, str] = {}
    for k, path in enumerate(photos):
        try:
            if not path.name.isprintable():
                raise NergError("its file name contains unprintable characters, which COLMAP cannot store; rename it")
            pictures.append(_copy_photo(path, folders, len(pictures), max_side, seen, allow_outside))
        except NergError as error:
            unused.append(UnusedFrame(path.name, error.message))
        on_progress(k + 1, len(photos))
    return pictures, unused


def _copy_photo(
    path: Path, folders: PhotoFolders, index: int, max_side: int, seen: dict[str, str], allow_outside: bool
) -> PhotoCopy:
    """Copy one photo. ``seen``: names of the previous photos by checksum, to which this one is added."""
    photo = read_photo(path if allow_outside else check_inside(path.parent, path, "photo"))
    image, name = photo.image, path.name
    first_name = seen.setdefault(hashlib.sha256(photo.raw).hexdigest(), name)
    if first_name != name:
        raise NergError(f'it is the same file as "{first_name}"')
    write_bytes(folders.images / name, photo.raw if photo.is_upright else encode_image(image, path.suffix))
    size = (image.width, image.height)
    small = fit_size(size, max_side)
    write_bytes(folders.small_images / small_file_name(index), encode_small_image(image, small))
    focal = photo.focal_35mm / _DIAGONAL_35 * float((size[0] ** 2 + size[1] ** 2) ** 0.5) if photo.focal_35mm else None
    return PhotoCopy(name, size, small, photo.camera_key, focal)


@dataclass(frozen=True)
class Photo:
    """A photo in memory.

    Attributes
    ----------
    raw
        Bytes of the file.
    image
        Upright Pillow image.
    is_upright
        Whether the file is stored upright, in a portable mode.
    camera_key
        Maker, model and focal length from EXIF.
    focal_35mm
        Equivalent focal length for 36 x 24 mm film.
    """

    raw: bytes
    image: Any
    is_upright: bool
    camera_key: tuple = ()
    focal_35mm: float | None = None


def read_photo(path: Path) -> Photo:
    """Read the photo ``path``. Raises `NergError` for another file, a damaged one, or one that claims too many
    pixels.
    """
    from PIL.Image import Transpose
    from PIL.JpegImagePlugin import JpegImageFile
    from PIL.PngImagePlugin import PngImageFile

    # Pillow uses four bytes per pixel, and as many again to rotate the image.
    header = check_image(path, "photo", _MAX_UNWARRANTED_PIXELS, _MAX_PHOTO_BYTES)
    kind = header.format
    if max(header.size) > MAX_SIDE:
        raise NergError(
            f'the photo "{path}" has a side of {max(header.size):,} pixels; the limit is {MAX_SIDE:,}; crop it'
        )
    if kind not in ("jpeg", "png"):
        raise NergError(
            f'the photo "{path}" has the format "{kind}", regardless of its name; convert it to JPEG or PNG'
        )
    raw = read_bytes(path, "photo", _MAX_PHOTO_BYTES)
    with warnings.catch_warnings(), translate_read_errors(path, "photo"):
        # Warnings about unusual EXIF data are irrelevant.
        warnings.simplefilter("ignore")
        # Image.open is not used, because its own size limit is below the size of current telephone photos.
        image = (JpegImageFile if kind == "jpeg" else PngImageFile)(io.BytesIO(raw))
        image.load()
        orientation, made_by, as_35 = _read_exif(image)
        is_turned = 2 <= orientation <= 8
        upright = image.transpose(Transpose[_ORIENTATION_TRANSFORMS[orientation - 2]]) if is_turned else image
    return Photo(raw, upright, not is_turned and image.mode in _PORTABLE_MODES, made_by, as_35)


def _read_exif(image: Any) -> tuple[int, tuple, float | None]:
    """Read the EXIF orientation, the camera key, and the equivalent focal length for 36 x 24 mm film."""
    try:
        exif = image.getexif()
        details = exif.get_ifd(_EXIF_IFD)
        orientation = int(exif.get(_ORIENTATION, 1))
        made_by = (*(str(exif.get(k, "")) for k in (_MAKE, _MODEL)), str(details.get(_FOCAL, "")))
        as_35 = float(details.get(_FOCAL_35MM, 0))
    except Exception:  # Pillow raises many types of exceptions for damaged EXIF data, which is optional
        return 1, (), None
    return orientation, made_by, as_35 if 5 <= as_35 <= 2000 else None


# ---- Reconstruction in a subprocess (`structure_worker`) ----

LENSES = {"auto": None, "radial": "SIMPLE_RADIAL", "opencv": "OPENCV"}
"""COLMAP camera model by lens name; auto selects it by the number of images per camera."""


@dataclass(frozen=True)
class StructureSettings:
    """Settings of the reconstruction.

    Attributes
    ----------
    lens
        One of `LENSES`.
    matching
        As in `select_pairs`.
    share_cameras
        Whether images share cameras.
    orient
        Whether to rotate the model so that up is +z.
    seed
        Random seed.
    threads
        Number of threads; None for all.
    """

    lens: str = "auto"
    matching: str = "auto"
    share_cameras: bool = True
    orient: bool = True
    seed: int = 0
    threads: int | None = None


@dataclass(frozen=True)
class Reconstruction:
    """Result of structure from motion.

    Attributes
    ----------
    models
        Image names of each model. The first model is the largest, and the one to which the other attributes refer.
    error
        Mean reprojection error in pixels of the small images.
    num_points
        Number of points.
    up
        Estimate of the up direction; None if the model was not oriented.
    lenses
        Cameras (JSON).
    to_world
        OpenGL poses (N, 4, 4) in the order of the first model.
    point_positions
        Points (M, 3) that at least three images see.
    point_colors
        Colours (M, 3) of these points, uint8.
    """

    models: list[list[str]]
    error: float
    num_points: int
    up: UpEstimate | None
    lenses: list[dict]
    to_world: np.ndarray
    point_positions: np.ndarray
    point_colors: np.ndarray


def check_installed() -> None:
    """Raise ``ImportError`` with the install command if pycolmap is not installed."""
    if importlib.util.find_spec("pycolmap") is None:
        raise ImportError('poses of photos need pycolmap, which is not installed: pip install "nerg-mi[poses]"')


def reconstruct(
    pictures: list[PhotoCopy], work: Path, settings: StructureSettings, on_progress: Callable[[str, int, int], None]
) -> Reconstruction | None:
    """Estimate the poses of ``pictures`` with COLMAP. Returns None if no three images can be registered together.

    Parameters
    ----------
    pictures
        Images, whose small copies are in ``work``/small.
    work
        Working folder. The model is written to ``work``/sparse/0.
    settings
        Settings.
    on_progress
        Callback ``on_progress(stage, done, total)``; stages are features, matching and mapping.

    Raises
    ------
    NergError
        If COLMAP terminates abnormally.
    ImportError
        If pycolmap is not installed.
    """
    check_installed()
    if settings.lens not in LENSES:
        raise NergError(f'lens must be {", ".join(LENSES)}, got "{settings.lens}"')
    select_pairs(0, settings.matching)
    write_text(work / "job.json", json.dumps(_describe_job(pictures, settings)))
    _run_process(work, settings.threads, on_progress)
    with np.load(work / "result.npz", allow_pickle=False) as archive:
        result, arrays = json.loads(str(archive["result"])), {k: archive[k] for k in archive.files if k != "result"}
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


def _describe_job(pictures: list[PhotoCopy], settings: StructureSettings) -> dict[str, Any]:
    numbers = assign_cameras(pictures, settings.share_cameras)
    cameras = []
    for number in range(max(numbers) + 1):
        camera_pictures = [p for p, n in zip(pictures, numbers) if n == number]
        focal = [p.focal * p.small_size[0] / p.size[0] for p in camera_pictures if p.focal is not None]
        cameras.append(
            {
                "size": camera_pictures[0].size,
                "small": camera_pictures[0].small_size,
                "focal": float(np.median(focal)) if focal else None,
                "pictures": len(camera_pictures),
            }
        )
    return {
        **asdict(settings),
        "pictures": [{"name": p.name, "camera": n} for p, n in zip(pictures, numbers)],
        "cameras": cameras,
        "lens": LENSES[settings.lens],
        "threads": settings.threads or -1,
    }


def _run_process(work: Path, threads: int | None, on_progress: Callable[[str, int, int], None]) -> None:
    """Run the subprocess; it is terminated at the end of the call at the latest."""
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(p for p in sys.path if p)}
    if threads:
        environment |= {name: str(threads) for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS")}
    command = [sys.executable, "-m", "nerg_mi.photos.structure_worker", str(work)]
    with tempfile.TemporaryFile() as error_output:
        # In its own session, so that only this process receives Ctrl-C, and then terminates the subprocess.
        process = subprocess.Popen(
            command,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=error_output,
            env=environment,
            start_new_session=True,
        )
        try:
            assert process.stdout is not None
            for line in process.stdout:
                on_progress(*json.loads(line))
            code = process.wait()
        finally:
            process.kill()
            process.wait()
        if code:
            error_output.seek(0)
            raise NergError(_explain_exit(code, error_output.read().decode("utf-8", "replace"), work))


def _explain_exit(code: int, error_output: str, work: Path) -> str:
    """Explain why the process exited with ``code``, as far as it is known."""
    if shutil.disk_usage(work).free < 1 << 20:
        return f'COLMAP failed because the disk of "{work.parent.parent}" is full; free some space'
    if code == -signal.SIGKILL:
        return (
            f"COLMAP was killed, probably because memory was short; use a smaller {parameter('max_image_size')} or "
            "fewer images"
        )
    lines = [line for line in error_output.splitlines() if line.strip()]
    # The message precedes the stack trace if a library aborts, and follows it if Python raises.
    message = next((line for line in lines if "Check failed" in line or "] " in line[:80]), lines[-1] if lines else "")
    return (
        f"COLMAP failed with exit code {code} ({sanitize(message, 200)}); try {parameter('threads', 1)} or other photos"
    )
