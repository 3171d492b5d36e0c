"""`nerg study`: a quick run, and what is refused."""

import csv
import json

import pytest

from nerg_mi.cli import main
from nerg_mi.evaluation.study import COLUMNS


@pytest.mark.nightly
def test_quick_run_of_the_command(tmp_path, capsys):
    with pytest.raises(SystemExit) as end:
        main("study slab --quick --width 24 --height 16 -m llvm_ad_rgb --out".split() + [str(tmp_path / "new")])
    assert not end.value.code
    said = capsys.readouterr().out
    out = tmp_path / "new"
    for name in ("study.csv", "study.md", "scaling.csv", "study.json", "errors.png", "scaling.png"):
        assert (out / name).is_file() and str(out / name) in said.replace("\n", "")
    with (out / "study.csv").open() as f:
        rows = list(csv.DictReader(f))
    assert tuple(rows[0]) == COLUMNS
    required = (
        "setting seconds density_evals color_evals gaze_evals color_rmse color_psnr depth_mae depth_p99 visibility_mae "
        "gaze_mae gaze_kld peak_mb pareto"
    )
    assert set(required.split()) <= set(COLUMNS)
    by_name = {r["setting"]: r for r in rows}
    default = by_name["default"]
    assert float(default["seconds"]) > 0 and float(default["density_evals"]) > 100 and float(default["peak_mb"]) > 0
    assert float(default["depth_mae"]) < 1e-5
    # Evaluations that are not needed are not made.
    assert float(by_name["no colour"]["color_evals"]) == 0 and by_name["no colour"]["color_rmse"] == ""
    assert float(by_name["no observer"]["density_evals"]) < 0.8 * float(default["density_evals"])
    assert any("depth" in r["pareto"] for r in rows)
    report = json.loads((out / "study.json").read_text())
    assert report["scene"] == "slab" and len(report["rows"]) == len(rows) and report["against_paper"]
    assert {r["axis"] for r in report["scaling"]} == {"pixels", "samples", "extent"}
    paper = next(p for p in report["against_paper"] if p["paper"]["setting"] == "paper, 1024 steps")
    assert paper["paper"]["depth_mae"] > 1000 * paper["default"]["depth_mae"]


@pytest.mark.parametrize(
    "arguments, said",
    [
        (["nowhere"], 'no scene file "nowhere"'),
        (["nowhere", "--scene-kind", "analytic"], "choose one of slab, sphere"),
        (["slab", "--scene-kind", "shapes"], 'no kind of scene "shapes"'),
        (["slab", "--width", "2"], "at least 4 x 4 pixels"),
        (["slab", "--only", "nothing of it"], 'no setting matches "nothing of it"'),
        (["slab", "--only", "("], '"(" is no regular expression'),
    ],
)
def test_one_sentence(tmp_path, capsys, arguments, said):
    with pytest.raises(SystemExit) as end:
        main(["study", *arguments, "--out", str(tmp_path / "new"), "-m", "llvm_ad_rgb"])
    assert end.value.code == 1
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1 and said in lines[0]
    assert not (tmp_path / "new").exists()
