"""Gaze on surfaces: conserved, and what `nerg.attention` says of the same."""

import dataclasses

import drjit as dr
import numpy as np
import pytest

from nerg_mi.surfaces.laplacian import merge
from nerg_mi.surfaces.mesh import Target, refine
from nerg_mi.surfaces.sources import GazeSettings, gaze_sums, lookers_of_law
from tests.surfaces.meshes import box, joined, vmf

ROOM = box((0, 0, 0), (4, 3, 2.5))
SHELF = box((1.5, 2, 0), (3, 2.4, 1.8))
SETTINGS = GazeSettings()
MEAN = np.array([0.84, 0.5, -0.2]) / np.linalg.norm([0.84, 0.5, -0.2])


@pytest.mark.parametrize(("kappa", "eye"), [(1.0, (1.0, 0.7, 1.5)), (500.0, (0.001, 1.3, 1.2))])
def test01_a_closed_room_receives_all(rgb, kappa, eye):
    """Also an observer a millimetre from a wall."""
    target = Target(refine(joined(ROOM, SHELF), 0.4).mesh)
    sums = gaze_sums(target, lookers_of_law(vmf(rgb, MEAN, kappa)), np.array([eye]), [1.0], SETTINGS)
    assert abs(sums.total - 1) < 3e-4 and sums.escaped == 0 and sums.elsewhere == 0
    assert abs(sums.unaccounted) < 1e-3
    assert np.isclose(sums.vertex.sum(), sums.face.sum(), rtol=1e-12)


@pytest.mark.parametrize(("y", "kappa"), [(0.7, 500.0), (0.69, 5000.0)])
def test02_surfaces_what_hides_them_and_what_escapes_are_what_they_are(rgb, y, kappa):
    """Against a sum in double precision that shares no line with it, narrow laws on an outline that runs along the
    cuts of a wall included."""
    for without in (None, 1):
        room = joined(box((0, 0, 0), (4, 3, 2.5), without))
        sums = gaze_sums(
            Target(room, [SHELF]), lookers_of_law(vmf(rgb, MEAN, kappa)), np.array([(1.0, y, 1.5)]), [2.0], SETTINGS
        )
        exact = _shares(kappa, np.array([1.0, y, 1.5]), without is not None)
        found = np.array([sums.on_surface, sums.elsewhere, sums.escaped]) / 2
        assert np.abs(found - exact).max() < 1.2e-3 and abs(sums.unaccounted) < 1e-3 * sums.total and sums.weight == 2


def _shares(kappa: float, eye: np.ndarray, window: bool, count: int = 1 << 17) -> np.ndarray:
    """Of the law on room, shelf and window: slab tests along directions that each have as much of it."""
    i, side = np.arange(count), np.cross(MEAN, [0, 0, 1]) / np.linalg.norm(np.cross(MEAN, [0, 0, 1]))
    cos = 1 + np.log1p((i + 0.5) / count * np.expm1(-2 * kappa)) / kappa
    turn, sin = 2 * np.pi * (i * (np.sqrt(5) - 1) / 2 % 1), np.sqrt(1 - cos**2)
    d = (
        cos[:, None] * MEAN
        + (sin * np.cos(turn))[:, None] * side
        + (sin * np.sin(turn))[:, None] * np.cross(MEAN, side)
    )
    ends = (np.array([(1.5, 2, 0), (3, 2.4, 1.8)])[:, None] - eye) / d
    shelf = (ends.min(axis=0).max(axis=1) < ends.max(axis=0).min(axis=1)) & (ends.min(axis=0).max(axis=1) > 0)
    wall = ((np.array([(0, 0, 0), (4, 3, 2.5)])[:, None] - eye) / d).max(axis=0).argmin(axis=1)
    out = ~shelf & (wall == 0) & (d[:, 0] > 0) & window
    return np.array([1 - shelf.mean() - out.mean(), shelf.mean(), out.mean()])


def test03_a_uniform_law_gives_solid_angles_and_a_cone_changes_nothing_of_it(rgb):
    uniform = lambda d: dr.full(rgb.Float, 1 / (4 * np.pi), dr.width(d))
    target, eye = Target(joined(ROOM)), np.array([(1.0, 0.7, 1.5)])
    for cone in (0.0, 0.03):
        sums = gaze_sums(target, lookers_of_law(uniform), eye, [1.0], GazeSettings(angle=0.1, cone=cone))
        floor = sums.face[(target.mesh.corners[:, :, 2] == 0).all(axis=1)].sum()
        # Of a rectangle, by the four rectangles between the foot point and its corners.
        x, y, h = np.array([1.0, 3.0]), np.array([0.7, 2.3]), 1.5
        exact = sum(np.arctan2(a * b, h * np.sqrt(a * a + b * b + h * h)) for a in x for b in y)
        assert np.isclose(floor, exact / (4 * np.pi), rtol=1e-4)


def test04_a_cone_widens_a_law_and_keeps_its_total(rgb):
    target, eye = Target(refine(joined(ROOM), 0.2).mesh), np.array([(2.0, 1.5, 1.2)])
    law, cone = lookers_of_law(vmf(rgb, (1, 0.1, 0), 400.0)), 0.026
    plain = gaze_sums(target, law, eye, [1.0], SETTINGS)
    wide = gaze_sums(target, law, eye, [1.0], dataclasses.replace(SETTINGS, cone=cone))
    # A vMF law after a Gaussian is nearly one whose variance is the sum.
    expected = gaze_sums(target, lookers_of_law(vmf(rgb, (1, 0.1, 0), 1 / (1 / 400 + cone**2))), eye, [1.0], SETTINGS)
    assert abs(wide.face.sum() - 1) < 1e-3
    assert np.abs(wide.face - expected.face).sum() < 0.03 < np.abs(plain.face - expected.face).sum()


def test05_it_is_what_attention_says(rgb, tmp_path):
    from importlib.resources import files

    from nerg_mi.scenes import store

    import nerg_mi as nerg
    from nerg_mi.api.scene import box_dict

    here = files(store)
    eye = (4.4, 2.8, 1.6)
    scene = nerg.make_scene(gaze=here / "shoppers.safetensors", shapes=here / "twin.ply", falloff=0.0)
    thing = box((4.4, 4.65, 0.0), (4.9, 5.0, 1.45))
    expected = nerg.attention(scene, box_dict(*np.array([(4.4, 4.65, 0.0), (4.9, 5.0, 1.45)])), [eye], divisions=24)
    from nerg_mi.formats.meshes import read_mesh_file
    from nerg_mi.surfaces.sources import lookers_of_field

    read = read_mesh_file(here / "twin.ply")
    twin = read.vertices, read.faces
    target = Target(joined(thing), [twin])
    # Looked at as if it stood there: the goods in the box hide it, as they hide the box of `attention`.
    make = lookers_of_field(scene.integrator.gaze, target.place, target.settings)
    sums = gaze_sums(target, make, np.array([eye]), [1.0], SETTINGS)
    assert expected.share[0] > 0.001
    # The field is normalised over what is seen: with the box there, and without it.
    gaze, at = scene.integrator.gaze, rgb.Point3f(eye)
    there, without = (
        float(gaze.at([at], place, target.settings).integrals(at)[0][0])
        for place in (target.place, Target(joined(twin)).place)
    )
    assert abs(there / without - 1) > 0.03
    assert np.isclose(sums.face.sum() * there / without, expected.share[0], rtol=0.01)


def test06_parts_add_up_to_the_whole_bit_by_bit(rgb):
    target, law, coarse = Target(joined(ROOM)), lookers_of_law(vmf(rgb, (0, 1, 0), 5.0)), GazeSettings(angle=0.2)
    eyes, weights = np.random.default_rng(0).uniform(0.5, 2, (3, 3)), np.array([0.2, 0.3, 0.5])
    each = [gaze_sums(target, law, eyes[k : k + 1], weights[k : k + 1], coarse) for k in range(3)]
    whole = gaze_sums(target, law, eyes, weights, coarse)
    assert np.array_equal(merge(each).vertex, whole.vertex) and whole.count == 3
