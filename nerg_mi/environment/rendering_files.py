"""Files of a rendering: frames, meshes and volumes to check, and images written in pieces."""

from __future__ import annotations

import csv
import os
import re
import struct
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from nerg_mi.errors import NergError, sanitize
from nerg_mi.files.atomic import check_writable, replace_atomically
from nerg_mi.files.images import encode_png, open_exr_writer, split_bitmap_channels
from nerg_mi.files.safe_read import map_bytes, open_file, translate_read_errors
from nerg_mi.files.tables import open_csv, write_csv
from nerg_mi.formats.camera_path import CameraPath, read_camera_path
from nerg_mi.formats.meshes import MAX_BYTES, MeshFile, read_mesh_file
from nerg_mi.formats.ply import PLY_MAGIC, parse_ply, write_columns

# ---- Frames file ----
#
# A CSV file for image sequences: the header names `<default>`s of a scene, and each row contains their values in one
# frame.

MAX_FRAMES_BYTES = 64 << 20
"""Maximum size of a frames file."""

MAX_FRAMES = 1_000_000
"""Maximum number of frames."""

_MAX_COLUMNS = 64
_NAME = re.compile(r"[A-Za-z_]\w*", re.ASCII)


def _frames_of_path(path: CameraPath) -> list[dict[str, str]]:
    text = lambda values: ", ".join(f"{v + 0.0:.9g}" for v in np.atleast_1d(values).tolist())
    eye, up, back = path.to_world[:, :3, 3], path.to_world[:, :3, 1], path.to_world[:, :3, 2]
    named = {"camera": eye, "target": eye - back, "up": up, "fov": path.horizontal_fov}
    return [{name: text(values[k]) for name, values in named.items()} for k in range(len(eye))]


def read_frames(path: str | Path) -> list[dict[str, str]]:
    """Read a frames file.

    Parameters
    ----------
    path : str or Path
        CSV file, or a camera path of nerfstudio (.json), which sets ``camera``, ``target``, ``up`` and ``fov`` as the
        scenes of ``nerg scene`` name them.

    Returns
    -------
    list of dict of str to str
        For each frame, the values by the name of their `<default>`.

    Raises
    ------
    NergError
        The file is not a valid frames file; the message names the line.
    """
    if Path(path).suffix.lower() == ".json":
        return _frames_of_path(read_camera_path(path))
    names: list[str] | None = None
    frames: list[dict[str, str]] = []
    lines = open_csv(path, "frames file", MAX_FRAMES_BYTES)
    try:
        for cells in lines:
            if not any(cell.strip() for cell in cells):
                continue
            if names is None:
                names = _check_names(path, [cell.strip() for cell in cells])
                continue
            if len(cells) != len(names):
                raise NergError(
                    f'the frames file "{path}" (line {lines.line_num}) has {len(cells)} values for {len(names)} '
                    'columns; values with commas, such as positions, need quotes: "1, 2, 3"'
                )
            if len(frames) == MAX_FRAMES:
                raise NergError(f'the frames file "{path}" has more than {MAX_FRAMES:,} frames; split the file')
            frames.append(dict(zip(names, cells)))
    except csv.Error as error:
        raise NergError(
            f'the frames file "{path}" (line {lines.line_num}) is not valid CSV: {sanitize(error)}'
        ) from error
    if not frames:
        raise NergError(
            f'the frames file "{path}" contains no frames; it needs a header with names of <default>s and one line '
            "per frame"
        )
    return frames


def _check_names(path: str | Path, names: list[str]) -> list[str]:
    bad = next((name for name in names if not _NAME.fullmatch(name)), None)
    if bad is not None or len(names) > _MAX_COLUMNS:
        what = f"{len(names)} names" if bad is None else f'"{sanitize(bad, 40)}"'
        raise NergError(
            f'the header of "{path}" contains {what}; it must consist of names of <default>s of the scene, such as eye'
        )
    if len(set(names)) < len(names):
        raise NergError(f'the header of "{path}" contains a name twice; remove one of the columns')
    return names


def write_frames(path: str | Path, frames: Sequence[Mapping[str, str]]) -> None:
    """Write a frames file atomically."""
    write_csv(path, frames)


def frame_path(output: Path, number: int, count: int) -> Path:
    """Return the path of frame ``number``, from 1 to ``count``, of a sequence: walk.png becomes walk_0001.png."""
    return output.with_name(f"{output.stem}_{number:0{max(4, len(str(count)))}d}{output.suffix}")


# ---- Checks of meshes and volumes ----
#
# Mitsuba trusts the counts and indices in a file; wrong ones exhaust the memory or crash the process. These functions
# check files before Mitsuba reads them.


def check_mesh(path: str | os.PathLike, kind: str, colored: bool = False) -> None:
    """Check that Mitsuba reads a mesh file correctly.

    Parameters
    ----------
    path : path-like
        Mesh file.
    kind : str
        Mitsuba plugin, "ply" or "obj".
    colored : bool
        Whether a texture uses the colours of the mesh.

    Raises
    ------
    NergError
        Mitsuba cannot read the file, or not all of it.
    """
    mesh = read_mesh_file(path, suffix=f".{kind}")
    reason = mesh.unreadable_reason or (
        "Mitsuba does not read its colours because of an alpha channel or their format"
        if colored and mesh.hides_colors
        else ""
    )
    if reason:
        raise NergError(
            f'Mitsuba cannot read the mesh "{path}" correctly: {reason}; export it in another format, or convert it '
            f'with "nerg scene {path} -o scene.xml"'
        )


def check_ply_points(path: str | os.PathLike) -> None:
    """Check that a PLY file has vertices and is complete. Raises `NergError` otherwise."""
    raw = map_bytes(path, "PLY file", MAX_BYTES, PLY_MAGIC, "export it again")
    with translate_read_errors(path, "PLY file", "export it again"):
        ply = parse_ply(np.frombuffer(raw, np.uint8))
        if "vertex" not in ply.tables or not ply.tables["vertex"].count:
            raise ValueError("it has no vertices")
        if ply.unusual_text:
            raise ValueError(f"{ply.unusual_text}, which Mitsuba does not read")


def write_mesh(path: str | os.PathLike, mesh: MeshFile) -> None:
    """Write ``mesh`` as a PLY file that Mitsuba reads.

    Colours become the attribute ``vertex_color`` or ``face_color``, linear in 0..1.
    """
    columns = dict(zip("xyz", mesh.vertices.T))
    if mesh.normals is not None:
        columns |= dict(zip(("nx", "ny", "nz"), mesh.normals.T))
    color_columns = lambda colors: {} if colors is None else {f"color_{k}": colors[:, k] for k in range(3)}
    write_columns(path, columns | color_columns(mesh.colors), mesh.faces, color_columns(mesh.face_colors))


def check_vol(path: str | os.PathLike) -> None:
    """Check that a Mitsuba volume (.vol) is valid and complete. Raises `NergError` otherwise."""
    path = Path(path)
    with open_file(path, "volume") as file:
        head = file.read(48)
        magic, version, kind, *size = struct.unpack("<3sB5i", head[:24])
        if magic != b"VOL" or version != 3:
            raise ValueError("it is not a Mitsuba volume of version 3")
        if kind != 1:
            raise ValueError(f"its data type is {kind}, but only 1 (float32) is supported")
        if min(size) < 1:
            raise ValueError("it has {} x {} x {} voxels of {} channels".format(*size))
        # Python's integers do not overflow.
        needed = 48 + 4 * size[0] * size[1] * size[2] * size[3]
        if path.stat().st_size < needed:
            raise ValueError(f"it has {path.stat().st_size:,} bytes, but its header requires {needed:,}")


def read_vol(path: str | os.PathLike) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the values (z, y, x, channels) of a Mitsuba volume (.vol), and the lower and upper corner of its box.
    Raises `NergError` as `check_vol`."""
    check_vol(path)
    with open_file(path, "volume") as file:
        head = file.read(48)
        nx, ny, nz, channels = struct.unpack("<4i", head[8:24])
        values = np.frombuffer(file.read(4 * nx * ny * nz * channels), "<f4").reshape(nz, ny, nx, channels)
    corners = np.frombuffer(head[24:], "<f4")
    return values, corners[:3], corners[3:]


# ---- Image files ----
#
# Images are written from the top in pieces: .exr with all channels of a film, .png with its colour.

IMAGE_FORMATS = (".exr", ".png")
_DITHER_ROWS = 256
"""Period, in rows, of the dither pattern that Mitsuba adds when it rounds to 8 bits."""


@contextmanager
def open_image_rows(
    path: str | Path, width: int, height: int, text: Mapping[str, str] | None = None
) -> Iterator[Callable[[object, int], None]]:
    """Write an image file row by row, atomically.

    Parameters
    ----------
    path : str or Path
        Image file: .exr stores float32, .png stores sRGB.
    width, height : int
        Size in pixels.
    text : mapping of str to str, optional
        Texts for the header, by PNG keyword.

    Yields
    ------
    callable
        ``write(bitmap, rows)`` appends the first ``rows`` rows of a Mitsuba bitmap.
    """
    check_writable(path, *IMAGE_FORMATS)
    if Path(path).suffix.lower() == ".exr":
        with open_exr_writer(path, width, height, text) as write:
            yield lambda bitmap, rows: write(
                {name: values[:rows] for name, values in split_bitmap_channels(bitmap).items()}
            )
        return
    # Open the file first, so that an unwritable folder is reported before the rendering.
    with replace_atomically(path) as temporary:
        display = DisplayRows(width, height)
        yield display.add
        temporary.write_bytes(encode_png(display.bitmap(), text))


class DisplayRows:
    """Collects the colour of an image of ``width`` x ``height`` pixels in 8 bits sRGB, from the top."""

    def __init__(self, width: int, height: int):
        self._pixels, self._num_converted = np.empty((height, width, 3), np.uint8), 0
        self._pending, self._format = [], None

    def add(self, bitmap, rows: int) -> None:
        """Append the first ``rows`` rows of a Mitsuba bitmap."""
        import mitsuba as mi

        # In a bitmap with AOVs, the colour is the layer without a name.
        if bitmap.pixel_format() == mi.Bitmap.PixelFormat.MultiChannel:
            bitmap = dict(bitmap.split())["<root>"]
        self._format = bitmap.pixel_format()
        self._pending.append(np.array(bitmap)[:rows])
        num_pending = sum(len(part) for part in self._pending)
        num_ready = (
            num_pending
            if self._num_converted + num_pending == len(self._pixels)
            else num_pending // _DITHER_ROWS * _DITHER_ROWS
        )
        if num_ready:
            values = np.concatenate(self._pending)
            self._convert(values[:num_ready])
            self._pending = [values[num_ready:].copy()]

    def _convert(self, values: np.ndarray) -> None:
        import mitsuba as mi

        bitmap = mi.Bitmap(values, pixel_format=self._format).convert(
            mi.Bitmap.PixelFormat.RGB, mi.Struct.Type.UInt8, True
        )
        self._pixels[self._num_converted : self._num_converted + len(values)] = np.array(bitmap)
        self._num_converted += len(values)

    def bitmap(self):
        """Return the complete image as a Mitsuba bitmap. Raises ``ValueError`` if rows are missing."""
        import mitsuba as mi

        return mi.Bitmap(self.pixels())

    def pixels(self) -> np.ndarray:
        """Return the complete image (height, width, 3), uint8. Raises ``ValueError`` if rows are missing."""
        if self._num_converted != len(self._pixels):
            raise ValueError(f"{self._num_converted} of {len(self._pixels)} rows were written")
        return self._pixels
