"""Mendings of errors, of the checkout and of its pages."""

from __future__ import annotations

from .reversal import held, undo

MENDINGS = (
    held(
        "What the user can mend is one sentence; a mistake in the program is shown as one",
        undo(
            "a wrong expression is the library's error",
            ["tests/cli/test_mendable.py::test02_other_commands"],
            ("nerg_mi/jobs/study.py", "    except re.error as error:\n", "    except FileNotFoundError as error:\n"),
        ),
        undo(
            "what options feed into a contract is refused as the contract's",
            ["tests/cli/test_mendable.py::test01_training_of_gaze"],
            (
                "nerg_mi/errors.py",
                "        raise NergError(f\"{str(error).rstrip('.')}; give other values by {options}\") from error\n",
                "        raise\n",
            ),
        ),
        undo(
            "a place whose scene is missing is Mitsuba's error",
            ["tests/rendering/test_scene_file.py::test_the_other_ways_in_are_guarded"],
            (
                "nerg_mi/training/geometry/places.py",
                "    scene = load_scene(path)\n",
                "    import mitsuba as mi\n\n    from nerg_mi.rendering.scene_file import check_scene_file\n\n"
                "    if path.is_file():\n        check_scene_file(path)\n    scene = mi.load_file(str(path))\n",
            ),
        ),
        undo(
            "every ValueError is the user's",
            ["tests/cli/test_main.py::test07_a_mistake_in_the_program_is_shown_as_one"],
            (
                "nerg_mi/errors.py",
                "return isinstance(error, (NergError, MemoryError))",
                "return isinstance(error, (ValueError, MemoryError))",
            ),
        ),
    ),
    held(
        "A checkout works without installation, and libLLVM is chosen before Mitsuba is loaded",
        undo(
            "an installation alone has plugins and scenes",
            ["tests/test_checkout.py::test01_plugins_and_scenes_are_found"],
            ("nerg_mi/checkout.py", "        sys.meta_path.append(Beside(package, folder.parent))\n", "        pass\n"),
        ),
        undo(
            "a benchmark loads Mitsuba first",
            ["tests/benchmarks/test_imports.py::test01_libllvm_is_chosen_first[benchmarks/gradients_memory.py]"],
            (
                "benchmarks/gradients_memory.py",
                "import nerg_mi  # noqa: F401  (chooses the libLLVM, so it comes before drjit)\n",
                "import mitsuba as mi\n",
            ),
        ),
    ),
    held(
        "NumPy 1.26 is enough",
        undo(
            "a function of NumPy 2 is used",
            ["tests/test_release.py::test_nothing_is_used_that_the_oldest_numpy_lacks"],
            ("nerg_mi/evaluation/saliency.py", "= trapezoid(", "= np.trapezoid("),
        ),
    ),
    held(
        "Pages say what the code does",
        undo(
            "a default of the march changes",
            ["tests/test_docs.py::test03_defaults_of_the_march_are_the_integrators"],
            (
                "plugins/nerg_properties.py",
                'number(props, "stop", default_stop(medium), low=0, high=1)',
                'number(props, "stop", 1e-2, low=0, high=1)',
            ),
        ),
        undo(
            "a recipe changes without `make docs`",
            ["tests/tools/test_generated.py::test_every_page_is_up_to_date"],
            (
                "nerg_mi/training/gaze/recipes.py",
                '            "weight_decay": 4.0,\n',
                '            "weight_decay": 3.0,\n',
            ),
        ),
        undo(
            "a page counts the directions of an integral as they once were",
            ["tests/test_docs.py::test05_numbers_that_are_constants"],
            ("docs/gaze-evaluation.md", "a sum over 131,072 directions", "a sum over 2,048 directions"),
        ),
        undo(
            "a page names an option that is gone",
            ["tests/test_docs.py::test01_options_that_are_named_exist[radiance-training.md]"],
            ("docs/radiance-training.md", "16 rays a pixel (`--spp`)", "16 rays a pixel (`--samples-a-pixel`)"),
        ),
    ),
)
