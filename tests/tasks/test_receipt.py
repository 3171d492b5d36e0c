"""Receipts as files."""

import json

import pytest

from nerg_mi.errors import NergError
from nerg_mi.tasks.receipt import digest_of, read_receipt, receipt_for, write_receipt
from tests.tasks import works


@pytest.fixture
def written(tmp_path):
    (tmp_path / "out.txt").write_text("abc")
    receipt = receipt_for(works.tasks(1)[0], tmp_path / "out.txt", 1.5, "a processor", {"limits": [0.1, 2.0]})
    write_receipt(tmp_path / "a.receipt.json", receipt)
    return tmp_path / "a.receipt.json", receipt


def test_they_come_back_as_they_were(written):
    path, receipt = written
    assert read_receipt(path) == receipt and receipt.size == 3 and receipt.notes == {"limits": [0.1, 2.0]}


@pytest.mark.parametrize(
    "change",
    [{"format": 9}, {"size": -1}, {"seconds": "1"}, {"sha256": "x"}, {"key": "/etc"}, {"notes": 1}, {"more": 1}],
)
def test_what_is_none_is_refused(written, change):
    path, _ = written
    path.write_text(json.dumps(json.loads(path.read_text()) | change))
    with pytest.raises(NergError, match="and its output is made anew"):
        read_receipt(path)


def test_digests_of_folders_know_names_and_bytes(tmp_path):
    def digest(**files):
        folder = tmp_path / str(len(list(tmp_path.iterdir())))
        folder.mkdir()
        for name, text in files.items():
            (folder / name).write_text(text)
        return digest_of(folder)

    assert digest(a="1", b="2") == digest(b="2", a="1")
    assert len({digest(a="1", b="2")[1], digest(a="2", b="1")[1], digest(a="12")[1], digest(c="1", b="2")[1]}) == 4
    assert digest(a="123", b="4")[0] == 4


def test_what_is_not_there_cannot_be_signed_for(tmp_path):
    with pytest.raises(NergError):
        digest_of(tmp_path / "none")
