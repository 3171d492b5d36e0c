"""`--allow-outside`: files beyond a data set's folder are read only where it is given."""

import re

import pytest

from nerg_mi.cli import main

from .test_eval import place  # noqa: F401  (fixture)

# The command, and what it says once the photos may be read: of the gaze, that photos of one grey have no salience.
COMMANDS = {
    "train radiance": (["train", "radiance", "{set}", "-o", "{out}", "--steps", "2", "--holdout", "3"], r"2 steps in"),
    "eval radiance": (["eval", "radiance", "{cube}", "{set}", "--holdout", "2", "-o", "{out}"], r"PSNR"),
    "train gaze": (
        ["train", "gaze", "-o", "{out}", "--views", "{set}", "--salience", "spectral-residual", "--field", "{cube}"],
        "no salience",
    ),
}


@pytest.mark.parametrize("name", COMMANDS)
def test_photos_beyond_the_folder_are_read_only_if_allowed(name, place, capsys):  # noqa: F811
    (place / "set").mkdir()
    text = (place / "transforms.json").read_text()
    (place / "set" / "transforms.json").write_text(re.sub(r'"(\d.png)"', r'"../\1"', text))
    command, said = COMMANDS[name]
    values = {"set": place / "set", "cube": place / "cube.safetensors", "out": place / "out.safetensors"}
    command = [word.format(**values) for word in command]
    with pytest.raises(SystemExit) as end:
        main(command)
    printed = capsys.readouterr()
    assert end.value.code == 1 and "--allow-outside" in printed.err and not re.search(said, printed.out + printed.err)
    with pytest.raises(SystemExit):
        main([*command, "--allow-outside"])
    printed = capsys.readouterr()
    assert re.search(said, printed.out + printed.err) and "outside of" not in printed.out + printed.err
