"""The package as others meet it: built, installed where nothing else is, and tried (`make packages`).

    nox -s "package-3.12(newest)" -- -k vmf         with this Python alone, and these tests

`oldest` holds every requirement to the lowest version that pyproject.toml names.
"""

import re
import shutil
from pathlib import Path

import nox

nox.options.error_on_missing_interpreters = False
TESTS = ("api", "field", "formats", "maths", "plugins/test_nerg.py", "rays", "statistics", "transport")
"""Below tests/: those that ask for nothing of the checkout but its test data."""


@nox.session(python=["3.10", "3.11", "3.12", "3.13"])
@nox.parametrize("versions", ["newest", "oldest"], ids=["newest", "oldest"])
def package(session: nox.Session, versions: str) -> None:
    folder = Path(session.create_tmp()).resolve()
    shutil.rmtree(folder)
    project = nox.project.load_toml("pyproject.toml")["project"]
    extras = project["optional-dependencies"]
    wanted = [*project["dependencies"], *extras["parquet"], *extras["mesh"]]
    floors = [match[0].replace(">=", "==") for text in wanted if (match := re.match(r"[\w.-]+>=[\w.]+", text))]
    session.install("build")
    session.run("python", "-m", "build", "--outdir", str(folder))
    (wheel,), (archive,) = folder.glob("*.whl"), folder.glob("*.tar.gz")
    session.install(f"{wheel}[test,parquet,mesh]", *(floors if versions == "oldest" else []))
    shutil.unpack_archive(archive, folder)
    source = folder / archive.name.removesuffix(".tar.gz")
    # What is tried is what is installed.
    for name in ("nerg_mi", "plugins"):
        shutil.rmtree(source / name)
    session.chdir(source)
    session.run("nerg", "doctor")
    session.run("nerg", "demo", "--output", str(folder / "demo"))
    paths = [f"tests/{name}" for name in TESTS]
    session.run("pytest", "-q", "-m", "not slow and not nightly", *(session.posargs or paths))
