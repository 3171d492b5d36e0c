"""Saliency maps as gaze densities over directions: solid angles of pixels, a classical model, and views of posed
photos.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from nerg_mi.errors import MissingFile, NergError
from nerg_mi.files.safe_read import read_npy, resolve_path
from nerg_mi.maths.transforms import invert_similarity

from . import cameras
from .cameras import Intrinsics, PosedCamera, make_area_weights, resize_by_area, resize_mask, resize_nearest
from .images import get_photo_size, open_bitmap, read_mask, read_photo
from .photo_set import Photos
from .posed import MaskFile, PosedFrame, check_inside, describe_unused

# ---- Solid angles of pixels for any lens ----
#
# The directions of the four corners of a pixel form two spherical triangles, whose areas are computed exactly (Van
# Oosterom & Strackee 1983). For a pinhole, pixel edges are great circles, so that the areas are exact and sum to that
# of the frustum. For other lenses, the error is proportional to the square of the pixel size. To first order, the area
# is the Jacobian dω/dA of the lens: cos³θ / f² for a pinhole (A in the image plane, focal length f, angle θ from the
# axis).


# Rows of pixels per chunk, to limit memory.
_ROW_BLOCK = 256


@lru_cache(maxsize=4)
def pixel_solid_angles(intrinsics: Intrinsics) -> np.ndarray:
    """Return the solid angles (height, width) of the pixels in sr, float64, read-only; 0 beyond the limit of a fisheye
    lens.

    Raises the error of `cameras.undistort`.
    """
    i = intrinsics
    out = np.empty((i.height, i.width))
    for a in range(0, i.height, _ROW_BLOCK):
        rows = np.arange(a, min(a + _ROW_BLOCK, i.height) + 1)
        x, y = np.meshgrid((np.arange(i.width + 1) - i.cx) / i.fx, (rows - i.cy) / i.fy)
        xy = np.stack([x, y], axis=-1)
        d = cameras.image_to_directions(xy, i)
        corner = d[:-1, :-1], d[:-1, 1:], d[1:, 1:], d[1:, :-1]
        part = spherical_triangle_area(*corner[:3]) + spherical_triangle_area(corner[0], *corner[2:])
        if i.fisheye:
            beyond = np.linalg.norm(xy, axis=-1) >= cameras.find_fisheye_limit(i)[1]
            part[beyond[:-1, :-1] & beyond[:-1, 1:] & beyond[1:, 1:] & beyond[1:, :-1]] = 0
        out[a : a + len(part)] = np.maximum(part, 0)
    out.flags.writeable = False
    return out


def spherical_triangle_area(a: np.ndarray, b: np.ndarray, c: np.ndarray) -> np.ndarray:
    """Return the signed areas (...) of spherical triangles with unit corners (..., 3); positive if a, b, c are
    right-handed.
    """
    dot = lambda u, v: np.einsum("...i,...i->...", u, v)
    return 2 * np.arctan2(dot(a, np.cross(b, c)), 1 + dot(a, b) + dot(b, c) + dot(c, a))


# ---- Spectral residual (Hou & Zhang, CVPR 2007), a classical saliency model ----
#
# The log amplitude of the spectrum minus its local mean is transformed back with the original phase, squared and
# blurred. Only SciPy is needed; OpenCV's contributed modules, which include saliency models, take 70 MB and replace an
# installed cv2. The model responds to contrast and unusual patterns, but not to people, faces or tasks. It is an
# example, not a prediction of gaze.


# Width of the map in pixels and standard deviation of the blur, as published.
RESIDUAL_WIDTH = 64
_BLUR_SIGMA = 2.5


def spectral_residual(photo: np.ndarray, width: int = RESIDUAL_WIDTH) -> np.ndarray:
    """Compute the saliency (h, w), float64, at most 1, of ``photo`` (H, W, 3) in 0..1, sRGB, at a width of ``width``
    pixels.

    Follows the script of the authors: grey values, 3 x 3 mean of the log amplitude with repeated edges, Gaussian blur
    of 2.5 pixels. Raises `NergError` for a photo of one colour.
    """
    from scipy.fft import fft2, ifft2
    from scipy.ndimage import gaussian_filter, uniform_filter

    H, W = photo.shape[:2]
    w = min(width, W)
    grey = np.asarray(photo, np.float32) @ np.array([0.299, 0.587, 0.114], np.float32)
    grey = resize_by_area(grey[..., None], w, max(1, round(H * w / W)))[..., 0].astype(np.float64)
    if not np.ptp(grey) > 1e-6:
        raise NergError("it has only one colour, so its saliency is undefined")
    spectrum = np.asarray(fft2(grey))
    # The logarithm of zero is undefined, and smaller amplitudes are dominated by rounding.
    amplitude = np.log(np.maximum(np.abs(spectrum), 1e-9 * np.abs(spectrum).max()))
    residual = amplitude - uniform_filter(amplitude, 3, mode="nearest")
    salience = np.abs(np.asarray(ifft2(np.exp(residual + 1j * np.angle(spectrum))))) ** 2
    salience = gaussian_filter(salience, _BLUR_SIGMA, mode="constant", truncate=2.0)
    return salience / salience.max()


# ---- Saliency maps of posed photos as densities over directions ----
#
# A saliency map describes how the gaze of an observer at the camera centre is distributed over the pixels, and nothing
# outside of the image. With the value s_i of pixel i and its solid angle dω_i, the density is s_i / dω_i / Σ s in 1/sr,
# conditional on gaze within the image.

SALIENCE_SUFFIXES = (".png", ".exr", ".npy")
VALUE_UNITS = ("pixel", "steradian")
SALIENCE_MODELS = {"spectral-residual": spectral_residual}
# Maximum number of pixels of a view; gaze fields are coarse.
_MAX_VIEW_PIXELS = 1 << 14
# Relative tolerance of the aspect ratio of a map.
_SHAPE_TOLERANCE = 0.01
_OPENGL_FROM_OPENCV = np.array([1.0, -1.0, -1.0])


@dataclass(frozen=True, eq=False)
class SalienceView:
    """The gaze distribution within one image.

    Attributes
    ----------
    name
        Name of the frame.
    camera
        Camera with intrinsics for the size of the map.
    gaze_fraction
        Fraction of the gaze on each pixel (h, w); sums to one.
    solid_angle
        Solid angle of each pixel (h, w) in sr; 0 for pixels that the lens or a mask excludes.
    """

    name: str
    camera: PosedCamera
    gaze_fraction: np.ndarray
    solid_angle: np.ndarray

    @property
    def total_solid_angle(self) -> float:
        """Total solid angle of the known pixels in sr."""
        return float(self.solid_angle.sum(dtype=np.float64))

    @property
    def density(self) -> np.ndarray:
        """Density (h, w) in 1/sr, conditional on gaze within the image; 0 for unknown pixels."""
        is_known = self.solid_angle > 0
        return np.where(is_known, self.gaze_fraction / np.where(is_known, self.solid_angle, 1), 0)

    def reduce(self, pixels: int) -> SalienceView:
        """Return the view with at most ``pixels`` pixels. Gaze fractions and solid angles of merged pixels are
        summed.
        """
        h, w = self.gaze_fraction.shape
        if h * w <= pixels:
            return self
        factor = np.sqrt(pixels / (h * w))
        width, height = max(1, int(w * factor)), max(1, int(h * factor))
        camera = PosedCamera(self.camera.intrinsics.resized(width, height), self.camera.to_world)
        rows, columns = (
            make_area_weights(h, height) * np.float32(h / height),
            make_area_weights(w, width) * np.float32(w / width),
        )
        total = lambda v: np.asarray((columns @ (rows @ v).T).T, np.float64)
        gaze_fraction = total(self.gaze_fraction)
        return SalienceView(self.name, camera, gaze_fraction / gaze_fraction.sum(), total(self.solid_angle))

    def sample(self, count: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        """Draw ``count`` directions, uniform over the solid angle of the view.

        Returns
        -------
        directions
            Unit directions (count, 3) in world coordinates, random within their pixels.
        pixel_index
            Flat pixel indices (count,), drawn by systematic sampling in proportion to the solid angle.
        """
        cumulative = np.cumsum(self.solid_angle.ravel(), dtype=np.float64)
        pixel_index = np.searchsorted(
            cumulative, (np.arange(count) + rng.random()) * (cumulative[-1] / count), side="right"
        )
        pixel_index = np.minimum(pixel_index, np.flatnonzero(self.solid_angle.ravel())[-1])
        i, offsets = self.camera.intrinsics, rng.random((2, count))
        xy = np.stack(
            [(pixel_index % i.width + offsets[0] - i.cx) / i.fx, (pixel_index // i.width + offsets[1] - i.cy) / i.fy],
            axis=-1,
        )
        return cameras.image_to_directions(xy, i) * _OPENGL_FROM_OPENCV @ self.camera.to_world[:3, :3].T, pixel_index

    def evaluate(self, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Evaluate the density (N,) in 1/sr at world ``directions`` (N, 3). Also returns a mask (N,) of the
        directions in the view.
        """
        i = self.camera.intrinsics
        xy, is_visible = cameras.directions_to_image(
            np.asarray(directions) @ self.camera.to_world[:3, :3] * _OPENGL_FROM_OPENCV, i
        )
        x, y = np.floor(xy[:, 0] * i.fx + i.cx), np.floor(xy[:, 1] * i.fy + i.cy)
        is_known = is_visible & (x >= 0) & (x < i.width) & (y >= 0) & (y < i.height)
        pixels = np.where(is_known, y, 0).astype(int), np.where(is_known, x, 0).astype(int)
        is_known &= self.solid_angle[pixels] > 0
        return np.where(is_known, self.density[pixels], 0), is_known


@dataclass(frozen=True)
class SalienceSet:
    """Views of a posed image set.

    Attributes
    ----------
    views
        Gaze distributions.
    frames_without_map
        Names of the frames without a map.
    unmatched_files
        Names of files that belong to no frame.
    notes
        Sentences about parts of the posed set that are not used.
    provenance
        Provenance (JSON).
    """

    views: list[SalienceView]
    frames_without_map: list[str]
    unmatched_files: list[str]
    notes: list[str]
    provenance: dict = field(default_factory=dict)


def open_salience(
    dataset: Photos | str | Path,
    source: str | Path,
    per: str = "pixel",
    align: np.ndarray | None = None,
    field_provenance: Mapping[str, Any] | None = None,
    allow_outside: bool = False,
) -> SalienceSet:
    """Read the saliency maps of a posed image set.

    Parameters
    ----------
    dataset
        The posed photos, or their file as in `Photos.load`.
    source
        Folder with one .png, .exr or .npy per frame, with the name of the photo except for the suffix; or the name of a
        model (``SALIENCE_MODELS``), which computes the maps from the photos.
    per
        Unit of the values. "pixel": gaze per pixel, as predicted by saliency models. "steradian": gaze per solid angle,
        as in a rendered density.
    align
        Similarity (4, 4) from the coordinates of the set to the target coordinates. Default: those of the set, or those
        of a radiance field that was trained on this set.
    field_provenance
        Provenance of that radiance field.
    allow_outside
        Whether files outside of the folders of the set and of the maps may be read.

    Raises
    ------
    NergError
        With the file name, for an invalid map, and if no frame has a map.

    Notes
    -----
    Masks of the frames mark pixels as unknown.
    """
    if per not in VALUE_UNITS:
        raise NergError(f'per must be {" or ".join(VALUE_UNITS)}, got "{per}"')
    posed = Photos.open(dataset, allow_outside)
    if (
        align is None
        and field_provenance
        and field_provenance.get("sha256") == posed.sha256
        and "to_file" in field_provenance
    ):
        align = invert_similarity(field_provenance["to_file"], '"to_file" of the field')
    if align is not None:
        posed = posed.transform(np.asarray(align, np.float64))
    model = SALIENCE_MODELS.get(str(source))
    if model is not None:
        files, unmatched_files = {f.name: None for f in posed.frames}, []
    else:
        files, unmatched_files = _match_files(Path(source), posed.frames, allow_outside)
    views = [_make_view(f, files[f.name], model, per) for f in posed.frames if f.name in files]
    frames_without_map = [f.name for f in posed.frames if f.name not in files]
    if not views:
        raise NergError(
            f'no file in "{source}" has the name of one of the {len(posed.frames)} frames of "{posed.path}"; '
            f'for the first frame, expected "{Path(posed.frames[0].name).stem}" with {", ".join(SALIENCE_SUFFIXES)}'
        )
    provenance = {
        "views": posed.path.name,
        "sha256": posed.sha256,
        "salience": str(source) if model else resolve_path(source).name,
        "per": per,
        "used": len(views),
        "missing": len(frames_without_map),
    }
    return SalienceSet(
        views, frames_without_map, unmatched_files, [*describe_unused(posed.unused), *posed.notes], provenance
    )


def read_salience(path: str | Path) -> np.ndarray:
    """Read a map (h, w), float64, non-negative and not all zero: PNG with 8 or 16 bits as stored (no gamma), EXR, or
    NPY.

    Raises `NergError` with the file name for an invalid map: NaN, negative values, colours, or transparency.
    """
    path = Path(path)
    out = read_npy(path, "salience image") if path.suffix.lower() == ".npy" else _read_stored_image(path)
    if out.ndim == 3 and out.shape[2] in (2, 4):
        if np.ptp(out[..., -1].astype(np.float64)) > 0:
            raise NergError(f'the salience image "{path}" is partly transparent; remove its alpha channel')
        out = out[..., :-1]
    if out.ndim == 3 and out.shape[2] in (1, 3):
        if not all(np.array_equal(out[..., 0], out[..., k], equal_nan=True) for k in range(1, out.shape[2])):
            raise NergError(
                f'the salience image "{path}" has colours; use the grey map itself, not a colour-coded image'
            )
        out = out[..., 0]
    if (
        out.ndim != 2
        or not out.size
        or not (np.issubdtype(out.dtype, np.number) or out.dtype == bool)
        or np.iscomplexobj(out)
    ):
        raise NergError(
            f'the salience image "{path}" must contain one number per pixel, got shape {out.shape} of {out.dtype}'
        )
    out = out.astype(np.float64)
    if not np.all(np.isfinite(out)):
        raise NergError(
            f'the salience image "{path}" contains {np.sum(~np.isfinite(out))} values that are not finite; '
            "remove it, or create it again"
        )
    if (out < 0).any():
        raise NergError(
            f'the salience image "{path}" contains negative values; convert log densities with the exponential function'
        )
    if not out.any():
        raise NergError(f'the salience image "{path}" is zero everywhere; remove it, or create it again')
    return out


def _read_stored_image(path: Path) -> np.ndarray:
    import mitsuba as mi

    bitmap = open_bitmap(path, "salience image")
    if bitmap.pixel_format() == mi.Bitmap.PixelFormat.MultiChannel and bitmap.channel_count() != 1:
        raise NergError(f'the salience image "{path}" has {bitmap.channel_count()} channels; save it with one channel')
    return np.array(bitmap)


def _match_files(folder: Path, frames: list[PosedFrame], allow_outside: bool) -> tuple[dict[str, Path], list[str]]:
    """Return the file of each frame that has one, and the names of the other files."""
    if not folder.is_dir():
        raise MissingFile(
            f'the folder "{folder}" of salience images does not exist; specify a folder or a model: '
            f"{', '.join(SALIENCE_MODELS)}"
        )
    files_by_stem: dict[str, Path] = {}
    for path in sorted(p for p in folder.iterdir() if p.suffix.lower() in SALIENCE_SUFFIXES):
        if path.stem in files_by_stem:
            raise NergError(
                f'"{files_by_stem[path.stem].name}" and "{path.name}" in "{folder}" belong to the same frame; remove '
                "one of them"
            )
        files_by_stem[path.stem] = path
    out, owner = {}, {}
    for frame in frames:
        stem = frame.image.stem
        if stem not in files_by_stem:
            continue
        if stem in owner:
            raise NergError(
                f'the salience image "{files_by_stem[stem]}" matches both "{owner[stem]}" and "{frame.name}"; '
                "rename one of the photos"
            )
        path = files_by_stem[stem]
        out[frame.name], owner[stem] = (
            path if allow_outside else check_inside(folder, path, "salience image"),
            frame.name,
        )
    return out, [p.name for stem, p in files_by_stem.items() if stem not in owner]


def _make_view(frame: PosedFrame, path: Path | None, model, per: str) -> SalienceView:
    if path is None:
        photo = read_photo(frame)
        size = photo.shape[1::-1]
        try:
            values = model(_to_opaque_float(photo))
        except ValueError as e:
            raise NergError(f'the photo "{frame.image}" has no saliency: {e}') from e
        subject = f'the photo "{frame.image}"'
    else:
        values, size, subject = read_salience(path), get_photo_size(frame), f'the salience image "{path}"'
    h, w = values.shape
    # The size of a map may have been rounded to a pixel.
    if abs(h - w * size[1] / size[0]) > max(1.0, _SHAPE_TOLERANCE * h):
        raise NergError(
            f"{subject} has {w} x {h} pixels, which does not match the shape of its photo, {size[0]} x {size[1]}; "
            "resize it"
        )
    intrinsics = frame.intrinsics(*size).resized(w, h)
    solid_angle = pixel_solid_angles(intrinsics)
    if frame.mask is not None:
        solid_angle = np.where(_resize_frame_mask(frame, frame.mask, intrinsics), solid_angle, 0)
    gaze_fraction = np.where(solid_angle > 0, values, 0) if per == "pixel" else values * solid_angle
    if not gaze_fraction.sum() > 0:
        raise NergError(
            f"{subject} is zero on all pixels that the lens and the mask of its frame include; "
            "remove it, or correct the mask"
        )
    view = SalienceView(
        frame.name, PosedCamera(intrinsics, frame.to_world), gaze_fraction / gaze_fraction.sum(), solid_angle
    ).reduce(_MAX_VIEW_PIXELS)
    return SalienceView(
        view.name, view.camera, view.gaze_fraction.astype(np.float32), view.solid_angle.astype(np.float32)
    )


def _to_opaque_float(photo: np.ndarray) -> np.ndarray:
    """Convert to floats in 0..1, composited over black."""
    photo = photo if photo.dtype == np.float32 else photo.astype(np.float32) / np.iinfo(photo.dtype).max
    return photo if photo.shape[2] == 3 else photo[..., :3] * photo[..., 3:]


def _resize_frame_mask(frame: PosedFrame, file: MaskFile, intrinsics: Intrinsics) -> np.ndarray:
    """Return which pixels of a map are fully known according to the mask ``file`` of its ``frame``."""
    mask = read_mask(file, read_photo(frame).shape[:2])
    width, height = min(intrinsics.width, mask.shape[1]), min(intrinsics.height, mask.shape[0])
    used = resize_mask(mask, width, height)
    # A map with a higher resolution than its mask uses the nearest value.
    return resize_nearest(used, intrinsics.width, intrinsics.height)
