"""Triangles cut alike on both sides of every edge."""

import numpy as np
import pytest

from nerg_mi.errors import NergError
from nerg_mi.surfaces import mesh
from nerg_mi.surfaces.mesh import refine
from tests.surfaces.meshes import box, joined, plate


def edge_counts(faces):
    pairs = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    return np.unique(pairs, axis=0, return_counts=True)[1]


@pytest.mark.parametrize("longest", [3.0, 1.0, 0.37, 0.11])
def test01_a_closed_box_stays_closed_and_its_area_what_it_is(longest):
    whole = joined(box((0, 0, 0), (1, 2, 3)))
    found = refine(whole, longest)
    assert set(edge_counts(found.mesh.faces)) == {2}
    assert found.mesh.longest.max() <= longest
    assert np.allclose(np.bincount(found.parent, found.mesh.area), whole.area, rtol=1e-12)
    # Outwards still: the flux of x is three times the volume, with the sign of the whole's.
    flux = lambda m: np.einsum("fi,fi->", m.corners.mean(1), m.normals * m.area[:, None])
    assert np.isclose(flux(found.mesh), flux(whole)) and np.isclose(abs(flux(whole)), 18)
    # Each corner is where its place in the parent says.
    told = np.einsum("fij,fjk->fik", found.place, whole.corners[found.parent])
    assert np.allclose(told, found.mesh.corners, atol=1e-12)


def test02_what_is_fine_already_stays():
    sheet = joined(plate(5, 0.3))
    found = refine(sheet, 10.0)
    assert np.array_equal(found.mesh.faces, sheet.faces) and np.array_equal(found.parent, np.arange(32))


def test03_too_many(monkeypatch):
    monkeypatch.setattr(mesh, "MOST_REFINED_FACES", 1000)
    with pytest.raises(NergError, match="larger --detail"):
        refine(joined(box((0, 0, 0), (1, 1, 1))), 0.01)
