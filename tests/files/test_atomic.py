"""Tests of `nerg_mi.files.atomic`."""

from __future__ import annotations

import hashlib
import os
import signal
import subprocess
import sys
import time

import pytest

from nerg_mi.errors import NergError
from nerg_mi.files import atomic
from nerg_mi.files.atomic import (
    check_folder,
    check_new_folder,
    check_writable,
    create_folder_atomically,
    make_folder,
    replace_atomically,
    reserve_output,
    write_bytes,
    write_text,
)

# ---- Output files are written atomically, and errors contain a remedy ----


def test_parents_are_created_without_leftovers(tmp_path):
    path = tmp_path / "a" / "b" / "c.txt"
    write_text(path, "é\n")
    assert path.read_bytes() == "é\n".encode()
    assert os.listdir(path.parent) == ["c.txt"]


def test_failing_writer_keeps_old_file(tmp_path):
    path = tmp_path / "a.npz"
    path.write_bytes(b"old")
    with pytest.raises(ZeroDivisionError), replace_atomically(path) as temporary:
        assert temporary.suffix == ".npz" and temporary.parent == tmp_path
        temporary.write_bytes(b"half")
        raise ZeroDivisionError
    assert path.read_bytes() == b"old" and os.listdir(tmp_path) == ["a.npz"]


def test_permissions_follow_umask(tmp_path):
    before = os.umask(0o027)
    try:
        write_bytes(tmp_path / "new", b"")
    finally:
        os.umask(before)
    assert (tmp_path / "new").stat().st_mode & 0o777 == 0o640
    os.chmod(tmp_path / "new", 0o604)
    write_bytes(tmp_path / "new", b"1")
    assert (tmp_path / "new").stat().st_mode & 0o777 == 0o604


def test_write_protected_file_is_not_replaced(tmp_path, monkeypatch):
    path = tmp_path / "kept"
    path.write_bytes(b"old")
    path.chmod(0o444)
    # Root may write to all files.
    monkeypatch.setattr(os, "access", lambda p, mode: mode & os.W_OK == 0 or os.stat(p).st_mode & 0o200 != 0)
    for write in (lambda: write_bytes(path, b"new"), lambda: check_writable(path)):
        with pytest.raises(NergError, match="permission denied"):
            write()
    assert path.read_bytes() == b"old" and os.listdir(tmp_path) == ["kept"]


def test_link_is_followed(tmp_path):
    (tmp_path / "real").write_bytes(b"old")
    (tmp_path / "link").symlink_to("real")
    write_bytes(tmp_path / "link", b"new")
    assert (tmp_path / "link").is_symlink() and (tmp_path / "real").read_bytes() == b"new"


def test_write_errors_name_file_and_remedy(tmp_path):
    (tmp_path / "file").write_bytes(b"")
    with pytest.raises(NergError, match="folder; specify a file name"):
        write_bytes(tmp_path, b"")
    with pytest.raises(NergError, match="parents is a file"):
        write_bytes(tmp_path / "file" / "x", b"")
    with pytest.raises(NergError, match="parents is a file"):
        make_folder(tmp_path / "file" / "x")
    with pytest.raises(NergError, match="name is too long"):
        write_bytes(tmp_path / ("x" * 300), b"")


def test_pipe_is_written_to_and_remains(tmp_path):
    path = tmp_path / "pipe"
    os.mkfifo(path)
    reader = os.open(path, os.O_RDONLY | os.O_NONBLOCK)
    write_bytes(path, b"through")
    assert os.read(reader, 100) == b"through" and path.is_fifo() and os.listdir(tmp_path) == ["pipe"]
    os.close(reader)


def test_unwritable_paths_are_detected_early_without_side_effects(tmp_path, monkeypatch):
    (tmp_path / "file").write_bytes(b"")
    check_writable(tmp_path / "file")
    check_writable(tmp_path / "a" / "b.NPZ", ".npz", ".parquet")
    check_folder(tmp_path)
    check_folder(tmp_path / "a" / "b")
    with pytest.raises(NergError, match="ends in .npz or .parquet"):
        check_writable(tmp_path / "b.txt", ".npz", ".parquet")
    for path, said in (
        (tmp_path, "is a folder"),
        (tmp_path / "file" / "x" / "y", "parents is a file"),
        (tmp_path / ("x" * 300), "too long"),
    ):
        with pytest.raises(NergError, match=said):
            check_writable(path)
    with pytest.raises(NergError, match="parents is a file"):
        check_folder(tmp_path / "file")
    with pytest.raises(NergError, match="parents is a file"):
        check_folder(tmp_path / "file" / "x")
    assert os.listdir(tmp_path) == ["file"]
    # Root may write everywhere, so the answer of the system for other users is simulated.
    monkeypatch.setattr(os, "access", lambda path, mode: False)
    for check in (check_writable, check_folder):
        with pytest.raises(NergError, match="permission denied"):
            check(tmp_path / "new")


_LIMITED = """
import resource, sys
from nerg_mi.files.atomic import write_bytes
resource.setrlimit(resource.RLIMIT_FSIZE, (1000, 1000))
write_bytes(sys.argv[1], b"x" * 5000)
"""


def test_full_disk_keeps_old_file(tmp_path):
    path = tmp_path / "a"
    path.write_bytes(b"old")
    done = subprocess.run([sys.executable, "-c", _LIMITED, str(path)], capture_output=True, text=True)
    assert done.returncode == 1 and "maximum file size" in done.stderr
    assert path.read_bytes() == b"old" and os.listdir(tmp_path) == ["a"]


_ENDLESS = """
import sys
from nerg_mi.files.atomic import write_bytes
for k in range(10**6):
    write_bytes(sys.argv[1], bytes([k % 256]) * 100_000)
"""


def test_killed_writer_leaves_complete_file(tmp_path):
    for k in range(5):
        path = tmp_path / str(k) / "a"
        child = subprocess.Popen([sys.executable, "-c", _ENDLESS, str(path)])
        while not path.exists():
            assert child.poll() is None
        time.sleep(0.013 * k)
        child.send_signal(signal.SIGKILL)
        child.wait()
        data = path.read_bytes()
        assert len(data) == 100_000 and len(set(data)) == 1


def test_folder_is_created_atomically(tmp_path):
    out = tmp_path / "new" / "capture"
    with create_folder_atomically(out) as folder:
        assert folder.parent == out.parent and not out.exists()
        write_text(folder / "a" / "b.txt", "1")
    assert (out / "a" / "b.txt").read_text() == "1" and os.listdir(out.parent) == ["capture"]
    for error in (KeyboardInterrupt, ZeroDivisionError):
        with pytest.raises(error), create_folder_atomically(tmp_path / "other") as folder:
            write_text(folder / "a" / "b.txt", "1")
            raise error
    with pytest.raises(NergError, match="other.*the disk is full"), create_folder_atomically(tmp_path / "other"):
        raise OSError(28, "No space left on device")
    assert os.listdir(tmp_path) == ["new"]


def test_non_empty_folder_is_refused(tmp_path):
    (tmp_path / "empty").mkdir()
    with create_folder_atomically(tmp_path / "empty") as folder:
        write_text(folder / "a", "1")
    for check in (
        lambda: check_new_folder(tmp_path / "empty"),
        lambda: create_folder_atomically(tmp_path / "empty").__enter__(),
    ):
        with pytest.raises(NergError, match="empty: choose another name"):
            check()
    with pytest.raises(NergError, match="parents is a file"):
        check_new_folder(tmp_path / "empty" / "a")
    assert os.listdir(tmp_path) == ["empty"] and os.listdir(tmp_path / "empty") == ["a"]


HOLD = """
import sys, time
from nerg_mi.files.atomic import reserve_output
with reserve_output(sys.argv[1]):
    print("held", flush=True)
    time.sleep(60)
"""


def test_output_has_one_writer_at_a_time(tmp_path):
    path = tmp_path / "new" / "a.bin"
    with reserve_output(path), pytest.raises(NergError, match='another process is writing ".*a.bin"'):
        with reserve_output(tmp_path / "new" / ".." / "new" / "a.bin"):
            raise AssertionError("two at a time")
    assert not list(tmp_path.iterdir())
    with pytest.raises(KeyboardInterrupt), reserve_output(path), reserve_output(path.with_name("b.bin")):
        raise KeyboardInterrupt
    assert not list(tmp_path.iterdir())
    with reserve_output(None):
        pass


def test_killed_process_releases_reservation(tmp_path):
    path = tmp_path / "a.bin"
    with subprocess.Popen([sys.executable, "-c", HOLD, path], stdout=subprocess.PIPE) as process:
        process.stdout.readline()
        with pytest.raises(NergError, match="another process"), reserve_output(path):
            pass
        process.kill()
        process.wait()
    with reserve_output(path):
        write_bytes(path, b"x")
    assert [p.name for p in tmp_path.iterdir()] == ["a.bin"]


# ---- Checksums of files ----


def test_checksum_of_file_larger_than_block(tmp_path, monkeypatch):
    monkeypatch.setattr(atomic, "_BLOCK", 7)
    data = bytes(range(256)) * 3
    (tmp_path / "a").write_bytes(data)
    (tmp_path / "empty").write_bytes(b"")
    assert atomic.file_sha256(tmp_path / "a") == hashlib.sha256(data).hexdigest()
    assert atomic.file_sha256(tmp_path / "empty") == hashlib.sha256(b"").hexdigest()


def test_checksum_of_non_file_is_refused(tmp_path):
    for path in (tmp_path / "absent", tmp_path):
        with pytest.raises(NergError, match=path.name):
            atomic.file_sha256(path)
