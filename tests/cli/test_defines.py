"""-D KEY=VALUE."""

import pytest

from nerg_mi.cli.defines import parse_defines
from nerg_mi.errors import NergError


def test_pairs():
    assert parse_defines(["spp=4", "name=a=b", "empty="]) == {"spp": "4", "name": "a=b", "empty": ""}
    assert parse_defines(None) == {}


@pytest.mark.parametrize("pair", ["level", "=3", ""])
def test_what_is_no_pair(pair):
    with pytest.raises(NergError, match="write -D key=value"):
        parse_defines([pair])
