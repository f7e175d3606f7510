"""The table of measured results, from the results.json files under workdirs.

    python experiments/table.py WORKDIR ... [--readme=README.md] [--table=results]

Prints one row a scored checkpoint. With --readme the table in that file between the lines
<!-- results --> and <!-- end of results --> is replaced; --table is the word there.
"""

import json
import pathlib

from absl import flags

from jaxnerf.runtime import cli
from jaxnerf.training.workdir import write_text

_README = flags.DEFINE_string("readme", None, "File whose table is replaced.")
_TABLE = flags.DEFINE_string("table", "results", "Which table of that file.")
MARKS = ("<!-- results -->", "<!-- end of results -->")
HEADS = ("run", "step", "training", "compiling", "PSNR", "SSIM", "views", "parameters")


def main(argv):
    """Prints the table of the workdirs named on the command line."""
    paths = sorted(path for folder in argv[1:] for path in pathlib.Path(folder).glob("eval/*/results.json"))
    if not paths:
        raise ValueError(f"{argv[1:]}: no eval/*/results.json; run python -m jaxnerf.eval --workdir=... first")
    rows = [row(path) for path in sorted(paths, key=lambda path: (path.parts[:-2], int_prefix(path)))]
    lines = markdown(HEADS, rows)
    print("\n".join(lines))
    if _README.value:
        marks = f"<!-- {_TABLE.value} -->", f"<!-- end of {_TABLE.value} -->"
        replace(pathlib.Path(_README.value), lines, marks)


def row(path):
    """Returns the cells of one results.json."""
    results = json.loads(path.read_text())
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


def int_prefix(path):
    return int(path.parent.name.split("-")[0])


def markdown(heads, rows):
    """Returns the lines of a table."""
    return ["| " + " | ".join(cells) + " |" for cells in (heads, ["---"] * len(heads), *rows)]


def replace(readme, lines, marks=MARKS):
    """Replaces what lies between the marks of a file."""
    text = readme.read_text()
    if any(mark not in text for mark in marks):
        raise ValueError(f"{readme}: lacks the lines {marks}; add them where the table shall stand")
    head, rest = text.split(marks[0], 1)
    tail = rest.split(marks[1], 1)[1]
    write_text(readme, head + marks[0] + "\n" + "\n".join(lines) + "\n" + marks[1] + tail)


if __name__ == "__main__":
    cli.run(main, positional=True)
