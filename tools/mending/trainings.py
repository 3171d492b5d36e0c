"""Mendings of trainings, and of what is made of their fields."""

from __future__ import annotations

from .reversal import held, undo

_SPEED = "tests/training/radiance/test_machine_speed.py::"
_TRAINER = "nerg_mi/training/radiance/trainer.py"
_VERDICT = "tests/training/radiance/test_verdict.py::"
_SCORES = "nerg_mi/evaluation/gaze/scores.py"

MENDINGS = (
    held(
        "A training of so many steps does not depend on the machine's speed, no step is beyond its bound, and nothing "
        "is compiled on the way",
        undo(
            "the share that is done is one of seconds",
            [
                _SPEED + "test_a_run_by_steps_does_not_see_the_clock",
                _SPEED + "test_a_run_by_minutes_is_the_run_of_as_many_steps",
            ],
            (
                _TRAINER,
                "        return min(1.0, self.steps / s.steps if s.steps is not None else",
                "        return min(1.0, self.seconds / (0.02 * s.steps) if s.steps is not None else",
            ),
        ),
        undo(
            "the density pass takes all steps of its rays",
            [_SPEED + "test_no_pass_of_a_run_is_larger_than_its_bound"],
            (
                _TRAINER,
                "s.stop, s.batch, thinning, most, with_features=True",
                "s.stop, s.batch, thinning, None, with_features=True",
            ),
            (
                _TRAINER,
                "affordable_rays(self.rays, self.looked, table.steps, most, _CANDIDATES * s.batch)\n",
                "self.rays\n",
            ),
        ),
        undo(
            "one step alone is compiled before the clock starts",
            ["tests/training/radiance/test_warm_up.py::test_nothing_is_compiled_in_a_run"],
            ("nerg_mi/training/radiance/warm_up.py", "for before in (3, 7, every):", "for before in (3,):"),
            ("nerg_mi/training/radiance/warm_up.py", "for before in (every, every + 1):", "for before in ():"),
        ),
        undo(
            "random numbers lie where memory happens to begin, for each of which kernels are compiled",
            ["tests/training/radiance/test_warm_up.py::test_nothing_is_compiled_in_a_run"],
            ("nerg_mi/field/backend.py", "    start = -memory.ctypes.data % 64\n", "    start = 0\n"),
        ),
    ),
    held(
        "A run that ends below what it promised says so",
        undo(
            "a fall is not told",
            [_VERDICT + "test_a_fall_below_an_earlier_look_is_named_with_its_numbers"],
            ("nerg_mi/training/radiance/verdict.py", "        if fall > _FALL:\n", "        if fall > 100 * _FALL:\n"),
        ),
        undo(
            "few steps are not told",
            [_VERDICT + "test_few_steps_are_named_with_the_machine_s_rate"],
            ("nerg_mi/training/radiance/verdict.py", "    if steps < _FEW_STEPS:\n", "    if steps < 1:\n"),
        ),
    ),
    held(
        "Semantic features are the same in training and rendering",
        undo(
            "they are cut off where the picture's colours are",
            ["tests/training/gaze/test_semantics.py::test_features_of_training_are_those_of_rendering"],
            (
                "nerg_mi/transport/features.py",
                "    settings = replace(settings, color_cutoff=MarchSettings.color_cutoff)\n",
                "",
            ),
        ),
    ),
    held(
        "An ensemble goes on only as what it was, its architecture included",
        undo(
            "members that are there are taken unseen",
            ["tests/training/gaze/test_ensemble.py::test_members_of_another_run_are_refused"],
            ("nerg_mi/training/gaze/ensemble.py", '    require_same(part, kept["about"], identity)\n', ""),
        ),
        undo(
            "architectures are not compared",
            [
                "tests/training/gaze/test_ensemble.py::test_members_of_another_run_are_refused[change0-architecture]",
                "tests/training/gaze/test_ensemble.py::test_members_of_another_run_are_refused[change1-architecture]",
            ],
            ("nerg_mi/training/gaze/plan.py", '            "architecture": self.config.to_dict(),\n', ""),
        ),
    ),
    held(
        "Hit points through windows make a place at the defaults",
        undo(
            "the box holds all hit points",
            [
                "tests/training/geometry/test_hit_extent.py::test_the_box_of_an_office_is_the_room",
                "tests/training/geometry/test_hit_extent.py::test_depths_in_an_office",
            ],
            (
                "nerg_mi/training/geometry/hit_extent.py",
                "    core = np.clip(core, low, high)\n",
                "    core = np.stack([low, high])\n",
            ),
        ),
        undo(
            "what is beyond the box stands nowhere",
            ["tests/training/geometry/test_hit_extent.py::test_depths_in_an_office"],
            (
                "nerg_mi/training/geometry/hit_geometry.py",
                "        hits[far] = _on_shell(origins[far], hits[far], extent)\n",
                "        hits[far] = np.nan\n",
            ),
        ),
    ),
    held(
        "What is evaluated is what is rendered, with its integral, at each position its own",
        undo(
            "the evaluation integrates in 64 directions",
            ["tests/evaluation/gaze/test_scores.py::test01_is_what_is_rendered"],
            (_SCORES, "surface_opacity=SURFACE_OPACITY)", "surface_opacity=SURFACE_OPACITY, directions=64)"),
        ),
        undo(
            "the first integral serves all positions",
            ["tests/evaluation/gaze/test_scores.py::test02_other_positions_have_integrals_of_their_own"],
            (
                _SCORES,
                "p_o, key = mi.Point3f(*position.tolist()), position.tobytes()",
                'p_o, key = mi.Point3f(*position.tolist()), b""',
            ),
        ),
        undo(
            "the alignment scales directions",
            ["tests/evaluation/gaze/test_scores.py::test03_alignment_moves_turns_and_scales"],
            (_SCORES, "@ (align.matrix[:3, :3] / align.scale).T", "@ align.matrix[:3, :3].T"),
        ),
    ),
    held(
        "Normalised gaze fields can be studied",
        undo(
            "the reference of shapes does not know the observer",
            ["tests/evaluation/study/test_gaze.py::test03_the_study_of_a_default_recipe[shapes]"],
            (
                "nerg_mi/evaluation/study/shapes.py",
                "integrator.gaze.at([mi.Point3f(*p_o.tolist())], place, integrator.observer_settings)",
                "ObservedGaze(integrator.gaze, place, integrator.observer_settings, [])",
            ),
        ),
        undo(
            "the paper's marching does not know the observer",
            ["tests/evaluation/study/test_gaze.py::test03_the_study_of_a_default_recipe[medium]"],
            (
                "nerg_mi/evaluation/study/paper.py",
                "like.gaze.at([p_o], place, like.observer_settings, like.cache)",
                "like.gaze.at([], place, like.observer_settings, like.cache)",
            ),
        ),
    ),
    held(
        "torch evaluates fields of the default recipe",
        undo(
            "densities are not divided by their integral",
            ["tests/interop/test_torch.py::test04b_a_normalised_gaze_field"],
            ("nerg_mi/interop/torch.py", "integral=e.x, escaped=e.y > 0.5)[0]", "escaped=e.y > 0.5)[0]"),
        ),
        undo(
            "directions that meet nothing are taken for surfaces",
            ["tests/interop/test_torch.py::test04b_a_normalised_gaze_field"],
            (
                "nerg_mi/interop/torch.py",
                "field.unnormalized(p, o, r, escaped=e.y > 0.5)",
                "field.unnormalized(p, o, r)",
            ),
        ),
    ),
)
