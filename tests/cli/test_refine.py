"""`nerg refine`: the file that it writes, and what it says."""

import numpy as np
import pytest
from typer.testing import CliRunner

from nerg_mi.cli import build_app
from nerg_mi.formats.checkpoint import read_metadata
from tests.plugins.fields import radiance


def test_it_writes_and_tells(tmp_path):
    import drjit.llvm.ad as ns

    from nerg_mi.fields.occupancy import OccupancyGrid

    occupancy = OccupancyGrid(np.ones((4, 4, 4), bool), ns, 0.1)
    radiance(tmp_path / "f.safetensors", density_scale=1e-2, occupancy=occupancy)
    line = ["refine", str(tmp_path / "f.safetensors"), "-o", str(tmp_path / "g.safetensors")]
    done = CliRunner().invoke(build_app(), line, catch_exceptions=False)
    assert done.exit_code == 0 and "where it was 100.00 %" in done.output
    refined = read_metadata(tmp_path / "g.safetensors")["occupancy"]["refined"]
    assert refined["threshold"] == pytest.approx(0.01) and refined["missed"] >= 0
