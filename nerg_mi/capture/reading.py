"""Pictures, depth and masks from files, and photos as their cameras describe them."""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np

from nerg_mi.errors import NergError
from nerg_mi.files.bounded import plain, reading
from nerg_mi.files.exr import read_exr
from nerg_mi.files.image_header import check_image
from nerg_mi.files.npy import read_npy
from nerg_mi.maths.color import encode_srgb

from .posed import DepthFile, Frame, MaskFile, name_some

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
    with reading(path, "image", also=(RuntimeError,)):
        linear = bitmap.convert(wanted, kinds.Float32, srgb_gamma=False, alpha_transform=straight)
    out = np.array(linear, np.float32)
    if alpha:
        # Without any light and without opacity a colour is 0 over 0.
        out[..., :3][out[..., 3] == 0] = 0
    if not np.all(np.isfinite(out)):
        raise NergError(f'the image "{path}" holds values that are not finite; make it again')
    out[..., :3] = encode_srgb(np.clip(out[..., :3], 0, 1))
    return np.clip(out, 0, 1)


def read_photo(frame: Frame) -> np.ndarray:
    """The pixels of `read_image` as the camera of ``frame`` describes them.

    A photo whose EXIF orientation says that it is to be turned is turned where the camera's width and height are those
    of the turned picture, and stays where they are those of the stored one. Where they fit both, poses of COLMAP are of
    the stored pixels, since it does not read the orientation; `NergError` for other frames, which are ambiguous.
    """
    pixels, orientation = read_image(frame.image), _read_orientation(frame.image)
    if orientation == 1:
        return pixels
    upright = _TURNS[orientation](pixels)
    fits_stored, fits_upright = (frame.has_shape(p.shape[1], p.shape[0]) for p in (pixels, upright))
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


def open_bitmap(path: str | Path, what: str):
    """The picture ``path`` as a Mitsuba bitmap, as Mitsuba itself opens it; `NergError` for one that is damaged or too
    large.

    The size is checked in the header first. EXR is read by the OpenEXR library.
    """
    import mitsuba as mi

    if check_image(path, what).kind == "exr":
        return _exr_bitmap(read_exr(path, what))
    # Mitsuba says so of whatever it finds wrong.
    with reading(path, what, also=(RuntimeError,)):
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
    with reading(path, "image", also=(RuntimeError,)):
        layers = dict(bitmap.split())
    for name in ("<root>", "rgba", "color"):
        if name in layers:
            return layers[name]
    raise NergError(
        f'the image "{path}" has no channels R, G and B, only the layers {plain(", ".join(sorted(layers)))}; '
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
    return np.asarray(~white if source.hides else white)


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
        f'the depth file "{path}" has the channels {name_some(names)}; save it with one channel, or call one of them Z'
    )
