"""A gaze field of a kind that the library does not know: one class, and checkpoints of it are read and rendered."""

from dataclasses import asdict, dataclass
from typing import ClassVar

import drjit as dr
import drjit.llvm.ad as ns
import numpy as np
import pytest

from nerg_mi.evaluation.gaze import FieldDensity
from nerg_mi.fields import gaze_base
from nerg_mi.fields.gaze_base import GazeEnsemble
from nerg_mi.formats.fields import load_gaze, save_gaze
from nerg_mi.maths.geometry import Box
from nerg_mi.transport.geometry import Place

from .scenes import camera, channels, named, observer_at
from .test_nerg_normalized import around, room

BOX = Box((-1, -1, -1), (1, 1, 1))


@dataclass(frozen=True)
class LobeConfig:
    """A density that falls off with the angle to an axis, wherever the observer stands."""

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
    """exp(sharpness axis . r_o), as a second recipe of log densities would be."""

    kind = "lobe"
    networks, support, limits = 1, None, {}
    DRJIT_STRUCT: ClassVar[dict] = {"axis": None}

    def __init__(self, config, box, axis):
        self.config, self.box, self.axis, self.members, self.ns = config, box, axis, [self], ns

    @classmethod
    def from_arrays(cls, about, box, arrays):
        config = LobeConfig(**{k: v for k, v in about.items() if k != "kind"})
        return cls(config, box, arrays.ns.TensorXf(arrays.array("axis", 3)))

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


@pytest.fixture(autouse=True)
def known(monkeypatch):
    monkeypatch.setattr(gaze_base, "_KINDS", dict(gaze_base._KINDS))
    gaze_base.register(LobeField)


def lobe(axis=(0.0, 0.0, 1.0), **more):
    return LobeField(LobeConfig(**more), BOX, ns.TensorXf(np.array(axis, np.float32)))


def volume(path, field):
    save_gaze(field, path, {})
    return {"type": "gazefield", "filename": str(path)}


def integrator(gaze, aovs="gaze,position", **more):
    return {"type": "nerg", "aovs": aovs, "radiance": False, "gaze": gaze, **more}


# Of exp(k cos) over the sphere.
TOTAL = 4 * np.pi * np.sinh(2.0) / 2.0


def test01_it_is_rendered_as_its_formula_says(rgb, tmp_path):
    eye = np.array([0.2, 0.1, 0.0])
    shown = integrator(volume(tmp_path / "g.safetensors", lobe()), observer=observer_at(rgb, *eye), falloff=0.0)
    out = channels(rgb, shown, camera(rgb, (0.1, -0.2, 0.3), (0.5, 0, 0)), **room(rgb))
    p = np.stack([out[f"position.{c}"] for c in "XYZ"], -1)
    r = (p - eye) / np.linalg.norm(p - eye, axis=-1, keepdims=True)
    seen = out["gaze.Y"] > 0
    assert seen.sum() > 100
    np.testing.assert_allclose(out["gaze.Y"][seen], (np.exp(2 * r[..., 2]) / TOTAL)[seen], rtol=2e-3)


def test02_its_integral_is_one(rgb, tmp_path):
    density, angle = around(rgb, (0.3, 0, -0.2), integrator(volume(tmp_path / "g.safetensors", lobe())), **room(rgb))
    assert (density * angle).sum() == pytest.approx(1, abs=0.01)


def test03_it_is_averaged_and_its_weights_are_parameters(rgb, tmp_path):
    members = [lobe(), lobe((0, 1, 0))]
    shown = integrator(volume(tmp_path / "e.safetensors", GazeEnsemble(members)), "gaze,gaze_std")
    sensor = camera(rgb, (0.1, -0.2, 0.3), (0.5, 0, 0))
    scene = rgb.load_dict({"type": "scene", "integrator": shown, "sensor": sensor, **room(rgb)})
    out = named(rgb, np.array(rgb.render(scene, spp=1)), shown)
    singles = [
        channels(rgb, integrator(volume(tmp_path / f"{k}.safetensors", m)), sensor, **room(rgb))["gaze.Y"]
        for k, m in enumerate(members)
    ]
    np.testing.assert_allclose(out["gaze.Y"], np.mean(singles, axis=0), rtol=1e-4)
    np.testing.assert_allclose(out["gaze_std.Y"], np.std(singles, axis=0, ddof=1), rtol=1e-3, atol=1e-6)
    assert [k for k in rgb.traverse(scene).keys() if "gaze" in k] == [
        "integrator.gaze.0.axis",
        "integrator.gaze.1.axis",
    ]


def test04_it_is_scored_like_any_other(rgb, tmp_path):
    volume(tmp_path / "g.safetensors", lobe())
    field, _ = load_gaze(tmp_path / "g.safetensors", ns)
    place = Place(None, rgb.load_dict({"type": "scene", **room(rgb)}))
    d = np.array([[0, 0, 1.0], [1, 0, 0], [0, 0, -1]])
    found = FieldDensity(field, place)(np.array([[0.1, 0.2, 0.3]]), d)[0]
    np.testing.assert_allclose(found, np.exp(2 * d[:, 2]) / TOTAL, rtol=2e-3)


def test05_without_it_the_checkpoint_is_refused(rgb, tmp_path):
    path = tmp_path / "g.safetensors"
    volume(path, lobe())
    del gaze_base._KINDS["lobe"]
    with pytest.raises(ValueError, match='"lobe"'):
        load_gaze(path, ns)
