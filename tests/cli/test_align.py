import json

import pytest

from nerg_mi.cli import main


def test_a_file_of_pairs_becomes_an_alignment_and_a_picture(tmp_path, capsys):
    rows = "0,0,0,1,0,0\n2,0,0,5,0,0\n0,1,0,1,2,0\n0,0,1,1,0,2\n"
    (tmp_path / "p.csv").write_text("x,y,z,place_x,place_y,place_z\n" + rows)
    with pytest.raises(SystemExit) as end:
        main(["align", "--pairs", str(tmp_path / "p.csv"), "-o", str(tmp_path / "a.json")])
    said = capsys.readouterr().out
    assert not end.value.code and "4 pairs" in said and "residuals:" in said
    assert json.loads((tmp_path / "a.json").read_text())["evidence"]["kind"] == "pairs"
    assert (tmp_path / "a.png").is_file()
