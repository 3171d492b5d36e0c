"""Subprocess for structure from motion: ``python -m nerg_mi.photos.structure_worker FOLDER``.

pycolmap includes compression libraries that conflict with other libraries in the same process (writing a PNG file with
Pillow may crash), aborts on errors, and handles Ctrl-C only between its steps. This process therefore loads nothing
else, and its parent may terminate it at any time.

FOLDER contains ``job.json`` (see `structure`) and the small images; ``sparse`` and ``result.npz`` are written there.
Each line on the standard output is a JSON list: stage, completed steps, total steps.
"""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from .colmap import estimate_up, rotation_to_z
from .structure import select_pairs, small_file_name

MIN_MODEL_SIZE = 3  # minimum number of images of a model; two images do not constrain the lens distortion

# Minimum number of images of a camera for OpenCV's lens model; others have a focal length and one radial coefficient.
_MIN_PICTURES_OPENCV = 10
_FLIP = np.diag([1.0, -1.0, -1.0])
_ERROR_LOG_LEVEL = 2  # glog level: errors


def main(folder: Path, on_progress: Callable[..., None]) -> None:
    """Run the job of ``job.json`` in ``folder``, and report progress to ``on_progress``."""
    import pycolmap

    pycolmap.logging.minloglevel = _ERROR_LOG_LEVEL
    job = json.loads((folder / "job.json").read_text(encoding="utf-8"))
    pycolmap.set_random_seed(job["seed"])
    database = folder / "database.db"
    _write_database(pycolmap, database, job)
    _extract_features(pycolmap, database, folder, job, on_progress)
    _match_pairs(pycolmap, database, folder, job, on_progress)
    models = _map_incrementally(pycolmap, database, folder, job, on_progress)
    models = sorted(models, key=lambda m: -m.num_reg_images())
    result: dict[str, Any] = {"parts": [[_get_index(m.image(i)) for i in m.reg_image_ids()] for m in models]}
    if models:
        result |= _finish_model(pycolmap, models[0], folder, job)
    to_world, points, colors = (
        _get_points_and_poses(models[0]) if models else (np.zeros((0, 4, 4)), np.zeros((0, 3)), np.zeros((0, 3)))
    )
    np.savez(
        folder / "result.npz", result=np.array(json.dumps(result)), to_world=to_world, points=points, colors=colors
    )


def _write_database(pycolmap: Any, path: Path, job: dict) -> None:
    """Write cameras, and images with one frame each, as COLMAP 4 requires."""
    database = pycolmap.Database.open(path)
    for number, camera in enumerate(job["cameras"], 1):
        model = job["lens"] or ("OPENCV" if camera["pictures"] >= _MIN_PICTURES_OPENCV else "SIMPLE_RADIAL")
        focal = camera["focal"] or 1.2 * max(camera["small"])
        colmap_camera = pycolmap.Camera.create_from_model_name(number, model, focal, *camera["small"])
        colmap_camera.has_prior_focal_length = camera["focal"] is not None
        database.write_camera(colmap_camera, use_camera_id=True)
        rig = pycolmap.Rig()
        rig.rig_id = number
        rig.add_ref_sensor(colmap_camera.sensor_id)
        database.write_rig(rig, use_rig_id=True)
    for number, picture in enumerate(job["pictures"], 1):
        image = pycolmap.Image(name=small_file_name(number - 1), camera_id=picture["camera"] + 1, image_id=number)
        database.write_image(image, use_image_id=True)
        frame = pycolmap.Frame()
        frame.frame_id, frame.rig_id = number, picture["camera"] + 1
        frame.add_data_id(image.data_id)
        database.write_frame(frame, use_frame_id=True)
    database.close()


def _extract_features(pycolmap: Any, database: Path, folder: Path, job: dict, on_progress: Callable[..., None]) -> None:
    options = pycolmap.FeatureExtractionOptions()
    options.num_threads = job["threads"]
    names = [small_file_name(k) for k in range(len(job["pictures"]))]
    # Processed in batches, to report progress between them.
    batch_size = 2 * (os.cpu_count() or 1) if job["threads"] < 1 else 2 * job["threads"]
    for begin in range(0, len(names), batch_size):
        on_progress("features", begin, len(names))
        batch = names[begin : begin + batch_size]
        pycolmap.extract_features(database, folder / "small", image_names=batch, extraction_options=options)


def _match_pairs(pycolmap: Any, database: Path, folder: Path, job: dict, on_progress: Callable[..., None]) -> None:
    matching, checking = pycolmap.FeatureMatchingOptions(), pycolmap.TwoViewGeometryOptions()
    matching.num_threads, checking.ransac.random_seed = job["threads"], job["seed"]
    pairing = pycolmap.ImportedPairingOptions()
    pairing.match_list_path = folder / "pairs.txt"
    pairs = select_pairs(len(job["pictures"]), job["matching"])
    batch_size = max(50, len(pairs) // 50)
    for begin in range(0, len(pairs), batch_size):
        on_progress("matching", begin, len(pairs))
        lines = [f"{small_file_name(i)} {small_file_name(j)}\n" for i, j in pairs[begin : begin + batch_size]]
        (folder / "pairs.txt").write_text("".join(lines), encoding="utf-8")
        pycolmap.match_image_pairs(
            database, matching_options=matching, pairing_options=pairing, verification_options=checking
        )


def _map_incrementally(
    pycolmap: Any, database: Path, folder: Path, job: dict, on_progress: Callable[..., None]
) -> list[Any]:
    """Return all models. Unconnected images are in different models."""
    options = pycolmap.IncrementalPipelineOptions()
    options.num_threads = options.mapper.num_threads = job["threads"]
    options.random_seed = options.mapper.random_seed = options.triangulation.random_seed = job["seed"]
    options.min_model_size, options.max_num_models = MIN_MODEL_SIZE, 10
    count, registered = len(job["pictures"]), 0

    def on_initial_pair() -> None:
        nonlocal registered
        registered = 2
        on_progress("mapping", registered, count)

    def on_next_image() -> None:
        nonlocal registered
        registered += 1
        on_progress("mapping", registered, count)

    on_progress("mapping", 0, count)
    (folder / "models").mkdir()
    models = pycolmap.incremental_mapping(
        database,
        folder / "small",
        folder / "models",
        options=options,
        initial_image_pair_callback=on_initial_pair,
        next_image_callback=on_next_image,
    )
    return [models[k] for k in sorted(models) if models[k].num_reg_images() >= MIN_MODEL_SIZE]


def _get_index(image: Any) -> int:
    return int(image.image_id) - 1


def _finish_model(pycolmap: Any, model: Any, folder: Path, job: dict) -> dict:
    """Rotate the model upright, restore image names and sizes, and write it."""
    out: dict[str, Any] = {
        "error": model.compute_mean_reprojection_error(),
        "points": model.num_points3D(),
        "observations": model.compute_mean_observations_per_reg_image(),
    }
    if job["orient"]:
        up = estimate_up(_get_poses(model), np.array([p.xyz for p in model.points3D.values() if p.track.length() > 2]))
        out["up"] = {
            "roll": up.median_roll,
            "plane": up.plane_fraction,
            "between": up.plane_angle,
            "direction": up.direction.tolist(),
        }
        turn = pycolmap.Rotation3d(rotation_to_z(up.direction))
        model.transform(pycolmap.Sim3d(1.0, turn, np.zeros(3)))
    for camera in model.cameras.values():
        _resize(pycolmap, camera, job["cameras"][camera.camera_id - 1]["size"])
    for image in model.images.values():
        picture = job["pictures"][_get_index(image)]
        image.name = picture["name"]
        camera = job["cameras"][picture["camera"]]
        factor = np.divide(camera["size"], camera["small"])
        if np.any(factor != 1):
            for point in image.points2D:
                point.xy = point.xy * factor
    out["lenses"] = [
        {"model": c.model_name, "size": [c.width, c.height], "parameters": np.asarray(c.params).tolist()}
        for c in model.cameras.values()
    ]
    (folder / "sparse" / "0").mkdir(parents=True)
    model.write_binary(folder / "sparse" / "0")
    return out


def _resize(pycolmap: Any, camera: Any, size: list[int]) -> None:
    """Convert ``camera`` to OpenCV's model for images of another ``size``. Rounding differs between the axes."""
    sx, sy = size[0] / camera.width, size[1] / camera.height
    p = np.asarray(camera.params, float)
    if camera.model_name == "SIMPLE_RADIAL":
        p = np.array([p[0], p[0], p[1], p[2], p[3], 0, 0, 0])
    camera.model = pycolmap.CameraModelId.OPENCV
    camera.params = [p[0] * sx, p[1] * sy, p[2] * sx, p[3] * sy, *p[4:]]
    camera.width, camera.height = size


def _get_poses(model: Any) -> np.ndarray:
    """Return the OpenGL camera-to-world poses (N, 4, 4) of the registered images in the order of their index."""
    out = []
    for number in sorted(model.reg_image_ids()):
        matrix = model.image(number).cam_from_world().matrix()
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = matrix[:, :3].T @ _FLIP, -matrix[:, :3].T @ matrix[:, 3]
        out.append(pose)
    return np.array(out)


def _get_points_and_poses(model: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the poses, and the points that at least three images see with their colours."""
    points = [p for p in model.points3D.values() if p.track.length() > 2]
    return (
        _get_poses(model),
        np.array([p.xyz for p in points]).reshape(-1, 3),
        np.array([p.color for p in points], np.uint8).reshape(-1, 3),
    )


def _run_as_script(arguments: list[str]) -> None:
    # Output of libraries is redirected to the standard error; the standard output is reserved for JSON lines.
    lines = os.fdopen(os.dup(sys.stdout.fileno()), "w", encoding="utf-8")
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())
    main(Path(arguments[0]), lambda *line: print(json.dumps(line), file=lines, flush=True))


if __name__ == "__main__":
    _run_as_script(sys.argv[1:])
