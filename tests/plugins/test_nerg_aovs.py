"""The table of AOVs, including features, and that unneeded values are not computed."""

import subprocess
import sys
from pathlib import Path

import drjit as dr
import numpy as np
import pytest

from nerg_mi.environment.scene import Scene
from nerg_mi.errors import NergError
from nerg_mi.evaluation.study import count_traced_operations
from nerg_mi.figures.image_files import draw_difference, draw_sheet
from nerg_mi.figures.layers import render_layers
from nerg_mi.figures.overlay import find_overlay, to_bytes
from nerg_mi.figures.style import figure_of
from nerg_mi.files.images import write_exr
from nerg_mi.transport import aovs
from nerg_mi.viewer.layers import choose_range, choose_scale, colorize, format_legend, list_layers

from . import fields
from .scenes import (
    camera,
    center_rays,
    channels,
    constant,
    look_at,
    make_observer,
    named,
    picture,
    plugin,
    points,
    put,
    render,
    scene_with,
    still,
    stored,
    straight,
    with_field,
    with_gaze,
)

# ---- The table of AOVs: an AOV is one entry ----


@pytest.fixture
def table(rgb):
    """The table, extended by a test."""
    before = dict(aovs.AOVS)
    yield aovs
    aovs.AOVS.clear()
    aovs.AOVS.update(before)


def test01_new_aov_needs_one_entry(rgb, files, table):
    entry = table.Aov(
        name="height",
        channels="ZT",
        summary="of the surface above the plane z = -1, and the distance to it",
        compute=lambda p: [dr.select(p.has_surface, p.p_d.z + 1, 0), p.depth],
        dependencies=(table.FIELD,),
    )
    table.AOVS["height"] = entry
    integrator = with_field(files, aovs="position,height,depth")
    out = channels(rgb, integrator)
    assert list(out)[3:5] == ["height.Z", "height.T"]
    has_surface = out["position.Z"] != 0
    assert has_surface.sum() > 20
    np.testing.assert_allclose(out["height.Z"][has_surface], out["position.Z"][has_surface] + 1, rtol=1e-5)
    assert not out["height.Z"][~has_surface].any() and np.array_equal(out["height.T"], out["depth.T"])
    with pytest.raises(RuntimeError, match='"aovs".*"height".*"field"'):
        rgb.load_dict(constant(aovs="height"))
    assert "- ``height`` (``.Z .T``): of the surface above the plane" in table.format_manual()


def test02_manual_lists_all_aovs(rgb, table):
    rgb.load_dict(constant())
    manual = sys.modules["nerg_mi.plugins.nerg"].NergIntegrator.__doc__
    assert table.format_manual() in manual and not any(w in manual for w in ("{aovs}", "{depths}", "{quadratures}"))
    for name, aov in table.AOVS.items():
        assert f"- ``{name}`` (" in manual and name == aov.name
    assert max(len(line) for line in table.format_manual().splitlines()) <= 120


def test03_every_aov_renders(rgb, files, table, tmp_path):
    """All AOVs of a field and a gaze field at once, with the declared numbers of channels."""
    eye = make_observer(rgb, -2, 0.3, -2)
    arguments = rgb.load_dict(with_gaze(files, observer=eye))
    names = [n for n, aov in table.AOVS.items() if all(need.is_satisfied(arguments) for need in aov.dependencies)]
    assert {"features", "gaze", "density_evals"} < set(names) and "gaze_std" not in names
    integrator = with_gaze(files, ",".join(names), observer=eye)
    scene = scene_with(rgb, integrator)
    out = named(rgb, picture(rgb, scene), integrator)
    assert all(np.isfinite(v).all() and v.any() for v in out.values()), [k for k, v in out.items() if not v.any()]
    factors = out["emit.Y"] * out["capture.Y"] * out["visibility.Y"]
    np.testing.assert_allclose(out["gaze.Y"], factors, rtol=1e-5)
    # Each alone equals its value among the others.
    for name in names:
        alone = channels(rgb, {**integrator, "aovs": name})
        for channel, value in alone.items():
            if not name.endswith("density_evals"):
                np.testing.assert_allclose(value, out[channel], rtol=1e-5, atol=1e-6, err_msg=channel)


def test04_unrequested_aovs_are_not_computed(rgb, files, table):
    """An entry costs nothing unless it is requested."""
    plain = operations(rgb, with_gaze(files, "depth"))
    calls = []
    table.AOVS["costly"] = table.Aov(
        name="costly",
        summary="many operations",
        compute=lambda p: (calls.append(p), [sum(dr.sin(p.depth * k) for k in range(400))])[1],
        required_data=frozenset({"counts", "features"}),
    )
    assert operations(rgb, with_gaze(files, "depth")) == plain and not calls
    assert operations(rgb, with_gaze(files, "depth,costly")) > plain + 400 and calls


@pytest.mark.parametrize("kind", ["sequential", "heat", "diverging", "categorical", "shade"])
def test05_new_aov_is_displayed_everywhere(rgb, table, tmp_path, kind):
    """With its title, scale and unit, without any other file that names it."""
    table.AOVS["rows"] = table.Aov(
        name="rows",
        title="Shelf row",
        label="row of the shelf",
        unit="rows",
        display=table.Display(kind=kind),
        summary="number of the row in which the surface lies",
        compute=lambda p: [dr.select(p.has_surface, dr.floor(p.p_d.z * 2 + 3), 0)],
    )
    scene = scene_with(rgb, constant())
    # Overlays, with the title, the label and the unit of the table.
    overlay = find_overlay("rows")
    layers = render_layers(Path("scene.xml"), scene, scene.sensors()[0], overlay)
    assert set(np.unique(layers.values[layers.mask])) <= set(range(9)) and layers.values.any()
    limits = overlay.limits(layers)
    if kind == "diverging":
        assert limits[0] == -limits[1]
    assert (limits is None) == (kind == "categorical")
    said = [axes.get_ylabel().replace("\n", " ") for axes in figure_of(overlay.draw(layers, limits)).axes]
    assert "row of the shelf [rows]" in said
    # The viewer, with the same colours.
    (layer,) = [la for la in list_layers(Scene(scene)) if la.title == "shelf row"]
    scale = choose_scale(layer, choose_range(layer, layers.values, layers.mask), None)
    shown = colorize(layer, layers.color, layers.values, layers.mask, scale, hatched=False)
    assert np.array_equal(shown[layers.mask], to_bytes(overlay.paint(layers, limits))[layers.mask])
    assert ("rows" if kind not in ("shade", "categorical") else "row of the shelf") in format_legend(layer, scale)
    # Files: sheets and differences.
    file = tmp_path / "a.exr"
    write_exr(file, {"rows.Y": layers.values, "opacity.Y": layers.mask.astype(np.float32)})
    said = [axes.get_ylabel().replace("\n", " ") for axes in draw_sheet(file, overlay="rows").axes]
    assert "row of the shelf [rows]" in said
    if kind == "categorical":
        with pytest.raises(NergError, match='"rows" is categorical'):
            draw_difference(file, file, channel="rows")
    else:
        said = [axes.get_ylabel() for axes in draw_difference(file, file, channel="rows").axes]
        assert any("difference of rows [rows]" in text.replace("\n", " ") for text in said)


# ---- Geometry features as AOVs: composited along the ray, and at the surface ----

STEP = 0.05


def block(out, name):
    keys = sorted((k for k in out if k.startswith(name + ".")), key=lambda k: int(k.split(".")[1]))
    return np.stack([out[k] for k in keys], -1)


def test01_composited_features_are_weighted_sums(rgb, files):
    """Against a float64 sum over the same steps of the field's own densities and features."""
    integrator = with_field(files, aovs="features,opacity,depth", step=STEP, color_cutoff=0.0, stop=0.0)
    sensor = still(camera(rgb, size=4))
    features = block(channels(rgb, integrator, sensor), "features").reshape(16, -1)
    medium = rgb.load_dict(integrator["field"]).medium()
    assert features.shape[-1] == medium.feature_count
    ray = center_rays(rgb, sensor)
    local = medium.ray_to_local(ray.o, ray.d)
    near, far = np.maximum(np.array(local.t_near, float), 0), np.array(local.t_far, float)
    T, total, t = np.ones(16), np.zeros_like(features, float), near.copy()
    while (t < far).any():
        inside, end = t < far, np.minimum(t + STEP, far)
        p = local.o + local.d * rgb.Float(np.where(inside, (t + end) / 2, 0).astype(np.float32))
        sigma, f = medium.density_features(p, rgb.Bool(inside))
        alpha = np.where(inside, -np.expm1(-np.array(sigma, float) * (end - t)), 0)
        total += (T * alpha)[:, None] * np.stack([np.array(v, float) for v in f], -1)
        T *= 1 - alpha
        t = end
    assert medium.occupancy is None and np.abs(total).max() > 0.05
    assert np.median(np.abs(features - total)) < 2e-4 * np.abs(total).max()
    assert np.abs(features - total).max() < 0.05 * np.abs(total).max()


def test02_color_does_not_depend_on_features(rgb, files):
    plain, both, dark = (
        render(rgb, with_field(files, aovs=f"opacity,depth{overrides}", radiance=lit))
        for overrides, lit in (("", True), (",features", True), (",features", False))
    )
    assert np.allclose(both[..., :5], plain[..., :5], atol=1e-6)
    assert not dark[..., :3].any() and np.allclose(dark[..., 5:], both[..., 5:], atol=1e-6)


def test03_features_at_the_surface_match_the_field(rgb, files):
    out = channels(rgb, with_field(files, aovs="position,features_at,opacity"))
    surface = out["opacity.Y"] >= 0.5
    medium = rgb.load_dict(with_field(files)["field"]).medium()
    p = rgb.Point3f(np.ascontiguousarray(points(out)[surface].T))
    expected = np.stack([np.array(f) for f in medium.density_features(p, True)[1]], -1)
    got = block(out, "features_at")
    assert surface.sum() > 10 and np.allclose(got[surface], expected, atol=2e-3 * np.abs(expected).max())
    assert not got[~surface].any()


def test04_shapes_have_no_features_and_occlude(rgb, files):
    wall = plugin("rectangle", to_world=look_at(rgb, (0.5, 0.4, -2), (0.5, 0.4, -3)).scale(9))
    out = channels(rgb, with_field(files, aovs="features,features_at,opacity"), w=wall)
    assert (out["opacity.Y"] == 1).all() and not block(out, "features").any() and not block(out, "features_at").any()


def test05_derivatives_reach_the_field(rgb, files):
    integrator = with_field(files, aovs="features,features_at", radiance=False, step=STEP, color_cutoff=0.0)
    # Primal and gradient must sample the same points of the pixels.
    scene = scene_with(rgb, integrator, still(camera(rgb, size=4)))
    params, key = rgb.traverse(scene), "integrator.field.density_net.1"
    start = rgb.TensorXf(params[key])

    def loss(value):
        put(params, key, value)
        image = rgb.render(scene, params, spp=1)
        return dr.sum(image[..., 3:] * image[..., 3:], axis=None)

    value, h = rgb.TensorXf(start), 1e-3
    dr.enable_grad(value)
    dr.backward(loss(value))
    gradient = np.array(dr.grad(value))
    size = np.linalg.norm(gradient)
    direction = rgb.TensorXf((gradient / size).astype(np.float32))
    ends = [loss(start + s * h * direction).numpy().item() for s in (1, -1)]
    assert size > 0 and (ends[0] - ends[1]) / (2 * h) == pytest.approx(size, rel=0.03)


# ---- Unneeded values are not computed: counts of traced operations and evaluations, not times ----


def operations(mi, integrator, sensor=None):
    scene = scene_with(mi, integrator, sensor)
    mi.render(scene, spp=1)  # one-time set-up is not counted
    return count_traced_operations(lambda: mi.render(scene, spp=1))


def test01_no_colour(rgb, files):
    dark, lit = (with_field(files, radiance=r, aovs="depth,opacity") for r in (False, True))
    assert operations(rgb, dark) < 0.75 * operations(rgb, lit)
    evals = channels(rgb, with_field(files, radiance=False, aovs="density_evals,color_evals"))
    assert evals["density_evals.Y"].max() > 5 and not evals["color_evals.Y"].any()


def test02_no_aovs_no_march(rgb, files):
    zeros, depth = (operations(rgb, with_field(files, radiance=False, aovs=a)) for a in ("", "depth"))
    assert zeros < 0.1 * depth


def test03_no_gaze_unless_requested(rgb, files):
    not_requested, requested = (
        operations(rgb, with_gaze(files, aovs)) for aovs in ("depth,opacity", "depth,opacity,gaze")
    )
    assert not_requested == operations(rgb, with_field(files, aovs="depth,opacity")) and requested > not_requested + 300


def test04_aligned_observer_needs_no_second_march(rgb, files):
    sensor, none = camera(rgb, (0.5, 0.4, -3)), with_gaze(files, "gaze,density_evals")
    local, moved = (none | {"observer": make_observer(rgb, *o)} for o in ((0.5, 0.4, -3), (-2, 0.3, -2)))
    a, b, c = (channels(rgb, i, sensor)["density_evals.Y"] for i in (none, local, moved))
    assert np.array_equal(a, b) and c.sum() > 1.3 * a.sum()
    first, second, third = (operations(rgb, i, sensor) for i in (none, local, moved))
    assert second < first + 60 and third > second + 300


def test05_no_observer_march_without_occlusion(rgb, files):
    aligned = with_gaze(files, "gaze,density_evals")
    off = aligned | {"observer": make_observer(rgb, -2, 0.3, -2), "occlusion": False}
    assert np.array_equal(*(channels(rgb, i)["density_evals.Y"] for i in (off, aligned)))
    assert operations(rgb, off) + 300 < operations(rgb, {**off, "occlusion": True})


def test06_single_factor_variants_evaluate_one_network(rgb, files, tmp_path):
    fields.gaze(tmp_path / "emit.safetensors", "emit")
    both = with_gaze(files, "gaze,gaze_evals")
    emit = {**both, "gaze": stored("gazefield", tmp_path / "emit.safetensors")}
    assert operations(rgb, emit) + 100 < operations(rgb, both)
    assert channels(rgb, emit)["gaze_evals.Y"].max() == 1 and channels(rgb, both)["gaze_evals.Y"].max() == 2


@pytest.mark.parametrize("thickness", [1, 4])
def test08_empty_space_is_skipped(rgb, thickness):
    # A sheet of a few voxels in an empty grid of 64: the sheet and one voxel on either side are marched.
    data = np.zeros((64, 64, 64), np.float32)
    data[30 : 30 + thickness] = 0.01
    density = {"type": "gridvolume", "grid": rgb.VolumeGrid(data)}
    integrator = {"type": "nerg", "density": density, "step": 1 / 256, "aovs": "density_evals"}
    evals = channels(rgb, integrator, straight(rgb, "perspective"))["density_evals.Y"].item()
    assert 4 * thickness <= evals <= 4 * (thickness + 2) + 2


def test10_missing_rays_cost_nothing(rgb, files):
    out = channels(rgb, with_gaze(files, "density_evals,color_evals,gaze_evals"), camera(rgb, (0, 0, -3), (0, 5, -2)))
    assert not any(c.any() for c in out.values())


def test11_rendering_imports_neither_torch_nor_matplotlib_nor_scipy_stats(files):
    code = f"""
import sys, nerg_mi, mitsuba as mi
mi.set_variant("llvm_ad_rgb")
scene = mi.load_dict({{"type": "scene", "integrator": {{"type": "nerg", "aovs": "depth,gaze",
    "field": {{"type": "nerf", "filename": r"{files / "field.safetensors"}"}},
    "gaze": {{"type": "gazefield", "filename": r"{files / "gaze.safetensors"}"}}}},
    "sensor": {{"type": "perspective", "film": {{"type": "hdrfilm", "width": 4, "height": 4}}}}}})
mi.render(scene, spp=1).numpy()
print([m for m in ("torch", "matplotlib", "scipy.stats") if m in sys.modules])
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
