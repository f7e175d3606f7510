"""Prints the table of measured results, from the results.json files under workdirs.

    python experiments/results/table.py WORKDIR ... [--page=FILE.md] [--table=results]

Prints one row per scored checkpoint. With --page the table in that file between the lines <!-- results --> and
<!-- end of results --> is replaced; --table is the word in these marks.
"""

import pathlib
import sys

from absl import flags

sys.path.append(str(pathlib.Path(__file__).resolve().parents[1]))
import common

from jaxnerf.runtime import cli
from jaxnerf.runtime.atomic_files import read_json

HEADS = ("run", "step", "training", "compiling", "PSNR", "SSIM", "views", "parameters")


def main(argv: list[str]) -> None:
    """Prints the table of the workdirs named on the command line."""
    rows = [row(path) for folder in sorted(argv[1:]) for path in scored(pathlib.Path(folder))]
    if not rows:
        raise ValueError(f"{argv[1:]}: no eval/*/results.json; run python -m jaxnerf.eval --workdir=... first")
    common.publish(common.markdown(HEADS, rows), flags.FLAGS.table)


def scored(folder: pathlib.Path) -> list[pathlib.Path]:
    """Returns the paths of a workdir's results.json files, by ascending step."""
    paths = [path for path in folder.glob("eval/*/results.json") if path.parent.name.split("-")[0].isdigit()]
    return sorted(paths, key=lambda path: (int(path.parent.name.split("-")[0]), path.parent.name))


def row(path: pathlib.Path) -> tuple[str, ...]:
    """Returns the cells of one results.json."""
    results = read_json(path, "score it again")
    run = path.parts[-4] + ("" if path.parent.name.isdigit() else f" ({path.parent.name.split('-')[1]})")
    return (
        run,
        f"{results['step']:,}",
        f"{results['training_seconds'] / 60:.1f} min",
        f"{results['compile_seconds']:.0f} s",
        f"{results['psnr']:.2f} dB",
        f"{results['ssim']:.3f}",
        str(results["views"]),
        f"{results['parameters']:,}",
    )


if __name__ == "__main__":
    flags.DEFINE_string("table", "results", "Name of the table in the marks of that file.")
    cli.run(main, positional=True)
