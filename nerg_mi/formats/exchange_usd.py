"""OpenUSD scenes (.usdc, .usda): values as primvars, splats as ParticleField. Needs the extra ``usd``."""

from __future__ import annotations

import errno
import json
import os
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from nerg_mi.fields.splats import Splats

from .exchange import ExchangeScene, unique_names

VALUE = "attention"
"""Name of the primvar of values; its label is the attribute's documentation."""

TIME_CODES_PER_SECOND = 1000.0
"""Resolution of times: a time code is a millisecond."""

_WRITE_ERRORS = (errno.ENOSPC, errno.EFBIG, errno.EDQUOT, errno.EACCES)
"""Errors of files that USD reports by their text."""

_APERTURE = 36.0  # horizontal aperture of cameras in tenths of a unit, as of a film of 36 mm
_WIDTH = 0.01  # width of points in metres
_FIXATION_WIDTH = 0.06  # of a fixation of one second, in metres


def write_usd(scene: ExchangeScene, path: Path) -> None:
    """Write ``scene`` as a USD stage.

    The prims are below ``/scene``: ``meshes``, ``points``, ``splats``, ``cameras``, and ``gaze`` with ``eyes`` (an
    animated transform), ``rays`` and ``fixations`` of each participant. Values are primvars, colours are linear.
    """
    Gf, Sdf, Tf, Usd, UsdGeom, Vt = map(_import, ("Gf", "Sdf", "Tf", "Usd", "UsdGeom", "Vt"))
    stage = Usd.Stage.CreateInMemory()
    UsdGeom.SetStageUpAxis(stage, {"y": UsdGeom.Tokens.y, "z": UsdGeom.Tokens.z}[scene.up])
    UsdGeom.SetStageMetersPerUnit(stage, scene.meters_per_unit)
    stage.SetDefaultPrim(UsdGeom.Xform.Define(stage, "/scene").GetPrim())
    vectors = lambda values: Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(values, np.float32))
    floats = lambda values: Vt.FloatArray.FromNumpy(np.ascontiguousarray(values, np.float32))
    integers = lambda values: Vt.IntArray.FromNumpy(np.ascontiguousarray(values, np.int32).ravel())

    def add_primvars(prim: Any, named: dict[str, Any], interpolation: str, label: str = "") -> None:
        api = UsdGeom.PrimvarsAPI(prim)
        for name, values in named.items():
            primvar = api.CreatePrimvar(name, Sdf.ValueTypeNames.FloatArray, interpolation)
            primvar.Set(floats(values))
            primvar.GetAttr().SetDocumentation(label)

    def add_colors(prim: Any, colors: np.ndarray | None) -> None:
        if colors is not None:
            prim.CreateDisplayColorPrimvar(UsdGeom.Tokens.vertex).Set(vectors(colors))

    def paths(group: str, names: list[str]) -> list[str]:
        return [f"/scene/{group}/{name}" for name in unique_names(names, Tf.MakeValidIdentifier)]

    for target, mesh in zip(paths("meshes", [m.name for m in scene.meshes]), scene.meshes):
        prim = UsdGeom.Mesh.Define(stage, target)
        prim.CreatePointsAttr(vectors(mesh.vertices))
        prim.CreateFaceVertexCountsAttr(integers(np.full(len(mesh.faces), 3)))
        prim.CreateFaceVertexIndicesAttr(integers(mesh.faces))
        # Subdivision would round all edges.
        prim.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
        prim.CreateDoubleSidedAttr(True)
        prim.CreateExtentAttr(vectors(_extent(mesh.vertices)))
        add_colors(prim, mesh.colors)
        if mesh.values is not None:
            add_primvars(prim, {VALUE: mesh.values}, UsdGeom.Tokens.vertex, mesh.label)
    for target, points in zip(paths("points", [p.name for p in scene.points]), scene.points):
        prim = UsdGeom.Points.Define(stage, target)
        prim.CreatePointsAttr(vectors(points.positions))
        prim.CreateWidthsAttr(floats([_WIDTH / scene.meters_per_unit]))
        prim.SetWidthsInterpolation(UsdGeom.Tokens.constant)
        prim.CreateExtentAttr(vectors(_extent(points.positions)))
        add_colors(prim, points.colors)
        if points.values is not None:
            add_primvars(prim, {VALUE: points.values}, UsdGeom.Tokens.vertex, points.label)
    if scene.splats is not None:
        _add_splats(stage, "/scene/splats", scene.splats)
    for target, camera in zip(paths("cameras", [c.name for c in scene.cameras]), scene.cameras):
        prim = UsdGeom.Camera.Define(stage, target)
        # Row vectors, so that the matrix is transposed.
        prim.AddTransformOp().Set(Gf.Matrix4d(np.ascontiguousarray(camera.to_world.T, np.float64)))
        prim.CreateHorizontalApertureAttr(_APERTURE)
        prim.CreateVerticalApertureAttr(_APERTURE * camera.height / camera.width)
        prim.CreateFocalLengthAttr(float(_APERTURE / 2 / np.tan(np.radians(camera.fov) / 2)))
        prim.CreateClippingRangeAttr(Gf.Vec2f(0.01 / scene.meters_per_unit, 1e4 / scene.meters_per_unit))
    if scene.rays or scene.fixations:
        stage.SetTimeCodesPerSecond(TIME_CODES_PER_SECOND)
        times = np.concatenate([g.times for g in (*scene.rays, *scene.fixations)]) * TIME_CODES_PER_SECOND
        stage.SetStartTimeCode(float(times.min()))
        stage.SetEndTimeCode(float(times.max()))
    names = scene.name_participants(Tf.MakeValidIdentifier)
    for rays in scene.rays:
        target = f"/scene/gaze/{names[rays.participant]}"
        participant = UsdGeom.Xform.Define(stage, target).GetPrim()
        participant.SetDisplayName(rays.participant)
        participant.SetCustomDataByKey("tracking", rays.tracking)
        operation = UsdGeom.Xform.Define(stage, f"{target}/{rays.origin_name}").AddTranslateOp()
        for time, origin in zip(rays.times, rays.origins):
            operation.Set(Gf.Vec3d(*map(float, origin)), float(time * TIME_CODES_PER_SECOND))
        lines = np.stack([rays.origins, rays.ends], axis=1).reshape(-1, 3)
        prim = UsdGeom.BasisCurves.Define(stage, f"{target}/rays")
        prim.CreateTypeAttr(UsdGeom.Tokens.linear)
        prim.CreatePointsAttr(vectors(lines))
        prim.CreateCurveVertexCountsAttr(integers(np.full(len(rays.times), 2)))
        prim.CreateWidthsAttr(floats([_WIDTH / 4 / scene.meters_per_unit]))
        prim.SetWidthsInterpolation(UsdGeom.Tokens.constant)
        prim.CreateExtentAttr(vectors(_extent(lines)))
        add_primvars(prim, {"time": rays.times}, UsdGeom.Tokens.uniform, "seconds")
    for fixations in scene.fixations:
        target = f"/scene/gaze/{names[fixations.participant]}"
        prim = UsdGeom.Points.Define(stage, f"{target}/fixations")
        prim.CreatePointsAttr(vectors(fixations.positions))
        prim.CreateWidthsAttr(floats(_FIXATION_WIDTH / scene.meters_per_unit * np.sqrt(fixations.durations)))
        prim.CreateExtentAttr(vectors(_extent(fixations.positions)))
        named = {"time": fixations.times, "duration": fixations.durations}
        add_primvars(prim, named, UsdGeom.Tokens.vertex, "seconds")
        prim.GetPrim().SetCustomDataByKey("definition", json.dumps(dict(fixations.definition)))
        prim.GetPrim().SetCustomDataByKey("kinds", " ".join(fixations.kinds.tolist()))
    try:
        stage.Export(str(path))
    except Tf.ErrorException as error:
        code = next((c for c in _WRITE_ERRORS if os.strerror(c) in str(error)), errno.EIO)
        raise OSError(code, os.strerror(code), str(path)) from error


def _import(module: str) -> Any:
    return import_module(f"pxr.{module}")


def _add_splats(stage: Any, path: str, splats: Splats) -> None:
    Sdf, UsdVol, Vt = map(_import, ("Sdf", "UsdVol", "Vt"))
    prim = UsdVol.ParticleField3DGaussianSplat.Define(stage, path).GetPrim()
    vectors = lambda values: Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(values, np.float32).reshape(-1, 3))
    floats = lambda values: Vt.FloatArray.FromNumpy(np.ascontiguousarray(values, np.float32))
    prim.GetAttribute("positions").Set(vectors(splats.centers))
    prim.GetAttribute("scales").Set(vectors(splats.scales))
    # A quaternion of Gf stores its real part last.
    rotations = np.ascontiguousarray(splats.rotations[:, [1, 2, 3, 0]], np.float32)
    prim.GetAttribute("orientations").Set(Vt.QuatfArray.FromNumpy(rotations))
    prim.GetAttribute("opacities").Set(floats(splats.opacities))
    prim.GetAttribute("radiance:sphericalHarmonicsDegree").Set(int(np.sqrt(splats.harmonics.shape[1])) - 1)
    prim.GetAttribute("radiance:sphericalHarmonicsCoefficients").Set(vectors(splats.harmonics))
    prim.GetAttribute("extent").Set(vectors(_extent(splats.centers)))
    prim.CreateAttribute("nerg:colorSpace", Sdf.ValueTypeNames.Token).Set(splats.color_space)


def _extent(points: np.ndarray) -> np.ndarray:
    return np.stack([points.min(axis=0), points.max(axis=0)]) if len(points) else np.zeros((2, 3))
