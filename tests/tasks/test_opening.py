"""Schedulers by their names."""

import pytest

from nerg_mi.errors import NergError
from nerg_mi.tasks.local import Local
from nerg_mi.tasks.opening import open_scheduler
from nerg_mi.tasks.processes import Processes


def test_names():
    assert isinstance(open_scheduler(None), Local) and isinstance(open_scheduler("local"), Local)
    found = open_scheduler("local:3")
    assert isinstance(found, Processes) and found.count == 3
    assert open_scheduler("local:3", 5).threads == 5 and open_scheduler("local:1000").threads == 1
    pytest.importorskip("distributed", reason="dask is not installed (extra cluster)")
    assert open_scheduler("tcp://127.0.0.1:1", 5).threads == 5


@pytest.mark.parametrize("name", ["", "dask", "local:", "local:x", "localhost:8786"])
def test_others_are_told(name):
    with pytest.raises(NergError, match="there is no scheduler"):
        open_scheduler(name)


@pytest.mark.parametrize("name", ["http://a:1", "tcp://a", "tcp://a:0", "tcp://a:99999", "tcp://a b:1"])
def test_addresses_are_looked_at(name):
    with pytest.raises(NergError, match=r"write tcp://HOST:PORT or tls://HOST:PORT"):
        open_scheduler(name)
