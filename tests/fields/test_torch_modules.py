"""Fields as torch modules: values, derivatives, training."""

from __future__ import annotations

import subprocess
import sys

import drjit as dr
import drjit.llvm.ad as ns
import numpy as np
import pytest

from nerg_mi.errors import NergError
from nerg_mi.fields.encoding import HashGridConfig
from nerg_mi.fields.gaze_base import GazeEnsemble
from nerg_mi.fields.gaze_hits import HitKernel, ReaimedHits
from nerg_mi.fields.gaze_log_density import LogGazeConfig, LogGazeField
from nerg_mi.fields.gaze_product import GazeConfig, ProductHead
from nerg_mi.fields.radiance import Background, BackgroundConfig, RadianceConfig, RadianceNetwork
from nerg_mi.formats.fields import save_gaze
from nerg_mi.maths.geometry import Box
from nerg_mi.transport.geometry import SceneGeometry
from nerg_mi.transport.march_primal import MarchSettings
from nerg_mi.transport.observer import ObserverSettings
from nerg_mi.transport.observer_gaze import GazeFieldInstance, ObserverTracer

# ---- Fields with random weights, and rays, evaluated through torch ----


GRID = HashGridConfig(levels=2, log2_rows=10, base=4, finest=16)
BOX = Box((-1, -1, -1), (1, 1, 1))
RNG = np.random.default_rng(0)


def vary_field(field):
    field.set_parameters({"grid.table": ns.Float(RNG.normal(size=len(field.grid.table)).astype(np.float32))})
    return field


def radiance(background=False, deferred=False):
    behind = Background.random(
        BackgroundConfig(3.0, HashGridConfig(levels=2, log2_rows=8, base=4, finest=16, dimensions=2), 16), ns
    )
    return vary_field(
        RadianceNetwork.random(
            RadianceConfig(GRID, width=16, geometry=7, deferred=deferred),
            BOX,
            ns,
            background=behind if background else None,
        )
    )


def rays(torch, n=200):
    p = RNG.uniform(-1.05, 1.05, (n, 3)).astype(np.float32)
    d = RNG.normal(size=(n, 3))
    return torch.tensor(p), torch.tensor((d / np.linalg.norm(d, axis=1, keepdims=True)).astype(np.float32))


# ---- Fields as torch modules ----


_BEGINNING = RNG.bit_generator.state


@pytest.fixture(autouse=True)
def same_numbers():
    """Use the same random numbers in each test, in any order: central differences may otherwise hit the kink of a
    ReLU.
    """
    RNG.bit_generator.state = _BEGINNING


@pytest.fixture
def interop(torch):
    import nerg_mi.fields.torch_modules

    return nerg_mi.fields.torch_modules


def test01_values_of_the_field(torch, interop):
    field = radiance(background=True)
    module, (p, d) = interop.RadianceModule(field), rays(torch)
    sigma, color = module(p, d)
    density, features = field.density_features(ns.Array3f(p.numpy().T))
    assert np.array_equal(sigma.detach().numpy(), density.numpy()) and (sigma == 0).any()
    assert np.array_equal(color.detach().numpy(), np.array(field.color(features, ns.Array3f(d.numpy().T))).T)
    assert np.allclose(module.density(p).detach().numpy(), density.numpy(), rtol=1e-5)
    shown = np.array(field.background(ns.Array3f(p.numpy().T), ns.Array3f(d.numpy().T))).T
    assert np.array_equal(module.background(p, d).detach().numpy(), shown)
    assert {k.replace("__", ".") for k, _ in module.named_parameters()} == set(field.parameters())
    with pytest.raises(ValueError, match="without a background"):
        interop.RadianceModule(radiance()).background(p, d)


@pytest.mark.parametrize("deferred", [False, True])
def test01b_colours_of_features(torch, interop, deferred):
    """Equal to those of the field, with derivatives that agree with central differences."""
    field = radiance(deferred=deferred)
    module, (p, d) = interop.RadianceModule(field), rays(torch)
    sigma, features = module.density_features(p)
    expected = field.density_features(ns.Array3f(p.numpy().T))
    assert np.array_equal(sigma.detach().numpy(), expected[0].numpy())
    assert np.array_equal(features.detach().numpy().T, np.stack([f.numpy() for f in expected[1]]))
    assert torch.allclose(module.color(features, d), module(p, d)[1], atol=1e-6)
    mix = torch.tensor(RNG.normal(size=(len(p), 3)))
    loss = lambda f, d: (module.color(f, d).double() * mix).sum()
    f, d = features.detach().requires_grad_(), d.requires_grad_()
    loss(f, d).backward()
    for value, ends in ((f, lambda v: loss(v, d)), (d, lambda v: loss(f, v))):
        name = torch.tensor(np.random.default_rng(1).normal(size=value.shape).astype(np.float32))
        slope = (ends(value + 2e-4 * name) - ends(value - 2e-4 * name)).item() / 4e-4
        assert np.isclose(float((value.grad * name).sum()), slope, rtol=0.03, atol=0.02)
    with pytest.raises(ValueError, match=r"must have shape \(N, 7\)"):
        module.color(features[:, :3], d)


def test02_gradients_equal_torch_reference(torch, interop):
    # The same networks in torch on the same features, as an independent reference for the gradients.
    from nerg_mi.fields.encoding import encode_direction

    field = radiance()
    module, (p, d) = interop.RadianceModule(field), rays(torch)
    mix = torch.tensor(RNG.normal(size=(len(p), 4)).astype(np.float32))
    sigma, color = module(p, d)
    loss = (torch.log1p(sigma) * mix[:, 0]).sum() + (color * mix[:, 1:]).sum()
    loss.backward()

    features = np.array([f.numpy() for f in field.grid(field.box.to_unit(ns.Array3f(p.numpy().T)))]).T
    sh = np.array([np.broadcast_to(h.numpy(), len(p)) for h in encode_direction(ns.Array3f(d.numpy().T), 4)]).T
    features, sh = torch.tensor(features, requires_grad=True), torch.tensor(sh.copy())
    weights = {
        k: torch.tensor(v.numpy(), requires_grad=True) for k, v in field.parameters().items() if k != "grid.table"
    }
    h = torch.relu(features @ weights["density_net.0"].T) @ weights["density_net.1"].T
    inside = torch.all(torch.abs(p) <= 1, 1)
    theirs = torch.where(inside, torch.exp(h[:, 0]), torch.zeros(()))
    c = torch.cat([sh, h[:, 1:]], 1)
    c = torch.relu(torch.relu(c @ weights["color_net.0"].T) @ weights["color_net.1"].T) @ weights["color_net.2"].T
    other = (torch.log1p(theirs) * mix[:, 0]).sum() + (torch.sigmoid(c) * mix[:, 1:]).sum()
    other.backward()
    assert torch.allclose(loss, other, rtol=1e-4, atol=1e-4)
    for name, value in weights.items():
        ours = module.get_parameter(name.replace(".", "__")).grad
        assert torch.allclose(ours, value.grad, rtol=1e-3, atol=1e-4), name
    table = module.grid__table.grad
    # The interpolation weights of a point sum to one for each level and feature.
    assert torch.isclose(table.sum(), features.grad[inside].sum(), rtol=1e-3, atol=1e-3) and (table != 0).sum() > 100


def test03_gradients_equal_central_differences(torch, interop):
    module, (p, d) = interop.RadianceModule(radiance(background=True)), rays(torch, 40)
    p = (p * 0.9).requires_grad_()
    d.requires_grad_()

    def loss(p, d):
        sigma, color = module(p, d)
        # Sums in float64, for precise differences.
        parts = sigma * 0.1, color * torch.tensor([1.0, 2.0, 3.0]), module.background(p, d)
        return sum(part.double().sum() for part in parts)

    loss(p, d).backward()
    check = {"p": (p, p.grad), "d": (d, d.grad)}
    check |= {
        k: (v, v.grad)
        for k, v in module.named_parameters()
        if k in ("color_net__1", "background_net__0", "density_net__0")
    }
    for name, (value, gradient) in check.items():
        direction = torch.tensor(np.random.default_rng(1).normal(size=value.shape).astype(np.float32))
        h = 2e-4
        with torch.no_grad():
            ends = []
            for sign in (1, -1):
                value += sign * h * direction
                ends.append(float(loss(p, d)))
                value -= sign * h * direction
        assert np.isclose(float((gradient * direction).sum()), (ends[0] - ends[1]) / (2 * h), rtol=0.03, atol=0.02), (
            name
        )


@pytest.mark.parametrize("trunk", ["relu", "layernorm", "linear"])
def test04_a_gaze_field(torch, interop, trunk):
    field = vary_field(ProductHead.random(GazeConfig(GRID, width=16, geometry=7, sh_degree=2, trunk=trunk), BOX, ns))
    module = interop.GazeModule(field)
    (p_od, r_o), (p_o, _) = rays(torch, 60), rays(torch, 60)
    gaze = module(p_od, p_o, r_o)
    expected = field.evaluate(*[ns.Array3f(x.numpy().T) for x in (p_od, p_o, r_o)])[0].numpy()
    assert np.array_equal(gaze.detach().numpy(), expected)
    mix = torch.tensor(RNG.normal(size=60).astype(np.float32))
    (gaze * mix).sum().backward()
    points = [ns.Array3f(x.numpy().T) for x in (p_od, p_o, r_o)]
    own_gradients(module, field, lambda: dr.sum(field.evaluate(*points)[0] * ns.Float(mix.numpy())))
    central_differences(
        torch, module, lambda: (module(p_od, p_o, r_o) * mix).double().sum(), ("emit_head__0", "capture_head__0")
    )


def own_gradients(module, field, loss):
    """Check that the gradients of the module equal Dr.Jit's gradients of the same ``loss``."""
    values = {k: type(v)(v) for k, v in field.parameters().items()}
    dr.enable_grad(values)
    field.set_parameters(values)
    dr.backward(loss())
    for name, value in values.items():
        parameter = module.get_parameter(name.replace(".", "__"))
        if parameter.requires_grad:
            theirs = dr.grad(value).numpy()
            assert np.abs(theirs).max() > 0
            np.testing.assert_allclose(parameter.grad.numpy(), theirs, atol=1e-4 * np.abs(theirs).max(), err_msg=name)


def central_differences(torch, module, loss, names):
    """Compare the gradients of the parameters ``names``, which no ReLU follows, with central differences."""
    for name in names:
        value = module.get_parameter(name)
        direction = torch.tensor(np.random.default_rng(2).normal(size=value.shape).astype(np.float32))
        ends, h = [], 1e-3
        with torch.no_grad():
            for sign in (1, -1):
                value += sign * h * direction
                ends.append(float(loss()))
                value -= sign * h * direction
        assert np.isclose(float((value.grad * direction).sum()), (ends[0] - ends[1]) / (2 * h), rtol=0.02, atol=1e-3), (
            name
        )


HEADS = ((-0.8, -0.8, -0.8), (0.8, 0.8, 0.8))


def normalised(kind):
    if kind == "product":
        field = vary_field(
            ProductHead.random(GazeConfig(GRID, width=16, geometry=7, sh_degree=2, normalized=True), BOX, ns)
        )
        field.set_parameters({"emit_head.0": 20 * field.emit_head.weights[0]})
        return field
    config = LogGazeConfig(
        grid=GRID,
        width=16,
        prior=16,
        heads=HEADS,
        mix=0.2 if kind == "mixed" else 0.0,
        variant="capture" if kind == "capture" else "emit_capture",
    )
    field = vary_field(LogGazeField.random(config, BOX, ns, 3, RNG.normal(size=(16, 32)) - 2.5))
    field.set_parameters(
        {"escaped": ns.Float(0.6)}
        | {k: 6 * v for k, v in field.parameters().items() if k in ("emit_net.2", "capture_net.2")}
    )
    return field


@pytest.mark.parametrize("kind", ["product", "log", "mixed", "capture"])
def test04b_a_normalised_gaze_field(torch, interop, rgb, kind, tmp_path):
    """Fields of the default recipe: integral and density of Dr.Jit's marching, in an environment that is half open."""
    field = normalised(kind)
    shape = {"type": "rectangle", "to_world": rgb.ScalarTransform4f().translate([0, 0, 0.6]).scale(5)}
    place, eye = SceneGeometry(None, rgb.load_dict({"type": "scene", "s": shape})), rgb.Point3f(0.1, -0.2, 0.3)
    placed, settings = GazeFieldInstance(field), ObserverSettings(march=MarchSettings(step=1), directions=1 << 12)
    around = ObserverTracer(placed, place, eye, settings).trace()
    observed = placed.for_observers([eye], place, settings)
    tensor = lambda v: torch.tensor(np.ascontiguousarray(np.array(v).T, np.float32))
    r_o, escaped = tensor(around.directions), torch.tensor(np.array(around.escaped))
    assert 0.3 < escaped.float().mean() < 0.7
    p_o = torch.tensor([[0.1, -0.2, 0.3]]).expand(len(r_o), 3)
    p_od = p_o + r_o * torch.tensor(np.array(around.distance))[:, None]
    module = interop.GazeModule(field)
    Z = module.integral(p_od, p_o, r_o, escaped)
    assert float(Z) == pytest.approx(float(observed.integrals(eye)[0][0]), rel=1e-5)
    gaze = module(p_od, p_o, r_o, Z, escaped)
    points = [rgb.Point3f(p_od.numpy().T), rgb.Point3f(p_o.numpy().T.copy()), rgb.Vector3f(r_o.numpy().T)]
    expected = np.array(observed.evaluate(*points, True, escaped=around.escaped)[0])
    np.testing.assert_allclose(gaze.detach().numpy(), expected, rtol=2e-5)
    if kind != "mixed":
        assert 4 * np.pi * float(gaze.mean()) == pytest.approx(1, rel=1e-5)
    # One integral per row is equivalent to one integral for all rows.
    assert torch.allclose(module(p_od, p_o, r_o, Z.expand(len(r_o)), escaped), gaze)
    trained = module.field()
    assert {k: v.numpy().tolist() for k, v in trained.parameters().items()} == {
        k: v.numpy().tolist() for k, v in field.parameters().items()
    }
    save_gaze(trained, tmp_path / "g.safetensors", {})
    with pytest.raises(ValueError, match='pass "integral"'):
        module(p_od, p_o, r_o)
    with pytest.raises(ValueError, match="integral must be one number or a tensor of length 4096"):
        module(p_od, p_o, r_o, torch.ones(7))


@pytest.mark.parametrize("members", [1, 2])
def test04e_reaimed_hits(torch, interop, rgb, members):
    """Their density is an argument, as the integral is."""
    field = normalised("log") if members == 1 else GazeEnsemble([normalised("log") for _ in range(members)])
    field.hits = ReaimedHits(*RNG.uniform(-1, 1, (2, 40, 3)), [HitKernel(0.3, 0.3, 30.0), HitKernel(0.1, 0.6, 10.0)])
    module = (interop.GazeModule if members == 1 else interop.GazeEnsembleModule)(field)
    place, eyes = SceneGeometry(None, rgb.load_dict({"type": "scene"})), torch.tensor([[0.1, -0.2, 0.3], [-0.5, 0, 0]])
    observers = [rgb.Point3f(*eye) for eye in eyes.tolist()]
    observed = GazeFieldInstance(field).for_observers(observers, place, ObserverSettings(march=MarchSettings(step=1)))
    directions = torch.nn.functional.normalize(torch.tensor(RNG.normal(size=(50, 3)).astype(np.float32)), dim=1)
    integrals = torch.tensor([float(z[0]) for z in observed.integrals(observers[0])])
    p_o = eyes[:1].expand(50, 3).contiguous()
    p_od = p_o + directions
    hits = module.evaluate_hits(p_o, directions)
    gaze = module(p_od, p_o, directions, integrals, None, hits)
    points = [rgb.Point3f(p_od.numpy().T), rgb.Point3f(p_o.numpy().T.copy()), rgb.Vector3f(directions.numpy().T)]
    np.testing.assert_allclose(gaze.detach().numpy(), np.array(observed.evaluate(*points, True)[0]), rtol=1e-4)
    both = module.evaluate_hits(torch.cat([eyes[1:], eyes[:1]]), directions[:2])
    assert both[1] == pytest.approx(float(module.evaluate_hits(eyes[:1], directions[1:2])[0]))
    assert module.field().hits is field.hits
    with pytest.raises(ValueError, match='pass "hits"'):
        module(p_od, p_o, directions, integrals)
    with pytest.raises(ValueError, match="hits must be a tensor of length 50"):
        module(p_od, p_o, directions, integrals, None, hits[:3])
    with pytest.raises(ValueError, match="no re-aimed hits"):
        interop.GazeModule(normalised("log")).evaluate_hits(p_o, directions)


@pytest.mark.parametrize("kind", ["product", "mixed"])
def test04c_gradients_pass_the_integral(torch, interop, kind):
    """Compared with Dr.Jit's gradients, and with central differences where there is no ReLU, for a loss in which each
    weight also changes the integral.
    """
    field = normalised(kind)
    module = interop.GazeModule(field)
    (p_od, r_o), (p_o, _) = rays(torch, 60), rays(torch, 60)
    p_o = p_o[:1].expand(60, 3) * 0.7
    escaped, mix = torch.arange(60) % 3 == 0, torch.tensor(RNG.normal(size=60).astype(np.float32))
    loss = lambda: (module(p_od, p_o, r_o, module.integral(p_od, p_o, r_o, escaped), escaped) * mix).double().sum()
    loss().backward()
    assert kind == "product" or (module.prior.grad is None and not module.prior.requires_grad)

    points, gone = [ns.Array3f(np.ascontiguousarray(x.numpy().T)) for x in (p_od, p_o, r_o)], ns.Bool(escaped.numpy())

    def same():
        emit, capture = field.unnormalized(*points, escaped=gone)
        Z = 4 * dr.pi * dr.mean(emit * capture)
        return dr.sum(field.evaluate(*points, integral=Z, escaped=gone)[0] * ns.Float(mix.numpy()))

    own_gradients(module, field, same)
    names = {"product": ("emit_head__0", "capture_head__0"), "mixed": ("emit_net__2", "capture_net__2", "escaped")}
    central_differences(torch, module, loss, names[kind])


@pytest.mark.parametrize("kind", ["product", "log"])
def test04d_an_ensemble_is_the_mean_of_its_members(torch, interop, kind):
    ensemble = GazeEnsemble([normalised(kind), normalised(kind)])
    with pytest.raises(NergError, match="use GazeEnsembleModule"):
        interop.GazeModule(ensemble)
    module = interop.GazeEnsembleModule(ensemble)
    p_od, r_o = (t[:64].contiguous() for t in rays(torch))
    p_o = torch.tensor([[0.1, -0.2, 0.3]]).expand(64, 3).contiguous()
    Z = module.integral(p_od, p_o, r_o)
    assert Z.shape == (2,) and Z[0] != Z[1]
    gaze, points = module(p_od, p_o, r_o, Z), [ns.Array3f(t.numpy().T.copy()) for t in (p_od, p_o, r_o)]
    each = [m.evaluate(*points, integral=ns.Float(z))[0].numpy() for m, z in zip(ensemble.members, Z.tolist())]
    np.testing.assert_allclose(module.forward_members(p_od, p_o, r_o, Z).detach().numpy(), each, rtol=1e-5)
    np.testing.assert_allclose(gaze.detach().numpy(), np.mean(each, axis=0), rtol=1e-5)
    with pytest.raises(ValueError, match="one entry for each of the 2 members, got 1"):
        module(p_od, p_o, r_o, Z[:1])
    gaze.sum().backward()
    for i in range(2):
        assert module.get_parameter(f"members.{i}.grid__table").grad.abs().max() > 0
    again = module.field()
    names = ensemble.parameters()
    assert all(np.array_equal(again.parameters()[k].numpy(), v.numpy()) for k, v in names.items())
    assert again.members[0] is not ensemble.members[0]


def test05_training_in_torch_and_back(torch, interop, tmp_path):
    from nerg_mi.formats.fields import load_radiance, save_radiance

    field = radiance()
    before = {k: v.numpy() for k, v in field.parameters().items()}
    module, (p, d) = interop.RadianceModule(field), rays(torch)
    p, optimizer = p * 0.9, torch.optim.Adam(module.parameters(), 3e-2)
    goal = torch.stack([0.5 + 0.4 * p[:, 0], 0.5 - 0.3 * p[:, 1], torch.full((len(p),), 0.2)], 1)
    losses = []
    for _ in range(30):
        optimizer.zero_grad()
        loss = ((module(p, d)[1] - goal) ** 2).mean()
        loss.backward()
        optimizer.step()
        losses.append(float(loss.detach()))
    assert losses[-1] < 0.3 * losses[0], losses
    save_radiance(module.field(), tmp_path / "t.safetensors", {})
    trained, _ = load_radiance(tmp_path / "t.safetensors", ns)
    for name, value in trained.parameters().items():
        assert np.array_equal(value.numpy(), module.get_parameter(name.replace(".", "__")).detach().numpy())
        assert np.array_equal(field.parameters()[name].numpy(), before[name])
    assert np.array_equal(trained.density(ns.Array3f(p.numpy().T)).numpy(), module.density(p).detach().numpy())


@pytest.mark.parametrize("change", [lambda p: p.double(), lambda p: p[:, :2], lambda p: p[:10], lambda p: p[0]])
def test06_wrong_tensors(torch, interop, change):
    module, (p, d) = interop.RadianceModule(radiance()), rays(torch, 20)
    with pytest.raises(ValueError, match="float32.*3"):
        module(change(p), d)


def test_missing_torch_names_extra():
    program = "import sys; sys.modules['torch'] = None; import nerg_mi.fields.torch_modules"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert done.returncode == 1
    assert done.stderr.strip().splitlines()[-1].endswith('which is not installed: pip install "nerg-mi[torch]"')
