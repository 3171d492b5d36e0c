"""Options of the field for a place where nobody was tracked."""

from nerg_mi.workflows.gaze_commands import PriorOptions


def test_a_sample_is_drawn_of_datasets_alone():
    options = PriorOptions()
    assert (options.most, options.seed, options.mode) == (10_000_000, 0, "llvm_ad_rgb")
