"""Shapes, a field, and both, in all of Mitsuba's contexts of an integrator: each image against closed forms, Mitsuba's
own integrators, or an equivalent scene."""

import drjit as dr
import numpy as np
import pytest

from nerg_mi.transport.mitsuba_mesh import positions_key

from .scenes import (
    camera,
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
    sphere,
    square,
    still,
)

EYE = (-2, 0.3, -2)
COLOR = (0.9, 0.4, 0.1)
AOVS = ["depth.T", "opacity.Y", "position.X", "position.Y", "position.Z", "visibility.Y"]
TOLERANCE = 1e-3


def closed_form(mi, sigma, eye, depth="expected", light=None):
    """A reference integrator: shapes in a box of constant density, by one ray cast and closed forms.

    It shares no code with `nerg`: rays come from Mitsuba's sensors, distances from its ray casts, light on shapes from
    its integrators. `nerg` should return the same for each ray, for any film, sensor or enclosing integrator. Density
    `sigma` (0: vacuum) and `COLOR` from -1 to 1; visibility by transmittance to the point `eye` (None: everything with
    a surface is visible). `light`: the integrator that lights shapes; None: a headlight.
    """

    def crossing(o, d, end):
        """The part of a ray inside the box, up to `end`."""
        a, b = (-1 - o) / d, (1 - o) / d
        start = dr.maximum(dr.max(dr.minimum(a, b)), 0)
        return start, dr.maximum(dr.minimum(dr.min(dr.maximum(a, b)), end), start)

    class ClosedForm(mi.SamplingIntegrator):
        def __init__(self, props):
            super().__init__(props)
            self.light = mi.load_dict({"type": light}) if light else None

        def aov_names(self):
            return AOVS

        def sample(self, scene, sampler, ray, medium=None, active=True):
            si = scene.ray_intersect(mi.Ray3f(ray), active)
            hit, t = si.is_valid(), si.t
            a, b = crossing(ray.o, ray.d, t)
            T = dr.exp(-sigma * (b - a))
            front = 1 - T
            opacity = dr.select(hit, 1, front)
            if depth == "expected":
                first = a - T * b + front / sigma if sigma else mi.Float(0)
                z = dr.select(hit, first + T * t, first) / dr.select(opacity > 0, opacity, 1)
            else:
                # Where half of the ray's own opacity is reached, or the shape if the box transmits more than half.
                inside = a - dr.log(1 - 0.5 * opacity) / sigma if sigma else mi.Float(dr.inf)
                z = dr.select(hit & (T > 0.5), t, inside)
            z = dr.select(opacity > 0, z, 0)

            surface = opacity >= 0.5
            p = ray.o + ray.d * z
            visible = mi.Float(1)
            if eye is not None:
                # The target lies in front of the surface: by the tolerance and the penetration depth.
                paths = 1.0 if depth == "expected" else dr.log(2)
                fuzz = dr.select(front > 0.5, dr.minimum(paths / sigma, z / 64), 0) if sigma else 0
                v = p - ray.d * (TOLERANCE + fuzz) - mi.Point3f(eye)
                distance = dr.norm(v)
                sight = mi.Ray3f(mi.Point3f(eye), v / distance)
                sight.maxt = distance
                a, b = crossing(sight.o, sight.d, distance)
                visible = dr.select(scene.ray_test(sight, surface), 0, dr.exp(-sigma * (b - a)))
            if self.light is not None:
                behind, seen, _ = self.light.sample(scene, sampler, ray, None, active)
            else:
                facing = 0.3 + 0.7 * dr.abs(dr.dot(si.n, ray.d))
                behind, seen = dr.select(hit, si.bsdf().eval_diffuse_reflectance(si, hit) * facing, 0), hit
            L = T * behind + front * mi.Color3f(COLOR)
            p = dr.select(surface, p, 0)
            return L, seen | (opacity > 0), [z, opacity, p.x, p.y, p.z, dr.select(surface, visible, 0)]

        def to_string(self):
            return "ClosedForm[]"

    return ClosedForm(mi.Properties())


def nerg(mi, sigma, eye, depth="expected", light=None, aovs="depth,opacity,position,visibility", **overrides):
    """The same as a description of `nerg`."""
    if light not in (None, "path"):
        overrides["light"] = {"type": light}
    if sigma:
        box = mi.ScalarTransform4f().translate([-1, -1, -1]).scale(2)
        overrides["density"] = {"type": "constvolume", "value": sigma, "to_world": box}
        overrides["color"] = {"type": "constvolume", "value": {"type": "rgb", "value": list(COLOR)}}
    if eye is not None:
        overrides["observer"] = make_observer(mi, *eye)
    return plugin("nerg", aovs=aovs, depth=depth, visibility="transmittance", tolerance=TOLERANCE, **overrides)


def furniture(mi):
    """A sphere inside the unit box's field, half a board behind it, and a board that casts a shadow from ``EYE``."""
    return dict(
        ball=sphere(mi, 0.5, 0, 0.2, radius=0.4), back=square(mi, 1.4, 0.8, x=-0.4), lid=square(mi, -0.2, 0.25, x=-0.6)
    )


CROP = dict(crop_offset_x=3, crop_offset_y=5, crop_width=6, crop_height=4)
PIXEL = dict(crop_offset_x=6, crop_offset_y=5, crop_width=1, crop_height=1)
FIRST_DIRECTIONS, SECOND = (0.5, 0.4, -3), (-2.5, 0.2, -1)
SENSORS = {
    "perspective": camera,
    "crop": lambda mi: camera(mi, film=CROP),
    "crop of one pixel": lambda mi: camera(mi, film=PIXEL),
    "thinlens": lambda mi: camera(mi, kind="thinlens", fov=35, aperture_radius=0.15, focus_distance=3.0),
    "orthographic": lambda mi: (
        camera(mi, kind="orthographic")
        | {"to_world": look_at(mi, FIRST_DIRECTIONS) @ mi.ScalarTransform4f().scale(1.5)}
    ),
    "batch": lambda mi: plugin(
        "batch",
        film=camera(mi)["film"] | {"height": 6},
        a=camera(mi, FIRST_DIRECTIONS, size=6),
        b=camera(mi, SECOND, size=6),
    ),
    "panorama": lambda mi: (
        camera(mi, kind="panorama", film={"width": 16, "height": 9})
        | {"to_world": mi.ScalarTransform4f().translate([0, 0.1, -1.6])}
    ),
    "sample border": lambda mi: camera(mi, rfilter="gaussian", film={"sample_border": True}),
    "crop with a border": lambda mi: camera(mi, rfilter="gaussian", film={"sample_border": True} | CROP),
}


def both_ways(mi, sensor, shapes, *place, spp=2, **kwargs):
    """The image of `nerg`, that of the closed form, and the latter's channels by name."""
    scene = mi.load_dict({"type": "scene", "sensor": sensor, **shapes})
    a = np.array(mi.render(scene, integrator=mi.load_dict(nerg(mi, *place, **kwargs)), spp=spp, seed=3))
    b = np.array(mi.render(scene, integrator=closed_form(mi, *place, **kwargs), spp=spp, seed=3))
    return a, b, dict(zip(AOVS, np.moveaxis(b[..., 3:], -1, 0)))


@pytest.mark.parametrize("kind", list(SENSORS))
def test01_every_sensor_sees_shapes_in_a_field(rgb, kind):
    a, b, expected = both_ways(rgb, SENSORS[kind](rgb), furniture(rgb), 1.0, EYE)
    assert np.allclose(a, b, atol=2e-4)
    seen = expected["visibility.Y"]
    assert kind == "crop of one pixel" or (
        np.ptp(seen) > 0.1 and seen.max() > 0.3 and np.ptp(expected["depth.T"]) > 0.2
    )


@pytest.mark.parametrize("kind", ["orthographic", "batch"])
@pytest.mark.parametrize("sigma", [0, 4.0])
def test02_every_sensor_sees_shapes_alone_and_a_field_alone(rgb, kind, sigma):
    shapes = {} if sigma else furniture(rgb)
    a, b, expected = both_ways(rgb, SENSORS[kind](rgb), shapes, sigma, EYE, depth="median")
    assert np.allclose(a, b, atol=2e-4) and np.ptp(expected["visibility.Y"]) > 0.1


@pytest.mark.parametrize("kind", ["thinlens", "batch", "panorama"])
def test03_without_an_observer_it_is_the_camera(rgb, kind):
    """All surfaces are visible to it, and it is at the centre of the camera that a ray comes from."""
    sensor = SENSORS[kind](rgb)
    a, b, _ = both_ways(rgb, sensor, furniture(rgb), 1.0, None)
    assert np.allclose(a, b, atol=2e-4)
    out = channels(rgb, nerg(rgb, 1.0, None, aovs="position,observer_depth"), sensor, **furniture(rgb))
    p = points(out)
    centers = {"panorama": [(0, 0.1, -1.6)], "batch": [FIRST_DIRECTIONS, SECOND], "thinlens": [FIRST_DIRECTIONS]}[kind]
    width = p.shape[1] // len(centers)
    for i, c in enumerate(centers):
        part = np.s_[:, i * width : (i + 1) * width]
        has_surface = p[part].any(-1)
        distance = np.linalg.norm(p[part] - c, axis=-1)
        assert has_surface.any() and np.allclose(
            out["observer_depth.T"][part][has_surface], distance[has_surface], rtol=1e-4
        )


@pytest.mark.parametrize("light", ["path", "direct"])
def test04_emitters_and_the_sky_light_shapes_and_are_the_background(rgb, light):
    """`path` is the default of a scene with emitters. Equal seeds: the same paths."""
    sky = {"type": "constant", "radiance": {"type": "rgb", "value": [0.3, 0.5, 0.2]}}
    lamp = {"type": "sphere", "center": [0, 0.7, -0.5], "radius": 0.2, "e": {"type": "area", "radiance": 3.0}}
    shapes = {**furniture(rgb), "sky": sky, "lamp": lamp}
    a, b, _ = both_ways(rgb, camera(rgb, fov=90), shapes, 0.5, EYE, light=light)
    assert np.allclose(a, b, atol=2e-4) and a[..., 0].max() > 1.5
    assert np.allclose(a[0, 0, :3], [0.3, 0.5, 0.2], atol=1e-5)


@pytest.mark.parametrize("kind", ["depth", "map"])
def test05_instances_match_their_shapes(rgb, kind):
    T = rgb.ScalarTransform4f
    group = {"type": "shapegroup", "a": {"type": "cube", "to_world": T().scale(0.25)}}
    places = (
        T().translate([-0.5, 0.3, -0.3]).rotate([0, 1, 0], 30),
        T().translate([0.4, -0.3, 0.2]).rotate([1, 0, 0], 50),
    )
    instances = {
        f"i{i}": plugin("instance", to_world=t, g={"type": "ref", "id": "group"}) for i, t in enumerate(places)
    }
    plain = {f"c{i}": plugin("cube", to_world=t @ T().scale(0.25)) for i, t in enumerate(places)}
    how = {"visibility": kind, "map_height": 64, "falloff": 0.0, "observer": make_observer(rgb, *EYE)}
    integrator = constant(0.3, aovs="depth,opacity,position,visibility", **how)
    a = render(rgb, integrator, group=group, **instances, back=square(rgb, 1.4, 1.5))
    b = render(rgb, integrator, **plain, back=square(rgb, 1.4, 1.5))
    assert np.mean(np.abs(a - b) > 1e-4) < 0.005 and 0.1 < named(rgb, b, integrator)["visibility.Y"].mean() < 0.95


def mover(mi, name):
    """A shape, the key that moves it, the new value, and the resulting shape."""
    t = mi.ScalarTransform4f().translate([-0.4, 0.2, 0.1]).rotate([0, 1, 0], 20).scale(0.35)
    group = {"type": "shapegroup", "cube": {"type": "cube", "to_world": mi.ScalarTransform4f().scale(0.5)}}
    instance = plugin(
        "instance", to_world=mi.ScalarTransform4f().translate([0.3, 0, 0]), g={"type": "ref", "id": "group"}
    )
    if name == "instance":
        return {"group": group, "it": instance}, "it.to_world", {"group": group, "it": {**instance, "to_world": t}}
    if name == "group":
        after = {**group, "cube": {"type": "cube", "to_world": t}}
        return {"group": group, "it": instance}, f"group.cube.{positions_key()}", {"group": after, "it": instance}
    if name == "mesh":
        return {"it": {"type": "cube"}}, f"it.{positions_key()}", {"it": {"type": "cube", "to_world": t}}
    return {"it": {"type": name}}, "it.to_world", {"it": {"type": name, "to_world": t}}


@pytest.mark.parametrize("kind", ["depth", "map"])
@pytest.mark.parametrize("name", ["sphere", "rectangle", "instance", "mesh", "group"])
def test06_moved_shapes_are_updated(rgb, name, kind):
    before, key, after = mover(rgb, name)
    integrator = plugin(
        "nerg", aovs="depth,visibility", visibility=kind, map_height=64, falloff=0.0, observer=make_observer(rgb, *EYE)
    )
    moved, new = (scene_with(rgb, integrator, back=square(rgb, 1.4, 1.5), **shapes) for shapes in (before, after))
    first = picture(rgb, moved)
    put(rgb.traverse(moved), key, rgb.traverse(new)[key])
    a, b = (picture(rgb, s) for s in (moved, new))
    assert np.allclose(a, b, atol=1e-4) and np.mean(np.abs(a - first)[..., 4] > 0.5) > 0.02


def test07_textures(rgb):
    """Explicitly: a board that fills the image shows its bitmap (v runs upwards)."""
    texels = np.random.default_rng(0).random((6, 6, 3)).astype(np.float32)
    texture = {"type": "bitmap", "bitmap": rgb.Bitmap(texels), "raw": True, "filter_type": "nearest"}
    board = {"type": "rectangle", "bsdf": {"type": "diffuse", "reflectance": texture}}
    sensor = {**camera(rgb, kind="orthographic", size=6), "to_world": look_at(rgb, (0, 0, 3))}
    image = render(rgb, {"type": "nerg", "aovs": ""}, still(sensor), board=board)
    assert np.allclose(image[..., :3], texels[::-1], atol=1e-5)
    # Equal to the albedo of `aov`, also rotated and repeated.
    texture["to_uv"] = rgb.ScalarTransform4f().scale([3, 2, 1])
    turned = rgb.ScalarTransform4f().rotate([0.5, 1, 0], 160)
    bsdf = {"type": "twosided", "b": {"type": "principled", "base_color": texture}}
    checkers = {"type": "diffuse", "reflectance": {"type": "checkerboard"}}
    shapes = {"board": plugin("rectangle", to_world=turned, bsdf=bsdf)}
    shapes["ball"] = sphere(rgb, 0.7, 0, -0.7, radius=0.4) | {"bsdf": checkers}
    albedo = render(rgb, {"type": "aov", "aovs": "a:albedo"}, **shapes)
    image = render(rgb, {"type": "nerg", "aovs": "", "headlight": 0.0}, **shapes)
    assert np.allclose(image[..., :3], albedo[..., -3:], atol=1e-5) and np.ptp(image[..., 0]) > 0.5


def test08_nested_in_aov_and_moment(rgb):
    inner, shapes, spp = nerg(rgb, 1.0, EYE), furniture(rgb), 4
    plain = render(rgb, inner, spp=spp, **shapes)
    around = render(rgb, {"type": "aov", "aovs": "z:depth", "nerg": nerg(rgb, 0, EYE)}, spp=spp, **shapes)
    z = named(rgb, render(rgb, nerg(rgb, 0, EYE), spp=spp, **shapes), inner)["depth.T"]
    # `aov` puts the inner image first and its own channels last.
    assert np.allclose(around[..., 3], z, atol=1e-5) and np.allclose(around[..., -1], z, atol=1e-5)
    moment = {"type": "moment", "in": inner}
    names, image = rgb.load_dict(moment).aov_names(), render(rgb, moment, spp=spp, **shapes)
    single = render(rgb, closed_form(rgb, 1.0, EYE), seed=1, spp=64, **shapes)[..., 3:]
    for i, name in enumerate(AOVS):
        first, second = (image[..., 3 + names.index(f"{p}in.{name}")] for p in ("", "m2_"))
        assert np.allclose(first, plain[..., 3 + i], atol=1e-5)
        # E[x^2] >= E[x]^2, with equality where a pixel sees one value only.
        assert (second >= first**2 - 1e-4).all() and np.mean(np.abs(second - first**2) < 0.05) > 0.3
        assert np.allclose(first.mean(), single[..., i].mean(), atol=0.08)


def test09_channels_of_a_nested_integrator_survive_in_any_order(rgb):
    nested = {"type": "aov", "aovs": "n:sh_normal,z:depth", "img": {"type": "direct"}}
    sky = {"type": "constant"}
    outer = {"type": "moment", "in": nerg(rgb, 0.5, EYE, aovs="opacity,depth", lit=nested)}
    names = rgb.load_dict(outer).aov_names()
    out = dict(zip(names, np.moveaxis(render(rgb, outer, ball=furniture(rgb)["ball"], sky=sky)[..., 3:], -1, 0)))
    expected = render(rgb, {"type": "aov", "aovs": "n:sh_normal,z:depth"}, ball=furniture(rgb)["ball"])
    hit = expected[..., -1] > 0
    assert np.allclose(out["in.z.T"], expected[..., -1], atol=1e-5) and hit.sum() > 5
    assert all(np.allclose(out[f"in.n.{c}"][hit], expected[..., -4 + i][hit], atol=1e-5) for i, c in enumerate("XYZ"))
    assert np.allclose(out["m2_in.z.T"], expected[..., -1] ** 2, rtol=1e-4) and (out["in.opacity.Y"][hit] == 1).all()


@pytest.mark.parametrize("sky", [False, True])
@pytest.mark.parametrize("hide", [False, True])
def test10_alpha_matches_other_integrators(rgb, sky, hide):
    """The film's alpha: the fraction of samples with a surface or a visible environment emitter."""
    overrides = {"sky": {"type": "constant"}} if sky else {}
    sensor = camera(rgb, film={"pixel_format": "rgba"})
    path = {"type": "path", "hide_emitters": hide}
    overrides["ball"] = sphere(rgb, 0, 0, 0)
    for nested in ({}, {"lit": {"type": "direct", "hide_emitters": hide}}):
        expected = render(rgb, nested.get("lit", path), sensor, spp=4, **overrides)[..., 3]
        ours = render(
            rgb, {"type": "nerg", "aovs": "opacity", "hide_emitters": hide, **nested}, sensor, spp=4, **overrides
        )
        assert np.array_equal(ours[..., 3], expected)
        assert 0 < ours[..., 4].mean() < 0.5
    del overrides["ball"]
    thin = render(rgb, constant(0.2, aovs="opacity", hide_emitters=hide), sensor, **overrides)
    has_surface = thin[..., 4] > 0
    assert np.array_equal(thin[..., 3], np.where(has_surface | (sky and not hide), 1, 0)) and thin[..., 4].max() < 0.5


def test11_hidden_emitters_still_light_shapes(rgb):
    """As in Mitsuba: `path` sees through a lamp, `depth` hits it."""
    lamp = {"type": "sphere", "radius": 0.5, "e": {"type": "area", "radiance": 2.0}}
    shapes = {"lamp": lamp, "back": square(rgb, 1.0, 2.0)}
    image = render(rgb, {"type": "nerg", "aovs": "depth", "hide_emitters": True}, **shapes)
    assert np.allclose(image[..., 3], render(rgb, {"type": "depth"}, **shapes)[..., 0], atol=1e-5)
    assert np.allclose(image[..., :3], render(rgb, {"type": "path", "hide_emitters": True}, **shapes), atol=1e-5)
    assert image[..., :3].max() < 1.9


def test12_distant_shapes_do_not_blur_shadows(rgb):
    """A lid 20 cm in front of a wall casts a hard shadow, also under a dome of a kilometre (1e-4 of its diagonal is 35
    cm)."""
    integrator = {
        "type": "nerg",
        "aovs": "visibility,position",
        "falloff": 0.0,
        "observer": make_observer(rgb, 0, 0, -1),
    }
    sensor = camera(rgb, (3.0, 0, -1), (0, 0, 1), fov=40, size=24)
    shapes = {"wall": square(rgb, 1.0, 3.0), "lid": square(rgb, 0.8, 0.5)}
    sky = plugin("sphere", radius=1000.0, bsdf={"type": "twosided", "b": {"type": "diffuse"}})
    for dome in ({}, {"dome": sky}):
        out = channels(rgb, integrator, sensor, **shapes, **dome)
        scale = np.maximum(np.abs(out["position.X"]), np.abs(out["position.Y"]))
        on_wall = np.abs(out["position.Z"] - 1) < 1e-3
        hidden, seen = on_wall & (scale < 0.55), on_wall & (scale > 0.56) & (scale < 2.9)
        assert hidden.sum() > 10 and seen.sum() > 100
        assert (out["visibility.Y"][hidden] == 0).all() and (out["visibility.Y"][seen] == 1).all()


def test13_nested_volpath_with_mitsuba_media(rgb):
    """Around shapes, and around the camera itself: the same paths as those of `volpath`."""
    fog = {"type": "homogeneous", "sigma_t": 0.4, "albedo": 0.5}
    shapes = {"back": square(rgb, 1.4, 1.5), "lamp": {"type": "point", "position": [1, 1, -1], "intensity": 9.0}}
    cloud = {"cloud": plugin("cube", to_world=rgb.ScalarTransform4f().scale(0.6), bsdf={"type": "null"}, interior=fog)}
    for sensor, overrides in ((camera(rgb), cloud), ({**camera(rgb), "medium": fog}, {})):
        lit = plugin("nerg", aovs="depth", lit={"type": "volpath"})
        expected, ours = (
            render(rgb, i, sensor, spp=2, seed=2, **shapes, **overrides) for i in ({"type": "volpath"}, lit)
        )
        assert np.allclose(ours[..., :3], expected, atol=1e-5) and np.ptp(expected) > 0.05


@pytest.mark.parametrize("case", ["aov", "moment", "faces"])
def test14_errors_inside_other_integrators(rgb, case):
    """In one message: ``mi.render`` wraps it into its own."""
    outer, shapes = {"aov": {"aovs": "z:depth"}, "moment": {}}.get(case), {}
    integrator, words = plugin(case, **{"in": {"type": "nerg"}}, **(outer or {})), "there is nothing to render"
    if outer is None:
        integrator = plugin("nerg", aovs="visibility", observer=make_observer(rgb, *EYE))
        shapes = {"ball": sphere(rgb, 0, 0, 0), "leftover": rgb.Mesh("leftover", 0, 0)}
        words = 'the mesh "leftover" has no faces'
    with pytest.raises(Exception) as raised:
        render(rgb, integrator, **shapes)
    error, said = raised.value, ""
    while error is not None:
        said, error = said + str(error), error.__cause__ or error.__context__
    assert words in said
