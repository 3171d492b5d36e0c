"""`nerg train radiance`: what is refused before anything is read."""

import re

import pytest

from nerg_mi.cli import main
from nerg_mi.formats.checkpoint import read_checkpoint

from .test_eval import place  # noqa: F401  (fixture)


@pytest.mark.parametrize(
    "given, said",
    [
        (["--resume"], "nothing to resume"),
        (["--steps", "5", "--minutes", "1"], "exactly one|either in steps or in minutes"),
    ],
)
def test_wrong_options_are_told_in_a_sentence(given, said, tmp_path, capsys):
    with pytest.raises(SystemExit) as end:
        main(["train", "radiance", str(tmp_path), "-o", str(tmp_path / "a.safetensors"), *given])
    assert end.value.code == 1
    assert re.search(said, capsys.readouterr().err)


@pytest.mark.nightly
def test_the_machine_s_speed_and_what_is_wrong_are_told(place, capsys):  # noqa: F811
    out = place / "a.safetensors"
    with pytest.raises(SystemExit) as end:
        main(["train", "radiance", str(place), "-o", str(out), "--steps", "3", "--holdout", "3"])
    assert not end.value.code
    printed = capsys.readouterr()
    assert float(re.search(r"3 steps in \d+ s; (\S+) field evaluations a second", printed.out)[1]) > 0
    assert "warning: only 3 steps" in printed.err
    about = read_checkpoint(out, "radiance")[1]["provenance"]
    assert about["evaluations_a_second"] > 0 and about["step_ms"]["max"] >= about["step_ms"]["median"]
    assert [x for x in about["complaints"] if x.startswith("only 3 steps")]
