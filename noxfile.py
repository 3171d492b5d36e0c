"""The package as others meet it: built, installed where nothing else is, and tried (`make packages`).

    nox -s "package-3.12(newest)" -- -k vmf         with this Python alone, and these tests

`oldest` installs the lowest version of every requirement that pyproject.toml admits and this Python can install.
"""

import shutil
from pathlib import Path

import nox

nox.options.error_on_missing_interpreters = False
EXTRAS = ("test", "parquet", "mesh")
TESTS = (
    "alignment",
    "aoi",
    "api",
    "environment",
    "evaluation",
    "fields",
    "files",
    "formats",
    "maths",
    "photos",
    "plugins/test_nerg.py",
    "surfaces",
    "tracking",
    "transport",
)
"""Below tests/: those that ask for nothing of the checkout but its test data."""


@nox.session(python=["3.10", "3.11", "3.12", "3.13"], venv_backend="uv")
@nox.parametrize("versions", ["newest", "oldest"], ids=["newest", "oldest"])
def package(session: nox.Session, versions: str) -> None:
    folder = Path(session.create_tmp()).resolve()
    shutil.rmtree(folder)
    session.run("uv", "build", "--out-dir", str(folder), external=True)
    (wheel,), (archive,) = folder.glob("*.whl"), folder.glob("*.tar.gz")
    lowest = ["--resolution=lowest-direct", "--no-build"] if versions == "oldest" else []
    extras = [f"--extra={name}" for name in EXTRAS]
    session.install(*lowest, "-r", "pyproject.toml", *extras)
    session.install("--no-deps", str(wheel))
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
