"""Salience images as densities over directions: solid angles of pixels, a classical model, and views of posed
photos."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path

import numpy as np

from nerg_mi.errors import MissingFile, NergError
from nerg_mi.files.safe_read import read_npy, resolve_path

from . import cameras
from .cameras import Intrinsics, PosedCamera, resize_mask, resize_by_area, resize_nearest, make_area_weights
from .colmap import find_pose_source
from .images import open_bitmap, read_mask, read_photo, read_posed_images
from .posed import MaskFile, PosedFrame, check_inside

# ---- Solid angles of a picture's pixels, whatever the lens ----
#
# A pixel covers the directions between those of its four corners: two spherical triangles, whose areas are exact (Van
# Oosterom & Strackee 1983). A pinhole's straight edges are great circles, so that its pixels' areas are exact too and
# those of all pixels sum to the frustum's; for other lenses the error falls with the square of the pixel's size. To
# first order this is the Jacobian dω/dA of the lens: cos³θ / f² for a pinhole (A in the image plane, focal length f,
# angle θ from the axis).


# Rows of pixels at a time: photos have many.
_ROWS = 256


@lru_cache(maxsize=4)
def pixel_solid_angles(intrinsics: Intrinsics) -> np.ndarray:
    """Solid angles (height, width), sr, float64, read-only. Pixels that a fisheye lens does not reach have none.

    Raises ``ValueError`` as `cameras.undistort` does.
    """
    i = intrinsics
    out = np.empty((i.height, i.width))
    for a in range(0, i.height, _ROWS):
        rows = np.arange(a, min(a + _ROWS, i.height) + 1)
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
    """Signed areas (...) of spherical triangles with unit corners (..., 3); positive where a, b, c are right-handed."""
    dot = lambda u, v: np.einsum("...i,...i->...", u, v)
    return 2 * np.arctan2(dot(a, np.cross(b, c)), 1 + dot(a, b) + dot(b, c) + dot(c, a))


# ---- Spectral residual ----
#
# A classical model of salience: the spectral residual of Hou & Zhang (CVPR 2007).
#
# What is salient is what a photo's spectrum does not share with others': the log amplitude less its local mean, with
# the phase kept, transformed back, squared and blurred. On scipy alone (a library with salience models, OpenCV's
# contributed modules, weighs 70 MB and replaces the cv2 of whoever has one). It looks for contrast and oddity, and
# knows nothing of people, faces or tasks: an example, not a measure of where people look.


# The authors' scale of attention, and their blur in pixels at that width.
RESIDUAL_WIDTH = 64
_SIGMA = 2.5


def spectral_residual(photo: np.ndarray, width: int = RESIDUAL_WIDTH) -> np.ndarray:
    """Salience (h, w), float64, at most 1, of ``photo`` (H, W, 3) in 0..1, sRGB; computed and returned ``width`` pixels
    wide.

    As the authors' own script has it: grey, 3 x 3 mean of the log amplitude with repeated edges, Gaussian of 2.5
    pixels. Raises `NergError` for a photo of one colour, which has no salience.
    """
    from scipy.fft import fft2, ifft2
    from scipy.ndimage import gaussian_filter, uniform_filter

    H, W = photo.shape[:2]
    w = min(width, W)
    grey = np.asarray(photo, np.float32) @ np.array([0.299, 0.587, 0.114], np.float32)
    grey = resize_by_area(grey[..., None], w, max(1, round(H * w / W)))[..., 0].astype(np.float64)
    if not np.ptp(grey) > 1e-6:
        raise NergError("it has one colour everywhere, and no spectrum to find salience in")
    spectrum = np.asarray(fft2(grey))
    # The logarithm of an amplitude of zero is none; rounding decides about smaller ones anyway.
    amplitude = np.log(np.maximum(np.abs(spectrum), 1e-9 * np.abs(spectrum).max()))
    residual = amplitude - uniform_filter(amplitude, 3, mode="nearest")
    salience = np.abs(np.asarray(ifft2(np.exp(residual + 1j * np.angle(spectrum))))) ** 2
    salience = gaussian_filter(salience, _SIGMA, mode="constant", truncate=2.0)
    return salience / salience.max()


# ---- Salience images of posed photos as densities over directions ----
#
# A salience image says how the gaze of somebody at the camera's centre is shared among the pixels, and nothing about
# what lies outside the picture: with the share s_i of pixel i and its solid angle dω_i, the density there is s_i / dω_i
# / Σ s, in 1/sr, given that the picture is looked at.

SALIENCE_SUFFIXES = (".png", ".exr", ".npy")
VALUE_UNITS = ("pixel", "steradian")
SALIENCE_MODELS = {"spectral-residual": spectral_residual}
# Pixels that are kept of an image: gaze fields are coarse.
_KEPT = 1 << 14
# Share by which a map may be off the shape of its photo.
_SHAPE = 0.01
_OPENGL_FROM_OPENCV = np.array([1.0, -1.0, -1.0])


@dataclass(frozen=True, eq=False)
class SalienceView:
    """What is looked at in one picture. ``camera``: its intrinsics are of the map's size; ``share`` (h, w): of the
    gaze, summing to one; ``solid_angle`` (h, w): sr of the directions that are known, 0 where the lens or a mask shows
    none."""

    name: str
    camera: PosedCamera
    gaze_fraction: np.ndarray
    solid_angle: np.ndarray

    @property
    def total_solid_angle(self) -> float:
        """Solid angle of what is known, sr."""
        return float(self.solid_angle.sum(dtype=np.float64))

    @property
    def density(self) -> np.ndarray:
        """(h, w), 1/sr, given that the picture is looked at; 0 where nothing is known."""
        known = self.solid_angle > 0
        return np.where(known, self.gaze_fraction / np.where(known, self.solid_angle, 1), 0)

    def reduce(self, pixels: int) -> SalienceView:
        """The same on at most ``pixels`` pixels, each of which has the gaze and the solid angle of those that it
        covers."""
        h, w = self.gaze_fraction.shape
        if h * w <= pixels:
            return self
        factor = np.sqrt(pixels / (h * w))
        width, height = max(1, int(w * factor)), max(1, int(h * factor))
        camera = PosedCamera(self.camera.intrinsics.resized(width, height), self.camera.to_world)
        rows, columns = make_area_weights(h, height) * np.float32(h / height), make_area_weights(w, width) * np.float32(w / width)
        total = lambda v: np.asarray((columns @ (rows @ v).T).T, np.float64)
        share = total(self.gaze_fraction)
        return SalienceView(self.name, camera, share / share.sum(), total(self.solid_angle))

    def sample(self, count: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        """``count`` directions that each stand for as much of the view's extent: (count, 3) unit, in the world, at
        random within the pixels (count,), flat indices, that are drawn by their solid angle (systematically: each as
        often as is its due, rounded up or down)."""
        steps = np.cumsum(self.solid_angle.ravel(), dtype=np.float64)
        which = np.searchsorted(steps, (np.arange(count) + rng.random()) * (steps[-1] / count), side="right")
        which = np.minimum(which, np.flatnonzero(self.solid_angle.ravel())[-1])
        i, at = self.camera.intrinsics, rng.random((2, count))
        xy = np.stack([(which % i.width + at[0] - i.cx) / i.fx, (which // i.width + at[1] - i.cy) / i.fy], axis=-1)
        return cameras.image_to_directions(xy, i) * _OPENGL_FROM_OPENCV @ self.camera.to_world[:3, :3].T, which

    def evaluate(self, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """``(density, known)`` (N,) of world ``directions`` (N, 3): 1/sr, and whether the view shows them."""
        i = self.camera.intrinsics
        xy, shown = cameras.directions_to_image(np.asarray(directions) @ self.camera.to_world[:3, :3] * _OPENGL_FROM_OPENCV, i)
        x, y = np.floor(xy[:, 0] * i.fx + i.cx), np.floor(xy[:, 1] * i.fy + i.cy)
        known = shown & (x >= 0) & (x < i.width) & (y >= 0) & (y < i.height)
        at = np.where(known, y, 0).astype(int), np.where(known, x, 0).astype(int)
        known &= self.solid_angle[at] > 0
        return np.where(known, self.density[at], 0), known


@dataclass(frozen=True)
class SalienceSet:
    """``views``; ``missing``: names of the frames without an image; ``stray``: files that belong to no frame;
    ``unused``: sentences on what of the posed set is not used; ``about``: for provenance (JSON)."""

    views: list[SalienceView]
    frames_without_map: list[str]
    unmatched_files: list[str]
    notes: list[str]
    provenance: dict = field(default_factory=dict)


def open_salience(
    dataset: str | Path,
    source: str | Path,
    per: str = "pixel",
    align: np.ndarray | None = None,
    field_provenance: dict | None = None,
    allow_outside: bool = False,
) -> SalienceSet:
    """The salience images of a posed image set ``dataset`` (as `colmap.find_source` knows them).

    ``source``: a folder with one .png, .exr or .npy a frame, called as the photo is but for the suffix, or the name of
    a model (``MODELS``), which makes them from the photos. ``per``: what the images' values are proportional to: gaze a
    ``pixel``, as models have it that predict where in a picture is looked, or a ``steradian``, as a rendered density
    has it. ``align``: (4, 4) similarity from the set's coordinates to those wanted; by default they stay, or become
    those of a radiance field that was trained on this very file, of which ``trained`` is the provenance. Masks of the
    frames hide what is not known.
    ``allow_outside``: read files outside of the set's folder, and of that of the images, too, to which names and links
    may lead.

    Raises `NergError`, naming the file, for an image that is none, and when no frame has one.
    """
    if per not in VALUE_UNITS:
        raise NergError(f'salience is given per {" or per ".join(VALUE_UNITS)}, not per "{per}"')
    posed = read_posed_images(find_pose_source(dataset), allow_outside)
    if align is None and field_provenance and field_provenance.get("sha256") == posed.sha256 and "to_file" in field_provenance:
        align = np.linalg.inv(field_provenance["to_file"])
    if align is not None:
        posed = posed.transform(np.asarray(align, np.float64))
    model = SALIENCE_MODELS.get(str(source))
    if model is not None:
        files, stray = {f.name: None for f in posed.frames}, []
    else:
        files, stray = _files(Path(source), posed.frames, allow_outside)
    views = [_view(f, files[f.name], model, per) for f in posed.frames if f.name in files]
    missing = [f.name for f in posed.frames if f.name not in files]
    if not views:
        raise NergError(
            f'no image in "{source}" is called as one of the {len(posed.frames)} frames of "{posed.path}" is; '
            f'the first of these would be "{Path(posed.frames[0].name).stem}" with {", ".join(SALIENCE_SUFFIXES)}'
        )
    about = {
        "views": posed.path.name,
        "sha256": posed.sha256,
        "salience": str(source) if model else resolve_path(source).name,
        "per": per,
        "used": len(views),
        "missing": len(missing),
    }
    return SalienceSet(views, missing, stray, [*map(str, posed.unused), *posed.notes], about)


def read_salience(path: str | Path) -> np.ndarray:
    """The image (h, w), float64, not negative and not all zero: PNG of 8 or 16 bits as stored (no gamma), EXR, NPY.

    Raises `NergError`, naming the file, for what is none: NaN, negative values, colours, transparency.
    """
    path = Path(path)
    out = read_npy(path, "salience image") if path.suffix.lower() == ".npy" else _stored(path)
    if out.ndim == 3 and out.shape[2] in (2, 4):
        if np.ptp(out[..., -1].astype(np.float64)) > 0:
            raise NergError(f'the salience image "{path}" is partly transparent; leave out its alpha channel')
        out = out[..., :-1]
    if out.ndim == 3 and out.shape[2] in (1, 3):
        if not all(np.array_equal(out[..., 0], out[..., k], equal_nan=True) for k in range(1, out.shape[2])):
            raise NergError(f'the salience image "{path}" is in colours; give the grey map itself, not a picture of it')
        out = out[..., 0]
    if (
        out.ndim != 2
        or not out.size
        or not (np.issubdtype(out.dtype, np.number) or out.dtype == bool)
        or np.iscomplexobj(out)
    ):
        raise NergError(
            f'the salience image "{path}" must hold one number a pixel, got shape {out.shape} of {out.dtype}'
        )
    out = out.astype(np.float64)
    if not np.all(np.isfinite(out)):
        raise NergError(
            f'the salience image "{path}" holds {np.sum(~np.isfinite(out))} values that are not finite; '
            "leave it out, or make it again"
        )
    if (out < 0).any():
        raise NergError(f'the salience image "{path}" holds negative values; of log densities give the exponential')
    if not out.any():
        raise NergError(f'the salience image "{path}" is zero everywhere; leave it out, or make it again')
    return out


def _stored(path: Path) -> np.ndarray:
    import mitsuba as mi

    bitmap = open_bitmap(path, "salience image")
    if bitmap.pixel_format() == mi.Bitmap.PixelFormat.MultiChannel and bitmap.channel_count() != 1:
        raise NergError(
            f'the salience image "{path}" has {bitmap.channel_count()} channels and not one; save it with one'
        )
    return np.array(bitmap)


def _files(folder: Path, frames: list[PosedFrame], allow_outside: bool) -> tuple[dict[str, Path], list[str]]:
    """The file of each frame that has one, and names of the others."""
    if not folder.is_dir():
        raise MissingFile(
            f'there is no folder "{folder}" of salience images; give one, or a model: {", ".join(SALIENCE_MODELS)}'
        )
    found: dict[str, Path] = {}
    for path in sorted(p for p in folder.iterdir() if p.suffix.lower() in SALIENCE_SUFFIXES):
        if path.stem in found:
            raise NergError(
                f'"{found[path.stem].name}" and "{path.name}" in "{folder}" are of the same frame; keep one'
            )
        found[path.stem] = path
    out, owner = {}, {}
    for frame in frames:
        stem = frame.image.stem
        if stem not in found:
            continue
        if stem in owner:
            raise NergError(
                f'the salience image "{found[stem]}" could be of "{owner[stem]}" or of "{frame.name}"; '
                "give the photos different names"
            )
        path = found[stem]
        out[frame.name], owner[stem] = path if allow_outside else check_inside(folder, path, "salience image"), frame.name
    return out, [p.name for stem, p in found.items() if stem not in owner]


def _view(frame: PosedFrame, path: Path | None, model, per: str) -> SalienceView:
    if path is None:
        photo = read_photo(frame)
        size = photo.shape[1::-1]
        try:
            values = model(_opaque(photo))
        except ValueError as e:
            raise NergError(f'the photo "{frame.image}" has no salience: {e}') from e
        what = f'the photo "{frame.image}"'
    else:
        values, size, what = read_salience(path), _photo_size(frame), f'the salience image "{path}"'
    h, w = values.shape
    # A map may be a pixel off where its size was rounded.
    if abs(h - w * size[1] / size[0]) > max(1.0, _SHAPE * h):
        raise NergError(
            f"{what} has {w} x {h} pixels, which is not the shape of its photo, {size[0]} x {size[1]}; "
            "bring it to that shape"
        )
    intrinsics = frame.intrinsics(*size).resized(w, h)
    solid = pixel_solid_angles(intrinsics)
    if frame.mask is not None:
        solid = np.where(_unmasked(frame, frame.mask, intrinsics), solid, 0)
    share = np.where(solid > 0, values, 0) if per == "pixel" else values * solid
    if not share.sum() > 0:
        raise NergError(
            f"{what} is zero wherever the lens and the mask of its frame show anything; "
            "leave it out, or correct the mask"
        )
    view = SalienceView(frame.name, PosedCamera(intrinsics, frame.to_world), share / share.sum(), solid).reduce(_KEPT)
    return SalienceView(view.name, view.camera, view.gaze_fraction.astype(np.float32), view.solid_angle.astype(np.float32))


def _opaque(photo: np.ndarray) -> np.ndarray:
    """Floats in 0..1, before black where there is alpha."""
    photo = photo if photo.dtype == np.float32 else photo.astype(np.float32) / np.iinfo(photo.dtype).max
    return photo if photo.shape[2] == 3 else photo[..., :3] * photo[..., 3:]


def _photo_size(frame: PosedFrame) -> tuple[int, int]:
    """Width and height: what the camera says, or else the file."""
    if "w" in frame.lens and "h" in frame.lens:
        return round(frame.lens["w"]), round(frame.lens["h"])
    return read_photo(frame).shape[1::-1]


def _unmasked(frame: PosedFrame, file: MaskFile, intrinsics: Intrinsics) -> np.ndarray:
    """Which pixels of a map are known altogether, by the mask ``file`` of its ``frame``."""
    mask = read_mask(file, read_photo(frame).shape[:2])
    width, height = min(intrinsics.width, mask.shape[1]), min(intrinsics.height, mask.shape[0])
    used = resize_mask(mask, width, height)
    # A map that is finer than its mask takes the nearest.
    return resize_nearest(used, intrinsics.width, intrinsics.height)
