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
    held(
        "Every output of every command is whole or absent, and its input stays",
        undo(
            "files are written under their own names",
            [
                "tests/cli/test_outputs.py::test_output[rays filter .npz]",
                "tests/cli/test_outputs.py::test_filtering_in_place_keeps_its_input_where_there_is_no_room",
            ],
            (
                "nerg_mi/files/atomic.py",
                "        # In the same folder, since only there",
                "        yield target\n        return\n        # In the same folder, since only there",
            ),
        ),
        undo(
            "a study opens its table itself",
            ["tests/test_writers.py::test_no_file_is_written_directly"],
            (
                "nerg_mi/evaluation/study/tables.py",
                "    write_text(paths[1], markdown(report))\n",
                '    with open(paths[1], "w") as file:\n        file.write(markdown(report))\n',
            ),
        ),
    ),
    held(
        "A finished training is not lost to a full disk or to fp16",
        undo(
            "the state goes before the result is written",
            [
                "tests/training/common/test_run_state.py::test_a_result_that_cannot_be_written_is_kept",
                "tests/training/gaze/test_state.py::test_a_result_that_cannot_be_written_is_kept",
            ],
            (
                "nerg_mi/training/common/run_state.py",
                "    try:\n        yield\n    except BaseException as error:\n        if path is None:\n",
                "    if path is not None and done:\n        path.unlink(missing_ok=True)\n"
                "    try:\n        yield\n    except BaseException as error:\n        if path is None or done:\n",
            ),
        ),
        undo(
            "what fp16 cannot hold is stored as infinite",
            ["tests/training/common/test_run_state.py::test_a_result_that_cannot_be_written_is_kept"],
            (
                "nerg_mi/formats/arrays.py",
                "        if not np.all(np.isfinite(out[name])):",
                "        if np.any(value != value):",
            ),
        ),
        undo(
            "members of an ensemble go before it is written",
            ["tests/training/gaze/test_ensemble.py::test_an_ensemble_that_cannot_be_written_is_kept"],
            (
                "nerg_mi/training/gaze/ensemble.py",
                "        with kept_unless(path, lambda: None, done=False):\n            write(ensemble, provenance)\n"
                "        for part in parts:\n            if part is not None:\n"
                "                part.unlink(missing_ok=True)\n",
                "        for part in parts:\n            if part is not None:\n"
                "                part.unlink(missing_ok=True)\n"
                "        with kept_unless(path, lambda: None, done=False):\n            write(ensemble, provenance)\n",
            ),
        ),
    ),
    held(
        "Ctrl-C ends a command with exit code 130 and leaves nothing in halves",
        undo(
            "a picture is rendered to its end",
            ["tests/cli/test_render.py::test09_ctrl_c_ends_it_and_leaves_nothing[out.exr]"],
            (
                "nerg_mi/jobs/pictures.py",
                "            stop.check()\n            share = (done",
                "            share = (done",
            ),
            (
                "nerg_mi/jobs/pictures.py",
                "add(bitmap, band.rows)\n            stop.check()\n",
                "add(bitmap, band.rows)\n",
            ),
        ),
        undo(
            "a file that was begun stays",
            ["tests/cli/test_render.py::test09_ctrl_c_ends_it_and_leaves_nothing[out.png]"],
            (
                "nerg_mi/files/atomic.py",
                "        except BaseException:\n            temporary.unlink(",
                "        except Exception:\n            temporary.unlink(",
            ),
        ),
        undo(
            "the demo makes all of its pictures",
            ["tests/cli/test_demo.py::test06_ctrl_c_ends_it_and_leaves_nothing"],
            ("nerg_mi/jobs/demo.py", "lambda done, total: stop.check())", "lambda done, total: None)"),
            ("nerg_mi/jobs/demo.py", "render(unhidden, CAMERA)\n        stop.check()\n", "render(unhidden, CAMERA)\n"),
        ),
        undo(
            "an error that Mitsuba or Typer makes of it is told as it comes",
            ["tests/cli/test_interrupts.py::test_a_command_ends_at_once"],
            (
                "nerg_mi/cli/ending.py",
                "        return link if link is not None or not self._heard or done else KeyboardInterrupt()",
                "        return end if isinstance(end, KeyboardInterrupt) else None",
            ),
        ),
        undo(
            "an ablation goes on with the next variant",
            ["tests/cli/test_interrupts.py::test_a_command_ends_at_once[ablate]"],
            ("nerg_mi/jobs/ablation_bench.py", "    if result.interrupted:\n        raise KeyboardInterrupt\n", ""),
        ),
        undo(
            "a training of gaze ends as if it were done",
            ["tests/cli/test_interrupts.py::test_a_gaze_training_keeps_its_state_and_its_result"],
            ("nerg_mi/jobs/gaze.py", "    if result.interrupted and output is not None:\n", "    if False:\n"),
        ),
        undo(
            "a radiance training ends as if it were done",
            ["tests/cli/test_interrupts.py::test_a_radiance_training_keeps_its_state_and_its_result"],
            ("nerg_mi/jobs/radiance.py", "    if result.interrupted and output is not None:\n", "    if False:\n"),
        ),
        undo(
            "Ctrl-C in the middle of a step ends a run there",
            ["tests/training/common/test_run_state.py::test_a_run_that_is_ended_from_outside_leaves_a_whole_state"],
            (
                "nerg_mi/interruption.py",
                "        if self.asked:\n            raise KeyboardInterrupt\n        self.asked = True\n",
                "        raise KeyboardInterrupt\n",
            ),
        ),
        undo(
            "Mitsuba keeps Python's handler to itself",
            ["tests/test_interruption.py::test_python_hears_ctrl_c_after_a_picture"],
            ("plugins/nerg.py", "        give_back_ctrl_c()\n", ""),
        ),
    ),
)
