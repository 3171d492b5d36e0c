"""The notebooks of examples/, run from top to bottom: `python -m tools.notebooks [NAME ...]` writes their outputs.

What a run leaves behind but the outputs (times, versions, identifiers) is taken out, so that a notebook changes only
where what it shows does.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import Any

import nerg_mi  # noqa: F401  (chooses the libLLVM, so it comes before what imports Mitsuba)
from tools.imports import ROOT

EXAMPLES = ROOT / "examples"
LONGEST = 600
"""Seconds after which a cell is given up."""


def notebooks() -> list[Path]:
    return sorted(EXAMPLES.glob("*.ipynb"))


def run(path: Path, folder: Path) -> dict[str, Any]:
    """The notebook ``path`` with the outputs of a run in ``folder``. Raises what nbclient does where a cell fails."""
    import nbformat
    from jupyter_client.manager import KernelManager
    from nbclient import NotebookClient

    notebook: Any = nbformat.read(path, as_version=4)
    # Over a socket of the file system and no port; of this Python, whatever kernels are installed by that name.
    kernel: Any = KernelManager(transport="ipc", ip=str(folder / "kernel"))
    kernel.kernel_spec.argv = [sys.executable, "-m", "ipykernel_launcher", "-f", "{connection_file}"]
    resources = {"metadata": {"path": str(folder)}}
    NotebookClient(notebook, km=kernel, timeout=LONGEST, resources=resources, record_timing=False).execute()
    return clean(json.loads(nbformat.writes(notebook)))


def clean(notebook: dict[str, Any]) -> dict[str, Any]:
    """Without what differs from run to run."""
    kept = {"kernelspec": {"display_name": "Python 3", "language": "python", "name": "python3"}}
    notebook["metadata"] = {**kept, "language_info": {"name": "python"}}
    for number, cell in enumerate(notebook["cells"]):
        cell["id"], cell["metadata"] = f"cell-{number}", {}
        if cell["cell_type"] == "code":
            cell["execution_count"] = None
            for output in cell["outputs"]:
                if "execution_count" in output:
                    output["execution_count"] = None
                output.pop("transient", None)
    return notebook


def structure(notebook: dict[str, Any]) -> list[tuple[str, str, tuple[str, ...]]]:
    """Of each cell its kind, its source, and the kinds of its outputs: what has to be equal in every run."""
    found = []
    for cell in notebook["cells"]:
        kinds = (
            "+".join(sorted(output["data"])) if "data" in output else output.get("name", output["output_type"])
            for output in cell.get("outputs", ())
        )
        found.append((cell["cell_type"], "".join(cell["source"]), tuple(kinds)))
    return found


def main(arguments: list[str] | None = None) -> int:
    import tempfile

    from nerg_mi.files.atomic import write_text

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", metavar="NAME", help="of these notebooks; all by default")
    options = parser.parse_args(arguments)
    for path in notebooks():
        if options.names and path.stem not in options.names:
            continue
        with tempfile.TemporaryDirectory() as folder:
            text = json.dumps(run(path, Path(folder)), indent=1, ensure_ascii=False) + "\n"
        write_text(path, text)
        print(f"wrote {path} ({len(text) / 1e3:.0f} kB)")
    return 0


if __name__ == "__main__":
    sys.exit(main())
