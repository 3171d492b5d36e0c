"""Films in parts: the bytes of one go, whoever makes the parts, and only what has to be made."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

from nerg_mi.errors import NergError
from nerg_mi.workflows import film
from nerg_mi.workflows.film import render_film
from nerg_mi.workflows.scene_commands import FilmOptions
from tests.cli.test_render import SCENE
from tests.conftest import ROOT
from tests.workflows.recorder import Recorder

AOV = 'type="aov"><string name="aovs" value="dd:depth"/>'
BALL = SCENE.replace(AOV, 'type="nerg">').replace('value="8"', 'value="16"')


@pytest.fixture
def scene(tmp_path, rgb):
    (tmp_path / "scene.xml").write_text(BALL)
    (tmp_path / "frames.csv").write_text("level\n0.25\n0.5\n0.75\n")
    return tmp_path / "scene.xml"


def files(folder):
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def render(scene, folder, name, told=None, **options):
    given = {"frames": scene.parent / "frames.csv", "mode": "llvm_ad_rgb", "seed": 3} | options
    return render_film(scene, scene.parent / folder / name, FilmOptions(**given), told or Recorder())


@pytest.mark.parametrize(
    "name, overlay",
    [
        ("a.png", {}),
        ("a.exr", {}),
        ("a.png", {"overlay": "depth"}),
        ("a.svg", {"overlay": "depth", "top": 4.0}),
        ("a.mp4", {}),
        ("a.mp4", {"overlay": "depth"}),
    ],
)
def test_parts_give_the_bytes_of_one_go(scene, name, overlay):
    if name.endswith("mp4"):
        pytest.importorskip("av")
    whole = render(scene, "whole", name, **overlay)
    parts = render(scene, "parts", name, store=scene.parent / "store", **overlay)
    found = files(scene.parent / "parts")
    assert found == files(scene.parent / "whole") and found
    assert (parts.size, parts.top, len(parts.files)) == (whole.size, whole.top, len(whole.files))


def test_pictures_that_are_kept_are_not_rendered_again(scene, monkeypatch):
    store, rendered = scene.parent / "store", []
    original = film.render_file
    monkeypatch.setattr(film, "render_file", lambda *given: rendered.append(given) or original(*given))
    render(scene, "one", "a.png", store=store)
    told = Recorder()
    render(scene, "two", "a.png", told, store=store)
    assert len(rendered) == 3 and files(scene.parent / "one") == files(scene.parent / "two")
    assert told.steps[-1] == (1.0, "3 of 3 parts") and "parts are kept in" in told.messages[-1]
    # One picture's values change: that one is rendered, and the video of the pictures takes all from the store.
    (scene.parent / "frames.csv").write_text("level\n0.25\n0.6\n0.75\n")
    render(scene, "three", "a.png", store=store)
    assert len(rendered) == 4
    # The scene changes: all are.
    scene.write_text(BALL.replace("0.3", "0.31"))
    render(scene, "four", "a.png", store=store)
    assert len(rendered) == 7 and files(scene.parent / "four") != files(scene.parent / "three")


def test_ctrl_c_says_where_it_goes_on_from(scene):
    class Impatient(Recorder):
        def progress(self, share, text=""):
            super().progress(share, text)
            if text.startswith("1 of 3 parts"):
                raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt, match=r"are kept in .*/a.tasks: the same command goes on"):
        render(scene, "out", "a.png", Impatient(), scheduler="local")
    told = Recorder()
    render(scene, "out", "a.png", told, scheduler="local")
    assert ("1 of 3 parts" in text for _, text in told.steps) and told.steps[1][1] == "1 of 3 parts"


def test_files_of_the_scene_are_the_same_wherever_it_lies(scene, tmp_path):
    """A picture's name does not depend on folders: a moved project finds its parts."""
    (tmp_path / "moved").mkdir()
    os.rename(scene, tmp_path / "moved" / "scene.xml")
    os.rename(tmp_path / "frames.csv", tmp_path / "moved" / "frames.csv")
    moved, store = tmp_path / "moved" / "scene.xml", tmp_path / "store"
    first = render(moved, "out", "a.png", store=store)
    os.rename(tmp_path / "moved", tmp_path / "again")
    told = Recorder()
    second = render(tmp_path / "again" / "scene.xml", "out", "a.png", told, store=store)
    assert (0.0, "3 of 3 parts") in told.steps or (1.0, "3 of 3 parts") in told.steps
    assert first.files[0].name == second.files[0].name


def test_one_picture_needs_nothing_of_it(scene, tmp_path):
    """Neither the engine nor dask is loaded where no parts are asked for."""
    code = (
        "import sys\nfrom nerg_mi.workflows.film import render_film\n"
        "from nerg_mi.workflows.options import FilmOptions\n"
        f"render_film({str(scene)!r}, {str(tmp_path / 'a.png')!r}, FilmOptions(mode='llvm_ad_rgb'))\n"
        "print([m for m in sys.modules if m.startswith(('nerg_mi.tasks', 'distributed', 'dask'))])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT)
    assert done.stdout.strip() == "[]", done.stderr


def test_options_that_contradict_are_told_before_any_work(scene, tmp_path):
    with pytest.raises(NergError, match="there is no scheduler"):
        render(scene, "out", "a.png", scheduler="nowhere")
    with pytest.raises(NergError, match=r"let its name end in"):
        render(scene, "out", "a.jpg", store=tmp_path / "store")
    assert not (tmp_path / "store").exists() and not (tmp_path / "out").exists()
