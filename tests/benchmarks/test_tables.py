"""Tables that benchmarks print have the heads of those on the pages, as far as that is quick to find out."""

import importlib

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.conftest import ROOT
from tests.rays.readers.examples import EXAMPLES


@pytest.fixture
def benchmark(monkeypatch):
    """Imports a benchmark by its name, as it is when it is run: beside the others."""
    monkeypatch.syspath_prepend(str(ROOT / "benchmarks"))
    return importlib.import_module


def lines(text: str) -> list[str]:
    """Lines of the tables in ``text``."""
    return [line for line in text.splitlines() if line.startswith("|")]


def page(name: str) -> list[str]:
    return lines((ROOT / "docs" / name).read_text(encoding="utf-8"))


def test01_slow_and_busy_machines(benchmark):
    known = dict.fromkeys(
        ("threads", "steps", "seconds", "psnr", "warnings", "max_by_median", "evaluations_a_second"), 1
    )
    rows = [
        {"length": n, "beside": "nothing", "ms_min": 1, "ms_median": 2, "ms_max": 3} | known for n in ("2 min", "1 min")
    ]
    head, _, first, _ = lines(benchmark("radiance_robustness").printed(rows))
    assert head in page("radiance-training.md") and first.startswith("| 1 min | 1 | nothing |")


def test02_places_of_hit_points(benchmark, monkeypatch, tmp_path, capsys):
    monkeypatch.setenv("NERG_DATA", str(tmp_path))
    benchmark("hit_places").main(["--rays", "2000"])
    head, _, row = lines(capsys.readouterr().out)
    assert head in page("gaze-training.md") and row.startswith("| room of 8 x 6 x 3 m, window |")


def test03_memory_of_derivatives(benchmark, monkeypatch, capsys):
    memory = benchmark("gradients_memory")
    monkeypatch.setattr(memory, "measured", lambda samples: [str(samples), "", "", ""])
    memory.main(["--samples", "16,64"])
    head, _, *rows = lines(capsys.readouterr().out)
    assert head in page("gradients.md") and len(rows) == 2


def test04_errors_of_derivatives(benchmark, capsys):
    benchmark("gradients").main(["--case", "silhouette"])
    head, rule, *rows = lines(capsys.readouterr().out)
    assert {head, *rows} <= set(page("gradients.md")) and len(rows) == 2


def test05_rays_sizes_and_derivatives(benchmark, monkeypatch, capsys):
    numerics = benchmark("numerics")
    monkeypatch.setattr("sys.argv", ["numerics.py", "--only", "rays"])
    numerics.main()
    printed, there = lines(capsys.readouterr().out), page("numerics.md")
    cases = {line.rsplit("|", 3)[0] for line in there}
    assert len(printed) > 10 and all(line.rsplit("|", 3)[0] in cases for line in printed)


@pytest.fixture
def made(benchmark):
    """Recordings that are right, of four people who walk about for two minutes."""
    return benchmark("tracking_people").make_recording(4, 120.0)


def test06_checks_of_tracking(benchmark, monkeypatch, tmp_path, capsys, made):
    checks = benchmark("tracking_checks")
    monkeypatch.setattr(checks, "make_recording", lambda: made)
    checks.main(["--data", str(tmp_path), "--mistake", "lengths in mm"])
    head, _, row = lines(capsys.readouterr().out)
    assert head in page("tracking.md") and row.startswith("| lengths in mm taken for m |")
    assert checks.named(made) == [] and checks.named(checks.bare(made)) == []


def test07_planted_mistakes_are_named(benchmark, made):
    """Each of them, by the check that is there for it, in all of a recording or in the half of it."""
    people, checks = benchmark("tracking_people"), benchmark("tracking_checks")
    for mistake in people.MISTAKES:
        spread = people.last_rows if "rays" in mistake.of else people.last_people
        share = 1.0 if "all" in mistake.of and mistake.check != "frames" else 0.5
        found = checks.named(mistake.plant(made, spread(made, share)))
        assert mistake.check in found or (mistake.name == "ms taken for s" and "times" in found), mistake.name


def test08_alignments(benchmark):
    from tests.alignment import rooms

    alignment = benchmark("alignment")
    world = alignment.World(rooms.traces(2000), rooms.traces(2000).end, rooms.people(200))
    there = page("tracking.md")
    assert f"| {' | '.join(alignment.HEAD)} |" in there
    for kind in ("pairs", "cameras"):
        cells = alignment.cells(alignment.measure(world, kind, 2, 1))
        assert cells[2] == "2 of 2" and cells[-2] == "1 of 1"
        assert any(line.startswith(f"| {cells[0]} |") for line in there)


def test09_a_dataset_of_rays(benchmark, tmp_path, capsys):
    """Imported twice, asked, and compared with its files by other means; the folder is gone afterwards."""
    pytest.importorskip("pyarrow")
    (tmp_path / "data" / "vr_supermarket").mkdir(parents=True)
    EXAMPLES["vr_supermarket"].make(tmp_path / "data" / "vr_supermarket")
    given = ["--rays", "100", "--files", "4", "--workers", "2", "--no-train", "--data", tmp_path / "data"]
    benchmark("ray_dataset").main([*map(str, given), "--folder", str(tmp_path / "dataset")])
    printed = capsys.readouterr().out
    head, _, *rows = lines(printed)
    assert head in page("tracking.md") and len(rows) == 10 and rows[0].startswith("| import of 4 files")
    assert "| 100 |" in rows[-1] and "people, 100 rays; means" in printed and not (tmp_path / "dataset").exists()


def some_walks(device_files, count=20):
    """Two people who look about, each at a point of their own a sample."""
    rng = np.random.default_rng(0)
    for name in ("ann", "bo"):
        eye = np.c_[rng.uniform(1, 3, (count, 2)), rng.uniform(1.5, 1.7, count)]
        head = Rotation.from_euler("zx", np.c_[rng.uniform(0, 360, count), rng.uniform(-30, 30, count)], degrees=True)
        gaze = head.apply([0, 1, 0]) + rng.normal(0, 0.1, (count, 3))
        gaze /= np.linalg.norm(gaze, axis=1, keepdims=True)
        yield device_files.Walk(name, 0.2 * np.arange(count), eye, gaze, eye + 2 * gaze, head)


@pytest.mark.parametrize("name", ["aria", "quest", "neon", "arett", "qualisys", "angles"])
def test09_files_of_devices(benchmark, tmp_path, name):
    """Each device's reader gives the rays back that its files were made of."""
    pictures = benchmark("tracking_pictures")
    device = next(d for d in pictures.DEVICES if d.name == name)
    walks = list(some_walks(benchmark("device_files")))
    device.writer(walks, tmp_path)
    rays = pictures.read_files(device, tmp_path, device.files.replace("shopper-*", "[ab]*"))
    assert rays.persons == ("ann", "bo") and len(rays) >= 36
    eyes, turns = pictures.compare(rays, np.eye(4), walks)
    assert eyes == turns == "0, 0"


def test10_recordings(benchmark, recorded, capsys):
    recordings = benchmark("tracking_recordings")
    head, rows = recordings.aria_rows(recorded("aria") / "gen1" / "mps_sample")
    row = recordings.navgs_row(recorded("eyenavgs") / "truck")
    printed = set(page("tracking.md"))
    for cells in (head, *rows, row):
        assert f"| {' | '.join(cells)} |" in printed
