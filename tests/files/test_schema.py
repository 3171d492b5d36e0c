"""Schemas of JSON documents: what has another structure is named by its key, with its value."""

from __future__ import annotations

import pytest

from nerg_mi.files.schema import INDEX, NUMBER, Items, Names, Number, check_json

SCHEMA = {
    "name": str,
    "size": Items(Number(0, 10), 2, 3),
    "parts?": Names({"index": INDEX, "is_used?": bool, "weights?": Items(NUMBER)}),
}
VALID = {"name": "a", "size": [1, 2.5], "parts": {"x": {"index": 3}}, "more": None}


def test_valid_document_is_returned():
    assert check_json(VALID, SCHEMA) is VALID
    assert check_json({"name": "a", "size": [0, 10, 1]}, SCHEMA)


@pytest.mark.parametrize(
    "change, words",
    [
        ([], ("document", "list")),
        ({"name": None}, ("name", "null")),
        ({"name": 3}, ("name", "3")),
        ({"size": None}, ("size", "null")),
        ({"size": [1]}, ("size", "2 to 3", "list of 1")),
        ({"size": [1, 2, 3, 4]}, ("size", "list of 4")),
        ({"size": [1, 11]}, ("size[1]", "0 to 10", "11")),
        ({"size": [1, float("nan")]}, ("size[1]", "nan")),
        ({"size": [1, float("inf")]}, ("size[1]", "inf")),
        ({"size": [1, True]}, ("size[1]", "true")),
        ({"size": [1, "2"]}, ("size[1]", '"2"')),
        ({"size": {}}, ("size", "object")),
        ({"parts": []}, ("parts", "list")),
        ({"parts": {"x": 1}}, ("parts.x", "1")),
        ({"parts": {"x": {}}}, ("lacks", "parts.x.index")),
        ({"parts": {"x": {"index": -1}}}, ("parts.x.index", "whole number", "-1")),
        ({"parts": {"x": {"index": 1.5}}}, ("parts.x.index", "1.5")),
        ({"parts": {"x": {"index": 10**400}}}, ("parts.x.index",)),
        ({"parts": {"x": {"index": 1, "is_used": 1}}}, ("parts.x.is_used", "true or false")),
        ({"parts": {"x": {"index": 1, "weights": [0, "a\x1b" * 99]}}}, ("parts.x.weights[1]", "...")),
    ],
)
def test_first_difference_is_named(change, words):
    value = change if isinstance(change, list) else VALID | change
    with pytest.raises(ValueError) as error:
        check_json(value, SCHEMA)
    assert all(word in str(error.value) for word in words) and str(error.value).isprintable()


@pytest.mark.parametrize("key", ["name", "size"])
def test_missing_key_is_named(key):
    with pytest.raises(ValueError, match=f'lacks "{key}"'):
        check_json({k: v for k, v in VALID.items() if k != key}, SCHEMA)
