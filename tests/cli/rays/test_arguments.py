"""What the sub-commands print alike."""

from pathlib import Path

import numpy as np

from nerg_mi.cli.rays.arguments import print_card
from nerg_mi.rays.quality import summarise
from nerg_mi.rays.rays import Rays


def test_names_are_shown_as_they_are(capsys):
    """A person or a file may be called what the terminal's library takes for a colour."""
    eyes, ahead = np.zeros((3, 3)), np.tile([1.0, 0.0, 0.0], (3, 1))
    rays = Rays(np.arange(3.0), [0, 0, 1], ("[red]", "[/b]"), eyes, ahead, np.ones(3))
    print_card(rays, summarise(rays), Path("[bold].npz"))
    shown = capsys.readouterr().out
    assert "[bold].npz" in shown and "[red]" in shown and "[/b]" in shown
