"""Tests of `nerg_mi.environment.environment`."""

from __future__ import annotations

import struct
from dataclasses import replace

import numpy as np
import pytest

from nerg_mi.environment.arrays import Camera
from nerg_mi.environment.contents import DensityGrid
from nerg_mi.environment.environment import FILES, Environment, EnvironmentFile, make_hit_geometry, no_geometry
from nerg_mi.environment.gaze import find_environment_record
from nerg_mi.environment.hits import (
    DEFAULT_VOXEL,
    PADDING_VOXELS,
    HitExtent,
    compute_hit_extent,
    make_volume_dict,
    shade_hits,
    voxelise_hits,
)
from nerg_mi.environment.kinds import KINDS
from nerg_mi.environment.planned import PlannedFiles
from nerg_mi.environment.queries import trace
from nerg_mi.environment.radiance import RadianceField
from nerg_mi.environment.scene import make_scene
from nerg_mi.environment.scene_file import write_scene
from nerg_mi.environment.scene_loading import list_scene_files
from nerg_mi.environment.scene_writer import SceneContent, element, format_numbers, prop
from nerg_mi.errors import NergError
from nerg_mi.fields.mlp import namespace
from nerg_mi.fields.radiance import RadianceNetwork
from nerg_mi.fields.splats import Splats, concatenate_splats
from nerg_mi.figures.pictures import render
from nerg_mi.files.atomic import file_sha256
from nerg_mi.formats.fields import save_radiance
from nerg_mi.formats.splats import write_ply_splats
from nerg_mi.formats.surfaces import write_volume
from nerg_mi.maths.geometry import Box, Similarity
from nerg_mi.tracking.rays import Rays
from nerg_mi.transport.geometry import trace_depth
from nerg_mi.transport.volume_medium import VolumeMedium
from tests.formats.splats.writers import random_splats
from tests.refusals import mentions
from tests.train.gaze.looks import looking_at
from tests.train.radiance.ball import BOX, TINY

# ---- Files of environments ----


def test_a_field_is_its_only_planned_file(tmp_path):
    (tmp_path / "field.safetensors").write_bytes(b"weights")
    planned = PlannedFiles.plan(tmp_path / "field.safetensors")
    assert planned.checked_path() == tmp_path / "field.safetensors" and len(planned.files.members) == 1


def open_spheres(path, keep_shapes):
    rows = np.loadtxt(path, ndmin=2)
    shapes = {f"s{k}": {"type": "sphere", "center": row[:3].tolist(), "radius": row[3]} for k, row in enumerate(rows)}
    return Environment.open({"type": "scene", **shapes})


def show_spheres(path, output):
    center = lambda row: element("point", name="center", value=format_numbers(row[:3]))
    shapes = tuple(
        element("shape", center(row), prop("float", "radius", row[3]), type="sphere")
        for row in np.loadtxt(path, ndmin=2)
    )
    return SceneContent(scene_children=shapes, subject=f"The spheres {path.name}")


def test_a_kind_of_environment_is_an_entry(rgb, tmp_path, monkeypatch):
    """It is opened, recorded, shown in scenes in memory and in files, and found next to a gaze field."""
    monkeypatch.setitem(KINDS, ".spheres", "spheres")
    kind = EnvironmentFile(open_spheres, show_spheres, "scene_file", "The spheres {}.")
    monkeypatch.setitem(FILES, "spheres", kind)
    path = tmp_path / "a.spheres"
    path.write_text("0 0 0 1\n3 0 0 1\n")
    opened = Environment.open(path)
    assert opened.kind == "spheres" and opened.description == "The spheres a.spheres."
    assert opened.trace_depth(np.array([[-5.0, 0, 0]]), np.array([[1.0, 0, 0]])) == pytest.approx(4)
    assert find_environment_record(opened.metadata) == {"file": "a.spheres", "sha256": file_sha256(path)}
    view = {"camera": (-5.0, 0.0, 0.0), "target": (0.0, 0.0, 0.0), "width": 9}
    written = write_scene(path, tmp_path / "a.xml", **view)
    assert len(written.load().mitsuba.shapes()) == 2
    made = make_scene(path, camera=Camera((-5, 0, 0), (0, 0, 0), width=9, height=9))
    assert render(made, quantities="depth", spp=1).depth[0, 4, 4] == pytest.approx(4, abs=0.05)


# ---- Geometries of distant hit points: an office with windows, in closed form ----

ROOM = np.array([[0.0, 0.0, 0.0], [8.0, 6.0, 3.0]])
WINDOW = np.array([[1.0, 0.8], [5.0, 2.4]])
"""In the wall x = 8: y and z of two corners."""


def office(n: int = 200_000, far: float = 40.0, seed: int = 0) -> Rays:
    """Rays of three participants in a room of 8 x 6 x 3 m, uniform in all but the steepest directions; rays through the
    window end 5 to ``far`` metres behind it.
    """
    rng = np.random.default_rng(seed)
    origin = rng.uniform([1.5, 1.5, 1.5], [6.5, 4.5, 1.7], (n, 3))
    azimuth, z = rng.uniform(0, 2 * np.pi, n), rng.uniform(-0.86, 0.95, n)
    d = np.stack([np.sqrt(1 - z**2) * np.cos(azimuth), np.sqrt(1 - z**2) * np.sin(azimuth), z], axis=1)
    wall = np.where(d > 0, ROOM[1], ROOM[0])
    t = ((wall - origin) / d).min(axis=1)
    out = looks_out(origin, d)
    t[out] += rng.uniform(5, far, out.sum())
    return Rays(np.arange(n) * 0.02, np.arange(n) % 3, tuple("abc"), origin, d, np.ones(n), origin + t[:, None] * d)


def looks_out(origin: np.ndarray, direction: np.ndarray) -> np.ndarray:
    """Which rays pass through the window, (N,) bool."""
    with np.errstate(divide="ignore"):
        t = np.where(direction[:, 0] > 0, (ROOM[1, 0] - origin[:, 0]) / direction[:, 0], np.nan)
    through = origin[:, 1:] + t[:, None] * direction[:, 1:]
    return ((through > WINDOW[0]) & (through < WINDOW[1])).all(axis=1)


MAX_CELLS = 1 << 19  # A box around everything would be a hundred times as large


@pytest.fixture(scope="module")
def rays_hit_extent():
    return office(100_000)


@pytest.fixture(scope="module")
def extent(rays_hit_extent):
    return compute_hit_extent(rays_hit_extent, max_voxels=MAX_CELLS)


def test_the_box_of_an_office_is_the_room(rays_hit_extent, extent):
    """With the default voxel edge, although the outside hits would extend it to 45 x 60 m."""
    spread = np.ptp(np.quantile(rays_hit_extent.hit, [0.005, 0.995], axis=0), axis=0)
    assert np.prod(spread / DEFAULT_VOXEL) > 16 * MAX_CELLS
    assert extent.is_cut and extent.voxel == DEFAULT_VOXEL and np.prod(extent.shape) <= MAX_CELLS
    low, high = extent.shell
    assert np.abs(low - ROOM[0]).max() < DEFAULT_VOXEL and np.abs(high - ROOM[1]).max() < 1.5 * DEFAULT_VOXEL
    assert extent.outside_fraction == pytest.approx(
        looks_out(rays_hit_extent.origin, rays_hit_extent.direction).mean(), abs=2e-3
    )


def test_depths_in_an_office(rgb, rays_hit_extent, extent, tmp_path, monkeypatch):
    """Surfaces inside the room are at their position; outside surfaces are on the shell, in the right direction."""
    monkeypatch.setattr("nerg_mi.environment.environment.compute_hit_extent", lambda *_: extent)
    place = make_hit_geometry(rays_hit_extent, tmp_path / "office.vol")
    assert place.metadata["geometry_file"]["beyond"] == pytest.approx(extent.outside_fraction, abs=1e-4)
    seen = office(4000, seed=1)  # rays that were not used for the volume
    depth, opacity = trace_depth(place.medium, seen.origin, seen.direction)
    out = looks_out(seen.origin, seen.direction)
    true = np.linalg.norm(seen.hit - seen.origin, axis=1)
    off = np.abs(depth - true)[~out]
    assert (opacity[~out] > 0.99).mean() > 0.995
    assert np.median(off) < 1.5 * DEFAULT_VOXEL and np.quantile(off, 0.99) < 4 * DEFAULT_VOXEL
    # The shell is in the plane of the window, where the box was cut.
    window = ((ROOM[1, 0] - seen.origin[:, 0]) / seen.direction[:, 0])[out]
    assert out.sum() > 100 and (opacity[out] > 0.99).mean() > 0.97
    assert np.quantile(np.abs(depth[out] - window), 0.95) < 4 * DEFAULT_VOXEL


def test_a_small_extent_is_not_cut(rays_hit_extent):
    room = rays_hit_extent.select(~looks_out(rays_hit_extent.origin, rays_hit_extent.direction))
    extent = compute_hit_extent(room)
    assert not extent.is_cut and extent.outside_fraction == 0 and extent.voxel == DEFAULT_VOXEL
    low = np.minimum(np.quantile(room.hit, 0.005, axis=0), room.origin.min(axis=0)) - PADDING_VOXELS * DEFAULT_VOXEL
    np.testing.assert_array_equal(extent.lower, low)
    assert not extent.is_outside_shell(np.full((1, 3), 1e6)).any()


def test_projected_hits_are_more_than_half_a_voxel_outside():
    extent = HitExtent(np.array([1.0, 2.0, 3.0]), (PADDING_VOXELS * 2 + 4,) * 3, 0.5, is_cut=True)
    low, high = extent.shell
    np.testing.assert_allclose([low, high], [[4, 5, 6], [6, 7, 8]])
    for axis in np.eye(3):
        hits = [end + side * by * 0.5 * axis for end, side in ((low, -1), (high, 1)) for by in (0.45, 0.55)]
        assert extent.is_outside_shell(np.array(hits)).tolist() == [False, True, False, True]


def test_a_volume_file_has_at_most_64_mib():
    """A cube of 24 m, looked at everywhere, has nearly twice as many voxels."""
    corners = np.array(list(np.ndindex(2, 2, 2))) * 24.0
    extent = compute_hit_extent(replace(office(8), origin=corners, hit=corners))
    assert 4 * np.prod(extent.shape) <= 64 * 2**20 and (extent.is_cut or extent.voxel > DEFAULT_VOXEL)


def test_voxels_grow_if_the_box_cannot_be_cut():
    """A hall filled with observers has no distant part to cut."""
    rng = np.random.default_rng(0)
    room = office(2000)
    hall = replace(room, origin=room.origin * 20, hit=room.origin * 20 + rng.normal(0, 2, (2000, 3)))
    extent = compute_hit_extent(hall, max_voxels=1 << 18)
    assert extent.voxel > DEFAULT_VOXEL and np.prod(extent.shape) <= 1 << 18
    low, high = extent.shell
    assert ((hall.hit >= low) & (hall.hit <= high)).all(axis=1).mean() >= 0.74


def test_tracking_outliers_do_not_enlarge_the_box(rays_hit_extent):
    origin = rays_hit_extent.origin.copy()
    origin[7] = [900.0, -900.0, 50.0]
    extent = compute_hit_extent(replace(rays_hit_extent, origin=origin), max_voxels=MAX_CELLS)
    assert extent.voxel == DEFAULT_VOXEL and np.abs(extent.shell[1] - ROOM[1]).max() < 2 * DEFAULT_VOXEL


def test_a_given_voxel_size_is_used(rays_hit_extent):
    assert compute_hit_extent(rays_hit_extent, 0.2, MAX_CELLS).voxel == 0.2  # noqa: RUF069 (stored)
    fine = compute_hit_extent(rays_hit_extent, 0.05, 1 << 21)
    assert fine.voxel == 0.05 and fine.is_cut  # noqa: RUF069 (stored)
    with pytest.raises(NergError, check=mentions("voxel_size")):
        compute_hit_extent(rays_hit_extent, 0.005, MAX_CELLS)
    for bad in (0.0, -1.0, np.nan, np.inf):
        with pytest.raises(NergError, check=mentions("voxel_size")):
            compute_hit_extent(rays_hit_extent, bad)
    with pytest.raises(NergError, check=mentions("environment")):
        compute_hit_extent(replace(rays_hit_extent, hit=None))


def test_hits_seen_from_outside_of_the_box_are_left_out(rays_hit_extent, extent):
    """Rays that start and end outside the shell on one side never enter it."""
    away = replace(
        rays_hit_extent.select(np.arange(100)),
        origin=np.full((100, 3), 60.0),
        hit=np.full((100, 3), 70.0),
        direction=np.full((100, 3), 3**-0.5),
    )
    density, _ = voxelise_hits(away, extent=extent)
    assert not density.any()


# ---- Geometries of hit points: surfaces are where rays ended ----


@pytest.fixture
def rays_hit_geometry():
    return looking_at((1.5, 0.4, 1.2))


def test_geometry_from_hits(rgb, rays_hit_geometry, tmp_path):
    density, box = voxelise_hits(rays_hit_geometry, 0.1)
    assert density.dtype == np.float32 and (density > 0).any()
    write_volume(tmp_path / "place.vol", density, box.lower, box.upper)
    medium = VolumeMedium(rgb.load_dict(make_volume_dict(tmp_path / "place.vol")))
    np.testing.assert_allclose(medium.bounds(), [box.lower, box.upper], atol=1e-5)
    central = np.abs(rays_hit_geometry.hit - np.median(rays_hit_geometry.hit, axis=0)).max(axis=1) < 0.1
    depth, opacity = trace_depth(medium, rays_hit_geometry.origin[central], rays_hit_geometry.direction[central])
    truth = np.linalg.norm(rays_hit_geometry.hit - rays_hit_geometry.origin, axis=1)[central]
    assert central.sum() > 5 and (opacity > 0.99).all() and np.abs(depth - truth).max() < 0.15


@pytest.mark.parametrize("axis", range(3))
@pytest.mark.parametrize("gap, closed", [(8, True), (9, False)])
def test_gaps_of_up_to_eight_voxels_are_closed(axis, gap, closed):
    along, across = np.eye(3)[[axis, axis - 1]]
    hit = np.array([20.5 + 0 * along, 20.5 + (gap + 1) * along])
    rays = Rays(np.zeros(2), np.zeros(2), ("a",), hit - 15 * across, np.tile(across, (2, 1)), np.ones(2), hit)
    density, _ = voxelise_hits(rays, extent=HitExtent(np.zeros(3), (50, 50, 50), 1.0))
    z, y, x = (20 + np.outer(np.arange(gap + 2), along)).astype(int).T[::-1]
    solid = density[z, y, x] > 0
    assert solid[[0, -1]].all() and (solid[1:-1] == closed).all()


def test_hit_geometry_needs_hits(rays_hit_geometry):
    with pytest.raises(NergError, check=mentions("environment")):
        voxelise_hits(replace(rays_hit_geometry, hit=None))
    with pytest.raises(NergError, check=mentions("voxel_size")):
        voxelise_hits(rays_hit_geometry, 1e-3)


# ---- Greys of hit points: by the axis that a surface faces, in the box of the voxels ----


@pytest.mark.parametrize("axis, grey", [(0, 0.34), (1, 0.16), (2, 0.55)])
def test_a_sheet_has_the_grey_of_its_axis(axis, grey):
    density = np.zeros((24, 24, 24), np.float32)
    sheet = [slice(None)] * 3
    sheet[2 - axis] = slice(11, 13)
    density[tuple(sheet)] = 9
    color, upper = shade_hits(density, np.zeros(3), np.full(3, 2.4))
    assert color.shape == (12, 12, 12, 3) and color.dtype == np.float32
    np.testing.assert_allclose(upper, 2.4)
    middle = color[6, 6, 6]
    np.testing.assert_allclose(middle, grey, atol=0.01)


def test_odd_and_empty_volumes():
    color, upper = shade_hits(np.zeros((5, 4, 3), np.float32), np.array([1.0, 2, 3]), np.array([4.0, 6, 8]))
    assert color.shape == (3, 2, 2, 3) and np.isfinite(color).all()
    np.testing.assert_allclose(upper, [5, 6, 9])  # A voxel is 1 wide


# ---- Geometries: frames and boxes, and damaged files of hit points (Mitsuba trusts their headers) ----


@pytest.fixture
def volume(tmp_path):
    path = tmp_path / "place.vol"
    write_volume(path, np.eye(3, dtype=np.float32)[None] + np.zeros((4, 1, 1)), (0, 0, 0), (1, 2, 3))
    return path


def test_a_complete_volume_is_read(rgb, volume):
    # Mitsuba returns the box through a transform in single precision.
    assert np.allclose(Environment.open(volume).box.upper, (1, 2, 3), rtol=1e-6)


@pytest.mark.parametrize(
    "at, value",
    [
        (0, b"XOL"),
        (3, b"\x02"),
        (4, struct.pack("<i", 2)),
        (8, struct.pack("<i", -3)),
        (8, struct.pack("<i", 0)),
        (12, struct.pack("<i", 2**31 - 1)),
        (20, struct.pack("<i", -1)),
        (20, struct.pack("<i", 10**9)),
        (24, struct.pack("<f", np.nan)),
        (36, struct.pack("<f", -1)),
    ],
)
def test_inconsistent_headers_are_refused(rgb, volume, at, value):
    data = volume.read_bytes()
    volume.write_bytes(data[:at] + value + data[at + len(value) :])
    with pytest.raises(NergError, match="place.vol"):
        Environment.open(volume)


@pytest.mark.parametrize("size", [0, 10, 30, 48, 100])
def test_truncated_volumes_are_refused(rgb, volume, size):
    volume.write_bytes(volume.read_bytes()[:size])
    with pytest.raises(NergError, match="place.vol"):
        Environment.open(volume)


def test_frames_of_rays_and_geometry():
    """Twice the size, a quarter turn about z, and shifted."""
    align = Similarity([[0, -2, 0, 1], [2, 0, 0, 2], [0, 0, 2, 3], [0, 0, 0, 1]])
    place = Environment(None, Box((0, 0, 0), (1, 1, 1)), "none", align=align)
    np.testing.assert_allclose(place.points_to_field(np.array([[1.0, 0, 0], [0, 1, 1]])), [[1, 4, 3], [-1, 2, 5]])
    d = np.array([[[0.6, 0.8, 0], [0, 0, 1.0]]])
    turned = place.directions_to_field(d)
    np.testing.assert_allclose(turned, [[[-0.8, 0.6, 0], [0, 0, 1]]], atol=1e-12)
    np.testing.assert_allclose(place.directions_to_rays(turned), d, atol=1e-12)


def test_without_geometry_the_box_surrounds_the_observers():
    assert no_geometry(np.array([[0.0, 1, 2], [1, 0, 2]])).box == Box((-2, -2, 0), (3, 3, 4))


def test_a_scene_box_holds_field_and_shapes_with_a_margin(rgb, tmp_path):
    (tmp_path / "both.xml").write_text("""<scene version="3.0.0">
      <integrator type="nerg"><volume name="density" type="constvolume"><float name="value" value="1"/>
      </volume></integrator>
      <shape type="cube"><transform name="to_world"><translate x="-2" y="-2" z="-3"/></transform></shape></scene>""")
    box = Environment.open(tmp_path / "both.xml").box
    np.testing.assert_allclose([box.lower, box.upper], [[-3.05, -3.05, -4.05], [1.05, 1.05, 1.05]], atol=1e-6)


@pytest.mark.parametrize("name", ["a.ply", "a.obj"])
def test_a_mesh_is_loaded_as_a_scene(rgb, tmp_path, name):
    rgb.load_dict({"type": "cube"}).write_ply(str(tmp_path / "a.ply"))
    corners, faces = "-1 -1 -1|1 -1 -1|1 1 -1|-1 1 1".split("|"), ("1 2 3", "1 3 4")
    (tmp_path / "a.obj").write_text("".join(f"v {c}\n" for c in corners) + "".join(f"f {f}\n" for f in faces))
    place = Environment.open(tmp_path / name)
    np.testing.assert_allclose([place.box.lower, place.box.upper], [[-1.02] * 3, [1.02] * 3], atol=1e-6)
    assert place.kind == "mesh" and place.metadata["scene_file"]["file"] == name
    assert list_scene_files(tmp_path / name) == [tmp_path / name]


def test_an_empty_scene_is_refused(rgb, tmp_path):
    (tmp_path / "empty.xml").write_text('<scene version="3.0.0"/>')
    with pytest.raises(NergError, match="no shapes and no field"):
        Environment.open(tmp_path / "empty.xml")


def test_splat_geometry_excludes_outliers(tmp_path):
    splats = random_splats(1000, degree=0, size=0.02)
    far = Splats([[90, 0, 0]], [[1, 1, 1]], [[1, 0, 0, 0]], [0.5], np.zeros((1, 1, 3)))
    write_ply_splats(tmp_path / "a.ply", concatenate_splats([splats, far]))
    place = Environment.open(tmp_path / "a.ply")
    assert place.kind == "splats" and place.radiance is None and place.metadata["field_file"]["file"] == "a.ply"
    assert np.allclose(place.box.upper, 1, atol=0.15) and np.allclose(place.box.lower, -1, atol=0.15)
    origin, along = np.float32([[0, 0, -3]]), np.float32([[0, 0, 1]])
    # The same geometry as in rendering.
    assert 1.9 < trace_depth(place.medium, origin, along)[0][0] < 4.1


def test_objects_are_opened_like_their_files(rgb, tmp_path):
    """The same rays hit the same surfaces, whether an environment is in memory or in a file."""
    import trimesh

    box = trimesh.creation.box((2, 2, 2))
    box.export(tmp_path / "box.ply")
    splats = random_splats(20, seed=3)
    write_ply_splats(tmp_path / "splats.ply", splats)
    field = RadianceNetwork.random(TINY, BOX, namespace("llvm_ad_rgb"), 0, march_step=1 / 16)
    save_radiance(field, tmp_path / "field.safetensors", {})
    density = np.full((2, 2, 2), 8.0)
    write_volume(tmp_path / "grid.vol", density, (-1, -1, -1), (1, 1, 1))
    cube = {"type": "cube"}
    (tmp_path / "cube.xml").write_text('<scene version="3.0.0"><shape type="cube"/></scene>')
    in_scene = {"type": "scene", "a": cube}
    pairs = [
        *((shape, "cube.xml") for shape in (box, cube, in_scene, [cube], {"a": cube}, rgb.load_dict(in_scene))),
        (str(tmp_path / "box.ply"), "cube.xml"),
        (splats, "splats.ply"),
        (RadianceField(field), "field.safetensors"),
        (DensityGrid(density, (-1, -1, -1), (1, 1, 1)), "grid.vol"),
    ]
    rng = np.random.default_rng(0)
    origins = rng.normal(size=(50, 3)).astype(np.float32)
    origins *= 3 / np.linalg.norm(origins, axis=1, keepdims=True)
    directions = (rng.uniform(-0.5, 0.5, (50, 3)) - origins).astype(np.float32)
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    for value, file in pairs:
        opened, loaded = Environment.open(value), Environment.open(tmp_path / file)
        for ours, theirs in zip(*(trace_depth(e.medium, origins, directions) for e in (opened, loaded))):
            np.testing.assert_allclose(ours, theirs, atol=2e-5 if file != "grid.vol" else 0.02, err_msg=file)
        np.testing.assert_allclose(opened.box.lower, loaded.box.lower, atol=1e-6)
        assert Environment.open(opened) is opened
        shown = [trace(make_scene(x), origins, directions, "depth").depth for x in (opened, loaded, value)]
        assert np.isfinite(shown[0]).any() and np.array_equal(shown[0], shown[2]), file
        np.testing.assert_allclose(shown[0], shown[1], atol=2e-5 if file != "grid.vol" else 0.02, err_msg=file)


def test_hits_in_memory_are_shown_as_those_of_a_file(rgb, tmp_path):
    rays = looking_at(np.array([1.5, 0, 1]), 200)
    hits, origin = make_hit_geometry(rays), np.array([0.0, 0, 1.5])
    directions = rays.hit[:20] - origin
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    first, second = (
        trace(make_scene(environment), origin, directions, ["depth", "opacity", "color"])
        for environment in (hits, hits.save(tmp_path / "hits"))
    )
    assert first.opacity.mean() > 0.5
    for name in ("depth", "opacity", "color"):
        np.testing.assert_allclose(first[name], second[name], atol=1e-5, err_msg=name)
    with pytest.raises(NergError):
        make_scene(no_geometry(np.zeros((1, 3))))


@pytest.mark.parametrize("value", [None, 3, Rays, {"type": "scene"}])
def test_what_is_no_environment_is_refused(value):
    with pytest.raises(NergError):
        Environment.open(value)


def test_files_of_rays_and_gaze_are_no_environment(tmp_path):
    looking_at(np.zeros(3), 5).save(tmp_path / "rays.npz")
    with pytest.raises(NergError, match="contains rays"):
        Environment.open(tmp_path / "rays.npz")


def test_an_environment_describes_itself(rgb, tmp_path):
    rgb.load_dict({"type": "cube"}).write_ply(str(tmp_path / "a.ply"))
    assert Environment.open(tmp_path / "a.ply").description == "The mesh a.ply."
    grid = DensityGrid(np.ones((2, 2, 2), np.float32), (0, 0, 0), (1, 1, 1))
    assert Environment.open(grid).description == "A grid of densities, in memory."
    assert Environment.open({"type": "cube"}).description == "The Mitsuba scene in memory."
