"""Pictures of a moment equal those of scenes that were built as they were then."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import nerg_mi as nerg
from nerg_mi.errors import NergError
from nerg_mi.figures.films import render_film
from nerg_mi.files.images import read_exr
from nerg_mi.maths.geometry import Similarity
from nerg_mi.tasks.settings import Parallel
from nerg_mi.tracking.objects import ObjectPoses
from tests.recorder import Recorder

pytestmark = pytest.mark.usefixtures("rgb")

FILM = """<sampler type="independent"><integer name="sample_count" value="1"/></sampler>
<film type="hdrfilm"><rfilter type="box"/><integer name="width" value="24"/><integer name="height" value="16"/>
<string name="component_format" value="float32"/></film>"""
SHAPE = """<shape type="{kind}" id="{name}"><transform name="to_world"><scale value="0.4"/>{moves}</transform>
</shape>"""
SCENE = """<scene version="3.0.0"><default name="eye" value="0, 0, -6"/><integrator type="nerg">
<string name="aovs" value="depth,opacity"/></integrator>{shapes}
<sensor type="perspective"><float name="fov" value="50"/><transform name="to_world">
<lookat origin="$eye" target="0, 0, 0" up="0, 1, 0"/></transform>{film}</sensor></scene>"""
REST = {"box": (-1, 0, 0), "sign": (1, 0, 0), "ball": (0, 1, 0), "floor": (0, -1.5, 0)}
KINDS = {"box": "cube", "sign": "rectangle", "ball": "sphere", "floor": "cube"}


def write(path, moved=()):
    """Write a scene whose objects are at rest, or moved by an angle about y and an offset; None removes one."""
    shapes = []
    for name, place in REST.items():
        motion = dict(moved).get(name, (0, (0, 0, 0)))
        if motion is not None:
            angle, offset = motion
            moves = '<translate value="{},{},{}"/>'.format(*place)
            moves += f'<rotate y="1" angle="{angle}"/>' + '<translate value="{},{},{}"/>'.format(*offset)
            shapes.append(SHAPE.format(kind=KINDS[name], name=name, moves=moves))
    path.write_text(SCENE.format(shapes="".join(shapes), film=FILM))
    return path


def poses():
    """The box and the ball move and turn from 0 to 2 s, the sign is taken away after one second."""
    turn = lambda angle: Rotation.from_euler("y", angle, degrees=True).as_quat()
    rows = [("box", 0, (0, 0, 0), 0), ("box", 2, (0.5, 0.2, 1), 60), ("ball", 0, (0, 0, 0), 0)]
    rows += [("ball", 2, (-1, -0.4, 0), 0), ("sign", 0, (0, 0, 0), 0), ("sign", 1, (np.nan,) * 3, 0)]
    names, times, places, angles = zip(*rows)
    return ObjectPoses.from_arrays(names, times, places, [turn(angle) for angle in angles], max_gap=3.0)


HALF = {"box": (30, (0.25, 0.1, 0.5)), "ball": (0, (-0.5, -0.2, 0)), "sign": None}
EARLY = {"box": (15, (0.125, 0.05, 0.25)), "ball": (0, (-0.25, -0.1, 0))}


def channels(picture):
    return {name: np.array(picture[name][0]) for name in ("depth", "opacity", "color")}


def assert_equal(a, b):
    for name in a:
        assert np.allclose(a[name], b[name], atol=2e-3), name


def test_shapes_move_in_a_scene(tmp_path):
    scene = nerg.Scene.load(write(tmp_path / "a.xml"))
    views = {name: channels(nerg.render(scene)) for name in ("rest",)}
    for name, time, moved in (("early", 0.5, EARLY), ("half", 1.0, HALF), ("early again", 0.5, EARLY)):
        scene.move_objects(poses(), time)
        views[name] = channels(nerg.render(scene))
        assert_equal(views[name], channels(nerg.render(nerg.Scene.load(write(tmp_path / "b.xml", moved)))))
    assert np.abs(views["early"]["depth"] - views["rest"]["depth"]).max() > 0.1
    # Those that other poses do not name go back.
    scene.move_objects(ObjectPoses.from_arrays(["box"], [0], [[0, 0, 0]]), 0)
    assert_equal(channels(nerg.render(scene)), views["rest"])
    with pytest.warns(UserWarning, match="ball"):
        scene.move_objects(poses(), -9)
    with pytest.raises(NergError):
        scene.move_objects(ObjectPoses.from_arrays(["chair"], [0], [[0, 0, 0]]), 0)


def test_poses_are_those_of_the_scene_and_the_participant(tmp_path):
    scene = nerg.Scene.load(write(tmp_path / "a.xml"))
    personal = ObjectPoses.from_arrays(
        ["box"] * 4, [0, 1] * 2, [[0, 0, 0], [1, 0, 0], [0, 0, 0], [0, 0, 2]], None, "aabb"
    )
    double = Similarity(np.diag([2.0, 2, 2, 1]))
    scene.move_objects(personal, 0.25, person="b", align=double)
    expected = nerg.Scene.load(write(tmp_path / "b.xml", {"box": (0, (0, 0, 1))}))
    assert_equal(channels(nerg.render(scene)), channels(nerg.render(expected)))


def test_films_have_objects_at_their_times(tmp_path):
    file = write(tmp_path / "a.xml")
    render_film(file, tmp_path / "half.exr", objects=poses(), time=1)
    render_film(write(tmp_path / "b.xml", HALF), tmp_path / "expected.exr")
    half, expected = (read_exr(tmp_path / f"{name}.exr") for name in ("half", "expected"))
    assert_equal(half, expected)
    # Cameras move in the same scene, with other values it is loaded again.
    frames = [{"eye": "0, 0, -6", "time": 1}, {"eye": "1, 0, -6", "time": 0.5}, {"eye": "0, 0, -6", "time": 1}]
    render_film(file, tmp_path / "film.exr", objects=poses(), frames=frames)
    for number in (1, 3):
        assert_equal(read_exr(tmp_path / f"film_{number:04}.exr"), expected)
    render_film(write(tmp_path / "b.xml", EARLY), tmp_path / "early.exr", defaults={"eye": "1, 0, -6"})
    assert_equal(read_exr(tmp_path / "film_0002.exr"), read_exr(tmp_path / "early.exr"))
    recorder = Recorder()
    render_film(file, tmp_path / "c.exr", objects=poses(), time=99, progress=recorder)
    assert len(recorder.warnings) == 2
    memory = nerg.make_scene({"box": {"type": "cube"}}, camera=nerg.Camera((0, 0, -6), (0, 0, 0), (0, 1, 0)))
    for scene, options in (
        (file, {"time": 1}),
        (file, {"objects": poses()}),
        (file, {"objects": poses(), "frames": [{"time": "noon"}]}),
        (file, {"objects": poses(), "time": 1, "parallel": Parallel(store=tmp_path / "store")}),
        (memory, {"objects": poses(), "time": 1}),
    ):
        with pytest.raises(NergError):
            render_film(scene, tmp_path / "d.exr", **options)
