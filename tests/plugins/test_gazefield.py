"""The volume `gazefield`: equation 1 in the scene, user-defined kinds, semantic fields, ensembles and support."""

from dataclasses import asdict, dataclass
from typing import ClassVar

import drjit as dr
import drjit.llvm.ad as ns
import numpy as np
import pytest

from nerg_mi.evaluation.gaze import FieldDensity
from nerg_mi.fields import gaze_base
from nerg_mi.fields.encoding import HashGridConfig
from nerg_mi.fields.gaze_base import CUTOFF_RADII, GazeEnsemble, RaySupport
from nerg_mi.fields.gaze_log_density import LogGazeConfig, LogGazeField
from nerg_mi.formats.fields import load_gaze, save_gaze
from nerg_mi.transport.geometry import SceneGeometry
from tests.evaluation import gaze_fields
from tests.reference import fields_numpy

from . import fields
from .scenes import (
    attach,
    camera,
    channels,
    make_observer,
    named,
    observed,
    picture,
    plugin,
    points,
    put,
    room,
    scene_with,
    stored,
    with_field,
    with_gaze,
)
from .test_nerg_aovs import operations

INSIDE = (0.1, -0.2, 0.3)


def gaze_only(gaze, aovs="gaze,position", **overrides):
    return plugin("nerg", aovs=aovs, radiance=False, gaze=gaze, **overrides)


def saved(path, field):
    save_gaze(field, path, {})
    return stored("gazefield", path)


# ---- Placement, parameters and constant weights ----


def ask(mi, gaze, p_od, p_o, r_o):
    p_od, p_o, r_o = (mi.Vector3f(np.asarray(x, float).tolist()) for x in (p_od, p_o, r_o))
    return [v.numpy()[0] for v in observed(mi, gaze, mi.Point3f(p_o)).evaluate(p_od, p_o, r_o, True)]


@pytest.mark.parametrize("kind", ["re-aimed hits", "ensemble"])
def test02b_reaimed_hits_are_mixed_in_unless_left_out(rgb, tmp_path, kind):
    path = tmp_path / "g.safetensors"
    hits = gaze_fields.saved(path, kind, fields.BOX).hits
    p_o, r_o = np.array([0.2, -0.3, 0.1]), np.array([0.6, 0.0, 0.8])
    volumes = [stored("gazefield", path, reaimed_hits=value) for value in (True, False)]
    mixed, plain = (ask(rgb, volume, p_o + 0.3 * r_o, p_o, r_o)[0] for volume in volumes)
    density = hits.observe(p_o, ns).evaluate(r_o[None])[0, 0]
    assert mixed == pytest.approx((1 - hits.weight) * plain + hits.weight * density, rel=1e-4)
    assert abs(mixed / plain - 1) > 0.01


@pytest.mark.parametrize("variant", ["emit", "capture", "emit_capture"])
def test01_gaze_field_is_placed_in_the_scene(rgb, tmp_path, variant):
    path = tmp_path / "g.safetensors"
    fields.gaze(path, variant)
    p_o, p_od = np.array([-0.5, 0.1, -0.7]), np.array([0.4, 0.3, 0.6])
    r_o = (p_od - p_o) / np.linalg.norm(p_od - p_o)
    plain = ask(rgb, stored("gazefield", path), p_od, p_o, r_o)
    to_world = rgb.ScalarTransform4f().translate([1, 2, 3]).rotate([0, 1, 0], 30).scale(4)
    m = np.array(to_world.matrix)
    moved = (m @ [*p_od, 1])[:3], (m @ [*p_o, 1])[:3], m[:3, :3] @ r_o / 4
    assert np.allclose(ask(rgb, stored("gazefield", path, to_world=to_world), *moved), plain, rtol=1e-4)


def test02_parameters_and_text(rgb, tmp_path, files):
    field = fields.gaze(tmp_path / "g.safetensors")
    volume = rgb.load_dict(stored("gazefield", tmp_path / "g.safetensors"))
    assert set(rgb.traverse(volume).keys()) == set(field.parameters())
    assert "variant = emit_capture" in str(volume) and "g.safetensors" in str(volume)
    assert np.allclose(np.array(volume.bbox().max).ravel(), 1)
    with pytest.raises(RuntimeError, match="contains a radiance field"):
        rgb.load_dict(stored("gazefield", files / "field.safetensors"))


def test04_constant_weights_change_no_gaze(rgb, files):
    where = (0.4, 0.3, 0.6), (-0.5, 0.1, -0.7), (0.6, 0.0, 0.8)
    plain, constant = (stored("gazefield", files / "gaze.safetensors", constant_weights=c) for c in (False, True))
    assert rgb.load_dict(constant).field.emit_head.has_constant_weights
    assert ask(rgb, plain, *where)[0] > 0 and ask(rgb, constant, *where) == ask(rgb, plain, *where)


# ---- A user-defined kind of gaze field: one class, whose checkpoints are read and rendered ----


@dataclass(frozen=True)
class LobeConfig:
    """A density that decreases with the angle to an axis, for any position."""

    kind: ClassVar[str] = "lobe"
    variant: ClassVar[str] = "emit"
    activation: ClassVar[str] = "exp"
    semantic: ClassVar[str] = ""
    features: ClassVar[int] = 0
    prior: ClassVar[int] = 0
    needs_surfaces: ClassVar[bool] = True
    fills_escaped: ClassVar[bool] = False
    sharpness: float = 2.0
    normalized: bool = True

    def conventions(self):
        return self.kind, self.normalized

    def to_dict(self):
        return {"kind": self.kind, **asdict(self)}


class LobeField:
    """exp(sharpness axis . r_o), like another recipe of log densities."""

    kind = "lobe"
    networks, support, hits, max_sizes = 1, None, None, {}
    DRJIT_STRUCT: ClassVar[dict] = {"axis": None}

    def __init__(self, config, box, axis):
        self.config, self.box, self.axis, self.members, self.ns = config, box, axis, [self], ns

    @classmethod
    def from_arrays(cls, architecture, box, arrays):
        config = LobeConfig(**{k: v for k, v in architecture.items() if k != "kind"})
        return cls(config, box, arrays.ns.TensorXf(arrays.get_array("axis", 3)))

    def architecture(self):
        return self.config.to_dict()

    def parameters(self):
        return {"axis": self.axis}

    def set_parameters(self, values):
        self.axis = values.get("axis", self.axis)

    def pack(self):
        pass

    def unnormalized(self, p_od, p_o, r_o, active=True, semantic=None, escaped=False):
        a = [dr.gather(type(r_o.x), self.axis.array, k) for k in range(3)]
        return dr.exp(self.config.sharpness * (a[0] * r_o.x + a[1] * r_o.y + a[2] * r_o.z)), type(r_o.x)(1)

    def evaluate(self, p_od, p_o, r_o, active=True, semantic=None, integral=None, escaped=False):
        emit, capture = self.unnormalized(p_od, p_o, r_o, active)
        emit = emit / integral if self.config.normalized else emit
        return emit * capture, emit, capture


# Integral of exp(k cos) over the sphere.
TOTAL = 4 * np.pi * np.sinh(2.0) / 2.0


@pytest.fixture
def lobe(monkeypatch):
    """Creates such a field."""
    monkeypatch.setattr(gaze_base, "_KINDS", dict(gaze_base._KINDS))
    gaze_base.register(LobeField)
    return lambda axis=(0.0, 0.0, 1.0): LobeField(LobeConfig(), fields.BOX, ns.TensorXf(np.array(axis, np.float32)))


def test01_registered_field_renders_its_formula(rgb, tmp_path, lobe):
    eye = np.array([0.2, 0.1, 0.0])
    shown = gaze_only(saved(tmp_path / "g.safetensors", lobe()), observer=make_observer(rgb, *eye), falloff=0.0)
    out = channels(rgb, shown, camera(rgb, INSIDE, (0.5, 0, 0)), **room(rgb))
    r = points(out) - eye
    r /= np.linalg.norm(r, axis=-1, keepdims=True)
    seen = out["gaze.Y"] > 0
    assert seen.sum() > 100
    np.testing.assert_allclose(out["gaze.Y"][seen], (np.exp(2 * r[..., 2]) / TOTAL)[seen], rtol=2e-3)


def members_and_ensemble(mi, folder, members):
    """``(gaze of each member, channels of the ensemble, its scene)`` in a room."""
    sensor = camera(mi, INSIDE, (0.5, 0, 0))
    each = [gaze_only(saved(folder / f"{k}.safetensors", m), "gaze") for k, m in enumerate(members)]
    shown = gaze_only(saved(folder / "e.safetensors", GazeEnsemble(members)), "gaze,gaze_std")
    scene = scene_with(mi, shown, sensor, **room(mi))
    return [channels(mi, i, sensor, **room(mi))["gaze.Y"] for i in each], named(mi, picture(mi, scene), shown), scene


def test03_registered_field_joins_an_ensemble(rgb, tmp_path, lobe):
    singles, out, scene = members_and_ensemble(rgb, tmp_path, [lobe(), lobe((0, 1, 0))])
    np.testing.assert_allclose(out["gaze.Y"], np.mean(singles, axis=0), rtol=1e-4)
    np.testing.assert_allclose(out["gaze_std.Y"], np.std(singles, axis=0, ddof=1), rtol=1e-3, atol=1e-6)
    keys = [k for k in rgb.traverse(scene).keys() if "gaze" in k]
    assert keys == ["integrator.gaze.0.axis", "integrator.gaze.1.axis"]


def test04_registered_field_is_evaluated(rgb, tmp_path, lobe):
    saved(tmp_path / "g.safetensors", lobe())
    field, _ = load_gaze(tmp_path / "g.safetensors", ns)
    place = SceneGeometry(None, rgb.load_dict({"type": "scene", **room(rgb)}))
    d = np.array([[0, 0, 1.0], [1, 0, 0], [0, 0, -1]])
    result = FieldDensity(field, place)(np.array([[0.1, 0.2, 0.3]]), d)[0]
    np.testing.assert_allclose(result, np.exp(2 * d[:, 2]) / TOTAL, rtol=2e-3)


def test05_checkpoint_of_unregistered_kind_is_refused(tmp_path, lobe):
    saved(tmp_path / "g.safetensors", lobe())
    del gaze_base._KINDS["lobe"]
    with pytest.raises(ValueError, match='"lobe"'):
        load_gaze(tmp_path / "g.safetensors", ns)


# ---- Normalised gaze fields: gaze integrates to one over an observer's sphere ----


def log_gaze(path, **kwargs):
    rng, grid = np.random.default_rng(4), HashGridConfig(levels=2, log2_rows=10, base=2, finest=4)
    config = LogGazeConfig(grid=grid, width=16, prior=16, heads=((-1, -1, -1), (1, 1, 1)), **kwargs)
    field = LogGazeField.random(config, fields.BOX, ns, 3)
    table = ns.Float((2 * rng.normal(size=len(field.grid.table))).astype(np.float32))
    field.set_parameters({"grid.table": table, "escaped": ns.Float(0.4)})
    # Random networks are nearly constant; these are not.
    field.set_parameters({k: 8 * v for k, v in field.parameters().items() if k in ("emit_net.2", "capture_net.2")})
    return saved(path, field)


def around(mi, origin, gaze, walls, size=48):
    """Gaze of an observer in all directions, and the solid angles of the pixels."""
    sensor = camera(mi, kind="panorama", film={"width": 2 * size, "height": size})
    sensor |= {
        "to_world": mi.ScalarTransform4f().translate(list(origin)),
        "sampler": plugin("stratified", sample_count=4),
    }
    theta = np.linspace(0, np.pi, size + 1)
    angle = (np.cos(theta[:-1]) - np.cos(theta[1:]))[:, None] * (np.pi / size)
    return channels(mi, gaze_only(gaze, "gaze"), sensor, spp=4, **walls)["gaze.Y"], angle


@pytest.mark.parametrize("origin", [(0, 0, 0), (0.5, -0.3, 0.2)])
@pytest.mark.parametrize("kind", ["log", "mixed", "softplus", "capture"])
def test01_integrates_to_one(rgb, tmp_path, origin, kind):
    path = tmp_path / "g.safetensors"
    if kind == "softplus":
        fields.gaze(path, normalized=True)
    else:
        log_gaze(path, mix=0.3 if kind == "mixed" else 0.0, variant="capture" if kind == "capture" else "emit_capture")
    density, angle = around(rgb, origin, stored("gazefield", path), room(rgb))
    assert np.ptp(density) > 2e-3 and (density >= 0).all()
    assert (density * angle).sum() == pytest.approx(1, abs=4e-3)


def test02_escaped_directions_contribute_to_the_integral(rgb, tmp_path):
    """Directions through the open side get the constant: the fraction that the walls lack."""
    gaze, walls, eye = log_gaze(tmp_path / "g.safetensors", variant="emit"), room(rgb, True), rgb.Point3f(0)
    density, angle = around(rgb, (0, 0, 0), gaze, walls)
    assert (angle * (density == 0)).sum() / (4 * np.pi) == pytest.approx(1 / 6, abs=0.02)
    place = SceneGeometry(None, rgb.load_dict({"type": "scene", **walls}))
    lost = np.exp(0.4) / 6 / float(observed(rgb, gaze, eye, place).integrals(eye)[0][0])
    assert (density * angle).sum() == pytest.approx(1 - lost, abs=0.01)


def test04_batch_has_one_integral_per_camera(rgb, tmp_path):
    integrator = gaze_only(log_gaze(tmp_path / "g.safetensors"), "gaze")
    cameras = {f"s{i}": camera(rgb, eye, (0, 0.5, 0.9)) for i, eye in enumerate([(0.3, 0.1, 0), (-0.5, 0.4, 0.2)])}
    film = {"type": "hdrfilm", "width": 24, "height": 12, "component_format": "float32", "rfilter": {"type": "box"}}
    both = channels(rgb, integrator, plugin("batch", film=film, **cameras), **room(rgb))["gaze.Y"]
    # Pixels have other samples in a batch: their means agree, and both cameras differ from each other.
    for i, sensor in enumerate(cameras.values()):
        alone = channels(rgb, integrator, sensor, **room(rgb))["gaze.Y"]
        assert both[:, 12 * i : 12 * i + 12].mean() == pytest.approx(alone.mean(), rel=0.05)


def test05_derivatives_include_the_integral(rgb, tmp_path):
    """Scaling emit by a factor changes nothing; scaling half of its table does."""
    integrator = gaze_only(log_gaze(tmp_path / "g.safetensors"), "gaze")
    scene = scene_with(rgb, integrator, camera(rgb, INSIDE, (0.5, 0, 0)), **room(rgb))
    params, key = rgb.traverse(scene), "integrator.gaze.prior"
    prior = rgb.TensorXf(params[key])
    half = rgb.TensorXf(np.repeat((np.arange(16) < 8).astype(np.float32)[:, None], 32, axis=1))

    def loss(part, h):
        put(params, key, prior + part * h)
        return dr.mean(rgb.render(scene, params, spp=1)[..., 3], axis=None)

    slopes = []
    for part in (dr.ones(rgb.TensorXf, half.shape), half):
        h = rgb.Float(0)
        dr.enable_grad(h)
        dr.backward(loss(part, h))
        slopes.append(float(dr.grad(h)[0]))
    ends = [float(loss(half, rgb.Float(h)).array[0]) for h in (0.02, -0.02, 0)]
    expected = (ends[0] - ends[1]) / 0.04
    assert abs(slopes[0]) < 1e-5 * ends[2]
    assert abs(expected) > 1e-4 and slopes[1] == pytest.approx(expected, rel=0.02)


# ---- Gaze fields with semantic features of a radiance field: the paper's semantic variants ----


def semantic_scene(files, tmp_path, aovs, **config):
    fields.gaze(tmp_path / "semantic.safetensors", **config)
    gaze = stored("gazefield", tmp_path / "semantic.safetensors")
    return with_field(files, aovs=aovs, depth="median", falloff=0.0, gaze=gaze)


@pytest.mark.parametrize(
    "semantic, with_own_features, aligned",
    [("accumulated", False, True), ("accumulated", True, False), ("snapshot", False, False), ("snapshot", True, True)],
)
def test01_emit_uses_features_of_the_radiance_field(rgb, files, tmp_path, semantic, with_own_features, aligned):
    """Against a separate evaluation of equation 1, with features from AOVs of a camera at the observer."""
    eye = (0.5, 0.4, -3)
    aovs = "position,gaze,emit,capture,visibility,opacity"
    integrator = semantic_scene(files, tmp_path, aovs, semantic=semantic, semantic_own=with_own_features)
    sensor = camera(rgb, eye)
    if not aligned:
        # An observer slightly off the camera sees the same, by a separate pass.
        integrator |= {"observer": make_observer(rgb, eye[0] + 1e-5, eye[1], eye[2]), "tolerance": 0.3}
    out = channels(rgb, integrator, sensor)
    seen = out["visibility.Y"] == 1
    name = "features" if semantic == "accumulated" else "features_at"
    blocks = channels(rgb, with_field(files, aovs=f"{name},opacity", depth="median", color_cutoff=0.0), sensor)
    features = [rgb.Float(np.ascontiguousarray(blocks[f"{name}.{k}"][seen])) for k in range(7)]
    p, p_o = rgb.Point3f(np.ascontiguousarray(points(out)[seen].T)), rgb.Point3f(*eye)
    gaze = observed(rgb, integrator["gaze"], p_o)
    expected = gaze.evaluate(p, p_o, dr.normalize(p - p_o), True, features)
    assert seen.sum() > 10
    for channel, value in zip(("gaze.Y", "emit.Y", "capture.Y"), expected):
        assert np.allclose(out[channel][seen], np.array(value), rtol=5e-3), channel
    other = gaze.evaluate(p, p_o, dr.normalize(p - p_o), True, [f + 1 for f in features])
    assert not np.allclose(np.array(other[1]), np.array(expected[1]), rtol=5e-3)


def test02_field_with_other_features_is_refused(rgb, files, tmp_path):
    integrator = semantic_scene(files, tmp_path, "gaze", semantic="snapshot")
    assert rgb.load_dict(integrator).aov_names() == ["gaze.Y"]
    without = {k: v for k, v in integrator.items() if k != "field"} | {"density": {"type": "constvolume", "value": 1.0}}
    fields.radiance(tmp_path / "field.safetensors", geometry=5)
    other = integrator | {"field": stored("nerf", tmp_path / "field.safetensors")}
    for wrong, said in ((without, '7.*"field"'), (other, '7.*"field".*5')):
        with pytest.raises(RuntimeError, match=said):
            rgb.load_dict(wrong)
    # Features are refused by a field without them, too.
    p = rgb.Point3f(0.1, 0.2, 0.3)
    gaze = observed(rgb, with_gaze(files)["gaze"], p + 1)
    with pytest.raises(ValueError, match="takes no semantic features, got 7"):
        gaze.evaluate(p, p + 1, rgb.Vector3f(0, 0, 1), True, [rgb.Float(0)] * 7)


@pytest.mark.parametrize(
    "config, said", [({"semantic": "labels"}, '"labels"'), ({"semantic_own": True}, "set semantic")]
)
def test04_invalid_configurations_are_refused(tmp_path, config, said):
    with pytest.raises(ValueError, match=said):
        fields.gaze(tmp_path / "x.safetensors", **config)


# ---- Ensembles and support: against NumPy and the single members ----

ORIGINS = np.random.default_rng(0).normal((-2, 0.3, -2), 0.3, (300, 3))


def support_at(*eye):
    return np.maximum(1 - ((ORIGINS - eye) ** 2).sum(axis=1) / CUTOFF_RADII**2, 0).sum()


@pytest.fixture(scope="module")
def ensemble(files):
    """A volume of three product fields, and the fields."""
    members = [fields.gaze(files / f"member{seed}.safetensors", seed=seed) for seed in (1, 2, 3)]
    for m in members:
        # Random networks are nearly constant; these are not.
        m.set_parameters({k: 20 * v for k, v in m.parameters().items() if k in ("emit_head.0", "capture_head.0")})
    return saved(files / "ensemble.safetensors", GazeEnsemble(members, RaySupport.from_origins(ORIGINS, 1.0))), members


@pytest.mark.parametrize("aligned", [True, False])
def test01_mean_and_std_over_members(rgb, files, ensemble, aligned):
    """In NumPy, at the surface that the camera sees."""
    gaze, members = ensemble
    eye = np.array([0.5, 0.4, -3] if aligned else [-2, 0.3, -2.0])
    overrides = {} if aligned else {"observer": make_observer(rgb, *eye)}
    out = channels(
        rgb, with_field(files, gaze=gaze, aovs="gaze,gaze_std,position,gaze_evals", occlusion=False, **overrides)
    )
    p = points(out)
    seen = np.abs(p).sum(axis=-1) > 0
    p = p[seen]
    r = (p - eye) / np.linalg.norm(p - eye, axis=-1, keepdims=True)
    grid = {k: v for k, v in asdict(fields.GRID).items() if k != "dimensions"}
    how = grid, (-1, -1, -1), (1, 1, 1), "emit_capture", "softplus"
    each = []
    for m in members:
        weights = {k: np.array(v, np.float64) for k, v in m.parameters().items()}
        each.append(fields_numpy.gaze(p, np.broadcast_to(eye, p.shape), r, weights, *how, degree=2)[0])
    assert seen.sum() > 20 and np.std(each, axis=0, ddof=1).max() > 0.05
    np.testing.assert_allclose(out["gaze.Y"][seen], np.mean(each, axis=0), rtol=2e-3, atol=1e-4)
    np.testing.assert_allclose(out["gaze_std.Y"][seen], np.std(each, axis=0, ddof=1), rtol=5e-3, atol=1e-4)
    assert not out["gaze_std.Y"][~seen].any() and out["gaze_evals.Y"].max() == 6


def test03_members_are_normalised_separately(rgb, tmp_path):
    """The mean of normalised densities, with depths traced once for all of them."""
    members = [load_gaze(log_gaze(tmp_path / f"{i}.safetensors", mix=0.2)["filename"], ns)[0] for i in range(2)]
    members[1].set_parameters({k: v * 1.3 for k, v in members[1].parameters().items() if k != "prior"})
    (a, b), out, scene = members_and_ensemble(rgb, tmp_path, members)
    assert np.abs(a - b).max() > 1e-3
    np.testing.assert_allclose(out["gaze.Y"], (a + b) / 2, rtol=1e-4)
    np.testing.assert_allclose(out["gaze_std.Y"], np.abs(a - b) / np.sqrt(2), rtol=2e-3, atol=1e-6)
    placed, cache = scene.integrator().gaze, scene.integrator().cache
    assert len(cache.peek((placed, "surroundings"))) == 1
    first, second = (float(cache.peek((placed, "integral", m))[0].value[0]) for m in placed.field.members)
    assert first != second


@pytest.mark.parametrize("eye", [(-2, 0.3, -2), (-1.6, 0.3, -2.2), (5.0, 5, 5)])
def test04_support_depends_on_the_observer(rgb, files, ensemble, eye):
    integrator = with_field(files, gaze=ensemble[0], aovs="support,position", observer=make_observer(rgb, *eye))
    out = channels(rgb, integrator, camera(rgb, fov=80))
    moved = out["position.Z"] != 0
    np.testing.assert_allclose(out["support.Y"][moved], support_at(*eye), rtol=0.03)
    assert 0 < moved.sum() < moved.size and not out["support.Y"][~moved].any()
    assert (support_at(*eye) == 0) == (eye[0] > 0)


def test05_support_follows_observer_and_placement(rgb, files, ensemble):
    """Scaled by two and moved: p_o = 2 p + (1, 0, 0) corresponds to p."""
    to_world = rgb.ScalarTransform4f().translate([1, 0, 0]).scale(2)
    field = stored("nerf", files / "field.safetensors", to_world=to_world)
    gaze, eye = {**ensemble[0], "to_world": to_world}, make_observer(rgb, -3, 0.6, -4)
    scene = scene_with(rgb, gaze_only(gaze, "support", field=field, observer=eye), camera(rgb, (2, 0.8, -6), (1, 0, 0)))
    assert picture(rgb, scene)[..., 3].max() == pytest.approx(support_at(-2, 0.3, -2), rel=0.03)
    moved = rgb.Transform4f().translate([-2.2, 0.6, -4.4])
    put(rgb.traverse(scene), "integrator.observer.to_world", moved)
    assert picture(rgb, scene)[..., 3].max() == pytest.approx(support_at(-1.6, 0.3, -2.2), rel=0.03)


def test06_unrequested_views_are_not_traced(rgb, files, ensemble):
    eye, single = make_observer(rgb, -2, 0.3, -2), stored("gazefield", files / "member1.safetensors")
    cost = lambda aovs, gaze=ensemble[0]: operations(rgb, with_field(files, gaze=gaze, aovs=aovs, observer=eye))
    depth, support, gaze, both = (cost(aovs) for aovs in ("depth", "support", "gaze", "gaze,gaze_std"))
    # Support needs neither the observer's march nor a network; the standard deviation adds only squares and a root.
    assert support < depth + 100 < gaze and both < gaze + 120
    assert cost("depth", single) == depth


@pytest.mark.parametrize(
    "aov, said", [("gaze_std", "ensemble.*train one with ensemble"), ("support", "with support; train it again")]
)
def test07_missing_dependencies_are_reported(rgb, files, aov, said):
    with pytest.raises(RuntimeError, match=said):
        rgb.load_dict(with_gaze(files, aov))
    with pytest.raises(RuntimeError, match=f'"{aov}", which needs a "gaze" volume'):
        rgb.load_dict(with_field(files, aovs=aov))


def test08_derivatives_reach_every_member(rgb, files, ensemble):
    scene = scene_with(rgb, with_field(files, gaze=ensemble[0], aovs="gaze_std"))
    params = rgb.traverse(scene)
    keys = [k for k in params.keys() if "gaze" in k and k.endswith("emit_head.0")]
    assert len(keys) == 3
    attach(params, *keys)
    dr.backward(dr.mean(rgb.render(scene, params, spp=1)[..., 3], axis=None))
    for k in keys:
        g = np.array(dr.grad(params[k]))
        assert np.isfinite(g).all() and np.abs(g).max() > 1e-6, k
