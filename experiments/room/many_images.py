"""Measures what a dataset costs before training: CPU seconds and peak memory of a run of one step, by number of images.

    JAXNERF_SCENES=... taskset -c 0 python experiments/room/many_images.py --data_dir=walk --images=302,1000,3000 \
        [--width=240] [--page=docs/results/captures.md]

More images than the dataset has are links to its own, with the same cameras. The dataset has a transforms.json.
"""

import json
import os
import pathlib
import subprocess
import sys
import tempfile

from absl import flags

sys.path.append(str(pathlib.Path(__file__).resolve().parents[1]))
import common

from jaxnerf.data import dataset
from jaxnerf.runtime import cli

HEADS = ("images", "px", "CPU seconds before training", "peak memory, MiB")
_DATA_DIR = flags.DEFINE_string("data_dir", "walk", "Folder, or a name below $JAXNERF_SCENES.")
_IMAGES = flags.DEFINE_list("images", ["302", "1000", "3000"], "Numbers of images.")
_WIDTH = flags.DEFINE_integer("width", 240, "px, of the images.", lower_bound=8)


def main(argv: list[str]) -> None:
    """Measures one program for each number of images."""
    del argv
    rows = []
    for count in map(int, _IMAGES.value):
        with tempfile.TemporaryDirectory() as folder:
            _link(dataset.dataset_folder(_DATA_DIR.value), pathlib.Path(folder), count)
            rows.append(_measure(folder, count))
    common.publish([*common.markdown(HEADS, rows), "", *common.provenance()], "many images")


def _link(source, target, count):
    """Writes a dataset of so many images, which are links."""
    content = json.loads((source / "transforms.json").read_text())
    frames = []
    for index in range(count):
        frame = content["frames"][index % len(content["frames"])]
        image = source / frame["file_path"]
        link = f"{index:05}{image.suffix}"
        (target / link).symlink_to(image.resolve())
        frames.append(frame | {"file_path": link})
    (target / "transforms.json").write_text(json.dumps(content | {"frames": frames}))


def _measure(folder, count):
    """Returns the row of a dataset; nothing is cached before."""
    options = ["--config=capture", f"--data_dir={folder}", f"--workdir={folder}/run"]
    options += [f"--config.data.width={_WIDTH.value}", "--config.train.max_steps=1", "--config.train.preview_every=0"]
    environment = os.environ | {"XDG_CACHE_HOME": f"{folder}/cache"}
    command = [sys.executable, "-m", "jaxnerf.train", *options]
    process = subprocess.Popen(command, env=environment, stdout=subprocess.DEVNULL)
    _, status, usage = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode:
        raise ValueError(f"jaxnerf-train ended with {process.returncode} on {count} images; correct what it reports")
    return f"{count:,}", str(_WIDTH.value), f"{usage.ru_utime + usage.ru_stime:.0f}", f"{usage.ru_maxrss / 2**10:,.0f}"


if __name__ == "__main__":
    cli.run(main)
