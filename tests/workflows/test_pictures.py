"""A scene file rendered by a job: the result, and what is told meanwhile."""

import pytest

from nerg_mi.errors import NergError
from nerg_mi.files.images import read_exr_text
from nerg_mi.rendering import aovs
from nerg_mi.rendering.aovs import prepare_for
from nerg_mi.workflows import render
from nerg_mi.workflows.demo import store_scene
from nerg_mi.workflows.render import PictureOptions, render_file
from tests.cli.test_render import SCENE
from tests.pictures import mitsuba_bitmap
from tests.workflows.recorder import Recorder


@pytest.fixture
def scene(tmp_path):
    (tmp_path / "scene.xml").write_text(SCENE)
    return tmp_path / "scene.xml"


def test_the_result_is_what_was_written(scene, tmp_path):
    told = Recorder()
    options = PictureOptions(defaults={"level": "0.5"}, sensor=0, spp=2, mode="llvm_ad_rgb")
    result = render_file(scene, tmp_path / "new" / "a.exr", options, told)
    bitmap = mitsuba_bitmap(result.path)
    assert tuple(bitmap.size()) == result.size == (16, 8) and bitmap.channel_count() == result.channels
    assert result.mode == "llvm_ad_rgb" and result.whole is None
    assert told.steps[-1][0] == 1 and "samples/s" in told.steps[-1][1]
    (line,) = told.messages
    assert line.startswith(f"Wrote {result.path} (16 x 8, {result.channels} channels, llvm_ad_rgb")


def test_a_reporter_may_end_it(scene, tmp_path):
    class Impatient(Recorder):
        def progress(self, share, text=""):
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        render_file(scene, tmp_path / "a.exr", PictureOptions(mode="llvm_ad_rgb"), Impatient())
    assert [p.name for p in tmp_path.iterdir()] == ["scene.xml"]


def test_a_sensor_that_is_not_there(scene, tmp_path):
    with pytest.raises(NergError, match="has 2 sensor"):
        render_file(scene, tmp_path / "a.exr", PictureOptions(sensor=2, mode="llvm_ad_rgb"))


@pytest.mark.slow
def test_the_header_says_what_the_gaze_rests_on(tmp_path):
    small = {"width": "12", "height": "8"}
    options = PictureOptions(defaults=small, spp=1, mode="llvm_ad_rgb")
    text = read_exr_text(render_file(store_scene(), tmp_path / "a.exr", options).path)
    assert text["gaze.basis"].startswith("made of ") and text["gaze.basis"].endswith(" people")
    assert "nerg render" in text["Comment"] and "kde.basis" not in text


@pytest.mark.nightly
@pytest.mark.slow
def test_long_renders_are_prepared_and_the_same_to_the_byte(tmp_path, monkeypatch):
    options = PictureOptions(defaults={"width": "24", "height": "16"}, spp=2, mode="llvm_ad_rgb")
    render_file(store_scene(), tmp_path / "a.png", options)
    prepared = []
    monkeypatch.setattr(aovs, "SAMPLES", 24 * 16 * 2)
    monkeypatch.setattr(
        render, "prepare_for", lambda samples, scene: prepared.append(prepare_for(samples, scene)) or prepared[-1]
    )
    render_file(store_scene(), tmp_path / "b.png", options)
    assert prepared == [True]
    assert mitsuba_bitmap(tmp_path / "a.png") == mitsuba_bitmap(tmp_path / "b.png")
