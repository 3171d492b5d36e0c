"""A ball before a far wall, by photos without alpha but with depth: both are learnt where they are, and rendered there
by their own occupancy."""

import drjit.llvm.ad as ns
import numpy as np
import pytest

from nerg_mi.maths.geometry import ContractedBox
from nerg_mi.photos.cameras import pixel_directions
from nerg_mi.photos.images import View
from nerg_mi.train.radiance_run import measure
from nerg_mi.train.radiance_trainer import RadianceTrainer
from nerg_mi.transport.field_medium import FieldMedium
from nerg_mi.transport.geometry import trace_depth
from tests.tiny import ball_pose

from .ball import BOX, LENS, RADIUS, TINY, ball, settings

FAR = 6.0


def before_a_wall(pose):
    """The ball, and behind it a sphere of radius FAR, coloured in waves."""
    view = ball(pose)
    d = pixel_directions(LENS) @ pose[:3, :3].T
    o = pose[:3, 3]
    b = d @ o
    away = -b + np.sqrt(b * b - o @ o + FAR**2)
    p = o + d * away[..., None]
    wall = 0.5 + 0.4 * np.sin(8 * p / FAR)
    seen = np.where(view.pixels[..., 3:] > 0, view.pixels[..., :3], wall)
    depth = np.where(view.depth > 0, view.depth, away)
    return View("ball", view.camera, seen.astype(np.float32), depth.astype(np.float32))


def poses(count):
    """Cameras 2 from the ball, all on one side of it, so that each part of the wall is in many pictures."""
    rng = np.random.default_rng(0)
    for a, e in rng.uniform([-0.7, -0.5], [0.7, 0.5], (count, 2)):
        yield ball_pose(2 * np.array([np.sin(a) * np.cos(e), -np.cos(a) * np.cos(e), np.sin(e)]))


@pytest.fixture(scope="module")
def trained():
    views = [before_a_wall(pose) for pose in poses(44)]
    trainer = RadianceTrainer(views[4:], ContractedBox(BOX, 32), TINY, settings(steps=300, photo_colors=False), ns)
    while trainer.progress < 1:
        trainer.step()
    field = trainer.field()
    return field, measure(trainer, views[:4], 1, field).mean, trainer


@pytest.mark.nightly
@pytest.mark.slow
def test_what_is_far_is_learnt_as_well(trained):
    assert trained[1] > 17


@pytest.mark.slow
def test_depths_are_those_of_the_scene(trained):
    field, _, _ = trained
    eye = np.array([[0.0, -2.0, 0.3]])
    at = np.array([[0.0, 0.0, 0.0], [0.3, 0.0, 0.2]])
    d = at - eye
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    near = trace_depth(FieldMedium(field), np.repeat(eye, 2, axis=0), d)[0]
    b = d @ eye[0]
    np.testing.assert_allclose(near, -b - np.sqrt(b * b - eye[0] @ eye[0] + RADIUS**2), atol=0.4)
    away = np.array([[0.3, 1.0, 0.2], [-0.3, 1.0, 0.1]])
    away /= np.linalg.norm(away, axis=1, keepdims=True)
    far = trace_depth(FieldMedium(field), np.repeat(eye, 2, axis=0), away)[0]
    b = away @ eye[0]
    np.testing.assert_allclose(far, -b + np.sqrt(b * b - eye[0] @ eye[0] + FAR**2), rtol=0.35)


@pytest.mark.slow
def test_its_occupancy_leaves_nothing_out_that_is_seen(trained):
    """The marcher, which leaps by cascades, against the trainer, which samples the cells of its own grid."""
    field, _, trainer = trained
    view = before_a_wall(next(poses(1)))
    d = (pixel_directions(LENS) @ view.camera.to_world[:3, :3].T).reshape(-1, 3)
    depth, opacity = trace_depth(FieldMedium(field), np.tile(view.camera.center, (len(d), 1)), d, kind="expected")
    trained_in = trainer.render(view)
    assert np.mean(np.abs(opacity - trained_in.opacity.ravel()) < 0.05) > 0.95
    np.testing.assert_allclose(np.median(depth / trained_in.depth.ravel()), 1, atol=0.02)
    assert field.march_growth == trainer.settings.growth and field.occupancy.bound == 32
    assert field.occupancy.bits.mean() < 0.6
