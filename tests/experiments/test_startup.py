"""The studies of startup times and silences: parsing of the output of programs, and a training that takes no step."""

import sys

import pytest

from studies import study

startup = study("speed/startup")
LINES = "steps         0 of 1 taken, 64 rays each"
ROW = '{"step": 1, "seconds": 0.1, "compile_seconds": 1.5}'
PROGRAM = """#!/bin/sh
sleep 0.2
for flag; do case $flag in --workdir=*) mkdir -p ${flag#*=}; echo '%s' > ${flag#*=}/metrics.jsonl;; esac; done
echo '%s'
exit %d
"""


@pytest.fixture
def training(tmp_path, monkeypatch):
    """Replaces training by a program that writes a row of metrics, prints some lines and exits with a code."""

    def prints(text, code):
        fake = tmp_path / "python"
        fake.write_text(PROGRAM % (ROW, text, code))
        fake.chmod(0o755)
        monkeypatch.setattr(sys, "executable", str(fake))

    return prints


def test_seconds_until_the_first_step(training, tmp_path):
    training(f"{LINES}\n1/1  8.80 dB  1,375 rays/s  0:00 elapsed, 0:00 left", 0)
    seconds, compiling = startup.start("smoke", tmp_path, 0)
    assert 0.2 <= seconds < 60 and compiling == 1.5


@pytest.mark.parametrize("text, code", [(LINES, 0), (f"{LINES}\n1/1  8.80 dB\nerror: no room", 1)])
def test_a_training_without_a_first_step_is_named(training, tmp_path, text, code):
    training(text, code)
    with pytest.raises(ValueError, match="smoke: training did not reach its first step"):
        startup.start("smoke", tmp_path, 0)


def test_the_longest_silence_is_between_two_outputs():
    silences = study("speed/silences")
    assert silences.printed("\r\x1b[Kworking 1 s\r\x1b[Kdone\r\n") == ["working 1 s", "done"]
    outputs = [(0.0, 0.0, "(start)"), (1.0, 9.0, "a|b"), (5.0, 10.0, "c"), (5.5, 11.0, "(end)")]
    assert silences.longest(outputs, cpu=True) == (4.0, 1.0, "a/b", "c")
    assert silences.longest(outputs, cpu=False) == (1.0, 9.0, "(start)", "a/b")
