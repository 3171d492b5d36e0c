"""What torch.save wrote, read without torch: exact, and unable to run anything."""

import io
import pickle
import sys
import zipfile

import numpy as np
import pytest

from nerg_mi.errors import NergError
from nerg_mi.formats.torch_ngp.pickling import write_torch
from nerg_mi.formats.torch_ngp.unpickling import StoredTensor, read_torch


def archive(path, pickled: bytes, **records):
    with zipfile.ZipFile(path, "w") as z:
        z.writestr("a/data.pkl", pickled)
        for key, value in records.items():
            z.writestr(f"a/data/{key}", value)
    return path


class Calls:
    """Pickles as a call of ``function``."""

    def __init__(self, function, *arguments):
        self.call = function, arguments

    def __reduce__(self):
        return self.call


def test01_what_torch_writes(tmp_path, torch):
    x = torch.arange(24.0).reshape(2, 3, 4)
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
        "size": x.shape,
        "none": None,
        "list": [1, 2.5, "a", True, 2**40],
    }
    torch.save(values, tmp_path / "x.pth")
    got = read_torch(tmp_path / "x.pth")
    for name, value in values.items():
        if isinstance(value, torch.Tensor):
            expected = value.detach().float().numpy() if name == "bf" else value.detach().numpy()
            assert np.array_equal(got[name].numpy(), expected) and got[name].shape == tuple(value.shape), name
        else:
            assert got[name] == value, name


def test02_what_torch_reads(tmp_path, torch):
    values = {
        "a": np.arange(6, dtype=np.float32).reshape(2, 3),
        "b": {"c": np.arange(5, dtype=np.uint8), "n": -3, "big": 2**40},
        "s": ["x", None, True, 0.1, ()],
        "h": np.ones(3, np.float16),
        "i": np.zeros((4, 0), np.int32),
    }
    write_torch(tmp_path / "w.pth", values)
    got = torch.load(tmp_path / "w.pth", weights_only=True)
    assert got["b"]["n"] == -3 and got["b"]["big"] == 2**40 and got["s"] == values["s"]
    for a, b in (
        (got["a"], values["a"]),
        (got["b"]["c"], values["b"]["c"]),
        (got["h"], values["h"]),
        (got["i"], values["i"]),
    ):
        assert np.array_equal(a.numpy(), b) and a.numpy().dtype == b.dtype


@pytest.mark.parametrize(
    "thing, name",
    [
        (Calls(exec, "import sys; sys.pwned = True"), "exec"),
        (Calls(eval, "1"), "eval"),
        (Calls(getattr, "x", "upper"), "getattr"),
        (Calls(io.open, "/etc/passwd"), "open"),
        (Calls(__import__, "os"), "__import__"),
        (np.zeros(3), "_reconstruct"),
    ],
)
def test03_nothing_else_is_called(tmp_path, thing, name):
    for protocol in (2, 4):
        path = archive(tmp_path / "evil.pth", pickle.dumps({"model": thing}, protocol))
        with pytest.raises(ValueError, match=f'asks for ".*{name}"'):
            read_torch(path)
    assert not hasattr(sys, "pwned")


def tensor(shape, stride, offset=0, state=b""):
    """A pickle of one tensor on a storage of 4 floats, and of a state set on it afterwards."""
    out = b"\x80\x02ctorch._utils\n_rebuild_tensor_v2\n((X\x07\x00\x00\x00storagectorch\nFloatStorage\n"
    out += b"X\x01\x00\x00\x000X\x03\x00\x00\x00cpuK\x04tQ"
    numbers = lambda values: b"(" + b"".join(f"I{v}\n".encode() for v in values) + b"t"
    return out + f"I{offset}\n".encode() + numbers(shape) + numbers(stride) + b"\x89NtR" + state + b"."


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
def test04_tensors_do_not_reach_beyond_their_storage(tmp_path, shape, stride, offset):
    path = archive(tmp_path / "t.pth", tensor(shape, stride, offset), **{"0": np.arange(4, dtype="<f4").tobytes()})
    with pytest.raises(ValueError):
        read_torch(path).numpy()


def test05_what_is_made_cannot_be_changed(tmp_path):
    good = archive(tmp_path / "t.pth", tensor((2, 2), (2, 1)), **{"0": np.arange(4, dtype="<f4").tobytes()})
    got = read_torch(good)
    assert isinstance(got, StoredTensor) and np.array_equal(got.numpy(), [[0, 1], [2, 3]])
    state = b"}X\x07\x00\x00\x00_strideX\x01\x00\x00\x00xsb"
    with pytest.raises(ValueError, match="changes an object"):
        read_torch(archive(tmp_path / "b.pth", tensor((2, 2), (2, 1), 0, state)))
    onto_function = b"\x80\x02ctorch._utils\n_rebuild_tensor_v2\n}X\x01\x00\x00\x00aX\x01\x00\x00\x00xsb."
    with pytest.raises(ValueError, match="changes an object"):
        read_torch(archive(tmp_path / "b.pth", onto_function))


@pytest.mark.parametrize("data, words", [(b"not a zip", "not a zip archive"), (b"", "not a zip archive")])
def test06_other_files(tmp_path, data, words):
    (tmp_path / "x.pth").write_bytes(data)
    with pytest.raises(ValueError, match=words):
        read_torch(tmp_path / "x.pth")


def test07_damaged_archives(tmp_path):
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


ONE = np.arange(4, dtype="<f4").tobytes()


def test_a_huge_memo_index_makes_no_room(tmp_path):
    for put in (b"r\xff\xff\xff\xff", b"r\xff\xff\xff\x7f"):
        assert read_torch(archive(tmp_path / "m.pth", b"\x80\x02K\x01" + put + b".")) == 1


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


def test_keys_that_share_their_parts_are_not_hashed(tmp_path):
    """A tuple of two that are one, fifty times over, has 2^50 leaves to hash."""
    with pytest.raises(NergError, match="key"):
        read_torch(archive(tmp_path / "k.pth", b"\x80\x02}K\x01" + b"2\x86" * 50 + b"Ns."))


def test_texts_are_not_copied_over_and_over(tmp_path):
    text = b"X" + (1 << 20).to_bytes(4, "little") + b"x" * (1 << 20) + b"q\x00"
    again = b"c_codecs\nencode\nq\x01" + b"h\x01h\x00\x85R" * 1000
    with pytest.raises(NergError, match="encoded text"):
        read_torch(archive(tmp_path / "e.pth", b"\x80\x02" + text + again + b"."))


@pytest.mark.parametrize(
    "pickled, words",
    [
        (b"\x80\x02" + b"N" * 1_000_001 + b".", "operations"),
        (b"\x80\x02h\x07.", "recalls"),
        (b"\x80\x02t.", ""),
        (b"\x80\x02(i\nos\nsystem\n.", ""),
        (b"\x80\x04\x96\xff\xff\xff\xff\xff\xff\xff\x7f.", ""),
        (b"\x80\x02\x82\x01.", "EXT1"),
        (b"\x80\x02X\xff\xff\xff\x7f.", ""),
        (b"\x80\x02N", ""),
        (b"\x80\x02.", ""),
    ],
)
def test_pickles_that_no_checkpoint_has(tmp_path, pickled, words):
    with pytest.raises(NergError, match=f"p.pth.*{words}"):
        read_torch(archive(tmp_path / "p.pth", pickled))


def test_nothing_of_a_pickle_leads_to_the_archive(tmp_path):
    """Not even while it is read: what a persistent id stands for is a key and a number type."""
    from nerg_mi.formats.torch_ngp import unpickling

    machine = unpickling._Machine()
    out = machine.run(tensor((2, 2), (2, 1)))
    assert out._archive is None and machine.tensors == [out]
    stored = unpickling._stored(("storage", unpickling._Global("torch", "FloatStorage"), "0", "cpu", 4))
    assert vars(stored) == {"key": "0", "dtype": "<f4"}
    for pid in (
        "storage",
        ("storage",),
        ("storage", "FloatStorage", "0"),
        ("module", *[unpickling._Global("torch", "x")] * 2),
        ("storage", unpickling._Global("torch", "FloatStorage"), "../0"),
    ):
        with pytest.raises(ValueError, match="stored array"):
            unpickling._stored(pid)


def test_archives_that_inflate_are_refused(tmp_path, monkeypatch):
    from nerg_mi.files import inflating

    monkeypatch.setattr(inflating, "FREE", 1 << 20)
    with zipfile.ZipFile(tmp_path / "z.pth", "w", zipfile.ZIP_DEFLATED) as z:
        z.writestr("a/data.pkl", tensor((2,), (1,)))
        z.writestr("a/data/0", bytes(30 << 20))
    with pytest.raises(NergError, match="z.pth.*inflates"):
        read_torch(tmp_path / "z.pth")
