"""Tests of messages that mention parameters."""

from __future__ import annotations

import pickle

from nerg_mi.errors import MissingFile, NergError, parameter, spell_command_line, spell_parameters


def test_parameters_are_spelled_where_a_message_is_shown():
    options = parameter("recipe", "small"), parameter("resume", True), parameter("seed")
    error = NergError(f"{parameter('test_share', 0.2)} needs {', '.join(options)}", kind="missing")
    assert str(error) == 'test_share=0.2 needs recipe="small", resume=True, seed'
    on_command_line = "--test-share 0.2 needs --recipe small, --resume, --seed"
    assert spell_parameters(error.message, spell_command_line) == on_command_line
    assert error.parameters == {"test_share": "0.2", "recipe": "small", "resume": "True", "seed": ""}
    copy = pickle.loads(pickle.dumps(error))
    assert (str(copy), copy.kind, copy.parameters) == (str(error), "missing", error.parameters)


def test_a_missing_file_mentions_parameters():
    assert str(MissingFile(f"correct {parameter('field', 'FILE')}")) == "correct field=FILE"
