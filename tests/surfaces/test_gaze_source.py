"""Gaze on surfaces: conserved, and what `nerg.attention` says of the same."""

import dataclasses

import drjit as dr
import numpy as np
import pytest

from nerg_mi.surfaces.gaze_source import GazeSettings, gaze_sums, lookers_of_law
from nerg_mi.surfaces.refinement import refine
from nerg_mi.surfaces.sums import merge
from nerg_mi.surfaces.target import Target
from tests.surfaces.meshes import box, joined, vmf

ROOM = box((0, 0, 0), (4, 3, 2.5))
SHELF = box((1.5, 2, 0), (3, 2.4, 1.8))
SETTINGS = GazeSettings(angle=0.025)


@pytest.mark.parametrize("kappa", [1.0, 37.0, 500.0])
@pytest.mark.parametrize("eye", [(1.0, 0.7, 1.5), (3.999, 1.3, 1.2)])
def test01_a_closed_room_receives_all(rgb, kappa, eye):
    """Also an observer a millimetre from a wall."""
    target = Target(refine(joined(ROOM, SHELF), 0.4).mesh)
    sums = gaze_sums(target, lookers_of_law(vmf(rgb, (0.5, 0.8, -0.3), kappa)), np.array([eye]), [1.0], SETTINGS)
    assert abs(sums.total - 1) < 1e-5 and sums.escaped == 0 and sums.elsewhere == 0
    assert abs(sums.unaccounted) < 1e-3
    assert np.isclose(sums.vertex.sum(), sums.face.sum(), rtol=1e-12)


@pytest.mark.parametrize("kappa", [1.0, 37.0])
def test02_a_room_with_a_window_and_something_else_in_it(rgb, kappa):
    """Surfaces, what hides them, and what escapes through the missing wall add up to the sphere's total."""
    open_room = joined(box((0, 0, 0), (4, 3, 2.5), without=1))
    law = vmf(rgb, (0.9, 0.4, 0.0), kappa)
    sums = gaze_sums(Target(open_room, [SHELF]), lookers_of_law(law), np.array([(1.0, 0.7, 1.5)]), [2.0], SETTINGS)
    assert sums.escaped > 0.2 and sums.elsewhere > 0.005 and sums.weight == 2
    assert abs(sums.unaccounted) < 1e-3 * sums.total
    # The window is the wall that the closed room has there.
    closed = joined(ROOM)
    whole = gaze_sums(Target(closed, [SHELF]), lookers_of_law(law), np.array([(1.0, 0.7, 1.5)]), [2.0], SETTINGS)
    wall = whole.face[(closed.corners[:, :, 0] == 4).all(axis=1)].sum()
    assert abs(wall - sums.escaped) < 1e-3 * sums.total


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

    here = files(store)
    eye = (4.4, 2.8, 1.6)
    scene = nerg.make_scene(gaze=here / "shoppers.safetensors", shapes=here / "twin.ply", falloff=0.0)
    thing = box((4.4, 4.65, 0.0), (4.9, 5.0, 1.45))
    expected = nerg.attention(scene, [(4.4, 4.65, 0.0), (4.9, 5.0, 1.45)], observers=[eye], divisions=24)
    from nerg_mi.surfaces.gaze_source import lookers_of_field
    from nerg_mi.surfaces.reading import read_mesh

    twin = read_mesh(here / "twin.ply")
    target = Target(joined(thing), [twin])
    # Looked at as if it stood there: the goods in the box hide it, as they hide the box of `attention`.
    sums = gaze_sums(target, lookers_of_field(scene.integrator.gaze, target), np.array([eye]), [1.0], SETTINGS)
    assert expected.share[0] > 0.001
    assert np.isclose(sums.face.sum(), expected.share[0], rtol=0.03)


def test06_parts_add_up_to_the_whole_bit_by_bit(rgb):
    target, law = Target(joined(ROOM)), lookers_of_law(vmf(rgb, (0, 1, 0), 5.0))
    eyes, weights = np.random.default_rng(0).uniform(0.5, 2, (3, 3)), np.array([0.2, 0.3, 0.5])
    each = [gaze_sums(target, law, eyes[k : k + 1], weights[k : k + 1], SETTINGS) for k in range(3)]
    whole = gaze_sums(target, law, eyes, weights, SETTINGS)
    assert np.array_equal(merge(each).vertex, whole.vertex) and whole.count == 3
