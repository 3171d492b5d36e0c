"""`nerg train prior`: what it hands on."""

from pathlib import Path

import pytest

from nerg_mi.cli import main
from nerg_mi.jobs import gaze_prior
from nerg_mi.jobs.options.prior import PriorOptions


def test_the_job_is_given_what_was_asked_for(monkeypatch):
    given = []
    monkeypatch.setattr(gaze_prior, "learn_prior", lambda *a: given.append(a[:-1]))
    with pytest.raises(SystemExit) as end:
        main("train prior shop.npz museum.parquet -o prior.safetensors --most 5000 --seed 3".split())
    assert not end.value.code
    files = [Path("shop.npz"), Path("museum.parquet")]
    assert given == [(files, Path("prior.safetensors"), PriorOptions(most=5000, seed=3))]
