"""The examples of the README run as they stand there, only smaller."""

import re
import shutil
from pathlib import Path

import numpy as np
import pytest

from nerg_mi.workflows import demo
from tests.figures.standins import write_standins

README = Path(__file__).resolve().parents[1] / "README.md"


def blocks(language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```", README.read_text(), re.M | re.S)


@pytest.fixture
def clone(rgb, tmp_path, monkeypatch):
    """A folder with the store's scene and checkpoints (random ones where the store has none), as a clone has them."""
    store = tmp_path / "scenes" / "store"
    store.mkdir(parents=True)
    shutil.copy(demo.store_scene(), store)
    own = [demo.store_scene().parent / name for name in demo.CHECKPOINTS.values()]
    if all(p.is_file() for p in own):
        for path in own:
            shutil.copy(path, store)
    else:
        write_standins(store)
    monkeypatch.chdir(tmp_path)
    return store


def smaller(text: str) -> str:
    small, count = re.subn(r"width=480, height=320", "width=36, height=24", text)
    small, more = re.subn(
        r'(name="(?:width|height)" value=")(480|320)"', lambda m: f'{m[1]}{int(m[2]) // 20 + 12}"', small
    )
    assert count + more, "the example has no resolution to make smaller"
    return small


def test01_xml(rgb, clone):
    (text,) = blocks("xml")
    (clone / "example.xml").write_text(smaller(text))
    scene = rgb.load_file(str(clone / "example.xml"))
    picture = np.array(rgb.render(scene))
    assert picture.shape == (28, 36, 7) and np.isfinite(picture).all()
    assert picture[..., 3].max() > 0 and picture[..., 5].max() > 0


def test02_python(rgb, clone):
    (text,) = blocks("python")
    names = {}
    exec(compile(smaller(text), "README.md", "exec"), names)
    one, other = names["gaze"]
    assert one.shape == (24, 36) and one.max() > 0 and not np.array_equal(one, other)
    assert names["share"].shape == (2,) and (names["share"] >= 0).all()


def test03_commands_exist():
    from nerg_mi.cli.building import find_commands

    said = set(re.findall(r"^\| `nerg (\w+)", README.read_text(), re.M))
    assert said and said <= {name.split()[0] for name in find_commands()}


def test04_what_it_names_is_there():
    root = README.parent
    text = README.read_text()
    for target in re.findall(r"\]\((?!http)([^)]+)\)", text):
        assert (root / target).is_file(), target
    for path in ("scenes/store/twin.xml", "benchmarks/store_visibility.py", "LICENSE"):
        assert path in text or path == "scenes/store/twin.xml"
        assert (root / path).is_file(), path


@pytest.mark.parametrize("page", ["README.md", "docs/rays.md", "docs/trust.md"])
def test05_every_way_to_another_machine_is_named(page):
    """A page that says what leaves the machine names the commands that connect (`tests/cli/test_outputs.py` has the
    others open none)."""
    text = (README.parent / page).read_text()
    assert "Nothing leaves the machine unless" in text
    for name in ("--scheduler tcp://", "nerg worker", "nerg view"):
        assert name in text, name
