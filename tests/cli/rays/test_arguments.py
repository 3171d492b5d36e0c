"""What the sub-commands have in common; the card is tried in test_show.py."""

import pytest

from nerg_mi.cli.rays.arguments import parse_numbers
from nerg_mi.errors import NergError


def test_numbers():
    assert parse_numbers("1,-2.5,3e2", "--box") == [1.0, -2.5, 300.0]
    for text in ("", "1,,2", "a"):
        with pytest.raises(NergError, match="--box is numbers with commas between them"):
            parse_numbers(text, "--box")
