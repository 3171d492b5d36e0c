"""What Mitsuba's optimisers and loaders of rays make of pictures: parameters found again, gaze learnt from views and
rays."""

import dataclasses

import drjit as dr
import numpy as np
import pytest

from .scenes import camera, constant, observer_at, with_gaze

SEEN, HELD_OUT = ((0.5, 0.4, -3), (-1.5, 0.3, -2.6), (2.0, -0.5, -2.2)), (1.3, 0.0, -2.7)
CENTERS = {"sampler": {"type": "stratified", "jitter": False, "sample_count": 1}}


# ----------------------------------------------------------------------------
# Adam
# ----------------------------------------------------------------------------


def found(mi, scene, start, steps, lr):
    """Adam from ``start`` on, on the scene's own picture: losses, and where each parameter ends."""
    params = mi.traverse(scene)
    target = mi.render(scene, spp=1)
    opt = mi.ad.Adam(lr=lr, params={key: mi.Float(value) for key, value in start.items()})
    params.update(opt)
    losses = []
    for i in range(steps):
        loss = dr.mean(dr.square(mi.render(scene, params, spp=1, seed=i) - target), axis=None)
        dr.backward(loss)
        opt.step()
        params.update(opt)
        losses.append(loss.numpy().item())
    return losses, {key: opt[key].numpy().item() for key in start}


def test01_adam_finds_falloff_and_density(rgb):
    """Both at once: visibility tells the first, opacity the second, in a fog that camera and observer see from two
    sides."""
    place = rgb.ScalarTransform4f().translate(-1).scale(2)
    fog = {"type": "constvolume", "value": 1.5, "to_world": place}
    observer = observer_at(rgb, -2, 0.3, 2)
    integrator = {**constant(aovs="opacity,visibility"), "density": fog, "observer": observer, "falloff": 2.0}
    scene = rgb.load_dict({"type": "scene", "integrator": integrator, "sensor": {**camera(rgb, size=6), **CENTERS}})
    true = {"integrator.falloff": 2.0, "integrator.density.value.value": 1.5}
    losses, ends = found(rgb, scene, dict(zip(true, (1.0, 0.6))), 100, 0.05)
    assert losses[-1] < 1e-3 * losses[0]
    for key, value in true.items():
        assert abs(ends[key] - value) < 0.02 * value, (key, ends[key])


# ----------------------------------------------------------------------------
# Gaze weights
# ----------------------------------------------------------------------------


@dataclasses.dataclass
class Task:
    """``views``: gaze to be found, a picture for each camera, the last one held out."""

    mi: object
    scene: object
    params: object
    views: list

    def error(self) -> float:
        """Of the camera that nothing is trained on, relative."""
        got = np.array(self.mi.render(self.scene, sensor=len(SEEN), spp=1))[..., 3]
        return float(np.linalg.norm(got - self.views[-1]) / np.linalg.norm(self.views[-1]))

    def train(self, batches, steps, lr):
        """Adam over all gaze weights on what ``batches()`` gives: sensor, target of gaze. Returns the losses."""
        keys = [key for key in self.params.keys() if key.startswith("integrator.gaze.")]
        opt = self.mi.ad.Adam(lr=lr, params={key: self.params[key] for key in keys})
        self.params.update(opt)
        losses = []
        for i in range(steps):
            sensor, target = batches(i)
            picture = self.mi.render(self.scene, self.params, sensor=sensor, spp=1, seed=i)
            loss = dr.mean(dr.square(picture[..., 3] - target), axis=None) / np.mean(np.square(self.views))
            dr.backward(loss)
            opt.step()
            self.params.update(opt)
            losses.append(loss.numpy().item())
        return losses


@pytest.fixture
def task(rgb, files):
    """The gaze to be found grows with x, e-fold over a unit: pictures agree about it, whichever camera made them."""
    integrator = with_gaze(files, "gaze,position", falloff=2.0, radiance=False, observer=observer_at(rgb, -2, 0.3, -2))
    sensors = {f"camera{i}": {**camera(rgb, origin, size=8), **CENTERS} for i, origin in enumerate((*SEEN, HELD_OUT))}
    scene = rgb.load_dict({"type": "scene", "integrator": integrator, **sensors})
    pictures = [np.array(rgb.render(scene, sensor=s, spp=1)) for s in scene.sensors()]
    return Task(rgb, scene, rgb.traverse(scene), [p[..., 3] * np.exp(p[..., 4]) for p in pictures])


def test02_gaze_weights_learn_from_whole_views(task):
    before = task.error()
    targets = [task.mi.TensorXf(view) for view in task.views]
    losses = task.train(lambda i: (i % 3, targets[i % 3]), 36, 0.02)
    assert np.mean(losses[-3:]) < 0.4 * np.mean(losses[:3])
    assert task.error() < 0.5 * before, (before, task.error())


@pytest.mark.nightly
def test03_gaze_weights_learn_from_batches_of_rays(task):
    """Random pixels of all cameras a step, their targets in the loader's colours."""
    before = task.error()
    colors = [task.mi.TensorXf(np.repeat(view[..., None], 3, -1)) for view in task.views[:3]]
    loader = task.mi.ad.loaders.RayDataLoader(
        task.scene.sensors()[:3], colors, pixels_per_batch=64, regular_reshuffle=True, tile_size=1
    )

    def batch(_):
        target, rays = loader.next()
        return rays, target[..., 0]

    losses = task.train(batch, 36, 0.02)
    assert np.mean(losses[-3:]) < 0.4 * np.mean(losses[:3])
    assert task.error() < 0.5 * before, (before, task.error())


def test04_a_batch_of_rays_shows_what_its_pixels_show(rgb, files):
    """All channels. Rays are almost parallel, as the loader moves each within its pixel: every camera shows but one
    number."""
    integrator = with_gaze(files, observer=observer_at(rgb, -2, 0.3, -2), falloff=2.0)
    eyes = [(0.2 * i - 0.5, 0.3 - 0.1 * i, -3) for i in range(3)]
    sensors = {f"camera{i}": camera(rgb, o, (o[0], o[1], 0), size=6, fov=0.01) for i, o in enumerate(eyes)}
    scene = rgb.load_dict({"type": "scene", "integrator": integrator, **sensors})
    pictures = [rgb.render(scene, sensor=s, spp=1) for s in scene.sensors()]
    # A divisor of the number of pixels: without tiles the loader of 3.9.1 draws pixels beyond the last one otherwise.
    loader = rgb.ad.loaders.RayDataLoader(
        scene.sensors(), [p[..., :3] for p in pictures], pixels_per_batch=36, tile_size=1
    )
    colors, rays = loader.next()
    got, chosen = np.array(rgb.render(scene, sensor=rays, spp=1))[0], np.array(rays.pixel_idx)
    expected = np.array(pictures).reshape(3 * 36, -1)[chosen]
    assert len(np.unique(chosen)) == 36 and len(np.unique(chosen // 36)) == 3
    assert np.allclose(np.array(colors)[0], expected[:, :3])
    span = np.ptp(expected, axis=0)
    assert np.all(span[:6] > 1e-4) and np.all(np.abs(got - expected) <= 0.1 * span)


def test05_batches_of_rays_need_an_observer(rgb, files):
    """The loader's sensor does not tell which camera a ray is of."""
    scene = rgb.load_dict(
        {"type": "scene", "integrator": with_gaze(files), "sensor": {**camera(rgb, size=4), **CENTERS}}
    )
    loader = rgb.ad.loaders.RayDataLoader(scene.sensors(), [rgb.render(scene, spp=1)[..., :3]], pixels_per_batch=4)
    _, rays = loader.next()
    with pytest.raises(Exception, match='FlatSensor.*"observer"'):
        scene.integrator().render(scene, rays, spp=1)
