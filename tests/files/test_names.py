"""Tests of nerg_mi.files.names."""

import pytest

from nerg_mi.files.names import make_portable_name, make_portable_names


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("anna", "anna"),
        ("P 01.b", "P 01.b"),
        ("Jo\u0308rg", "J\u00f6rg"),
        ('a<b>c:d"e/f\\g|h?i*j', "a_b_c_d_e_f_g_h_i_j"),
        ("a\nb\x1b", "a_b_"),
        ("shelf. ", "shelf__"),
        ("..", "__"),
        ("", "_"),
        ("CON", "_CON"),
        ("nul.txt", "_nul.txt"),
        ("com1", "_com1"),
        ("LPT³.a.b", "_LPT³.a.b"),
        ("console", "console"),
        ("com10", "com10"),
    ],
)
def test_portable_names(name, expected):
    assert make_portable_name(name) == expected


def test_long_names_are_cut_between_characters():
    name = make_portable_name("ä" * 300)
    assert set(name) == {"ä"} and len(name.encode()) <= 200


def test_portable_names_differ():
    assert make_portable_names(["a:b", "A?b", "a*b", "c"]) == ["a_b", "A_b-2", "a_b-3", "c"]
