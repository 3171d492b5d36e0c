"""Outputs of all commands: parents are created, unwritable outputs are reported before any work, and neither a
full disk nor Ctrl-C loses anything."""

from __future__ import annotations

import os
import pkgutil
import resource
import signal
import socket
from contextlib import contextmanager
from pathlib import Path
from typing import get_args, get_type_hints

import pytest

import nerg_mi.cli
from nerg_mi.cli.building import make_callback
from nerg_mi.cli.signatures import make_command
from nerg_mi.cli.table import ROWS

from .outputs import CASES, INPUTS, MAKES_A_FOLDER, OF_TORCH


def nerg(capsys, *arguments) -> tuple[int, str]:
    """Exit code of a command, and its output on stderr."""
    with pytest.raises(SystemExit) as end:
        nerg_mi.cli.main(list(map(str, arguments)))
    return end.value.code or 0, capsys.readouterr().err


def files(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


@contextmanager
def largest_file(size: int):
    """Simulate a full disk: no file of this process may grow beyond ``size`` bytes."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


def is_one_sentence(code: int, said: str) -> bool:
    last = said.strip().splitlines()[-1:] or [""]
    return code == 1 and last[0].startswith("nerg: ") and "Traceback" not in said


def interrupting(function):
    """Wrap ``function`` so that Ctrl-C arrives during its first call."""
    calls = []

    def interrupted(*arguments):
        calls.append(arguments)
        if len(calls) == 1:
            signal.raise_signal(signal.SIGINT)
        return function(*arguments)

    return interrupted


def remember(monkeypatch, name: str) -> None:
    """Call a function once and return its first result again later; the computed values do not matter here."""
    cached = []
    original = pkgutil.resolve_name(name)
    monkeypatch.setattr(
        name, lambda *args, **kwargs: cached[0] if cached else cached.append(original(*args, **kwargs)) or cached[0]
    )


@pytest.fixture
def offline(monkeypatch):
    """Block connections to other machines and listening on ports."""

    def refuse(name):
        original = getattr(socket.socket, name)

        def guarded(self, *arguments):
            assert self.family not in (socket.AF_INET, socket.AF_INET6), f"{name}{arguments}"
            return original(self, *arguments)

        monkeypatch.setattr(socket.socket, name, guarded)

    refuse("connect"), refuse("connect_ex"), refuse("bind"), refuse("sendto")


def _make_parameter(case):
    """Cases that take seconds and write with the functions of other cases are nightly."""
    name = f"{case.name} {Path(case.files[0]).suffix}"
    long = ("demo", "eval folds", "eval gaze", "eval next", "report", "study")
    is_long = case.name in long or "--ensemble" in case.line
    return pytest.param(case, id=name, marks=[pytest.mark.nightly] * is_long)


@pytest.mark.parametrize("case", [_make_parameter(case) for case in CASES])
def test_an_output_is_written_atomically(case, inputs, tmp_path, capsys, monkeypatch, rgb, offline):
    if case.name in OF_TORCH:
        pytest.importorskip("torch")
    if case.name == "export mesh":
        pytest.importorskip("skimage")
    if case.files[0].endswith(".parquet"):
        pytest.importorskip("pyarrow")
    if case.files[0].endswith(".mp4"):
        pytest.importorskip("av")
    for suffix, module in ((".usdc", "pxr"), (".rrd", "rerun")):
        if case.files[0].endswith(suffix):
            pytest.importorskip(module)

    case.set_defaults(monkeypatch, inputs)
    for name in case.once:
        remember(monkeypatch, f"nerg_mi.{name}")

    # A missing parent is created, and no other file remains.
    out = tmp_path / "new" / "deeper"
    code, said = nerg(capsys, *case.arguments(inputs, out))
    made = files(out)
    assert code == 0 and set(made) == set(case.files), said
    assert all(made.values())

    # Unwritable outputs are reported before any work: nothing is written.
    for k, name in enumerate(case.targets):
        out = tmp_path / f"blocked{k}"
        if Path(name).suffix:
            (out / name).mkdir(parents=True)
            reason = "it is a folder"
        else:
            out.mkdir()
            (out / name).write_bytes(b"old")
            reason = "one of its parents is a file"
        before = files(out)
        code, said = nerg(capsys, *case.arguments(inputs, out))
        assert is_one_sentence(code, said) and reason in said and str(out / name) in " ".join(said.split()), said
        assert files(out) == before
    (tmp_path / "file").write_bytes(b"old")
    code, said = nerg(capsys, *case.arguments(inputs, tmp_path / "file" / "below"))
    assert is_one_sentence(code, said) and "one of its parents is a file" in said

    # On a full disk each file is the old one or the new one, and no other file remains.
    for share in (0, 0.5) if len(made) > 1 and not case.once else (0.5,):
        limit = int(share * max(map(len, made.values())))
        out = tmp_path / f"full{share}"
        for name in () if case.needs_new_folder else case.files:
            (out / name).parent.mkdir(parents=True, exist_ok=True)
            (out / name).write_bytes(b"old")
        with largest_file(limit):
            code, said = nerg(capsys, *case.arguments(inputs, out))
        assert is_one_sentence(code, said) and "maximum file size" in said, said
        contents = files(out)
        if case.needs_new_folder:
            assert not contents
            continue
        # The state of a training, or the members of an ensemble, are kept and reported if they are small enough.
        saved = [contents.pop(name) for name in list(contents) if name == "a.run" or ".member" in name]
        assert bool(saved) == ("the training is saved" in said)
        assert set(contents) == set(case.files), "a leftover, or a loss"
        assert all(content == b"old" or limit >= len(content) > 3 for content in contents.values())
        assert any(content == b"old" for content in contents.values())

    # Ctrl-C in the middle of the first file.
    out = tmp_path / "interrupted"
    with monkeypatch.context() as change:
        change.setattr(os, "fsync", interrupting(os.fsync))
        code, said = nerg(capsys, *case.arguments(inputs, out))
    assert code == 130 and said.strip(), said
    if case.name == "render":  # handled between steps; writing is the last step
        remaining = set(files(out))
        # Finished images of a sequence remain; a sequence that waits for its common scale has none.
        assert remaining == set(case.files) if "--frames" not in case.line else remaining < set(case.files)
    else:  # the state of a training is kept
        assert set(files(out)) <= {"a.run"} and ("--resume" in said or not files(out))


def test_filtering_in_place_on_a_full_disk_keeps_the_input(inputs, tmp_path, capsys):
    for name in ("rays.npz", "rays.parquet"):
        if name.endswith(".parquet"):
            pytest.importorskip("pyarrow")
        from nerg_mi.tracking.rays import Rays

        Rays.load(inputs / "rays.npz").save(tmp_path / name)
        before = (tmp_path / name).read_bytes()
        with largest_file(1000):
            code, said = nerg(capsys, "rays", "filter", tmp_path / name, "-o", tmp_path / name, "--person", "a")
        assert is_one_sentence(code, said) and (tmp_path / name).read_bytes() == before
        assert name in os.listdir(tmp_path)
        code, _ = nerg(capsys, "rays", "filter", tmp_path / name, "-o", tmp_path / name, "--person", "a")
        assert code == 0 and set(Rays.load(tmp_path / name).person) == {0}


def commands() -> dict:
    """The function of each command of `nerg`, by its full name."""
    made = {name: make_command(row) for name, row in ROWS.items()}
    return {name: (make_callback(command), command.parameters) for name, command in made.items()}


def path_options(command, parameters) -> dict[str, tuple]:
    """Path parameters of a command, and their options; arguments are inputs."""
    out = {}
    arguments = {key for key, parameter in parameters.items() if not parameter.names}
    for key, hint in get_type_hints(command, include_extras=True).items():
        kind, *annotations = get_args(hint) or (hint,)
        if key not in arguments and Path in (kind, *get_args(kind)):
            names = [d for info in annotations for d in (getattr(info, "default", None), *(info.param_decls or ()))]
            out[key] = tuple(d for d in names if isinstance(d, str) and d.startswith("-")) or (
                "--" + key.replace("_", "-"),
            )
    return out


def test_every_output_option_has_a_case(tmp_path):
    """Each option with a path is an output in `outputs.CASES`, or an input."""
    commands_by_name = commands()
    assert set(commands_by_name) >= {c.name for c in CASES} | set(MAKES_A_FOLDER) | set(INPUTS)
    for name, command in commands_by_name.items():
        if name in MAKES_A_FOLDER:
            continue
        lines = [c.arguments(tmp_path, tmp_path) for c in CASES if c.name == name]
        options, read = path_options(*command), INPUTS.get(name, set())
        assert read <= set(options), f"{name} has no such option"
        for parameter in set(options) - read:
            assert any(option in line for line in lines for option in options[parameter]), (
                f"{name}: {options[parameter]}"
            )
