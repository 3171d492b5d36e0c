"""What torch.save wrote, read without torch: exact, and unable to run anything."""

import io
import pickle
import sys
import zipfile

import numpy as np
import pytest

from nerg_mi.errors import NergError
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


def test_a_huge_memo_index_makes_no_room(tmp_path):
    for put in (b"r\xff\xff\xff\xff", b"r\xff\xff\xff\x7f"):
        assert read_torch(archive(tmp_path / "m.pth", b"\x80\x02K\x01" + put + b".")) == 1


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
