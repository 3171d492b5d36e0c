"""Checkpoints of other programs by jobs: the fields themselves, with and without files."""

import pytest

from nerg_mi.workflows.export import import_checkpoint
from nerg_mi.workflows.radiance_commands import CheckpointImportOptions
from tests.formats.torch_ngp.test_fields import small_state
from tests.formats.torch_ngp.test_nerg import save, small_gaze
from tests.workflows.recorder import Recorder

pytestmark = pytest.mark.usefixtures("torch")


def test_fields_without_any_file(tmp_path):
    path, told = save(tmp_path / "nerg.pth", small_gaze(), nerf=small_state()), Recorder()
    found = import_checkpoint(path, reporter=told)
    assert found.field is not None and found.gaze.config.variant == "emit_capture" and found.files == []
    assert [p.name for p in tmp_path.iterdir()] == ["nerg.pth"]
    assert told.messages == [f'"{path}" also holds a gaze field: --gaze NAME.safetensors writes it']


def test_files_in_their_order(tmp_path):
    path = save(tmp_path / "nerg.pth", small_gaze(), nerf=small_state())
    outputs = tmp_path / "f.safetensors", tmp_path / "g.safetensors"
    found = import_checkpoint(path, *outputs, CheckpointImportOptions(half=True))
    assert tuple(found.files) == outputs and all(p.is_file() for p in outputs)
