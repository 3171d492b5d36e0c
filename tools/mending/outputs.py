"""Mendings of what is written, and of how commands end."""

from __future__ import annotations

from .reversal import held, undo

MENDINGS = (
    held(
        "One core, or one thread, is enough to write and to read EXR",
        undo(
            "Mitsuba writes bitmaps",
            ["tests/files/test_exr.py::test_one_thread_is_enough"],
            (
                "nerg_mi/files/exr.py",
                "    write_exr(path, bitmap_channels(bitmap), {k: str(v) for k, v in attributes.items()})\n",
                "    bitmap.write(str(path))\n",
            ),
        ),
        undo(
            "Mitsuba reads with the threads that there are",
            ["tests/files/test_exr.py::test_a_scene_with_an_exr_file_is_read_with_one_thread"],
            ("nerg_mi/files/exr.py", "    set_thread_count(2)\n", "    set_thread_count(threads)\n"),
        ),
        undo(
            "Mitsuba writes the picture of `nerg render`",
            ["tests/cli/test_render.py::test07_one_thread_is_enough[out.exr]"],
            (
                "nerg_mi/rendering/picture_file.py",
                "yield lambda bitmap, rows: write({name: values[:rows] for name, values in "
                "bitmap_channels(bitmap).items()})",
                "yield lambda bitmap, rows: bitmap.write(str(path))",
            ),
        ),
    ),
)
