"""Addresses of clusters, and which of them are protected."""

import sys

import pytest

from nerg_mi.errors import NergError
from nerg_mi.tasks.addresses import check_address, import_distributed, is_cluster, own_host, security_for, unprotected


@pytest.mark.parametrize("host", ["127.0.0.1", "127.9.9.9", "localhost", "[::1]"])
def test_this_machine_is_silent(host):
    check_address(f"tcp://{host}:8786")
    assert unprotected(f"tcp://{host}:8786") is None


def test_tls_is_silent_and_all_else_is_told_in_a_sentence():
    assert unprotected("tls://192.0.2.1:8786") is None
    for host in ("192.0.2.1", "cluster.example", "[2001:db8::1]", "0.0.0.0"):
        said = unprotected(f"tcp://{host}:8786")
        assert said is not None and said.startswith(f"nothing protects tcp://{host}:8786: whoever reaches that port")


def test_workers_listen_where_their_scheduler_reaches_them():
    assert own_host("tcp://localhost:1") == own_host("tcp://127.0.0.1:1") == "127.0.0.1"
    assert own_host("tcp://[::1]:1") == "::1"


def test_names_of_clusters():
    assert is_cluster("tcp://a:1") and not is_cluster("local:2")


def test_tls_needs_certificates():
    distributed = pytest.importorskip("distributed", reason="dask is not installed (extra cluster)")
    import dask

    assert security_for("tcp://a:1") is None
    with pytest.raises(NergError, match="tls:// needs certificates: set DASK_DISTRIBUTED__COMM__TLS__CA_FILE"):
        security_for("tls://a:1")
    with dask.config.set({"distributed.comm.tls.ca-file": "ca.pem"}):
        found = security_for("tls://a:1")
    assert isinstance(found, distributed.Security) and found.require_encryption and found.tls_ca_file == "ca.pem"


def test_without_dask_a_sentence_says_how_to_get_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(ImportError, match=r'pip install "nerg-mi\[cluster\]"'):
        import_distributed()
