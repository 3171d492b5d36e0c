"""Pictures, depth and masks of posed sets: found, read, undistorted, resized, and split into training and held-out
views."""

from __future__ import annotations

import warnings
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np

from nerg_mi.errors import MissingFile, NergError, sanitize
from nerg_mi.files.images import check_image, read_exr
from nerg_mi.files.safe_read import is_regular_file, read_npy, translate_read_errors, resolve_path
from nerg_mi.maths.color import encode_srgb
from nerg_mi.ranges import LENGTHS, check_number

from . import cameras
from .cameras import (
    Intrinsics,
    PosedCamera,
    resize_mask,
    resize_by_area,
    resize_nearest,
    pixel_directions,
    pixel_grid,
    make_sensor_dict,
    find_view_tangents,
)
from .colmap import UpEstimate, describe_other_models, find_pose_source, estimate_up, read_colmap, rotation_to_z
from .posed import DepthFile, MaskFile, PosedFrame, PosedImages, UnusedFrame, format_names
from .transforms import read_dataparser, read_transforms

# ---- Pictures, depth and masks from files, and photos as their cameras describe them ----

_ORIENTATION = 0x0112
# EXIF orientation -> what makes stored pixels (h, w, c) upright.
_TURNS = {
    2: np.fliplr,
    3: lambda p: np.rot90(p, 2),
    4: np.flipud,
    5: lambda p: p.swapaxes(0, 1),
    6: lambda p: np.rot90(p, -1),
    7: lambda p: np.rot90(p, 2).swapaxes(0, 1),
    8: np.rot90,
}


def read_image(path: str | Path) -> np.ndarray:
    """The image (h, w, 3 or 4), sRGB with straight alpha: uint8 or uint16 as stored, else float32 in 0..1.

    EXR is linear, with premultiplied alpha where it has any: it is made straight and converted, and what is
    brighter than white is clipped. Raises `NergError`, naming the file, for what cannot be read.
    """
    import mitsuba as mi

    bitmap = open_bitmap(path, "image")
    formats, kinds = mi.Bitmap.PixelFormat, mi.Struct.Type
    kind, pixels = bitmap.component_format(), bitmap.pixel_format()
    if kind in (kinds.UInt8, kinds.UInt16) and bitmap.srgb_gamma():
        # As stored: Mitsuba's own conversion goes by way of linear values.
        out = np.array(bitmap)
        out = out if out.ndim == 3 else out[..., None]
        if pixels in (formats.RGB, formats.RGBA):
            return out
        if pixels in (formats.Y, formats.YA):
            return np.ascontiguousarray(out[..., [0, 0, 0, 1][: 3 if pixels == formats.Y else 4]])
    if pixels == formats.MultiChannel:
        bitmap = _layer(bitmap, path)
    alpha = bitmap.has_alpha()
    straight = (
        mi.Bitmap.AlphaTransform.Unpremultiply
        if alpha and bitmap.premultiplied_alpha()
        else mi.Bitmap.AlphaTransform.Empty
    )
    wanted = formats.RGBA if alpha else formats.RGB
    with translate_read_errors(path, "image", extra_errors=(RuntimeError,)):
        linear = bitmap.convert(wanted, kinds.Float32, srgb_gamma=False, alpha_transform=straight)
    out = np.array(linear, np.float32)
    if alpha:
        # Without any light and without opacity a colour is 0 over 0.
        out[..., :3][out[..., 3] == 0] = 0
    if not np.all(np.isfinite(out)):
        raise NergError(f'the image "{path}" holds values that are not finite; make it again')
    out[..., :3] = encode_srgb(np.clip(out[..., :3], 0, 1))
    return np.clip(out, 0, 1)


def read_photo(frame: PosedFrame) -> np.ndarray:
    """The pixels of `read_image` as the camera of ``frame`` describes them.

    A photo whose EXIF orientation says that it is to be turned is turned where the camera's width and height are those
    of the turned picture, and stays where they are those of the stored one. Where they fit both, poses of COLMAP are of
    the stored pixels, since it does not read the orientation; `NergError` for other frames, which are ambiguous.
    """
    pixels, orientation = read_image(frame.image), _read_orientation(frame.image)
    if orientation == 1:
        return pixels
    upright = _TURNS[orientation](pixels)
    fits_stored, fits_upright = (frame.matches_shape(p.shape[1], p.shape[0]) for p in (pixels, upright))
    if fits_stored and fits_upright and not frame.ignores_exif:
        raise NergError(
            f'the photo "{frame.image}" is to be turned by its EXIF orientation ({orientation}), and nothing tells '
            "whether its pose and its lens are of the stored or of the turned picture; store it turned, or remove the "
            "note where they are of the stored one (exiftool -Orientation= FILE)"
        )
    return np.ascontiguousarray(upright) if fits_upright and not fits_stored else pixels


def _read_orientation(path: Path) -> int:
    """EXIF orientation of a JPEG or PNG file, from 1 (as stored) to 8; 1 where it has none."""
    from PIL.JpegImagePlugin import JpegImageFile
    from PIL.PngImagePlugin import PngImageFile

    kinds = {b"\xff\xd8": JpegImageFile, b"\x89P": PngImageFile}
    with warnings.catch_warnings(), open(path, "rb") as file:
        warnings.simplefilter("ignore")
        kind = kinds.get(file.read(2))
        file.seek(0)
        try:
            image = None if kind is None else kind(file)
            # Without the condition, Pillow decodes a PNG to look for notes behind its pixels.
            value = 1 if image is None or "exif" not in image.info else image.getexif().get(_ORIENTATION, 1)
        except Exception:  # Pillow raises many kinds on damaged notes, without which a photo is as good
            return 1
    return value if value in _TURNS else 1


def open_bitmap(path: str | Path, file_kind: str):
    """The picture ``path`` as a Mitsuba bitmap, as Mitsuba itself opens it; `NergError` for one that is damaged or too
    large.

    The size is checked in the header first. EXR is read by the OpenEXR library.
    """
    import mitsuba as mi

    if check_image(path, file_kind).format == "exr":
        return _exr_bitmap(read_exr(path, file_kind))
    # Mitsuba says so of whatever it finds wrong.
    with translate_read_errors(path, file_kind, extra_errors=(RuntimeError,)):
        return mi.Bitmap(str(path))


def _exr_bitmap(channels: dict[str, np.ndarray]):
    import mitsuba as mi

    names, kinds = list(channels), {c.dtype for c in channels.values()}
    values = np.stack(list(channels.values()), axis=-1)
    if len(kinds) > 1:
        values = values.astype(np.float32)
    found = "".join(n.rpartition(".")[2].lower() for n in names)
    known = {"rgb": "RGB", "rgba": "RGBA", "y": "Y", "ya": "YA", "xyz": "XYZ", "xyza": "XYZA"}
    format = getattr(
        mi.Bitmap.PixelFormat, known.get(found, "MultiChannel") if len(found) == len(names) else "MultiChannel"
    )
    bitmap = mi.Bitmap(values, format, names)
    bitmap.set_premultiplied_alpha(True)
    return bitmap


def _layer(bitmap, path):
    """The colour layer of a multichannel EXR."""
    # Layers whose channels do not fit together make Mitsuba say so.
    with translate_read_errors(path, "image", extra_errors=(RuntimeError,)):
        layers = dict(bitmap.split())
    for name in ("<root>", "rgba", "color"):
        if name in layers:
            return layers[name]
    raise NergError(
        f'the image "{path}" has no channels R, G and B, only the layers {sanitize(", ".join(sorted(layers)))}; '
        "save it with these"
    )


def read_depth(source: DepthFile) -> np.ndarray:
    """The values (h, w) of ``.npy``, ``.exr`` or 16-bit ``.png`` in scene units, float32; 0: unknown."""
    path, suffix = source.path, source.path.suffix.lower()
    if suffix == ".npy":
        out = read_npy(path, "depth file")
    elif suffix == ".exr":
        out = _depth_channel(read_exr(path, "depth file"), path)
    elif suffix == ".png":
        out = np.array(open_bitmap(path, "depth file"))
        if out.dtype != np.uint16:
            raise NergError(f'the depth file "{path}" must be a 16-bit PNG, but has {out.dtype.itemsize * 8} bits')
    else:
        raise NergError(f'the depth file "{path}" must be .npy, .exr or a 16-bit .png')
    if out.ndim == 3 and out.shape[2] == 1:
        out = out[..., 0]
    if out.ndim != 2 or not np.issubdtype(out.dtype, np.number):
        raise NergError(f'the depth file "{path}" must hold one number a pixel, got shape {out.shape}')
    if np.iscomplexobj(out):
        raise NergError(f'the depth file "{path}" holds complex numbers; save it as float32')
    with np.errstate(over="ignore", invalid="ignore"):  # what float32 cannot hold is unknown
        out = out.astype(np.float32)
    return np.where(np.isfinite(out) & (out > 0), out * np.float32(source.unit), 0).astype(np.float32)


def read_mask(source: MaskFile, shape: tuple[int, int]) -> np.ndarray:
    """Which pixels (h, w) are used, bool. The mask must have the image's ``shape``."""
    out = np.array(open_bitmap(source.path, "mask"))
    out = out[..., None] if out.ndim == 2 else out
    if out.shape[:2] != shape:
        raise NergError(
            f'the mask "{source.path}" has {out.shape[1]} x {out.shape[0]} pixels, but its image '
            f"{shape[1]} x {shape[0]}"
        )
    colors = out[..., :1] if out.shape[2] <= 2 else out[..., :3]
    white = _is_white(colors).any(axis=2)
    if out.shape[2] in (2, 4):
        opaque = _is_white(out[..., -1])
        # A black stencil says by its alpha alone what is used.
        is_stencil = not white.any() and not opaque.all()
        white = opaque if is_stencil else white & opaque
    return np.asarray(~white if source.is_inverted else white)


def _is_white(values: np.ndarray) -> np.ndarray:
    """Which ``values`` are above half of white: JPEG makes black values of 1 to 3."""
    if not np.issubdtype(values.dtype, np.integer):
        return values > 0.5
    # Labels of 0 and 1 are no shades of black, nor are 8-bit values in 16 bits.
    white = next(w for w in (1, 255, np.iinfo(values.dtype).max) if values.max(initial=0) <= w)
    return values > 0.5 * white


def _depth_channel(channels: dict[str, np.ndarray], path: Path) -> np.ndarray:
    """The depth among the ``channels`` of an EXR: the only one, the one of that name, or grey as R, G and B."""
    names = list(channels)
    named = [n for n in names if "depth" in n.lower() or n.rpartition(".")[2].lower() == "z"]
    if len(names) == 1 or len(named) == 1:
        return channels[named[0] if named else names[0]]
    if {"R", "G", "B"} <= set(names) and all(np.array_equal(channels["R"], channels[n], True) for n in "GB"):
        return channels["R"]
    raise NergError(
        f'the depth file "{path}" has the channels {format_names(names)}; save it with one channel, or call one of them Z'
    )


# ---- Posed image sets, loaded at a chosen size and split into training and held-out views ----


@dataclass(frozen=True)
class PhotoView:
    """One picture with its camera.

    ``pixels``: (h, w, 3) or (h, w, 4), sRGB as stored, alpha straight (not premultiplied): uint8, uint16 or floats in
    0..1; ``depth``: (h, w) float32 distance along each pixel's ray in scene units, 0 where unknown, or None;
    ``mask``: (h, w) bool, the pixels that count, or None for all; ``left_out``: fraction of the pixels that the mask's
    file leaves out, None without such a file.
    """

    name: str
    camera: PosedCamera
    pixels: np.ndarray
    depth: np.ndarray | None = None
    mask: np.ndarray | None = None
    masked_fraction: float | None = None

    @property
    def shape(self) -> tuple[int, int]:
        """Height and width."""
        return self.pixels.shape[:2]

    @property
    def color(self) -> np.ndarray:
        """The pixels as float32 in 0..1; made anew at every call."""
        return _as_floats(self.pixels)

    @property
    def has_alpha(self) -> bool:
        return self.pixels.shape[2] == 4

    def composite_over(self, background: float) -> np.ndarray:
        """The picture (h, w, 3), float32, before a grey ``background``."""
        color = self.color
        if not self.has_alpha:
            return color
        alpha = color[..., 3:]
        return color[..., :3] * alpha + (1 - alpha) * background


def split_holdout(frames: list[PosedFrame], every: int) -> tuple[list[PosedFrame], list[PosedFrame]]:
    """Training and held-out frames: every ``every``-th of ``frames`` (sorted by file name), the first
    included, is held out; 0 holds none out."""
    if every < 0 or every == 1:
        raise NergError(f"holdout must be 0 (none) or at least 2 (every so many frames), got {every}")
    if every == 0:
        return list(frames), []
    held = frames[::every]
    train = [f for i, f in enumerate(frames) if i % every]
    if not train:
        raise NergError(f"holding out every {every}th of {len(frames)} frames leaves none to train on; use holdout 0")
    return train, held


def load_usable_views(
    frames: list[PosedFrame], width: int | None = None, downscale: float | None = None, depth: bool = False
) -> tuple[list[PhotoView], list[UnusedFrame]]:
    """`load_view` of all ``frames``, and those for which it failed."""
    check_size(width, downscale)
    views, unused = [], []
    for frame in frames:
        try:
            views.append(load_view(frame, width, downscale, depth))
        except ValueError as e:
            unused.append(UnusedFrame(frame.name, str(e)))
    return views, unused


def check_size(width: int | None, downscale: float | None) -> None:
    """`NergError` for sizes that no picture can have."""
    if width is not None and downscale is not None:
        raise NergError("give either width or downscale, not both")
    if width is not None and width < 1:
        raise NergError(f"width must be at least 1 pixel, got {width}")
    if downscale is not None and not downscale >= 1:
        raise NergError(f"downscale must be at least 1, got {downscale}")


def load_view(
    frame: PosedFrame, width: int | None = None, downscale: float | None = None, depth: bool = False
) -> PhotoView:
    """Load ``frame`` at its own size, at ``width`` pixels, or divided by ``downscale``.

    Pictures are averaged over the area of the new pixels, on their stored (sRGB) values, as other
    trainers do; depth takes the value nearest to each new pixel's centre; a pixel counts where all that it covers is
    on in the mask. ``depth``: read depth files. `NergError` names the file that cannot be used.
    """
    check_size(width, downscale)
    pixels = read_photo(frame)
    h, w = pixels.shape[:2]
    stated = frame.intrinsics(w, h)
    factor = w / width if width is not None else downscale or 1.0
    if factor < 1:
        raise NergError(f'the image "{frame.image}" is only {w} pixels wide; choose a width of at most {w}')
    size = max(1, round(w / factor)), max(1, round(h / factor))
    intrinsics = stated.resized(*size)
    # Every pixel must have a ray; lenses fold over at the borders first.
    find_view_tangents(intrinsics)
    mask = None if frame.mask is None else resize_mask(read_mask(frame.mask, (h, w)), *size)
    left_out = None if mask is None else 1 - float(mask.mean())
    if intrinsics.fisheye:
        shown = np.linalg.norm(pixel_grid(intrinsics), axis=-1) < cameras.find_fisheye_limit(intrinsics)[1]
        mask = mask if shown.all() else shown if mask is None else mask & shown
    if mask is not None and not mask.any():
        raise NergError("its mask leaves out every pixel")
    distance = _distances(frame.depth, (h, w), intrinsics) if depth and frame.depth is not None else None
    if size != (w, h):
        pixels = resize_by_area(_as_floats(pixels), *size)
    if pixels.dtype == np.float32:
        # 16 bits tell more than the photo and take half the room.
        pixels = np.round(pixels * 65535).astype(np.uint16)
    return PhotoView(frame.name, PosedCamera(intrinsics, frame.to_world), pixels, distance, mask, left_out)


def _as_floats(pixels: np.ndarray) -> np.ndarray:
    """``pixels`` of any of the types of `PhotoView.pixels` as float32 in 0..1."""
    if pixels.dtype in (np.uint8, np.uint16):
        return pixels.astype(np.float32) / np.iinfo(pixels.dtype).max
    return pixels.astype(np.float32, copy=False)


def _distances(file: DepthFile, shape: tuple[int, int], intrinsics) -> np.ndarray:
    """Distances along the rays of the resized picture; depth cameras may have fewer pixels than the photo."""
    out, (h, w) = read_depth(file), shape
    if abs(out.shape[1] * h - out.shape[0] * w) > 0.01 * w * out.shape[0]:
        raise NergError(
            f'the depth file "{file.path}" has {out.shape[1]} x {out.shape[0]} pixels, which is not the '
            f"shape of its image, {w} x {h}"
        )
    out = resize_nearest(out, intrinsics.width, intrinsics.height)
    if file.along_axis:
        ahead = -pixel_directions(intrinsics)[..., 2]
        out = np.where(ahead > 1e-3, out / np.maximum(ahead, 1e-3), 0).astype(np.float32)
    return np.ascontiguousarray(out)


# ---- Which files a data set's folder consists of, and which of its frames are held out ----

COORDINATES = ("file", "upright", "original")
# Of files that are taken for photos, in small letters.
_PHOTOS = (".png", ".jpg", ".jpeg", ".exr")
# What trainings write, into a capture's folder as well.
_WRITTEN = (".safetensors", ".run", ".preview.png")


@dataclass(frozen=True)
class HoldoutSplit:
    """``posed``: the training file, its frames those to train on; ``held_out``: frames, chosen by the ``rule``, a few
    words for provenance."""

    posed: PosedImages
    held_out: list[PosedFrame]
    rule: str


def read_posed_images(source: Path, allow_outside: bool = False) -> PosedImages:
    """Read what `find_source` found. ``allow_outside``: use files outside of its folder too (of a COLMAP model: of the
    one that holds its images), to which names and links in it may lead."""
    if source.is_file():
        return read_transforms(source, allow_outside)
    folders = [source, *list(resolve_path(source).parents)[:3]]
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
) -> HoldoutSplit:
    """Read ``dataset`` and set its held-out frames apart.

    ``holdout``: every so many frames, 0 none. None: the frames of a ``transforms_test.json`` or else
    ``transforms_val.json`` beside the file, or those that the file itself lists for testing, or every 8th.
    ``coordinates``: "file"; "upright", those turned about their origin so that up is +z, as cameras and points tell
    (`find_up`; `NergError` where the cameras do not agree); "original", before the writer applied its
    ``applied_transform``; or a ``dataparser_transforms.json``, those that nerfstudio trained in.
    ``scale``: of all lengths, after that.
    ``allow_outside``: as `read_posed` has it.
    """
    source = find_pose_source(dataset)
    posed = read_posed_images(source, allow_outside)
    whole = posed
    similarity = _similarity(posed, coordinates, scale)
    posed = posed.transform(similarity)
    if posed.unassigned:
        spare = set(posed.unassigned)
        posed = replace(
            posed,
            frames=[f for f in posed.frames if f.name not in spare],
            notes=[*posed.notes, f"{len(spare)} frames are in no training or test list of {posed.path.name}"],
        )
    other = _test_file(source) if holdout is None else None
    test = None if other is None else read_transforms(other, allow_outside)
    posed = replace(posed, notes=[*posed.notes, *_describe_leftovers([whole, *([] if test is None else [test])])])
    if test is not None and other is not None:
        test = test.transform(similarity)
        hidden = {resolve_path(f.image) for f in test.frames}
        both = [f for f in posed.frames if resolve_path(f.image) in hidden]
        train = [f for f in posed.frames if resolve_path(f.image) not in hidden]
        if not train:
            raise NergError(
                f'all frames of "{posed.path}" are also in "{other.name}", which holds them out; use holdout 0'
            )
        unused = [*posed.unused, *(UnusedFrame(f.name, f"it is held out by {other.name}") for f in both), *test.unused]
        posed = replace(posed, frames=train, unused=unused, notes=[*posed.notes, *test.notes])
        return HoldoutSplit(posed, test.frames, other.name)
    if holdout is None and posed.held_out:
        names = set(posed.held_out)
        train = [f for f in posed.frames if f.name not in names]
        if not train:
            raise NergError(f'"{posed.path}" holds out all of its frames; use holdout 0')
        return HoldoutSplit(
            replace(posed, frames=train), [f for f in posed.frames if f.name in names], f"listed in {posed.path.name}"
        )
    every = 8 if holdout is None else holdout
    train, held = split_holdout(posed.frames, every)
    return HoldoutSplit(replace(posed, frames=train), held, f"every {every}th frame" if every else "none")


def estimate_photo_up(posed: PosedImages) -> UpEstimate:
    """Up, as the cameras of ``posed`` are held and as its points lie."""
    points = np.zeros((0, 3)) if posed.points is None else posed.points
    return estimate_up(np.stack([f.to_world for f in posed.frames]), points)


def _describe_leftovers(sets: list[PosedImages]) -> list[str]:
    """What lies in the folder of a data set, described by the files of ``sets``, and is not used: photos beside those
    that the files list, and what else the folder holds."""
    resolve = cache(resolve_path)
    locate = lambda path: resolve(path.parent) / path.name
    listed = {locate(p) for posed in sets for p in posed.image_files}
    others = {locate(x.path) for posed in sets for f in posed.frames for x in (f.depth, f.mask) if x is not None}
    photos = {
        p
        for folder in {resolve(folder) for posed in sets for folder in posed.image_folders if folder.is_dir()}
        for p in folder.iterdir()
        if p.suffix.lower() in _PHOTOS and not p.name.startswith((".", "dynamic_mask_"))
    } - others
    stray, notes = sorted(photos - listed), []
    if stray:
        notes.append(
            f"{len(stray)} of {len(photos)} photos have no pose in {sets[0].path.name} and are not used: "
            f"{format_names(p.name for p in stray)}"
        )
    root = resolve_path(sets[0].root)
    used = {*listed, *others, *stray, *(locate(posed.path) for posed in sets)}
    used = {name for p in used if p.is_relative_to(root) for name in p.relative_to(root).parts[:1]}
    rest = {p.name for p in root.iterdir() if not (p.name.startswith(".") or p.name.endswith(_WRITTEN))} - used
    if rest:
        notes.append(f'not used of "{sanitize(root.name)}": {format_names(sorted(rest))}')
    return notes


def _test_file(source: Path) -> Path | None:
    if not source.is_file():
        return None
    for name in ("transforms_test.json", "transforms_val.json"):
        path = source.with_name(name)
        if path != source and is_regular_file(path, "transforms file"):
            return path
    return None


def _similarity(posed: PosedImages, coordinates: str, scale: float) -> np.ndarray:
    """From the file's coordinates to those asked for."""
    check_number(scale, LENGTHS, "scale")
    original = np.eye(4) if posed.to_original is None else posed.to_original
    if coordinates == "file":
        to = np.eye(4)
    elif coordinates == "upright":
        up, to = estimate_photo_up(posed), np.eye(4)
        if not up.is_reliable:
            raise NergError(
                f'the cameras of "{posed.path}" do not agree on what is up (rolled by {up.median_roll:.0f} degrees), so that '
                'nothing can be turned upright; use the coordinates "file"'
            )
        to[:3, :3] = rotation_to_z(up.direction)
    elif coordinates == "original":
        if posed.to_original is None:
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


# ---- Between a photo's lens and the pinhole cameras that Mitsuba renders ----
#
# Two ways to compare a rendering with a distorted photo: `undistorted` turns the photo into the pinhole picture that it
# would have been; `pinhole` and `through_lens` leave the photo alone and bend the rendering to its lens.


# Beyond this angle from the axis a pinhole picture wastes its pixels.
_WIDEST = np.radians(75)


class UndistortedPhoto(NamedTuple):
    """``image``: (h, w, 3 or 4) float32, sRGB, alpha straight; ``mask``: (h, w), where the photo says what is to be
    seen; ``sensor``: dict for ``mi.load_dict`` that renders the same picture."""

    image: np.ndarray
    mask: np.ndarray
    sensor: dict


def undistort_photo(view: PhotoView) -> UndistortedPhoto:
    """``view`` as a pinhole camera of the same place, size and principal point would have taken it.

    The focal length stays (the mean of the two where pixels are not square), so that details keep their size at
    the centre. Resampled by cubic splines; without distortion and with square pixels the photo itself. What the photo
    does not show, and what its own mask leaves out, is off in ``mask``.
    """
    i = view.camera.intrinsics
    color = view.color
    own = _own_mask(view)
    if not i.is_distorted and abs(i.fx / i.fy - 1) < 1e-9:
        return UndistortedPhoto(color, own, make_sensor_dict(view.camera))
    focal = float(np.sqrt(i.fx * i.fy))
    plain = Intrinsics(i.width, i.height, focal, focal, i.cx, i.cy)
    xy, shown = cameras.directions_to_image(_forward(plain), i)
    at = xy * [i.fx, i.fy] + [i.cx, i.cy]
    inside = shown & np.all((at >= 0.5) & (at <= [i.width - 0.5, i.height - 0.5]), axis=-1)
    # A lens that folds over shows some places twice; the photo holds the near one only.
    inside &= _unfolded(at, plain, i, inside)
    at = np.where(inside[..., None], at, 0.5)
    if not own.all():
        inside &= _sample(own[..., None].astype(np.float32), at, 1)[..., 0] > 0.999
    return UndistortedPhoto(
        np.where(inside[..., None], _resample(color, at), 0).astype(np.float32),
        inside,
        make_sensor_dict(PosedCamera(plain, view.camera.to_world)),
    )


def make_pinhole_camera(camera: PosedCamera, oversample: float = 1.0) -> PosedCamera:
    """The smallest pinhole camera at the same place that sees all that ``camera`` does, up to 75 degrees off its axis.

    ``oversample``: its pixels to one of ``camera``'s at the centre.
    """
    d = pixel_directions(camera.intrinsics)
    d = d[-d[..., 2] > np.cos(_WIDEST)]
    x, y = d[:, 0] / -d[:, 2], d[:, 1] / d[:, 2]
    focal = oversample * float(np.sqrt(camera.intrinsics.fx * camera.intrinsics.fy))
    # One pixel more on every side: the outermost centres of the photo lie between pixels here.
    left, top = (int(np.floor(focal * v.min())) - 2 for v in (x, y))
    right, bottom = (int(np.ceil(focal * v.max())) + 2 for v in (x, y))
    return PosedCamera(Intrinsics(right - left, bottom - top, focal, focal, float(-left), float(-top)), camera.to_world)


def apply_lens(picture: np.ndarray, source: PosedCamera, camera: PosedCamera) -> tuple[np.ndarray, np.ndarray]:
    """A rendered ``picture`` (h, w, c) of the pinhole ``source`` as ``camera``, at the same place, would have taken it.

    Returns it (camera's height, width, c), float32, resampled by cubic splines, and a mask of the pixels that
    ``source`` sees. Alpha, as a fourth channel, is not treated apart: give premultiplied colours.
    """
    if not np.allclose(source.to_world, camera.to_world):
        raise ValueError("both cameras must stand at the same place and look the same way")
    i = source.intrinsics
    if picture.shape[:2] != (i.height, i.width):
        raise ValueError(
            f"the picture has {picture.shape[1]} x {picture.shape[0]} pixels, but its camera {i.width} x {i.height}"
        )
    xy, shown = cameras.directions_to_image(_forward(camera.intrinsics), i)
    at = xy * [i.fx, i.fy] + [i.cx, i.cy]
    inside = shown & np.all((at >= 0.5) & (at <= [i.width - 0.5, i.height - 0.5]), axis=-1)
    at = np.where(inside[..., None], at, 0.5)
    return np.where(inside[..., None], _sample(picture, at, 3), 0).astype(np.float32), inside


def _forward(intrinsics: Intrinsics) -> np.ndarray:
    """Directions (h, w, 3) of the pixels in OpenCV's camera frame."""
    return cameras.image_to_directions(pixel_grid(intrinsics), intrinsics)


def _own_mask(view: PhotoView) -> np.ndarray:
    return np.ones(view.shape, bool) if view.mask is None else view.mask


def _unfolded(at: np.ndarray, plain: Intrinsics, i: Intrinsics, inside: np.ndarray) -> np.ndarray:
    """Where the direction that the photo's lens gives for the pixel ``at`` is the one that led there."""
    out = np.zeros(inside.shape, bool)
    if inside.any():
        back = cameras.image_to_directions((at[inside] - [i.cx, i.cy]) / [i.fx, i.fy], i)
        out[inside] = np.linalg.norm(back - _forward(plain)[inside], axis=-1) < 1e-6
    return out


def _resample(color: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Colours at pixel coordinates ``at``; where there is alpha, colours count by it."""
    if color.shape[2] == 3:
        return np.clip(_sample(color, at, 3), 0, 1)
    alpha = np.clip(_sample(color[..., 3:], at, 3), 0, 1)
    rgb = _sample(color[..., :3] * color[..., 3:], at, 3)
    return np.concatenate([np.clip(np.where(alpha > 0, rgb / np.where(alpha > 0, alpha, 1), 0), 0, 1), alpha], axis=-1)


def _sample(values: np.ndarray, at: np.ndarray, order: int) -> np.ndarray:
    """``values`` (h, w, c) at pixel coordinates (..., 2), by splines."""
    from scipy.ndimage import map_coordinates

    where = [at[..., 1] - 0.5, at[..., 0] - 0.5]
    return np.stack(
        [
            map_coordinates(values[..., k].astype(np.float32), where, order=order, mode="nearest")
            for k in range(values.shape[2])
        ],
        axis=-1,
    )
