"""The volume `splats` in the integrator: against Mitsuba's own splat renderer, and with shapes and observers."""

import re
from dataclasses import replace

import drjit as dr
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from nerg_mi.fields.splats import Splats, concatenate_splats, harmonics_from_colors
from nerg_mi.formats.splats import write_ply_splats
from nerg_mi.maths.color import decode_srgb, encode_srgb
from nerg_mi.registration import get_plugin_class
from tests.conftest import ROOT
from tests.formats.splats.writers import random_splats

from .scenes import camera, look_at, picture, stored
from .scenes import render as draw


@pytest.fixture
def render(rgb, tmp_path):
    """The image of splats by `nerg`, by channel name."""

    def rendered(splats, sensor=None, others=(), field=(), **parameters):
        write_ply_splats(tmp_path / "a.ply", splats)
        place = stored("splats", tmp_path / "a.ply", **dict(field))
        integrator = {"type": "nerg", "field": place, **parameters}
        image = draw(rgb, integrator, sensor, **dict(others))
        names = rgb.load_dict(integrator).aov_names()
        # All channels of an AOV together; a single one without an axis.
        result: dict = {}
        for name, value in zip(names, np.moveaxis(image[..., image.shape[-1] - len(names) :], -1, 0)):
            result.setdefault(name.split(".")[0], []).append(value)
        result = {name: v[0] if len(v) == 1 else np.stack(v, axis=-1) for name, v in result.items()}
        return result | {"color": image[..., :3]}

    return rendered


def wall(z=0.0, opacity=0.99, half=2.0, spacing=0.08, color=(0.2, 0.5, 0.8)):
    """A square of flat Gaussians at ``z``, across the z axis."""
    x = np.arange(-half, half + 1e-6, spacing)
    grid = np.stack(np.meshgrid(x, x, [z], indexing="ij"), axis=-1).reshape(-1, 3)
    n = len(grid)
    scales = np.tile([spacing, spacing, 1e-3], (n, 1))
    return Splats(grid, scales, [[1, 0, 0, 0]] * n, np.full(n, opacity), harmonics_from_colors(np.tile(color, (n, 1))))


def of_mitsuba(mi, path, sensor):
    """The sum of the colours, linear as it is."""
    scene = {"type": "scene", "i": {"type": "volprim_rf_basic"}, "s": sensor, "e": {"type": "ellipsoids"}}
    scene["e"]["filename"] = str(path)
    return encode_srgb(picture(mi, mi.load_dict(scene))[..., :3])


def test_colors_match_volprim_rf_basic(rgb, tmp_path, render):
    # Spheres of one size, few and thin: Mitsuba's renderer stops at a hundredth of the light, and sorts overlapping
    # ones by their shells.
    some = random_splats(25, degree=3)
    scales = np.full((25, 3), 0.12)
    some = Splats(some.centers, scales, some.rotations, 0.4 * some.opacities, some.harmonics)
    ours = render(some, aovs="opacity", sensor=camera(rgb, size=32))
    opacity = ours["opacity"][..., None]
    sums = opacity * encode_srgb(ours["color"] / np.maximum(opacity, 1e-9))
    difference = np.abs(sums - of_mitsuba(rgb, tmp_path / "a.ply", camera(rgb, size=32))).max(-1)[opacity[..., 0] > 0]
    assert len(difference) > 300 and np.median(difference) < 1e-6 and (difference < 1e-4).mean() > 0.9


@pytest.mark.parametrize("border", [False, True])
def test_lists_change_images_by_less_than_a_grey_level(rgb, render, border):
    some = concatenate_splats([wall(z=-0.6, half=1.5, spacing=0.06), wall(opacity=0.7, half=1.5, spacing=0.06)])
    assert len(some) > 4096
    settings = {"aovs": "depth,opacity,visibility", "observer": camera(rgb, (1.5, 1, 3))}
    film = {"type": "hdrfilm", "width": 64, "height": 32}
    around = {"type": "panorama", "to_world": look_at(rgb, (0.3, 0.2, -1.5)), "film": film}
    for sensor in (camera(rgb, size=48, rfilter="gaussian" if border else "box"), around):
        exact = render(some, sensor, field={"lists": False}, **settings)
        listed = render(some, sensor, **settings)
        for name in ("color", "opacity"):
            # Faint Gaussians are left out, so that lists that are not used are noticed.
            assert 0 < np.abs(listed[name] - exact[name]).max() < 1 / 255
        seen = exact["opacity"] > 0.05
        np.testing.assert_allclose(listed["depth"][seen], exact["depth"][seen], atol=1e-3)
        assert (np.abs(listed["visibility"] - exact["visibility"]) > 0.01).mean() < 0.002


def test_each_gaussian_is_hit_once(rgb, tmp_path, render):
    # Mitsuba 3.9.1 hits a thin one twice at grazing angles: its next ray starts outside again.
    one = Splats([[0, 0, 0]], [[0.3, 0.05, 0.1]], [[0.8, 0.3, 0.4, 0.2]], [0.5], harmonics_from_colors([[1, 1, 1]]))
    opacity = render(one, aovs="opacity", sensor=camera(rgb, size=64))["opacity"]
    theirs = of_mitsuba(rgb, tmp_path / "a.ply", camera(rgb, size=64))[..., 0]
    # Within the rim, where both cut it off.
    has_surface = opacity > 0
    theirs, opacity = theirs[has_surface], opacity[has_surface]
    twice = theirs > 1.2 * opacity
    assert has_surface.sum() > 500 and twice.mean() < 0.05 and np.allclose(theirs[~twice], opacity[~twice], atol=1e-5)
    assert np.allclose(theirs[twice], 1 - (1 - opacity[twice]) ** 2, atol=1e-5)


def test_wall_depth_for_camera_and_observer(rgb, render):
    result = render(
        wall(),
        aovs="depth,opacity,position,visibility,observer_depth",
        observer={"type": "perspective", "to_world": look_at(rgb, (1, 0.5, -2), (0, 0, 0))},
    )
    assert result["opacity"].min() > 0.99
    assert np.abs(result["position"][..., 2]).max() < 2e-3
    # From the near plane on.
    assert np.allclose(result["depth"], np.linalg.norm(result["position"] - [0.5, 0.4, -3], axis=-1), atol=0.02)
    assert result["visibility"].min() == 1
    assert np.allclose(decode_srgb(np.array([0.2, 0.5, 0.8])), result["color"].mean((0, 1)), atol=1e-3)


@pytest.mark.parametrize("visibility", ["depth", "transmittance", "map"])
def test_splats_occlude(rgb, render, visibility):
    back, front = wall(), wall(-1, half=0.6)
    both = concatenate_splats([back, front])
    # The camera looks at the far wall below the near one, behind which the observer is.
    observer = {"type": "perspective", "to_world": look_at(rgb, (0, 0, -3), (0, 0, 0))}
    sensor = camera(rgb, (0, 0, -0.5), (0, 0, 0), fov=140)
    result = render(
        both, sensor, aovs="position,visibility", observer=observer, visibility=visibility, falloff=0.0, map_height=256
    )
    x, y = np.abs(result["position"][..., :2]).max(-1), result["visibility"]
    inside = (x < 1.9) & (np.abs(result["position"][..., 2]) < 0.01)
    # A shadow on a surface at 3 of one at 2; its rim is as soft as the last Gaussians.
    assert y[inside & (x < 0.75)].max() < 0.05 and y[inside & (x > 1.3)].min() > 0.95
    assert (inside & (x < 0.75)).sum() > 3 and (inside & (x > 1.3)).sum() > 3


def test_camera_inside_gaussians(rgb, render):
    # A haze around camera and wall: its peak is behind the camera on one side, in front of it on the other.
    haze = Splats([[0.5, 0.4, -2.5]], [[3, 3, 3]], [[1, 0, 0, 0]], [0.5], harmonics_from_colors([[1, 1, 1]]))
    result = render(haze, aovs="opacity,depth")
    assert result["opacity"].min() > 0.4 and result["depth"].max() <= 0.5
    away = render(haze, camera(rgb, (0.5, 0.4, -2), (0.5, 0.4, 0)), aovs="opacity")
    assert away["opacity"].max() == 0


def test_shapes_and_splats_occlude_each_other(rgb, render):
    ball = {"ball": {"type": "sphere", "radius": 0.5, "center": [0, 0, 1]}}
    behind = render(wall(opacity=0.3), others=ball, aovs="depth,opacity")
    middle = behind["depth"].shape[0] // 2
    assert behind["opacity"][middle, middle] == 1 and behind["depth"][middle, middle] < 3.1
    ball["ball"]["center"] = [0, 0, -1]
    before = render(wall(), others=ball, aovs="depth")
    assert np.isclose(before["depth"][middle, middle], np.linalg.norm([0.5, 0.4, 2]) - 0.5, atol=0.02)


def test_rotated_splats_rotate_colors(rgb, render):
    splats = random_splats(25, degree=3, size=0.15)
    turn = Rotation.random(random_state=np.random.default_rng(4)).as_matrix()
    matrix = np.eye(4)
    matrix[:3, :3] = 2 * turn
    to_world = rgb.ScalarTransform4f(matrix)
    eye, target = np.array([0.5, 0.4, -3]), np.zeros(3)
    local = render(splats, aovs="depth,opacity")
    up = turn @ [0, 1, 0]
    moved = camera(rgb) | {"to_world": look_at(rgb, 2 * turn @ eye, target, up)}
    other = render(splats, moved, field={"to_world": to_world}, aovs="depth,opacity")
    assert np.abs(other["color"] - local["color"]).max() < 1e-4
    # Rays start at the near plane, which has not been scaled.
    assert np.allclose(other["depth"], 2 * local["depth"], atol=0.02)


def test_image_derivatives(rgb, tmp_path):
    write_ply_splats(tmp_path / "a.ply", random_splats(20, degree=0, size=0.2))
    place = stored("splats", tmp_path / "a.ply")
    scene = rgb.load_dict({"type": "scene", "i": {"type": "nerg", "id": "i", "field": place}, "s": camera(rgb)})
    params = rgb.traverse(scene)
    key = next(k for k in params.keys() if k.endswith("field.opacities"))
    before = rgb.Float(params[key])
    value = rgb.Float(before)
    dr.enable_grad(value)
    params[key] = value
    params.update()
    dr.backward(dr.mean(rgb.render(scene, params, spp=1, seed=0)[:, :, :4], axis=None))
    result = float(dr.sum(dr.grad(value))[0])
    ends = []
    for sign in (1, -1):
        params[key] = before + sign * 1e-3
        params.update()
        ends.append(np.array(rgb.render(scene, params, spp=1, seed=0), np.float64)[..., :4].mean())
    assert abs(result) > 1e-2 and np.isclose(result, (ends[0] - ends[1]) / 2e-3, rtol=2e-2)


def test_fitting_page_example_runs(rgb, tmp_path, monkeypatch):
    """The block of docs/how-to/environments.md."""
    write_ply_splats(tmp_path / "store.ply", random_splats(20, degree=0, size=0.2))
    monkeypatch.chdir(tmp_path)
    page = (ROOT / "docs" / "how-to" / "exchange.md").read_text("utf-8")
    (text,) = [block for block in re.findall(r"^```python\n(.*?)^```", page, re.M | re.S) if '"splats"' in block]
    names: dict = {}
    exec(compile(text, "exchange.md", "exec"), names)
    losses = [loss.numpy().item() for loss in names["losses"]]
    assert len(losses) == 4 and losses[-1] < 0.9 * losses[0]


def test_extreme_splats_give_finite_images(rgb, tmp_path):
    # Needles, pancakes, points and haloes, many of them overlapping and barely visible; the camera is inside.
    rng = np.random.default_rng(5)
    n = 300
    sizes = np.array([[1e-6] * 3, [1e-6, 1e-6, 1], [1e-6, 1, 1], [1e3] * 3, [1e3, 1e-6, 1e3], [0.3] * 3])
    opacities = rng.choice([0, 1e-3, 0.05, 1], n)
    colors = harmonics_from_colors(rng.uniform(-1, 2, (n, 3)))
    some = Splats(rng.normal(0, 1, (n, 3)), rng.choice(sizes, n), rng.normal(size=(n, 4)), opacities, colors)
    place = get_plugin_class("splats").from_network(some)
    integrator = {"type": "nerg", "id": "i", "field": place, "aovs": "depth,opacity,position"}
    scene = rgb.load_dict({"type": "scene", "i": integrator, "s": camera(rgb, (0, 0, 0), (0.3, 0.2, 1), size=8)})
    params = rgb.traverse(scene)
    for name in ("centers", "scales", "rotations", "opacities", "harmonics"):
        dr.enable_grad(params[f"i.field.{name}"])
    params.update()
    picture = rgb.render(scene, params, spp=1)
    result = np.array(picture)
    assert np.isfinite(result).all() and result[..., 4].min() >= 0 and result[..., 4].max() <= 1
    assert result[..., 4].max() > 0.1
    dr.backward(dr.mean(picture, axis=None))
    for name in ("centers", "scales", "rotations", "opacities", "harmonics"):
        grad = np.array(dr.grad(params[f"i.field.{name}"]))
        assert np.isfinite(grad).all(), (name, (~np.isfinite(grad)).sum())


def test_volume_to_string(rgb, tmp_path):
    write_ply_splats(tmp_path / "a.ply", wall())
    volume = rgb.load_dict(stored("splats", tmp_path / "a.ply", color_space="linear"))
    assert "count = 2601" in str(volume) and volume.medium().color_space == "linear"
    assert np.allclose(np.array(volume.bbox().max).ravel(), [2.24, 2.24, 0.003], atol=1e-3)
    params = rgb.traverse(volume)
    params["centers"] = params["centers"] + 1
    params.update()
    assert np.allclose(np.array(volume.bbox().max).ravel(), [3.24, 3.24, 1.003], atol=1e-3)
    with pytest.raises(Exception, match="no density at a point"):
        volume.eval_1(rgb.Interaction3f())
    kind = get_plugin_class("splats")
    assert kind.from_network(replace(wall(), color_space="linear")).medium().color_space == "linear"
    assert "in memory" in str(kind.from_network(wall()))
    with pytest.raises(Exception, match="expected splats in memory"):
        kind.from_network(3)
    with pytest.raises(RuntimeError, match="lacks the column"):
        (tmp_path / "b.ply").write_text("ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nend_header\n1\n")
        rgb.load_dict(stored("splats", tmp_path / "b.ply"))
