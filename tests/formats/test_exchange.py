"""Scenes for Rerun and OpenUSD, read back by the libraries of these formats."""

from __future__ import annotations

import json

import numpy as np
import pytest

from nerg_mi.errors import NergError
from nerg_mi.fields.splats import Splats
from nerg_mi.formats.exchange import (
    FORMATS,
    ExchangeCamera,
    ExchangeFixations,
    ExchangeMesh,
    ExchangePoints,
    ExchangeRays,
    ExchangeScene,
    write_exchange,
)
from nerg_mi.maths.color import encode_srgb

RNG = np.random.default_rng(0)
MESH = ExchangeMesh(
    "a room", RNG.random((5, 3)), np.array([[0, 1, 2], [2, 3, 4]]), RNG.random((5, 3)), RNG.random(5), "g [1/m²]"
)
POINTS = ExchangePoints("field", RNG.random((7, 3)), RNG.random((7, 3)), RNG.random(7), "gaze [1/sr]")
SPLATS = Splats(
    RNG.random((4, 3)),
    0.1 * RNG.random((4, 3)) + 0.01,
    RNG.normal(size=(4, 4)),
    RNG.random(4),
    0.2 * RNG.normal(size=(4, 4, 3)),
)
RAYS = ExchangeRays("1 Ada", np.array([0.5, 0.51, 2.0]), RNG.random((3, 3)), 3 + RNG.random((3, 3)), "eye")
KINDS, RULES = np.array(["fixation", "vor_fixation"]), {"velocity": 100.0}
FIXATIONS = ExchangeFixations("1 Ada", np.array([0.5, 2.0]), np.array([0.25, 1.0]), RNG.random((2, 3)), KINDS, RULES)
POSE = np.array([[0, 0, 1, 4.0], [1, 0, 0, 5], [0, 1, 0, 6], [0, 0, 0, 1]])
CAMERA = ExchangeCamera("camera", POSE, 80.0, 60, 40)
SCENE = ExchangeScene((MESH,), (POINTS,), SPLATS, (RAYS,), (FIXATIONS,), (CAMERA,), meters_per_unit=0.5)
close = lambda a, b: np.allclose(np.asarray(a, float), np.asarray(b, float), atol=1e-6)


def test_rerun_reads_what_was_written(tmp_path):
    reader = pytest.importorskip("rerun.chunk")
    write_exchange(SCENE, tmp_path / "a.rrd")
    content, times = {}, {}
    for chunk in reader.RrdReader(tmp_path / "a.rrd").stream():
        batch = chunk.to_record_batch()
        for name in batch.schema.names:
            column = batch.column(name)
            if name == "time":
                times[chunk.entity_path] = np.array(column.cast("int64")) / 1e9
            content[chunk.entity_path, name] = column.to_pylist()
    get = lambda entity, name: content[f"/scene/{entity}", name]
    mesh = "mesh/a_room"
    assert close(get(mesh, "Mesh3D:vertex_positions")[0], MESH.vertices)
    assert np.array_equal(get(mesh, "Mesh3D:triangle_indices")[0], MESH.faces)
    assert close(get(mesh, "value")[0], MESH.values) and get(mesh, "label")[0] == [MESH.label]
    for entity, component, colors in (
        (mesh, "Mesh3D:vertex_colors", MESH.colors),
        ("points/field", "Points3D:colors", POINTS.colors),
    ):
        rgba = np.array(get(entity, component)[0], np.uint32)
        stored = np.stack([rgba >> 24, rgba >> 16 & 255, rgba >> 8 & 255], axis=-1) / 255
        assert np.allclose(stored, encode_srgb(colors), atol=0.6 / 255)
    assert close(get("points/field", "Points3D:positions")[0], POINTS.positions)
    assert close(get("splats", "GaussianSplats3D:centers")[0], SPLATS.centers)
    assert close(get("splats", "GaussianSplats3D:scales")[0], SPLATS.scales)
    assert close(get("splats", "GaussianSplats3D:quaternions")[0], SPLATS.rotations[:, [1, 2, 3, 0]])
    coefficients = np.reshape(get("splats", "GaussianSplats3D:sh_coefficients")[0], (4, 15, 3))
    # Rerun stores them in half precision.
    assert np.allclose(coefficients[:, :3], SPLATS.harmonics[:, 1:], atol=1e-3) and not coefficients[:, 3:].any()
    # Times of gaze are on a timeline in seconds.
    assert close(times["/scene/gaze/1_Ada/rays"], RAYS.times) and close(
        times["/scene/gaze/1_Ada/fixations"], FIXATIONS.times
    )
    strips = np.reshape(get("gaze/1_Ada/rays", "LineStrips3D:strips"), (3, 2, 3))
    assert close(strips[:, 0], RAYS.origins) and close(strips[:, 1], RAYS.ends)
    assert close(np.reshape(get("gaze/1_Ada/fixations", "Points3D:positions"), (2, 3)), FIXATIONS.positions)
    assert close(np.ravel(get("gaze/1_Ada/fixations", "duration")), FIXATIONS.durations)
    assert np.ravel(get("gaze/1_Ada/fixations", "kind")).tolist() == KINDS.tolist()
    assert json.loads(np.ravel(get("gaze/1_Ada/fixations", "definition"))[0]) == RULES
    assert np.ravel(get("gaze/1_Ada", "tracking")).tolist() == ["eye"]
    assert close(np.ravel(get("cameras/camera", "Transform3D:translation")), [4, 5, 6])
    matrix = np.reshape(get("cameras/camera", "Transform3D:mat3x3"), (3, 3)).T
    # The camera looks along +z: the opposite of the backward axis.
    assert close(matrix[:, 2], -POSE[:3, 2]) and close(np.linalg.det(matrix), 1)
    focal = np.reshape(get("cameras/camera", "Pinhole:image_from_camera"), (3, 3))[0, 0]
    assert close(2 * np.degrees(np.arctan(30 / focal)), 80)


@pytest.mark.parametrize("suffix", [".usdc", ".usda"])
def test_usd_reads_what_was_written(tmp_path, suffix):
    pytest.importorskip("pxr")
    from pxr import Usd, UsdGeom, UsdVol

    write_exchange(SCENE, tmp_path / f"a{suffix}")
    stage = Usd.Stage.Open(str(tmp_path / f"a{suffix}"))
    assert UsdGeom.GetStageUpAxis(stage) == "Z" and UsdGeom.GetStageMetersPerUnit(stage) == 0.5  # noqa: RUF069 (stored)
    assert stage.GetDefaultPrim().GetPath() == "/scene"
    get = lambda path, name, *time: stage.GetPrimAtPath(f"/scene/{path}").GetAttribute(name).Get(*time)
    mesh = UsdGeom.Mesh(stage.GetPrimAtPath("/scene/meshes/a_room"))
    assert close(mesh.GetPointsAttr().Get(), MESH.vertices) and mesh.GetSubdivisionSchemeAttr().Get() == "none"
    assert np.array_equal(np.reshape(mesh.GetFaceVertexIndicesAttr().Get(), (-1, 3)), MESH.faces)
    attention = UsdGeom.PrimvarsAPI(mesh).GetPrimvar("attention")
    assert close(attention.Get(), MESH.values) and attention.GetInterpolation() == "vertex"
    assert attention.GetAttr().GetDocumentation() == MESH.label
    assert close(mesh.GetDisplayColorPrimvar().Get(), MESH.colors)
    assert close(get("points/field", "points"), POINTS.positions)
    assert close(get("points/field", "primvars:attention"), POINTS.values)
    splats = stage.GetPrimAtPath("/scene/splats")
    assert splats.IsA(UsdVol.ParticleField3DGaussianSplat)
    assert close(get("splats", "positions"), SPLATS.centers) and close(get("splats", "scales"), SPLATS.scales)
    stored = [(q.GetReal(), *q.GetImaginary()) for q in get("splats", "orientations")]
    assert close(stored, SPLATS.rotations) and close(get("splats", "opacities"), SPLATS.opacities)
    assert get("splats", "radiance:sphericalHarmonicsDegree") == 1
    assert close(np.reshape(get("splats", "radiance:sphericalHarmonicsCoefficients"), (4, 4, 3)), SPLATS.harmonics)
    camera = UsdGeom.Camera(stage.GetPrimAtPath("/scene/cameras/camera")).GetCamera(Usd.TimeCode.Default())
    assert close(camera.GetFieldOfView(camera.FOVHorizontal), 80) and close(camera.aspectRatio, 1.5)
    assert close(np.array(camera.transform).T, POSE)
    person = stage.GetPrimAtPath("/scene/gaze").GetChildren()[0]
    assert person.GetDisplayName() == "1 Ada"
    name = f"gaze/{person.GetName()}"
    assert close(np.reshape(get(f"{name}/rays", "points"), (3, 2, 3)), np.stack([RAYS.origins, RAYS.ends], axis=1))
    assert close(get(f"{name}/rays", "primvars:time"), RAYS.times)
    rate = stage.GetTimeCodesPerSecond()
    for time, origin in zip(RAYS.times, RAYS.origins):
        assert close(get(f"{name}/eyes", "xformOp:translate", Usd.TimeCode(time * rate)), origin)
    assert close([stage.GetStartTimeCode(), stage.GetEndTimeCode()], [500, 2000])
    assert close(get(f"{name}/fixations", "points"), FIXATIONS.positions)
    assert close(get(f"{name}/fixations", "primvars:duration"), FIXATIONS.durations)
    assert person.GetCustomDataByKey("tracking") == "eye"
    fixations = stage.GetPrimAtPath(f"/scene/{name}/fixations")
    assert json.loads(fixations.GetCustomDataByKey("definition")) == RULES
    assert fixations.GetCustomDataByKey("kinds").split() == KINDS.tolist()


def test_an_empty_scene_and_other_formats_are_refused(tmp_path):
    pytest.importorskip("pxr.Usd", reason="usd-core, of the extra usd, is not installed")
    with pytest.raises(NergError, match="nothing to write"):
        write_exchange(ExchangeScene(), tmp_path / "a.usdc")
    with pytest.raises(NergError, match=r"\.rrd"):
        write_exchange(SCENE, tmp_path / "a.fbx")
    assert not list(tmp_path.iterdir()) and set(FORMATS) == {".rrd", ".usdc", ".usda", ".usd"}
