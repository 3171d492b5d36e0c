"""The sub-commands of ``nerg rays`` on files: their options, outputs and refusals."""

import subprocess
import sys

import pytest

from nerg_mi.tracking.rays import Rays
from tests.cli.rays.running import run, write_walk


def test_imports_load_no_renderer():
    code = (
        "import sys; import nerg_mi as nerg; nerg.import_rays, nerg.filter_rays, nerg.split_rays, nerg.measure_events; "
    )
    code += "print(*{'mitsuba', 'drjit', 'scipy', 'trimesh', 'matplotlib'} & set(sys.modules))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120, check=True)
    assert done.stdout.strip() == ""


@pytest.fixture
def walk(tmp_path):
    return write_walk(tmp_path / "walk.npz")


def test_show_prints_the_quality_report(walk):
    done = run("show", walk)
    shown = " ".join(done.output.split())
    assert done.exit_code == 0 and "12,000 of 12,000 rows" in shown and "sampling rate 50 Hz" in shown


def test_options_of_a_filter(walk, tmp_path):
    conditions = ["--person", "a", "--person", "c", "--start", 10, "--end", 30, "--box=0,3,0,3,0,3"]
    done = run("filter", walk, "-o", tmp_path / "some.npz", *conditions)
    assert done.exit_code == 0, done.output
    some = Rays.load(tmp_path / "some.npz")
    assert set(some.participants) == {"a", "c"}
    assert some.t.min() >= 10 and some.t.max() < 30 and some.origin[:, 0].max() <= 3
    (step,) = some.metadata["steps"]
    assert (step["step"], step["kept"], step["of"], step["persons"]) == ("filter", len(some), 12_000, ["a", "c"])


def test_a_split_is_written_and_drawn(walk, tmp_path):
    done = run("split", walk, "-o", tmp_path / "s.npz", "--test-zones", 2, "--person", "b")
    assert done.exit_code == 0 and "wrote" in done.output, done.output
    train, test = (tmp_path / f"s-{side}.npz" for side in ("train", "test"))
    assert len(Rays.load(train)) and Rays.load(test).participants == ("b",)
    done = run("plot", train, "-o", tmp_path / "s.png", "--kind", "layout", "--test", test)
    assert done.exit_code == 0 and (tmp_path / "s.png").read_bytes().startswith(b"\x89PNG"), done.output


def test_events_and_their_quality_are_written(walk, tmp_path):
    files = tmp_path / "events.csv", tmp_path / "quality.csv"
    done = run("events", walk, "-o", files[0], "--quality", files[1])
    assert done.exit_code == 0 and all(f"wrote {file}" in done.output for file in files), done.output
    assert files[0].read_text().startswith("participant,onset") and len(files[1].read_text().splitlines()) == 5


@pytest.mark.parametrize(
    "arguments, message",
    [
        (["filter"], "no selection is given"),
        (["filter", "--start", "1e9"], "selects none"),
        (["filter", "--box", "a,b"], "comma-separated numbers"),
        (["split"], "no criterion is given"),
        (["plot", "--test", "walk.npz"], "kind"),
        (["filter", "--thin=-1"], "Invalid value for '--thin'"),
        (["events"], ".csv"),
    ],
)
def test_wrong_arguments_are_refused(walk, tmp_path, monkeypatch, arguments, message):
    monkeypatch.chdir(tmp_path)
    command, *options = arguments
    output = "x.png" if command == "plot" else "x.npz"
    done = run(command, walk, "-o", output, *options)
    assert done.exit_code != 0 and message in f"{done.exception} {' '.join(done.output.split())}"
    assert [path.name for path in tmp_path.iterdir()] == ["walk.npz"]
