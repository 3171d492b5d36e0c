"""The networks, their gradients and one gaze field against torch, an autograd that shares no code with ours."""

import drjit as dr
import drjit.llvm.ad as ns
import numpy as np

from nerg_mi.fields.encoding import HashGridConfig, encode_direction
from nerg_mi.fields.gaze_product import GazeConfig, GazeField
from nerg_mi.fields.mlp import MLP
from nerg_mi.maths.geometry import Box
from tests.fields.test_mlp import evaluated_backwards

RNG = np.random.default_rng(0)


def forward(torch, weights, x):
    for i, w in enumerate(weights):
        x = torch.nn.functional.linear(x, w)
        x = torch.relu(x) if i + 1 < len(weights) else x
    return x


def test01_values_and_weight_gradients_of_both_modes(torch):
    net = MLP.random([5, 16, 8, 3], ns, RNG)
    x = RNG.normal(size=(40, 5)).astype(np.float32)
    mix = RNG.normal(size=(40, 3)).astype(np.float32)
    theirs = [torch.tensor(w.numpy(), requires_grad=True) for w in net.weights]
    out = forward(torch, theirs, torch.tensor(x))
    (out * torch.tensor(mix)).sum().backward()

    for mode in ("coop", "tensor"):
        value = evaluated_backwards(net, x, mix, mode)
        assert np.allclose(value, out.detach().numpy(), rtol=1e-5, atol=1e-6), mode
        for a, b in zip(net.weights, theirs):
            assert np.allclose(dr.grad(a).numpy(), b.grad.numpy(), rtol=1e-4, atol=1e-5), mode
        dr.clear_grad(net.weights)


def test02_equation_1_of_a_gaze_field(torch):
    config = GazeConfig(HashGridConfig(levels=2, log2_rows=10, base=4, finest=16), width=16, geometry=7, sh_degree=2)
    field = GazeField.random(config, Box((-1, -1, -1), (1, 1, 1)), ns)
    field.set_parameters({"grid.table": ns.Float(RNG.normal(size=len(field.grid.table)).astype(np.float32))})
    p_o = RNG.uniform(-0.9, 0.9, (30, 3)).astype(np.float32)
    p_od = RNG.uniform(-0.9, 0.9, (30, 3)).astype(np.float32)
    r_o = (p_od - p_o) / np.linalg.norm(p_od - p_o, axis=1, keepdims=True)

    def head(p, d, name):
        features = np.array([f.numpy() for f in field.grid(field.box.to_unit(ns.Array3f(p.T)))]).T
        harmonics = np.array([np.broadcast_to(h.numpy(), 30) for h in encode_direction(ns.Array3f(d.T), 2)]).T
        nets = {k: [torch.tensor(w.numpy()) for w in getattr(field, k).weights] for k in field.NETS}
        geometry = forward(torch, nets["position_net"], torch.tensor(features))
        hidden = forward(torch, nets["direction_net"], torch.cat([torch.tensor(harmonics.copy()), geometry], 1))
        return forward(torch, nets[name], torch.relu(hidden))[:, 0]

    emit = torch.nn.functional.softplus(head(p_od, -r_o, "emit_head")) * getattr(config, "emit_scale", 1.0)
    gaze = emit * torch.sigmoid(head(p_o, r_o, "capture_head"))
    ours = field.evaluate(ns.Array3f(p_od.T), ns.Array3f(p_o.T), ns.Array3f(r_o.T))[0]
    assert np.allclose(ours.numpy(), gaze.numpy(), rtol=1e-4)
