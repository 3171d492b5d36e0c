"""The integrator's parameters and children: what is read of a scene, and what is refused."""

from pathlib import Path

import numpy as np
import pytest

from .scenes import SIZE, camera, constant, look_at, render, with_field, with_gaze

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
