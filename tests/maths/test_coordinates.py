"""Coordinates of surveys are refused, wherever they are read, with the offset to subtract."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from nerg_mi.alignment.constraints import read_surface
from nerg_mi.errors import NergError
from nerg_mi.formats.ply import write_columns
from nerg_mi.formats.splats import read_splats
from nerg_mi.maths.coordinates import check_near_origin
from nerg_mi.photos.posed import Frame, settled
from nerg_mi.rays.readers.base import UNITY, RaysBuilder
from tests.formats.splats.writers import random_splats, write_antimatter, write_inria, write_khronos

ROOM = np.random.default_rng(0).uniform((0, 0, 0), (6, 4, 3), (200, 3))
UTM = (500_000.0, 5_600_000.0, 0.0)


def read_points(path: Path, points: np.ndarray) -> None:
    np.save(path / "a.npy", points)
    read_surface(path / "a.npy")


def read_cloud(path: Path, points: np.ndarray) -> None:
    write_columns(path / "a.ply", dict(zip("xyz", points.T)))
    read_surface(path / "a.ply")


def read_rays(path: Path, points: np.ndarray) -> None:
    builder = RaysBuilder(UNITY)
    builder.source(Path(__file__))
    # Unity: y up, left-handed; the offset is named in the file's own coordinates.
    builder.add(
        np.arange(len(points)), "ann", points, np.tile([1.0, 0, 0], (len(points), 1)), rows=np.arange(len(points))
    )
    builder.build()


def read_cameras(path: Path, points: np.ndarray) -> None:
    poses = np.tile(np.eye(4), (len(points), 1, 1))
    poses[:, :3, 3] = points
    settled(path / "a.json", [Frame(f"{k}", path / f"{k}", pose, {}) for k, pose in enumerate(poses)], [])


def splats_by(name, write):
    def read(path: Path, points: np.ndarray) -> None:
        write(path / name, replace(random_splats(200, 0), centers=points))
        read_splats(path / name)

    return read


READERS = {
    "points": read_points,
    "cloud": read_cloud,
    "rays": read_rays,
    "cameras": read_cameras,
    "splats .ply": splats_by("a.ply", write_inria),
    "splats .splat": splats_by("a.splat", write_antimatter),
    "splats .glb": splats_by("a.glb", write_khronos),
}


@pytest.mark.parametrize("kind", READERS)
def test_every_reader_refuses_them(tmp_path, kind):
    READERS[kind](tmp_path, ROOM)
    with pytest.raises(NergError, match="subtract 500000,5600000,0 from it"):
        READERS[kind](tmp_path, ROOM + UTM)


@pytest.mark.parametrize(
    "points, refused",
    [
        (ROOM + (19_000, 0, 0), False),
        (ROOM + (0, -21_000, 0), True),
        (1000 * ROOM + 30_000, False),
        (1e6 * ROOM, False),
        (1e-4 * ROOM, False),
        (ROOM[:1] + (4_027_000, 307_000, 4_919_000), True),
        (np.vstack([ROOM, np.full((1, 3), np.nan), np.full((1, 3), 1e9)]), False),
        (np.zeros((0, 3)), False),
    ],
)
def test_what_is_small_beside_its_distance(points, refused):
    if not refused:
        check_near_origin(points, "it")
        return
    with pytest.raises(NergError, match="single precision"):
        check_near_origin(points, "it")
