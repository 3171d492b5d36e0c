"""Tests of `plugins.nerg`."""

import math
from pathlib import Path

import numpy as np
import pytest

from .scenes import (
    GAZE,
    SIZE,
    camera,
    channels,
    constant,
    look_at,
    named,
    observer_at,
    render,
    straight,
    with_field,
    with_gaze,
)

# ---- The integrator through Mitsuba: its channels, and what Python sees of it ----


CHANNELS = {
    "depth": ["depth.T"],
    "opacity": ["opacity.Y"],
    "position": ["position.X", "position.Y", "position.Z"],
    "gaze": ["gaze.Y"],
    "emit": ["emit.Y"],
    "capture": ["capture.Y"],
    "visibility": ["visibility.Y"],
    "observer_depth": ["observer_depth.T"],
    "density_evals": ["density_evals.Y"],
    "color_evals": ["color_evals.Y"],
    "gaze_evals": ["gaze_evals.Y"],
}


def test01_names_and_order(rgb, files):
    assert rgb.load_dict(constant()).aov_names() == ["depth.T", "opacity.Y"]
    assert rgb.load_dict(constant(aovs="")).aov_names() == []
    order = list(CHANNELS)[::-1]
    integrator = with_gaze(files, " , ".join(order))
    assert rgb.load_dict(integrator).aov_names() == [c for name in order for c in CHANNELS[name]]
    assert render(rgb, integrator).shape == (SIZE, SIZE, 3 + 13)
    assert render(rgb, constant(aovs="")).shape == (SIZE, SIZE, 3)


def test02_each_channel_alone_equals_all_together(rgb, files):
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
    assert np.allclose(
        everything["gaze.Y"], everything["emit.Y"] * everything["capture.Y"] * everything["visibility.Y"], rtol=1e-5
    )


def test03_without_radiance(rgb, files):
    names = ",".join(n for n in CHANNELS if n != "color_evals")
    a, b = (render(rgb, with_gaze(files, names, radiance=r)) for r in (True, False))
    assert a[..., :3].max() > 0.05 and not b[..., :3].any() and np.array_equal(a[..., 3:], b[..., 3:])
    evals = channels(rgb, with_gaze(files, "density_evals,color_evals", radiance=False))
    assert not evals["color_evals.Y"].any() and evals["density_evals.Y"].any()
    black = render(rgb, constant(radiance=False, background=1.0))
    assert not black[..., :3].any()


def test04_below_the_surface_opacity(rgb, files):
    low, high = (
        channels(rgb, with_gaze(files, "opacity,depth,position,gaze,visibility", surface_opacity=s))
        for s in (0.05, 0.97)
    )
    for c in ("opacity.Y", "depth.T"):
        assert np.array_equal(low[c], high[c])
    thin = high["opacity.Y"] < 0.97
    assert thin.any() and not high["gaze.Y"][thin].any() and not high["position.Z"][thin].any()
    assert low["gaze.Y"][low["opacity.Y"] > 0.05].all() and not high["visibility.Y"][thin].any()
    assert (low["depth.T"][low["opacity.Y"] > 0] > 0).all() and not low["depth.T"][low["opacity.Y"] == 0].any()


def test05_to_string(rgb, files):
    text = str(rgb.load_dict(with_gaze(files, GAZE, observer=observer_at(rgb, 1, 2, 3), falloff=0.25)))
    for part in (
        "NergIntegrator[",
        "NerfVolume[",
        "GazeFieldVolume[",
        "falloff = [0.25]",
        "1, 2, 3",
        "depth = expected",
        "aovs = depth",
    ):
        assert part in text, part


def test06_traverse_and_update(rgb, files):
    scene = rgb.load_dict(
        {
            "type": "scene",
            "integrator": with_gaze(files, GAZE, observer=observer_at(rgb, -2, 0.3, -2)),
            "sensor": camera(rgb),
        }
    )
    params = rgb.traverse(scene)
    for key in (
        "field.grid.table",
        "field.density_net.0",
        "field.color_net.2",
        "gaze.grid.table",
        "gaze.emit_head.0",
        "gaze.capture_head.0",
        "observer.to_world",
        "falloff",
    ):
        assert f"integrator.{key}" in params, key

    def picture():
        return named(rgb, np.array(rgb.render(scene, spp=1)), with_gaze(files, GAZE)), np.array(
            rgb.render(scene, spp=1)
        )[..., :3]

    changes = {
        "field.density_net.1": ("opacity.Y", 1.3),
        "gaze.emit_head.0": ("emit.Y", -1.0),
        "gaze.grid.table": ("gaze.Y", 0.5),
        "falloff": ("visibility.Y", 30.0),
    }
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


def test07_a_negative_falloff_is_refused_later_too(rgb):
    integrator = rgb.load_dict(constant())
    params = rgb.traverse(integrator)
    params["falloff"] = rgb.Float(-1)
    with pytest.raises(ValueError, match='"falloff"'):
        params.update()


def test08_a_voxel_grid_that_changes_is_seen(rgb):
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


def test09_another_integrator_may_ask_for_some_rays_only(rgb):
    """All of them, unless it says which; the others are black, not valid, and have no depth."""
    scene = rgb.load_dict(
        {"type": "scene", "integrator": constant(aovs="depth,opacity", background=0.5), "sensor": camera(rgb)}
    )
    x = np.linspace(0.1, 1.9, 10, dtype=np.float32)  # five through the cube, five past it
    ray = rgb.RayDifferential3f(rgb.Point3f(x, 0.4, -1), rgb.Vector3f(0, 0, 1))
    sampler = rgb.load_dict({"type": "independent"})
    sampler.seed(0, len(x))
    ask = scene.integrator().sample
    whole, wanted = ask(scene, sampler, ray), np.arange(10) % 3 > 0
    color, valid, aovs = (np.array(whole[0]), np.array(whole[1]), np.array(whole[2]))
    assert np.allclose(color, 0.5 * np.where(x < 1, np.exp(-3), 1), rtol=1e-4) and np.array_equal(valid, x < 1)
    some = ask(scene, sampler, ray, None, rgb.Bool(wanted))
    assert np.array_equal(np.array(some[0]), color * wanted) and np.array_equal(np.array(some[1]), valid & wanted)
    assert np.array_equal(np.array(some[2]), aovs * wanted)


# ---- The integrator's parameters and children: what is read of a scene, and what is refused ----


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
    integrator = with_gaze(
        files,
        "depth,opacity,gaze,visibility,position",
        observer=observer,
        falloff=0.3,
        depth="median",
        background={"type": "rgb", "value": [0.1, 0.2, 0.3]},
    )
    a, b = np.array(rgb.render(scene, spp=2, seed=3)), render(rgb, integrator, spp=2, seed=3)
    # The XML parser rounds placements in another way.
    assert a.shape == (SIZE, SIZE, 3 + 7) and np.allclose(a, b, atol=3e-6)
    assert a[..., 3].max() > 0 and a[..., 5].max() > 0
    plain = render(rgb, {**integrator, "background": [0.1, 0.2, 0.3]}, spp=2, seed=3)
    assert np.allclose(plain, b, atol=1e-6)


def test02_unknown_parameters_are_errors(rgb):
    with pytest.raises(RuntimeError, match="fallof"):
        rgb.load_dict(constant(fallof=0.3))
    density = '<volume name="density" type="constvolume"/>'
    xml = f'<scene version="3.0.0"><integrator type="nerg">{density}{{}}</integrator></scene>'
    rgb.load_string(xml.format(""))
    with pytest.raises(RuntimeError, match="fallof"):
        rgb.load_string(xml.format('<float name="fallof" value="1"/>'))


ALL = dict(
    occlusion=False,
    falloff=0.5,
    tolerance=0.1,
    depth="median",
    surface_opacity=0.4,
    radiance=False,
    background=0.5,
    aovs="depth",
    step=0.1,
    dt_gamma=0.01,
    stop=1e-3,
    color_cutoff=0.01,
    jitter=True,
)


@pytest.mark.parametrize("name", list(ALL))
def test03_every_documented_parameter_is_read_and_documented(rgb, name):
    integrator = rgb.load_dict(constant(**{name: ALL[name]}))
    assert f"* - {name}" in type(integrator).__doc__ or name in ("density",)
    if name != "background":
        assert f"{name} = " in str(integrator)


@pytest.mark.parametrize(
    "name, value",
    [
        ("falloff", -0.1),
        ("falloff", "far"),
        ("falloff", float("nan")),
        ("falloff", float("inf")),
        ("falloff", True),
        ("tolerance", -1.0),
        ("depth", "mean"),
        ("depth", 3),
        ("surface_opacity", 1.5),
        ("surface_opacity", -0.1),
        ("radiance", "no"),
        ("radiance", 2.0),
        ("occlusion", "false"),
        ("jitter", "yes"),
        ("background", -1.0),
        ("background", "red"),
        ("aovs", "depth,colour"),
        ("aovs", "depth,depth"),
        ("aovs", 3),
        ("aovs", "gaze"),
        ("step", -1.0),
        ("step", float("inf")),
        ("dt_gamma", -1.0),
        ("stop", 2.0),
        ("stop", -1.0),
        ("color_cutoff", -1.0),
    ],
)
def test04_wrong_values_are_named(rgb, name, value):
    with pytest.raises((RuntimeError, ValueError), match=f'"{name}"'):
        rgb.load_dict(constant(**{name: value}))


def test05_wrong_children_are_named(rgb, files):
    with pytest.raises(RuntimeError, match='"field".*"density"'):
        rgb.load_dict(with_field(files, density={"type": "constvolume", "value": 1.0}))
    with pytest.raises(RuntimeError, match='"color" goes with "density"'):
        rgb.load_dict(with_field(files, color={"type": "constvolume", "value": 1.0}))
    with pytest.raises(RuntimeError, match='"field".*"nerf"'):
        rgb.load_dict({"type": "nerg", "field": {"type": "constvolume", "value": 1.0}})
    with pytest.raises(RuntimeError, match='"gaze".*"gazefield"'):
        rgb.load_dict(constant(gaze={"type": "constvolume", "value": 1.0}))
    with pytest.raises(RuntimeError, match='"density"'):
        rgb.load_dict({"type": "nerg", "density": 3.0})
    with pytest.raises(RuntimeError, match='"observer"'):
        rgb.load_dict(constant(observer={"type": "constvolume", "value": 1.0}))
    with pytest.raises(RuntimeError, match='"observer"'):
        rgb.load_dict(constant(observer={"type": "orthographic"}))


def test05b_an_empty_place_is_refused(rgb):
    scene = rgb.load_dict({"type": "scene", "integrator": {"type": "nerg"}, "sensor": camera(rgb)})
    with pytest.raises(ValueError, match="nothing to render.*or the scene shapes"):
        scene.integrator().render(scene, scene.sensors()[0])
    with pytest.raises(RuntimeError, match='"color".*"density"'):
        rgb.load_dict({"type": "nerg", "color": {"type": "constvolume", "value": 1.0}})
    with pytest.raises(RuntimeError, match="PRBIntegrator.*one ray"):
        rgb.load_dict({"type": "nerg", "i": {"type": "prb"}})


def test06_an_observer_who_is_a_batch_is_refused(rgb):
    # It would stand at the origin of the scene.
    batch = {
        "type": "batch",
        "film": {"type": "hdrfilm", "width": 4, "height": 2},
        "a": {
            "type": "perspective",
            "to_world": look_at(rgb, (1, 2, 3)),
            "film": {"type": "hdrfilm", "width": 2, "height": 2},
        },
        "b": {
            "type": "perspective",
            "to_world": look_at(rgb, (3, 2, 1)),
            "film": {"type": "hdrfilm", "width": 2, "height": 2},
        },
    }
    with pytest.raises(RuntimeError, match='"observer"'):
        rgb.load_dict(constant(observer=batch))


def test07_missing_files_are_named(rgb, tmp_path):
    for kind, name in (("nerf", "field"), ("gazefield", "gaze")):
        with pytest.raises(RuntimeError, match="nowhere.safetensors.*does not exist"):
            rgb.load_dict(
                constant(**{name: {"type": kind, "filename": "nowhere.safetensors"}})
                if name == "gaze"
                else {"type": "nerg", name: {"type": kind, "filename": "nowhere.safetensors"}}
            )
        with pytest.raises(RuntimeError, match='"filename"'):
            rgb.load_dict({"type": kind})


def test_each_text_of_the_manual_has_one_place(rgb):
    from nerg_mi.plugins import nerg

    source = Path(nerg.__file__).read_text("utf-8").split('"""')[1]
    names = [*nerg.TEXTS, "quadratures", "depths", "aovs"]
    # No formula is one of them.
    assert {name: source.count(f"{{{name}}}") for name in names} == dict.fromkeys(names, 1)
