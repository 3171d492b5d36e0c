"""What is minded while a function is recorded: that it is, and that garbage waits until it is over."""

import gc
from types import SimpleNamespace

import drjit as dr

from nerg_mi.transport.jit import no_collection, recording


def test01_it_is_known_while_a_function_is_recorded(rgb):
    seen = []
    # A list that it refers to would be an input, whose length differs from call to call.
    note = SimpleNamespace(of=seen.append)

    @dr.freeze
    def twice(x):
        note.of(recording())
        return 2 * x

    assert not recording()
    for value in (1, 2, 3, 4):
        assert twice(dr.opaque(rgb.Float, value, 16))[0] == 2 * value
    # Later calls replay.
    assert seen == [True] and not recording()


def test02_garbage_is_collected_as_usual_otherwise():
    assert gc.isenabled()
    with no_collection():
        assert gc.isenabled()
    assert gc.isenabled()


def test03_garbage_waits_while_a_function_is_recorded(rgb):
    seen = []

    @dr.freeze
    def add(x):
        with no_collection():
            seen.append(gc.isenabled())
        seen.append(gc.isenabled())
        return x + 1

    assert add(rgb.Float([1, 2]))[1] == 3
    assert seen == [False, True] and gc.isenabled()


def test04_who_had_switched_it_off_finds_it_off(rgb):
    seen = []

    @dr.freeze
    def add(x):
        with no_collection():
            pass
        seen.append(gc.isenabled())
        return x + 1

    gc.disable()
    try:
        add(rgb.Float([1, 2]))
        assert seen == [False] and not gc.isenabled()
    finally:
        gc.enable()
