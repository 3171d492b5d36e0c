"""Tests of `nerg_mi.surfaces.mesh`."""

import sys

import numpy as np
import pytest

from nerg_mi.errors import NergError
from nerg_mi.maths.sphere import fibonacci_directions
from nerg_mi.surfaces import mesh
from nerg_mi.surfaces.mesh import SurfaceTarget, iter_texture_rows, refine, unwrap_uv, weld_mesh
from nerg_mi.transport.volume_medium import VolumeMedium
from tests.surfaces.meshes import box, joined, longest_edge, plate

# ---- Clean meshes: vertices at one position are merged, and degenerate faces removed ----


def test_duplicate_corners_are_welded():
    v, f = box((0, 0, 0), (1, 2, 3))
    mesh, index, repairs = weld_mesh(v[f].reshape(-1, 3), np.arange(f.size).reshape(-1, 3))
    assert (len(mesh.vertices), len(mesh.faces), repairs.num_merged_vertices) == (8, 12, 28)
    assert np.array_equal(index, np.arange(12)) and np.isclose(mesh.area.sum(), 22)
    assert np.allclose(mesh.corners, v[f]) and np.isclose(mesh.vertex_area.sum(), 22)
    assert np.isclose(mesh.diagonal, np.sqrt(14))
    assert np.allclose(np.linalg.norm(mesh.normals, axis=1), 1)


def test_only_equal_coordinates_are_welded():
    v = np.array([(0, 0, 0), (1, 0, 0), (0, 1, 0), (-0.0, 0, 0), (0, 1, 1e-9), (1, 0, 0)])
    mesh, _, _ = weld_mesh(v, [(0, 1, 2), (3, 4, 5)])
    assert len(mesh.vertices) == 4


@pytest.mark.parametrize("scale", [1e-9, 1.0, 1e6])
def test_degenerate_and_duplicate_faces_are_removed(scale):
    v = scale * np.array([(0, 0, 0), (1, 0, 0), (0, 1, 0), (2, 0, 0), (9, 9, 9)])
    mesh, index, repairs = weld_mesh(v, [(0, 1, 2), (0, 1, 3), (1, 1, 2), (2, 0, 1), (2, 1, 0)])
    assert index.tolist() == [0] and (repairs.num_degenerate_faces, repairs.num_duplicate_faces) == (2, 2)
    assert repairs.summary == "2 faces without area removed, 2 duplicate faces removed"
    assert len(mesh.vertices) == 3 and np.isclose(mesh.area[0], scale**2 / 2)
    assert weld_mesh(v, [(0, 1, 2)])[2].summary is None


def test_meshes_without_area_are_refused():
    with pytest.raises(NergError, match="vertices of the wall"):
        weld_mesh([(0, 0, np.nan)], [(0, 0, 0)], "the wall")
    with pytest.raises(NergError, match="row 1 is"):
        weld_mesh([(0, 0, 0), (0, 0, 1.1e7), (1, 0, 0)], [(0, 1, 2)])
    with pytest.raises(NergError, match="no face with an area"):
        weld_mesh([(0, 0, 0), (1, 0, 0), (2, 0, 0)], [(0, 1, 2)])


# ---- Refinement ----


def edge_counts(faces):
    pairs = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    return np.unique(pairs, axis=0, return_counts=True)[1]


@pytest.mark.parametrize("longest", [3.0, 1.0, 0.37, 0.11])
def test_refinement_preserves_area_and_closedness(longest):
    whole_result = joined(box((0, 0, 0), (1, 2, 3)))
    result = refine(whole_result, longest)
    assert set(edge_counts(result.mesh.faces)) == {2}
    assert longest_edge(result.mesh) <= longest
    assert np.allclose(np.bincount(result.parent, result.mesh.area), whole_result.area, rtol=1e-12)
    # The faces still point outwards: the flux of x is three times the volume, with the same sign.
    flux = lambda m: np.einsum("fi,fi->", m.corners.mean(1), m.normals * m.area[:, None])
    assert np.isclose(flux(result.mesh), flux(whole_result)) and np.isclose(abs(flux(whole_result)), 18)
    # Corners match their barycentric coordinates in the parent.
    texts = np.einsum("fij,fjk->fik", result.barycentric, whole_result.corners[result.parent])
    assert np.allclose(texts, result.mesh.corners, atol=1e-12)


def test_fine_mesh_is_unchanged():
    sheet = joined(plate(5, 0.3))
    result = refine(sheet, 10.0)
    assert np.array_equal(result.mesh.faces, sheet.faces) and np.array_equal(result.parent, np.arange(32))


def test_too_many_faces_are_refused(monkeypatch):
    monkeypatch.setattr(mesh, "MAX_REFINED_FACES", 1000)
    with pytest.raises(NergError, match="larger max_edge"):
        refine(joined(box((0, 0, 0), (1, 1, 1))), 0.01)


# ---- Ray casts ----


def test_ray_ends(rgb):
    room, inner = joined(box((0, 0, 0), (4, 3, 2), without=1)), box((2, 1, 0.5), (3, 2, 1.5))
    target = SurfaceTarget(room, [inner])
    d = fibonacci_directions(4000)[1:]
    eye = np.array([1.0, 1.5, 1.0])
    result = target.trace(np.broadcast_to(eye, d.shape), d)
    # Slabs, in NumPy: the inner box first, then the open side, then the room.
    with np.errstate(divide="ignore"):
        t = (np.array([(2, 1, 0.5), (3, 2, 1.5)])[:, None] - eye) / d
        hits = t.min(0).max(1) < t.max(0).min(1)
        hits &= t.min(0).max(1) > 0
        walls = np.where(d > 0, (np.array([4, 3, 2]) - eye) / d, -eye / d)
    out = ~hits & (walls.argmin(1) == 0) & (d[:, 0] > 0)
    assert np.array_equal(result.elsewhere, hits)
    assert np.mean((result.face < 0) == (hits | out)) > 0.9995
    on = result.face >= 0
    p = np.einsum("pi,pik->pk", result.barycentric, room.corners[result.face])[on]
    assert np.allclose(p, (eye + walls.min(1)[:, None] * d)[on], atol=1e-5)


def test_rays_end_in_a_medium(rgb):
    fog = rgb.load_dict({"type": "constvolume", "value": 100.0, "to_world": rgb.ScalarTransform4f().scale(0.5)})
    sheet = (np.array([(-2.0, -2, 2), (2, -2, 2), (2, 2, 2), (-2, 2, 2)]), np.array([(0, 1, 2), (0, 2, 3)]))
    target = SurfaceTarget(joined(sheet), medium=VolumeMedium(fog))
    origins = np.array([(0.25, 0.25, -1), (1.0, 1.0, -1)])
    result = target.trace(origins, np.broadcast_to([0.0, 0, 1], (2, 3)))
    assert result.elsewhere.tolist() == [True, False] and (result.face >= 0).tolist() == [False, True]


# ---- Charts ----


@pytest.mark.parametrize("scale", [1e-5, 1e5])
@pytest.mark.parametrize("rows", [3, 100, 256])
def test_texture_matches_the_surface(rgb, scale, rows, monkeypatch):
    pytest.importorskip("xatlas", reason="xatlas is not installed")
    monkeypatch.setattr("nerg_mi.surfaces.mesh.TEXTURE_ROWS", rows)
    mesh, pixels = joined(box((0, 0, 0), (scale, 2 * scale, 0.5 * scale))), 256
    refined = refine(mesh, 0.2 * scale)
    charts = unwrap_uv(mesh, pixels)
    assert charts.uv.min() >= 0 and charts.uv.max() <= 1
    assert np.array_equal(charts.vertex[charts.faces], mesh.faces)
    values = refined.mesh.vertices @ [1.0, 2, 3] / scale
    blocks = list(iter_texture_rows(charts, refined, values, pixels))
    result, is_known = (np.concatenate([block[k] for block in blocks]) for k in (1, 2))
    assert [block[0].start for block in blocks] == list(range(0, pixels, rows))
    assert result.shape == is_known.shape == (256, 256) and 0.3 < is_known.mean() < 1
    # Gutters do not end at the borders of batches.
    monkeypatch.setattr("nerg_mi.surfaces.mesh.TEXTURE_ROWS", pixels)
    ((_, _, is_known_at_once),) = iter_texture_rows(charts, refined, values, pixels)
    assert np.array_equal(is_known, is_known_at_once)
    # At points drawn on the surface, by the nearest pixel.
    rng = np.random.default_rng(0)
    face, b = rng.integers(0, len(mesh.faces), 500), rng.dirichlet((2, 2, 2), 500)
    uv = np.einsum("ni,nik->nk", b, charts.uv[charts.faces[face]])
    expected = np.einsum("ni,nik->nk", b, mesh.corners[face]) @ [1.0, 2, 3] / scale
    column, row = np.floor(uv * pixels).astype(int).T
    assert is_known[row, column].all() and np.abs(result[row, column] - expected).max() < 0.06


def test_oversized_textures_are_refused(rgb, monkeypatch):
    pytest.importorskip("xatlas", reason="xatlas is not installed")
    cube = joined(box((0, 0, 0), (1, 1, 1)))
    monkeypatch.setattr(mesh, "MAX_CHART_FACES", 4)
    with pytest.raises(NergError, match="omit texture_size"):
        unwrap_uv(cube, 64)


def test_missing_xatlas_is_reported(monkeypatch):
    monkeypatch.setitem(sys.modules, "xatlas", None)
    with pytest.raises(ImportError, match=r'pip install "nerg-mi\[bake\]"'):
        unwrap_uv(joined(box((0, 0, 0), (1, 1, 1))), 64)
