"""Every block of code of the pages: what Python and XML say is run, commands are parsed as they stand, and those of the
quick start are run on a small recording. A block that is neither has a reason, in one table."""

from __future__ import annotations

import json
import re
import shlex
import shutil
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from nerg_mi.workflows import demo
from tests.conftest import ROOT

PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").glob("*.md"))]

RUN_ELSEWHERE = {
    ("README.md", "python"): "tests/test_readme.py",
    ("README.md", "xml"): "tests/test_readme.py",
    ("clusters.md", "python"): "tests/tasks/test_page.py",
    ("gradients.md", "python"): "tests/test_gradients_page.py",
    ("pictures.md", "py"): "tests/test_pictures_page.py",
    ("python.md", "python"): "tests/api/test_page.py",
    ("sign.md", "python"): "tests/test_sign_page.py",
    ("splats.md", "python"): "tests/plugins/test_splats.py",
    ("rays.md", "python"): "tests/rays/test_manual.py",
    ("shop.md", "json"): "tests/test_shop_page.py",
    ("shop.md", "python"): "tests/test_shop_page.py",
    ("statistics.md", "json"): "tests/test_shop_page.py",
}
"""All blocks of a language on a page -> the tests that run them."""

NOT_RUN = {
    ("applications.md", "text"): "a formula",
    ("bake.md", "text"): "formulas, and what a command prints",
    ("plugins.md", "math"): "a formula",
    ("python-reference.md", "{eval-rst}"): "what Sphinx is told; `make manual` builds the page",
    ("quickstart.md", "text"): "what commands print",
    ("tracking.md", ""): "what commands print, and a list of files",
    ("posed-images.md", "text"): "installs a package, which needs the network",
}
"""All blocks of a language on a page -> why nothing is there to be run."""

SHELL = {
    "make": "its target is looked up in the Makefile",
    "python": "its script and options are looked up by tests/test_docs.py",
    "nerg": "it is parsed, and run where it is quick",
    "export": "a setting of the reader's shell",
    "_NERG_COMPLETE=source_bash": "tests/cli/test_completion.py asks for it",
    "_NERG_COMPLETE=source_zsh": "tests/cli/test_completion.py asks for it",
    "_NERG_COMPLETE=source_fish": "tests/cli/test_completion.py asks for it",
    "pip": "installs packages, which needs the network; its extras are looked up in pyproject.toml",
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
        """The lines of a shell, those that go on joined, a loop as what it repeats."""
        joined = re.sub(r"\\\n\s*", " ", self.text).splitlines()
        return [re.sub(r"^for \w+ in .*?; do (.*); done$", r"\1", line.strip()) for line in joined if line.strip()]


def blocks(*languages: str, page: str = "") -> list[Block]:
    """The blocks of the pages, of these languages or all, of this page or all."""
    found = []
    for path in PAGES:
        for _, language, text in re.findall(r"^( *)```([^\n`]*)\n(.*?)^ *```", path.read_text("utf-8"), re.M | re.S):
            if (not languages or language in languages) and page in ("", path.name):
                found.append(Block(path.name, language, text))
    return found


def test01_no_block_is_left_out():
    here = {"sh", ("interchange.md", "python"), ("tracking.md", "python"), ("python.md", "py")}
    here |= {("report.md", "json")}
    here |= {(b.page, b.language) for b in blocks("xml", "python") if b.page in ("plugins.md", *XML_PAGES)}
    for block in blocks():
        key = (block.page, block.language)
        assert block.language in here or key in here or key in RUN_ELSEWHERE or key in NOT_RUN, key
    for table in (RUN_ELSEWHERE, NOT_RUN):
        assert set(table) <= {(b.page, b.language) for b in blocks()}, "the table names blocks that are gone"
    assert not [file for file in RUN_ELSEWHERE.values() if not (ROOT / file).is_file()]


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
                assert {e for found in re.findall(r"\[([\w,]+)\]", line) for e in found.split(",")} <= extras, line


def test04_areas_are_read(tmp_path):
    from nerg_mi.formats.areas import read_regions

    for block in blocks("json", page="report.md"):
        (tmp_path / "a.json").write_text(block.text)
        assert all(region.holds(region.corners).all() for region in read_regions(tmp_path / "a.json"))


XML_PAGES = ("gaze-training.md", "performance.md", "plugins.md", "shapes-and-fields.md", "splats.md")


@pytest.fixture
def place(rgb, standins, tmp_path, monkeypatch):
    """A folder with what snippets name: stand-ins of the store's fields, a scene of them, rays."""
    from tests.evaluation.test_gaze import crowd
    from tests.formats.splats.writers import random_splats, write_inria

    for file in standins.values():
        shutil.copy(file, tmp_path)
    shutil.copy(demo.store_scene(), tmp_path)
    shutil.copy(tmp_path / "store.safetensors", tmp_path / "field.safetensors")
    crowd().save(tmp_path / "day.npz")
    write_inria(tmp_path / "store.ply", random_splats())
    monkeypatch.chdir(tmp_path)
    return tmp_path


def as_scene(text: str) -> str:
    """A snippet within what it stands in."""
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
    names: dict = {}
    (block,) = blocks("python", page="interchange.md")
    exec(compile(block.text, block.page, "exec"), names)
    assert names["sigma"].shape == (100,) and names["color"].shape == (100, 3)


def test08_datasets(tmp_path, monkeypatch):
    pytest.importorskip("pyarrow", reason="pyarrow is not installed")
    from tests.rays.dataset.making import write_dataset

    monkeypatch.chdir(tmp_path)
    _, rays = write_dataset(tmp_path, place="north")
    names: dict = {}
    for block in blocks("python", page="tracking.md"):
        text = block.text.replace('["ann"]', '["p0_1"]')
        exec(compile(text, block.page, "exec"), names)
    assert len(names["some"]) == len(rays) == names["seen"].count_rows()
    assert len(names["rays"]) > 0 and set(np.array(names["rays"].persons)[names["rays"].person]) == {"p0_1"}


@pytest.mark.nightly
@pytest.mark.slow
def test09_from_recordings(rgb, place, monkeypatch):
    """The block of trainings, whose inputs are a table of four people and photos of the store, with fewer steps."""
    import nerg_mi as nerg

    rays = nerg.load_rays("day.npz")
    names = [rays.persons[k] for k in rays.person]
    table = np.column_stack([rays.t, rays.origin, rays.direction])
    lines = [",".join(map(str, row)) + f",{who}" for row, who in zip(table, names)]
    Path("day.csv").write_text("t,x,y,z,dx,dy,dz,who\n" + "\n".join(lines) + "\n")
    (text,) = [block.text for block in blocks("py", page="python.md")]
    fewer = {"minutes=5": "steps=2, holdout=0", "test_zones=3": FEW}
    for long, short in fewer.items():
        assert text.count(long) == 1
        text = text.replace(long, short)
    write_photos(place / "photos", nerg)
    names = {"nerg": nerg}
    exec(compile(text, "docs/python.md", "exec"), names)
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
    about = {"camera_angle_x": float(np.radians(70)), "w": 24, "h": 16, "frames": frames}
    (folder / "transforms.json").write_text(json.dumps(about))
