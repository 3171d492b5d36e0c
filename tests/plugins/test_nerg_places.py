"""Shapes, a field, and both, under everything that Mitsuba puts around an integrator: each picture against closed
forms, against Mitsuba's own integrators, or against the same place built in another way."""

import numpy as np
import pytest

from .closed_form import AOVS, closed_form, nerg
from .scenes import camera, channels, constant, look_at, named, observer_at, render
from .test_nerg_shapes import center_only, sphere, square

EYE = (-2, 0.3, -2)
COLOR = (0.9, 0.4, 0.1)


def film(**kwargs):
    return {
        "type": "hdrfilm",
        "width": 12,
        "height": 12,
        "component_format": "float32",
        "pixel_format": "rgb",
        "rfilter": {"type": "box"},
        **kwargs,
    }


def furniture(mi):
    """A ball inside of the unit box's field, half a board behind it, and a board that casts a shadow from ``EYE``."""
    return {
        "ball": sphere(mi, 0.5, 0, 0.2, radius=0.4),
        "back": square(mi, 1.4, 0.8, x=-0.4),
        "lid": square(mi, -0.2, 0.25, x=-0.6),
    }


def sensors(mi):
    crop = dict(crop_offset_x=3, crop_offset_y=5, crop_width=6, crop_height=4)
    ortho = look_at(mi, (0.5, 0.4, -3)) @ mi.ScalarTransform4f().scale(1.5)
    return {
        "perspective": camera(mi),
        "crop": camera(mi, film=crop),
        "thinlens": camera(mi, kind="thinlens", fov=35, aperture_radius=0.15, focus_distance=3.0),
        "orthographic": {**camera(mi, kind="orthographic"), "to_world": ortho},
        "batch": {
            "type": "batch",
            "film": film(height=6),
            **{f"c{i}": camera(mi, o, size=6) for i, o in enumerate([(0.5, 0.4, -3), (-2.5, 0.2, -1)])},
        },
        "panorama": {
            "type": "panorama",
            "to_world": mi.ScalarTransform4f().translate([0, 0.1, -1.6]),
            "film": film(width=16, height=9),
        },
        "sample border": camera(mi, rfilter="gaussian", film=dict(sample_border=True)),
        "crop with a border": camera(mi, rfilter="gaussian", film=dict(sample_border=True, **crop)),
    }


SENSORS = [
    "perspective",
    "crop",
    "thinlens",
    "orthographic",
    "batch",
    "panorama",
    "sample border",
    "crop with a border",
]


def both_ways(mi, sensor, things, *place, spp=2, **kwargs):
    """The picture of `nerg`, the closed form's, and the latter's channels by name."""
    scene = mi.load_dict({"type": "scene", "sensor": sensor, **things})
    a = np.array(mi.render(scene, integrator=mi.load_dict(nerg(mi, *place, **kwargs)), spp=spp, seed=3))
    b = np.array(mi.render(scene, integrator=closed_form(mi, *place, **kwargs), spp=spp, seed=3))
    return a, b, dict(zip(AOVS, np.moveaxis(b[..., 3:], -1, 0)))


@pytest.mark.parametrize("kind", SENSORS)
def test01_every_sensor_sees_shapes_in_a_field(rgb, kind):
    a, b, known = both_ways(rgb, sensors(rgb)[kind], furniture(rgb), 1.0, COLOR, EYE)
    assert np.allclose(a, b, atol=2e-4)
    seen = known["visibility.Y"]
    assert np.ptp(seen) > 0.1 and seen.max() > 0.3 and np.ptp(known["depth.T"]) > 0.2


@pytest.mark.parametrize("kind", ["orthographic", "batch"])
@pytest.mark.parametrize("sigma", [0, 4.0])
def test02_every_sensor_sees_shapes_alone_and_a_field_alone(rgb, kind, sigma):
    things = {} if sigma else furniture(rgb)
    a, b, known = both_ways(rgb, sensors(rgb)[kind], things, sigma, COLOR, EYE, depth="median")
    assert np.allclose(a, b, atol=2e-4) and np.ptp(known["visibility.Y"]) > 0.1


@pytest.mark.parametrize("kind", ["thinlens", "batch", "panorama"])
def test03_without_an_observer_it_is_the_camera(rgb, kind):
    """Whatever has a surface is visible to it, and it stands at the centre of the camera that a ray comes from."""
    sensor = sensors(rgb)[kind]
    a, b, _ = both_ways(rgb, sensor, furniture(rgb), 1.0, COLOR, None)
    assert np.allclose(a, b, atol=2e-4)
    out = channels(rgb, nerg(rgb, 1.0, COLOR, None) | {"aovs": "position,observer_depth"}, sensor, **furniture(rgb))
    p = np.stack([out[f"position.{c}"] for c in "XYZ"], -1)
    first = (0.5, 0.4, -3)
    centers = {"panorama": [(0, 0.1, -1.6)], "batch": [first, (-2.5, 0.2, -1)], "thinlens": [first]}[kind]
    width = p.shape[1] // len(centers)
    for i, c in enumerate(centers):
        part = np.s_[:, i * width : (i + 1) * width]
        met = p[part].any(-1)
        distance = np.linalg.norm(p[part] - c, axis=-1)
        assert met.any() and np.allclose(out["observer_depth.T"][part][met], distance[met], rtol=1e-4)


@pytest.mark.parametrize("light", ["path", "direct"])
def test04_emitters_and_the_sky_light_shapes_and_are_the_background(rgb, light):
    """`path` is the default of a scene with emitters. Equal seeds: the same paths."""
    sky = {"type": "constant", "radiance": {"type": "rgb", "value": [0.3, 0.5, 0.2]}}
    lamp = {"type": "sphere", "center": [0, 0.7, -0.5], "radius": 0.2, "e": {"type": "area", "radiance": 3.0}}
    things = {**furniture(rgb), "sky": sky, "lamp": lamp}
    a, b, _ = both_ways(rgb, camera(rgb, fov=90), things, 0.5, COLOR, EYE, light=light)
    assert np.allclose(a, b, atol=2e-4) and a[..., 0].max() > 1.5
    assert np.allclose(a[0, 0, :3], [0.3, 0.5, 0.2], atol=1e-5)


def boxes(mi):
    T = mi.ScalarTransform4f
    return [
        T().translate([-0.5, 0.3, -0.3]).rotate([0, 1, 0], 30),
        T().translate([0.4, -0.3, 0.2]).rotate([1, 0, 0], 50),
    ]


@pytest.mark.parametrize("kind", ["depth", "map"])
def test05_instances_are_what_they_stand_for(rgb, kind):
    group = {"type": "shapegroup", "a": {"type": "cube", "to_world": rgb.ScalarTransform4f().scale(0.25)}}
    instances = {
        f"i{i}": {"type": "instance", "to_world": t, "g": {"type": "ref", "id": "group"}}
        for i, t in enumerate(boxes(rgb))
    }
    plain = {
        f"c{i}": {"type": "cube", "to_world": t @ rgb.ScalarTransform4f().scale(0.25)} for i, t in enumerate(boxes(rgb))
    }
    integrator = constant(
        0.3,
        aovs="depth,opacity,position,visibility",
        visibility=kind,
        map_height=64,
        falloff=0.0,
        observer=observer_at(rgb, *EYE),
    )
    a = render(rgb, integrator, group=group, **instances, back=square(rgb, 1.4, 1.5))
    b = render(rgb, integrator, **plain, back=square(rgb, 1.4, 1.5))
    assert np.mean(np.abs(a - b) > 1e-4) < 0.005 and 0.1 < named(rgb, b, integrator)["visibility.Y"].mean() < 0.95


def mover(mi, name):
    """A shape, the key that moves it, the value to move it to, and the shape as it then is."""
    t = mi.ScalarTransform4f().translate([-0.4, 0.2, 0.1]).rotate([0, 1, 0], 20).scale(0.35)
    group = {"type": "shapegroup", "cube": {"type": "cube", "to_world": mi.ScalarTransform4f().scale(0.5)}}
    instance = {
        "type": "instance",
        "to_world": mi.ScalarTransform4f().translate([0.3, 0, 0]),
        "g": {"type": "ref", "id": "group"},
    }
    if name == "instance":
        return {"group": group, "it": instance}, "it.to_world", {"group": group, "it": {**instance, "to_world": t}}
    if name == "group":
        after = {**group, "cube": {"type": "cube", "to_world": t}}
        return {"group": group, "it": instance}, "group.cube.vertex_positions", {"group": after, "it": instance}
    if name == "mesh":
        return {"it": {"type": "cube"}}, "it.vertex_positions", {"it": {"type": "cube", "to_world": t}}
    return {"it": {"type": name}}, "it.to_world", {"it": {"type": name, "to_world": t}}


@pytest.mark.parametrize("kind", ["depth", "map"])
@pytest.mark.parametrize("name", ["sphere", "rectangle", "instance", "mesh", "group"])
def test06_what_moves_is_seen_where_it_is(rgb, name, kind):
    before, key, after = mover(rgb, name)
    integrator = {
        "type": "nerg",
        "aovs": "depth,visibility",
        "visibility": kind,
        "map_height": 64,
        "falloff": 0.0,
        "observer": observer_at(rgb, *EYE),
    }
    description = {"type": "scene", "integrator": integrator, "sensor": camera(rgb), "back": square(rgb, 1.4, 1.5)}
    moved, new = (rgb.load_dict(description | things) for things in (before, after))
    first = np.array(rgb.render(moved, spp=1))
    params, there = rgb.traverse(moved), rgb.traverse(new)
    params[key] = there[key]
    params.update()
    a, b = (np.array(rgb.render(s, spp=1)) for s in (moved, new))
    assert np.allclose(a, b, atol=1e-4) and np.mean(np.abs(a - first)[..., 4] > 0.5) > 0.02


def test07_textures(rgb):
    """By hand: a board that fills the picture shows its bitmap (v runs upwards)."""
    texels = np.random.default_rng(0).random((6, 6, 3)).astype(np.float32)
    texture = {"type": "bitmap", "bitmap": rgb.Bitmap(texels), "raw": True, "filter_type": "nearest"}
    board = {"type": "rectangle", "bsdf": {"type": "diffuse", "reflectance": texture}}
    sensor = {**camera(rgb, kind="orthographic", size=6), "to_world": look_at(rgb, (0, 0, 3))}
    image = render(rgb, {"type": "nerg", "aovs": ""}, center_only(rgb, sensor), board=board)
    assert np.allclose(image[..., :3], texels[::-1], atol=1e-5)
    # As `aov` has the albedo, also where it is turned and repeated.
    texture["to_uv"] = rgb.ScalarTransform4f().scale([3, 2, 1])
    things = {
        "board": {
            **board,
            "to_world": rgb.ScalarTransform4f().rotate([0.5, 1, 0], 160),
            "bsdf": {"type": "twosided", "b": {"type": "principled", "base_color": texture}},
        },
        "ball": {
            **sphere(rgb, 0.7, 0, -0.7, radius=0.4),
            "bsdf": {"type": "diffuse", "reflectance": {"type": "checkerboard"}},
        },
    }
    albedo = render(rgb, {"type": "aov", "aovs": "a:albedo"}, **things)
    image = render(rgb, {"type": "nerg", "aovs": ""}, **things)
    assert np.allclose(image[..., :3], albedo[..., -3:], atol=1e-5) and np.ptp(image[..., 0]) > 0.5


def test08_inside_of_aov_and_moment(rgb):
    inner, things, spp = nerg(rgb, 1.0, COLOR, EYE), furniture(rgb), 4
    plain = render(rgb, inner, spp=spp, **things)
    around = render(rgb, {"type": "aov", "aovs": "z:depth", "nerg": nerg(rgb, 0, COLOR, EYE)}, spp=spp, **things)
    z = named(rgb, render(rgb, nerg(rgb, 0, COLOR, EYE), spp=spp, **things), inner)["depth.T"]
    # `aov` puts the inner picture first and its own channels last.
    assert np.allclose(around[..., 3], z, atol=1e-5) and np.allclose(around[..., -1], z, atol=1e-5)
    moment = {"type": "moment", "in": inner}
    names, image = rgb.load_dict(moment).aov_names(), render(rgb, moment, spp=spp, **things)
    single = render(rgb, closed_form(rgb, 1.0, COLOR, EYE), seed=1, spp=64, **things)[..., 3:]
    for i, name in enumerate(AOVS):
        first, second = (image[..., 3 + names.index(f"{p}in.{name}")] for p in ("", "m2_"))
        assert np.allclose(first, plain[..., 3 + i], atol=1e-5)
        # E[x^2] >= E[x]^2, and equal where a pixel sees one thing only.
        assert (second >= first**2 - 1e-4).all() and np.mean(np.abs(second - first**2) < 0.05) > 0.3
        assert np.allclose(first.mean(), single[..., i].mean(), atol=0.08)


def test09_channels_of_a_nested_integrator_survive_in_any_order(rgb):
    nested = {"type": "aov", "aovs": "n:sh_normal,z:depth", "img": {"type": "direct"}}
    sky = {"type": "constant"}
    outer = {"type": "moment", "in": nerg(rgb, 0.5, COLOR, EYE) | {"aovs": "opacity,depth", "lit": nested}}
    names = rgb.load_dict(outer).aov_names()
    out = dict(zip(names, np.moveaxis(render(rgb, outer, ball=furniture(rgb)["ball"], sky=sky)[..., 3:], -1, 0)))
    known = render(rgb, {"type": "aov", "aovs": "n:sh_normal,z:depth"}, ball=furniture(rgb)["ball"])
    hit = known[..., -1] > 0
    assert np.allclose(out["in.z.T"], known[..., -1], atol=1e-5) and hit.sum() > 5
    assert all(np.allclose(out[f"in.n.{c}"][hit], known[..., -4 + i][hit], atol=1e-5) for i, c in enumerate("XYZ"))
    assert np.allclose(out["m2_in.z.T"], known[..., -1] ** 2, rtol=1e-4) and (out["in.opacity.Y"][hit] == 1).all()


@pytest.mark.parametrize("sky", [False, True])
@pytest.mark.parametrize("hide", [False, True])
def test10_alpha_is_that_of_other_integrators(rgb, sky, hide):
    """The film's alpha: the share of samples that meet anything, or an environment that shows."""
    more = {"sky": {"type": "constant"}} if sky else {}
    sensor = camera(rgb, film={"pixel_format": "rgba"})
    path = {"type": "path", "hide_emitters": hide}
    more["ball"] = sphere(rgb, 0, 0, 0)
    for nested in ({}, {"lit": {"type": "direct", "hide_emitters": hide}}):
        known = render(rgb, nested.get("lit", path), sensor, spp=4, **more)[..., 3]
        ours = render(rgb, {"type": "nerg", "aovs": "opacity", "hide_emitters": hide, **nested}, sensor, spp=4, **more)
        assert np.array_equal(ours[..., 3], known)
        assert 0 < ours[..., 4].mean() < 0.5
    del more["ball"]
    thin = render(rgb, constant(0.2, aovs="opacity", hide_emitters=hide), sensor, **more)
    met = thin[..., 4] > 0
    assert np.array_equal(thin[..., 3], np.where(met | (sky and not hide), 1, 0)) and thin[..., 4].max() < 0.5


def test11_hidden_emitters_are_hidden_from_the_picture_only(rgb):
    """As in Mitsuba: `path` sees through a lamp, `depth` meets it."""
    things = {
        "lamp": {"type": "sphere", "radius": 0.5, "e": {"type": "area", "radiance": 2.0}},
        "back": square(rgb, 1.0, 2.0),
    }
    image = render(rgb, {"type": "nerg", "aovs": "depth", "hide_emitters": True}, **things)
    assert np.allclose(image[..., 3], render(rgb, {"type": "depth"}, **things)[..., 0], atol=1e-5)
    assert np.allclose(image[..., :3], render(rgb, {"type": "path", "hide_emitters": True}, **things), atol=1e-5)
    assert image[..., :3].max() < 1.9


def test12_what_is_far_away_does_not_blunt_shadows(rgb):
    """A lid 20 cm before a wall hides it by a hard edge, also under a dome of a kilometre (1e-4 of its diagonal are 35
    cm)."""
    integrator = {"type": "nerg", "aovs": "visibility,position", "falloff": 0.0, "observer": observer_at(rgb, 0, 0, -1)}
    sensor = camera(rgb, (3.0, 0, -1), (0, 0, 1), fov=40, size=24)
    things = {"wall": square(rgb, 1.0, 3.0), "lid": square(rgb, 0.8, 0.5)}
    for dome in (
        {},
        {"dome": {"type": "sphere", "radius": 1000.0, "bsdf": {"type": "twosided", "b": {"type": "diffuse"}}}},
    ):
        out = channels(rgb, integrator, sensor, **things, **dome)
        reach = np.maximum(np.abs(out["position.X"]), np.abs(out["position.Y"]))
        on_wall = np.abs(out["position.Z"] - 1) < 1e-3
        hidden, seen = on_wall & (reach < 0.55), on_wall & (reach > 0.56) & (reach < 2.9)
        assert hidden.sum() > 10 and seen.sum() > 100
        assert (out["visibility.Y"][hidden] == 0).all() and (out["visibility.Y"][seen] == 1).all()


def test13_media_of_mitsuba_light_shapes_through_a_nested_volpath(rgb):
    """Around shapes, and around the camera itself: the same paths as those of `volpath`."""
    fog = {"type": "homogeneous", "sigma_t": 0.4, "albedo": 0.5}
    things = {"back": square(rgb, 1.4, 1.5), "lamp": {"type": "point", "position": [1, 1, -1], "intensity": 9.0}}
    cloud = {
        "cloud": {
            "type": "cube",
            "to_world": rgb.ScalarTransform4f().scale(0.6),
            "bsdf": {"type": "null"},
            "interior": fog,
        }
    }
    for sensor, more in ((camera(rgb), cloud), ({**camera(rgb), "medium": fog}, {})):
        known = render(rgb, {"type": "volpath"}, sensor, spp=2, seed=2, **things, **more)
        ours = render(
            rgb, {"type": "nerg", "aovs": "depth", "lit": {"type": "volpath"}}, sensor, spp=2, seed=2, **things, **more
        )
        assert np.allclose(ours[..., :3], known, atol=1e-5) and np.ptp(known) > 0.05


def said(error) -> str:
    """The messages of an error and of all that it comes from: ``mi.render`` puts one of its own around."""
    text = ""
    while error is not None:
        text, error = text + str(error), error.__cause__ or error.__context__
    return text


@pytest.mark.parametrize("around", ["aov", "moment"])
def test14_nothing_to_render_is_said_inside_of_other_integrators_too(rgb, around):
    outer = {"type": around, "in": {"type": "nerg"}, **({"aovs": "z:depth"} if around == "aov" else {})}
    with pytest.raises(Exception) as error:
        render(rgb, outer)
    assert "there is nothing to render" in said(error.value)


def test15_a_mesh_without_faces_is_named(rgb):
    integrator = {"type": "nerg", "aovs": "visibility", "observer": observer_at(rgb, *EYE)}
    with pytest.raises(Exception) as error:
        render(rgb, integrator, ball=sphere(rgb, 0, 0, 0), leftover=rgb.Mesh("leftover", 0, 0))
    assert 'the mesh "leftover" has no faces' in said(error.value)
