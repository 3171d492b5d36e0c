"""Objects that are chosen by name: what is taken, what is missing, and in which order."""

from dataclasses import dataclass

import pytest

from nerg_mi.errors import NergError
from nerg_mi.transport.quadrature import Registry


@dataclass(frozen=True)
class Thing:
    name: str
    summary: str


@pytest.fixture
def things():
    made = Registry("flavour")
    for name, summary in (("sweet", "like honey"), ("bitter", "like tea")):
        made.register(Thing(name, summary))
    return made


def test01_names_come_in_the_order_of_registration(things):
    assert things.names() == ("sweet", "bitter") and [t.name for t in things] == ["sweet", "bitter"]
    assert things.find("bitter").summary == "like tea"
    assert things.manual() == "``sweet``: like honey. ``bitter``: like tea."


def test02_what_is_missing_is_said_beside_what_there_is(things):
    with pytest.raises(NergError, match='"flavour".*"sour"'):
        things.find("sour")


def test03_a_name_is_taken_once_and_can_be_given_back(things):
    again = Thing("sweet", "like sugar")
    with pytest.raises(ValueError, match='"sweet".*"flavour"'):
        things.register(again)
    things.unregister("sweet")
    assert things.register(again) is again and things.names() == ("bitter", "sweet")
    with pytest.raises(KeyError):
        things.unregister("sour")
