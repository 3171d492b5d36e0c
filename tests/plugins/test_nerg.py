"""The integrator through Mitsuba: parameters, channels, closed forms, observers, determinism, variants."""
import math
import subprocess
import sys

import numpy as np
import pytest

from . import fields

SIZE = 12


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    import mitsuba as mi

    mi.set_variant("llvm_ad_rgb")
    folder = tmp_path_factory.mktemp("fields")
    fields.radiance(folder / "field.safetensors")
    fields.gaze(folder / "gaze.safetensors")
    return folder


def look_at(mi, origin, target=(0, 0, 0), up=(0, 1, 0)):
    return mi.ScalarTransform4f().look_at(list(origin), list(target), list(up))


def camera(mi, origin=(0.5, 0.4, -3), target=(0, 0, 0), kind="perspective", rfilter="box", size=SIZE, film=(), **kwargs):
    if kind == "perspective":
        kwargs = {"fov": 35, **kwargs}
    return {
        "type": kind, "to_world": look_at(mi, origin, target), **kwargs,
        "sampler": {"type": "independent", "sample_count": 1},
        "film": {"type": "hdrfilm", "width": size, "height": size, "component_format": "float32",
                 "rfilter": {"type": rfilter}, "pixel_format": "luminance" if "mono" in mi.variant() else "rgb",
                 **dict(film)},
    }  # fmt: skip


def with_field(files, **kwargs):
    return {"type": "nerg", "field": {"type": "nerf", "filename": str(files / "field.safetensors")}, **kwargs}


def with_gaze(files, aovs="depth,opacity,gaze,visibility", **kwargs):
    gaze = {"type": "gazefield", "filename": str(files / "gaze.safetensors")}
    return with_field(files, gaze=gaze, aovs=aovs, **kwargs)


def constant(sigma=3.0, **kwargs):
    return {"type": "nerg", "density": {"type": "constvolume", "value": sigma}, **kwargs}


def render(mi, integrator, sensor=None, spp=1, seed=0, **more):
    scene = mi.load_dict({"type": "scene", "integrator": integrator, "sensor": sensor or camera(mi), **more})
    return np.array(mi.render(scene, spp=spp, seed=seed))


def named(mi, image, integrator):
    """The channels of ``image`` behind the colour, by name."""
    names = mi.load_dict(integrator).aov_names()
    return dict(zip(names, np.moveaxis(image[..., image.shape[-1] - len(names):], -1, 0)))


def channels(mi, integrator, sensor=None, **kwargs):
    return named(mi, render(mi, integrator, sensor, **kwargs), integrator)


# ------------------------------------------------------------------------
#  Parameters
# ------------------------------------------------------------------------

XML = """<scene version="3.0.0">
  <integrator type="nerg" id="integrator">
    <volume name="field" type="nerf"><string name="filename" value="field.safetensors"/></volume>
    <volume name="gaze" type="gazefield"><string name="filename" value="gaze.safetensors"/></volume>
    <sensor name="observer" type="perspective">
      <transform name="to_world"><lookat origin="-2, 0.3, -2" target="0, 0, 0" up="0, 1, 0"/></transform>
    </sensor>
    <float name="falloff" value="0.3"/>
    <boolean name="occlusion" value="true"/>
    <boolean name="radiance" value="true"/>
    <string name="depth" value="median"/>
    <rgb name="background" value="0.1, 0.2, 0.3"/>
    <integer name="step" value="0"/>
    <string name="aovs" value="depth, opacity,gaze,visibility,position"/>
  </integrator>
  <sensor type="perspective">
    <float name="fov" value="35"/>
    <transform name="to_world"><lookat origin="0.5, 0.4, -3" target="0, 0, 0" up="0, 1, 0"/></transform>
    <sampler type="independent"/>
    <film type="hdrfilm">
      <integer name="width" value="12"/><integer name="height" value="12"/>
      <string name="component_format" value="float32"/><string name="pixel_format" value="rgb"/>
      <rfilter type="box"/>
    </film>
  </sensor>
</scene>"""


def test01_xml_equals_dict_and_files_lie_beside_the_scene(rgb, files):
    path = files / "scene.xml"
    path.write_text(XML)
    scene = rgb.load_file(str(path))
    observer = {"type": "perspective", "to_world": look_at(rgb, (-2, 0.3, -2))}
    integrator = with_gaze(files, "depth,opacity,gaze,visibility,position", observer=observer, falloff=0.3, depth="median",
                           background={"type": "rgb", "value": [0.1, 0.2, 0.3]})
    a, b = np.array(rgb.render(scene, spp=2, seed=3)), render(rgb, integrator, spp=2, seed=3)
    # The XML parser rounds placements in another way.
    assert a.shape == (SIZE, SIZE, 3 + 7) and np.allclose(a, b, atol=3e-6)
    assert a[..., 3].max() > 0 and a[..., 5].max() > 0
    plain = render(rgb, {**integrator, "background": [0.1, 0.2, 0.3]}, spp=2, seed=3)
    assert np.allclose(plain, b, atol=1e-6)


def test02_unknown_parameters_are_errors(rgb):
    with pytest.raises(RuntimeError, match="fallof"):
        rgb.load_dict(constant(fallof=0.3))
    xml = '<scene version="3.0.0"><integrator type="nerg"><volume name="density" type="constvolume"/>{}</integrator></scene>'
    rgb.load_string(xml.format(""))
    with pytest.raises(RuntimeError, match="fallof"):
        rgb.load_string(xml.format('<float name="fallof" value="1"/>'))


ALL = dict(
    occlusion=False, falloff=0.5, tolerance=0.1, depth="median", surface_opacity=0.4, radiance=False, background=0.5,
    aovs="depth", step=0.1, dt_gamma=0.01, stop=1e-3, color_cutoff=0.01, jitter=True,
)  # fmt: skip


@pytest.mark.parametrize("name", list(ALL))
def test03_every_documented_parameter_is_read_and_documented(rgb, name):
    integrator = rgb.load_dict(constant(**{name: ALL[name]}))
    assert f"* - {name}" in type(integrator).__doc__ or name in ("density",)
    if name != "background":
        assert f"{name} = " in str(integrator)


@pytest.mark.parametrize("name, value", [
    ("falloff", -0.1), ("falloff", "far"), ("falloff", float("nan")), ("falloff", float("inf")), ("falloff", True),
    ("tolerance", -1.0), ("depth", "mean"), ("depth", 3), ("surface_opacity", 1.5), ("surface_opacity", -0.1),
    ("radiance", "no"), ("radiance", 2.0), ("occlusion", "false"), ("jitter", "yes"), ("background", -1.0),
    ("background", "red"), ("aovs", "depth,colour"), ("aovs", "depth,depth"), ("aovs", 3), ("aovs", "gaze"),
    ("step", -1.0), ("step", float("inf")), ("dt_gamma", -1.0), ("stop", 2.0), ("stop", -1.0), ("color_cutoff", -1.0),
])  # fmt: skip
def test04_wrong_values_are_named(rgb, name, value):
    with pytest.raises((RuntimeError, ValueError), match=f'"{name}"'):
        rgb.load_dict(constant(**{name: value}))


def test05_wrong_children_are_named(rgb, files):
    with pytest.raises(RuntimeError, match='either "field".*or "density".*not both'):
        rgb.load_dict({"type": "nerg"})
    with pytest.raises(RuntimeError, match="not both"):
        rgb.load_dict(with_field(files, density={"type": "constvolume", "value": 1.0}))
    with pytest.raises(RuntimeError, match='"color" goes with "density"'):
        rgb.load_dict(with_field(files, color={"type": "constvolume", "value": 1.0}))
    with pytest.raises(RuntimeError, match='"field" must be a volume of type "nerf"'):
        rgb.load_dict({"type": "nerg", "field": {"type": "constvolume", "value": 1.0}})
    with pytest.raises(RuntimeError, match='"gaze" must be a volume of type "gazefield"'):
        rgb.load_dict(constant(gaze={"type": "constvolume", "value": 1.0}))
    with pytest.raises(RuntimeError, match='"density" must be a volume'):
        rgb.load_dict({"type": "nerg", "density": 3.0})
    with pytest.raises(RuntimeError, match='"observer" must be a sensor'):
        rgb.load_dict(constant(observer={"type": "constvolume", "value": 1.0}))
    with pytest.raises(RuntimeError, match='"observer" is a .*no centre'):
        rgb.load_dict(constant(observer={"type": "orthographic"}))


def test06_an_observer_who_is_a_batch_is_refused(rgb):
    # It would stand at the origin of the scene.
    batch = {"type": "batch", "film": {"type": "hdrfilm", "width": 4, "height": 2},
             "a": {"type": "perspective", "to_world": look_at(rgb, (1, 2, 3)), "film": {"type": "hdrfilm", "width": 2, "height": 2}},
             "b": {"type": "perspective", "to_world": look_at(rgb, (3, 2, 1)), "film": {"type": "hdrfilm", "width": 2, "height": 2}}}
    with pytest.raises(RuntimeError, match='"observer"'):
        rgb.load_dict(constant(observer=batch))


def test07_missing_files_are_named(rgb, tmp_path):
    for kind, name in (("nerf", "field"), ("gazefield", "gaze")):
        with pytest.raises(RuntimeError, match="nowhere.safetensors.*does not exist"):
            rgb.load_dict(constant(**{name: {"type": kind, "filename": "nowhere.safetensors"}}) if name == "gaze" else
                          {"type": "nerg", name: {"type": kind, "filename": "nowhere.safetensors"}})
        with pytest.raises(RuntimeError, match='"filename"'):
            rgb.load_dict({"type": kind})


# ------------------------------------------------------------------------
#  Channels
# ------------------------------------------------------------------------

CHANNELS = {
    "depth": ["depth.T"], "opacity": ["opacity.Y"], "position": ["position.X", "position.Y", "position.Z"],
    "gaze": ["gaze.Y"], "emit": ["emit.Y"], "capture": ["capture.Y"], "visibility": ["visibility.Y"],
    "observer_depth": ["observer_depth.T"], "density_evals": ["density_evals.Y"], "color_evals": ["color_evals.Y"],
    "gaze_evals": ["gaze_evals.Y"],
}  # fmt: skip


def test08_names_and_order(rgb, files):
    assert rgb.load_dict(constant()).aov_names() == ["depth.T", "opacity.Y"]
    assert rgb.load_dict(constant(aovs="")).aov_names() == []
    order = list(CHANNELS)[::-1]
    integrator = with_gaze(files, " , ".join(order))
    assert rgb.load_dict(integrator).aov_names() == [c for name in order for c in CHANNELS[name]]
    assert render(rgb, integrator).shape == (SIZE, SIZE, 3 + 13)
    assert render(rgb, constant(aovs="")).shape == (SIZE, SIZE, 3)


def test09_each_channel_alone_equals_all_together(rgb, files):
    observer = {"type": "perspective", "to_world": look_at(rgb, (-2, 0.3, -2))}
    everything = channels(rgb, with_gaze(files, ",".join(CHANNELS), observer=observer))
    for name, parts in CHANNELS.items():
        if name in ("density_evals", "color_evals", "gaze_evals"):
            continue
        alone = channels(rgb, with_gaze(files, name, observer=observer))
        assert list(alone) == parts
        for c in parts:
            assert np.array_equal(alone[c], everything[c]), c
            assert everything[c].any(), c
    assert np.allclose(everything["gaze.Y"],
                       everything["emit.Y"] * everything["capture.Y"] * everything["visibility.Y"], rtol=1e-5)


def test10_without_radiance(rgb, files):
    names = ",".join(n for n in CHANNELS if n != "color_evals")
    a, b = (render(rgb, with_gaze(files, names, radiance=r)) for r in (True, False))
    assert a[..., :3].max() > 0.05 and not b[..., :3].any() and np.array_equal(a[..., 3:], b[..., 3:])
    evals = channels(rgb, with_gaze(files, "density_evals,color_evals", radiance=False))
    assert not evals["color_evals.Y"].any() and evals["density_evals.Y"].any()
    black = render(rgb, constant(radiance=False, background=1.0))
    assert not black[..., :3].any()


def test11_below_the_surface_opacity(rgb, files):
    low, high = (channels(rgb, with_gaze(files, "opacity,depth,position,gaze,visibility", surface_opacity=s)) for s in (0.05, 0.97))
    for c in ("opacity.Y", "depth.T"):
        assert np.array_equal(low[c], high[c])
    thin = high["opacity.Y"] < 0.97
    assert thin.any() and not high["gaze.Y"][thin].any() and not high["position.Z"][thin].any()
    assert low["gaze.Y"][low["opacity.Y"] > 0.05].all() and not high["visibility.Y"][thin].any()
    assert (low["depth.T"][low["opacity.Y"] > 0] > 0).all() and not low["depth.T"][low["opacity.Y"] == 0].any()


# ------------------------------------------------------------------------
#  Closed forms
# ------------------------------------------------------------------------


def straight(mi, kind):
    """A ray along +z through the middle of the unit cube, from z = -2."""
    if kind == "orthographic":
        to_world = mi.ScalarTransform4f().translate([0.5, 0.5, -2]).scale([1e-3, 1e-3, 1])
        return {**camera(mi, kind="orthographic", size=1), "to_world": to_world, "near_clip": 0.01}
    return camera(mi, (0.5, 0.5, -2), (0.5, 0.5, 0), fov=1e-3, size=1, near_clip=0.01)


@pytest.mark.parametrize("kind", ["orthographic", "perspective"])
@pytest.mark.parametrize("depth", ["expected", "median"])
def test12_unit_cube(rgb_and_mono, kind, depth):
    mi = rgb_and_mono
    out = channels(mi, constant(3.0, depth=depth), straight(mi, kind))
    assert np.isclose(out["opacity.Y"].item(), 1 - math.exp(-3), rtol=1e-5)
    inside = {"expected": 1 / 3 - 1 / math.expm1(3), "median": -math.log((1 + math.exp(-3)) / 2) / 3}[depth]
    # Distance from the ray's own origin, which lies on the near plane.
    assert abs(out["depth.T"].item() - (2 - 0.01 + inside)) < 1e-4


@pytest.mark.parametrize("sigma", [1e-6, 1e-3, 1, 1e3, 1e6, 1e9])
def test13_any_density(rgb, sigma):
    out = channels(rgb, constant(sigma), straight(rgb, "perspective"))
    assert np.isclose(out["opacity.Y"].item(), -math.expm1(-sigma), rtol=1e-5)
    inside = 0.5 if sigma < 1e-2 else 1 / sigma - (1 / math.expm1(sigma) if sigma < 700 else 0)
    assert np.isclose(out["depth.T"].item(), 1.99 + inside, rtol=1e-4)


@pytest.mark.parametrize("sigma", [0.05, 3.0])
def test14_colour_of_a_homogeneous_volume(rgb_and_mono, sigma):
    # α C + (1 - α) L_behind, also where every single step weighs less than color_cutoff.
    mi = rgb_and_mono
    color = {"type": "constvolume", "value": {"type": "rgb", "value": [0.9, 0.5, 0.2]}}
    background = {"type": "rgb", "value": [0.1, 0.2, 0.4]}
    image = render(mi, constant(sigma, color=color, background=background, aovs=""), straight(mi, "perspective")).ravel()
    α = -math.expm1(-sigma)
    expected = α * np.array([0.9, 0.5, 0.2]) + (1 - α) * np.array([0.1, 0.2, 0.4])
    if "mono" in mi.variant():
        expected = expected @ [0.212671, 0.715160, 0.072169]
    assert np.allclose(image, expected, rtol=2e-3)


def test15_environment_takes_the_place_of_the_background(rgb):
    sky = {"type": "constant", "radiance": {"type": "rgb", "value": [0.2, 0.4, 0.8]}}
    image = render(rgb, constant(3.0, background=9.0, aovs=""), straight(rgb, "perspective"), sky=sky).ravel()
    assert np.allclose(image, math.exp(-3) * np.array([0.2, 0.4, 0.8]), rtol=1e-4)
    hidden = render(rgb, constant(3.0, hide_emitters=True, aovs=""), straight(rgb, "perspective"), sky=sky).ravel()
    assert not hidden.any()


def test16_an_envmap_is_seen_where_it_belongs(rgb):
    data = np.random.default_rng(0).random((8, 16, 3)).astype(np.float32)
    sky = {"type": "envmap", "bitmap": rgb.Bitmap(data)}
    scene = {"type": "scene", "sensor": camera(rgb), "sky": sky}
    path = np.array(rgb.render(rgb.load_dict({**scene, "integrator": {"type": "path"}}), spp=1, seed=1))
    nerg = np.array(rgb.render(rgb.load_dict({**scene, "integrator": constant(0.0, aovs="")}), spp=1, seed=1))
    assert np.allclose(path, nerg, atol=1e-5) and path.std() > 0.01


# ------------------------------------------------------------------------
#  Observers
# ------------------------------------------------------------------------

GAZE = "depth,opacity,position,gaze,emit,capture,visibility,observer_depth"


def observer_at(mi, *origin, **kwargs):
    return {"type": "perspective", "to_world": look_at(mi, origin, (0.1, 0.2, 0.3)), **kwargs}


@pytest.mark.parametrize("near_clip", [0.01, 1.0])
def test17_an_observer_at_the_camera_is_none(rgb, files, near_clip):
    sensor = camera(rgb, near_clip=near_clip)
    a = render(rgb, with_gaze(files, GAZE), sensor, spp=2)
    b = render(rgb, with_gaze(files, GAZE, observer=observer_at(rgb, 0.5, 0.4, -3, near_clip=0.5)), sensor, spp=2)
    assert np.array_equal(a, b)
    out = named(rgb, a, with_gaze(files, GAZE))
    assert set(np.unique(out["visibility.Y"])) <= {0, 0.5, 1} and out["gaze.Y"].max() > 0


def test18_near_clip_does_not_move_the_observer(rgb, files):
    near, far = (channels(rgb, with_gaze(files, GAZE), camera(rgb, near_clip=n)) for n in (0.01, 1.0))
    seen = near["gaze.Y"] > 0
    assert seen.any() and np.allclose(near["position.X"], far["position.X"], atol=2e-2)
    # Depth is measured from the near plane, gaze and observer depth from the centre.
    assert (near["depth.T"][seen] - far["depth.T"][seen] > 0.9).all()
    assert np.allclose(near["observer_depth.T"][seen], far["observer_depth.T"][seen], rtol=2e-2)


def test19_cameras_without_a_centre_need_an_observer(rgb, files):
    sensor = {**camera(rgb, kind="orthographic"), "near_clip": 0.1}
    scene = rgb.load_dict({"type": "scene", "integrator": with_gaze(files, "gaze"), "sensor": sensor})
    with pytest.raises(ValueError, match="no centre to look from.*observer"):
        scene.integrator().render(scene, scene.sensors()[0])
    out = channels(rgb, with_gaze(files, "gaze", observer=observer_at(rgb, 1, 0, -3)), sensor)
    assert out["gaze.Y"].any()
    assert render(rgb, with_gaze(files, "depth"), sensor).shape[-1] == 4


def wall(mi, gap=0.3):
    """An opaque wall in the plane z = 0 that leaves x > ``gap`` open, and a back wall at z = 0.8 .. 1."""
    n = 40
    data = np.zeros((n, 2, n), np.float32)
    x = (np.arange(n) + 0.5) / n * 2 - 1
    data[19:21, :, x < gap] = 1e4
    data[36:] = 1e4
    return {"type": "gridvolume", "grid": mi.VolumeGrid(data), "filter_type": "nearest",
            "to_world": mi.ScalarTransform4f().translate([-1, -1, -1]).scale(2)}  # fmt: skip


def hidden_scene(mi, **kwargs):
    # The camera is behind the wall and sees the back wall; the observer is in front of it.
    sensor = camera(mi, (0.5, 0, 0.2), (0.5, 0, 1), fov=65, near_clip=1e-3)
    integrator = {"type": "nerg", "density": wall(mi), "aovs": "visibility,position,observer_depth", "step": 0.01,
                  "observer": observer_at(mi, 0, 0, -0.9), **kwargs}  # fmt: skip
    return channels(mi, integrator, sensor)


@pytest.mark.parametrize("depth", ["expected", "median"])
def test20_behind_an_opaque_wall(rgb, depth):
    out = hidden_scene(rgb, depth=depth, falloff=0.0)
    x, z = out["position.X"], out["position.Z"]
    assert np.allclose(z, 0.8, atol=0.02)
    # The observer's line to (x, y, 0.8) passes z = -0.05 .. 0.05 at x (0.85 .. 0.95) / 1.7.
    hidden, visible = x * 0.95 / 1.7 < 0.3 - 0.06, x * 0.85 / 1.7 > 0.3 + 0.06
    assert hidden.sum() > 20 and visible.sum() > 5
    assert not out["visibility.Y"][hidden].any() and (out["visibility.Y"][visible] == 1).all()
    ray = np.sqrt(x**2 + out["position.Y"] ** 2 + 1.7**2)
    assert np.allclose(out["observer_depth.T"][visible], ray[visible], atol=0.03)
    assert np.allclose(out["observer_depth.T"][hidden], (ray * 0.85 / 1.7)[hidden], atol=0.03)


def test21_falloff_is_a_ramp(rgb):
    # Hidden surfaces lie 1.7 / 0.85 times as far as what the observer meets.
    out = hidden_scene(rgb, falloff=2.0, tolerance=0.05)
    x = out["position.X"]
    hidden = x * 0.95 / 1.7 < 0.3 - 0.06
    ray = np.sqrt(x**2 + out["position.Y"] ** 2 + 1.7**2)
    expected = 1 - np.clip((ray - out["observer_depth.T"] - 0.05) / 2, 0, 1)
    assert np.allclose(out["visibility.Y"][hidden], expected[hidden], atol=0.01)
    assert 0.3 < expected[hidden].min() and expected[hidden].max() < 0.8


def test22_without_occlusion_all_is_visible(rgb):
    out = hidden_scene(rgb, occlusion=False)
    assert (out["visibility.Y"] == 1).all()
    ray = np.sqrt(out["position.X"] ** 2 + out["position.Y"] ** 2 + (out["position.Z"] + 0.9) ** 2)
    assert np.allclose(out["observer_depth.T"], ray, rtol=1e-5)


def test23_no_shadow_acne_on_what_the_observer_sees(rgb):
    # Observer and camera on the same side of one flat wall, near each other and far apart.
    data = np.zeros((40, 2, 2), np.float32)
    data[30:] = 1e4
    density = {"type": "gridvolume", "grid": rgb.VolumeGrid(data), "filter_type": "nearest",
               "to_world": rgb.ScalarTransform4f().translate([-1, -1, -1]).scale(2)}
    for x in (0.01, 0.3, 0.9):
        integrator = {"type": "nerg", "density": density, "aovs": "visibility", "falloff": 0.0,
                      "observer": observer_at(rgb, x, 0.1, -0.9)}
        out = channels(rgb, integrator, camera(rgb, (0, 0, -0.95), (0, 0, 1), fov=60, near_clip=1e-3))
        assert (out["visibility.Y"] == 1).all()


@pytest.mark.parametrize("origin", [(0.5, 0.4, -3), (0, 0, 0), (0.1, 0.2, 5), (1e4, 0, 0)])
def test24_observers_anywhere_give_finite_pictures(rgb, files, origin):
    for falloff in (0.0, 1e-30, 0.3, 1e30):
        out = render(rgb, with_gaze(files, GAZE, observer=observer_at(rgb, *origin), falloff=falloff))
        assert np.all(np.isfinite(out))


# ------------------------------------------------------------------------
#  Seeds, films, batches, nesting
# ------------------------------------------------------------------------


@pytest.mark.parametrize("rfilter, tolerance", [("box", 0), ("gaussian", 1e-6)])
def test25_equal_seeds(rgb, files, rfilter, tolerance):
    integrator = with_gaze(files, GAZE, jitter=True)
    a, b = (render(rgb, integrator, camera(rgb, rfilter=rfilter), spp=4, seed=7) for _ in range(2))
    assert np.array_equal(a, b) if tolerance == 0 else np.allclose(a, b, atol=tolerance, rtol=1e-6)
    c = render(rgb, integrator, camera(rgb, rfilter=rfilter), spp=4, seed=8)
    assert not np.allclose(a, c, atol=1e-4)


def test26_jitter_alone_makes_seeds_differ(rgb, files):
    # One sample in the middle of each pixel: nothing but the jitter depends on the seed.
    still = {"type": "stratified", "jitter": False, "sample_count": 1}

    def picture(seed, jitter):
        return render(rgb, with_field(files, jitter=jitter, aovs="opacity"), {**camera(rgb), "sampler": still}, seed=seed)

    def random(seed, jitter):
        return render(rgb, constant(3.0, density={"type": "gridvolume", "grid": rgb.VolumeGrid(np.random.default_rng(0).exponential(
            3, (6, 6, 6)).astype(np.float32))}, jitter=jitter, step=0.2), straight(rgb, "perspective"), seed=seed)

    assert not np.array_equal(random(1, True), random(2, True)) and np.allclose(random(1, False), random(2, False), rtol=1e-3)
    assert picture(1, True).shape == picture(1, False).shape


def test27_more_samples_converge(rgb, files):
    integrator = with_field(files, aovs="opacity", jitter=True)
    reference = render(rgb, integrator, spp=512, seed=1)
    errors = [np.abs(render(rgb, integrator, spp=n, seed=2) - reference).mean() for n in (4, 64)]
    assert errors[1] < 0.5 * errors[0]


def test28_crop_is_the_crop_of_the_whole(rgb, files):
    # Equal subpixel positions in both: one sample in the middle of each pixel.
    still = {"type": "stratified", "jitter": False, "sample_count": 1}
    integrator = with_gaze(files, GAZE)
    whole = render(rgb, integrator, {**camera(rgb), "sampler": still})
    crop = dict(crop_offset_x=3, crop_offset_y=5, crop_width=6, crop_height=4)
    part = render(rgb, integrator, {**camera(rgb, film=crop), "sampler": still})
    assert part.shape == (4, 6, whole.shape[-1]) and np.allclose(part, whole[5:9, 3:9], atol=2e-4)


@pytest.mark.parametrize("near_clip", [0.01, 1.0])
def test29_a_batch_equals_its_members(rgb, files, near_clip):
    still = {"type": "stratified", "jitter": False, "sample_count": 1}
    origins = [(0.5, 0.4, -3), (-2.5, 0.2, -1), (0, 0.5, 3)]
    cameras = [{**camera(rgb, o, near_clip=near_clip), "sampler": still} for o in origins]
    integrator = with_gaze(files, GAZE)
    batch = {"type": "batch", "sampler": still, "film": {**cameras[0]["film"], "width": SIZE * 3},
             **{f"c{i}": c for i, c in enumerate(cameras)}}
    whole = render(rgb, integrator, batch)
    for i, c in enumerate(cameras):
        alone = render(rgb, integrator, c)
        got = whole[:, SIZE * i: SIZE * (i + 1)]
        assert np.mean(np.abs(got - alone) < 2e-3) > 0.99 and np.abs(got - alone).mean() < 1e-3


def test30_nested(rgb, files):
    inner = with_gaze(files, GAZE)
    plain = render(rgb, inner)
    # `aov` puts the inner picture first.
    assert np.allclose(render(rgb, {"type": "aov", "aovs": "pos:position", "nerg": inner})[..., :13], plain, atol=1e-6)
    moment = {"type": "moment", "nested": inner}
    names, image = rgb.load_dict(moment).aov_names(), render(rgb, moment)
    for i, name in enumerate(rgb.load_dict(inner).aov_names()):
        assert np.allclose(image[..., 3 + names.index(f"nested.{name}")], plain[..., 3 + i], atol=1e-6), name


def test31_integrator_given_to_render(rgb, files):
    scene = rgb.load_dict({"type": "scene", "sensor": camera(rgb)})
    integrator = rgb.load_dict(with_gaze(files, GAZE))
    assert np.array_equal(np.array(rgb.render(scene, integrator=integrator, spp=1)), render(rgb, with_gaze(files, GAZE)))


def test32_a_sensor_outside_of_the_scene(rgb, files):
    # The observer is the camera that renders, not the scene's own.
    scene = rgb.load_dict({"type": "scene", "integrator": with_gaze(files, GAZE), "sensor": camera(rgb, (2, 1, 2))})
    other = rgb.load_dict(camera(rgb))
    assert np.array_equal(np.array(rgb.render(scene, sensor=other, spp=1)), render(rgb, with_gaze(files, GAZE)))


def test33_film_channels_by_name(rgb, files):
    scene = rgb.load_dict({"type": "scene", "integrator": with_gaze(files, "depth,gaze"), "sensor": camera(rgb)})
    rgb.render(scene, spp=1)
    layers = [name for name, _ in scene.sensors()[0].film().bitmap().split()]
    assert layers == ["<root>", "depth", "gaze"]


# ------------------------------------------------------------------------
#  Variants
# ------------------------------------------------------------------------


def test34_mono_is_the_luminance_of_rgb(rgb, files):
    still = {"type": "stratified", "jitter": False, "sample_count": 1}
    integrator = with_gaze(files, GAZE, background={"type": "rgb", "value": [0.1, 0.3, 0.2]})
    a = render(rgb, integrator, {**camera(rgb), "sampler": still})
    rgb.set_variant("llvm_ad_mono")
    b = render(rgb, integrator, {**camera(rgb), "sampler": still})
    assert b.shape[-1] == a.shape[-1] - 2
    assert np.allclose(b[..., 0], a[..., :3] @ [0.212671, 0.715160, 0.072169], atol=1e-4)
    assert np.allclose(b[..., 1:], a[..., 3:], atol=1e-4)


@pytest.mark.parametrize("variant", ["llvm_ad_spectral", "llvm_ad_mono_polarized", "llvm_ad_spectral_polarized"])
def test35_spectral_and_polarized_are_refused(rgb, variant):
    if variant not in rgb.variants():
        pytest.skip(f"{variant} is not in this build of Mitsuba")
    rgb.set_variant(variant)
    try:
        with pytest.raises(RuntimeError, match=f'"nerg" renders rgb and mono variants, not "{variant}".*set_variant'):
            rgb.load_dict(constant())
    finally:
        rgb.set_variant("llvm_ad_rgb")


def test36_scalar_is_refused_and_forgotten(files):
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


# ------------------------------------------------------------------------
#  Seen from Python
# ------------------------------------------------------------------------


def test37_to_string(rgb, files):
    text = str(rgb.load_dict(with_gaze(files, GAZE, observer=observer_at(rgb, 1, 2, 3), falloff=0.25)))
    for part in ("NergIntegrator[", "NerfVolume[", "GazeFieldVolume[", "falloff = [0.25]", "1, 2, 3", "depth = expected", "aovs = depth"):
        assert part in text, part


def test38_traverse_and_update(rgb, files):
    scene = rgb.load_dict({"type": "scene", "integrator": with_gaze(files, GAZE, observer=observer_at(rgb, -2, 0.3, -2)),
                           "sensor": camera(rgb)})
    params = rgb.traverse(scene)
    for key in ("field.grid.table", "field.density_net.0", "field.color_net.2", "gaze.grid.table", "gaze.emit_head.0",
                "gaze.capture_head.0", "observer.to_world", "falloff"):
        assert f"integrator.{key}" in params, key

    def picture():
        return named(rgb, np.array(rgb.render(scene, spp=1)), with_gaze(files, GAZE)), np.array(rgb.render(scene, spp=1))[..., :3]

    changes = {
        "field.density_net.1": ("opacity.Y", 1.3), "gaze.emit_head.0": ("emit.Y", -1.0), "gaze.grid.table": ("gaze.Y", 0.5),
        "falloff": ("visibility.Y", 30.0),
    }  # fmt: skip
    before, color = picture()
    for key, (channel, factor) in changes.items():
        name = f"integrator.{key}"
        params[name] = type(params[name])(params[name] * factor)
        params.update()
        after, _ = picture()
        assert not np.allclose(after[channel], before[channel], rtol=1e-3), key
        before = after
    name = "integrator.field.color_net.2"
    params[name] = params[name] * -1
    params.update()
    assert not np.allclose(picture()[1], color, rtol=1e-2)
    params["integrator.observer.to_world"] = rgb.Transform4f().look_at([2, -1, -2], [0, 0, 0], [0, 1, 0])
    params.update()
    assert not np.allclose(picture()[0]["observer_depth.T"], before["observer_depth.T"], rtol=1e-3)


def test39_a_negative_falloff_is_refused_later_too(rgb):
    integrator = rgb.load_dict(constant())
    params = rgb.traverse(integrator)
    params["falloff"] = rgb.Float(-1)
    with pytest.raises(ValueError, match='"falloff"'):
        params.update()


def test40_a_voxel_grid_that_changes_is_seen(rgb):
    # Empty voxels that are filled later must not be skipped.
    data = np.zeros((8, 8, 8), np.float32)
    data[0] = 2
    integrator = {"type": "nerg", "density": {"type": "gridvolume", "grid": rgb.VolumeGrid(data)}, "aovs": "opacity"}
    scene = rgb.load_dict({"type": "scene", "integrator": integrator, "sensor": straight(rgb, "perspective")})
    before = np.array(rgb.render(scene, spp=1))[..., 3].item()
    params = rgb.traverse(scene)
    key = next(k for k in params.keys() if k.endswith("data"))
    params[key] = rgb.TensorXf(np.full((8, 8, 8, 1), 2, np.float32))
    params.update()
    after = np.array(rgb.render(scene, spp=1))[..., 3].item()
    assert before < 0.5 and np.isclose(after, 1 - math.exp(-2), rtol=1e-4)


@pytest.mark.parametrize("angle", [45, 90, 180])
def test41_a_turned_grid_is_not_skipped_by_its_own_voxels(rgb, angle):
    # A small dense block of a large empty grid, turned: its place is elsewhere than its indices say.
    data = np.zeros((32, 32, 32), np.float32)
    data[14:18, 2:6, 2:6] = 50
    turn = rgb.ScalarTransform4f().rotate([0, 0, 1], angle).translate([-0.5, -0.5, -0.5])
    density = {"type": "gridvolume", "grid": rgb.VolumeGrid(data), "to_world": turn}
    x, y = (np.array(turn.matrix) @ [4 / 32, 4 / 32, 0.5, 1])[:2].tolist()
    sensor = camera(rgb, (x, y, -2), (x, y, 0), fov=1e-3, size=1)
    out = channels(rgb, {"type": "nerg", "density": density, "aovs": "opacity"}, sensor)
    assert out["opacity.Y"].item() > 0.9


def test42_a_grid_that_repeats_is_bounded_as_it_repeats(rgb):
    # The last half voxel interpolates with the first voxel of the next repetition.
    data = np.zeros((8, 8, 8), np.float32)
    data[0] = 40
    opacity = {}
    for wrap in ("clamp", "repeat"):
        density = {"type": "gridvolume", "grid": rgb.VolumeGrid(data), "wrap_mode": wrap}
        sensor = camera(rgb, (-2, 0.5, 0.99), (0, 0.5, 0.99), fov=1e-3, size=1)
        opacity[wrap] = channels(rgb, {"type": "nerg", "density": density, "aovs": "opacity"}, sensor)["opacity.Y"].item()
    assert opacity["clamp"] == 0
    assert np.isclose(opacity["repeat"], 1 - math.exp(-40 * (0.5 - 0.01 * 8)), rtol=1e-4)


@pytest.mark.parametrize("visibility", ["depth", "map", "transmittance"])
def test43_kinds_of_visibility_agree_on_opaque_walls(rgb, visibility):
    out = hidden_scene(rgb, visibility=visibility, falloff=0.0, map_height=256)
    x = out["position.X"]
    hidden, visible = x * 0.95 / 1.7 < 0.3 - 0.08, x * 0.85 / 1.7 > 0.3 + 0.08
    assert hidden.sum() > 20 and visible.sum() > 5
    assert np.allclose(out["visibility.Y"][hidden], 0, atol=1e-6) and np.allclose(out["visibility.Y"][visible], 1, atol=1e-6)


@pytest.mark.parametrize("quadrature", ["constant", "linear", "cells"])
def test44_quadratures_converge_to_one_picture(rgb, quadrature):
    data = np.random.default_rng(0).exponential(2, (4, 5, 6)).astype(np.float32)
    density = {"type": "gridvolume", "grid": rgb.VolumeGrid(data),
               "to_world": rgb.ScalarTransform4f().translate([-1, -1, -1]).scale(2)}
    still = {**camera(rgb, size=6), "sampler": {"type": "stratified", "jitter": False, "sample_count": 1}}
    base = {"type": "nerg", "density": density, "stop": 1e-9}
    fine = channels(rgb, {**base, "step": 1e-3}, still)
    got = channels(rgb, {**base, "step": 2e-3 if quadrature == "constant" else 0.02, "quadrature": quadrature}, still)
    for c in fine:
        assert np.allclose(got[c], fine[c], rtol=1e-3, atol=1e-4), c


def test45_coarse_steps_in_front_of_matter_change_nothing_behind(rgb):
    a, b = (hidden_scene(rgb, coarse=c, falloff=0.0, aovs="depth,opacity,visibility,position,observer_depth") for c in (1.0, 4.0))
    # Steps end elsewhere: a pixel at the shadow's edge may change sides.
    assert np.mean(a["visibility.Y"] != b["visibility.Y"]) < 0.06
    same = a["visibility.Y"] == b["visibility.Y"]
    for c in ("depth.T", "opacity.Y", "observer_depth.T"):
        assert np.allclose(a[c][same], b[c][same], rtol=1e-2, atol=5e-3), c
