"""The ablation: every variant, losses relative to the product, spreads over seeds, files."""

from __future__ import annotations

import csv
import json

import numpy as np
import pytest

from nerg_mi.evaluation.ablation import COLUMNS, all_variants, summarise, table, write_ablation

from .gaze.test_evaluation import crowd


def rows():
    out = []
    for recipe, variant, seed, loss in (
        ("default", "emit", 0, 2.0),
        ("default", "emit_capture", 0, 1.0),
        ("default", "emit_capture", 1, 1.2),
        ("paper", "emit_capture", 0, 3.0),
    ):
        out.append(
            {
                "recipe": recipe,
                "variant": variant,
                "seed": seed,
                "steps": 5,
                "train_seconds": 1.0,
                "test_loss": loss,
                "train_loss": loss,
                "test_KLD": loss,
                "test_CC": 0.5,
                "test_MAE": 0.01,
                "test_relative": loss / 1.1,
                "train_relative": loss,
            }
        )
    return out


def test_variants():
    names = [(v.recipe, v.name) for v in all_variants(True)]
    assert [n for r, n in names if r == "default"] == ["emit", "capture", "emit_capture"]
    paper = [n for r, n in names if r == "paper"]
    assert len(paper) == 9 and sum("semantic" in n for n in paper) == 4 and "begins as the field, frozen" in paper
    assert len(all_variants(False)) == 6 and len(all_variants(True, ("small",))) == 9


def test_spreads_are_over_seeds():
    emit, both, paper = summarise(rows())
    assert both["test_loss"] == pytest.approx(1.1) and both["test_loss.spread"] == pytest.approx(
        np.std([1, 1.2], ddof=1)
    )
    assert "test_loss.spread" not in emit and both["seeds"] == 2 and paper["recipe"] == "paper"
    assert "1.100 ± 0.141" in table([emit, both]) and len(table([emit, both]).splitlines()) == 4
    assert len({line.count("|") for line in table([emit, both]).splitlines()}) == 1


def test_files(tmp_path):
    files = write_ablation(tmp_path, rows(), "notes")
    assert all(f.stat().st_size > 50 for f in files)
    with open(files[1]) as f:
        assert list(csv.DictReader(f).fieldnames) == list(COLUMNS)
    assert len(json.loads(files[2].read_text())["summary"]) == 3


def test_the_plot_has_as_much_room_for_each_variant_however_many_there_are(tmp_path, monkeypatch):
    from nerg_mi.evaluation import ablation

    drawn = []
    monkeypatch.setattr(ablation, "write_figure", lambda path, figure, **options: drawn.append(figure))
    many = [dict(rows()[1], variant=f"v{k}") for k in range(9)]
    for count in (3, 6, 9):
        write_ablation(tmp_path, many[:count], "notes")
    widths, heights = np.array([f.get_size_inches() for f in drawn]).T
    assert widths[1] - widths[0] == widths[2] - widths[1] > 0 and np.ptp(heights) == 0
    # Two bars a variant, of training and of test probes, and their names below.
    (axis,) = drawn[1].axes
    assert len(axis.patches) == 12
    assert [t.get_text() for t in axis.get_xticklabels()] == [f"v{k}\n(default)" for k in range(6)]
    assert np.allclose([b.get_height() for b in axis.patches], [1.0] * 6 + [1.0 / 1.1] * 6)


@pytest.mark.slow
def test_the_command(rgb, tmp_path, capsys, monkeypatch):
    """With two variants, for the time that compiling takes; the trainers know all of them."""
    from nerg_mi.cli import main
    from nerg_mi.evaluation import ablation

    monkeypatch.setattr(
        ablation,
        "all_variants",
        lambda semantic, recipes: [v for v in all_variants(semantic, recipes) if v.gaze != "emit"],
    )
    crowd(3000).save(tmp_path / "rays.npz")
    command = [
        str(a)
        for a in (
            "ablate",
            tmp_path / "rays.npz",
            "-o",
            tmp_path / "out",
            "--geometry",
            "hits",
            "--recipes",
            "default",
            "--seeds",
            2,
            "--default-steps",
            2,
            "--zones",
            2,
            "--positions",
            6,
            "--min-rays",
            8,
            "--radius",
            0.5,
            "--cameras",
            1,
            "--size",
            "16x8",
            "--probes",
            12,
        )
    ]
    with pytest.raises(SystemExit) as end:
        main(command)
    assert not end.value.code, capsys.readouterr().err
    found = json.loads((tmp_path / "out" / "ablation.json").read_text())
    assert len(found["rows"]) == 4 and {r["seed"] for r in found["rows"]} == {0, 1}
    whole = [r["test_relative"] for r in found["rows"] if r["variant"] == "emit_capture"]
    assert np.mean(whole) == pytest.approx(1)
    assert all(r["frame_seconds"] > 0 and np.isfinite(r["test_loss"]) for r in found["rows"])
    assert (tmp_path / "out" / "default_capture_0.safetensors").exists()
    # What is there already is not trained again; what would be another training is.
    trained = []
    monkeypatch.setattr(ablation, "_train", lambda *given: trained.append(given[-1].stem) or found["rows"][0])
    other = ["--law", "tests.evaluation.test_ablation:Uniform", "--seeds", "1", "--variant", "capture"]
    for more in ([], other):
        with pytest.raises(SystemExit) as end:
            main(command + more)
        assert not end.value.code, capsys.readouterr().err
        assert trained == (["default_capture_0"] if more else [])
    for more, words in (
        (["--law", "nowhere"], "MODULE:CLASS"),
        (["--variant", "emitt"], 'emit_capture here, got "emitt"'),
    ):
        with pytest.raises(SystemExit) as end:
            main([*command, *more])
        assert end.value.code and words in " ".join(capsys.readouterr().err.split())


class Uniform:
    """A law under which people look anywhere."""

    def density(self, positions, directions):
        return np.full((len(positions), len(directions)), 1 / (4 * np.pi))
