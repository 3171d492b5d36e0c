"""Photos of a folder: turned as they are to be looked at, and what is wrong with others named."""

from __future__ import annotations

import os
import struct
import sys
import zlib
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from nerg_mi.errors import NergError
from nerg_mi.photos.images import read_image
from nerg_mi.photos.structure import Folders, copy_photos, list_photos, small_name


def ramp(width: int = 48, height: int = 32, seed: int = 0) -> Image.Image:
    """A smooth picture, red to the right and green downwards; the seed is in its blue."""
    x, y = np.meshgrid(np.linspace(0, 255, width), np.linspace(0, 255, height))
    return Image.fromarray(np.stack([x, y, np.full_like(x, 20 * seed)], axis=-1).astype(np.uint8))


@pytest.fixture
def folders(tmp_path) -> Folders:
    made = Folders(tmp_path / "images", tmp_path / "small")
    made.images.mkdir()
    made.small.mkdir()
    return made


def copied(folder: Path, folders: Folders, longest: int = 24):
    steps = []
    pictures, unused = copy_photos(list_photos(folder)[0], folders, longest, lambda *now: steps.append(now))
    assert steps and steps[-1][0] == steps[-1][1] == len(steps)
    return pictures, {u.name: u.reason for u in unused}


@pytest.fixture
def folder(tmp_path) -> Path:
    out = tmp_path / "photos"
    out.mkdir()
    return out


def test_what_stands_upright_is_copied_byte_for_byte(folder, folders):
    ramp().save(folder / "b.JPG", quality=90)
    ramp(seed=2).convert("L").save(folder / "a c.png")
    pictures, unused = copied(folder, folders)
    assert [p.name for p in pictures] == ["a c.png", "b.JPG"] and not unused
    for k, p in enumerate(pictures):
        assert (folders.images / p.name).read_bytes() == (folder / p.name).read_bytes()
        assert p.size == (48, 32) and p.small == (24, 16) == Image.open(folders.small / small_name(k)).size
        assert p.focal is None


# Where red and green grow in the file, so that after turning red grows to the right and green downwards.
@pytest.mark.parametrize("orientation", range(1, 9))
def test_a_photo_is_turned_as_its_notes_say(orientation, folder, folders):
    """EXIF, tag 0x0112: the file of an upright picture is made by the inverse of what viewers do."""
    undo = {
        2: Image.Transpose.FLIP_LEFT_RIGHT,
        3: Image.Transpose.ROTATE_180,
        4: Image.Transpose.FLIP_TOP_BOTTOM,
        5: Image.Transpose.TRANSPOSE,
        6: Image.Transpose.ROTATE_90,
        7: Image.Transpose.TRANSVERSE,
        8: Image.Transpose.ROTATE_270,
    }
    stored = ramp() if orientation == 1 else ramp().transpose(undo[orientation])
    notes = Image.Exif()
    notes[0x0112] = orientation
    stored.save(folder / "a.jpg", quality=98, exif=notes)
    (picture,), unused = copied(folder, folders)
    assert picture.size == (48, 32) and not unused
    # As the trainer sees it, which passes over such notes.
    seen = read_image(folders.images / "a.jpg").astype(int)
    assert np.abs(seen - np.asarray(ramp())).mean() < 3
    assert Image.open(folders.images / "a.jpg").getexif().get(0x0112, 1) == 1


def test_notes_tell_focal_length_and_camera(folder, folders):
    notes = Image.Exif()
    notes[0x010F], notes[0x0110] = "Maker", "Model"
    notes.get_ifd(0x8769)[0xA405] = 26
    notes.get_ifd(0x8769)[0x920A] = 4.25
    ramp(360, 240).save(folder / "a.jpg", exif=notes)
    (picture,), _ = copied(folder, folders)
    # A picture of the shape of film, on which 36 mm are 360 pixels.
    assert picture.focal == pytest.approx(260, rel=1e-4) and picture.made_by[:2] == ("Maker", "Model")
    assert float(picture.made_by[2]) == 4.25


def test_damaged_notes_do_not_matter(folder, folders):
    ramp().save(folder / "a.jpg", exif=b"Exif\x00\x00MM\x00*\xff\xff\xff\xff" + bytes(range(256)))
    (picture,), unused = copied(folder, folders)
    assert picture.made_by in ((), ("", "", "")) and not unused


def test_palettes_are_stored_anew(folder, folders):
    ramp().quantize(16).save(folder / "a.png")
    (picture,), _ = copied(folder, folders)
    assert Image.open(folders.images / picture.name).mode == "RGB"


def test_what_cannot_be_used_is_named(folder, folders):
    ramp().save(folder / "a.jpg", quality=95)
    ramp().save(folder / "b.jpg", quality=95)
    ramp(seed=5).save(folder / "good.jpg")
    raw = (folder / "good.jpg").read_bytes()
    (folder / "cut.jpg").write_bytes(raw[: len(raw) // 2])
    (folder / "empty.png").write_bytes(b"")
    (folder / "text.jpg").write_text("no picture")
    ramp().save(folder / "a gif.jpg", "gif")
    pictures, unused = copied(folder, folders)
    assert [p.name for p in pictures] == ["a.jpg", "good.jpg"]
    assert unused["b.jpg"] == 'it is the same file as "a.jpg"'
    assert set(unused) == {"b.jpg", "cut.jpg", "empty.png", "text.jpg", "a gif.jpg"}
    assert all("cannot be read" in unused[n] and n in unused[n] for n in set(unused) - {"b.jpg"})
    assert {p.name for p in folders.images.iterdir()} == {"a.jpg", "good.jpg"}


def test_pictures_of_other_kinds_are_named_whatever_they_are_called(folder, folders):
    ramp().save(folder / "a.jpg", "bmp")
    ramp(seed=1).save(folder / "b.jpg", "png")
    (folder / "c.jpg").write_bytes(b"\0\0\0\x18ftypheic" + bytes(100))
    pictures, unused = copied(folder, folders)
    assert [p.name for p in pictures] == ["b.jpg"] and 'of the kind "bmp"' in unused["a.jpg"]
    assert "no picture of a kind that is read" in unused["c.jpg"]


def test_links_out_of_the_folder_are_followed_only_if_allowed(folder, folders, tmp_path):
    ramp().save(tmp_path / "private.jpg")
    ramp(seed=1).save(folder / "a.jpg")
    (folder / "b.jpg").symlink_to(tmp_path / "private.jpg")
    (folder / "c.jpg").symlink_to("a.jpg")
    pictures, unused = copied(folder, folders)
    assert [p.name for p in pictures] == ["a.jpg"] and "same file" in unused["c.jpg"]
    assert "outside of" in unused["b.jpg"] and "--allow-outside" in unused["b.jpg"]
    found, _ = copy_photos(list_photos(folder)[0], folders, 24, lambda *now: None, allow_outside=True)
    assert [p.name for p in found] == ["a.jpg", "b.jpg"]


@pytest.mark.skipif(sys.platform != "linux", reason="names of files are bytes on Linux alone")
def test_names_that_cannot_be_stored_are_told(folder, folders):
    ramp().save(folder / "good.jpg")
    for k, name in enumerate((b"caf\xe9.jpg", b"two\nlines.jpg", b"\x1b[31m.jpg")):
        ramp(seed=k + 1).save(folder / os.fsdecode(name))
    pictures, unused = copied(folder, folders)
    assert [p.name for p in pictures] == ["good.jpg"]
    assert len(unused) == 3 and all("rename it" in reason for reason in unused.values())


def test_photos_are_as_large_as_their_bytes_warrant(folder, folders, monkeypatch):
    ramp().save(folder / "a.png")
    raw = (folder / "a.png").read_bytes()
    claim = raw[12:16] + struct.pack(">II", 8193, 8193) + raw[24:29]
    (folder / "b.png").write_bytes(raw[:12] + claim + zlib.crc32(claim).to_bytes(4, "big") + raw[33:])
    with (folder / "c.jpg").open("wb") as file:
        file.truncate((1 << 28) + 1)
    pictures, unused = copied(folder, folders)
    assert [p.name for p in pictures] == ["a.png"]
    assert "8,193 x 8,193 pixels" in unused["b.png"] and "make it smaller" in unused["b.png"]
    assert "268,435,457 bytes" in unused["c.jpg"]
    # JPEG, in which it is stored where it is turned, has no longer sides.
    Image.new("L", (65_501, 1)).save(folder / "d.png")
    assert "a side of 65,501 pixels" in copied(folder, folders)[1]["d.png"]
    # Pillow's own limit is lower than what telephones take by now.
    monkeypatch.setattr(Image, "MAX_IMAGE_PIXELS", 100)
    assert [p.name for p in copied(folder, folders)[0]] == ["a.png"]


def test_odd_notes_leave_a_photo_as_it_is(folder, folders):
    """Of each kind and size: Pillow's own turning writes the notes anew, and fails on some."""
    entry = lambda *numbers: struct.pack(">HHII", *numbers)
    notes = [
        entry(0x0112, 3, 0xFFFFFFFF, 8) + entry(0x8769, 4, 1 << 30, 8),
        entry(0x0112, 11, 1, 0x7FC00000),
        entry(0x0112, 2, 4, 0x36363636),
        entry(0x8769, 4, 1, 8) + entry(0x0112, 5, 1, 8),
    ]
    for k, found in enumerate(notes):
        head = b"Exif\0\0MM\0*\0\0\0\x08" + struct.pack(">H", len(found) // 12)
        # What follows are the same notes again.
        ramp(seed=k).save(folder / f"{k}.jpg", exif=head + found + struct.pack(">I", 8))
    pictures, unused = copied(folder, folders)
    assert [p.size for p in pictures] == [(48, 32)] * 4 and not unused


def test_others_are_named_and_hidden_ones_are_not(folder):
    ramp().save(folder / "a.jpg")
    for name in ("b.HEIC", ".c.jpg", "notes.txt"):
        (folder / name).write_bytes(b"x")
    photos, others = list_photos(folder)
    assert [p.name for p in photos] == ["a.jpg"] and [o.name for o in others] == ["b.HEIC"]
    assert "JPEG and PNG" in others[0].reason


def test_a_folder_without_photos_is_told(folder, tmp_path):
    with pytest.raises(NergError, match="name the folder"):
        list_photos(folder)
    (folder / "images").mkdir()
    with pytest.raises(NergError, match='did you mean ".*images"'):
        list_photos(folder)
    (folder / "a.heic").write_bytes(b"x")
    with pytest.raises(NergError, match="convert them"):
        list_photos(folder)
    with pytest.raises(NergError, match="there is no folder of photos"):
        list_photos(tmp_path / "nowhere")
