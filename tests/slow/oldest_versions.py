"""Runs the programs with the oldest version of each dependency that setup.cfg allows, and prints a line about each.

    python tests/slow/oldest_versions.py FOLDER

Two environments are made in FOLDER, of the oldest and of the newest jax; all other packages have their lower bounds.
It needs a registry of packages.
"""

import argparse
import configparser
import pathlib
import re
import subprocess
import sys

ROOT = pathlib.Path(__file__).resolve().parents[2]
EXTRAS = ("check", "export", "report")
EXPORT = ("--kind=points", "--num_points=50", "--num_views=1", "--size=16")


def main(out):
    for jax in ("oldest", "newest"):
        folder = pathlib.Path(out).resolve() / jax
        folder.mkdir(parents=True)
        call(sys.executable, "-m", "venv", folder / "venv")
        bounds = lower_bounds()
        pinned = [f"{name}=={version}" for name, version in bounds.items() if (name, jax) != ("jax", "newest")]
        (folder / "pinned.txt").write_text("\n".join(pinned) + "\n")
        python, run = folder / "venv" / "bin" / "python", folder / "run"
        install = ("-m", "pip", "install", "--quiet", "--constraint", folder / "pinned.txt")
        call(python, *install, f"{ROOT}[{','.join(EXTRAS)}]")
        programs = {
            "train": ("--config=smoke", "--config.train.max_steps=2", "--config.data.hold_out=4"),
            "eval": ("--uncertainty=laplace",),
            "render": ("--frames=2", "--width=16"),
            "export": EXPORT,
            "check": (f"--out={folder / 'check.png'}",),
            "report": (f"--plot={folder / 'report.svg'}",),
        }
        for program, flags in programs.items():
            where = run if program == "report" else f"--workdir={run}"
            call(python.with_name(f"jaxnerf-{program}"), where, *flags, cwd=folder)
        call(python.with_name("jaxnerf-export"), f"--workdir={run}", "--kind=mesh", "--resolution=16", cwd=folder)
        versions = call(python, "-m", "pip", "list", "--format=freeze").split()
        shown = [each for each in versions if each.partition("==")[0].lower().replace("_", "-") in bounds]
        print(f"{jax} jax: {len(programs) + 1} programs run with {', '.join(shown)}", flush=True)


def lower_bounds():
    """Returns the lowest allowed version of each package of setup.cfg that has one, extras of EXTRAS included."""
    config = configparser.ConfigParser()
    config.read(ROOT / "setup.cfg")
    texts = [config["options"]["install_requires"], *(config["options.extras_require"][name] for name in EXTRAS)]
    return dict(re.findall(r"^([\w-]+)>=([\d.]+)$", "\n".join(texts), re.MULTILINE))


def call(*command, cwd=ROOT):
    done = subprocess.run(list(map(str, command)), cwd=cwd, capture_output=True, text=True)
    assert done.returncode == 0 and "Traceback" not in done.stderr, f"{command}: {done.stdout}{done.stderr}"
    return done.stdout


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("out")
    main(**vars(parser.parse_args()))
