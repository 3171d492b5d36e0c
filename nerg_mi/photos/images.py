"""Images, depth and masks of posed sets: reading, undistortion, resizing, and the split into training and held-out
views.

Images: JPEG and PNG of 8 or 16 bits are sRGB with straight alpha. EXR is linear with premultiplied alpha and is
converted; values above white are clipped. Images with alpha show an object in front of nothing.

Orientation: COLMAP, nerfstudio and instant-ngp ignore the EXIF orientation, other programs rotate first. The
camera's width and height decide. Where both fit, photos of a COLMAP model are taken as stored; others are left out
until the tag is removed (``exiftool -Orientation= FILE``).

Masks: ``mask_path`` (black is left out), instant-ngp's ``dynamic_mask_NAME.png`` (white is left out), or
``masks/NAME.png`` next to COLMAP's ``images/`` (black is left out). White begins above half (in a file of zeros and
ones, at one). In a mask of one colour, alpha is the mask.

Depth maps: ``depth_file_path`` or ``depth_path``, distances along the viewing axis (z), or along rays with
``"is_euclidean_depth": true``. 0 and non-finite values are unknown, and so is the background: values far beyond all
others, a maximum that is repeated as only a far plane can be, and the largest number of 16 bits. A map may have
fewer pixels than its photo, in the same shape.

- PNG of 16 bits and NPY: one step is 0.001 m of the original coordinates, else ``depth_unit_scale_factor`` in
  metres, or instant-ngp's ``integer_depth_scale`` in units of the file. NPY in metres needs
  ``"depth_unit_scale_factor": 1.0``.
- EXR: metres, as Record3D writes them, else the same keys; the channel called Z or depth, the only one, or grey.
- Depth whose unit differs from that of the cameras is refused: its median exceeds 100 times the cameras' extent, or
  another usual factor makes a fifth more of its points agree with other views to 5 %. ``--no-depth`` ignores depth.

Sensors of Mitsuba have no distortion: `undistort_photo` returns a photo as a pinhole camera would have taken it, a
mask, and the sensor; `make_pinhole_camera` and `apply_lens` distort a rendering instead.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np

from nerg_mi.errors import NergError, format_error, sanitize
from nerg_mi.files.images import check_image, read_exr
from nerg_mi.files.safe_read import is_regular_file, read_npy, resolve_path, translate_read_errors
from nerg_mi.files.values import FilePath
from nerg_mi.maths.color import encode_srgb
from nerg_mi.ranges import LENGTHS, check_number

from . import cameras
from .cameras import (
    Intrinsics,
    PosedCamera,
    find_view_tangents,
    make_sensor_dict,
    pixel_directions,
    pixel_grid,
    resize_by_area,
    resize_mask,
    resize_nearest,
)
from .colmap import UpEstimate, estimate_up, rotation_to_z
from .observed import ObservedPoints
from .photo_set import PHOTO_SUFFIXES, Photos
from .posed import DepthFile, MaskFile, PosedFrame, PosedImages, UnusedFrame, format_names
from .transforms import read_dataparser, read_transforms

# ---- Images, depth and masks from files ----

_ORIENTATION = 0x0112
# EXIF orientation -> function that makes stored pixels (h, w, c) upright.
_ORIENTATION_TRANSFORMS = {
    2: np.fliplr,
    3: lambda p: np.rot90(p, 2),
    4: np.flipud,
    5: lambda p: p.swapaxes(0, 1),
    6: lambda p: np.rot90(p, -1),
    7: lambda p: np.rot90(p, 2).swapaxes(0, 1),
    8: np.rot90,
}


def read_image(path: str | Path) -> np.ndarray:
    """Read the image (h, w, 3 or 4) as sRGB with straight alpha: uint8 or uint16 as stored, otherwise float32 in 0..1.

    EXR is linear with premultiplied alpha: it is converted to straight alpha and sRGB, and values above white are
    clipped. Raises `NergError` with the file name for a file that cannot be read.
    """
    import mitsuba as mi

    bitmap = open_bitmap(path, "image")
    formats, kinds = mi.Bitmap.PixelFormat, mi.Struct.Type
    kind, pixels = bitmap.component_format(), bitmap.pixel_format()
    if kind in (kinds.UInt8, kinds.UInt16) and bitmap.srgb_gamma():
        # As stored: Mitsuba's conversion uses linear values as an intermediate step.
        out = np.array(bitmap)
        out = out if out.ndim == 3 else out[..., None]
        if pixels in (formats.RGB, formats.RGBA):
            return out
        if pixels in (formats.Y, formats.YA):
            return np.ascontiguousarray(out[..., [0, 0, 0, 1][: 3 if pixels == formats.Y else 4]])
    if pixels == formats.MultiChannel:
        bitmap = _select_color_layer(bitmap, path)
    alpha = bitmap.has_alpha()
    straight = (
        mi.Bitmap.AlphaTransform.Unpremultiply
        if alpha and bitmap.premultiplied_alpha()
        else mi.Bitmap.AlphaTransform.Empty
    )
    pixel_format = formats.RGBA if alpha else formats.RGB
    with translate_read_errors(path, "image", extra_errors=(RuntimeError,)):
        linear = bitmap.convert(pixel_format, kinds.Float32, srgb_gamma=False, alpha_transform=straight)
    out = np.array(linear, np.float32)
    if alpha:
        # The straight colour of a black transparent pixel is 0/0.
        out[..., :3][out[..., 3] == 0] = 0
    if not np.all(np.isfinite(out)):
        raise NergError(f'the image "{path}" contains values that are not finite; create it again')
    out[..., :3] = encode_srgb(np.clip(out[..., :3], 0, 1))
    return np.clip(out, 0, 1)


def get_photo_size(frame: PosedFrame) -> tuple[int, int]:
    """Return width and height from the camera, or otherwise from the file."""
    if "w" in frame.lens and "h" in frame.lens:
        return round(frame.lens["w"]), round(frame.lens["h"])
    height, width = read_photo(frame).shape[:2]
    return width, height


def read_photo(frame: PosedFrame) -> np.ndarray:
    """Read the pixels of a photo in the orientation that the camera of ``frame`` describes.

    If the EXIF orientation rotates the photo, it is rotated if the camera's width and height match the rotated image,
    and left as stored if they match the stored image. If both match, COLMAP poses refer to the stored pixels, since
    COLMAP ignores the orientation. For other poses the orientation is ambiguous, which raises `NergError`.
    """
    pixels, orientation = read_image(frame.image), _read_orientation(frame.image)
    if orientation == 1:
        return pixels
    upright = _ORIENTATION_TRANSFORMS[orientation](pixels)
    fits_stored, fits_upright = (frame.matches_shape(p.shape[1], p.shape[0]) for p in (pixels, upright))
    if fits_stored and fits_upright and not frame.ignores_exif:
        raise NergError(
            f'the photo "{frame.image}" has EXIF orientation {orientation}, and it is unknown '
            "whether its pose and its lens refer to the stored or to the rotated image; store it rotated, or remove "
            "the "
            "EXIF orientation if they refer to the stored image (exiftool -Orientation= FILE)"
        )
    return np.ascontiguousarray(upright) if fits_upright and not fits_stored else pixels


def _read_orientation(path: Path) -> int:
    """Read the EXIF orientation of a JPEG or PNG file, from 1 (as stored) to 8; 1 if it has none."""
    from PIL.JpegImagePlugin import JpegImageFile
    from PIL.PngImagePlugin import PngImageFile

    kinds = {b"\xff\xd8": JpegImageFile, b"\x89P": PngImageFile}
    with warnings.catch_warnings(), open(path, "rb") as file:
        warnings.simplefilter("ignore")
        kind = kinds.get(file.read(2))
        file.seek(0)
        try:
            image = None if kind is None else kind(file)
            # Without this condition, Pillow decodes a PNG to search for EXIF data after its pixels.
            value = 1 if image is None or "exif" not in image.info else image.getexif().get(_ORIENTATION, 1)
        except Exception:  # Pillow raises many types of exceptions for damaged EXIF data, which is optional
            return 1
    return value if value in _ORIENTATION_TRANSFORMS else 1


def open_bitmap(path: str | Path, file_kind: str):
    """Open the image ``path`` as a Mitsuba bitmap, in the way Mitsuba opens it.

    The size is checked in the header first. EXR is read with the OpenEXR library. Raises `NergError` for an image that
    is damaged or too large.
    """
    import mitsuba as mi

    if check_image(path, file_kind).format == "exr":
        return _make_exr_bitmap(read_exr(path, file_kind))
    # Mitsuba raises this type for all errors in a file.
    with translate_read_errors(path, file_kind, extra_errors=(RuntimeError,)):
        return mi.Bitmap(str(path))


def _make_exr_bitmap(channels: dict[str, np.ndarray]):
    import mitsuba as mi

    names, kinds = list(channels), {c.dtype for c in channels.values()}
    values = np.stack(list(channels.values()), axis=-1)
    if len(kinds) > 1:
        values = values.astype(np.float32)
    signature = "".join(n.rpartition(".")[2].lower() for n in names)
    formats = {"rgb": "RGB", "rgba": "RGBA", "y": "Y", "ya": "YA", "xyz": "XYZ", "xyza": "XYZA"}
    format = getattr(
        mi.Bitmap.PixelFormat,
        formats.get(signature, "MultiChannel") if len(signature) == len(names) else "MultiChannel",
    )
    bitmap = mi.Bitmap(values, format, names)
    bitmap.set_premultiplied_alpha(True)
    return bitmap


def _select_color_layer(bitmap, path):
    """Return the colour layer of a multichannel EXR."""
    # Mitsuba raises an error for layers with inconsistent channels.
    with translate_read_errors(path, "image", extra_errors=(RuntimeError,)):
        layers = dict(bitmap.split())
    for name in ("<root>", "rgba", "color"):
        if name in layers:
            return layers[name]
    raise NergError(
        f'the image "{path}" has no channels R, G and B, only the layers {sanitize(", ".join(sorted(layers)))}; '
        "save it with R, G and B"
    )


_MAX_HALF = float(np.finfo(np.float16).max)


def read_depth(source: DepthFile) -> np.ndarray:
    """Read depth (h, w) from ``.npy``, ``.exr`` or 16-bit ``.png`` in scene units, float32; 0 is unknown.

    The largest number of an integer type, and of half precision, is no depth: programs write it for the background.
    """
    path, suffix = source.path, source.path.suffix.lower()
    if suffix == ".npy":
        out = read_npy(path, "depth file")
    elif suffix == ".exr":
        out = _select_depth_channel(read_exr(path, "depth file"), path)
    elif suffix == ".png":
        out = np.array(open_bitmap(path, "depth file"))
        if out.dtype != np.uint16:
            raise NergError(f'the depth file "{path}" must be a 16-bit PNG, but has {out.dtype.itemsize * 8} bits')
    else:
        raise NergError(
            f'depth maps of the format "{sanitize(suffix, 20)}" are not read ("{path}"); convert them to .npy '
            "(numpy.save), .exr or 16-bit .png, and correct depth_file_path"
        )
    if out.ndim == 3 and out.shape[2] == 1:
        out = out[..., 0]
    if out.ndim != 2 or not np.issubdtype(out.dtype, np.number):
        raise NergError(f'the depth file "{path}" must contain one number per pixel, got shape {out.shape}')
    if np.iscomplexobj(out):
        raise NergError(f'the depth file "{path}" contains complex numbers; save it as float32')
    if not np.any(out > 0) and len(np.unique(out[out < 0])) > 1:
        raise NergError(
            f'all values of the depth file "{path}" are negative; distances are positive: negate them, or remove '
            "depth_file_path"
        )
    largest = np.iinfo(out.dtype).max if np.issubdtype(out.dtype, np.integer) else _MAX_HALF
    with np.errstate(over="ignore", invalid="ignore"):  # values beyond float32 are unknown depth
        scaled = out.astype(np.float32) * np.float32(source.unit)
        return np.where(np.isfinite(scaled) & (out > 0) & (out != largest), scaled, 0).astype(np.float32)


def read_mask(source: MaskFile, shape: tuple[int, int]) -> np.ndarray:
    """Read which pixels (h, w) are used, bool. The mask must have the ``shape`` of the image."""
    out = np.array(open_bitmap(source.path, "mask"))
    out = out[..., None] if out.ndim == 2 else out
    if out.shape[:2] != shape:
        raise NergError(
            f'the mask "{source.path}" has {out.shape[1]} x {out.shape[0]} pixels, but its image '
            f"{shape[1]} x {shape[0]}"
        )
    colors = out[..., :1] if out.shape[2] <= 2 else out[..., :3]
    white = _threshold_white(colors).any(axis=2)
    if out.shape[2] in (2, 4):
        opaque = _threshold_white(out[..., -1])
        # The alpha channel of a black stencil alone marks the used pixels.
        is_stencil = not white.any() and not opaque.all()
        white = opaque if is_stencil else white & opaque
    return np.asarray(~white if source.is_inverted else white)


def _threshold_white(values: np.ndarray) -> np.ndarray:
    """Return which ``values`` are above half of white, because JPEG stores black as 1 to 3."""
    if not np.issubdtype(values.dtype, np.integer):
        return values > 0.5
    # Labels 0 and 1, and 8-bit values in 16 bits, are scaled to their maximum.
    white = next(w for w in (1, 255, np.iinfo(values.dtype).max) if values.max(initial=0) <= w)
    return values > 0.5 * white


def _select_depth_channel(channels: dict[str, np.ndarray], path: Path) -> np.ndarray:
    """Select the depth channel of an EXR: the only one, the one with that name, or grey as R, G and B."""
    names = list(channels)
    candidates = [n for n in names if "depth" in n.lower() or n.rpartition(".")[2].lower() == "z"]
    if len(names) == 1 or len(candidates) == 1:
        return channels[candidates[0] if candidates else names[0]]
    if {"R", "G", "B"} <= set(names) and all(np.array_equal(channels["R"], channels[n], True) for n in "GB"):
        return channels["R"]
    raise NergError(
        f'the depth file "{path}" has the channels {format_names(names)}; save it with one channel, or name the '
        'depth Z and no other channel Z or "depth"'
    )


# ---- Views at a chosen size ----


@dataclass(frozen=True)
class PhotoView:
    """An image with its camera.

    Attributes
    ----------
    name
        Name of the frame.
    camera
        Camera of the resized image.
    pixels
        (h, w, 3) or (h, w, 4), sRGB as stored, straight alpha: uint8, uint16 or floats in 0..1.
    depth
        (h, w) float32 distance along the ray of each pixel in scene units, 0 if unknown; or None.
    mask
        (h, w) bool, the pixels that are used; None for all.
    masked_fraction
        Fraction of the pixels that the mask file excludes; None without a mask file.
    points
        Surface points that a reconstruction matched in the image; None if unknown.
    """

    name: str
    camera: PosedCamera
    pixels: np.ndarray
    depth: np.ndarray | None = None
    mask: np.ndarray | None = None
    masked_fraction: float | None = None
    points: ObservedPoints | None = None

    @property
    def shape(self) -> tuple[int, int]:
        """Height and width."""
        return self.pixels.shape[:2]

    @property
    def color(self) -> np.ndarray:
        """The pixels as float32 in 0..1; converted at each access."""
        return _to_float(self.pixels)

    @property
    def has_alpha(self) -> bool:
        return self.pixels.shape[2] == 4

    def composite_over(self, background: float) -> np.ndarray:
        """Composite the image over a grey ``background``: (h, w, 3) float32."""
        color = self.color
        if not self.has_alpha:
            return color
        alpha = color[..., 3:]
        return color[..., :3] * alpha + (1 - alpha) * background


def pick_evenly(views: list[PhotoView], count: int) -> list[PhotoView]:
    """Return at most ``count`` of ``views``, evenly spaced, with the first and the last."""
    return [views[int(k)] for k in np.linspace(0, len(views) - 1, min(count, len(views))).round()]


def split_holdout(frames: list[PosedFrame], every: int) -> tuple[list[PosedFrame], list[PosedFrame]]:
    """Split ``frames``, sorted by file name, into training and held-out frames.

    Every ``every``-th frame, starting with the first, is held out; 0 holds none out.
    """
    if every < 0 or every == 1:
        raise NergError(f"holdout must be 0 (none) or at least 2 (every n-th frame), got {every}")
    if every == 0:
        return list(frames), []
    held_out = frames[::every]
    train = [f for i, f in enumerate(frames) if i % every]
    if not train:
        raise NergError(f"holding out every {every}th of {len(frames)} frames leaves none to train on; use holdout 0")
    return train, held_out


def load_usable_views(
    frames: list[PosedFrame], width: int | None = None, depth: bool = False
) -> tuple[list[PhotoView], list[UnusedFrame]]:
    """Load all ``frames`` with `load_view`. Returns the views, and the frames that cannot be used."""
    check_width(width)
    views, unused = [], []
    for frame in frames:
        try:
            views.append(load_view(frame, width, depth))
        except ValueError as e:
            unused.append(UnusedFrame(frame.name, format_error(e)))
    return views, unused


def check_width(width: int | None) -> None:
    """Raise `NergError` for an invalid width of images."""
    if width is not None and width < 1:
        raise NergError(f"width must be at least 1 pixel, got {width}")


def load_view(frame: PosedFrame, width: int | None = None, depth: bool = False) -> PhotoView:
    """Load ``frame`` at its full size, or at a width of ``width`` pixels.

    Images are resized by area averaging of the stored (sRGB) values, as other trainers do. Depth is resized to the
    nearest value. A pixel is used if all pixels that it covers are set in the mask. ``depth``: whether to read depth
    files. Raises `NergError` with the name of the file that cannot be used.
    """
    check_width(width)
    pixels = read_photo(frame)
    h, w = pixels.shape[:2]
    stated = frame.intrinsics(w, h)
    factor = w / width if width is not None else 1.0
    if factor < 1:
        raise NergError(f'the image "{frame.image}" is only {w} pixels wide; choose a width of at most {w}')
    size = max(1, round(w / factor)), max(1, round(h / factor))
    intrinsics = stated.resized(*size)
    # Each pixel must have a ray. Lens models fold over at the borders first, which this call checks.
    find_view_tangents(intrinsics)
    mask = None if frame.mask is None else resize_mask(read_mask(frame.mask, (h, w)), *size)
    left_out = None if mask is None else 1 - float(mask.mean())
    if intrinsics.fisheye:
        is_visible = np.linalg.norm(pixel_grid(intrinsics), axis=-1) < cameras.find_fisheye_limit(intrinsics)[1]
        mask = mask if is_visible.all() else is_visible if mask is None else mask & is_visible
    if mask is not None and not mask.any():
        raise NergError("its mask excludes all pixels")
    distance = _load_distances(frame.depth, (h, w), intrinsics) if depth and frame.depth is not None else None
    if size != (w, h):
        pixels = resize_by_area(_to_float(pixels), *size)
    if pixels.dtype == np.float32:
        # 16 bits are more precise than the photo and take half the memory of floats.
        pixels = np.round(pixels * 65535).astype(np.uint16)
    camera = PosedCamera(intrinsics, frame.to_world)
    return PhotoView(frame.name, camera, pixels, distance, mask, left_out, frame.points)


def _to_float(pixels: np.ndarray) -> np.ndarray:
    """Convert ``pixels`` of any type of `PhotoView.pixels` to float32 in 0..1."""
    if pixels.dtype in (np.uint8, np.uint16):
        return pixels.astype(np.float32) / np.iinfo(pixels.dtype).max
    return pixels.astype(np.float32, copy=False)


def _load_distances(file: DepthFile, shape: tuple[int, int], intrinsics) -> np.ndarray:
    """Load distances along the rays of the resized image. Depth images may have fewer pixels than the photo."""
    out, (h, w) = read_depth(file), shape
    if abs(out.shape[1] * h - out.shape[0] * w) > 0.01 * w * out.shape[0]:
        raise NergError(
            f'the depth file "{file.path}" has {out.shape[1]} x {out.shape[0]} pixels, which does not match the '
            f"shape of its image, {w} x {h}"
        )
    out = resize_nearest(out, intrinsics.width, intrinsics.height)
    if file.along_axis:
        ahead = -pixel_directions(intrinsics)[..., 2]
        with np.errstate(over="ignore"):
            out = np.where(ahead > 1e-3, out / np.maximum(ahead, 1e-3), 0).astype(np.float32)
        out[~np.isfinite(out)] = 0
    return np.ascontiguousarray(out)


# ---- Files of a data set, and the split into training and held-out frames ----

COORDINATES = ("file", "upright", "original")
# Suffixes of files that trainings write, possibly into the folder of the data set.
_OUTPUT_SUFFIXES = (".safetensors", ".run", ".preview.png", ".curves.csv", ".curves.png")


@dataclass(frozen=True)
class HoldoutSplit:
    """Training and held-out frames.

    Attributes
    ----------
    posed
        The image set with the training frames.
    held_out
        Held-out frames.
    rule
        How the frames were held out, for provenance.
    """

    posed: Photos
    held_out: list[PosedFrame]
    rule: str


def read_split(
    dataset: Photos | FilePath,
    holdout: int | None = None,
    coordinates: str = "file",
    scale: float = 1.0,
    allow_outside: bool = False,
) -> HoldoutSplit:
    """Read ``dataset`` and split off its held-out frames.

    Parameters
    ----------
    dataset
        The data set, as in `Photos.open`.
    holdout
        Hold out every n-th frame; 0: none. None: the frames of ``transforms_test.json`` or ``transforms_val.json`` next
        to the file, or the test frames that the file lists, or every 8th frame.
    coordinates
        "file": those of the file. "upright": rotated about the origin so that up is +z (`estimate_up`; `NergError` if
        the cameras do not agree). "original": before the ``applied_transform`` of the file. Or the path of a
        ``dataparser_transforms.json``: those in which nerfstudio trained.
    scale
        Scale factor for all lengths, applied last.
    allow_outside
        As in `Photos.load`.
    """
    original = posed = Photos.open(dataset, allow_outside)
    similarity = _choose_similarity(posed, coordinates, scale)
    posed = posed.transform(similarity)
    if posed.unassigned:
        spare = set(posed.unassigned)
        posed = replace(
            posed,
            frames=[f for f in posed.frames if f.name not in spare],
            notes=[
                *posed.notes,
                f"{len(spare)} frames are in neither the training nor the test list of {posed.path.name}",
            ],
        )
    test_path = _find_test_file(original.path) if holdout is None else None
    test = None if test_path is None else read_transforms(test_path, allow_outside)
    posed = replace(posed, notes=[*posed.notes, *_describe_unused_files([original, *([] if test is None else [test])])])
    if test is not None and test_path is not None:
        test = test.transform(similarity)
        held_out_files = {resolve_path(f.image) for f in test.frames}
        shared_frames = [f for f in posed.frames if resolve_path(f.image) in held_out_files]
        train = [f for f in posed.frames if resolve_path(f.image) not in held_out_files]
        if not train:
            raise NergError(
                f'all frames of "{posed.path}" are also in "{test_path.name}", which holds them out; use holdout 0'
            )
        unused = [
            *posed.unused,
            *(UnusedFrame(f.name, f"it is held out by {test_path.name}") for f in shared_frames),
            *test.unused,
        ]
        posed = replace(posed, frames=train, unused=unused, notes=[*posed.notes, *test.notes])
        return HoldoutSplit(posed, test.frames, test_path.name)
    if holdout is None and posed.held_out:
        names = set(posed.held_out)
        train = [f for f in posed.frames if f.name not in names]
        if not train:
            raise NergError(f'"{posed.path}" holds out all of its frames; use holdout 0')
        return HoldoutSplit(
            replace(posed, frames=train), [f for f in posed.frames if f.name in names], f"listed in {posed.path.name}"
        )
    every = 8 if holdout is None else holdout
    train, held_out = split_holdout(posed.frames, every)
    return HoldoutSplit(replace(posed, frames=train), held_out, f"every {every}th frame" if every else "none")


def estimate_photo_up(posed: Photos) -> UpEstimate:
    """Estimate the up direction from the cameras and points of ``posed``."""
    points = np.zeros((0, 3)) if posed.points is None else posed.points
    return estimate_up(np.stack([f.to_world for f in posed.frames]), points)


def _describe_unused_files(sets: list[PosedImages]) -> list[str]:
    """Describe photos and other files in the folder of a data set that the files of ``sets`` do not use."""
    resolve = cache(resolve_path)
    locate = lambda path: resolve(path.parent) / path.name
    listed = {locate(p) for posed in sets for p in posed.image_files}
    auxiliary_files = {
        locate(x.path) for posed in sets for f in posed.frames for x in (f.depth, f.mask) if x is not None
    }
    photos = {
        p
        for folder in {resolve(folder) for posed in sets for folder in posed.image_folders if folder.is_dir()}
        for p in folder.iterdir()
        if p.suffix.lower() in PHOTO_SUFFIXES and not p.name.startswith((".", "dynamic_mask_"))
    } - auxiliary_files
    photos_without_pose, notes = sorted(photos - listed), []
    if photos_without_pose:
        notes.append(
            f"{len(photos_without_pose)} of {len(photos)} photos have no pose in {sets[0].path.name} and are not used: "
            f"{format_names(p.name for p in photos_without_pose)}"
        )
    root = resolve_path(sets[0].root)
    used = {*listed, *auxiliary_files, *photos_without_pose, *(locate(posed.path) for posed in sets)}
    used = {name for p in used if p.is_relative_to(root) for name in p.relative_to(root).parts[:1]}
    unused_entries = {
        p.name for p in root.iterdir() if not (p.name.startswith(".") or p.name.endswith(_OUTPUT_SUFFIXES))
    } - used
    if unused_entries:
        notes.append(f'unused in "{sanitize(root.name)}": {format_names(sorted(unused_entries))}')
    return notes


def _find_test_file(source: Path) -> Path | None:
    if source.suffix.lower() != ".json":
        return None  # a COLMAP model
    for name in ("transforms_test.json", "transforms_val.json"):
        path = source.with_name(name)
        if path != source and is_regular_file(path, "transforms file"):
            return path
    return None


def _choose_similarity(posed: Photos, coordinates: str, scale: float) -> np.ndarray:
    """Return the transform from the coordinates of the file to the requested ones."""
    check_number(scale, LENGTHS, "scale")
    original = np.eye(4) if posed.to_original is None else posed.to_original
    if coordinates == "file":
        to = np.eye(4)
    elif coordinates == "upright":
        up, to = estimate_photo_up(posed), np.eye(4)
        if not up.is_reliable:
            raise NergError(
                f'the cameras of "{posed.path}" do not agree on the up direction (median roll {up.median_roll:.0f} '
                "degrees), so "
                'they cannot be rotated upright; use the coordinates "file"'
            )
        to[:3, :3] = rotation_to_z(up.direction)
    elif coordinates == "original":
        if posed.to_original is None:
            raise NergError(
                f'"{posed.path}" has no "applied_transform", so its original coordinates are unknown; '
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


# ---- Comparison of distorted photos with the pinhole cameras that Mitsuba renders ----
#
# `undistort_photo` resamples the photo as a pinhole image. `make_pinhole_camera` and `apply_lens` leave the photo
# unchanged and distort the rendering instead.


# Maximum angle from the axis of a pinhole image; larger angles would need too many pixels.
_MAX_ANGLE = np.radians(75)


class UndistortedPhoto(NamedTuple):
    """A photo resampled as a pinhole image.

    Attributes
    ----------
    image
        (h, w, 3 or 4) float32, sRGB, straight alpha.
    mask
        (h, w) bool, the pixels that the photo shows.
    sensor
        Dict for ``mi.load_dict`` of a sensor that renders the same image.
    """

    image: np.ndarray
    mask: np.ndarray
    sensor: dict


def undistort_photo(view: PhotoView) -> UndistortedPhoto:
    """Resample ``view`` as an image of a pinhole camera with the same pose, size and principal point.

    The focal length stays the same (the geometric mean if pixels are not square), so that the resolution at the centre
    is preserved. Resampling uses cubic splines; an undistorted photo with square pixels is returned unchanged. Pixels
    that the photo does not show, or that its mask excludes, are not set in ``mask``.
    """
    i = view.camera.intrinsics
    color = view.color
    photo_mask = np.ones(view.shape, bool) if view.mask is None else view.mask
    if not i.is_distorted and abs(i.fx / i.fy - 1) < 1e-9:
        return UndistortedPhoto(color, photo_mask, make_sensor_dict(view.camera))
    focal = float(np.sqrt(i.fx * i.fy))
    pinhole = Intrinsics(i.width, i.height, focal, focal, i.cx, i.cy)
    xy, is_visible = cameras.directions_to_image(_compute_directions(pinhole), i)
    pixels = xy * [i.fx, i.fy] + [i.cx, i.cy]
    inside = is_visible & np.all((pixels >= 0.5) & (pixels <= [i.width - 0.5, i.height - 0.5]), axis=-1)
    # A lens model that folds over maps some pixels twice; the photo shows only the direction nearer to the axis.
    inside &= _check_unfolded(pixels, pinhole, i, inside)
    pixels = np.where(inside[..., None], pixels, 0.5)
    if not photo_mask.all():
        inside &= _sample(photo_mask[..., None].astype(np.float32), pixels, 1)[..., 0] > 0.999
    return UndistortedPhoto(
        np.where(inside[..., None], _resample(color, pixels), 0).astype(np.float32),
        inside,
        make_sensor_dict(PosedCamera(pinhole, view.camera.to_world)),
    )


def make_pinhole_camera(camera: PosedCamera, oversample: float = 1.0) -> PosedCamera:
    """Return the smallest pinhole camera with the same pose that sees everything ``camera`` sees, up to 75 degrees off
    axis.

    ``oversample``: resolution relative to ``camera`` at the centre.
    """
    d = pixel_directions(camera.intrinsics)
    d = d[-d[..., 2] > np.cos(_MAX_ANGLE)]
    x, y = d[:, 0] / -d[:, 2], d[:, 1] / d[:, 2]
    focal = oversample * float(np.sqrt(camera.intrinsics.fx * camera.intrinsics.fy))
    # Margin on each side for interpolation: the outermost pixel centres of the photo are between pixels here.
    left, top = (int(np.floor(focal * v.min())) - 2 for v in (x, y))
    right, bottom = (int(np.ceil(focal * v.max())) + 2 for v in (x, y))
    return PosedCamera(Intrinsics(right - left, bottom - top, focal, focal, float(-left), float(-top)), camera.to_world)


def apply_lens(picture: np.ndarray, source: PosedCamera, camera: PosedCamera) -> tuple[np.ndarray, np.ndarray]:
    """Resample a rendering of a pinhole camera as an image of ``camera`` at the same pose.

    Parameters
    ----------
    picture
        Rendering (h, w, c) of ``source``. An alpha channel is treated like a colour, so pass premultiplied colours.
    source
        The pinhole camera.
    camera
        The camera with lens distortion.

    Returns
    -------
    image
        (height, width, c) float32, resampled with cubic splines.
    mask
        (height, width) bool, the pixels that ``source`` sees.
    """
    if not np.allclose(source.to_world, camera.to_world):
        raise ValueError("both cameras must have the same pose")
    i = source.intrinsics
    if picture.shape[:2] != (i.height, i.width):
        raise ValueError(
            f"the picture has {picture.shape[1]} x {picture.shape[0]} pixels, but its camera {i.width} x {i.height}"
        )
    xy, is_visible = cameras.directions_to_image(_compute_directions(camera.intrinsics), i)
    pixels = xy * [i.fx, i.fy] + [i.cx, i.cy]
    inside = is_visible & np.all((pixels >= 0.5) & (pixels <= [i.width - 0.5, i.height - 0.5]), axis=-1)
    pixels = np.where(inside[..., None], pixels, 0.5)
    return np.where(inside[..., None], _sample(picture, pixels, 3), 0).astype(np.float32), inside


def _compute_directions(intrinsics: Intrinsics) -> np.ndarray:
    """Return the directions (h, w, 3) of the pixels in OpenCV's camera frame."""
    return cameras.image_to_directions(pixel_grid(intrinsics), intrinsics)


def _check_unfolded(pixels: np.ndarray, pinhole: Intrinsics, i: Intrinsics, inside: np.ndarray) -> np.ndarray:
    """Return where the lens maps ``pixels`` back to the direction of the pinhole pixel."""
    out = np.zeros(inside.shape, bool)
    if inside.any():
        back = cameras.image_to_directions((pixels[inside] - [i.cx, i.cy]) / [i.fx, i.fy], i)
        out[inside] = np.linalg.norm(back - _compute_directions(pinhole)[inside], axis=-1) < 1e-6
    return out


def _resample(color: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """Interpolate colours at ``pixels``; with alpha, colours are weighted by it."""
    if color.shape[2] == 3:
        return np.clip(_sample(color, pixels, 3), 0, 1)
    alpha = np.clip(_sample(color[..., 3:], pixels, 3), 0, 1)
    rgb = _sample(color[..., :3] * color[..., 3:], pixels, 3)
    return np.concatenate([np.clip(np.where(alpha > 0, rgb / np.where(alpha > 0, alpha, 1), 0), 0, 1), alpha], axis=-1)


def _sample(values: np.ndarray, pixels: np.ndarray, order: int) -> np.ndarray:
    """Interpolate ``values`` (h, w, c) at ``pixels`` (..., 2) with splines of the given ``order``."""
    from scipy.ndimage import map_coordinates

    coordinates = [pixels[..., 1] - 0.5, pixels[..., 0] - 0.5]
    return np.stack(
        [
            map_coordinates(values[..., k].astype(np.float32), coordinates, order=order, mode="nearest")
            for k in range(values.shape[2])
        ],
        axis=-1,
    )
