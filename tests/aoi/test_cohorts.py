"""Cohorts of people from a table."""

from __future__ import annotations

import pytest

from nerg_mi.aoi.scene import read_cohorts
from nerg_mi.errors import NergError
from nerg_mi.files.tables import write_csv


def test01_read(tmp_path):
    (tmp_path / "c.csv").write_text("cohort;person\nold;Ada\nyoung;Bo\nold;Ada\n")
    assert read_cohorts(tmp_path / "c.csv") == {"Ada": "old", "Bo": "young"}


def test_names_come_back_as_they_were_written(tmp_path):
    cohorts = {"=Ada": "-old", "@Bo": "+young", "'Cy": "old", "'=Di": "-1"}
    write_csv(tmp_path / "c.csv", [{"person": k, "cohort": v} for k, v in cohorts.items()])
    assert read_cohorts(tmp_path / "c.csv") == cohorts


@pytest.mark.parametrize(
    "text", ["person,cohort\n", "person,group\nAda,old\n", "person,cohort\nAda,old\nAda,young\n", ""]
)
def test02_refused(tmp_path, text):
    (tmp_path / "c.csv").write_text(text)
    with pytest.raises(NergError, match=r"c\.csv"):
        read_cohorts(tmp_path / "c.csv")
