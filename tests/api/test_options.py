"""Options of jobs one by one."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

import nerg_mi as nerg
from nerg_mi.api.scene import options_of
from nerg_mi.api.workflows import bake, stats
from nerg_mi.errors import NergError


@dataclass(frozen=True, kw_only=True)
class Options:
    """Of a job."""

    steps: int = 5
    folder: Path | None = None
    store: Path | None = None
    seed: int = 0
    mode: str | None = None


def test01_changes_are_on_top_of_what_is_given(rgb):
    assert options_of(Options, "job", None, {}) == Options(mode="llvm_ad_rgb")
    assert options_of(Options, "job", Options(steps=9, seed=2), {"seed": 3}) == Options(
        steps=9, seed=3, mode="llvm_ad_rgb"
    )


def test02_the_variant_in_use_is_kept(mono):
    assert options_of(Options, "job", Options(mode="llvm_ad_rgb"), {}).mode == "llvm_ad_mono"


def test04_files_may_be_named_by_strings(rgb):
    assert options_of(Options, "job", None, {"folder": "tests"}).folder == Path("tests")
    assert options_of(Options, "job", None, {"store": "to be made"}).store == Path("to be made")


def cube():
    return nerg.make_scene(shapes={"type": "cube"})


CALLS = [
    (lambda: nerg.train_gaze("no.npz", scene="no.xml", test_peple=0.3), 'did you mean "test_people"'),
    (lambda: nerg.train_gaze("no.npz", scene="no.xml", test_people=0.3), 'no file "no.xml", which "scene" names'),
    (lambda: nerg.train_gaze("no.npz", geometry="none"), 'no file "no.npz", which "rays" names'),
    (lambda: nerg.train_gaze(np.zeros(3), geometry="none"), "rays are what load_rays .* got ndarray; import_rays"),
    (lambda: nerg.train_gaze(None, scene=cube()), '"scene" is a file, .* got Scene; give its name'),
    (lambda: nerg.train_radiance(None), '"photos" is a file, named by a string or a path, got NoneType; give'),
    (lambda: nerg.train_radiance("no"), 'no file "no", which "photos" names'),
    (lambda: nerg.evaluate_gaze("no.safetensors", "no.npz"), "no.npz"),
    (lambda: nerg.evaluate_radiance(3, "."), '"field" is a file, .* got int'),
    (lambda: nerg.ablate("no.npz", "new", geometry="none"), "no.npz"),
    (lambda: nerg.align("no.npz", scene="no.xml"), "no.xml"),
    (lambda: nerg.study(cube(), "new"), '"scene" is a file, .* got Scene'),
    (lambda: nerg.import_rays(np.zeros(3)), r"reads files, .* got ndarray; write a table to a file \(df.to_csv"),
    (lambda: nerg.import_rays("no.csv", colums="t=t"), 'has no option "colums"; did you mean "columns"'),
    (lambda: nerg.import_rays(["no.csv"], "unity"), 'no file "no.csv"'),
    (lambda: nerg.make_scene("no.safetensors", falof=0.1), 'no setting "falof"; did you mean "falloff"?'),
    (lambda: nerg.make_scene("no.safetensors"), '^there is no file "no.safetensors", which "field" names'),
    (lambda: nerg.render("no.xml"), 'there is no scene file "no.xml"'),
    (lambda: nerg.render(None), "a scene is what make_scene .* got NoneType"),
    (lambda: nerg.trace(3, [0, 0, 0], [1, 0, 0]), "a scene is what make_scene .* got int"),
    (lambda: bake("no.ply", gaze="no.safetensors"), "no.safetensors"),
    (lambda: stats("no.npz", "no.json"), "no.json"),
]


@pytest.mark.parametrize("call, said", CALLS)
def test_names_come_before_files_and_files_before_work(rgb, tmp_path, monkeypatch, call, said):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(NergError, match=said) as told:
        call()
    assert len(str(told.value)) < 300 and not any(tmp_path.iterdir())


def test_what_is_natural_is_taken(rgb, tmp_path):
    import mitsuba as mi

    path = tmp_path / "room.xml"
    path.write_text(
        '<scene version="3.0.0"><integrator type="nerg"/><shape type="cube"/><sensor type="perspective"><film '
        'type="hdrfilm"><integer name="width" value="4"/><integer name="height" value="4"/></film></sensor></scene>'
    )
    scene = nerg.Scene.load(path)
    pictures = [nerg.render(given, quantities="opacity").opacity for given in (path, str(path), scene, scene.mitsuba)]
    assert all((picture == pictures[0]).all() for picture in pictures)
    assert options_of(Options, "job", None, {"folder": scene}).folder == path
    # Values of `<default>`s make another scene of it than the file says.
    assert nerg.Scene.load(path).path == path and nerg.Scene(mi.load_file(str(path))).path is None


def test03_unknown_options_are_told(rgb):
    with pytest.raises(NergError, match='job has no option "step"; did you mean "steps"?'):
        options_of(Options, "job", None, {"step": 3})
    with pytest.raises(NergError, match="mi.set_variant"):
        options_of(Options, "job", None, {"mode": "scalar_rgb"})
    with pytest.raises(NergError, match='"xyz"'):
        options_of(Options, "job", None, {"xyz": 1})
