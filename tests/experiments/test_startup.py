"""The study of starts: what it takes from a training's lines, and a training that never takes a step."""

import sys

import pytest

from studies import study

startup = study("startup")
LINES = """
precision   parameters float32; compiled in 1.5 s
steps       0 of 1 taken, 64 rays each
"""


@pytest.fixture
def training(tmp_path, monkeypatch):
    """Makes trainings say some lines and end with a code."""

    def says(text, code):
        fake = tmp_path / "python"
        fake.write_text(f"#!/bin/sh\nsleep 0.2\ncat <<EOF\n{text}\nEOF\nexit {code}\n")
        fake.chmod(0o755)
        monkeypatch.setattr(sys, "executable", str(fake))

    return says


def test_seconds_until_the_first_step(training, tmp_path):
    training(f"{LINES}1/1  8.80 dB  1,375 rays/s  0:00 done, 0:00 left", 0)
    seconds, compiling = startup.start("smoke", tmp_path, 0)
    assert 0.2 <= seconds < 60 and compiling == 1.5


@pytest.mark.parametrize("text, code", [(LINES, 0), (f"{LINES}1/1  8.80 dB\nerror: no room", 1)])
def test_a_training_without_a_first_step_is_named(training, tmp_path, text, code):
    training(text, code)
    with pytest.raises(ValueError, match="smoke: training did not come to its first step"):
        startup.start("smoke", tmp_path, 0)
