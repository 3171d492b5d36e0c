"""Plugins are there in every order of imports and after every change of variant. Each order needs a process of its
own."""

import importlib
import importlib.metadata
import subprocess
import sys
import textwrap
from pathlib import Path

import pytest

from nerg_mi.registration import PLUGINS

CHECK = """
def check():
    import mitsuba as mi
    sensor = mi.load_dict({"type": "panorama", "film": {"type": "hdrfilm", "width": 8, "height": 4}})
    assert sensor.variant_name() == mi.variant(), (sensor.variant_name(), mi.variant())
"""


def run(code):
    done = subprocess.run([sys.executable, "-c", CHECK + textwrap.dedent(code)], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.parametrize(
    "code",
    [
        "import nerg_mi; import mitsuba as mi; mi.set_variant('llvm_ad_rgb'); check()",
        "import mitsuba as mi; import nerg_mi; mi.set_variant('llvm_ad_rgb'); check()",
        "import mitsuba as mi; mi.set_variant('llvm_ad_rgb'); import nerg_mi; check()",
        "import drjit; import nerg_mi; import mitsuba as mi; mi.set_variant('llvm_ad_rgb'); check()",
        "import nerg_mi; from mitsuba import set_variant; set_variant('llvm_ad_mono'); check()",
        "import nerg_mi, importlib; importlib.reload(nerg_mi); import mitsuba as mi; "
        "mi.set_variant('llvm_ad_rgb'); check()",
    ],
)
def test01_every_order(code):
    run(code)


def test02_back_and_forth():
    run(
        """
        import nerg_mi, mitsuba as mi
        for variant in ("llvm_ad_rgb", "scalar_rgb", "llvm_ad_mono", "llvm_ad_rgb", "llvm_ad_rgb", "llvm_ad_mono"):
            mi.set_variant(variant)
            if variant != "scalar_rgb":
                check()
        """
    )


def test03_import_loads_nothing():
    loaded = run("import nerg_mi, sys; print(*sys.modules)").split()
    assert not {"mitsuba", "drjit", "numpy", "torch"} & set(loaded)


def test04_mitsuba_without_torch():
    assert (
        "torch"
        not in run(
            "import nerg_mi, mitsuba as mi; mi.set_variant('llvm_ad_rgb'); import sys; print(*sys.modules)"
        ).split()
    )


@pytest.mark.parametrize("name, kind", [p for p in PLUGINS if p[1] != "volume"])
def test05_scalar_sentence(rgb, name, kind):
    rgb.set_variant("scalar_rgb")
    said = f'"{name}" needs a variant that compiles its kernels, and "scalar_rgb" is active: call mi.set_variant'
    with pytest.raises(RuntimeError, match=said):
        rgb.load_dict({"type": name})
    with pytest.raises(RuntimeError, match=said):
        rgb.load_string(f'<scene version="3.0.0"><{kind} type="{name}"/></scene>')


def test05b_scalar_variants_are_warned_of_and_forgotten():
    # A volume that scalar_rgb knew, as a texture, could not be loaded from a dict in any later variant.
    code = (
        "import nerg_mi, mitsuba as mi\n"
        "mi.set_variant('scalar_rgb'); mi.set_variant('llvm_ad_rgb')\n"
        "try: mi.load_dict({'type': 'nerg', 'field': {'type': 'nerf', 'filename': 'nowhere'}})\n"
        "except RuntimeError as e: print(e)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert (
        '"nerf", "gazefield", "gazekde", "splats", "nerg") needs a variant that compiles its kernels'
        in done.stdout + done.stderr
    )
    assert '"nowhere" does not exist' in done.stdout.replace(str(Path.cwd()) + "/", "")


def test06_entry_points():
    entries = {e.name: e for e in importlib.metadata.entry_points(group="mitsuba") if e.name.startswith("nerg_")}
    assert set(entries) == {f"nerg_{name}" for name, _ in PLUGINS}
    for name, entry in entries.items():
        module = entry.load()
        assert module.__name__ == "nerg_mi.plugins." + name.removeprefix("nerg_")
        importlib.reload(module)  # what Mitsuba after 3.9 does when the variant changes


def test07_broken_plugin_is_not_hidden():
    done = subprocess.run(
        [
            sys.executable,
            "-c",
            "import nerg_mi.registration as r; r.PLUGINS += (('missing', 'sensor'),)\n"
            "import mitsuba as mi; mi.set_variant('llvm_ad_rgb')",
        ],
        capture_output=True,
        text=True,
    )
    assert done.returncode == 1 and "nerg_mi.plugins.missing" in done.stderr
