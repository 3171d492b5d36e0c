"""Archives of torch.save: tensors within their storage, records that are there, and no more than the file warrants."""

import zipfile

import numpy as np
import pytest

from nerg_mi.errors import NergError
from nerg_mi.files import safe_read
from nerg_mi.formats.torch_ngp.archive import TorchArchive
from nerg_mi.formats.torch_ngp.unpickling import read_torch
from tests.formats.torch_ngp.test_unpickling import archive, tensor

ONE = np.arange(4, dtype="<f4").tobytes()


@pytest.mark.parametrize(
    "shape, stride, offset",
    [
        ((5,), (1,), 0),
        ((4,), (1,), 1),
        ((2, 2), (3, 1), 0),
        ((2,), (1,), -1),
        ((2,), (-1,), 1),
        ((2,), (10**12,), 0),
        ((2, 2), (1,), 0),
        ((-1,), (1,), 0),
    ],
)
def test_tensors_do_not_reach_beyond_their_storage(tmp_path, shape, stride, offset):
    path = archive(tmp_path / "t.pth", tensor(shape, stride, offset), **{"0": np.arange(4, dtype="<f4").tobytes()})
    with pytest.raises(ValueError):
        read_torch(path).numpy()


def test_damaged_archives(tmp_path):
    with pytest.raises(FileNotFoundError, match="no file"):
        read_torch(tmp_path / "none.pth")
    with zipfile.ZipFile(tmp_path / "z.pth", "w") as z:
        z.writestr("readme", "x")
    with pytest.raises(ValueError, match="no data.pkl"):
        read_torch(tmp_path / "z.pth")
    for broken in (b"", b"\x80\x02}", b"\x80\x02(t)R.", b"garbage"):
        with pytest.raises(ValueError, match="damaged|not read"):
            read_torch(archive(tmp_path / "d.pth", broken))
    with pytest.raises(ValueError, match='lacks its record "data/0"'):
        read_torch(archive(tmp_path / "d.pth", tensor((2,), (1,)))).numpy()


@pytest.mark.parametrize(
    "shape, stride", [((10**9,), (0,)), ((10**5, 10**5), (0, 0)), ((1 << 21,), (0,)), ((1,) * 40, (0,) * 40)]
)
def test_repeated_numbers_are_bounded(tmp_path, shape, stride):
    with pytest.raises(NergError, match="t.pth"):
        read_torch(archive(tmp_path / "t.pth", tensor(shape, stride), **{"0": ONE})).numpy()
    assert np.array_equal(
        read_torch(archive(tmp_path / "s.pth", tensor((3, 2), (0, 1)), **{"0": ONE})).numpy(), [[0, 1]] * 3
    )
    far = tensor((1, 2), (2**61, 1))
    assert np.array_equal(read_torch(archive(tmp_path / "s.pth", far, **{"0": ONE})).numpy(), [[0, 1]])


def test_archives_that_inflate_are_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(safe_read, "FREE", 1 << 20)
    with zipfile.ZipFile(tmp_path / "z.pth", "w", zipfile.ZIP_DEFLATED) as z:
        z.writestr("a/data.pkl", tensor((2,), (1,)))
        z.writestr("a/data/0", bytes(30 << 20))
    with pytest.raises(NergError, match="z.pth.*inflates"):
        read_torch(tmp_path / "z.pth")


def test_a_record_has_a_largest_size(tmp_path):
    found = TorchArchive(archive(tmp_path / "t.pth", b"N.", **{"0": ONE}))
    assert found.record("data/0") == ONE and found.record("data/0", 16) == ONE
    with pytest.raises(NergError, match='record "data/0" of ".*t.pth" has 16 bytes, more than the 15 that are read'):
        found.record("data/0", 15)


def test_bytes_in_the_other_order_are_refused(tmp_path):
    with zipfile.ZipFile(tmp_path / "b.pth", "w") as z:
        z.writestr("a/data.pkl", b"N.")
        z.writestr("a/byteorder", b"big")
    with pytest.raises(NergError, match="big-endian"):
        TorchArchive(tmp_path / "b.pth")
