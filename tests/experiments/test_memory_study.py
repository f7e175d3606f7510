"""Where the memory and the time of a training program go: samples are added up by stage."""

from studies import study

memory = study("speed/memory")


def samples(*rows):
    return [dict(zip(("stage", "seconds", "cpu", "mb"), row, strict=True)) for row in rows]


def test_samples_are_added_up_by_stage_and_named_between_stages():
    found = memory.by_stage(
        samples(
            (None, 1.0, 0.5, 100.0),
            ("reading the checkpoint", 2.0, 1.0, 300.0),
            (None, 3.0, 2.0, 200.0),
            (None, 4.0, 3.0, 250.0),
            ("saving the checkpoint", 5.0, 3.5, 400.0),
            (None, 7.0, 4.0, 150.0),
        )
    )
    assert list(found) == [
        *("start", "reading the checkpoint", "training", "saving the checkpoint", "other", "whole program")
    ]
    assert found["training"] == {"s": 2.0, "CPU s": 2.0, "MB at its end": 250.0, "peak MB": 250.0}
    assert found["whole program"] == {"s": 7.0, "CPU s": 4.0, "MB at its end": 150.0, "peak MB": 400.0}
    lines = memory.table(found, {"start": found["start"]})
    assert lines[2].split(" | ")[1:6] == ["1.0", "0.5", "100", "100", "1.0"] and lines[3].endswith("| - | - | - | - |")
