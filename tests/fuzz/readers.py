"""All readers of the package for the fuzzer, one entry each; see `watch.Reader`."""

from __future__ import annotations

import json
import struct
from pathlib import Path

import numpy as np

from tests.formats.splats import writers
from tests.fuzz.capture_readers import CAPTURES
from tests.fuzz.checkpoint_readers import CHECKPOINTS
from tests.fuzz.tracking_readers import TRACKING
from tests.fuzz.watch import Reader

# ---- Scene files and the files that they refer to ----


_SCENE = """<scene version="3.0.0">
    <default name="side" value="8"/>
    <integrator type="nerg">
        <volume name="density" type="gridvolume">
            <string name="filename" value="fog.vol"/>
        </volume>
        <string name="aovs" value="depth,opacity"/>
    </integrator>
    <sensor type="perspective">
        <transform name="to_world"><lookat origin="0, 0, -4" target="0, 0, 0" up="0, 1, 0"/></transform>
        <film type="hdrfilm"><integer name="width" value="$side"/><integer name="height" value="4"/></film>
        <sampler type="independent"><integer name="sample_count" value="1"/></sampler>
    </sensor>
    <shape type="ply"><string name="filename" value="binary.ply"/></shape>
    <shape type="ply"><string name="filename" value="text.ply"/></shape>
    <shape type="obj"><string name="filename" value="a.obj"/></shape>
</scene>
"""
_PLY = """\
ply
format {} 1.0
element vertex 3
property float x
property float y
property float z
element face 1
property list uchar int vertex_indices
end_header
"""
_CORNERS = [[0, 0, 0], [1, 0, 0], [0, 1, 0]]


def _make(folder: Path) -> None:
    (folder / "scene.xml").write_text(_SCENE)
    triangle = np.array(_CORNERS, "<f4").tobytes() + struct.pack("<Biii", 3, 0, 1, 2)
    (folder / "binary.ply").write_bytes(_PLY.format("binary_little_endian").encode() + triangle)
    (folder / "text.ply").write_text(_PLY.format("ascii") + "0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n")
    (folder / "a.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    head = struct.pack("<3sBiiiii6f", b"VOL", 3, 1, 3, 2, 2, 1, 0, 0, 0, 1, 1, 1)
    (folder / "fog.vol").write_bytes(head + np.ones(12, "<f4").tobytes())


def _read(folder: Path) -> object:
    import mitsuba as mi

    import nerg_mi  # noqa: F401
    from nerg_mi.environment.scene_loading import load_scene

    if mi.variant() != "llvm_ad_rgb":
        mi.set_variant("llvm_ad_rgb")
    scene = load_scene(folder / "scene.xml")
    return [shape.bbox() for shape in scene.shapes()]


def _nest(folder: Path) -> object:
    from nerg_mi.environment.nested_scene import nest_scene
    from nerg_mi.environment.scene_writer import GazeFiles, LookAt, SceneText

    place = nest_scene(folder / "theirs.xml")
    camera = LookAt(np.zeros(3), np.ones(3))
    return SceneText(place, GazeFiles(), camera, None, np.array([0.0, 0, 1])).to_xml(folder / "ours")


def _make_nested(folder: Path) -> None:
    _make(folder)
    integrator = '<integrator type="$kind" id="light"><integer name="max_depth" value="3"/></integrator>'
    path = '<default name="kind" value="path"/><path value="."/><include filename="more.xml"/>'
    theirs = _SCENE.replace(_SCENE[_SCENE.index("    <integrator") : _SCENE.index("    <sensor")], integrator + path)
    (folder / "theirs.xml").write_text(theirs)
    (folder / "more.xml").write_text('<scene version="3.0.0"><!-- more --><shape type="cube"/></scene>')


def _make_frames(folder: Path) -> None:
    (folder / "walk.frames.csv").write_text('eye,ahead,falloff\n"1, 2, 3","4, 5, 6",0.1\n"1,2,3","""a"" b",\n')


def _make_regions(folder: Path) -> None:
    first, second = (
        '{"name": "a", "min": [0, 0, 0], "max": [1, 1, 1]}',
        '{"name": "b", "min": [0, 1, 2], "max": [3, 4, 5]}',
    )
    text = f'{{"regions": [{first}, {second}]}}'
    (folder / "areas.json").write_text(text)


def _read_frames(folder: Path) -> object:
    from nerg_mi.environment.rendering_files import read_frames

    return read_frames(folder / "walk.frames.csv")


def _make_glb(folder: Path) -> None:
    from nerg_mi.formats.gltf import encode_unlit_glb

    corners = [("POSITION", np.array(_CORNERS, "<f4"), False)]
    content = b"".join(encode_unlit_glb(corners, np.array([[0, 1, 2]])))
    (folder / "a.glb").write_bytes(content)
    # The JSON document alone, so that damage can preserve its structure.
    (folder / "document.json").write_bytes(content[20 : 20 + struct.unpack_from("<I", content, 12)[0]])


def _read_glb(folder: Path) -> object:
    from nerg_mi.files.safe_read import MAX_JSON_BYTES, read_bytes
    from nerg_mi.formats.gltf import parse_glb
    from nerg_mi.formats.meshes import read_mesh_file

    text = read_bytes(folder / "document.json", "document", MAX_JSON_BYTES)
    data = np.array(_CORNERS, "<f4").tobytes() + np.array([0, 1, 2], "<u4").tobytes()
    head = struct.pack("<IIIII", 0x46546C67, 2, 28 + len(text) + len(data), len(text), 0x4E4F534A)
    made = head + text + struct.pack("<II", len(data), 0x004E4942) + data
    return parse_glb(made, folder / "b.glb"), read_mesh_file(folder / "a.glb")


def _make_path(folder: Path) -> None:
    (folder / "walk.csv").write_text("x,y,z,weight\n1,2,1.6,0.5\n2,2,1.6,1\n")


def _read_path(folder: Path) -> object:
    from nerg_mi.surfaces.bake_parts import read_observer_file

    return read_observer_file(folder / "walk.csv")


def _reader(name: str, *kinds: str) -> Reader:
    return Reader(f"scene's {name}", _make, {name: kinds}, _read)


SCENES = [
    _reader("scene.xml", "text"),
    _reader("binary.ply"),
    _reader("text.ply", "text"),
    _reader("a.obj", "text"),
    _reader("fog.vol"),
    Reader("scene to be nested", _make_nested, {"theirs.xml": ("text",), "more.xml": ("text",)}, _nest),
    Reader("mesh of glTF", _make_glb, {"a.glb": (), "document.json": ("json",)}, _read_glb),
    Reader("path of observers", _make_path, {"walk.csv": ("text",)}, _read_path),
    Reader("frames of a sequence", _make_frames, {"walk.frames.csv": ("text",)}, _read_frames),
]


# ---- Inputs of statistics ----


def _make_areas(folder: Path) -> None:
    areas = [
        {"name": "shelf", "min": [0, 0, 0], "max": [1, 2, 3], "turn": 30},
        {"name": "lamp", "min": [0, 0, 0], "max": [1, 1, 1], "turn": [0, 0.6, 0, 0.8]},
        {"name": "sign", "mesh": "sign.ply", "faces": [0, [4, 9]]},
        {"name": "till", "shape": "till_0"},
        {"name": "all", "parts": ["shelf", "pair"]},
        {"name": "pair", "parts": ["till", "sign"]},
    ]
    (folder / "areas.json").write_text(json.dumps({"regions": areas}))


def _read_areas(folder: Path) -> object:
    from nerg_mi.aoi.areas import Areas

    areas = Areas.load(folder / "areas.json")
    assert all(elements for elements in areas.box_indices.values())
    for box in areas.boxes:
        box.contains(areas.boxes[0].vertices if areas.boxes else [[0.0, 0, 0]])
    return areas.element_indices()


def _make_twin(folder: Path) -> None:
    from tests.formats.test_boxes import write_twin

    write_twin(folder / "twin")


def _read_twin(folder: Path) -> object:
    from nerg_mi.aoi.areas import Areas

    return Areas.load(folder / "twin").boxes


def _make_changes(folder: Path) -> None:
    changes = {
        "move": [{"shape": "sign", "by": [0.5, 0, 0], "turn": 90}, {"area": "shelf", "by": [0, 1, 0]}],
        "remove": ["stand"],
        "add": [{"name": "poster", "min": [1, 0, 1], "max": [2, 0.1, 2]}],
        "swap": [{"shape": "till", "mesh": "till2.ply"}],
        "observers": [[1, 2, 1.6]],
        "shift": [0, 0, -0.2],
    }
    (folder / "changes.json").write_text(json.dumps(changes))


def _read_changes(folder: Path) -> object:
    from nerg_mi.aoi.areas import Areas
    from nerg_mi.aoi.changes import apply_to_areas, read_changes
    from nerg_mi.formats.boxes import Region

    return apply_to_areas(Areas((Region.create("shelf", [0, 0, 0], [1, 1, 1]),)), read_changes(folder / "changes.json"))


def _make_cohorts(folder: Path) -> None:
    (folder / "cohorts.csv").write_text('person,cohort\nAda,"young, tall"\nBo,old\n')


def _read_cohorts(folder: Path) -> object:
    from nerg_mi.aoi.measured import read_cohorts

    return read_cohorts(folder / "cohorts.csv")


AREAS = [
    Reader("boxes", _make_regions, {"areas.json": ("json",)}, _read_areas),
    Reader("areas of every kind", _make_areas, {"areas.json": ("json",)}, _read_areas),
    Reader(
        "objects of a twin",
        _make_twin,
        {"twin/3d_bounding_box.csv": ("text",), "twin/scene_objects.csv": ("text",), "twin/instances.json": ("json",)},
        _read_twin,
    ),
    Reader("changes", _make_changes, {"changes.json": ("json",)}, _read_changes),
    Reader("cohorts", _make_cohorts, {"cohorts.csv": ("text",)}, _read_cohorts),
]


# ---- Inputs of reports: evaluations, and boxes of objects ----


def _make_results(folder: Path) -> None:
    from nerg_mi.evaluation.gaze_report import write_report
    from tests.evaluation.test_gaze_report import scored

    person = {"method": "gaze field", "person": "Ada", "rays": 9, "bits": 0.1, "CC": 0.5, "KLD": 0.2}
    metadata = {
        "gaze": "g.safetensors",
        "split": "both",
        "kappa": 20.0,
        "positions": 60,
        "people": 30,
        "gaze_sha256": "ab",
    }
    write_report(folder, scored((0.9, 0.85, 0.3), reach=0.02), [person], metadata, "# notes")


def _read_results(folder: Path) -> None:
    from nerg_mi.evaluation.gaze_report import read_results
    from nerg_mi.reports.data import Run
    from nerg_mi.reports.sections import render_page

    results = read_results(folder / "gaze.json")
    render_page(Run("Gaze", {}, "A place.", "none", results=(results,)))


def _make_boxes(folder: Path) -> None:
    boxes = {"shelf": [[0, 0, 0], [1, 2, 3]], "till": {"min": [4, 0, 0], "max": [5, 1, 1.2]}}
    (folder / "objects.json").write_text(json.dumps(boxes))


def _read_boxes(folder: Path) -> None:
    from nerg_mi.aoi.areas import Areas

    for box in Areas.load(folder / "objects.json").boxes:
        box.contains(box.corners)


REPORTS = [
    Reader("evaluation of gaze", _make_results, {"gaze.json": ("json",)}, _read_results),
    Reader("boxes of objects", _make_boxes, {"objects.json": ("json",)}, _read_boxes),
]


# ---- Files of Gaussian splats of other programs ----


def _make_splats(name: str, **how):
    def make(folder: Path) -> None:
        write = {
            ".ply": writers.write_inria,
            ".splat": writers.write_antimatter,
            ".spz": writers.write_spz,
            ".sog": writers.write_sog,
            ".glb": writers.write_khronos,
        }[Path(name).suffix]
        write(folder / name, writers.random_splats(12, degree=1), **how)

    return make


def _read_splats(name: str):
    def read(folder: Path) -> object:
        from nerg_mi.formats.splats import read_splats

        splats = read_splats(folder / name)
        return splats.axes(), splats.degree

    return read


SPLATS = [
    Reader("splats: binary.ply", _make_splats("binary.ply"), {"binary.ply": ()}, _read_splats("binary.ply")),
    Reader(
        "splats: text.ply", _make_splats("text.ply", style="ascii"), {"text.ply": ("text",)}, _read_splats("text.ply")
    ),
    Reader("splats: a.splat", _make_splats("a.splat"), {"a.splat": ()}, _read_splats("a.splat")),
    Reader("splats: a.spz", _make_splats("a.spz"), {"a.spz": ("gzip",)}, _read_splats("a.spz")),
    Reader("splats: a.sog", _make_splats("a.sog"), {"a.sog": ("zip",)}, _read_splats("a.sog")),
    Reader("splats: a.glb", _make_splats("a.glb"), {"a.glb": ()}, _read_splats("a.glb")),
]


# ---- Photos of telephones, and videos ----


_SIZE = 64, 48
# Containers with: whether they consist of boxes, which guide the damage; the codec; options of the writer.
_FILMS = {
    "film.mp4": (("boxes",), "mpeg4", {}),
    "parts.mp4": (("boxes",), "mpeg4", {"movflags": "frag_keyframe+empty_moov"}),
    "film.mov": (("boxes",), "libx264", {"movflags": "faststart"}),
    "film.mkv": ((), "mpeg4", {}),
    "film.avi": ((), "mjpeg", {}),
    "film.mts": ((), "libx264", {}),
    "film.mpg": ((), "mpeg2video", {}),
    "film.wmv": ((), "wmv2", {}),
}


def _pixels(k: int = 0) -> np.ndarray:
    w, h = _SIZE
    return np.kron(np.random.default_rng(k).integers(0, 255, (h // 8, w // 8, 3)), np.ones((8, 8, 1))).astype(np.uint8)


def _make_photo(name: str):
    def make(folder: Path) -> None:
        from PIL import Image

        notes = Image.Exif()
        notes[0x010F], notes[0x0110], notes[0x0112] = "Maker", "Model", 6
        details = notes.get_ifd(0x8769)
        details[0xA405], details[0x920A] = 26, 4.25
        Image.fromarray(_pixels()).save(folder / name, exif=notes)

    return make


def _read_photo(name: str):
    def read(folder: Path) -> object:
        from nerg_mi.photos.structure import encode_image, encode_small_image, fit_size, read_photo

        photo = read_photo(folder / name)
        # Operations for rotated photos, and for all photos.
        return [
            *(encode_image(photo.image, kind) for kind in (".jpg", ".png")),
            encode_small_image(photo.image, fit_size(_SIZE, 24)),
        ]

    return read


def _make_film(name: str):
    _, codec, options = _FILMS[name]

    def make(folder: Path) -> None:
        import av

        parameters = {"mts": "mpegts", "wmv": "asf"}.get(name.rpartition(".")[2])
        with av.open(str(folder / name), "w", format=parameters, options=options) as out:
            stream = out.add_stream(codec, rate=25)
            stream.width, stream.height = _SIZE
            stream.pix_fmt = "yuvj420p" if codec == "mjpeg" else "yuv420p"
            if codec == "libx264":
                stream.options = {"preset": "ultrafast", "x264-params": "log-level=none"}
            for k in range(6):
                out.mux(stream.encode(av.VideoFrame.from_ndarray(_pixels(k), format="rgb24")))
            out.mux(stream.encode())

    return make


def _read_film(name: str):
    def read(folder: Path) -> object:
        from PIL import Image

        from nerg_mi.photos.structure import encode_image, encode_small_image, fit_size
        from nerg_mi.photos.video_frames import select_sharpest_frames

        # By default, the decoder starts one thread per core.
        frames = [Image.fromarray(frame.pixels) for frame in select_sharpest_frames(folder / name, 3, threads=2)]
        return [(encode_image(f, ".jpg"), encode_small_image(f, fit_size(f.size, 24))) for f in frames]

    return read


STRUCTURE = [
    *(
        Reader(f"photo {name}", _make_photo(name), {name: kinds}, _read_photo(name), needs="PIL")
        for name, kinds in (("a.jpg", ()), ("a.png", ("png",)))
    ),
    *(
        Reader(f"video {name}", _make_film(name), {name: kinds}, _read_film(name), needs="av")
        for name, (kinds, _, _) in _FILMS.items()
    ),
]


# ---- Files in stores of tasks: plans, and manifests of outputs ----


def _make_plan(folder: Path) -> None:
    from nerg_mi.tasks.store import Store
    from tests.tasks import works

    (folder / "light.txt").write_text("light")
    Store(folder).save_plan(works.make_plan(3, (folder / "light.txt",))).rename(folder / "plans" / "a.json")


def _read_plan(folder: Path) -> None:
    from nerg_mi.tasks.store import Store, read_status

    read_status(Store(folder))


def _make_receipt(folder: Path) -> None:
    from nerg_mi.tasks.store import Store, make_manifest
    from tests.tasks import works

    (folder / "out.txt").write_text("abc")
    (task,), store = works.make_plan(1).tasks, Store(folder)
    store.add_manifest(make_manifest(task, folder / "out.txt", 1.5, {"limits": [0, 1]}))
    store.manifest_path(task.key).rename(folder / "a.json")


def _read_receipt(folder: Path) -> None:
    from nerg_mi.tasks.store import read_manifest

    read_manifest(folder / "a.json")


TASKS = [
    Reader("plan of tasks", _make_plan, {"plans/a.json": ("json", "text")}, _read_plan),
    Reader("receipt of a task", _make_receipt, {"a.json": ("json", "text")}, _read_receipt),
]


ALL = [*CHECKPOINTS, *CAPTURES, *STRUCTURE, *SCENES, *REPORTS, *AREAS, *TASKS, *TRACKING, *SPLATS]
READERS = [r for r in ALL if r.installed]
