"""Notebooks run from top to bottom, and their cells give the kinds of output that are stored."""

from __future__ import annotations

import sys

import pytest

from tests.conftest import ROOT


def outputs(book) -> list[list[str]]:
    """The kinds of output of each cell."""
    return [
        ["+".join(sorted(o["data"])) if "data" in o else o.get("name", o.output_type) for o in cell.get("outputs", ())]
        for cell in book.cells
    ]


@pytest.mark.nightly
@pytest.mark.parametrize("path", sorted((ROOT / "examples").glob("*.ipynb")), ids=lambda p: p.stem)
def test_it_runs_and_gives_what_is_stored(path, tmp_path):
    nbformat = pytest.importorskip("nbformat", reason="nbclient, of the extra test, is not installed")
    pytest.importorskip("ipykernel", reason="ipykernel, of the extra test, is not installed")
    from jupyter_client.manager import KernelManager
    from nbclient import NotebookClient

    book = nbformat.read(path, as_version=4)
    stored = outputs(book)
    # Over a socket of the file system and no port; of this Python, whatever kernels are installed by that name.
    kernel = KernelManager(transport="ipc", ip=str(tmp_path / "kernel"))
    kernel.kernel_spec.argv = [sys.executable, "-m", "ipykernel_launcher", "-f", "{connection_file}"]
    NotebookClient(book, km=kernel, timeout=600, resources={"metadata": {"path": str(tmp_path)}}).execute()
    assert outputs(book) == stored and any("image/png" in kind for cell in stored for kind in cell)
