"""The integrator `nerg` in Mitsuba: channels, parameters and children."""

import re
import sys
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
    make_observer,
    named,
    picture,
    plugin,
    put,
    render,
    scene_with,
    still,
    stored,
    with_field,
    with_gaze,
)

# ---- Channels ----

CHANNELS = "depth.T opacity.Y position.X position.Y position.Z gaze.Y emit.Y capture.Y visibility.Y observer_depth.T"
EVALS = ["density_evals.Y", "color_evals.Y", "gaze_evals.Y"]


def test01_names_and_order(rgb, files):
    assert rgb.load_dict(constant()).aov_names() == ["depth.T", "opacity.Y"]
    assert rgb.load_dict(constant(aovs="")).aov_names() == []
    names = f"{GAZE},density_evals,color_evals,gaze_evals".split(",")[::-1]
    integrator, all_channels = with_gaze(files, " , ".join(names)), [*CHANNELS.split(), *EVALS]
    expected = [c for name in names for c in all_channels if c.split(".")[0] == name]
    assert rgb.load_dict(integrator).aov_names() == expected and len(expected) == 13
    assert render(rgb, integrator).shape == (SIZE, SIZE, 3 + 13)
    assert render(rgb, constant(aovs="")).shape == (SIZE, SIZE, 3)


def test03_without_radiance(rgb, files):
    a, b = (render(rgb, with_gaze(files, f"{GAZE},density_evals,gaze_evals", radiance=r)) for r in (True, False))
    assert a[..., :3].max() > 0.05 and not b[..., :3].any() and np.array_equal(a[..., 3:], b[..., 3:])
    black = render(rgb, constant(radiance=False, background=1.0))
    assert not black[..., :3].any()


def test04_no_surface_below_surface_opacity(rgb, files):
    make = lambda s: channels(rgb, with_gaze(files, "opacity,depth,position,gaze,visibility", surface_opacity=s))
    low, high = make(0.05), make(0.97)
    for c in ("opacity.Y", "depth.T"):
        assert np.array_equal(low[c], high[c])
    thin = high["opacity.Y"] < 0.97
    assert thin.any() and not high["gaze.Y"][thin].any() and not high["position.Z"][thin].any()
    assert low["gaze.Y"][low["opacity.Y"] > 0.05].all() and not high["visibility.Y"][thin].any()
    assert (low["depth.T"][low["opacity.Y"] > 0] > 0).all() and not low["depth.T"][low["opacity.Y"] == 0].any()


def test05_to_string(rgb, files):
    text = str(rgb.load_dict(with_gaze(files, GAZE, observer=make_observer(rgb, 1, 2, 3), falloff=0.25)))
    for part in ("NerfVolume[", "GazeFieldVolume[", "falloff = [0.25]", "1, 2, 3", "aovs = depth"):
        assert part in text, part


def test09_nested_use_with_masked_rays(rgb):
    """All rays by default; inactive ones are black, not valid, and have no depth."""
    scene = scene_with(rgb, constant(aovs="depth,opacity", background=0.5))
    x = np.linspace(0.1, 1.9, 10, dtype=np.float32)  # five through the cube, five past it
    ray = rgb.RayDifferential3f(rgb.Point3f(x, 0.4, -1), rgb.Vector3f(0, 0, 1))
    sampler = rgb.load_dict({"type": "independent"})
    sampler.seed(0, len(x))
    ask = lambda *more: [np.array(v) for v in scene.integrator().sample(scene, sampler, ray, *more)]
    (color, valid, aovs), wanted = ask(), np.arange(10) % 3 > 0
    assert np.allclose(color, 0.5 * np.where(x < 1, np.exp(-3), 1), rtol=1e-4) and np.array_equal(valid, x < 1)
    some = ask(None, rgb.Bool(wanted))
    assert np.array_equal(some[0], color * wanted) and np.array_equal(some[1], valid & wanted)
    assert np.array_equal(some[2], aovs * wanted)


# ---- Parameters of ``mi.traverse`` ----


def test01_parameter_flags(rgb, files):
    params = rgb.traverse(scene_with(rgb, with_gaze(files, observer=make_observer(rgb, -2, 0.3, -2))))
    D, edges = rgb.ParamFlags.Differentiable, rgb.ParamFlags.Discontinuous
    shown = {k: params.flags(k) for k in params.keys() if k.startswith("integrator.")}
    assert shown.pop("integrator.observer.to_world") == D | edges
    assert "integrator.falloff" in shown and len(shown) == 14 and all(v == D for v in shown.values())
    # Parameters of a sensor other than its pose are not exposed.
    assert [k for k in params.keys() if "observer" in k] == ["integrator.observer.to_world"]


@pytest.mark.parametrize(
    "key, channel, factor",
    [
        ("field.density_net.1", "opacity.Y", 1.3),
        ("field.color_net.2", "R", -1),
        ("gaze.emit_head.0", "emit.Y", -1.0),
        ("gaze.grid.table", "gaze.Y", 0.5),
        ("gaze.capture_head.0", "capture.Y", -1.0),
        ("falloff", "visibility.Y", 30.0),
    ],
)
def test06_update_takes_effect(rgb, files, key, channel, factor):
    integrator = with_gaze(files, GAZE, observer=make_observer(rgb, -2, 0.3, -2))
    scene = scene_with(rgb, integrator)
    params, key = rgb.traverse(scene), f"integrator.{key}"

    def shown():
        image = picture(rgb, scene)
        return (named(rgb, image, integrator) | {"R": image[..., 0]})[channel]

    before = shown()
    put(params, key, type(params[key])(params[key] * factor))
    assert not np.allclose(shown(), before, rtol=1e-3)


def test07_negative_falloff_is_refused_on_update(rgb):
    with pytest.raises(ValueError, match='"falloff"'):
        put(rgb.traverse(rgb.load_dict(constant())), "falloff", rgb.Float(-1))


@pytest.mark.parametrize("kind", ["perspective", "panorama"])
def test02_observer_can_be_moved(rgb, files, kind):
    def scene_of(*eye):
        observer = {**make_observer(rgb, *eye), "type": kind}
        return scene_with(rgb, with_gaze(files, "gaze", falloff=2.0, observer=observer), still(camera(rgb, size=6)))

    scene, key = scene_of(-2, 0.3, -2), "integrator.observer.to_world"
    params = rgb.traverse(scene)
    put(params, key, rgb.ScalarTransform4f().translate([-1, -1, -2]))
    assert np.array_equal(picture(rgb, scene), picture(rgb, scene_of(-1, -1, -2)))
    with pytest.raises(Exception, match="not finite"):
        put(params, key, rgb.ScalarTransform4f().translate([np.nan, 0, 0]))


# ---- Reading a scene, and error messages ----

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


def test01_xml_equals_dict_and_files_are_relative(rgb, files):
    path = files / "scene.xml"
    path.write_text(XML)
    scene = rgb.load_file(str(path))
    overrides = {"observer": {"type": "perspective", "to_world": look_at(rgb, (-2, 0.3, -2))}, "depth": "median"}
    overrides |= {"falloff": 0.3, "background": {"type": "rgb", "value": [0.1, 0.2, 0.3]}}
    integrator = with_gaze(files, "depth,opacity,gaze,visibility,position", **overrides)
    a, b = np.array(rgb.render(scene, spp=2, seed=3)), render(rgb, integrator, spp=2, seed=3)
    # The XML parser rounds transforms differently.
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


WRONG = {
    "falloff": [-0.1, "far", float("nan"), float("inf"), True],
    "tolerance": [-1.0],
    "depth": ["mean", 3],
    "surface_opacity": [1.5, -0.1],
    "radiance": ["no", 2.0],
    "occlusion": ["false"],
    "jitter": ["yes"],
    "background": [-1.0, "red"],
    "aovs": ["depth,colour", "depth,depth", 3, "gaze"],
    "step": [-1.0, float("inf")],
    "dt_gamma": [-1.0],
    "quadrature": ["simpson"],
    "stop": [2.0, -1.0],
    "color_cutoff": [-1.0],
}


@pytest.mark.parametrize("name, value", [(name, value) for name, values in WRONG.items() for value in values])
def test04_invalid_values_are_named(rgb, name, value):
    with pytest.raises((RuntimeError, ValueError), match=f'"{name}"'):
        rgb.load_dict(constant(**{name: value}))


def test05_invalid_children_are_named(rgb, files):
    some, small = plugin("constvolume", value=1.0), {"type": "hdrfilm", "width": 2, "height": 2}
    positions = {k: {"type": "perspective", "to_world": look_at(rgb, (k, 2, 3)), "film": small} for k in (1, 3)}
    # It would be at the origin of the scene.
    batch = plugin("batch", film={"type": "hdrfilm", "width": 4, "height": 2}, a=positions[1], b=positions[3])
    for integrator, said in (
        (with_field(files, density=some), '"field".*"density"'),
        (with_field(files, color=some), '"color" goes with "density"'),
        (plugin("nerg", color=some), '"color".*"density"'),
        (plugin("nerg", field=some), '"field".*"nerf"'),
        (constant(gaze=some), '"gaze".*"gazefield"'),
        (plugin("nerg", density=3.0), '"density"'),
        (constant(observer=some), '"observer"'),
        (constant(observer={"type": "orthographic"}), '"observer"'),
        (constant(observer=batch), '"observer"'),
        (plugin("nerg", i={"type": "prb"}), "PRBIntegrator.*single rays"),
        (plugin("nerg", field=stored("nerf", "nowhere.safetensors")), "nowhere.safetensors.*does not exist"),
        (constant(gaze=stored("gazefield", "nowhere.safetensors")), "nowhere.safetensors.*does not exist"),
        ({"type": "nerf"}, '"filename"'),
        ({"type": "gazefield"}, '"filename"'),
    ):
        with pytest.raises(RuntimeError, match=said):
            rgb.load_dict(integrator)


def test05b_empty_scene_is_refused(rgb):
    scene = scene_with(rgb, {"type": "nerg"})
    with pytest.raises(ValueError, match="nothing to render.*or add shapes"):
        scene.integrator().render(scene, scene.sensors()[0])


# ---- Defaults in the manual are those of the code ----

NAMES = """headlight occlusion falloff tolerance visibility map_height directions integral_tolerance depth
surface_opacity radiance background aovs step quadrature coarse dt_gamma stop color_cutoff refined jitter""".split()
TEXTS = {"visibility": "map", "depth": "refined", "quadrature": "linear", "aovs": "opacity"}
SHARES = dict.fromkeys(("headlight", "surface_opacity", "integral_tolerance", "dt_gamma", "stop", "color_cutoff"), 0.25)
OTHER_VALUES, INTEGERS = TEXTS | SHARES, ("map_height", "directions")


def manual(mi):
    """Parameter name -> default, as in the plugin's documentation."""
    mi.load_dict({"type": "nerg"})
    text = sys.modules["nerg_mi.plugins.nerg"].__doc__
    entries = re.split(r"^ \* - ", text, flags=re.MULTILINE)[1:]
    result = {e.split("\n")[0].strip(): re.search(r"\(Default:\s*([^;,:) ]+(?:,opacity)?)", e) for e in entries}
    # There is no ceiling by default, and its up has no effect without one.
    return {name: m[1].strip("`\n ") for name, m in result.items() if m and name not in ("ceiling", "up")}


def test01_manual_states_all_defaults(rgb):
    assert list(manual(rgb)) == NAMES


def test04_help_begins_with_a_summary(rgb):
    """Ten parameters of the manual, with its defaults, before the manual itself."""
    text = type(rgb.load_dict({"type": "nerg"})).__doc__
    summary, _, rest = text.partition(".. _integrator-nerg:")
    rows = dict(re.findall(r"^    (\(?[a-z]+\)?) {2,}(.*)$", summary, re.MULTILINE))
    defaults = manual(rgb)
    assert len(rows) == 10 and all(f"* - {name}" in rest for name in rows)
    stated = {name: default for name, default in defaults.items() if name in rows}
    assert all(default in rows[name] for name, default in stated.items() if name != "step") and len(stated) >= 4


def settings_of(mi, **overrides):
    integrator = mi.load_dict(constant(1.0, depth="median") | overrides)
    overrides = {"text": str(integrator), "background": np.array(integrator.background).tolist()}
    return vars(integrator.settings) | vars(integrator.observer_settings) | overrides


@pytest.mark.parametrize("name", NAMES)
def test02_explicit_defaults_change_nothing(rgb, name):
    text = manual(rgb)[name]
    truth = {"true": True, "false": False}
    read = str if name in TEXTS else int if name in INTEGERS else float
    value = truth[text] if text in truth else read(text)
    assert settings_of(rgb, **{name: value}) == settings_of(rgb)
    other = OTHER_VALUES[name] if name in OTHER_VALUES else not value if isinstance(value, bool) else value + 2
    assert settings_of(rgb, **{name: other}) != settings_of(rgb)


def test03_default_step_is_a_fraction_of_the_diagonal(rgb):
    settings = rgb.load_dict(constant()).settings
    assert settings.step == pytest.approx(3**0.5 / 1024, rel=1e-5) and settings.cell_step == float("inf")
    arguments = rgb.load_dict(constant(step=0.25)).settings
    assert arguments.step == arguments.cell_step == 0.25  # noqa: RUF069 (stored)


def test_manual_texts_are_used_once(rgb):
    from nerg_mi.plugins import nerg

    source = Path(nerg.__file__).read_text("utf-8").split('"""')[1]
    names = [*nerg.PARAMETER_TEXTS, "quadratures", "depths", "aovs"]
    # Formulas contain none of them.
    assert {name: source.count(f"{{{name}}}") for name in names} == dict.fromkeys(names, 1)
