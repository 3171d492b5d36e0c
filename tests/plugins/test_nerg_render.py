"""Seeds, films, batches, nesting and variants."""

import subprocess
import sys

import numpy as np
import pytest

from .scenes import GAZE, SIZE, camera, constant, render, straight, with_field, with_gaze


@pytest.mark.parametrize("rfilter, tolerance", [("box", 0), ("gaussian", 1e-6)])
def test01_equal_seeds(rgb, files, rfilter, tolerance):
    integrator = with_gaze(files, GAZE, jitter=True)
    a, b = (render(rgb, integrator, camera(rgb, rfilter=rfilter), spp=4, seed=7) for _ in range(2))
    assert np.array_equal(a, b) if tolerance == 0 else np.allclose(a, b, atol=tolerance, rtol=1e-6)
    c = render(rgb, integrator, camera(rgb, rfilter=rfilter), spp=4, seed=8)
    assert not np.allclose(a, c, atol=1e-4)


def test01b_the_integrators_own_render_has_the_seed_of_mitsubas(rgb, files):
    scene = rgb.load_dict({"type": "scene", "integrator": with_field(files), "sensor": camera(rgb)})
    own, same, other = (
        scene.integrator().render(scene, spp=1),
        rgb.render(scene, spp=1),
        rgb.render(scene, spp=1, seed=1),
    )
    assert np.array_equal(own, same) and not np.array_equal(own, other)


def test02_jitter_alone_makes_seeds_differ(rgb, files):
    # One sample in the middle of each pixel: nothing but the jitter depends on the seed.
    still = {"type": "stratified", "jitter": False, "sample_count": 1}

    def picture(seed, jitter):
        return render(
            rgb, with_field(files, jitter=jitter, aovs="opacity"), {**camera(rgb), "sampler": still}, seed=seed
        )

    def random(seed, jitter):
        return render(
            rgb,
            constant(
                3.0,
                density={
                    "type": "gridvolume",
                    "grid": rgb.VolumeGrid(np.random.default_rng(0).exponential(3, (6, 6, 6)).astype(np.float32)),
                },
                jitter=jitter,
                step=0.2,
            ),
            straight(rgb, "perspective"),
            seed=seed,
        )

    assert not np.array_equal(random(1, True), random(2, True)) and np.allclose(
        random(1, False), random(2, False), rtol=1e-3
    )
    assert picture(1, True).shape == picture(1, False).shape


def test03_more_samples_converge(rgb, files):
    integrator = with_field(files, aovs="opacity", jitter=True)
    reference = render(rgb, integrator, spp=512, seed=1)
    errors = [np.abs(render(rgb, integrator, spp=n, seed=2) - reference).mean() for n in (4, 64)]
    assert errors[1] < 0.5 * errors[0]


def test04_crop_is_the_crop_of_the_whole(rgb, files):
    # Equal subpixel positions in both: one sample in the middle of each pixel.
    still = {"type": "stratified", "jitter": False, "sample_count": 1}
    integrator = with_gaze(files, GAZE)
    whole = render(rgb, integrator, {**camera(rgb), "sampler": still})
    crop = dict(crop_offset_x=3, crop_offset_y=5, crop_width=6, crop_height=4)
    part = render(rgb, integrator, {**camera(rgb, film=crop), "sampler": still})
    assert part.shape == (4, 6, whole.shape[-1]) and np.allclose(part, whole[5:9, 3:9], atol=2e-4)


@pytest.mark.parametrize("near_clip", [0.01, 1.0])
def test05_a_batch_equals_its_members(rgb, files, near_clip):
    still = {"type": "stratified", "jitter": False, "sample_count": 1}
    origins = [(0.5, 0.4, -3), (-2.5, 0.2, -1), (0, 0.5, 3)]
    cameras = [{**camera(rgb, o, near_clip=near_clip), "sampler": still} for o in origins]
    integrator = with_gaze(files, GAZE)
    batch = {
        "type": "batch",
        "sampler": still,
        "film": {**cameras[0]["film"], "width": SIZE * 3},
        **{f"c{i}": c for i, c in enumerate(cameras)},
    }
    whole = render(rgb, integrator, batch)
    for i, c in enumerate(cameras):
        alone = render(rgb, integrator, c)
        got = whole[:, SIZE * i : SIZE * (i + 1)]
        assert np.mean(np.abs(got - alone) < 2e-3) > 0.99 and np.abs(got - alone).mean() < 1e-3


def test06_nested(rgb, files):
    inner = with_gaze(files, GAZE)
    plain = render(rgb, inner)
    # `aov` puts the inner picture first.
    assert np.allclose(render(rgb, {"type": "aov", "aovs": "pos:position", "nerg": inner})[..., :13], plain, atol=1e-6)
    moment = {"type": "moment", "nested": inner}
    names, image = rgb.load_dict(moment).aov_names(), render(rgb, moment)
    for i, name in enumerate(rgb.load_dict(inner).aov_names()):
        assert np.allclose(image[..., 3 + names.index(f"nested.{name}")], plain[..., 3 + i], atol=1e-6), name


def test06b_rays_are_active_unless_told(rgb, files):
    """As for integrators in Python that ask another one for the radiance along a ray."""
    scene = rgb.load_dict({"type": "scene", "integrator": with_field(files), "sensor": camera(rgb)})
    sampler, ray = rgb.load_dict({"type": "independent"}), rgb.Ray3f([0.5, 0.4, -3], [0, 0, 1])
    sampler.seed(0, 1)
    (plain, *_), (told, *_) = (scene.integrator().sample(scene, sampler, ray, **k) for k in ({}, {"active": True}))
    assert np.array_equal(plain, told) and np.array(plain).max() > 0


def test07_integrator_given_to_render(rgb, files):
    scene = rgb.load_dict({"type": "scene", "sensor": camera(rgb)})
    integrator = rgb.load_dict(with_gaze(files, GAZE))
    assert np.array_equal(
        np.array(rgb.render(scene, integrator=integrator, spp=1)), render(rgb, with_gaze(files, GAZE))
    )


def test08_a_sensor_outside_of_the_scene(rgb, files):
    # The observer is the camera that renders, not the scene's own.
    scene = rgb.load_dict({"type": "scene", "integrator": with_gaze(files, GAZE), "sensor": camera(rgb, (2, 1, 2))})
    other = rgb.load_dict(camera(rgb))
    assert np.array_equal(np.array(rgb.render(scene, sensor=other, spp=1)), render(rgb, with_gaze(files, GAZE)))


def test09_film_channels_by_name(rgb, files):
    scene = rgb.load_dict({"type": "scene", "integrator": with_gaze(files, "depth,gaze"), "sensor": camera(rgb)})
    rgb.render(scene, spp=1)
    layers = [name for name, _ in scene.sensors()[0].film().bitmap().split()]
    assert layers == ["<root>", "depth", "gaze"]


def test10_mono_is_the_luminance_of_rgb(rgb, files):
    still = {"type": "stratified", "jitter": False, "sample_count": 1}
    integrator = with_gaze(files, GAZE, background={"type": "rgb", "value": [0.1, 0.3, 0.2]})
    a = render(rgb, integrator, {**camera(rgb), "sampler": still})
    rgb.set_variant("llvm_ad_mono")
    b = render(rgb, integrator, {**camera(rgb), "sampler": still})
    assert b.shape[-1] == a.shape[-1] - 2
    assert np.allclose(b[..., 0], a[..., :3] @ [0.212671, 0.715160, 0.072169], atol=1e-4)
    assert np.allclose(b[..., 1:], a[..., 3:], atol=1e-4)


@pytest.mark.parametrize("variant", ["llvm_ad_spectral", "llvm_ad_mono_polarized", "llvm_ad_spectral_polarized"])
def test11_spectral_and_polarized_are_refused(rgb, variant):
    if variant not in rgb.variants():
        pytest.skip(f"{variant} is not in this build of Mitsuba")
    rgb.set_variant(variant)
    try:
        with pytest.raises(RuntimeError, match=f'"nerg" renders rgb and mono variants, not "{variant}".*set_variant'):
            rgb.load_dict(constant())
    finally:
        rgb.set_variant("llvm_ad_rgb")


def test12_scalar_is_refused_and_forgotten(files):
    # In a process of its own: what scalar_rgb registers stays.
    code = f"""
import nerg_mi, mitsuba as mi
mi.set_variant("scalar_rgb")
try:
    mi.load_dict({{"type": "nerg"}})
except RuntimeError as e:
    assert '"nerg" needs a variant that compiles its kernels' in str(e), e
else:
    raise SystemExit("not refused")
mi.set_variant("llvm_ad_rgb")
mi.load_dict({{"type": "nerf", "filename": r"{files / "field.safetensors"}"}})
mi.load_dict({{"type": "nerg", "field": {{"type": "nerf", "filename": r"{files / "field.safetensors"}"}}}})
"""
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert run.returncode == 0, run.stderr[-2000:]
