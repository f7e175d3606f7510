"""Runs the commands of the README and the guides, with few steps and small images; exits with 1 if one fails.

    JAXNERF_SCENES=... PYTHONPATH=.:tests python tests/slow/commands.py

These are the lines of their blocks that train, evaluate, check, render and export, in the order of the pages, in one
empty folder; lego takes the place of every dataset. Servers, several machines, COLMAP and published weights have tests
of their own.
"""

import os
import pathlib
import shlex
import shutil
import subprocess
import sys
import tempfile
import time

from test_documents import DOCS, PROGRAMS, ROOT, fenced_lines

PAGES = [ROOT / "README.md", DOCS / "getting_started.md"]
PAGES += [DOCS / "guides" / f"{name}.md" for name in ("your_own_images", "training", "rendering", "evaluation")]
PAGES += [DOCS / "guides" / f"{name}.md" for name in ("exporting", "resuming")]
# Appended to the flags, so that they win.
SHORT = {
    "train": ["max_steps=20", "max_seconds=0", "preview_every=0"],
    "render": ["--frames=2", "--width=32"],
    "export": ["--num_views=4", "--size=32"],
}
SHORT["train"] = [f"--config.train.{field}" for field in SHORT["train"]]
SKIPPED = ("...", "HOST", "--viewer", "jaxnerf-view", "jaxnerf-cameras", "jaxnerf-convert")


def main() -> int:
    """Runs each command once; prints its seconds, and the output of those that fail."""
    lines = ["jaxnerf-train --config=quickstart --workdir=runs/demo"]  # as `make demo`, for the pages that export it
    lines += [line for page in PAGES for line in fenced_lines(page) if line.split(" ")[0] in PROGRAMS]
    failed = 0
    with tempfile.TemporaryDirectory() as folder:
        for line in dict.fromkeys(lines):
            if any(part in line for part in SKIPPED):
                continue
            started = time.perf_counter()
            done = run(line, pathlib.Path(folder))
            print(
                f"{'failed' if done.returncode else 'passed'} in {time.perf_counter() - started:3.0f} s: {line}",
                flush=True,
            )
            if done.returncode:
                failed += 1
                print(done.stdout)
    return int(failed > 0)


def run(line: str, folder: pathlib.Path) -> subprocess.CompletedProcess:
    """Runs a command line in a folder, at a small size."""
    program, *flags = shlex.split(line)
    if "=DIR" in line and not (folder / "DIR").exists():
        for kind in ("color", "gt-color"):
            shutil.copytree(next(folder.glob("runs/lego/eval/*")) / kind, folder / "DIR" / kind)
    (folder / "DIR" / "results.json").unlink(missing_ok=True)  # of an earlier command
    if "runs/fox" in line and not (folder / "runs" / "fox").exists():
        shutil.copytree(folder / "runs" / "lego", folder / "runs" / "fox")
    flags = [flag.replace("/path/to/dataset", "lego").replace("/path/to/lego", "lego") for flag in flags]
    flags = [flag.replace("--data_dir=data/lego", "--data_dir=lego") for flag in flags]
    flags = [flag.replace("--error_budget=0.002", "--error_budget=0.1") for flag in flags]  # after 20 steps all is fog
    short = SHORT.get(program.removeprefix("jaxnerf-"), [])
    if {"--kind=mesh", "--kind=points", "--kind=splats"}.intersection(flags):
        short = [*short, "--resolution=32"]
    command = [sys.executable, "-m", PROGRAMS[program], *flags, *short]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    return subprocess.run(
        command, cwd=folder, env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    )


if __name__ == "__main__":
    sys.exit(main())
