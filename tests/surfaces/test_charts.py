"""Surfaces unrolled, and values on them found again on the texture."""

import builtins

import numpy as np
import pytest

from nerg_mi.errors import NergError
from nerg_mi.surfaces import mesh as module
from nerg_mi.surfaces.mesh import refine, texture_rows, unroll
from tests.surfaces.meshes import box, joined

xatlas = pytest.importorskip("xatlas", reason="xatlas is not installed")


@pytest.mark.parametrize("scale", [1e-5, 1e5])
@pytest.mark.parametrize("rows", [3, 100, 256])
def test01_a_texture_has_at_each_point_what_the_surface_has(rgb, scale, rows, monkeypatch):
    monkeypatch.setattr(module, "TEXTURE_ROWS", rows)
    mesh, pixels = joined(box((0, 0, 0), (scale, 2 * scale, 0.5 * scale))), 256
    refined = refine(mesh, 0.2 * scale)
    charts = unroll(mesh, pixels)
    assert charts.uv.min() >= 0 and charts.uv.max() <= 1
    assert np.array_equal(charts.vertex[charts.faces], mesh.faces)
    values = refined.mesh.vertices @ [1.0, 2, 3] / scale
    blocks = list(texture_rows(charts, refined, values, pixels))
    found, known = (np.concatenate([block[k] for block in blocks]) for k in (1, 2))
    assert [block[0].start for block in blocks] == list(range(0, pixels, rows))
    assert found.shape == known.shape == (256, 256) and 0.3 < known.mean() < 1
    # At points drawn on the surface, by the nearest pixel.
    rng = np.random.default_rng(0)
    face, b = rng.integers(0, len(mesh.faces), 500), rng.dirichlet((2, 2, 2), 500)
    uv = np.einsum("ni,nik->nk", b, charts.uv[charts.faces[face]])
    there = np.einsum("ni,nik->nk", b, mesh.corners[face]) @ [1.0, 2, 3] / scale
    column, row = np.floor(uv * pixels).astype(int).T
    assert known[row, column].all() and np.abs(found[row, column] - there).max() < 0.06


def test02_what_does_not_fit(rgb, monkeypatch):
    mesh = joined(box((0, 0, 0), (1, 1, 1)))
    monkeypatch.setattr(module, "MOST_CHART_FACES", 4)
    with pytest.raises(NergError, match="leave out --texture"):
        unroll(mesh, 64)


def test03_without_xatlas_the_extra_is_named(monkeypatch):
    original = builtins.__import__

    def missing(name, *rest, **more):
        if name == "xatlas":
            raise ImportError(name)
        return original(name, *rest, **more)

    monkeypatch.setattr(builtins, "__import__", missing)
    with pytest.raises(ImportError, match=r'pip install "nerg-mi\[bake\]"'):
        unroll(joined(box((0, 0, 0), (1, 1, 1))), 64)
