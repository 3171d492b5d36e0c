"""Files of torch.save: exact round trips, no code execution, and memory limited by the file size."""

import io
import os
import pickle
import struct
import subprocess
import sys
import zipfile

import numpy as np
import pytest

from nerg_mi.errors import NergError
from nerg_mi.formats import torch_files as module
from nerg_mi.formats.torch_files import read_torch, to_numpy, write_torch

ONE = np.arange(4, dtype="<f4").tobytes()


def archive(path, pickled: bytes, compression=zipfile.ZIP_STORED, **records):
    with zipfile.ZipFile(path, "w", compression) as z:
        z.writestr("a/data.pkl", pickled)
        z.writestr("a/version", b"3\n")
        for key, value in records.items():
            z.writestr(f"a/data/{key}" if key.isdigit() else f"a/{key}", value)
    return path


def tensor(shape, stride, offset=0, state=b"", stored=4):
    """A pickle of one tensor on a storage of 4 floats, with a state that is set afterwards."""
    storage = lambda value: b"\x8a\x08" + struct.pack("<q", value)
    numbers = lambda values: b"(" + b"".join(map(storage, values)) + b"t"
    out = b"\x80\x02ctorch._utils\n_rebuild_tensor_v2\n((X\x07\x00\x00\x00storagectorch\nFloatStorage\n"
    out += b"X\x01\x00\x00\x000X\x03\x00\x00\x00cpu" + storage(stored) + b"tQ"
    return (
        out + storage(offset) + numbers(shape) + numbers(stride) + b"\x89ccollections\nOrderedDict\n)RtR" + state + b"."
    )


class Calls:
    """Pickled as a call of ``function``."""

    def __init__(self, function, *arguments):
        self.call = function, arguments

    def __reduce__(self):
        return self.call


def test_files_of_torch_are_read(tmp_path, torch):
    x, path = torch.arange(24.0).reshape(2, 3, 4), tmp_path / "x.pth"
    values = {
        "plain": x,
        "strided": x.permute(2, 0, 1)[1:, :, ::2],
        "half": x.half(),
        "bf": x.bfloat16(),
        "long": x.long(),
        "bool": x > 3,
        "empty": torch.zeros(0, 4),
        "scalar": torch.tensor(2.5),
        "parameter": torch.nn.Parameter(x),
        "number": np.float64(0.1),
        "truth": np.bool_(True),
        "size": x.shape,
        "none": None,
        "list": [1, 2.5, "a", True, 2**40],
    }
    torch.save(values, path)
    got = read_torch(path)
    for name, value in values.items():
        if isinstance(value, torch.Tensor):
            expected = value.detach().float().numpy() if name == "bf" else value.detach().numpy()
            loaded = to_numpy(got[name], path)
            assert np.array_equal(loaded, expected) and loaded.dtype == expected.dtype, name
        else:
            assert got[name] == value, name


def test_torch_reads_written_files(tmp_path, torch):
    values = {
        "a": np.arange(6, dtype=np.float32).reshape(2, 3).T,
        "b": {"c": np.arange(5, dtype=np.uint8), "n": -3, "big": 2**40},
        "s": ["x", None, True, 0.1, (), "é"],
        "h": np.ones(3, np.float16),
        "i": np.zeros((4, 0), np.int32),
    }
    write_torch(tmp_path / "w.pth", values)
    got = torch.load(tmp_path / "w.pth", weights_only=True)
    assert got["b"]["n"] == -3 and got["b"]["big"] == 2**40 and got["s"] == values["s"]
    for a, b in [(got[k], values[k]) for k in "ahi"] + [(got["b"]["c"], values["b"]["c"])]:
        assert np.array_equal(a.numpy(), b) and a.numpy().dtype == b.dtype
    first = (tmp_path / "w.pth").read_bytes()
    write_torch(tmp_path / "w.pth", values)
    assert (tmp_path / "w.pth").read_bytes() == first
    with pytest.raises(AttributeError):  # functions cannot be pickled
        write_torch(tmp_path / "x.pth", {"a": lambda: 0})
    assert not (tmp_path / "x.pth").exists()


def test_without_torch_the_extra_is_named(tmp_path):
    archive(tmp_path / "x.pth", b"N.")
    line = "import sys; sys.modules['torch'] = None; from nerg_mi.formats.torch_files import *; "
    for call in (f"read_torch({str(tmp_path / 'x.pth')!r})", f"write_torch({str(tmp_path / 'y.pth')!r}, {{}})"):
        done = subprocess.run([sys.executable, "-c", line + call], capture_output=True, text=True)
        assert done.stderr.endswith('which is not installed: pip install "nerg-mi[torch]"\n')


def test_vulnerable_torch_version_is_refused(tmp_path, torch, monkeypatch):
    path = archive(tmp_path / "x.pth", b"\x80\x02N.")
    for version, is_used in (("2.10.1+cpu", False), ("2.11.0", True), ("2.13.0a0+git1", True)):
        monkeypatch.setattr(torch, "__version__", version)
        if is_used:
            assert read_torch(path) is None
        else:
            with pytest.raises(ImportError, match="2.11.*2.10.1"):
                read_torch(path)


@pytest.mark.parametrize(
    "target, name",
    [
        (Calls(exec, "import sys; sys.pwned = True"), "exec"),
        (Calls(getattr, "x", "upper"), "getattr"),
        (Calls(io.open, "/etc/passwd"), "open"),
        (Calls(os.system, "true"), "system"),
        (np.zeros(3), "_reconstruct"),
        # Names that torch itself would accept.
        (bytearray(3), "bytearray"),
        ({1, 2}, "set"),
        (Calls(complex, 1), "complex"),
    ],
)
def test_other_callables_are_refused(tmp_path, torch, target, name):
    path = archive(tmp_path / "evil.pth", pickle.dumps({"model": target}, 2))
    with pytest.raises(NergError, match=f'evil.pth" .* uses ".*{name}"'):
        read_torch(path)
    with pytest.raises(NergError, match="evil.pth"):
        read_torch(archive(tmp_path / "evil.pth", pickle.dumps({"model": target}, 4)))
    assert not hasattr(sys, "pwned")


def test_huge_array_is_not_allocated(tmp_path, torch):
    for call in (b"cbuiltins\nbytearray\n", b"c__builtin__\nbytearray\n"):
        with pytest.raises(NergError, match="bytearray"):
            read_torch(archive(tmp_path / "b.pth", b"\x80\x02" + call + b"\x8a\x06" + b"\x7f" * 6 + b"\x85R."))


# Fifty nested tuples of two identical elements have 2^50 leaves to hash.
_DOUBLED = b"K\x01q\x00" + b"".join(b"h%ch%c\x86q%c" % (k, k, k + 1) for k in range(50))
_LONG = b"X" + (1 << 20).to_bytes(4, "little") + b"x" * (1 << 20) + b"q\x00"
_NUMBERS = b"](" + b"K\x01" * 100_000 + b"eq\x00"


@pytest.mark.parametrize(
    "pickled, words",
    [
        (b"}" + _DOUBLED + b"Ns.", "repeats"),
        (b"}(" + _DOUBLED + b"Nu.", "repeats"),
        (b"]q\x00" + b"h\x00a" * 60 + b"ctorch\nSize\nh\x00\x85R.", "repeats"),
        (_NUMBERS + b"ctorch\nSize\nq\x01" + b"h\x01h\x00\x85R" * 1000 + b".", "repeats"),
        (_LONG + b"c_codecs\nencode\nq\x01" + b"h\x01h\x00\x85R" * 1000 + b".", "encoded text"),
        (_LONG + b"c_codecs\nencode\nh\x00X\x08\x00\x00\x00punycode\x86R.", "encoded text"),
        (b"N" * 200_001 + b".", "operations"),
        (b"h\x07.", ""),
        (b"t.", ""),
        (b"(i\nos\nsystem\n.", ""),
        (b"\x96\xff\xff\xff\xff\xff\xff\xff\x7f.", ""),
        (b"\x82\x01.", ""),
        (b"X\xff\xff\xff\x7f.", ""),
        (b"(t)R.", ""),
        (b"}", ""),
        (b"N", ""),
        (b".", ""),
        (b"", ""),
    ],
)
def test_invalid_pickles_are_refused(tmp_path, torch, monkeypatch, pickled, words):
    monkeypatch.setattr(module, "MAX_OPERATIONS", 200_000)
    with pytest.raises(NergError, match=f"p.pth.*{words}") as error:
        read_torch(archive(tmp_path / "p.pth", b"\x80\x02" + pickled))
    assert str(error.value).isprintable()


def test_huge_memo_index_allocates_nothing(tmp_path, torch):
    for put in (b"r\xff\xff\xff\xff", b"r\xff\xff\xff\x7f"):
        assert read_torch(archive(tmp_path / "m.pth", b"\x80\x02K\x01" + put + b".")) == 1


def test_large_valid_pickle_is_accepted(tmp_path, torch):
    """Records of 100,000 steps as NumPy numbers, a shared list, and a list that contains itself."""
    torch.save(
        {"loss": [np.float64(0.5)] * 20_000 + [0.25] * 80_000, "shared": [betas := (0.9, 0.99)] * 1000},
        tmp_path / "x.pth",
    )
    got = read_torch(tmp_path / "x.pth")
    assert sum(got["loss"]) == 30_000 and got["shared"][999] == betas
    looped: list = []
    looped.append(looped)
    torch.save(looped, tmp_path / "x.pth")
    assert read_torch(tmp_path / "x.pth")[0][0] is not None


def test_stand_ins_are_immutable(tmp_path, torch):
    path = archive(tmp_path / "t.pth", tensor((2, 2), (2, 1)), **{"0": ONE})
    assert np.array_equal(to_numpy(read_torch(path), path), [[0, 1], [2, 3]])
    onto_function = b"\x80\x02ctorch._utils\n_rebuild_tensor_v2\n}X\x01\x00\x00\x00aX\x01\x00\x00\x00xsb."
    onto_tensor = tensor((2, 2), (2, 1), 0, b"}X\x07\x00\x00\x00_strideX\x01\x00\x00\x00xsb")
    for pickled in (onto_function, onto_tensor):
        with pytest.raises(NergError, match="b.pth"):
            read_torch(archive(tmp_path / "b.pth", pickled, **{"0": ONE}))


@pytest.mark.parametrize(
    "shape, stride, offset, stored",
    [
        ((5,), (1,), 0, 4),
        ((4,), (1,), 1, 4),
        ((2, 2), (3, 1), 0, 4),
        ((2,), (1,), -1, 4),
        ((2,), (-1,), 1, 4),
        ((2,), (10**12,), 0, 4),
        ((2, 2), (1,), 0, 4),
        ((-1,), (1,), 0, 4),
        ((1 << 20,), (1,), 0, 1 << 20),
        ((4,), (1,), 0, -4),
        ((10**9,), (0,), 0, 4),
        ((10**5, 10**5), (0, 0), 0, 4),
        ((1 << 21,), (0,), 0, 4),
    ],
)
def test_tensors_do_not_reach_beyond_their_storage(tmp_path, torch, shape, stride, offset, stored):
    path = archive(tmp_path / "t.pth", tensor(shape, stride, offset, b"", stored), **{"0": ONE})
    with pytest.raises(NergError, match="t.pth"):
        to_numpy(read_torch(path), path)


def test_repeated_numbers_are_read(tmp_path, torch):
    for shape, stride, expected in (((3, 2), (0, 1), [[0, 1]] * 3), ((1, 2), (2**40, 1), [[0, 1]])):
        path = archive(tmp_path / "s.pth", tensor(shape, stride), **{"0": ONE})
        assert np.array_equal(to_numpy(read_torch(path), path), expected)


def test_damaged_archives(tmp_path, torch):
    with pytest.raises(FileNotFoundError, match="does not exist"):
        read_torch(tmp_path / "none.pth")
    for data in (b"not a zip", b"", b"PK\3\4 and no more", pickle.dumps({"a": 1})):
        (tmp_path / "x.pth").write_bytes(data)
        with pytest.raises(NergError, match="not a zip archive"):
            read_torch(tmp_path / "x.pth")
    for names in (["readme"], ["a/data.pkl", "b/data.pkl"], ["a/data.pkl", "a/DATA.pkl"]):
        with zipfile.ZipFile(tmp_path / "z.pth", "w") as z:
            for name in names:
                z.writestr(name, "x")
        with pytest.raises(NergError, match=r"z.pth.*data\.pkl"):
            read_torch(tmp_path / "z.pth")
    for missing in (tensor((2,), (1,)), b"\x80\x02ctorch._utils\n_rebuild_parameter\nN\x85R."):
        with pytest.raises(NergError, match="d.pth"):
            read_torch(archive(tmp_path / "d.pth", missing))
    path = archive(tmp_path / "c.pth", tensor((4,), (1,)), **{"0": ONE})
    path.write_bytes(path.read_bytes().replace(ONE, ONE[:-1] + b"A"))
    with pytest.raises(NergError, match="c.pth.*a/data/0"):
        read_torch(path)


def test_archives_that_inflate_are_refused(tmp_path, torch):
    pickled = tensor((2,), (1,))
    with pytest.raises(NergError, match="z.pth.*compressed"):
        read_torch(archive(tmp_path / "z.pth", pickled, zipfile.ZIP_DEFLATED, **{"0": bytes(30 << 20)}))
    with pytest.raises(NergError, match="z.pth"):
        read_torch(archive(tmp_path / "z.pth", pickled, **{"constants.pkl": b"."}))


def test_pickle_size_is_limited(tmp_path, torch, monkeypatch):
    path = archive(tmp_path / "t.pth", b"\x80\x02N.")
    monkeypatch.setattr(module, "MAX_PICKLE_BYTES", 4)
    assert read_torch(path) is None
    monkeypatch.setattr(module, "MAX_PICKLE_BYTES", 3)
    with pytest.raises(NergError, match=r"t.pth.*4 bytes.*the limit is 3"):
        read_torch(path)


def test_big_endian_is_converted(tmp_path, torch):
    big = np.arange(4, dtype=">f4").tobytes()
    path = archive(tmp_path / "b.pth", tensor((4,), (1,)), **{"0": big, "byteorder": b"big"})
    assert np.array_equal(to_numpy(read_torch(path), path), np.arange(4))
