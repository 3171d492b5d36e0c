"""Addresses of clusters: which are protected, and what dask needs in order to speak to them."""

from __future__ import annotations

import ipaddress
import re
from types import ModuleType
from typing import Any

from nerg_mi.errors import NergError

_ADDRESS = re.compile(r"(tcp|tls)://(\[[0-9a-fA-F:]+\]|[\w.-]+):(\d{1,5})")

TLS = (
    "tls:// needs certificates: set DASK_DISTRIBUTED__COMM__TLS__CA_FILE, and __CLIENT__CERT and __CLIENT__KEY "
    "(for workers __WORKER__CERT and __WORKER__KEY) in place of __CA_FILE, or write them into dask's configuration"
)


def is_cluster(text: str) -> bool:
    """Whether ``text`` looks like the address of a cluster at all."""
    return "://" in text


def check_address(address: str) -> None:
    """Raise `NergError` unless ``address`` is one of a scheduler: tcp://HOST:PORT or tls://HOST:PORT."""
    found = _ADDRESS.fullmatch(address)
    if found is None or not 0 < int(found[3]) < 65536:
        raise NergError(f'"{address}" is no address of a scheduler; write tcp://HOST:PORT or tls://HOST:PORT')


def unprotected(address: str) -> str | None:
    """The sentence of warning about an ``address`` that neither TLS nor this machine's bounds protect; else None."""
    found = _ADDRESS.fullmatch(address)
    if found is None or found[1] == "tls" or _is_loopback(found[2].strip("[]")):
        return None
    return (
        f"nothing protects {address}: whoever reaches that port, or a worker's, can run code there and here; "
        "use tls://, or a tunnel to 127.0.0.1"
    )


def own_host(address: str) -> str:
    """The address of this machine by which the scheduler at ``address`` is reached: where a worker listens, and not
    wherever else this machine can be reached."""
    found = _ADDRESS.fullmatch(address)
    host = found[2].strip("[]") if found is not None else ""
    if _is_loopback(host):
        return "127.0.0.1" if host == "localhost" else host
    return import_distributed().utils.get_ip(host)


def _is_loopback(host: str) -> bool:
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def import_distributed() -> ModuleType:
    """The module `distributed` of dask. Raises `ImportError`, in a sentence, where it is missing."""
    try:
        import distributed
    except ImportError:
        raise ImportError('a cluster needs dask, which is not installed: pip install "nerg-mi[cluster]"') from None
    return distributed


def security_for(address: str) -> Any:
    """What dask needs for ``address``: its configured certificates for tls://, else None. Raises `NergError` where
    there are none."""
    distributed = import_distributed()
    if not address.startswith("tls://"):
        return None
    security = distributed.Security(require_encryption=True)
    if not security.tls_ca_file:
        raise NergError(TLS)
    return security
