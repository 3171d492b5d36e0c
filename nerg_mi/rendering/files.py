"""Files around a rendering: pictures written in pieces, values of frames, and meshes checked before Mitsuba reads
them."""

from __future__ import annotations

import csv
import io
import os
import re
import struct
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from nerg_mi.errors import NergError, sanitize
from nerg_mi.files.atomic import check_writable, replace_atomically
from nerg_mi.files.images import split_bitmap_channels, encode_png, open_exr_writer
from nerg_mi.files.safe_read import map_bytes, open_file, read_bytes, translate_read_errors
from nerg_mi.files.tables import write_csv
from nerg_mi.formats.meshes import MAX_BYTES, MeshFile, read_mesh_file
from nerg_mi.formats.ply import PLY_MAGIC, parse_ply, write_columns

# ---- Frames file ----
#
# Sequences of pictures: a CSV file whose header names `<default>`s of a scene and whose rows are their values in each
# picture.

FRAMES_BYTES = 64 << 20
"""A file of frames may have so many bytes."""

FRAMES = 1_000_000
"""And so many frames."""

_COLUMNS = 64
_NAME = re.compile(r"[A-Za-z_]\w*", re.ASCII)


def read_frames(path: str | Path) -> list[dict[str, str]]:
    """Values by the name of their `<default>`, of each picture. Raises `NergError` for what is no such file, naming the
    line."""
    raw = read_bytes(path, "file of frames", FRAMES_BYTES)
    with translate_read_errors(path, "file of frames", "correct it"):
        text = raw.decode("utf-8-sig")
    names: list[str] | None = None
    frames: list[dict[str, str]] = []
    lines = csv.reader(io.StringIO(text, newline=""), strict=True)
    try:
        for cells in lines:
            if not any(cell.strip() for cell in cells):
                continue
            if names is None:
                names = _names(path, [cell.strip() for cell in cells])
                continue
            if len(cells) != len(names):
                raise NergError(
                    f'"{path}" (line {lines.line_num}) has {len(cells)} values for {len(names)} names; positions have '
                    'commas in them and need quotes: "1, 2, 3"'
                )
            if len(frames) == FRAMES:
                raise NergError(f'"{path}" has more than {FRAMES:,} frames; divide it')
            frames.append(dict(zip(names, cells)))
    except csv.Error as error:
        raise NergError(f'"{path}" (line {lines.line_num}) is no CSV: {sanitize(error)}; correct it') from error
    if not frames:
        raise NergError(f'"{path}" holds no frames: a line of names of <default>s, and a line for each picture')
    return frames


def _names(path: str | Path, names: list[str]) -> list[str]:
    bad = next((name for name in names if not _NAME.fullmatch(name)), None)
    if bad is not None or len(names) > _COLUMNS:
        what = f"{len(names)} names" if bad is None else f'"{sanitize(bad, 40)}"'
        raise NergError(f'"{path}" begins with {what}, where names of <default>s of the scene are needed, such as eye')
    if len(set(names)) < len(names):
        raise NergError(f'"{path}" names a <default> twice; leave one of the columns')
    return names


def write_frames(path: str | Path, frames: Sequence[Mapping[str, str]]) -> None:
    """Write ``frames``, whole or not at all."""
    write_csv(path, frames)


def frame_path(output: Path, number: int, count: int) -> Path:
    """The file of the picture ``number``, from 1 on, of ``count``: walk.png, walk_0001.png."""
    return output.with_name(f"{output.stem}_{number:0{max(4, len(str(count)))}d}{output.suffix}")


# ---- Mesh file ----
#
# Meshes and volumes that Mitsuba is going to read, looked at before: its readers believe the counts and indices in a
# file, and fill the memory or end the process where these are wrong.


def check_mesh(path: str | os.PathLike, kind: str, colored: bool = False) -> None:
    """Raise `NergError` for a file that Mitsuba's plugin ``kind`` ("ply", "obj") does not read as a mesh, or not as the
    one that it is; ``colored``: whether a texture is to show its colours."""
    mesh = read_mesh_file(path, suffix=f".{kind}")
    reason = mesh.unreadable_reason or (
        "an alpha, or their format, hides its colours" if colored and mesh.hides_colors else ""
    )
    if reason:
        raise NergError(
            f'Mitsuba does not read the mesh "{path}" as it is meant: {reason}; export it otherwise, or take what '
            f'"nerg scene {path} -o scene.xml" makes of it'
        )


def check_points(path: str | os.PathLike) -> None:
    """Raise `NergError` for a PLY file that holds less than its header says, or no vertices."""
    raw = map_bytes(path, "PLY file", MAX_BYTES, PLY_MAGIC, "export it again")
    with translate_read_errors(path, "PLY file", "export it again"):
        tables = parse_ply(np.frombuffer(raw, np.uint8)).tables
        if "vertex" not in tables or not tables["vertex"].count:
            raise ValueError("it has no vertices")


def write_mesh(path: str | os.PathLike, mesh: MeshFile) -> None:
    """Write ``mesh`` as a PLY file that Mitsuba shows: triangles, with the attributes ``vertex_color`` or
    ``face_color``, linear in 0..1, where there are colours."""
    columns = dict(zip("xyz", mesh.vertices.T))
    if mesh.normals is not None:
        columns |= dict(zip(("nx", "ny", "nz"), mesh.normals.T))
    tint = lambda colors: {} if colors is None else {f"color_{k}": colors[:, k] for k in range(3)}
    write_columns(path, columns | tint(mesh.colors), mesh.faces, tint(mesh.face_colors))


def check_vol(path: str | os.PathLike) -> None:
    """Raise `NergError` for a volume (Mitsuba's .vol) with counts below 1, or with fewer values than it announces."""
    path = Path(path)
    with open_file(path, "volume") as file:
        head = file.read(48)
        magic, version, kind, *size = struct.unpack("<3sB5i", head[:24])
        if magic != b"VOL" or version != 3:
            raise ValueError("it is no volume of Mitsuba's version 3")
        if kind != 1:
            raise ValueError(f"its values are of kind {kind}, and only float32 (1) is read")
        if min(size) < 1:
            raise ValueError("it has {} x {} x {} voxels of {} channels".format(*size))
        # Python's integers do not overflow.
        needed = 48 + 4 * size[0] * size[1] * size[2] * size[3]
        if path.stat().st_size < needed:
            raise ValueError(f"it has {path.stat().st_size:,} bytes, and its header asks for {needed:,}")


# ---- Picture file ----
#
# Picture files that are written from the top in pieces: .exr with all channels of a film, .png with its colour.

IMAGE_FORMATS = (".exr", ".png")
_DITHER = 256
"""Rows after which the pattern repeats that Mitsuba adds where it rounds to 8 bits."""


@contextmanager
def open_image_rows(
    path: str | Path, width: int, height: int, text: Mapping[str, str] | None = None
) -> Iterator[Callable[[object, int], None]]:
    """A picture file of ``width`` x ``height`` pixels, whole or absent.

    Gives a function that writes the next rows: the first ``rows`` of a Mitsuba bitmap. Float32 in .exr, tonemapped to
    sRGB in .png. ``text``: what the header says, by PNG's names.
    """
    check_writable(path, *IMAGE_FORMATS)
    if Path(path).suffix.lower() == ".exr":
        with open_exr_writer(path, width, height, text) as write:
            yield lambda bitmap, rows: write({name: values[:rows] for name, values in split_bitmap_channels(bitmap).items()})
        return
    # Opened first, so that a folder that cannot be written to is found before anything is rendered.
    with replace_atomically(path) as temporary:
        display = DisplayRows(width, height)
        yield display.add
        temporary.write_bytes(encode_png(display.bitmap(), text))


class DisplayRows:
    """The colour of a picture of ``width`` x ``height`` pixels in 8 bits, tonemapped to sRGB, put together from the
    top."""

    def __init__(self, width: int, height: int):
        self._pixels, self._done = np.empty((height, width, 3), np.uint8), 0
        self._waiting, self._format = [], None

    def add(self, bitmap, rows: int) -> None:
        """Add the first ``rows`` of a Mitsuba bitmap."""
        import mitsuba as mi

        # With AOVs the bitmap has many channels, of which the colour is the layer without a name.
        if bitmap.pixel_format() == mi.Bitmap.PixelFormat.MultiChannel:
            bitmap = dict(bitmap.split())["<root>"]
        self._format = bitmap.pixel_format()
        self._waiting.append(np.array(bitmap)[:rows])
        known = sum(len(part) for part in self._waiting)
        ready = known if self._done + known == len(self._pixels) else known // _DITHER * _DITHER
        if ready:
            values = np.concatenate(self._waiting)
            self._convert(values[:ready])
            self._waiting = [values[ready:].copy()]

    def _convert(self, values: np.ndarray) -> None:
        import mitsuba as mi

        bitmap = mi.Bitmap(values, pixel_format=self._format).convert(
            mi.Bitmap.PixelFormat.RGB, mi.Struct.Type.UInt8, True
        )
        self._pixels[self._done : self._done + len(values)] = np.array(bitmap)
        self._done += len(values)

    def bitmap(self):
        """All of it as a Mitsuba bitmap. Raises ``ValueError`` while rows are missing."""
        import mitsuba as mi

        return mi.Bitmap(self.pixels())

    def pixels(self) -> np.ndarray:
        """All of it (height, width, 3), uint8. Raises ``ValueError`` while rows are missing."""
        if self._done != len(self._pixels):
            raise ValueError(f"{self._done} of {len(self._pixels)} rows were written")
        return self._pixels
