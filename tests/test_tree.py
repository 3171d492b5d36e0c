"""The tree as a whole: tests mirror it, and no file grows past what one can read."""

from __future__ import annotations

import subprocess

from tests.conftest import ROOT
from tools.mirror import without_tests

LONGEST = 350

_MENDINGS = "a list only: tests/tools/test_mendings.py holds it to the sources, the tests and the page"
_OPTIONS = "only fields: tests/jobs/test_options.py looks at every one, and each job's tests set them"
_REPORT = "parts of one job: tests/jobs/test_report.py reads in the page what they give"
_SECTIONS = "tests/report/sections/test_registry.py shows every section, whole and bare, and reads what it says"

TESTED_ELSEWHERE: dict[str, str] = {
    "nerg_mi/__init__.py": "tests/api/test_names.py asks for every public name",
    "nerg_mi/cli/__init__.py": "tests/cli/test_main.py runs the command",
    "nerg_mi/field/gaze/__init__.py": "it only imports the kinds, which tests/field/gaze/test_registry.py asks for",
    "nerg_mi/jobs/options/__init__.py": _OPTIONS,
    "nerg_mi/jobs/options/ablation.py": _OPTIONS,
    "nerg_mi/jobs/options/alignment.py": _OPTIONS,
    "nerg_mi/jobs/options/bake.py": _OPTIONS,
    "nerg_mi/jobs/options/checkpoints.py": _OPTIONS,
    "nerg_mi/jobs/options/evaluation.py": _OPTIONS,
    "nerg_mi/jobs/options/export.py": _OPTIONS,
    "nerg_mi/jobs/options/gaze.py": _OPTIONS,
    "nerg_mi/jobs/options/pictures.py": _OPTIONS,
    "nerg_mi/jobs/options/parts.py": _OPTIONS,
    "nerg_mi/jobs/film_parts.py": "tests/jobs/test_film.py renders by it in every way",
    "nerg_mi/jobs/options/place.py": _OPTIONS,
    "nerg_mi/jobs/options/poses.py": _OPTIONS,
    "nerg_mi/jobs/options/radiance.py": _OPTIONS,
    "nerg_mi/jobs/options/report.py": _OPTIONS,
    "nerg_mi/jobs/options/scene.py": _OPTIONS,
    "nerg_mi/jobs/options/statistics.py": _OPTIONS,
    "nerg_mi/jobs/options/study.py": _OPTIONS,
    "nerg_mi/jobs/options/view.py": _OPTIONS,
    "nerg_mi/rays/checks/protocol.py": "only fields: tests/rays/checks/test_registry.py looks at every check",
    "nerg_mi/rays/readers/parsing/usual_names.py": "names only: headsets/test_unity.py finds columns by them",
    "nerg_mi/jobs/reports/results.py": _REPORT,
    "nerg_mi/jobs/reports/words.py": _REPORT,
    "nerg_mi/maths/types.py": "names for signatures",
    "nerg_mi/report/sections/data.py": _SECTIONS,
    "nerg_mi/report/sections/gaze.py": _SECTIONS,
    "nerg_mi/report/sections/limits.py": _SECTIONS,
    "nerg_mi/report/sections/objects.py": _SECTIONS,
    "nerg_mi/report/sections/people.py": _SECTIONS,
    "nerg_mi/report/sections/place.py": _SECTIONS,
    "nerg_mi/report/sections/protocol.py": _SECTIONS,
    "nerg_mi/report/sections/provenance.py": _SECTIONS,
    "nerg_mi/report/sections/scores.py": _SECTIONS,
    "nerg_mi/report/sections/settings.py": _SECTIONS,
    "nerg_mi/report/sections/stage.py": _SECTIONS,
    "nerg_mi/report/sections/uncertainty.py": _SECTIONS,
    "nerg_mi/report/sections/verdict.py": _SECTIONS,
    "nerg_mi/tasks/__init__.py": "a docstring only",
    "nerg_mi/tasks/protocol.py": "only fields: tests/tasks/test_run.py fulfils it in three more ways",
    "nerg_mi/viewer/__init__.py": "a docstring only",
    "nerg_mi/viewer/page.py": "what browsers are sent: tests/viewer/test_in_chromium.py looks at it in one",
    "nerg_mi/transport/media/hits.py": "only fields: tests/transport/media/splats/test_nearest.py makes them",
    "nerg_mi/transport/media/local_ray.py": "only fields: tests/transport/media/test_protocol.py makes them",
    "tools/mending/__init__.py": _MENDINGS,
    "tools/mending/house.py": _MENDINGS,
    "tools/mending/outputs.py": _MENDINGS,
    "tools/mending/readers.py": _MENDINGS,
    "tools/mending/scenes.py": _MENDINGS,
    "tools/mending/trainings.py": _MENDINGS,
    "tools/mutation/changes.py": "tables only: tests/tools/mutation/test_sites.py finds a mistake of every kind",
}
"""Modules without a file of tests of their own -> where and why."""


def python_files() -> list[str]:
    """Every Python file of the checkout that git does not ignore."""
    listed = ["git", "-C", str(ROOT), "ls-files", "--cached", "--others", "--exclude-standard", "*.py"]
    files = subprocess.run(listed, capture_output=True, text=True, check=True).stdout.split()
    return [name for name in files if (ROOT / name).is_file()]


def test_every_module_has_its_tests():
    assert [m for m in without_tests(("nerg_mi", "plugins", "tools")) if m not in TESTED_ELSEWHERE] == []


def test_exceptions_are_of_modules_that_are_there():
    assert set(TESTED_ELSEWHERE) <= set(without_tests(("nerg_mi", "plugins", "tools")))


def test_no_file_is_longer_than_one_can_read():
    lengths = {name: len((ROOT / name).read_text(encoding="utf-8").splitlines()) for name in python_files()}
    assert len(lengths) > 300 and {name: n for name, n in lengths.items() if n > LONGEST} == {}


def test_nothing_is_kept_from_the_formatter():
    marks = [f"# fmt: {word}" for word in ("skip", "off")]
    assert [n for n in python_files() if any(m in (ROOT / n).read_text(encoding="utf-8") for m in marks)] == []
