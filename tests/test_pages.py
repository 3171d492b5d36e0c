"""Every block of code of the pages: what Python and XML say is run, commands are parsed as they stand, and those of the
quick start are run on a small recording. A block that is neither has a reason, in one table."""

from __future__ import annotations

import json
import os
import re
import shlex
import shutil
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from nerg_mi.scenes.store import SCENE_FILE

import nerg_mi.cli
from nerg_mi.aoi.areas import Areas
from nerg_mi.aoi.changes import read_changes
from nerg_mi.aoi.settings import AoiSampling
from nerg_mi.cli import demo
from nerg_mi.maths.sphere import sample_uniform_directions
from nerg_mi.tracking.rays import Rays
from tests.conftest import ROOT
from tests.figures.standins import write_standins
from tests.figures.test_floor_plans import make_walk
from tests.watched import write_scene
from tools import generated, reference

PAGES = {page.name: page.read_text(encoding="utf-8") for page in generated.pages()}
PAGES["plugins.md"] = reference.plugins()

NOT_RUN = {
    ("numerics.md", "text"): "a formula",
    ("baking.md", "text"): "what a command prints",
    ("bids.md", "text"): "files of a dataset",
    ("events.md", "text"): "a table that a command reads",
    ("plugins.md", "math"): "a formula",
    ("quickstart.md", "text"): "what commands print",
}
"""All blocks of a language on a page -> why nothing is there to be run."""

SHELL = {
    "make": "its target is looked up in the Makefile",
    "python": "its script and options are looked up by tests/test_docs.py",
    "nerg": "it is parsed, and run where it is quick",
    "blender": "another program, whose script is in examples/",
    "export": "a setting of the reader's shell",
    "_NERG_COMPLETE=source_bash": "tests/cli/test_main.py asks for it",
    "_NERG_COMPLETE=source_zsh": "tests/cli/test_main.py asks for it",
    "_NERG_COMPLETE=source_fish": "tests/cli/test_main.py asks for it",
    "pip": "installs packages, which needs the network; its extras are looked up in pyproject.toml",
    "bids-validator-deno": "a program of others",
    "ffmpeg": "a program of others",
    "dask": "a program of others",
    "openssl": "a program of others",
}
"""First words of the lines of shell blocks -> what becomes of them."""


@dataclass(frozen=True)
class Block:
    page: str
    language: str
    text: str

    @property
    def lines(self) -> list[str]:
        """The commands of a shell block: continued lines are joined, and a loop is replaced by its body."""
        joined = re.sub(r"\\\n\s*", " ", self.text).splitlines()
        return [re.sub(r"^for \w+ in .*?; do (.*); done$", r"\1", line.strip()) for line in joined if line.strip()]


def run(text: str, page: str, names: dict | None = None) -> dict:
    """The names that a block of Python defines, on top of ``names``."""
    names = {} if names is None else names
    exec(compile(text, page, "exec"), names)
    return names


def blocks(*languages: str, page: str = "") -> list[Block]:
    """The code blocks of one page or all pages, in some languages or all."""
    matches = []
    for name, content in PAGES.items():
        for _, language, text in re.findall(r"^( *)```([^\n`]*)\n(.*?)^ *```", content, re.M | re.S):
            if (not languages or language in languages) and page in ("", name):
                matches.append(Block(name, language, text))
    return matches


def test01_no_block_is_left_out():
    here = {
        "sh",
        ("moving-objects.md", "text"),
        ("README.md", "python"),
        ("figures.md", "py"),
        ("python.md", "py"),
        ("exchange.md", "py"),
    }
    here |= {("moving-objects.md", language) for language in ("text", "python")} | {("other-choices.md", "python")}
    here |= {("flat-areas.md", "python")}
    here |= {(f"{page}.md", "json") for page in ("viewer", "store", "statistics")}
    here |= {
        (f"{page}.md", "python")
        for page in "derivatives evaluation exchange python store recordings next-look training CONTRIBUTING".split()
    }
    here |= {(b.page, b.language) for b in blocks("xml", "python") if b.page in ("plugins.md", *XML_PAGES)}
    for block in blocks():
        key = (block.page, block.language)
        assert block.language in here or key in here or key in NOT_RUN, key
    assert set(NOT_RUN) <= {(b.page, b.language) for b in blocks()}, "the table names blocks that are gone"


def test03_every_line_of_a_shell_is_known():
    targets = set(re.findall(r"^([a-z]+):", (ROOT / "Makefile").read_text(), re.M)) | {"check", "test"}
    extras = set(re.findall(r"^(\w+) = \[", (ROOT / "pyproject.toml").read_text(), re.M))
    for block in blocks("sh"):
        for line in block.lines:
            if line.startswith("#"):
                continue
            words = shlex.split(re.sub(r"[\[\]|]", " ", line) if line.startswith("python ") else line, comments=True)
            first = words[0].removeprefix(".venv/bin/")
            assert first in SHELL, (block.page, line)
            if first == "make":
                assert words[1] in targets, line
            if first == "pip":
                assert {e for match in re.findall(r"\[([\w,]+)\]", line) for e in match.split(",")} <= extras, line


def test04_areas_are_read(tmp_path):

    for block in blocks("json", page="viewer.md"):
        (tmp_path / "a.json").write_text(block.text)
        assert all(region.contains(region.corners).all() for region in Areas.load(tmp_path / "a.json").boxes)


XML_PAGES = ("figures.md", "plugins.md", "environments.md")


@pytest.fixture
def place(rgb, standins, tmp_path, monkeypatch):
    """A folder with the files that snippets name: stand-ins of the store's fields, a scene with them, and rays."""
    from tests.evaluation.test_gaze import crowd
    from tests.formats.splats.writers import random_splats, write_inria

    for file in standins.values():
        shutil.copy(file, tmp_path)
    shutil.copy(SCENE_FILE, tmp_path)
    shutil.copy(tmp_path / "store.safetensors", tmp_path / "field.safetensors")
    crowd().save(tmp_path / "day.npz")
    write_inria(tmp_path / "store.ply", random_splats())
    monkeypatch.chdir(tmp_path)
    return tmp_path


def as_scene(text: str) -> str:
    """A snippet within its context."""
    if text.lstrip().startswith("<scene"):
        return text
    if text.lstrip().startswith("<volume"):
        aovs = '<string name="aovs" value="kde"/>' if "gazekde" in text else ""
        field = (
            ""
            if 'name="field"' in text
            else '<volume name="field" type="nerf"><string name="filename" value="store.safetensors"/></volume>'
        )
        text = f'<integrator type="nerg">{field}{text}{aovs}</integrator>'
    return f'<scene version="3.0.0">{text}</scene>'


@pytest.mark.parametrize("block", [b for b in blocks("xml") if b.page in XML_PAGES], ids=lambda b: b.page)
def test05_xml_is_a_scene(rgb, place, block):
    (place / "a.xml").write_text(as_scene(block.text))
    scene = rgb.load_file(str(place / "a.xml"))
    if "integrator" in as_scene(block.text) or "include" in block.text:
        assert type(scene.integrator()).__name__ == "NergIntegrator"
    else:
        assert len(scene.sensors()) == 1


@pytest.mark.parametrize("block", blocks("python", page="plugins.md"), ids=lambda b: b.text.split("\n")[0])
def test06_dicts_of_plugins_are_loaded(rgb, place, block):
    made = eval("{" + block.text + "}", {"mi": rgb})
    if "type" in made:
        assert rgb.load_dict(made) is not None
        return
    integrator = {"type": "nerg", "field": {"type": "nerf", "filename": "store.safetensors"}, **made}
    if "kde" in made:
        integrator["aovs"] = "kde"
    assert type(rgb.load_dict({"type": "scene", "integrator": integrator}).integrator()).__name__ == "NergIntegrator"


def test07_torch(rgb, place):
    pytest.importorskip("torch", reason="torch is not installed")
    # The other block is run by tests/plugins/test_splats.py.
    (block,) = [block for block in blocks("python", page="exchange.md") if "import torch" in block.text]
    names = run(block.text, block.page)
    assert names["sigma"].shape == (100,) and names["color"].shape == (100, 3)


def test_scenes_are_exported(rgb, tmp_path, monkeypatch):
    """The block of scenes with gaze, in files of both formats."""
    import trimesh

    import nerg_mi as nerg

    for module in ("rerun", "pxr"):
        pytest.importorskip(module, reason=f"{module} is not installed")
    monkeypatch.chdir(tmp_path)
    room = trimesh.creation.box((8, 6, 3)).apply_translation((4, 3, 1.5))
    room.export("day.ply")
    gaze = nerg.GazeField.load(SCENE_FILE.parent / "shoppers.safetensors")
    names = {"nerg": nerg, "room": room, "gaze": gaze, "camera": nerg.Camera((1, 1, 2), (5, 4, 1), width=12, height=8)}
    names["rays"] = nerg.Rays.from_arrays([[4, 3, 1.6]] * 9, [[1, 0, 0]] * 9, times=np.arange(9) / 30)
    (block,) = blocks("py", page="exchange.md")
    run(block.text, block.page, names)
    assert all(Path(name).stat().st_size > 1000 for name in ("day.rrd", "day.usdc"))


def test_objects_move(rgb, tmp_path):
    from nerg_mi.tracking.objects import ObjectPoses

    (table,) = blocks("text", page="moving-objects.md")
    (tmp_path / "poses.csv").write_text(table.text)
    assert ObjectPoses.load(tmp_path / "poses.csv").names == ("book", "box")
    (block,) = blocks("python", page="moving-objects.md")
    names = run(block.text, block.page)
    # The box leaves the line of sight when it has moved by half of its edge, after 2.2 of 4 seconds.
    rows = {row["aoi"]: row["share"] for row in names["numbers"].aois}
    assert rows["box"] == pytest.approx(0.55, abs=0.03) and rows["box"] + rows["wall"] == pytest.approx(1)
    assert len(names["on_box"]) == pytest.approx(22, abs=1) and np.allclose(names["on_box"].hit[:, 0], 2.8, atol=1e-3)
    assert names["baked"].on_surface > 0.9


def test_flat_areas(rgb):
    (block,) = blocks("python", page="flat-areas.md")
    names = run(block.text, block.page)
    # The pillar hides what is less than 0.1 / 2.9 x 4.9 m from the middle.
    assert len(names["gaze"].samples["t"]) == 40 and len(names["seen"]) == pytest.approx(30, abs=1)
    assert len(names["figure"].axes) == 2


def test_other_choices():
    (block,) = blocks("python", page="other-choices.md")
    rows = {row["conclusion"]: row for row in run(block.text, block.page)["result"].conclusions[:2]}
    assert rows["shelf > sign"]["verdict"] == "survives" and rows["shelf > sign"]["reference"] > 0.3


def test08_datasets(tmp_path, monkeypatch):
    pytest.importorskip("pyarrow", reason="pyarrow is not installed")
    from tests.tracking.dataset.making import write_dataset

    monkeypatch.chdir(tmp_path)
    _, rays = write_dataset(tmp_path, place="north")
    names: dict = {}
    for block in blocks("python", page="recordings.md"):
        text = block.text.replace('["ann"]', '["p0_1"]')
        run(text, block.page, names)
    assert len(names["some"]) == len(rays) == names["seen"].count_rows()
    assert len(names["rays"]) > 0 and set(np.array(names["rays"].persons)[names["rays"].person]) == {"p0_1"}


def test_a_recipe_has_other_settings():
    trained = {}
    names = {"nerg": SimpleNamespace(train_gaze=lambda rays, *_, **options: trained.update(options)), "rays": None}
    (block,) = blocks("python", page="training.md")
    run(block.text, "training.md", names)
    assert trained["recipe"].settings.loss == "code" and trained["recipe"].name == "small"


def test_heads_are_turned_to_gaze(tmp_path, monkeypatch):
    """The block of training on heads, without the training itself."""
    import nerg_mi as nerg

    monkeypatch.chdir(tmp_path)
    head = sample_uniform_directions(400, np.random.default_rng(0))
    head[:, 2] = 0
    head /= np.linalg.norm(head, axis=1, keepdims=True)
    below = [0.0, 0.0, np.sin(np.radians(-9))] + np.cos(np.radians(9)) * head
    eyes = nerg.Rays(np.arange(400), np.zeros(400, int), ("a",), head * 0, below, np.ones(400), head=head)
    eyes.save("eyes.npz")
    trained = {}
    names = {"nerg": SimpleNamespace(Rays=nerg.Rays, train_gaze=lambda rays, *_, **options: trained.update(rays=rays))}
    (text,) = [block.text for block in blocks("python", page="next-look.md")]
    run(text, "next-look.md", names | {"rays": replace(eyes, direction=head)})
    assert trained["rays"].direction == pytest.approx(below, abs=1e-6)


@pytest.mark.nightly
@pytest.mark.slow
def test09_from_recordings(rgb, place, monkeypatch):
    """The block of trainings, whose inputs are a table of four people and photos of the store, with fewer steps."""
    import nerg_mi as nerg

    rays = nerg.Rays.load("day.npz")
    names = [rays.persons[k] for k in rays.person]
    table = np.column_stack([rays.t, rays.origin, rays.direction])
    lines = [",".join(map(str, row)) + f",{who}" for row, who in zip(table, names)]
    Path("day.csv").write_text("t,x,y,z,dx,dy,dz,who\n" + "\n".join(lines) + "\n")
    (text,) = [b.text for b in blocks("py", page="python.md") if "train_radiance" in b.text]
    fewer = {"minutes=5": "steps=30, holdout=0", "test_zones=3": FEW}
    for long, short in fewer.items():
        assert text.count(long) == 1
        text = text.replace(long, short)
    write_photos(place / "photos", nerg)
    names = run(text, "docs/how-to/python.md", {"nerg": nerg})
    assert names["field"].kind == "radiance" and names["gaze"].kind == "gaze" and names["scores"].rows


FEW = "test_zones=1, test_positions=4, radius=0.6, probes=8, steps=2, directions=64, min_rays=8, seed=1, force=True"


def write_photos(folder: Path, nerg) -> None:
    """Four posed photos of the stand-in store."""
    import mitsuba as mi

    folder.mkdir()
    scene, frames = nerg.make_scene("store.safetensors"), []
    for i, eye in enumerate([(4.4, 2.8, 1.6), (4.4, 3.4, 1.6), (4.5, 2.2, 1.5), (4.5, 4.0, 1.5)]):
        camera = nerg.Camera(eye, (4.8, 4.9, 1.2), fov=70, width=24, height=16)
        color = nerg.render(scene, quantities="color", camera=camera, spp=4).color[0]
        mi.util.write_bitmap(str(folder / f"{i}.png"), mi.TensorXf(np.ascontiguousarray(color)), write_async=False)
        pose = np.array(mi.ScalarTransform4f().look_at(list(eye), [4.8, 4.9, 1.2], [0, 0, 1]).matrix)
        frames.append({"file_path": f"{i}.png", "transform_matrix": (pose @ np.diag([-1, 1, -1, 1])).tolist()})
    metadata = {"camera_angle_x": float(np.radians(70)), "w": 24, "h": 16, "frames": frames}
    (folder / "transforms.json").write_text(json.dumps(metadata))


# ---- Pages with consecutive blocks, on the files of the store or on stand-ins of its fields ----


@pytest.fixture
def clone(rgb, tmp_path, monkeypatch):
    """``clone(name, ...)``: a working folder with these files of the demo store, as in a clone."""

    def make(*names: str) -> Path:
        store = tmp_path / "scenes" / "store"
        store.mkdir(parents=True)
        for name in names:
            shutil.copy(SCENE_FILE.with_name(name), store)
        monkeypatch.chdir(tmp_path)
        return store

    return make


def with_smaller_image(text: str) -> str:
    """An example with a smaller picture."""
    size = r'(width=|height=|name="(?:width|height)" value=")(480|320)'
    small, count = re.subn(size, lambda m: f"{m[1]}{int(m[2]) // 20 + 12}", text)
    assert count, "the example has no resolution to make smaller"
    return small


@pytest.fixture
def readme(clone):
    """The scene and the checkpoints; random ones if the store has none."""
    block = list(demo.CHECKPOINTS.values())
    has_own = all(SCENE_FILE.with_name(name).is_file() for name in block)
    store = clone("scene.xml", *(block if has_own else ()))
    if not has_own:
        write_standins(store)
    return store


def test10_the_scene_file(rgb, readme):
    block = blocks("xml", page="environments.md")[0]
    (readme / "example.xml").write_text(with_smaller_image(block.text))
    picture = np.array(rgb.render(rgb.load_file(str(readme / "example.xml"))))
    assert picture.shape == (28, 36, 7) and np.isfinite(picture).all()
    assert picture[..., 3].max() > 0 and picture[..., 5].max() > 0


def test11_the_python_of_the_readme(readme):
    (block,) = blocks("python", page="README.md")
    names = run(with_smaller_image(block.text), "README.md")
    one, other = names["gaze"]
    assert one.shape == (28, 36) and one.max() > 0 and not np.array_equal(one, other)
    assert names["share"].shape == (2,) and (names["share"] >= 0).all()


@pytest.mark.nightly
def test12_a_sign(clone, capsys):
    """For fewer visitors."""
    clone("twin.ply", "shoppers.safetensors")
    names: dict = {}
    for block in blocks("python", page="store.md")[1:]:
        run(block.text.replace("4.8, 9)", "4.8, 3)"), block.page, names)
    said = capsys.readouterr().out.splitlines()
    assert len(said) == 6 and said[0].endswith("see more than half of it")
    seen, share = names["seen"], names["share"]
    assert len(share) == 12 and np.all((share >= 0) & (share < 0.2)) and share.max() > 1e-4
    # It is seen best from the third aisle; an invisible object attracts no gaze.
    assert seen.reshape(4, 3).mean(axis=1).argmax() == 2
    assert np.all(share[seen == 0] < 0.3 * share.max())


@pytest.mark.nightly
def test13_gradients(clone):
    """On untrained fields, and smaller."""
    write_standins(clone("scene.xml"))
    names: dict = {}
    for block in blocks("python", page="derivatives.md"):
        small = block.text.replace("width=480, height=320", "width=12, height=8").replace("batch=4096", "batch=64")
        run(small, block.page, names)
    assert np.isfinite(np.array(names["change"])).all() and np.any(np.array(names["change"]) != 0)
    losses, errors = ([x.numpy().item() for x in names[name]] for name in ("losses", "errors"))
    # From whole views, then frozen; and of a camera that nothing was trained on, before and after, then with batches of
    # rays.
    assert len(losses) == 14 and max(losses[9:]) < losses[0] and losses[-1] < losses[9]
    assert len(errors) == 4 and errors[1] < errors[0] and errors[3] < errors[2], errors


def shoppers(people: int = 5, each: int = 60) -> Rays:
    """Participants in the aisles who look around."""
    rng = np.random.default_rng(0)
    n = people * each
    origin = np.column_stack([rng.choice([2.75, 4.55, 6.3], n), rng.uniform(0.8, 4.8, n), np.full(n, 1.6)])
    d = rng.normal(size=(n, 3)) * (1, 1, 0.3)
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    times, who = np.tile(0.2 * np.arange(each), people), np.repeat(np.arange(people), each)
    return Rays(times, who, tuple("abcde"[:people]), origin, d, np.ones(n))


@pytest.mark.nightly
def test14_a_shop(rgb, tmp_path, monkeypatch):
    """The settings of the page, with fewer participants, positions and directions."""
    monkeypatch.chdir(tmp_path)
    for name in ("shapes.xml", "twin.ply", "twin_lights.ply", "shoppers.safetensors"):
        shutil.copy(SCENE_FILE.with_name(name), tmp_path)
    for name, block in zip(("areas", "zones", "changes"), blocks("json", page="store.md")):
        (tmp_path / f"{name}.json").write_text(block.text)
    shoppers().save(tmp_path / "shop.npz")
    block = blocks("python", page="store.md")[0]
    sampling = AoiSampling(directions=512, aoi_samples=8)
    small = block.text.replace(
        "    aoi_visibility", "    viewpoints=5, resamples=199, sampling=sampling, aoi_visibility"
    )
    names = run(small, block.page, {"sampling": sampling})
    assert set(names["counted"]) == set(Areas.load(tmp_path / "areas.json").names)
    assert names["weakest"] in names["counted"] and "display" in {r["aoi"] for r in names["found"].what_if}
    assert (tmp_path / "numbers" / "aois.png").is_file()


def test15_files_of_statistics(tmp_path):
    areas, changes = (block.text for block in blocks("json", page="statistics.md"))
    (tmp_path / "a.json").write_text(areas)
    (tmp_path / "c.json").write_text(changes)
    assert len(Areas.load(tmp_path / "a.json").areas) == len(json.loads(areas)["regions"])
    names = read_changes(tmp_path / "c.json")
    assert names.move and names.remove and names.add and names.swap and names.observers is not None


def test16_pictures(tmp_path, rgb, monkeypatch):
    import nerg_mi as nerg

    path = write_scene(tmp_path)
    make_walk().save(tmp_path / "rays.npz")
    shutil.copy(tmp_path / "gaze.safetensors", tmp_path / "shoppers.safetensors")
    monkeypatch.chdir(tmp_path)
    names = {"nerg": nerg, "scene": nerg.Scene.load(str(path))}
    for block in blocks("py", page="figures.md"):
        if "from PIL" in block.text:
            nerg.draw_floor("rays.npz", "gaze.png")
        smaller = block.text.replace("scenes/store/scene.xml", "scene.xml").replace("width=480", "width=64, spp=1")
        run(smaller, block.page, names)
    assert {"floor.svg", "gaze.pdf"} <= set(os.listdir("."))
    assert b"my notebook" in Path("gaze.pdf").read_bytes()


def test_saliency_metrics_of_the_evaluation_page():
    (block,) = blocks("python", page="evaluation.md")
    assert np.isfinite(list(run(block.text, block.page)["scores"].to_dict().values())).all()


def test17_clusters(capsys):
    (block,) = blocks("python", page="CONTRIBUTING.md")
    run(block.text, block.page, {"__name__": "page"})
    assert capsys.readouterr().out == ".txt 2.0\n"


@pytest.mark.nightly
def test18_python(rgb, tmp_path, monkeypatch):
    """Thirty lines lead from loading to a plot of attention shares; then fields are saved and evaluated."""
    import matplotlib

    import nerg_mi as nerg

    matplotlib.use("Agg")
    monkeypatch.chdir(tmp_path)
    texts, names = [block.text for block in blocks("python", page="python.md")], {}
    assert len([line for line in texts[0].splitlines() if line.strip()]) <= 30
    for text in texts:
        small = text.replace("width=480, height=320", "width=24, height=16").replace("4.6, 10)", "4.6, 2)")
        small = small.replace("[[2, 7]]", "[[0, 1]]")
        assert small.count("width=24") == text.count("width=480")
        run(small.replace("spp=4", "spp=1"), "docs/how-to/python.md", names)
        if text is texts[0]:
            share = np.array(list(names["share"].values()))
            assert share.shape == (4, 2) and (share >= 0).all() and (share.sum(axis=0) < 1.1).all()
            # Participants who come nearer to the coolers look at them more.
            assert share.max() > 0.01 and share[3, -1] > share[3, 0]
            assert names["view"].gaze.shape == (2, 16, 24)
    assert (tmp_path / "attention.png").stat().st_size > 10_000
    assert nerg.RadianceField.load(tmp_path / "copy.safetensors").kind == "radiance"
    assert names["on_display"].share.shape == (1,) and names["on_display"].share[0] > 0
    assert names["seen"].gaze.shape == (1, 2) and names["down"].color.shape == (2, 3)
    assert 1.5 < names["down"].depth[0] < 1.7


# ---- The quick start ----

SMALLER = {
    "nerg render": "--spp 1 -D width=24 -D height=16",
    "nerg train": "--radius 0.6 --steps 2 --min-rays 8 --seed 1 --test-positions 4 --force",
    "nerg eval": "--min-rays 4",
    "nerg report": "--width 36",
    "nerg stats": "--viewpoints 8 --resamples 199",
}
"""What is added to a command, so that it takes a second."""


def quick_start() -> list[str]:
    """The commands of the page, without the viewer, which runs until it is stopped; see tests/viewer."""
    lines = [line for block in blocks("sh", page="quickstart.md") for line in block.lines]
    return [line for line in lines if line.startswith("nerg ") and not line.startswith("nerg view")]


def test20_the_quick_start_leads_from_a_recording_to_a_picture():
    done = [" ".join(line.split()[:2]) for line in quick_start()]
    order = ["nerg rays", "nerg train", "nerg eval", "nerg scene", "nerg render", "nerg report", "nerg stats"]
    assert [command for command in done[2:] if command in order][-len(order) :] == order
    assert set(SMALLER) <= set(done)


@pytest.mark.nightly
@pytest.mark.slow
def test21_commands_of_the_quick_start(rgb, clone, tmp_path, capsys):
    from nerg_mi.scenes.store import layout, shoppers, twin

    store = clone("scene.xml", "regions.json")
    (store / "build").mkdir()
    (tmp_path / "out").mkdir()
    write_standins(store)
    recording = store / "build" / "shoppers.csv"
    shoppers.write_shoppers(layout.build_store(0), recording, log=str, shoppers=6, stops=(4, 5), scene=twin.load_twin())
    for line in quick_start():
        words = shlex.split(line, comments=True)[1:]
        words += shlex.split(SMALLER.get(" ".join(line.split()[:2]), ""))
        with pytest.raises(SystemExit) as end:
            nerg_mi.cli.main(words)
        assert not end.value.code, (line, capsys.readouterr().err)
        for name in re.findall(r"-o (\S+)", line):
            assert (tmp_path / name).stat().st_size > 0, line
    # The page contains the output of the guess.
    assert "preset skeleton" in (ROOT / "docs" / "tutorials" / "quickstart.md").read_text(encoding="utf-8")
