"""Which tests belong to which module."""

from __future__ import annotations

import pytest

from tools import mirror


@pytest.mark.parametrize(
    "source, test",
    [
        ("nerg_mi/field/gaze/product.py", "tests/field/gaze/test_product.py"),
        ("nerg_mi/llvm.py", "tests/test_llvm.py"),
        ("nerg_mi/api/__init__.py", "tests/api/test_init.py"),
        ("plugins/nerg.py", "tests/plugins/test_nerg.py"),
        ("tools/mutation/sites.py", "tests/tools/mutation/test_sites.py"),
    ],
)
def test_names(source, test):
    assert mirror.test_file_of(source) == test
    assert mirror.is_test_of(test, source) and mirror.is_test_of(f"{test}::test_a", source)


def test_files_that_were_split_off_count():
    assert mirror.is_test_of("tests/plugins/test_nerg_shapes.py::test_a", "plugins/nerg.py")
    assert not mirror.is_test_of("tests/plugins/test_nerg_shapes.py", "plugins/nerf.py")
    assert not mirror.is_test_of("tests/plugins/test_nergy.py", "plugins/nerg.py")


def test_what_has_no_tests_is_found(tmp_path):
    for path in ("nerg_mi/a/b.py", "nerg_mi/a/c.py", "nerg_mi/a/__init__.py", "nerg_mi/d.py", "tests/a/test_b.py"):
        (tmp_path / path).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / path).write_text('"""Words."""\n')
    assert mirror.without_tests(("nerg_mi",), tmp_path) == ["nerg_mi/a/c.py", "nerg_mi/d.py"]
    (tmp_path / "nerg_mi/a/__init__.py").write_text("x = 1\n" * 9)
    assert "nerg_mi/a/__init__.py" in mirror.without_tests(("nerg_mi",), tmp_path)
