"""Readers of binary files under atheris, a coverage-guided fuzzer (extra ``fuzz``).

Usage: python tests/fuzz/atheris_targets.py TARGET SECONDS [options of libFuzzer]

The run starts with a valid input. It ends at an outcome that is neither a result nor a `NergError`, and libFuzzer
writes the input into the working directory.
"""

from __future__ import annotations

import os
import sys
import tempfile
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))

import atheris  # noqa: E402

# Libraries are instrumented on import. These libraries are imported first, to exclude them.
import mitsuba as mi  # noqa: E402
import numpy as np  # noqa: E402, F401

with atheris.instrument_imports(include=["nerg_mi.formats", "nerg_mi.photos", "zipfile", "gzip"]):
    import nerg_mi  # noqa: F401
    from nerg_mi.errors import NergError
    from nerg_mi.files.images import check_image
    from nerg_mi.files.safe_read import parse_json, read_npy, read_npz
    from nerg_mi.formats.fields import load_radiance
    from nerg_mi.formats.torch_files import check_pickle
    from nerg_mi.formats.torch_ngp import ImportOptions, read_torch_ngp
    from nerg_mi.photos.colmap import read_colmap
    from nerg_mi.photos.images import read_image

from tests.fuzz.cases import make_inputs  # noqa: E402
from tests.fuzz.readers import READERS  # noqa: E402


def _namespace():
    from drjit.llvm import ad

    return ad


def _pickle(path: Path) -> object:
    # Errors in a pickle are translated by the reader of the archive.
    try:
        return check_pickle(path.read_bytes())
    except (ValueError, IndexError, KeyError, OverflowError) as error:
        raise NergError(str(error)) from error


TARGETS = {
    "checkpoint": ("radiance checkpoint", "field.safetensors", lambda p: load_radiance(p, _namespace())),
    "torch": (
        "torch-ngp checkpoint",
        "ngp.pth",
        lambda p: read_torch_ngp(p, _namespace(), options=ImportOptions(finest=32)),
    ),
    "pickle": ("torch-ngp checkpoint", "pickle", _pickle),
    "npy": ("picture a.npy", "a.npy", read_npy),
    "npz": ("rays rays.npz", "rays.npz", read_npz),
    "exr": ("picture a.exr", "a.exr", read_image),
    "header": ("picture a.jpg", "a.jpg", check_image),
    "json": ("transforms", "transforms.json", lambda p: parse_json(p.read_bytes(), p)),
    "colmap": ("COLMAP binary", "sparse/0/images.bin", lambda p: read_colmap(p.parent, p.parents[2] / "images")),
}


def main() -> None:
    if len(sys.argv) < 3 or sys.argv[1] not in TARGETS:
        sys.exit(f"name one of {', '.join(TARGETS)}, and for how many seconds")
    mi.set_variant("llvm_ad_rgb")
    name, seconds = sys.argv.pop(1), float(sys.argv.pop(1))
    reader, target, read = TARGETS[name]
    folder = Path(tempfile.mkdtemp(prefix="nerg-atheris-"))
    inputs = make_inputs([r for r in READERS if r.name == reader], folder / "inputs") / reader
    if target == "pickle":
        import zipfile

        with zipfile.ZipFile(inputs / "ngp.pth") as archive:
            (inputs / target).write_bytes(archive.read("ngp/data.pkl"))
    file, seeds = inputs / target, folder / "seeds"
    seeds.mkdir()
    (seeds / "valid").write_bytes(file.read_bytes())

    start, runs = time.monotonic(), 0

    def attempt(data: bytes) -> None:
        nonlocal runs
        if time.monotonic() - start > seconds:
            print(f"{name}: {runs} inputs in {seconds:.0f} s, each a result or one sentence", flush=True)
            # At the regular exit of libFuzzer, the threads of Dr.Jit would abort the process.
            os._exit(0)
        runs += 1
        file.write_bytes(data)
        try:
            read(file)
        except NergError:
            pass

    atheris.Setup([*sys.argv, str(seeds), "-rss_limit_mb=3000", "-timeout=10"], attempt)
    atheris.Fuzz()


if __name__ == "__main__":
    main()
