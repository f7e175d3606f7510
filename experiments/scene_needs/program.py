"""Runs jaxnerf-needs, for the studies of this folder."""

import pathlib
import subprocess
import sys
from typing import Any

import common


def run_program(dataset: pathlib.Path | str, folder: pathlib.Path, budget: str, *arguments: str) -> dict[str, Any]:
    """Runs jaxnerf-needs, or continues it, and returns its results."""
    if not (folder / "results.json").exists():
        folder.parent.mkdir(parents=True, exist_ok=True)
        program = [sys.executable, "-m", "jaxnerf.tools.needs.program"]
        options = [f"--data_dir={dataset}", f"--out={folder}", f"--budget={budget}", *arguments]
        code = subprocess.run([*program, *options], check=False).returncode
        if code:
            raise SystemExit(code)  # the program has said why
    return common.read_json(folder / "results.json")
