"""Which code made an output."""

from importlib.metadata import version
from importlib.util import find_spec

from nerg_mi.tasks.code import RENDERS, code_digest, digest_of_sources, processor, versions


def test_versions_name_code_and_programs():
    found = versions(*RENDERS)
    assert found == {"code": code_digest(), **{name: version(name) for name in ("mitsuba", "drjit", "numpy")}}
    assert len(code_digest()) == 16 and int(code_digest(), 16) >= 0 and processor()


def test_the_digest_follows_the_sources_that_compute(tmp_path):
    for name in ("maths/vmf.py", "jobs/film.py", "cli/render.py", "tasks/store.py", "notes.txt"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text("x = 1\n")
    found = [digest_of_sources([("nerg_mi", tmp_path)])]
    for name in ("cli/render.py", "tasks/store.py", "notes.txt"):
        (tmp_path / name).write_text("x = 2\n")
        assert digest_of_sources([("nerg_mi", tmp_path)]) == found[0], name
    for name in ("maths/vmf.py", "jobs/film.py"):
        (tmp_path / name).write_text("x = 2\n")
        found.append(digest_of_sources([("nerg_mi", tmp_path)]))
    (tmp_path / "maths" / "vmf.py").rename(tmp_path / "maths" / "other.py")
    found.append(digest_of_sources([("nerg_mi", tmp_path)]))
    assert len(set(found)) == 4


def test_plugins_and_scenes_count():
    """They lie beside the package in a checkout."""
    for name in ("plugins", "scenes"):
        assert find_spec(f"nerg_mi.{name}").submodule_search_locations, name
