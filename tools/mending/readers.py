"""Mendings of what is read, and of what is said about it."""

from __future__ import annotations

from .reversal import held, undo

_IMPORTS = "tests/cli/rays/test_imports.py::"
_STRUCTURE = "tests/capture/structure/"
_VIDEO = "nerg_mi/capture/structure/video.py"
_BUILDER = "nerg_mi/rays/readers/builder.py"
_PSEUDONYMS = "nerg_mi/rays/pseudonyms.py"

MENDINGS = (
    held(
        "One line that was cut off does not end an import",
        undo(
            "no line is left out",
            [_IMPORTS + "test_one_line_that_was_cut_off_among_many_files"],
            (_BUILDER, "        return self._bad_line if self._skips else None\n", "        return None\n"),
        ),
        undo(
            "lines of all files are counted together",
            ["tests/rays/readers/test_builder.py::test_bad_lines_are_bounded_by_file"],
            (
                _BUILDER,
                '        self._lines, self._bad, self._first_bad = 0, [], ""\n',
                '        self._bad, self._first_bad = [], ""\n',
            ),
        ),
    ),
    held(
        "A wrong tick is named",
        undo(
            "rays more than a second apart have no rate",
            [
                _IMPORTS + "test_a_wrong_tick_is_told_and_nothing_is_nan",
                "tests/rays/test_summary.py::test_rate_of_rays_far_apart",
            ],
            (
                "nerg_mi/rays/summary.py",
                "    rate = 1.0 / (float(np.median(step)) if step.size else median_step)\n",
                '    rate = 1.0 / float(np.median(step)) if step.size else float("nan")\n',
            ),
        ),
        undo(
            "a rate that nobody knows is printed",
            [_IMPORTS + "test_times_that_do_not_change"],
            ("nerg_mi/rays/card.py", "    if not np.isfinite(s.rate):\n", "    if s.rate < 0:\n"),
        ),
        undo(
            "no unit of time is offered",
            [_IMPORTS + "test_a_wrong_tick_is_told_and_nothing_is_nan"],
            (
                "nerg_mi/rays/checks/times.py",
                "        if fits:\n            unit",
                "        if not fits:\n            unit",
            ),
        ),
    ),
    held(
        "Pseudonyms leave no name behind, and are told from names by the salt alone",
        undo(
            "metadata stay as they are",
            ["tests/rays/test_pseudonyms.py::test_no_name_is_left_anywhere", _IMPORTS + "test_pseudonyms"],
            (
                _PSEUDONYMS,
                "    metadata = _without_names(rays.metadata, rays.persons, person, digest)\n",
                "    metadata = dict(rays.metadata)\n",
            ),
        ),
        undo(
            "the salt is left out",
            ["tests/rays/test_pseudonyms.py::test_the_salt_decides"],
            (_PSEUDONYMS, "    return secrets.token_bytes(32) if salt is None else salt\n", "    return bytes(32)\n"),
        ),
        undo(
            "rays stay in the order of the names",
            ["tests/rays/test_pseudonyms.py::test_rays_stay_those_of_the_same_people"],
            (
                _PSEUDONYMS,
                "    order = sorted(range(len(names)), key=lambda i: names[i])\n",
                "    order = list(range(len(names)))\n",
            ),
        ),
    ),
    held(
        "A data set reads no file beyond its folder unless that is allowed",
        undo(
            "paths lead anywhere",
            [
                "tests/capture/test_transforms.py::test_files_outside_of_the_folder_are_used_only_if_allowed",
                "tests/capture/test_colmap.py::test_images_outside_of_the_capture_are_used_only_if_allowed",
                "tests/capture/test_colmap.py::test_masks_outside_of_the_capture_are_used_only_if_allowed",
                "tests/cli/test_outside.py::test_photos_beyond_the_folder_are_read_only_if_allowed",
            ],
            (
                "nerg_mi/capture/posed.py",
                "not Path(os.path.realpath(path)).is_relative_to(os.path.realpath(root)):\n",
                "not os.path.realpath(path):\n",
            ),
        ),
        undo(
            "links are not followed, and `..` is not either",
            ["tests/capture/test_transforms.py::test_files_outside_of_the_folder_are_used_only_if_allowed"],
            (
                "nerg_mi/capture/posed.py",
                "not Path(os.path.realpath(path)).is_relative_to(os.path.realpath(root)):\n",
                "not Path(path).is_relative_to(root):\n",
            ),
        ),
    ),
    held(
        "Photos are read of their own folder, and as large as their bytes warrant",
        undo(
            "links lead anywhere",
            [_STRUCTURE + "test_photos.py::test_links_out_of_the_folder_are_followed_only_if_allowed"],
            (
                "nerg_mi/capture/structure/photos.py",
                'read_photo(path if allow_outside else inside(path.parent, path, "photo"))',
                "read_photo(path)",
            ),
        ),
        undo(
            "what a header claims is read",
            [_STRUCTURE + "test_photos.py::test_photos_are_as_large_as_their_bytes_warrant"],
            (
                "nerg_mi/capture/structure/photos.py",
                "_PIXELS, _BYTES = 1 << 26, 1 << 28\n",
                "_PIXELS, _BYTES = 1 << 40, 1 << 40\n",
            ),
        ),
    ),
    held(
        "A video makes FFmpeg open nothing but itself, and room for no more than it holds",
        undo(
            "FFmpeg opens what a video names",
            [_STRUCTURE + "test_video.py::test_nothing_but_the_file_is_opened"],
            (_VIDEO, "                io_open=_nothing_else,\n", ""),
            (
                _VIDEO,
                'container_options={"format_whitelist": ",".join(FORMATS), "protocol_whitelist": "none"},\n',
                "\n",
            ),
            (_VIDEO, "                _Source(file),\n", "                str(video),\n"),
        ),
        undo(
            "FFmpeg is given the name",
            [_STRUCTURE + "test_video.py::test_a_name_is_no_address"],
            (_VIDEO, "                _Source(file),\n", "                str(video),\n"),
        ),
        undo(
            "samples take no bytes",
            ["tests/files/test_movie_tables.py::test_samples_need_bytes"],
            (
                "nerg_mi/files/movie_tables.py",
                "    if claims.samples * max(1, claims.edits - 1) > length:\n",
                "    if claims.samples < 0:\n",
            ),
        ),
    ),
    held(
        "Damaged files are told in one sentence, within bounds",
        undo(
            "what a file lacks is told as it comes",
            [
                "tests/fuzz/test_readers.py::test_damaged_files_give_a_result_or_one_sentence",
                "tests/fuzz/test_readers.py::test_cases_that_once_failed",
            ],
            ("nerg_mi/files/bounded.py", "    KeyError,\n", ""),
        ),
        undo(
            "room is made for pictures before their size is looked at",
            ["tests/fuzz/test_readers.py::test_cases_that_once_failed"],
            (
                "nerg_mi/files/image_header.py",
                "    if width * height > pixels or header.bytes > decoded:\n",
                "    if width * height < 1:\n",
            ),
        ),
    ),
)
