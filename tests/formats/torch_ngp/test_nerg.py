"""Checkpoints of the paper's authors: the gaze networks against their restatement, and what is refused."""

import sys
import types
from enum import Enum

import drjit as dr
import drjit.llvm.ad as ns
import numpy as np
import pytest

from nerg_mi.formats.fields import load_gaze, save_gaze
from nerg_mi.formats.torch_files import write_torch
from nerg_mi.formats.torch_ngp import read_nerg
from tests.reference import torch_ngp_numpy as reference

from .test_fields import small_state

pytestmark = pytest.mark.usefixtures("torch")


def save(path, state, variant="EmitCapture", nerf=None, **more):
    state = {**state, **{f"model_nerf.{k}": v for k, v in (nerf or {}).items()}}
    write_torch(path, {"epoch": 2, "global_step": 5, "stats": {}, "variant": variant, "model": state, **more})
    return path


def queries(bound, n=2000):
    rng = np.random.default_rng(1)
    p_od, p_o = (rng.uniform(-1.01 * bound, 1.01 * bound, (n, 3)).astype(np.float32) for _ in range(2))
    r_o = (p_od - p_o) / np.linalg.norm(p_od - p_o, axis=1, keepdims=True)
    return p_od, p_o, r_o.astype(np.float32)


def small_gaze(layernorm=True, variant="EmitCapture"):
    """A gaze field of the authors' networks on a grid of two levels."""
    rng = np.random.default_rng(3)
    state = reference.gaze_state(1, rng, variant, layernorm)
    where = reference.offsets(2, 256)
    state |= {"encoder.embeddings": reference.table(where[-1], rng), "encoder.offsets": where}
    first = "net1.lin0.weight" if layernorm else "net1.0.weight"
    state[first] = reference.matrix(rng, 64, 4)
    if layernorm:
        state |= {"net1.layernorm0.weight": np.ones(4, np.float32), "net1.layernorm0.bias": np.zeros(4, np.float32)}
    return state


def compare(gaze, state, bound, variant="EmitCapture"):
    q = queries(bound)
    got = gaze.evaluate(*[ns.Array3f(x.T) for x in q])
    dr.eval(got)
    for a, b in zip(got, reference.gaze(state, bound, *q, variant)):
        assert np.abs(a.numpy() - b).max() <= 2e-6 * max(np.abs(b).max(), 1)


@pytest.mark.parametrize("bound", [2, 5])
def test01_equals_the_restatement_in_the_authors_sizes(tmp_path, bound):
    state = reference.gaze_state(bound, np.random.default_rng(bound))
    field, gaze, origin = read_nerg(save(tmp_path / "nerg_ep0002.pth", state), ns)
    assert field is None and origin["format"] == "NeRG" and origin["epoch"] == 2
    assert (gaze.config.trunk, gaze.config.activation, gaze.config.variant) == ("layernorm", "linear", "emit_capture")
    save_gaze(gaze, tmp_path / "g.safetensors", origin)
    again, _ = load_gaze(tmp_path / "g.safetensors", ns)
    assert again.config == gaze.config and again.box == gaze.box
    compare(again, state, bound)


@pytest.mark.parametrize("layernorm", [True, False])
@pytest.mark.parametrize("variant", ["Emit", "Capture", "EmitCapture"])
def test02_variants_and_both_kinds_of_networks(tmp_path, layernorm, variant):
    state = small_gaze(layernorm, variant)
    _, gaze, _ = read_nerg(save(tmp_path / "n.pth", state, variant), ns)
    assert gaze.config.trunk == ("layernorm" if layernorm else "linear")
    compare(gaze, state, 1, variant)
    _, unnamed, _ = read_nerg(save(tmp_path / "n.pth", state, None), ns)
    assert unnamed.config == gaze.config


def test03_older_names_of_the_heads(tmp_path):
    state = small_gaze()
    for head in ("emit", "capture"):
        state[f"lin_{head}.weight"] = state.pop(f"{head}_head.weight")
    _, gaze, _ = read_nerg(save(tmp_path / "n.pth", state), ns)
    assert np.array_equal(gaze.emit_head.weights[0].numpy(), state["lin_emit.weight"])
    assert np.array_equal(gaze.capture_head.weights[0].numpy(), state["lin_capture.weight"])


def test04_as_torch_writes_it_with_an_enum_of_its_own(tmp_path, torch, monkeypatch):
    class NeRGVariant(Enum):
        EmitCapture = "EmitCapture"

        def __new__(cls, name):
            obj = object.__new__(cls)
            obj._value_, obj.emit = name, True
            return obj

    module = types.ModuleType("nerg.gaze_prediction")
    NeRGVariant.__module__, NeRGVariant.__qualname__, module.NeRGVariant = module.__name__, "NeRGVariant", NeRGVariant
    monkeypatch.setitem(sys.modules, "nerg", types.ModuleType("nerg"))
    monkeypatch.setitem(sys.modules, "nerg.gaze_prediction", module)
    state = {**small_gaze(), **{f"model_nerf.{k}": v for k, v in small_state().items()}}
    torch.save(
        {
            "epoch": 1,
            "global_step": 4,
            "stats": {},
            "variant": NeRGVariant.EmitCapture,
            "model": {k: torch.tensor(v) for k, v in state.items()},
        },
        tmp_path / "nerg_ep0001.pth",
    )
    monkeypatch.delitem(sys.modules, "nerg.gaze_prediction")
    monkeypatch.delitem(sys.modules, "nerg")
    field, gaze, _ = read_nerg(tmp_path / "nerg_ep0001.pth", ns)
    assert gaze.config.variant == "emit_capture" and field.config.width == 64
    assert np.array_equal(field.color_net.weights[2].numpy(), state["model_nerf.color_net.2.weight"])
    assert "nerg.gaze_prediction" not in sys.modules


@pytest.mark.parametrize("variant", ["EmitCaptureSemantic", "EmitSemanticFinetune", "EmitCaptureAttend"])
def test05_variants_that_are_not_read(tmp_path, variant):
    with pytest.raises(ValueError, match=f"of the variant {variant}; Emit, Capture, EmitCapture are read"):
        read_nerg(save(tmp_path / "n.pth", small_gaze(), variant), ns)


def test06_a_mixture_head_and_missing_heads(tmp_path):
    state = small_gaze()
    state["capture_head.mu.weight"] = state.pop("capture_head.weight")
    with pytest.raises(ValueError, match="von Mises-Fisher"):
        read_nerg(save(tmp_path / "n.pth", state), ns)
    del state["capture_head.mu.weight"]
    with pytest.raises(ValueError, match="EmitCapture and lacks"):
        read_nerg(save(tmp_path / "n.pth", state), ns)


def test07_averages_are_the_weights(tmp_path):
    path = save(tmp_path / "n.pth", small_gaze(), ema={"shadow_params": [np.zeros(3, np.float32)]})
    assert read_nerg(path, ns)[2]["weights"] == "moving averages"
    with pytest.raises(ValueError, match="without --no-ema"):
        read_nerg(path, ns, ema=False)
    with pytest.raises(ValueError, match="with --no-ema"):
        read_nerg(save(tmp_path / "n.pth", small_gaze()), ns, ema=True)
