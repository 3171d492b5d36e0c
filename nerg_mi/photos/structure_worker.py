"""Structure from motion in a process of its own: ``python -m nerg_mi.photos.structure_worker FOLDER``.

pycolmap brings compression libraries whose functions take the place of others' in the same process (writing a PNG file
with Pillow may then end it), aborts where something is amiss, and hears of Ctrl-C only between its steps. So nothing
else is loaded here, and whoever started the process may end it at any time.

FOLDER holds ``job.json`` (see `reconstruction`) and the small pictures; ``sparse`` and ``result.npz`` are written
there.
Each line on the standard output is a JSON list: a stage, how much of it is done, and of how much.
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

MIN_MODEL_SIZE = 3  # so many pictures a model needs: two of them tell a place from one that is bent

# Cameras with so many pictures have all parameters of OpenCV's lens refined, others a focal length and one radial term.
_MANY = 10
_FLIP = np.diag([1.0, -1.0, -1.0])
_QUIET = 2  # of glog: errors


def main(folder: Path, on_progress: Callable[..., None]) -> None:
    """Do what ``job.json`` in ``folder`` says, and ``tell`` of it."""
    import pycolmap

    pycolmap.logging.minloglevel = _QUIET
    job = json.loads((folder / "job.json").read_text(encoding="utf-8"))
    pycolmap.set_random_seed(job["seed"])
    database = folder / "database.db"
    _write_database(pycolmap, database, job)
    _find_features(pycolmap, database, folder, job, on_progress)
    _match(pycolmap, database, folder, job, on_progress)
    models = _map(pycolmap, database, folder, job, on_progress)
    models = sorted(models, key=lambda m: -m.num_reg_images())
    result: dict[str, Any] = {"parts": [[_index(m.image(i)) for i in m.reg_image_ids()] for m in models]}
    if models:
        result |= _finish(pycolmap, models[0], folder, job)
    to_world, points, colors = (
        _drawn(models[0]) if models else (np.zeros((0, 4, 4)), np.zeros((0, 3)), np.zeros((0, 3)))
    )
    np.savez(
        folder / "result.npz", result=np.array(json.dumps(result)), to_world=to_world, points=points, colors=colors
    )


def _write_database(pycolmap: Any, path: Path, job: dict) -> None:
    """Cameras, and pictures each in a frame of its own, as COLMAP 4 has them."""
    database = pycolmap.Database.open(path)
    for number, camera in enumerate(job["cameras"], 1):
        model = job["lens"] or ("OPENCV" if camera["pictures"] >= _MANY else "SIMPLE_RADIAL")
        focal = camera["focal"] or 1.2 * max(camera["small"])
        made = pycolmap.Camera.create_from_model_name(number, model, focal, *camera["small"])
        made.has_prior_focal_length = camera["focal"] is not None
        database.write_camera(made, use_camera_id=True)
        rig = pycolmap.Rig()
        rig.rig_id = number
        rig.add_ref_sensor(made.sensor_id)
        database.write_rig(rig, use_rig_id=True)
    for number, picture in enumerate(job["pictures"], 1):
        image = pycolmap.Image(name=small_file_name(number - 1), camera_id=picture["camera"] + 1, image_id=number)
        database.write_image(image, use_image_id=True)
        frame = pycolmap.Frame()
        frame.frame_id, frame.rig_id = number, picture["camera"] + 1
        frame.add_data_id(image.data_id)
        database.write_frame(frame, use_frame_id=True)
    database.close()


def _find_features(pycolmap: Any, database: Path, folder: Path, job: dict, tell: Callable[..., None]) -> None:
    options = pycolmap.FeatureExtractionOptions()
    options.num_threads = job["threads"]
    names = [small_file_name(k) for k in range(len(job["pictures"]))]
    # Several at a time, so that there is something to tell in between.
    several = 2 * (os.cpu_count() or 1) if job["threads"] < 1 else 2 * job["threads"]
    for begin in range(0, len(names), several):
        tell("features", begin, len(names))
        some = names[begin : begin + several]
        pycolmap.extract_features(database, folder / "small", image_names=some, extraction_options=options)


def _match(pycolmap: Any, database: Path, folder: Path, job: dict, tell: Callable[..., None]) -> None:
    matching, checking = pycolmap.FeatureMatchingOptions(), pycolmap.TwoViewGeometryOptions()
    matching.num_threads, checking.ransac.random_seed = job["threads"], job["seed"]
    pairing = pycolmap.ImportedPairingOptions()
    pairing.match_list_path = folder / "pairs.txt"
    pairs = select_pairs(len(job["pictures"]), job["matching"])
    several = max(50, len(pairs) // 50)
    for begin in range(0, len(pairs), several):
        tell("matching", begin, len(pairs))
        lines = [f"{small_file_name(i)} {small_file_name(j)}\n" for i, j in pairs[begin : begin + several]]
        (folder / "pairs.txt").write_text("".join(lines), encoding="utf-8")
        pycolmap.match_image_pairs(
            database, matching_options=matching, pairing_options=pairing, verification_options=checking
        )


def _map(pycolmap: Any, database: Path, folder: Path, job: dict, tell: Callable[..., None]) -> list[Any]:
    """All models: pictures that nothing connects are in different ones."""
    options = pycolmap.IncrementalPipelineOptions()
    options.num_threads = options.mapper.num_threads = job["threads"]
    options.random_seed = options.mapper.random_seed = options.triangulation.random_seed = job["seed"]
    options.min_model_size, options.max_num_models = MIN_MODEL_SIZE, 10
    count, registered = len(job["pictures"]), 0

    def begun() -> None:
        nonlocal registered
        registered = 2
        tell("mapping", registered, count)

    def one_more() -> None:
        nonlocal registered
        registered += 1
        tell("mapping", registered, count)

    tell("mapping", 0, count)
    (folder / "models").mkdir()
    found = pycolmap.incremental_mapping(
        database,
        folder / "small",
        folder / "models",
        options=options,
        initial_image_pair_callback=begun,
        next_image_callback=one_more,
    )
    return [found[k] for k in sorted(found) if found[k].num_reg_images() >= MIN_MODEL_SIZE]


def _index(image: Any) -> int:
    return int(image.image_id) - 1


def _finish(pycolmap: Any, model: Any, folder: Path, job: dict) -> dict:
    """Turn the model upright, give it the pictures' names and sizes, and write it."""
    out: dict[str, Any] = {
        "error": model.compute_mean_reprojection_error(),
        "points": model.num_points3D(),
        "observations": model.compute_mean_observations_per_reg_image(),
    }
    if job["orient"]:
        up = estimate_up(_poses(model), np.array([p.xyz for p in model.points3D.values() if p.track.length() > 2]))
        out["up"] = {"roll": up.median_roll, "plane": up.plane_fraction, "between": up.plane_angle, "direction": up.direction.tolist()}
        turn = pycolmap.Rotation3d(rotation_to_z(up.direction))
        model.transform(pycolmap.Sim3d(1.0, turn, np.zeros(3)))
    for camera in model.cameras.values():
        _resize(pycolmap, camera, job["cameras"][camera.camera_id - 1]["size"])
    for image in model.images.values():
        picture = job["pictures"][_index(image)]
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
    """The camera of pictures of another ``size``, as OpenCV's model: what is rounded differs by axis."""
    sx, sy = size[0] / camera.width, size[1] / camera.height
    p = np.asarray(camera.params, float)
    if camera.model_name == "SIMPLE_RADIAL":
        p = np.array([p[0], p[0], p[1], p[2], p[3], 0, 0, 0])
    camera.model = pycolmap.CameraModelId.OPENCV
    camera.params = [p[0] * sx, p[1] * sy, p[2] * sx, p[3] * sy, *p[4:]]
    camera.width, camera.height = size


def _poses(model: Any) -> np.ndarray:
    """OpenGL camera-to-world poses (N, 4, 4) of the registered pictures, by their number."""
    out = []
    for number in sorted(model.reg_image_ids()):
        matrix = model.image(number).cam_from_world().matrix()
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = matrix[:, :3].T @ _FLIP, -matrix[:, :3].T @ matrix[:, 3]
        out.append(pose)
    return np.array(out)


def _drawn(model: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """What a picture of the model shows: poses, and points seen by three pictures or more with their colours."""
    points = [p for p in model.points3D.values() if p.track.length() > 2]
    return (
        _poses(model),
        np.array([p.xyz for p in points]).reshape(-1, 3),
        np.array([p.color for p in points], np.uint8).reshape(-1, 3),
    )


def _alone(arguments: list[str]) -> None:
    # What libraries print goes where errors go: the standard output is for lines of JSON.
    lines = os.fdopen(os.dup(sys.stdout.fileno()), "w", encoding="utf-8")
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())
    main(Path(arguments[0]), lambda *line: print(json.dumps(line), file=lines, flush=True))


if __name__ == "__main__":
    _alone(sys.argv[1:])
