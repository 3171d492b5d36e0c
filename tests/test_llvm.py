"""The choice of libLLVM: versions by file name, what is refused, and what passes. Files are faked where they can be."""

import os
import subprocess
import sys

import pytest

from nerg_mi import llvm
from nerg_mi.errors import UnusableLLVM


def fake(folder, *names):
    for name in names:
        (folder / name).touch()
    return folder


@pytest.fixture
def machine(tmp_path, monkeypatch):
    """A machine whose only libraries are those put into a folder, with no NVIDIA driver and Dr.Jit not loaded."""
    monkeypatch.setattr(llvm, "_FOLDERS", {sys.platform: (str(tmp_path),)})
    monkeypatch.setattr(sys, "prefix", str(tmp_path / "nothing"))
    monkeypatch.setattr(llvm, "_loaded", lambda: None)
    monkeypatch.setattr(llvm, "has_cuda", lambda: False)
    # Set first, so that what a test makes of it is undone also where it was not set.
    monkeypatch.setenv(llvm.VARIABLE, "")
    monkeypatch.delenv(llvm.VARIABLE)
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
def test01_version_from_name(tmp_path, name, version):
    fake(tmp_path, name)
    assert llvm.version_of(str(tmp_path / name)) == version


def test02_version_of_link_is_that_of_its_target(tmp_path):
    fake(tmp_path, "libLLVM-15.so.1")
    (tmp_path / "libLLVM.so").symlink_to("libLLVM-15.so.1")
    assert llvm.version_of(str(tmp_path / "libLLVM.so")) == (15,)


def test03_nameless_library_is_asked(tmp_path):
    good = next((library for library in llvm.installed() if library.usable), None)
    if good is None:
        pytest.skip("no usable libLLVM in the usual places of this machine")
    # A hard copy would be 100 MB; a file name without a number that is no link will do where hard links are possible.
    nameless = tmp_path / "libLLVM.so"
    try:
        os.link(os.path.realpath(good.path), nameless)
    except OSError:
        pytest.skip("the temporary folder is on another file system than libLLVM")
    assert llvm.version_of(str(nameless))[0] == good.version[0]


def test04_no_library_has_no_version(tmp_path):
    (tmp_path / "libLLVM.so").write_text("not a library")
    assert llvm.version_of(str(tmp_path / "libLLVM.so")) is None
    assert llvm.version_of(str(tmp_path / "missing.so")) is None


@pytest.mark.skipif(sys.platform != "linux", reason="the names of the files are those of Linux")
def test05_newest_usable_is_taken(machine):
    fake(machine, "libLLVM-14.so.1", "libLLVM-15.so.1", "libLLVM.so.19.1", "libLLVM-17.so.1")
    llvm.prepare()
    assert os.environ[llvm.VARIABLE] == str(machine / "libLLVM.so.19.1")
    assert llvm.problem() is None
    llvm.require()


@pytest.mark.skipif(sys.platform != "linux", reason="the names of the files are those of Linux")
def test06_only_bad_ones(machine, monkeypatch):
    fake(machine, "libLLVM-15.so.1", "libLLVM-16.so.1")
    llvm.prepare()
    assert llvm.VARIABLE not in os.environ
    with pytest.raises(UnusableLLVM, match="16.*17.*libllvm19"):
        llvm.require()
    # With an NVIDIA driver the package is of use, and only an llvm variant is refused.
    monkeypatch.setattr(llvm, "has_cuda", lambda: True)
    llvm.require()
    llvm.require("cuda_ad_rgb")
    with pytest.raises(UnusableLLVM, match="LLVM 16"):
        llvm.require("llvm_ad_rgb")


def test07_none_at_all_is_refused_only_by_an_llvm_variant(machine):
    llvm.prepare()
    llvm.require()
    llvm.require("scalar_rgb")
    with pytest.raises(UnusableLLVM, match="No libLLVM was found"):
        llvm.require("llvm_ad_rgb")


def test08_named_by_the_user_is_never_replaced(machine, monkeypatch):
    fake(machine, "libLLVM.so.19.1", "libLLVM-15.so.1")
    for bad, said in (("libLLVM-15.so.1", "LLVM 15"), ("missing.so", "is no file")):
        monkeypatch.setenv(llvm.VARIABLE, str(machine / bad))
        monkeypatch.setattr(llvm, "has_cuda", lambda: True)
        llvm.prepare()
        assert os.environ[llvm.VARIABLE] == str(machine / bad)
        with pytest.raises(UnusableLLVM, match=said):
            llvm.require()


@pytest.mark.skipif(sys.platform != "linux", reason="the names of the files are those of Linux")
def test09_remedy_names_the_good_one_that_is_there(machine, monkeypatch):
    fake(machine, "libLLVM.so.19.1", "libLLVM-15.so.1")
    monkeypatch.setenv(llvm.VARIABLE, str(machine / "libLLVM-15.so.1"))
    assert f"unset {llvm.VARIABLE}, since LLVM 19.1" in llvm.problem()


def test10_real_old_library_is_refused_and_never_aborts():
    old = next((library for library in llvm.installed() if library.version[0] in (15, 16)), None)
    if old is None:
        pytest.skip("no libLLVM 15 or 16 on this machine")
    orders = "import nerg_mi, drjit", "import nerg_mi, mitsuba", "import drjit, nerg_mi", "import mitsuba, nerg_mi"
    for code in orders:
        run = subprocess.run(
            [sys.executable, "-c", code], env={**os.environ, llvm.VARIABLE: old.path}, capture_output=True, text=True
        )
        assert run.returncode == 1, code
        last = run.stderr.strip().splitlines()[-1]
        assert last.startswith(f"nerg_mi.errors.UnusableLLVM: LLVM {old.version[0]}"), last


def test11_loaded_version_counts(monkeypatch):
    import drjit as dr

    assert llvm.current().version == tuple(dr.detail.llvm_version())
    # What is set after Dr.Jit was loaded has no effect on it.
    monkeypatch.setenv(llvm.VARIABLE, "/nowhere/libLLVM-15.so.1")
    assert llvm.problem() is None


@pytest.mark.parametrize("late", ["drjit", "mitsuba"])
def test12_refused_when_drjit_is_imported_and_not_before(late, tmp_path):
    """What needs no kernel works without them, `nerg doctor` for one; a second import is refused like the first."""
    fake(tmp_path, "libLLVM-15.so.1")
    code = (
        "import nerg_mi.diagnosis\nprint('imported')\n"
        f"try: import {late}\nexcept ImportError as error: print(type(error).__name__)\nimport {late}"
    )
    bad = {**os.environ, llvm.VARIABLE: str(tmp_path / "libLLVM-15.so.1")}
    run = subprocess.run([sys.executable, "-c", code], env=bad, capture_output=True, text=True)
    assert run.returncode == 1 and run.stdout.split() == ["imported", "UnusableLLVM"]
    assert run.stderr.strip().splitlines()[-1].startswith("nerg_mi.errors.UnusableLLVM: LLVM 15")
