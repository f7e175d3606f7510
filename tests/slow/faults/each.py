"""Provokes each fault on real processes and disks, and prints a line about its outcome.

    sudo python tests/slow/faults/each.py --out=FOLDER

Root mounts the disks that become full or read-only.
"""

import argparse
import contextlib
import logging
import os
import pathlib
import random
import shutil
import signal
import subprocess
import sys
import time

import jax
import numpy as np

ROOT = pathlib.Path(__file__).resolve().parents[3]
sys.path[:0] = [str(ROOT), str(ROOT / "tests")]

from jaxnerf.training import auto_config, build, workdir  # noqa: E402
from jaxnerf.training.checkpoint import Checkpoints  # noqa: E402
from jaxnerf.training.metric_log import read_rows  # noqa: E402
from jaxnerf.training.state import create_state  # noqa: E402
from runs import PACKED, as_flags, free_port, module_of  # noqa: E402

OPTIONS = {"save_every": 10, "log_every": 1, "max_to_keep": 1000}
TRAIN = ("--config=configs/smoke.py", *(f"--config.train.{name}={value}" for name, value in OPTIONS.items()))
FOREVER = (*TRAIN, "--config.train.max_steps=1000000")
# Programs of a trained run: flags, and where the run has what they write.
VIEWS = ("--num_views=2", "--size=16")
PROGRAMS = {
    "eval": ("eval", (), "eval/20"),
    "render": ("render", ("--frames=3", "--width=16", "--video=gif"), "renders/turntable-20"),
    "mesh": ("export", ("--kind=mesh", "--format=glb", "--resolution=24", "--texture=512", *VIEWS), "exports/mesh-20"),
    "points": ("export", ("--kind=points", "--num_points=500", *VIEWS), "exports/points-20"),
    "depth": ("export", ("--kind=depth", *VIEWS), "exports/depth-20"),
    "splats": ("export", ("--kind=splats", "--num_points=500", "--fit_steps=2", *VIEWS), "exports/splats-20"),
    "web": ("export", ("--kind=web",), "exports/web-20"),
    "next": ("check", (), "camera_paths"),
}
FREE = (0, 2**14, 2**17)  # bytes


def main(out, only=""):
    out = pathlib.Path(out)
    out.mkdir(parents=True)
    logging.disable()  # orbax logs each file that it cannot read
    faults = (damage, second, signals, full_disk, read_only, full_disks, kills, devices, hangs)
    for fault in [fault for fault in faults if only in ("", fault.__name__)]:
        for line in fault(out):
            print(f"{fault.__name__:9}  {line}", flush=True)


def damage(out):
    """Truncates, removes or changes a bit in each file of a checkpoint: it is restored exactly or skipped."""
    finish("train", out / "run", *TRAIN)
    expected = jax.device_put(state(out / "run", 20))
    names = [path for path in (out / "run/checkpoints/20").rglob("*") if path.is_file()]
    for kind in (cut, os.remove, change):
        steps = []
        for name in names:
            copy = shutil.copytree(out / "run", out / "damaged")
            kind(copy / name.relative_to(out / "run"))
            try:
                found, said = Checkpoints(copy, max_to_keep=3).load_newest(expected)
                assert len(said) == (int(found.step) == 10), said
                if not said:
                    jax.tree.map(np.testing.assert_array_equal, found, expected)
                steps.append(int(found.step))
            except ValueError as error:  # also the one before cannot be read: both stay
                assert "checkpoints/20" in str(error) and Checkpoints(copy).steps() == [10, 20]
                steps.append(None)
            shutil.rmtree(copy)
        yield f"{kind.__name__} in one of {len(names)} files: continued from steps {steps}"


def second(out):
    """A second training is an error; evaluation during training works."""
    with training(out / "two") as (process, _):
        code, err = finish("train", out / "two", *FOREVER)
        assert code == 1 and f"process {process.pid} on " in err[-1], err
        yield f"exit {code}, {err[-1]}"
        code, err = finish("eval", out / "two", "--step", str(wait_for(out / "two", process, 10)))
        assert code == 0, err
        yield f"eval during training: exit {code}"


def signals(out):
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        with training(out / f"signal{int(number)}") as (process, folder):
            process.send_signal(number)
            err = process.communicate(timeout=300)[1].splitlines()
            assert process.returncode == 0 and "saved; the same command continues" in err[-1], err
            yield f"{number.name} in training: exit 0, {err[-1]}"
    folder = out / "scored"
    process = start("train", folder, *TRAIN, "--config.eval.at_end")
    while process.poll() is None and not (folder / "eval").exists():
        time.sleep(0.01)
    process.send_signal(signal.SIGTERM)
    err = process.communicate(timeout=300)[1].splitlines()
    assert process.returncode == 0 and "stopped while scoring" in err[-1], err
    yield f"SIGTERM while scoring: exit 0, {err[-1]}"
    for _ in range(2):
        code, _ = finish("train", folder, *TRAIN, "--config.eval.at_end")
        assert code == 0 and (folder / "eval/20/results.json").exists()


def full_disk(out):
    with disk(out / "full") as place:
        with training(place / "run") as (process, folder):
            fill(place)
            err = process.communicate(timeout=300)[1].splitlines()
        assert process.returncode == 1 and err[-1].startswith("error: "), err
        yield f"while training: exit 1, {err[-1]}"
        before = Checkpoints(folder).steps()
        for program, options in (("train", FOREVER), ("eval", ())):
            code, err = finish(program, folder, *options)
            assert code == 1 and Checkpoints(folder).steps() == before, err
            assert not list(folder.glob("eval/*/results.json")), err
            yield f"{program} then: exit 1, {err[-1]}"
        code, err = finish("train", place / "new", *TRAIN)
        assert code == 1, err
        yield f"a new run: exit 1, {err[-1]}"
        os.remove(place / "filler")
        end = before[-1] + 10
        code, err = finish("train", folder, *TRAIN, f"--config.train.max_steps={end}")
        assert code == 0 and any(line.split()[:2] == ["steps", str(before[-1])] for line in err), err
        assert [row["step"] for row in read_rows(folder)] == list(range(1, end + 1))
        yield f"with free space again: continued from {before[-1]}"


def read_only(out):
    with disk(out / "read") as place:
        code, err = finish("train", place / "run", *TRAIN)
        assert code == 0, err
        subprocess.run(["mount", "-o", "remount,ro", place], check=True)
        for program, name in (("train", "run"), ("train", "new"), ("eval", "run")):
            code, err = finish(program, place / name, *(TRAIN if program == "train" else ()))
            assert code == 1 and "Read-only file system" in err[-1], err
            yield f"{program} in {name}: exit 1, {err[-1]}"


def full_disks(out):
    """Programs of a run on a disk with little space: one line, no half result, and success once there is more."""
    run, held = trained_run(out), 0
    for name, (program, flags, written) in PROGRAMS.items():
        codes = []
        for free in FREE:
            with disk(out / f"disk_{name}_{free}", size="24m") as place:
                copy, options = shutil.copytree(run, place / "run"), (*flags, *plot_of(program, place))
                fill(place, free)
                code, err = finish(program, copy, *options)
                assert code == 0 or (code == 1 and err[-1].startswith("error: ")), err
                os.remove(place / "filler")
                complete = (copy / written).exists() and program == "export"
                again, err = finish(program, copy, *options, *["--overwrite"] * (complete or code == 0))
                assert again == 0 and (copy / written).exists(), err
                assert code == 1 or not complete or files_of(copy / written), name
                assert not leftovers(copy), leftovers(copy)
                codes.append(code)
                held += 1
        yield f"{name} with {FREE} bytes free: exit {codes}; then exit 0, and nothing left behind"
    yield f"{held} tried, {held} held"


def kills(out, seed=0, count=3):
    """Programs of a trained run that are ended at random moments: the same command then gives the same files."""
    random_, run, held = random.Random(seed), trained_run(out), 0
    for name, (program, flags, written) in PROGRAMS.items():
        whole, ended = shutil.copytree(run, out / f"whole_{name}"), []
        options, started = (*flags, *plot_of(program, whole)), time.monotonic()
        code, err = finish(program, whole, *options)
        seconds, expected = time.monotonic() - started, files_of(whole / written)
        assert code == 0 and expected, err
        for number in (signal.SIGKILL, signal.SIGTERM, signal.SIGINT) * count:
            copy = shutil.copytree(run, out / "ended", dirs_exist_ok=False)
            process = start(program, copy, *flags, *plot_of(program, copy))
            time.sleep(random_.uniform(0.1 * seconds, 1.1 * seconds))
            process.send_signal(number)
            said = process.communicate(timeout=300)[1]
            assert process.returncode in (0, -number, 128 + number) and "Traceback" not in said, said
            complete = process.returncode == 0 or (program == "export" and (copy / written).exists())
            if complete:
                assert files_of(copy / written) == expected, name
            again, err = finish(program, copy, *flags, *plot_of(program, copy), *["--overwrite"] * complete)
            if again and "exists already" in err[-1]:  # it was finished, and the signal came while it said so
                again = 0
            assert again == 0 and files_of(copy / written) == expected, (name, err, files_of(copy / written))
            assert not leftovers(copy), leftovers(copy)
            ended.append(process.returncode)
            held += 1
            shutil.rmtree(copy)
        yield f"{name}, ended within {seconds:.0f} s: exit {ended}; then complete, and nothing left behind"
    yield f"{held} tried, {held} held"


def trained_run(out):
    """Returns the workdir of a run that every program can use."""
    folder = out / "trained"
    if not folder.exists():
        code, err = finish("train", folder, *TRAIN, *as_flags(PACKED), "--config.train.max_to_keep=1")
        assert code == 0, err
    return folder


def plot_of(program, place):
    """Returns the flag for the plot of jaxnerf-check, which it would write to the working folder."""
    return [f"--out={place / 'check.png'}"] if program == "check" else []


def files_of(folder):
    return sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*"))


def leftovers(folder):
    return [path for path in folder.rglob("*") if ".tmp" in path.name or path.name.endswith(".old")]


def devices(out):
    """Trains on four devices, then two, then one, and compares with one and with four throughout."""
    runs_of_counts = {"mixed": (4, 2, 1), "one": (1, 1, 1), "four": (4, 4, 4)}
    for name, counts in runs_of_counts.items():
        for end, count in zip((20, 40, 60), counts, strict=True):
            os.environ["XLA_FLAGS"] = f"--xla_force_host_platform_device_count={count}"
            code, err = finish("train", out / name, *TRAIN, f"--config.train.max_steps={end}")
            assert code == 0, err
    params = {name: jax.tree.leaves(state(out / name, 60).params) for name in runs_of_counts}
    for name in ("one", "four"):
        pairs = zip(params["mixed"], params[name], strict=True)
        largest = max(float(np.abs(a - b).max()) for a, b in pairs)
        assert largest < 1e-5
        yield f"4, then 2, then 1, against {name} throughout, 60 steps: parameters within {largest:.1e}"


def hangs(out):
    """Stops one process of two: the other one names it."""
    for index in (0, 1):
        folder = out / f"hangs{index}"
        flags = (*FOREVER, "--heartbeat_seconds=10", f"--coordinator=127.0.0.1:{free_port()}", "--num_processes=2")
        started = [start("train", folder, *flags, f"--process_id={each}") for each in (0, 1)]
        try:
            wait_for(folder, started[0], 12)
            started[index].send_signal(signal.SIGSTOP)
            err = started[1 - index].communicate(timeout=100)[1].splitlines()
            code = started[1 - index].returncode
            assert code == 1 and err[-1].startswith(f"error: process {index} does not answer any more"), err
            yield f"process {index} of 2: the other one ends with exit 1, {err[-1]}"
        finally:
            for process in started:
                process.kill()
                process.communicate()


def start(program, folder, *flags):
    command = [sys.executable, "-m", module_of(program), f"--workdir={folder}", *map(str, flags)]
    return subprocess.Popen(command, cwd=ROOT, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)


def finish(program, folder, *flags):
    """Returns the exit code and the lines of stderr."""
    process = start(program, folder, *flags)
    said = process.communicate(timeout=600)[1]
    assert "Traceback" not in said, said
    return process.returncode, said.splitlines()


@contextlib.contextmanager
def training(folder):
    """Yields a process that trains until it is stopped and has saved a checkpoint, and its workdir."""
    process = start("train", folder, *FOREVER)
    try:
        wait_for(folder, process, 12)
        yield process, folder
    finally:
        process.kill()
        process.communicate()


def wait_for(folder, process, step):
    while max([row["step"] for row in read_rows(folder)], default=0) < step:
        assert process.poll() is None, process.communicate()[1]
        time.sleep(0.01)
    return max(Checkpoints(folder).steps())


@contextlib.contextmanager
def disk(place, size="8m"):
    place.mkdir()
    subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={size}", "none", place], check=True)
    try:
        yield place
    finally:
        subprocess.run(["umount", "-l", place], check=True)


def fill(place, free=0):
    """Fills a disk but for some bytes."""
    with contextlib.suppress(OSError), open(place / "filler", "wb", buffering=0) as file:
        while file.write(bytes(2**12)):
            pass
    os.truncate(place / "filler", os.path.getsize(place / "filler") - free)


def state(folder, step):
    experiment = build.build(auto_config.resolve_for_device(workdir.load_config(folder))[0])
    like = create_state(experiment.model, experiment.optimizer, experiment.config.seed)
    return jax.device_get(Checkpoints(folder).load(step, like))


def cut(path):
    os.truncate(path, path.stat().st_size // 2)


def change(path):
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--out", required=True)
    parser.add_argument("--only", default="", help="the name of one fault")
    main(**vars(parser.parse_args()))
