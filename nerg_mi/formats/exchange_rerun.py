"""Recordings of Rerun (.rrd): geometry without time, gaze on the timeline ``time``. Needs the extra ``rerun``."""

from __future__ import annotations

import json
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from nerg_mi.fields.splats import Splats
from nerg_mi.files.atomic import write_bytes
from nerg_mi.maths.color import encode_srgb

from .exchange import ExchangeScene, unique_names

TIMELINE = "time"
"""Name of the timeline, in seconds of the recording."""

_FIXATION_RADIUS = 0.03  # of a fixation of one second, in metres
_SH0 = 0.28209479177387814


def write_rerun(scene: ExchangeScene, path: Path) -> None:
    """Write ``scene`` as a Rerun recording.

    Values of meshes and points are stored as component ``value`` of their entities, which no view displays, and are
    named by the component ``label``.
    """
    rr: Any = import_module("rerun")
    # Without it, data that Rerun rejects are left out with a warning.
    rr.set_strict_mode(True)
    recording = rr.RecordingStream("nerg_mi", recording_id="nerg_mi", send_properties=False)
    # Errors of Rerun's own file writer are only logged.
    memory = recording.memory_recording()
    axes = {"z": rr.ViewCoordinates.RIGHT_HAND_Z_UP, "y": rr.ViewCoordinates.RIGHT_HAND_Y_UP}
    recording.log("scene", axes[scene.up], static=True)
    for name, mesh in zip(_entities("mesh", scene.meshes), scene.meshes):
        recording.log(
            name,
            rr.Mesh3D(
                vertex_positions=mesh.vertices.astype(np.float32),
                triangle_indices=mesh.faces.astype(np.uint32),
                vertex_colors=None if mesh.colors is None else _to_bytes(mesh.colors),
            ),
            *_values(rr, mesh.values, mesh.label),
            static=True,
        )
    for name, points in zip(_entities("points", scene.points), scene.points):
        shown = rr.Points3D(points.positions.astype(np.float32), colors=_to_bytes(points.colors))
        recording.log(name, shown, *_values(rr, points.values, points.label), static=True)
    if scene.splats is not None:
        recording.log("scene/splats", _splats(rr, scene.splats), static=True)
    for name, camera in zip(_entities("cameras", scene.cameras), scene.cameras):
        # Rerun's pinhole looks along +z with y down.
        rotation = camera.to_world[:3, :3] @ np.diag([1.0, -1.0, -1.0])
        focal = float(camera.width / 2 / np.tan(np.radians(camera.fov) / 2))
        recording.log(name, rr.Transform3D(translation=camera.to_world[:3, 3], mat3x3=rotation), static=True)
        size = camera.width, camera.height
        recording.log(name, rr.Pinhole(focal_length=focal, width=size[0], height=size[1]), static=True)
    names = scene.name_participants(_part)
    for rays in scene.rays:
        name = names[rays.participant]
        time = [rr.TimeColumn(TIMELINE, duration=rays.times)]
        lines = np.stack([rays.origins, rays.ends], axis=1).astype(np.float32)
        recording.send_columns(f"scene/gaze/{name}/rays", time, rr.LineStrips3D.columns(strips=list(lines)))
        heads = rr.Points3D.columns(positions=rays.origins.astype(np.float32))
        recording.send_columns(f"scene/gaze/{name}/{rays.origin_name}", time, heads)
        recording.log(f"scene/gaze/{name}", rr.AnyValues(tracking=rays.tracking), static=True)
    for fixations in scene.fixations:
        name = names[fixations.participant]
        radii = _FIXATION_RADIUS / scene.meters_per_unit * np.sqrt(fixations.durations)
        points = rr.Points3D.columns(positions=fixations.positions.astype(np.float32), radii=radii.astype(np.float32))
        durations = rr.AnyValues.columns(duration=fixations.durations, kind=fixations.kinds.tolist())
        time = [rr.TimeColumn(TIMELINE, duration=fixations.times)]
        recording.send_columns(f"scene/gaze/{name}/fixations", time, [*points, *durations])
        definition = rr.AnyValues(definition=json.dumps(dict(fixations.definition)))
        recording.log(f"scene/gaze/{name}/fixations", definition, static=True)
    write_bytes(path, memory.drain_as_bytes())
    recording.disconnect()


def _entities(kind: str, things: tuple[Any, ...]) -> list[str]:
    return [f"scene/{kind}/{name}" for name in unique_names([thing.name for thing in things], _part)]


def _part(name: str) -> str:
    """Return ``name`` as a part of an entity path."""
    return "".join(c if c.isalnum() or c in "-_." else "_" for c in name) or "_"


def _values(rr: Any, values: np.ndarray | None, label: str) -> list[Any]:
    return [] if values is None else [rr.AnyValues(value=values.astype(np.float32), label=label)]


def _to_bytes(linear: np.ndarray) -> np.ndarray:
    return (encode_srgb(np.clip(linear, 0, 1)) * 255 + 0.5).astype(np.uint8)


def _splats(rr: Any, splats: Splats) -> Any:
    base = np.clip(0.5 + _SH0 * splats.harmonics[:, 0], 0, 1)
    base = encode_srgb(base) if splats.color_space == "linear" else base
    rgba = (np.column_stack([base, splats.opacities]) * 255 + 0.5).astype(np.uint8)
    rest = np.zeros((len(splats.centers), 15, 3), np.float32)
    rest[:, : splats.harmonics.shape[1] - 1] = splats.harmonics[:, 1:]
    return rr.GaussianSplats3D(
        splats.centers,
        scales=splats.scales,
        quaternions=splats.rotations[:, [1, 2, 3, 0]],
        colors=rgba,
        sh_coefficients=rest if splats.harmonics.shape[1] > 1 else None,
        spherical_harmonics_degree=int(np.sqrt(splats.harmonics.shape[1])) - 1,
    )
