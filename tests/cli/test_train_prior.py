"""`nerg train prior`: what it hands on."""

from pathlib import Path

import pytest

from nerg_mi.cli import main
from nerg_mi.workflows import train_prior  # noqa: F401 (declares the command)
from nerg_mi.workflows.train_prior import PriorOptions

from .handed import keep_handed


def test_the_job_is_given_what_was_asked_for(monkeypatch):
    given = keep_handed(monkeypatch, "train prior")
    with pytest.raises(SystemExit) as end:
        main("train prior shop.npz museum.parquet -o prior.safetensors --most 5000 --seed 3".split())
    assert not end.value.code
    files = [Path("shop.npz"), Path("museum.parquet")]
    options = PriorOptions(most=5000, seed=3)
    assert given == [{"rays": files, "output": Path("prior.safetensors"), "options": options}]
