"""`nerg train radiance`: what is refused before anything is read."""
import pytest

from nerg_mi.cli import main


@pytest.mark.parametrize("given, said", [
    (["--resume"], "nothing to resume"),
    (["--steps", "5", "--minutes", "1"], "exactly one|either in steps or in minutes"),
    (["--distortion-weight", "-1"], "0 or more"),
])
def test_wrong_options_are_told_in_a_sentence(given, said, tmp_path, capsys):
    import re

    with pytest.raises(SystemExit) as end:
        main(["train", "radiance", str(tmp_path), "-o", str(tmp_path / "a.safetensors"), *given])
    assert end.value.code == 1
    assert re.search(said, capsys.readouterr().err)
