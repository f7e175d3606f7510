"""Compares the cameras of two datasets with the same images, in groups of successive images.

    JAXNERF_SCENES=... python experiments/pose_estimation/compare_cameras.py --first=can --second=can_reposed \
        [--groups=0000,0014,0035,0053] [--page=docs/results/captures.md]

For each group a similarity maps the first cameras' positions onto the second ones' with the least squared distance
(Umeyama 1991). What remains is how well the group agrees with the other cameras; how far its similarity is turned from
that of the first group is how far the groups contradict each other.
"""

import pathlib
import sys

import numpy as np
from absl import flags
from jaxtyping import Float

sys.path.append(str(pathlib.Path(__file__).resolve().parents[1]))
import common
from pose_estimation.pose_errors import errors, similarity

from jaxnerf.data.dataset import dataset_folder
from jaxnerf.data.readers.base import read_capture
from jaxnerf.runtime import cli

HEADS = ("images", "rotations, degrees", "positions, % of their spread", "turned against the first group, degrees")

_FIRST = flags.DEFINE_string("first", "can", "Folder of a dataset.")
_SECOND = flags.DEFINE_string("second", "can_reposed", "Folder of a dataset with the same images and better cameras.")
_GROUPS = flags.DEFINE_list("groups", [], "Names of the images with which groups begin.")
_TABLE = flags.DEFINE_string("table", "groups", "Name of the table in the marks of --page.")


def main(argv: list[str]) -> None:
    """Prints the table."""
    del argv
    first, second = (_poses(flag.value) for flag in (_FIRST, _SECOND))
    names = sorted(first.keys() & second.keys())
    starts = [names.index(name) for name in _GROUPS.value] or [0]
    stacks = (np.array([poses[name] for name in names]) for poses in (first, second))
    common.publish([*common.markdown(HEADS, rows(names, *stacks, starts)), "", *common.provenance()], _TABLE.value)


def rows(
    names: list[str], first: Float[np.ndarray, "V 3 4"], second: Float[np.ndarray, "V 3 4"], starts: list[int]
) -> list[tuple[str, ...]]:
    """Returns the cells of a row for all cameras, and for each group that begins at one of the starts."""
    groups = [slice(0, len(names)), *map(slice, starts, [*starts[1:], len(names)])]
    found, turns = [], []
    for group in groups if len(starts) > 1 else groups[:1]:
        one, other = first[group], second[group]
        degrees, moved = errors(one, other)
        spread = np.sqrt(((other[:, :, 3] - other[:, :, 3].mean(axis=0)) ** 2).sum(axis=1).mean())
        turns.append(similarity(one[:, :, 3], other[:, :, 3]).turn)
        against = "-" if len(turns) < 2 else f"{angle(turns[1].T @ turns[-1]):.0f}"
        label = "all" if len(turns) == 1 else f"{names[group][0]} to {names[group][-1]}"
        found.append((f"{label} ({len(one)})", f"{degrees:.2f}", f"{100 * moved / spread:.1f}", against))
    return found


def angle(turn: Float[np.ndarray, "3 3"]) -> float:
    """Returns the angle of a rotation, degrees."""
    return float(np.degrees(np.arccos(np.clip((np.trace(turn) - 1) / 2, -1, 1))))


def _poses(folder):
    frames = read_capture(dataset_folder(folder)).frames
    return {pathlib.Path(frame.name).stem: np.asarray(frame.camera.to_world, np.float64) for frame in frames}


if __name__ == "__main__":
    cli.run(main)
