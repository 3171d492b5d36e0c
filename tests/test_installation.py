"""A checkout without installation, the order of imports, the choice of libLLVM, and the diagnosis of a machine."""

from __future__ import annotations

import ast
import importlib
import importlib.metadata
import os
import re
import shutil
import subprocess
import sys
import textwrap
from pathlib import Path

import numpy
import pytest
from packaging.requirements import Requirement

from nerg_mi import diagnosis, llvm
from nerg_mi.errors import NergError, UnusableLLVM, translate_mitsuba_errors
from nerg_mi.registration import PLUGINS, _make_constructor
from tests.conftest import ROOT

# ---- A checkout without installation ----


# Folder of the dependencies. Without the site module, .pth files and thus editable installations are ignored.
SITE = Path(numpy.__file__).parents[1]


@pytest.fixture
def clone(tmp_path):
    """A copy of the checkout."""
    for name in ("nerg_mi", "plugins", "scenes"):
        shutil.copytree(ROOT / name, tmp_path / name, ignore=shutil.ignore_patterns("__pycache__", "build"))
    return tmp_path


def run_uninstalled(code: str, folder: Path, **environment):
    """Run ``code`` in ``folder`` with a Python that has the dependencies, but not the package."""
    begin = f"import sys\nsys.path.append({str(SITE)!r})\n"
    begin += "assert not any('editable' in repr(f).lower() for f in sys.meta_path)\n"
    inherited = {k: v for k, v in os.environ.items() if k != "PYTHONPATH"}
    return subprocess.run(
        [sys.executable, "-S", "-c", begin + textwrap.dedent(code)],
        cwd=folder,
        env=inherited | environment,
        capture_output=True,
        text=True,
        timeout=300,
    )


USE = """
    import nerg_mi, mitsuba as mi
    mi.set_variant("llvm_ad_rgb")
    mi.set_variant("llvm_ad_mono")
    mi.set_variant("llvm_ad_rgb")
    print(type(mi.load_dict({"type": "nerg", "density": {"type": "constvolume"}})).__name__)
    from nerg_mi.scenes.store import layout
    from nerg_mi.plugins import nerg
    print(nerg.__file__, layout.__file__)
"""


@pytest.mark.parametrize("elsewhere", [False, True])
def test01_checkout_works_without_installation(clone, elsewhere):
    done = run_uninstalled(USE, Path("/"), PYTHONPATH=str(clone)) if elsewhere else run_uninstalled(USE, clone)
    assert done.returncode == 0, done.stderr
    kind, files = done.stdout.strip().splitlines()[-2:]
    assert kind == "NergIntegrator"
    assert files.split() == [str(clone / "plugins" / "nerg.py"), str(clone / "scenes" / "store" / "layout.py")]


def test01_an_editable_installation_is_found_next_to_a_clone_of_that_name(tmp_path):
    """From the folder above a clone, ``nerg_mi`` is that folder, unless a package of this name is on the path."""
    pytest.importorskip("setuptools", minversion="77")
    clone, site = tmp_path / "above" / "nerg_mi", tmp_path / "site"
    for name in ("nerg_mi", "plugins", "scenes"):
        shutil.copytree(ROOT / name, clone / name, ignore=shutil.ignore_patterns("__pycache__", "build"))
    for name in ("pyproject.toml", "README.md", "LICENSE", "MANIFEST.in"):
        shutil.copy(ROOT / name, clone / name)
    # What pip does for `pip install -e`, without its downloads.
    build = f"from setuptools import build_meta; build_meta.build_editable({str(tmp_path)!r})"
    done = subprocess.run([sys.executable, "-c", build], cwd=clone, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    shutil.unpack_archive(next(tmp_path.glob("*.whl")), site, "zip")
    begin = f"import site; site.addsitedir({str(site)!r})\n"
    done = run_uninstalled(
        begin + "import nerg_mi; print(nerg_mi.render.__module__)" + textwrap.dedent(USE), clone.parent
    )
    assert done.returncode == 0, done.stderr
    assert "nerg_mi.figures.pictures" in done.stdout
    assert done.stdout.split()[-2:] == [str(clone / "plugins/nerg.py"), str(clone / "scenes/store/layout.py")]


# ---- Plugins are registered after any order of imports and variant changes; each order needs a process ----


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
def test02_every_import_order(code):
    run(code)


def test03_repeated_variant_changes():
    run(
        """
        import nerg_mi, mitsuba as mi
        for variant in ("llvm_ad_rgb", "scalar_rgb", "llvm_ad_mono", "llvm_ad_rgb", "llvm_ad_rgb", "llvm_ad_mono"):
            mi.set_variant(variant)
            if variant != "scalar_rgb":
                check()
        """
    )


def test04_import_loads_nothing():
    loaded = run("import nerg_mi, sys; print(*sys.modules)").split()
    assert not {"mitsuba", "drjit", "numpy", "torch"} & set(loaded)


def test05_mitsuba_without_torch():
    assert (
        "torch"
        not in run(
            "import nerg_mi, mitsuba as mi; mi.set_variant('llvm_ad_rgb'); import sys; print(*sys.modules)"
        ).split()
    )


@pytest.mark.parametrize("name, kind", [p for p in PLUGINS if p[1] != "volume"])
def test06_scalar_variants_are_refused(rgb, name, kind):
    rgb.set_variant("scalar_rgb")
    said = f'"{name}" needs a variant .*"scalar_rgb" is active: call mi.set_variant'
    with pytest.raises(RuntimeError, match=said):
        rgb.load_dict({"type": name})
    with pytest.raises(RuntimeError, match=said):
        rgb.load_string(f'<scene version="3.0.0"><{kind} type="{name}"/></scene>')


def test_errors_of_the_user_in_plugins_have_no_traceback(rgb):
    """In the messages of Mitsuba, as a dict and as XML, at the top and inside of a scene."""
    flat, matrix = rgb.ScalarTransform4f().scale([1, 1, 0]), "1 0 0 0 0 1 0 0 0 0 0 0 0 0 0 1"
    file = str(ROOT / "scenes" / "store" / "shoppers.safetensors")
    gaze = {"type": "gazefield", "filename": file, "to_world": flat}
    xml = (
        f'<volume type="gazefield"><string name="filename" value="{file}"/><transform name="to_world">'
        f'<matrix value="{matrix}"/></transform></volume>'
    )
    for load, content in (
        (rgb.load_dict, gaze),
        (rgb.load_dict, {"type": "scene", "i": {"type": "nerg", "gaze": gaze}}),
        (rgb.load_dict, {"type": "panorama", "to_world": flat}),
        (rgb.load_string, f'<scene version="3.0.0"><integrator type="nerg">{xml}</integrator></scene>'),
    ):
        with pytest.raises(RuntimeError, match='NergError: "to_world"') as info:
            load(content)
        assert "Traceback" not in str(info.value) and "\n" not in str(info.value)
        with pytest.raises(NergError, match='"to_world"') as info, translate_mitsuba_errors():
            load(content)
        assert "NergError" not in str(info.value)
    # The traceback of a bug remains.
    with pytest.raises(RuntimeError, match="(?s)Traceback.*TypeError"):
        rgb.register_integrator("broken", _make_constructor(lambda props: len(props.plugin_name)))
        rgb.load_dict({"type": "broken"})


def test07_scalar_variants_leave_no_state():
    # A volume registered as a texture in scalar_rgb could not be loaded from a dict in any later variant.
    code = (
        "import nerg_mi, mitsuba as mi\n"
        "mi.set_variant('scalar_rgb'); mi.set_variant('llvm_ad_rgb')\n"
        "try: mi.load_dict({'type': 'nerg', 'field': {'type': 'nerf', 'filename': 'nowhere'}})\n"
        "except RuntimeError as e: print(e)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert '"nerf", "gazefield", "gazekde", "splats", "nerg") needs a variant' in done.stdout + done.stderr
    assert '"nowhere" does not exist' in done.stdout.replace(str(Path.cwd()) + "/", "")


def test08_entry_points():
    entries = {e.name: e for e in importlib.metadata.entry_points(group="mitsuba") if e.name.startswith("nerg_")}
    assert set(entries) == {f"nerg_{name}" for name, _ in PLUGINS}
    for name, entry in entries.items():
        module = entry.load()
        assert module.__name__ == "nerg_mi.plugins." + name.removeprefix("nerg_")
        importlib.reload(module)  # what Mitsuba after 3.9 does when the variant changes


AUTOLOAD = """
    import importlib, importlib.metadata, sys, warnings
    import mitsuba as mi

    warnings.simplefilter("error")
    modules = []

    def load_plugins():
        '''Double of Mitsuba after 3.9: import at the first variant, reload at later ones. Errors end the test.'''
        for module in modules:
            importlib.reload(module)
        if not modules:
            entries = importlib.metadata.entry_points(group="mitsuba")
            entries = sorted((e for e in entries if e.name.startswith("nerg_")), key=lambda e: e.name)
            modules.extend(importlib.import_module(e.value) for e in entries)

    def activate(variant):
        if order == "callbacks first" or "nerg_mi" not in sys.modules:
            mi.set_variant(variant)
            load_plugins()
        else:
            from nerg_mi import registration
            mi.detail.remove_variant_callback(registration._on_variant)
            old = mi.variant()
            mi.set_variant(variant)
            load_plugins()
            registration._on_variant(old, variant)

    def load(kind):
        try:
            return mi.load_dict(kind)
        except RuntimeError as error:
            return str(error)

    for variant in variants:
        activate(variant)
        from nerg_mi.registration import get_plugin_class
        nerg = load({"type": "nerg", "density": {"type": "constvolume"}})
        field = load({"type": "nerg", "field": {"type": "nerf", "filename": "nowhere"}})
        sensor = load({"type": "panorama"})
        if variant.startswith("scalar"):
            assert "needs a variant with compiled kernels" in nerg and "needs a variant" in sensor, (nerg, sensor)
        else:
            assert type(nerg) is get_plugin_class("nerg") and nerg.variant_name() == variant, nerg
            assert type(sensor) is get_plugin_class("panorama") and "does not exist" in field, (sensor, field)
    print("done")
"""


@pytest.mark.parametrize("order", ["callbacks first", "plugins first"])
@pytest.mark.parametrize(
    "variants", [("llvm_ad_rgb", "scalar_rgb", "llvm_ad_mono", "llvm_ad_rgb"), ("scalar_spectral", "llvm_ad_rgb")]
)
def test27_autoloaded_plugins_are_registered_twice_without_harm(order, variants):
    """The caller does not import nerg_mi. Mitsuba reloads the modules, and so does the callback of nerg_mi."""
    assert "done" in run(f"order, variants = {order!r}, {variants!r}\n" + textwrap.dedent(AUTOLOAD))


def test09_broken_plugin_is_reported():
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


# ---- The choice of libLLVM ----


def make_fake_libraries(folder, *names):
    for name in names:
        (folder / name).touch()
    return folder


@pytest.fixture
def machine(tmp_path, monkeypatch):
    """A machine whose libraries are only those in a folder, without NVIDIA driver, and with Dr.Jit not loaded."""
    monkeypatch.setattr(llvm, "_FOLDERS", {sys.platform: (str(tmp_path),)})
    monkeypatch.setattr(sys, "prefix", str(tmp_path / "nothing"))
    monkeypatch.setattr(llvm, "_find_loaded", lambda: None)
    monkeypatch.setattr(llvm, "has_cuda", lambda: False)
    # Set it first, so that monkeypatch also restores it if it was not set.
    monkeypatch.setenv(llvm.PATH_VARIABLE, "")
    monkeypatch.delenv(llvm.PATH_VARIABLE)
    monkeypatch.delitem(sys.modules, "drjit", raising=False)
    return tmp_path


@pytest.mark.parametrize(
    "name, version",
    [
        ("libLLVM-14.so.1", (14,)),
        ("libLLVM-14.0.6.so.1", (14, 0, 6)),
        ("libLLVM.so.19.1", (19, 1)),
        ("libLLVM-22.so", (22,)),
        ("libLLVM.so.20.1-rust-1.86", (20, 1)),
    ],
)
def test10_llvm_version_from_name(tmp_path, name, version):
    make_fake_libraries(tmp_path, name)
    assert llvm.find_version(str(tmp_path / name)) == version


def test11_llvm_version_of_link(tmp_path):
    make_fake_libraries(tmp_path, "libLLVM-15.so.1")
    (tmp_path / "libLLVM.so").symlink_to("libLLVM-15.so.1")
    assert llvm.find_version(str(tmp_path / "libLLVM.so")) == (15,)


def test12_llvm_version_without_name(tmp_path):
    good = next((library for library in llvm.find_installed() if library.is_usable), None)
    if good is None:
        pytest.skip("no usable libLLVM in the usual places of this machine")
    # A hard link without a number in its name; a copy would have 100 MB.
    nameless = tmp_path / "libLLVM.so"
    try:
        os.link(os.path.realpath(good.path), nameless)
    except OSError:
        pytest.skip("the temporary folder is on another file system than libLLVM")
    assert llvm.find_version(str(nameless))[0] == good.version[0]


def test13_invalid_library_has_no_version(tmp_path):
    (tmp_path / "libLLVM.so").write_text("not a library")
    assert llvm.find_version(str(tmp_path / "libLLVM.so")) is None
    assert llvm.find_version(str(tmp_path / "missing.so")) is None


@pytest.mark.skipif(sys.platform != "linux", reason="the names of the files are those of Linux")
def test14_newest_usable_llvm_is_selected(machine):
    make_fake_libraries(machine, "libLLVM-14.so.1", "libLLVM-15.so.1", "libLLVM.so.22.1", "libLLVM-17.so.1")
    llvm.select_library()
    assert os.environ[llvm.PATH_VARIABLE] == str(machine / "libLLVM.so.22.1")
    assert llvm.find_problem() is None
    llvm.require_usable()


@pytest.mark.skipif(sys.platform != "linux", reason="the names of the files are those of Linux")
def test15_only_unusable_llvm(machine, monkeypatch):
    make_fake_libraries(machine, "libLLVM-15.so.1", "libLLVM-16.so.1")
    llvm.select_library()
    assert llvm.PATH_VARIABLE not in os.environ
    with pytest.raises(UnusableLLVM, match="16.*17.*libllvm19"):
        llvm.require_usable()
    # With an NVIDIA driver, only llvm variants are refused.
    monkeypatch.setattr(llvm, "has_cuda", lambda: True)
    llvm.require_usable()
    llvm.require_usable("cuda_ad_rgb")
    with pytest.raises(UnusableLLVM, match="LLVM 16"):
        llvm.require_usable("llvm_ad_rgb")


def test16_missing_llvm_is_refused_by_llvm_variants(machine):
    llvm.select_library()
    llvm.require_usable()
    llvm.require_usable("scalar_rgb")
    with pytest.raises(UnusableLLVM, match="No libLLVM was found"):
        llvm.require_usable("llvm_ad_rgb")


def test17_user_setting_is_kept(machine, monkeypatch):
    make_fake_libraries(machine, "libLLVM.so.19.1", "libLLVM-15.so.1")
    for bad, said in (("libLLVM-15.so.1", "LLVM 15"), ("missing.so", "not a file|no file")):
        monkeypatch.setenv(llvm.PATH_VARIABLE, str(machine / bad))
        monkeypatch.setattr(llvm, "has_cuda", lambda: True)
        llvm.select_library()
        assert os.environ[llvm.PATH_VARIABLE] == str(machine / bad)
        with pytest.raises(UnusableLLVM, match=said):
            llvm.require_usable()


@pytest.mark.skipif(sys.platform != "linux", reason="the names of the files are those of Linux")
def test18_remedy_names_usable_llvm(machine, monkeypatch):
    make_fake_libraries(machine, "libLLVM.so.19.1", "libLLVM-15.so.1")
    monkeypatch.setenv(llvm.PATH_VARIABLE, str(machine / "libLLVM-15.so.1"))
    assert f"unset {llvm.PATH_VARIABLE}, since LLVM 19.1" in llvm.find_problem()


def test19_old_llvm_is_refused_without_abort():
    old = next((library for library in llvm.find_installed() if library.version[0] in (15, 16)), None)
    if old is None:
        pytest.skip("no libLLVM 15 or 16 on this machine")
    orders = "import nerg_mi, drjit", "import nerg_mi, mitsuba", "import drjit, nerg_mi", "import mitsuba, nerg_mi"
    for code in orders:
        run = subprocess.run(
            [sys.executable, "-c", code],
            env={**os.environ, llvm.PATH_VARIABLE: old.path},
            capture_output=True,
            text=True,
        )
        assert run.returncode == 1, code
        last = run.stderr.strip().splitlines()[-1]
        assert last.startswith(f"nerg_mi.errors.UnusableLLVM: LLVM {old.version[0]}"), last


def test20_loaded_llvm_is_checked(monkeypatch):
    import drjit as dr

    assert llvm.find_current().version == tuple(dr.detail.llvm_version())
    # Changes after loading Dr.Jit have no effect.
    monkeypatch.setenv(llvm.PATH_VARIABLE, "/nowhere/libLLVM-15.so.1")
    assert llvm.find_problem() is None


@pytest.mark.parametrize("late", ["drjit", "mitsuba"])
def test21_error_is_raised_at_drjit_import(late, tmp_path):
    """Functions without kernels work, such as `nerg doctor`; a second import fails like the first."""
    make_fake_libraries(tmp_path, "libLLVM-15.so.1")
    code = (
        "import nerg_mi.diagnosis\nprint('imported')\n"
        f"try: import {late}\nexcept ImportError as error: print(type(error).__name__)\nimport {late}"
    )
    bad = {**os.environ, llvm.PATH_VARIABLE: str(tmp_path / "libLLVM-15.so.1")}
    run = subprocess.run([sys.executable, "-c", code], env=bad, capture_output=True, text=True)
    assert run.returncode == 1 and run.stdout.split() == ["imported", "UnusableLLVM"]
    assert run.stderr.strip().splitlines()[-1].startswith("nerg_mi.errors.UnusableLLVM: LLVM 15")


# ---- Diagnosis of the machine ----


def test22_crashing_backend_is_reported(monkeypatch):
    monkeypatch.setattr(
        diagnosis, "_TEST_SCRIPT", "import os, sys; print('LLVM ERROR: no', file=sys.stderr, flush=True); os.abort()"
    )
    assert diagnosis.try_backend("llvm") == {"variants": [], "failed": {"llvm": "LLVM ERROR: no"}}


def test23_extras_use_distribution_names(monkeypatch):
    """The names are those of distributions in pyproject.toml; scikit-image differs from its module name."""
    project = (ROOT / "pyproject.toml").read_text()
    assert all(f'["{name}>=' in project for name in diagnosis.EXTRAS)


def test24_problems_follow_their_topic():
    result = diagnosis.Diagnosis(
        [diagnosis.Finding("LLVM", "none", "install it"), diagnosis.Finding("threads", "2")], is_usable=False
    )
    assert result.to_text() == "LLVM     none\n         -> install it\nthreads  2"


WORKS = {"variants": ["llvm_ad_rgb"], "failed": {}, "threads": 2, "version": [19, 1, 7]}
NO_FINDINGS = {"variants": [], "failed": {"llvm": "it died"}}


@pytest.mark.parametrize("backend_state, verdict", [(WORKS, "ready to render"), (NO_FINDINGS, "cannot render")])
def test25_verdict(monkeypatch, backend_state, verdict):
    scalar = {"variants": ["scalar_rgb"], "failed": {}}
    monkeypatch.setattr(diagnosis, "try_backend", lambda backend: scalar if backend == "scalar" else backend_state)
    monkeypatch.setattr(llvm, "has_cuda", lambda: False)
    monkeypatch.setattr(llvm, "find_problem", lambda: None)
    result = diagnosis.run_diagnosis()
    assert result.is_usable is (backend_state is WORKS) and verdict in result.to_text()
    assert ("it died" in result.to_text()) is (backend_state is NO_FINDINGS)


@pytest.mark.parametrize("version, is_tested", [("3.9.1", True), ("3.10.0", False), (None, True)])
def test28_untested_mitsuba_is_reported(monkeypatch, version, is_tested):
    monkeypatch.setattr(diagnosis, "try_backend", lambda backend: WORKS)
    monkeypatch.setattr(llvm, "has_cuda", lambda: False)
    monkeypatch.setattr(diagnosis, "_version", lambda name: version)
    assert (diagnosis.run_diagnosis().findings[0].problem == "") is is_tested


@pytest.mark.parametrize("version, old", [([12, 4], True), ([12, 8], False), ([13, 0], False)])
def test26_old_driver_is_reported(monkeypatch, version, old):
    monkeypatch.setattr(diagnosis, "try_backend", lambda backend: {**WORKS, "version": version})
    monkeypatch.setattr(llvm, "has_cuda", lambda: True)
    assert ("R570" in diagnosis.run_diagnosis().to_text()) is old


HOLES = [
    # Dependency, last affected version of each release line, advisory, oldest Python with a corrected version.
    ("pillow", ["12.2.0"], "CVE-2026-54058", "3.10"),
    ("pillow", ["12.3.0"], "CVE-2026-112403", "3.11"),
    ("OpenEXR", ["3.4.16", "3.5.2"], "GHSA-frx8-5p4h-j8m7", "3.10"),
    ("torch", ["2.10.0"], "PYSEC-2026-139", "3.10"),
    ("pyarrow", ["23.0.0"], "CVE-2026-25087", "3.10"),
    ("av", ["17.0.1"], "CVE-2026-8461", "3.10"),
    ("distributed", ["2025.12.0"], "CVE-2026-23528", "3.10"),
    ("setuptools", ["78.1.0"], "CVE-2025-47273", "3.10"),
]


@pytest.mark.parametrize("name, affected, advisory, python", HOLES)
def test_versions_with_known_holes_are_not_admitted(name, affected, advisory, python):
    text = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    requirements = [Requirement(match) for match in re.findall(rf'"({name}\b[^"\n]*[<>=][^"\n]*)"', text)]
    valid = [r for r in requirements if r.marker is None or r.marker.evaluate({"python_version": python})]
    assert valid and not any(r.specifier.contains(version) for r in valid for version in affected), advisory


def test_all_packages_are_installed():
    """A package that is missing in the list works in a checkout, and is not part of a wheel."""
    listed = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    folders = {".".join(path.parent.relative_to(ROOT).parts) for path in (ROOT / "nerg_mi").rglob("__init__.py")}
    assert [name for name in sorted(folders) if f'"{name}",' not in listed] == []


OF_EXTRAS = {"c3d", "dask", "distributed", "pyarrow", "pycolmap", "torch", "viser", "websockets", "xarray"}
"""Libraries whose absence is named where they are imported."""


def test_the_package_is_tried_with_tests_that_exist():
    # Other names end the session before any test.
    text = (ROOT / "noxfile.py").read_text(encoding="utf-8")
    (names,) = (ast.literal_eval(n.value) for n in ast.parse(text).body if _assigns(n, "TESTS"))
    assert len(names) > 5 and all((ROOT / "tests" / name).exists() for name in names)


def _assigns(node: ast.stmt, name: str) -> bool:
    return isinstance(node, ast.Assign) and [ast.unparse(target) for target in node.targets] == [name]


def test_libraries_of_the_core_are_dependencies():
    """Such as narwhals, which reads the data frames of `Rays.from_dataframe`."""
    statement = re.compile(
        r"^ *(?:from (\w+)[.\w]* import|import ([a-zA-Z]\w*)[.\w]*(?: as \w+)?(?:  #.*)?$)", re.MULTILINE
    )
    imported = set()
    for path in (path for name in ("nerg_mi", "plugins", "scenes") for path in (ROOT / name).rglob("*.py")):
        imported |= {a or b for a, b in statement.findall(path.read_text(encoding="utf-8"))}
    typing_only, in_prose = {"_typeshed", "typing_extensions"}, {"Mitsuba"}
    libraries = imported - set(sys.stdlib_module_names) - OF_EXTRAS - typing_only - in_prose - {"nerg_mi"}
    text = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    listed = re.findall(r'^    "([\w-]+)', text[text.index("\ndependencies = ") : text.index("\n]\n")], re.MULTILINE)
    distributions = {"PIL": "pillow", "Imath": "OpenEXR"}
    assert {distributions.get(name, name) for name in libraries} == set(listed)
