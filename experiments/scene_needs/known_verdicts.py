"""Checks the verdicts of jaxnerf-needs on captures whose needs are known before: see known_scenes.py.

    taskset -c 0 python experiments/scene_needs/known_verdicts.py --out=DIR [--only=matt,turned]
        [--seconds_a_change=120] [--trial=5] [--page=docs/results/scene_needs.md]

Runs the program on each capture, with the parts whose verdict is known, and prints a table of those verdicts, what the
program found, and whether it is right. A verdict that the program leaves open is neither right nor wrong. What DIR
holds of an earlier start is not repeated.
"""

import pathlib
import sys
from typing import Any, NamedTuple

from absl import flags

sys.path += [str(folder) for folder in pathlib.Path(__file__).resolve().parents[:2]]
import common
import known_scenes
from program import run_program

from jaxnerf.runtime import cli

OPEN = "cannot tell"
# For images of 48 px; the table of `capture` is as large as those of 400 px need, and slow.
SMALL = ("--config=capture", "--config.hash_grid.table_size=16384", "--config.train.cpu_batch_size=512", "--nolean")
HEADS = ("capture", "part, change", "known", "because", "contributes, dB", "found", "")

_OUT = flags.DEFINE_string("out", None, "Folder of the captures and of all trials.", required=True)
_ONLY = flags.DEFINE_list("only", list(known_scenes.SCENES), "Captures.")
_TRIAL = flags.DEFINE_float("trial", 5.0, "Seconds of training of each trial.")
_SECONDS = flags.DEFINE_float(
    "seconds_a_change", 120.0, "Budget of the program: for the complete model and each change."
)


class Verdict(NamedTuple):
    """A verdict of the program beside the known one.

    Attributes:
        scene: name of the capture.
        change: part and change.
        known: verdict.
        reason: of the known verdict.
        found: verdict; "cannot tell" is open.
        effect: {"mean", "lower", "upper"} in dB; None where the program did not try it.
    """

    scene: str
    change: str
    known: str
    reason: str
    found: str
    effect: dict[str, float] | None

    @property
    def title(self) -> str:
        """Returns the capture's name, with what is special about it."""
        return f"{self.scene}: {known_scenes.SCENES[self.scene].about}"

    @property
    def grade(self) -> str:
        """Returns "right", "open" or "WRONG"."""
        return "open" if self.found == OPEN else "right" if self.found == self.known else "WRONG"


def main(argv: list[str]) -> None:
    """Runs the program on the captures and prints the table."""
    del argv
    out, verdicts = pathlib.Path(_OUT.value), []
    for name in common.chosen("--only", _ONLY.value, list(known_scenes.SCENES)):
        known = known_scenes.SCENES[name]
        capture = known_scenes.write(known, out / "captures" / name)
        parts = dict.fromkeys(change.rpartition(",")[0] for change in known.verdicts)
        budget = f"{_SECONDS.value * (1 + len(known.verdicts)):.0f}s"
        results = run_program(
            capture, out / "needs" / name, budget, *SMALL, f"--seconds={_TRIAL.value}", f"--parts={','.join(parts)}"
        )
        verdicts += compared(name, known, results)
        common.publish([*table(verdicts), "", *common.provenance()], "known")


def compared(name: str, known: known_scenes.Known, results: dict[str, Any]) -> list[Verdict]:
    """Returns the verdicts of one capture.

    Raises:
        ValueError: if the program has no such part.
    """
    found = {f"{row['part']}, {row['change']}": row for row in results["parts"]}
    missing = sorted(known.verdicts.keys() - found.keys())
    if missing:
        raise ValueError(f"{name}: the program has no row {missing[0]!r}, expected one of {sorted(found)}")
    return [
        Verdict(name, change, verdict, reason, found[change]["verdict"], found[change]["effect"])
        for change, (verdict, reason) in known.verdicts.items()
    ]


def table(verdicts: list[Verdict]) -> list[str]:
    """Returns the lines of the table, with the number of right verdicts."""
    grades = [each.grade for each in verdicts]
    counts = (
        f"{grades.count('right')} of {len(grades)} right, {grades.count('open')} open, {grades.count('WRONG')} wrong"
    )
    rows = [
        (each.title, each.change, each.known, each.reason, interval(each.effect), each.found, each.grade)
        for each in verdicts
    ]
    return [f"{counts}.", "", *common.markdown(HEADS, rows)]


def interval(effect: dict[str, float] | None) -> str:
    """Returns an effect in words."""
    if effect is None:
        return "-"
    ends = "" if effect["lower"] is None else f" ({effect['lower']:+.2f} to {effect['upper']:+.2f})"
    return f"{effect['mean']:+.2f}{ends}"


if __name__ == "__main__":
    cli.run(main, stopped="the same command continues")
