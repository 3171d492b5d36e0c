"""Gaze fields that see a radiance field's geometry features: the paper's semantic variants."""

import drjit as dr
import numpy as np
import pytest

from . import fields
from .scenes import camera, channels, observed, observer_at, with_field, with_gaze


def points(mi, out, name, mask):
    return mi.Point3f(*[np.ascontiguousarray(out[f"{name}.{c}"][mask]) for c in "XYZ"])


def semantic_scene(files, tmp_path, aovs, **config):
    fields.gaze(tmp_path / "semantic.safetensors", **config)
    return with_field(
        files,
        aovs=aovs,
        depth="median",
        falloff=0.0,
        gaze={"type": "gazefield", "filename": str(tmp_path / "semantic.safetensors")},
    )


@pytest.mark.parametrize(
    "semantic, own, aligned",
    [("accumulated", False, True), ("accumulated", True, False), ("snapshot", False, False), ("snapshot", True, True)],
)
def test01_emit_takes_the_fields_features(rgb, files, tmp_path, semantic, own, aligned):
    """Against equation 1 evaluated apart, with features from AOVs: of a camera that stands where the observer does."""
    eye = (0.5, 0.4, -3)
    integrator = semantic_scene(
        files, tmp_path, "position,gaze,emit,capture,visibility,opacity", semantic=semantic, semantic_own=own
    )
    sensor = camera(rgb, eye)
    if not aligned:
        # An observer a hair beside the camera sees the same, by a pass of its own.
        integrator |= {"observer": observer_at(rgb, eye[0] + 1e-5, eye[1], eye[2]), "tolerance": 0.3}
    out = channels(rgb, integrator, sensor)
    seen = out["visibility.Y"] == 1
    name = "features" if semantic == "accumulated" else "features_at"
    blocks = channels(rgb, with_field(files, aovs=f"{name},opacity", depth="median", color_cutoff=0.0), sensor)
    features = [rgb.Float(np.ascontiguousarray(blocks[f"{name}.{k}"][seen])) for k in range(7)]
    p, p_o = points(rgb, out, "position", seen), rgb.Point3f(*eye)
    gaze = observed(rgb, integrator["gaze"], p_o)
    expected = gaze.evaluate(p, p_o, dr.normalize(p - p_o), True, features)
    assert seen.sum() > 10
    for channel, value in zip(("gaze.Y", "emit.Y", "capture.Y"), expected):
        assert np.allclose(out[channel][seen], np.array(value), rtol=5e-3), channel
    other = gaze.evaluate(p, p_o, dr.normalize(p - p_o), True, [f + 1 for f in features])
    assert not np.allclose(np.array(other[1]), np.array(expected[1]), rtol=5e-3)


def test02_a_field_with_other_features_is_refused(rgb, files, tmp_path):
    integrator = semantic_scene(files, tmp_path, "gaze", semantic="snapshot")
    without = {k: v for k, v in integrator.items() if k != "field"} | {"density": {"type": "constvolume", "value": 1.0}}
    with pytest.raises(RuntimeError, match='7.*"field"'):
        rgb.load_dict(without)
    fields.radiance(tmp_path / "field.safetensors", geometry=5)
    with pytest.raises(RuntimeError, match='7.*"field".*5'):
        rgb.load_dict({**integrator, "field": {"type": "nerf", "filename": str(tmp_path / "field.safetensors")}})
    assert rgb.load_dict(integrator).aov_names() == ["gaze.Y"]


def test03_features_where_none_are_wanted_are_refused(rgb, files):
    p = rgb.Point3f(0.1, 0.2, 0.3)
    gaze = observed(rgb, with_gaze(files)["gaze"], p + 1)
    with pytest.raises(ValueError, match="takes no semantic features, got 7"):
        gaze.evaluate(p, p + 1, rgb.Vector3f(0, 0, 1), True, [rgb.Float(0)] * 7)


def test04_configurations_that_make_no_sense_are_refused(tmp_path):
    for config, said in (
        ({"semantic": "labels"}, "accumulated, snapshot or none"),
        ({"semantic_own": True}, "say which"),
        ({"semantic": "snapshot", "variant": "capture"}, "no emit"),
    ):
        with pytest.raises(ValueError, match=said):
            fields.gaze(tmp_path / "x.safetensors", **config)
