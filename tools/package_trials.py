"""An installed package, tried from outside of the checkout: its commands, what it says of missing extras, its tests."""

from __future__ import annotations

import os
import shutil
from pathlib import Path
from xml.etree import ElementTree

from tools.package_build import EXTRAS, Failure, run

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
    "transport/observer/test_surroundings.py",
    "transport/march/test_quadrature.py",
    "figures",
    "cli/test_demo.py",
    "cli/rays",
    "cli/test_render.py",
)
"""Tests of an installed package, below tests/: they ask for nothing of the checkout but themselves."""


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

    def versions(self) -> dict[str, str]:
        """Name in small letters -> version of each distribution that is installed."""
        each = "d.metadata['Name'] + '=' + d.version for d in m.distributions()"
        listed = self.python(f"import importlib.metadata as m; print(' '.join({each}))")
        return {name.lower(): version for name, version in (pair.split("=") for pair in listed.split())}


def try_commands(there: Environment, out: Path) -> str:
    """Version, diagnosis, demo and a render of the installed scene, from `/`; what was made."""
    if "site-packages" not in there.python("import nerg_mi; print(nerg_mi.__file__)"):
        raise Failure("nerg_mi is not imported from where it was installed")
    there.run("nerg", "--version")
    there.run("nerg", "doctor")
    there.run("nerg", "demo", "--out", out / "demo", "--width", 48, "--spp", 1, "-m", "llvm_ad_rgb")
    scene = there.python("from nerg_mi.jobs.demo import store_scene; print(store_scene())")
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
    field = there.python("from nerg_mi.jobs.demo import store_scene; print(store_scene().parent / 'store.safetensors')")
    scene = Path(field).with_name("scene.xml")
    asked = {
        "nerg-mi[mesh]": ("nerg", "export", "mesh", field, "-o", out / "field.ply", "--resolution", 8),
        "nerg-mi[bake]": (
            *("nerg", "bake", scene.with_name("twin.ply"), "--rays", out / "rays.npz", "-o", out / "a.glb"),
            *("--texture", 64, "--detail", 3),
        ),
        "nerg-mi[parquet]": ("nerg", "rays", "show", out / "rays.parquet"),
        "nerg-mi[poses]": ("nerg", "poses", out, "-o", out / "capture"),
        "nerg-mi[video]": ("nerg", "render", scene, "-o", out / "a.mp4", "--frames", out / "frames.csv"),
        "nerg-mi[mocap]": ("nerg", "rays", "import", out / "a.c3d", "-o", out / "b.npz", "--preset", "c3d"),
        "nerg-mi[cluster]": ("nerg", "worker", "tcp://127.0.0.1:8786"),
        "nerg-mi[torch]": ("python", "-c", "import nerg_mi.interop.torch"),
    }
    (out / "rays.parquet").write_bytes(b"PAR1")
    (out / "a.c3d").write_bytes(b"")
    for extra, (command, *arguments) in asked.items():
        printed = there.run(command, *arguments, code=1).strip().splitlines()
        if extra not in printed[-1] or (command == "nerg" and len(printed) != 1):
            raise Failure(f"without {extra}: {' / '.join(printed[-3:])}")
    return f"{len(asked)} of {len(asked)}"


def try_tests(there: Environment, unpacked: Path, out: Path) -> str:
    """The quick tests of the source archive against what is installed; how many passed."""
    there.install(f"{there.package}[test,{','.join(EXTRAS)}]")
    (out / "outside").mkdir()
    # Only the tests and what they use: next to the sources these would be imported in place of what is installed.
    for read in ("tests", "docs", "tools"):
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
        "-n",
        "auto",
        "--maxprocesses",
        "4",
        "--dist",
        "loadfile",
        f"--junitxml={report}",
        *paths,
        cwd=out / "outside",
    )
    counts = ElementTree.parse(report).getroot().find("testsuite").attrib
    skipped = int(counts["skipped"])
    return f"{int(counts['tests']) - skipped} passed" + (f", {skipped} skipped" if skipped else "")
