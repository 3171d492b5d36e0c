"""Tests of the registry of readers, and of a format added by one object: in Python, as a job and as a command."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from nerg_mi.cli import build_app
from nerg_mi.errors import NergError
from nerg_mi.tracking.imports import import_rays
from nerg_mi.tracking.quality import check_rays
from nerg_mi.tracking.rays import Rays
from nerg_mi.tracking.readers import registry
from nerg_mi.tracking.readers.base import RaysBuilder, Signature, TickOption, TrackingFrame, option
from nerg_mi.tracking.readers.tables import iterate_table
from tests.refusals import mentions

# ---- A fictitious format as an extension would add it: a file of gaze and a file of heads ----


@dataclass(frozen=True, kw_only=True)
class MadeUpOptions(TickOption):
    heads: Path | None = option(None, "File of the heads' places.")
    scale: float = option(1.0, "What a unit of the heads' places is, in metres.")
    blinks: bool = option(False, "Keep blinks.")


class MadeUp:
    """Columns t, a, b, c of directions; x, y, z of heads, row by row."""

    name = "made_up"
    files = "directions, with the file of the heads in `--heads`"
    frame_description = "y up, right, m"
    evidence = "itself"
    signature = Signature(
        columns=(("t", "a", "b", "c", "open"),),
        options={"--heads": "HEADS"},
        question="the file of the heads (--heads)",
    )
    Options = MadeUpOptions

    def frame(self, files: Sequence[Path], options: MadeUpOptions) -> TrackingFrame:
        return TrackingFrame(up="y")

    def read(self, files: Sequence[Path], options: MadeUpOptions, builder: RaysBuilder) -> None:
        if options.heads is None:
            raise NergError("directions alone are no rays; name the file of the heads (--heads)")
        builder.begin_source(options.heads)
        heads = np.concatenate([b.numbers for b in iterate_table(options.heads, ["x", "y", "z"])])
        for path in files:
            builder.begin_source(path)
            for values, _, lines in iterate_table(path, ["t", "a", "b", "c", "open"], on_bad_line=builder.on_bad_line):
                builder.add(
                    values[:, 0] * options.tick,
                    path.stem,
                    options.scale * heads[lines - 2],
                    values[:, 1:4],
                    rows=lines,
                    drop={} if options.blinks else {"a blink": values[:, 4] == 0},
                )


def write_recording(folder: Path) -> tuple[Path, Path]:
    """Files of directions and of heads: two rows, the second of which is a blink."""
    (folder / "ann.csv").write_text("t,a,b,c,open\n0,0,0,-2,1\n500,1,0,0,0\n")
    (folder / "heads.csv").write_text("x,y,z\n100,160,-300\n200,160,0\n")
    return folder / "ann.csv", folder / "heads.csv"


# ---- Tests ----


@pytest.fixture
def made_up():
    reader = MadeUp()
    registry.register_reader(reader)
    yield reader
    registry.unregister_reader("made_up")


def test_format_is_added_by_one_object(tmp_path, made_up):
    both_eyes, heads = write_recording(tmp_path)
    settings = MadeUpOptions(heads=heads, scale=0.01, tick=1e-3)
    rays = import_rays(both_eyes, "made_up", settings)
    assert np.allclose(rays.origin, [[1, 3, 1.6]]) and np.allclose(rays.direction, [[0, 1, 0]])
    assert rays.persons == ("ann",) and check_rays(rays).summary.dropped == {"a blink": 1}
    assert rays.metadata["preset"] == "made_up" and rays.metadata["scale"] == 0.01 and rays.metadata["tick"] == 1e-3  # noqa: RUF069 (stored)
    assert "heads" not in rays.metadata and [s["file"] for s in rays.metadata["sources"]] == ["heads.csv", "ann.csv"]

    run = lambda *arguments: CliRunner().invoke(build_app(), ["rays", *(str(a) for a in arguments)])
    command = ["import", both_eyes, "-o", tmp_path / "r.npz", "--preset", "made_up", "--heads", heads, "--scale", 0.01]
    done = run(*command, "--tick", 1e-3)
    assert done.exit_code == 0, done.output
    loaded = Rays.load(tmp_path / "r.npz")
    assert np.array_equal(loaded.origin, rays.origin) and loaded.metadata == rays.metadata
    done = run(*command, "--tick", 1e-3, "--blinks")
    assert done.exit_code == 0 and len(Rays.load(tmp_path / "r.npz")) == 2
    assert "name the file of the heads (--heads)" in str(run(*command[:6]).exception)
    assert "up" in run(*command, "--up", "y").exception.parameters
    assert "made_up" in run("import", "--help").output
    shown = " ".join(run("import", "--preset", "made_up", "--help").output.split())
    assert "What a unit of the heads' places is, in metres." in shown
    assert run("guess", both_eyes).output.rstrip().endswith("--preset made_up --heads HEADS")
    assert registry.format_preset(made_up).startswith("`made_up`: directions, with the file of the heads in `--heads`.")


def test_invalid_readers_are_refused(made_up):
    @dataclass(frozen=True, kw_only=True)
    class Other:
        tick: str = option("a", "Of another type.")

    for name, options, message in (
        ("made_up", MadeUpOptions, "name is taken"),
        *((name, MadeUpOptions, "cannot be called") for name in ("", "Upper", "a-b", "1st")),
        ("other", Other, "--tick"),
    ):
        reader = MadeUp()
        reader.name, reader.Options = name, options
        with pytest.raises(ValueError, match=message):
            registry.register_reader(reader)
    assert "other" not in registry.list_reader_names()
    with pytest.raises(KeyError):
        registry.unregister_reader("other")


def test_names():
    assert registry.TABLE not in registry.list_preset_names()
    assert set(registry.list_reader_names()) == {*registry.list_preset_names(), registry.TABLE}
    with pytest.raises(NergError, match="choose one of aria"):
        registry.get_reader("etch")
    with pytest.raises(NergError, match="choose one of aria"):
        registry.read_rays("etch", "a.csv")


def test_options_of_another_reader():
    with pytest.raises(NergError, match="tick.*columns"):
        registry.make_options("varjo", {"tick": 1.0, "columns": "x"})
    with pytest.raises(NergError, check=mentions("marker")):
        registry.parse_options("table", {"marker": 0.05})
    with pytest.raises(TypeError, match="varjo takes NoOptions, not MadeUpOptions"):
        registry.read_rays("varjo", "a.csv", MadeUpOptions())
    with pytest.raises(NergError, match="no tracking files"):
        registry.read_rays("varjo", [])
    assert registry.parse_options("skeleton", {"keypoints": "1,2,3"}).keypoints == (1, 2, 3)


def test_options_of_several_readers(made_up):
    shared = {o.name: o for o in registry.collect_shared_options()}
    defaults = "z; bids: that of the dataset; c3d: the file's, or z; motive, pupil: y"
    assert shared["up"].help == f"Up axis: x, y, z, -x, -y or -z.  [default: {defaults}]"
    confidence = shared["min_confidence"].help
    assert confidence.startswith("Drop rows below this confidence.  [default: 0; ") and "pupil: 0.6" in confidence
    assert shared["marker"].help == "pupil: Edge of a tracking marker in metres."
    assert shared["keypoints"].kind is str and shared["radians"].kind is bool and shared["heads"].kind is Path
    assert shared["handedness"].flag == "--hand" and shared["columns"].flag == "--map"
    # Options of tables come first.
    assert list(shared).index("person_from") < list(shared).index("keypoints")
