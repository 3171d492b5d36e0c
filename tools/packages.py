"""The packages as others meet them: built, installed where nothing else is, and tried from outside of the checkout.

    python tools/packages.py [--row PYTHON/DEPENDENCIES/FROM ...] [--work FOLDER] [--update docs/trust.md]

Each row is one empty environment: PYTHON such as 3.12, DEPENDENCIES `oldest` (the floors that the package names) or
`newest`, FROM `wheel` or `sdist`. Tried in it from `/`: the version, the demo, a render of the installed scene, the
sentence of each extra that is missing, and then, with the test extra, the quick tests as the source archive holds them.
Interpreters are those of PATH and of pyenv; a row whose interpreter is missing says so. Exit code 1 where a row fails.
"""

from __future__ import annotations

import argparse
import os
import re
import shutil
import subprocess
import sys
import tarfile
import tempfile
import zipfile
from dataclasses import dataclass, field
from email import message_from_string
from pathlib import Path
from xml.etree import ElementTree

ROOT = Path(__file__).resolve().parents[1]
ROWS = ("3.10/oldest/wheel", "3.10/newest/sdist", "3.11/newest/wheel", "3.12/newest/wheel", "3.13/newest/sdist")
EXTRAS = ("parquet", "mesh")
"""Extras that the tests of a row run with. torch is none of them: its oldest version is a download of gigabytes."""
TESTS = (
    "rays",
    "density",
    "maths",
    "field/gaze",
    "field/test_radiance.py",
    "files",
    "formats/test_checkpoint.py",
    "formats/test_fields.py",
    "formats/test_surfaces.py",
    "formats/torch_ngp/test_unpickling.py",
    "capture/test_colmap.py",
    "capture/test_transforms.py",
    "interop",
    "plugins/test_gazefield.py",
    "plugins/test_nerf.py",
    "plugins/test_nerg_gradients.py",
    "plugins/test_nerg_observer.py",
    "plugins/test_panorama.py",
    "renders",
    "test_registration.py",
    "training/gaze/test_losses.py",
    "transport/observer/test_integral.py",
    "transport/march/test_quadrature.py",
    "view",
    "cli/test_demo.py",
    "cli/rays",
    "cli/test_render.py",
)
"""Tests of an installed package, below tests/: they ask for nothing of the checkout but themselves."""
# Folder of the checkout -> folder in the wheel
_INSTALLED = {"nerg_mi": "nerg_mi", "plugins": "nerg_mi/plugins", "scenes": "nerg_mi/scenes"}
_LIMIT = 1800


class Failure(Exception):
    """A row that does not work; the message says at what."""


@dataclass
class Row:
    """One line of the table: what was asked for, and what became of each trial."""

    python: str
    dependencies: str
    source: str
    demo: str = "-"
    extras: str = "-"
    tests: str = "-"
    result: str = "works"
    versions: dict[str, str] = field(default_factory=dict)

    @staticmethod
    def of(text: str) -> Row:
        match = re.fullmatch(r"(3\.\d+)/(oldest|newest)/(wheel|sdist)", text)
        if match is None:
            raise ValueError(f'"{text}" is no row: write PYTHON/DEPENDENCIES/FROM, such as 3.12/newest/wheel')
        return Row(*match.groups())

    def cells(self) -> list[str]:
        shown = ", ".join(
            f"{name} {self.versions[name]}" for name in ("mitsuba", "numpy", "scipy") if name in self.versions
        )
        given = f"{self.dependencies}: {shown}" if shown else self.dependencies
        return [
            self.versions.get("python", self.python),
            given,
            self.source,
            self.demo,
            self.extras,
            self.tests,
            self.result,
        ]


HEAD = ("Python", "Dependencies", "Built from", "Demo and render", "Missing extras told", "Tests", "Result")


# ----------------------------------------------------------------------------
# What there is to try
# ----------------------------------------------------------------------------


def interpreters(wanted: set[str]) -> dict[str, Path]:
    """The interpreters found for the versions ``wanted`` ("3.12"): of PATH, else of pyenv."""
    pyenv = Path(os.environ.get("PYENV_ROOT", Path.home() / ".pyenv")) / "versions"
    found = {}
    for version in wanted:
        here = [shutil.which(f"python{version}"), sys.executable, *sorted(pyenv.glob(f"{version}.*/bin/python"))]
        for python in filter(None, here):
            # A name on PATH may be pyenv's, which only says that this version is not switched on.
            probe = "import sys, venv; print('%d.%d' % sys.version_info[:2])"
            answer = subprocess.run([python, "-c", probe], capture_output=True, text=True)
            if answer.returncode == 0 and answer.stdout.strip() == version:
                found[version] = Path(python)
                break
    return found


def floors(metadata: str) -> list[str]:
    """pip constraints that hold every requirement of a wheel's METADATA to its lowest version, those of `EXTRAS`
    included."""
    pinned = []
    for requirement in message_from_string(metadata).get_all("Requires-Dist", []):
        name, _, marker = (part.strip() for part in requirement.partition(";"))
        extra = re.search(r"extra == .(\w+).", marker)
        if extra is not None and extra[1] not in EXTRAS:
            continue
        floor = re.match(r"([\w.-]+).*?(?:>=\s*([\w.]+)|==\s*([\w.]+)\.\*)", name)
        if floor is not None:
            pinned.append(f"{floor[1]}=={floor[2] or floor[3] + '.0'}")
    return pinned


def missing_from_wheel(tracked: list[str], names: list[str]) -> list[str]:
    """Files of the checkout (``tracked``) that are to be installed and are not among the ``names`` in the wheel."""
    there = set(names)
    wanted = ((path, path.split("/", 1)) for path in tracked if "/" in path)
    return [path for path, (top, rest) in wanted if top in _INSTALLED and f"{_INSTALLED[top]}/{rest}" not in there]


def missing_from_sdist(tracked: list[str], names: list[str]) -> list[str]:
    """Files of the checkout (``tracked``) that the source archive lacks, except those that only git and its server
    use."""
    there = {name.split("/", 1)[1] for name in names if "/" in name}
    return [path for path in tracked if not path.startswith(".") and path not in there]


# ----------------------------------------------------------------------------
# Building and installing
# ----------------------------------------------------------------------------


def run(command: list, cwd: Path | str = "/", *, env: dict | None = None, code: int = 0) -> str:
    """Standard output and error of ``command``, which has to end with ``code``; raises `Failure` with its last
    lines."""
    words = [str(c) for c in command]
    shown = " ".join(Path(w).name if w.startswith("/") else w for w in words)[:160]
    try:
        done = subprocess.run(
            words,
            cwd=cwd,
            env=env,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            timeout=_LIMIT,
        )
    except subprocess.TimeoutExpired:
        raise Failure(f"{shown}: no end after {_LIMIT} s") from None
    if done.returncode != code:
        last = " / ".join(done.stdout.strip().splitlines()[-25:])
        raise Failure(f"{shown}: exit code {done.returncode}: {last}")
    return done.stdout


def tracked_files() -> list[str]:
    """Paths of the checkout's files, those that are not committed yet included, without what git ignores."""
    listed = ["git", "-C", ROOT, "ls-files", "-z", "--cached", "--others", "--exclude-standard"]
    return [p for p in run(listed).split("\0") if p and (ROOT / p).is_file()]


def build(work: Path) -> tuple[Path, Path]:
    """Source archive and wheel, made from a copy of the checkout that holds nothing else; raises `Failure`."""
    tracked, copy, out = tracked_files(), work / "checkout", work / "dist"
    for path in tracked:
        (copy / path).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy2(ROOT / path, copy / path)
    run([sys.executable, "-m", "venv", work / "build"])
    python = work / "build" / "bin" / "python"
    run([python, "-m", "pip", "install", "-q", "build"])
    # Without a choice the wheel is built from the source archive, as it is for whoever has only that.
    run([python, "-m", "build", "--outdir", out, copy])
    (sdist,), (wheel,) = out.glob("*.tar.gz"), out.glob("*.whl")
    with tarfile.open(sdist) as archive:
        lost = missing_from_sdist(tracked, archive.getnames())
        archive.extractall(work / "unpacked", filter="data") if hasattr(tarfile, "data_filter") else archive.extractall(
            work / "unpacked"
        )
    lost += missing_from_wheel(tracked, zipfile.ZipFile(wheel).namelist())
    if lost:
        raise Failure(f"the packages lack {len(lost)} files of the checkout: {', '.join(lost[:8])}")
    return sdist, wheel


def metadata_of(wheel: Path) -> str:
    """The text METADATA of a wheel."""
    with zipfile.ZipFile(wheel) as archive:
        (name,) = [n for n in archive.namelist() if n.endswith(".dist-info/METADATA")]
        return archive.read(name).decode()


# ----------------------------------------------------------------------------
# Trying
# ----------------------------------------------------------------------------


class Environment:
    """An empty environment with the package in it, whose commands see nothing of the checkout."""

    def __init__(self, folder: Path, interpreter: Path, package: Path, constraints: list[str], home: Path):
        self.folder, self.package = folder, package
        self.constraints = folder.with_suffix(".constraints")
        self.constraints.write_text("\n".join(constraints) + "\n")
        run([interpreter, "-m", "venv", folder])
        kept = {k: v for k, v in os.environ.items() if not k.startswith(("PYTHON", "VIRTUAL_ENV", "NERG_", "COVERAGE"))}
        self.env = {**kept, "HOME": str(home), "PATH": f"{folder / 'bin'}:{os.environ['PATH']}", "MPLBACKEND": "agg"}
        self.install(package)

    def install(self, *what: str | Path) -> None:
        self.run("python", "-m", "pip", "install", "-q", "--disable-pip-version-check", "-c", self.constraints, *what)

    def run(self, command: str, *arguments, cwd: Path | str = "/", code: int = 0) -> str:
        return run([self.folder / "bin" / command, *arguments], cwd, env=self.env, code=code)

    def python(self, program: str) -> str:
        return self.run("python", "-c", program).strip().splitlines()[-1]


def try_commands(there: Environment, out: Path) -> str:
    """Version, diagnosis, demo and a render of the installed scene, from `/`; what was made."""
    if "site-packages" not in there.python("import nerg_mi; print(nerg_mi.__file__)"):
        raise Failure("nerg_mi is not imported from where it was installed")
    there.run("nerg", "--version")
    there.run("nerg", "doctor")
    there.run("nerg", "demo", "--out", out / "demo", "--width", 48, "--spp", 1, "-m", "llvm_ad_rgb")
    scene = there.python("from nerg_mi.view.demo import store_scene; print(store_scene())")
    sizes = ("-D", "width=36", "-D", "height=24", "-D", "aovs=depth,gaze,visibility")
    there.run("nerg", "render", scene, "-o", out / "scene.exr", "--spp", 1, "-m", "llvm_ad_rgb", *sizes)
    probe = (
        "import nerg_mi, mitsuba as mi, sys; mi.set_variant('llvm_ad_rgb'); b = mi.Bitmap(%r); print(b.channel_count())"
    )
    if there.python(probe % str(out / "scene.exr")) != "6":
        raise Failure("the rendered picture does not have the six channels that were asked for")
    return f"{len(list((out / 'demo').iterdir())) + 1} files"


def try_missing_extras(there: Environment, out: Path) -> str:
    """The commands that need an extra say its name and how to get it, in one line; how many did."""
    field = there.python("from nerg_mi.view.demo import store_scene; print(store_scene().parent / 'store.safetensors')")
    asked = {
        "nerg-mi[mesh]": ("nerg", "export", "mesh", field, "-o", out / "field.ply", "--resolution", 8),
        "nerg-mi[parquet]": ("nerg", "rays", "show", out / "rays.parquet"),
        "nerg-mi[torch]": ("python", "-c", "import nerg_mi.interop.torch"),
    }
    (out / "rays.parquet").write_bytes(b"PAR1")
    for extra, (command, *arguments) in asked.items():
        said = there.run(command, *arguments, code=1).strip().splitlines()
        if extra not in said[-1] or (command == "nerg" and len(said) != 1):
            raise Failure(f"without {extra}: {' / '.join(said[-3:])}")
    return f"{len(asked)} of {len(asked)}"


def try_tests(there: Environment, unpacked: Path, out: Path) -> str:
    """The quick tests of the source archive against what is installed; how many passed."""
    there.install(f"{there.package}[test,{','.join(EXTRAS)}]")
    (out / "outside").mkdir()
    # Only the tests: next to the sources these would be imported in place of what is installed.
    for read in ("tests", "docs"):
        shutil.copytree(unpacked / read, out / "outside" / read)
    (out / "outside" / "pytest.ini").write_text(
        "[pytest]\naddopts = --import-mode=importlib\nmarkers = slow: takes seconds\n"
    )
    report = out / "tests.xml"
    paths = [f"tests/{path}" for path in TESTS]
    there.run(
        "python",
        "-m",
        "pytest",
        "-q",
        "-m",
        "not slow",
        "-o",
        "faulthandler_timeout=600",
        "-p",
        "no:cacheprovider",
        f"--junitxml={report}",
        *paths,
        cwd=out / "outside",
    )
    counts = ElementTree.parse(report).getroot().find("testsuite").attrib
    skipped = int(counts["skipped"])
    return f"{int(counts['tests']) - skipped} passed" + (f", {skipped} skipped" if skipped else "")


def try_row(row: Row, interpreter: Path | None, wheel: Path, sdist: Path, unpacked: Path, work: Path) -> None:
    """Fill in what became of ``row``."""
    if interpreter is None:
        row.result = f"not tried: no Python {row.python} here"
        return
    folder = work / f"{row.python}-{row.dependencies}-{row.source}"
    folder.mkdir()
    (work / "home").mkdir(exist_ok=True)
    pinned = floors(metadata_of(wheel)) if row.dependencies == "oldest" else []
    try:
        there = Environment(
            folder / "env", interpreter, wheel if row.source == "wheel" else sdist, pinned, work / "home"
        )
        listed = "import importlib.metadata as m; print(' '.join(d.metadata['Name'] + '=' + d.version for d in m.distributions()))"
        row.versions = {k.lower(): v for k, v in (pair.split("=") for pair in there.python(listed).split())}
        row.versions["python"] = there.python("import platform; print(platform.python_version())")
        row.extras = try_missing_extras(there, folder)
        row.demo = try_commands(there, folder)
        row.tests = try_tests(there, unpacked, folder)
    except Failure as failure:
        row.result = f"fails: {failure}"


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--row", action="append", type=Row.of, metavar="PYTHON/DEPENDENCIES/FROM")
    parser.add_argument("--work", type=Path, help="empty folder to work in, which is kept")
    parser.add_argument("--update", type=Path, help="page whose table is exchanged")
    options = parser.parse_args(arguments)
    rows = options.row or [Row.of(text) for text in ROWS]
    found = interpreters({row.python for row in rows})
    with tempfile.TemporaryDirectory(prefix="nerg-packages-") as made:
        work = (options.work or Path(made)).resolve()
        work.mkdir(parents=True, exist_ok=True)
        sdist, wheel = build(work)
        (unpacked,) = (work / "unpacked").iterdir()
        for row in rows:
            print(
                f"{row.python}, {row.dependencies} dependencies, from the {row.source} ...", file=sys.stderr, flush=True
            )
            try_row(row, found.get(row.python), wheel, sdist, unpacked, work)
            print(" | ".join(row.cells()), file=sys.stderr, flush=True)
    sys.path.insert(0, str(ROOT))
    from tools.page import table, update

    update(options.update, "Versions", table(HEAD, [row.cells() for row in rows]))
    return int(any(row.result.startswith("fails") for row in rows))


if __name__ == "__main__":
    sys.exit(main())
