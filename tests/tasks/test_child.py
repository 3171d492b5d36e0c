"""The process that runs tasks, spoken to as whoever asks it does."""

import json
import subprocess
import sys

from nerg_mi.tasks.child import answer
from nerg_mi.tasks.inputs import Checksums
from tests.conftest import ROOT
from tests.tasks import works

CHILD = [sys.executable, "-m", "nerg_mi.tasks.child"]


def request(task, store):
    return {"task": task.document(), "paths": {}, "store": str(store)}


def test_answers_are_lines_and_what_tasks_print_is_elsewhere(tmp_path):
    process = subprocess.Popen(
        CHILD, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=ROOT
    )
    for task in works.tasks(2, prints=True):
        process.stdin.write(json.dumps(request(task, tmp_path)) + "\n")
        process.stdin.flush()
        found = json.loads(process.stdout.readline())
        assert found["receipt"]["key"] == task.key
    # Where nobody asks any more, it ends.
    _, said = process.communicate(timeout=30)
    assert process.returncode == 0 and said.count("in nobody's way") == 2


def test_it_ends_in_the_middle_when_nobody_waits(tmp_path):
    process = subprocess.Popen(CHILD, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True, cwd=ROOT)
    process.stdin.write(json.dumps(request(works.tasks(1, seconds=600)[0], tmp_path)) + "\n")
    process.stdin.close()
    assert process.wait(30) == 0


def test_kinds_of_errors(tmp_path):
    def said(function, **more):
        document = {**works.tasks(1)[0].document(), "function": f"tests.tasks.works:{function}", **more}
        return answer({"task": document, "paths": {}, "store": str(tmp_path)}, Checksums())

    assert said("refused") | {"trace": ""} == {
        "error": "the scene has no light; give it one",
        "kind": "mendable",
        "trace": "",
    }
    assert said("mistaken")["kind"] == "fault" and "works.py" in said("mistaken")["trace"]
    assert said("hashed", versions={"code": "other"})["kind"] == "final"
