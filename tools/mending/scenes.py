"""Mendings of scenes and of rendering."""

from __future__ import annotations

from .reversal import held, undo

_SCENE_FILE = "tests/rendering/test_scene_file.py::"

MENDINGS = (
    held(
        "Voxels are read again only when they change, and maps are made again when the field does",
        undo(
            "every update of a parameter reads the voxels",
            ["tests/plugins/test_nerg_updates.py::test01_voxels_are_read_when_they_change_and_not_otherwise"],
            (
                "nerg_mi/transport/media/volume.py",
                "        if arrays == self._read and not anyway:\n            return\n",
                "",
            ),
        ),
        undo(
            "a map is one of a position alone",
            ["tests/plugins/test_nerg_updates.py::test03_a_map_follows_the_field"],
            (
                "nerg_mi/transport/observer/cache.py",
                "values = [] if place.medium is None else [v for v in place.medium.parameters() if dr.is_array_v(v)]",
                "values = []",
            ),
            ("plugins/nerg.py", "            self.cache.forget()\n", "            pass\n"),
        ),
    ),
    held(
        "Threads change between computations, never within one",
        undo(
            "the number changes while kernels are queued",
            ["tests/test_threads.py::test_what_is_queued_is_done_first"],
            ("nerg_mi/threads.py", "    dr.sync_thread()\n", ""),
        ),
    ),
    held(
        "Scenes that would end the process are refused in one sentence: depth, counts, films, samples",
        undo(
            "Mitsuba reads the file first",
            [_SCENE_FILE + "test_what_would_end_the_process_is_a_sentence"],
            ("nerg_mi/rendering/pictures.py", "    check_scene_file(path, defaults)\n", ""),
        ),
        undo(
            "films may be of any size",
            [
                _SCENE_FILE + "test_what_would_end_the_process_is_a_sentence[film]",
                _SCENE_FILE + "test_what_would_end_the_process_is_a_sentence[long film]",
            ],
            ("nerg_mi/rendering/pictures.py", "    check_scene(path, loaded)\n", ""),
        ),
        undo(
            "a place is read without a look at its file",
            [_SCENE_FILE + "test_the_other_ways_in_are_guarded"],
            (
                "nerg_mi/training/geometry/places.py",
                "    scene = load_scene(path)\n",
                "    import mitsuba as mi\n\n    scene = mi.load_file(str(path))\n",
            ),
        ),
    ),
    held(
        "Samples that are given on the line count, and not a scene's own: `nerg render -D spp=0` is refused",
        undo(
            "no samples are few enough",
            [
                _SCENE_FILE + "test_values_given_count_and_not_the_defaults",
                _SCENE_FILE + "test_what_would_end_the_process_is_a_sentence[samples]",
                _SCENE_FILE + "test_what_would_end_the_process_is_a_sentence[multijitter]",
            ],
            ("nerg_mi/rendering/scene_file.py", "    if not 1 <= count <= SAMPLES:\n", "    if count > SAMPLES:\n"),
        ),
        undo(
            "defaults are looked at, whatever is given",
            [_SCENE_FILE + "test_values_given_count_and_not_the_defaults"],
            (
                "nerg_mi/rendering/scene_file.py",
                "_Scene(path.parent, {k: str(v) for k, v in (defaults or {}).items()}).read(",
                "_Scene(path.parent, {}).read(",
            ),
        ),
    ),
    held(
        "Depths of an observer are finite whatever the tolerance",
        undo(
            "tolerances are squared to infinity",
            ["tests/plugins/test_nerg_finite.py::test_observer_depth_is_finite_whatever_the_tolerance"],
            ("nerg_mi/transport/observer/sight.py", "LARGEST = 1e18\n", 'LARGEST = float("inf")\n'),
        ),
    ),
)
