"""Executes the notebooks of examples/notebooks and reports seconds and file sizes; exits with 1 if a cell fails.

    python tests/slow/notebooks.py [--write] [NAME ...]

--write stores the outputs in the files, without execution counts of earlier runs. Needs the extra `notebooks`.
"""

import argparse
import pathlib
import sys
import time

import nbformat
from nbclient import NotebookClient
from nbclient.exceptions import CellExecutionError

from jaxnerf.runtime.atomic_files import write_text

FOLDER = pathlib.Path(__file__).resolve().parents[2] / "examples" / "notebooks"
LARGEST = 500_000  # bytes of a notebook with its outputs


def main() -> int:
    """Executes the notebooks in turn."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("names", nargs="*", help="Notebooks, without .ipynb; all when not given.")
    parser.add_argument("--write", action="store_true", help="Store the outputs.")
    flags = parser.parse_args()
    failed = 0
    for path in sorted(FOLDER.glob("*.ipynb")):
        if flags.names and path.stem not in flags.names:
            continue
        notebook, started = nbformat.read(path, as_version=4), time.perf_counter()
        try:
            NotebookClient(notebook, timeout=600, record_timing=False).execute(cwd=str(FOLDER))
        except CellExecutionError as error:
            failed += 1
            print(f"{path.name}: failed\n{error}")
            continue
        text = nbformat.writes(notebook) + "\n"
        good = len(text) <= LARGEST
        failed += not good
        seconds = time.perf_counter() - started
        print(f"{path.name}: {seconds:.0f} s, {len(text):,} bytes" + ("" if good else ", too large"))
        if flags.write:
            write_text(path, text)
    return int(failed > 0)


if __name__ == "__main__":
    sys.exit(main())
