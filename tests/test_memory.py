"""A lack of memory is named, also where a library cannot be loaded because of it."""

from __future__ import annotations

import subprocess
import sys

import pytest

from nerg_mi.cli.ending import USER_ERROR, exit_code
from nerg_mi.errors import NergError, import_extra
from nerg_mi.memory import require_address_space

_SCENE = """<scene version="3.0.0"><integrator type="path"/><shape type="cube"/><sensor type="perspective">
<film type="hdrfilm"><integer name="width" value="4"/><integer name="height" value="4"/></film></sensor></scene>"""
_LIMITED = "import resource, sys; resource.setrlimit(resource.RLIMIT_AS, (int(sys.argv[1]) << 20,) * 2); "

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="limits of the address space are those of Linux")


@pytest.mark.parametrize("megabytes", [90, 190, 300, 390])
def test_limited_address_space_is_named_before_libraries_fail(tmp_path, megabytes):
    (tmp_path / "a.xml").write_text(_SCENE)
    command = ["render", str(tmp_path / "a.xml"), "-o", str(tmp_path / "a.png")]
    code = _LIMITED + "from nerg_mi.cli import main; main(sys.argv[2:])"
    done = subprocess.run([sys.executable, "-c", code, str(megabytes), *command], capture_output=True, text=True)
    assert done.returncode == USER_ERROR and done.stderr.startswith("nerg: not enough memory")
    assert len(done.stderr.splitlines()) == 1 and "ulimit" in done.stderr and "shared object" not in done.stderr
    assert not (tmp_path / "a.png").exists()


def test_limit_that_suffices_for_numpy_only_is_named():
    code = _LIMITED + "from nerg_mi.cli import main; main(sys.argv[2:])"
    command = [sys.executable, "-c", code, "250", "rays", "show", "missing.npz"]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == USER_ERROR and "ulimit" in done.stderr and len(done.stderr.splitlines()) == 1


def test_limited_address_space_is_named_in_python():
    code = _LIMITED + "import nerg_mi, mitsuba"
    done = subprocess.run([sys.executable, "-c", code, "250"], capture_output=True, text=True)
    assert "NergError: not enough memory" in done.stderr.splitlines()[-1]


def test_without_a_limit_nothing_is_required():
    import resource

    if resource.getrlimit(resource.RLIMIT_AS)[0] == resource.RLIM_INFINITY:
        require_address_space(1 << 40, "a test")


@pytest.mark.parametrize(
    "error",
    [
        MemoryError("cannot hold 3 TB"),
        MemoryError(),
        ImportError("libz3.so.4: failed to map segment from shared object"),
        OSError("libx.so: cannot allocate memory in static TLS block"),
        OSError(12, "Cannot allocate memory"),
        RuntimeError("can't start new thread"),
        RuntimeError("std::bad_alloc"),
    ],
)
def test_lack_of_memory_is_an_error_of_the_user(error):
    code, text = exit_code(error)
    assert code == USER_ERROR and text.startswith("not enough memory")
    assert not any(word in text for word in ("segment", "bad_alloc", "thread", "TLS", ".so"))


def test_module_that_memory_does_not_suffice_for_is_not_missing(monkeypatch, tmp_path):
    (tmp_path / "large_module.py").write_text("raise ImportError('x.so: failed to map segment from shared object')")
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(ImportError) as error:
        import_extra("large_module", "this needs it", "extra")
    assert "pip" not in str(error.value) and exit_code(error.value)[0] == USER_ERROR
    with pytest.raises(ImportError, match="pip"):
        import_extra("missing_module", "this needs it", "extra")
    assert not isinstance(error.value, NergError)
