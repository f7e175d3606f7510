"""The launch files for clusters, as far as they can be tested without a cluster."""

import os
import re
import subprocess

import pytest
import yaml

from runs import ROOT

FILES = ROOT / "experiments" / "cluster"


def flags_of(program):
    """Returns the names of a program's flags."""
    source = (ROOT / "jaxnerf" / f"{program}.py").read_text()
    if "run_flags.RunFlags" in source:
        source += (ROOT / "jaxnerf" / "evaluation" / "run_flags.py").read_text()
    return {*re.findall(r'(?:DEFINE|define)_\w+\(\s*"(\w+)"', source), *re.findall(r"\.define_(config)\(", source)}


def calls(text):
    """Returns (program, names of its flags) of each call of a program in a shell script."""
    found = re.findall(r"python -m jaxnerf\.(\w+)((?:[^\n\\]|\\\n)*)", text)
    return [(program, set(re.findall(r"--(\w+)", rest))) for program, rest in found]


@pytest.mark.parametrize("name", ["train.sbatch", "eval.sbatch"])
def test_batch_scripts_are_valid_shell_with_existing_flags(name):
    path = FILES / name
    subprocess.run(["bash", "-n", path], check=True)
    assert path.read_text().startswith("#!/usr/bin/env bash\n")
    found = calls(path.read_text())
    assert found
    for program, names in found:
        assert names and names <= flags_of(program), names - flags_of(program)


def commands_of(path, tmp_path, *arguments, **environment):
    """Returns the commands that a script runs: srun and python are replaced by scripts that print them."""
    for name in ("srun", "python"):
        (tmp_path / name).write_text(f'#!/bin/sh\necho {name} "$@"\n')
        (tmp_path / name).chmod(0o755)
    environment = {**os.environ, "PATH": f"{tmp_path}:{os.environ['PATH']}", **environment}
    done = subprocess.run(["bash", path, *arguments], env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stdout.splitlines()


def test_the_batch_scripts_run_the_expected_commands(tmp_path):
    assert commands_of(FILES / "train.sbatch", tmp_path, "c.py", "/a scene", "/run") == [
        "srun --kill-on-bad-exit=1 python -m jaxnerf.train --config=c.py --data_dir=/a scene --workdir=/run --multihost"
    ]
    array = {"SLURM_ARRAY_TASK_ID": "3", "SLURM_ARRAY_TASK_COUNT": "16"}
    assert commands_of(FILES / "eval.sbatch", tmp_path, "/run", **array) == [
        "python -m jaxnerf.eval --workdir=/run --shard=3/16",
        "python -m jaxnerf.render --workdir=/run --shard=3/16",
    ]
    assert "--array=0-15" in (FILES / "eval.sbatch").read_text(), "shards are numbered from 0"


def job(name):
    (found,) = [part for part in yaml.safe_load_all((FILES / name).read_text()) if part["kind"] == "Job"]
    (container,) = found["spec"]["template"]["spec"]["containers"]
    assert found["spec"]["completionMode"] == "Indexed" and container["env"][0]["name"] == "JOB_COMPLETION_INDEX"
    program = container["command"][2].removeprefix("jaxnerf.")
    flags = dict(re.fullmatch(r"--(\w+)=(.*)", flag).groups() for flag in container["args"])
    assert set(flags) <= flags_of(program)
    return found, flags


def test_kubernetes_processes_start_together_and_find_the_first():
    found, flags = job("train.yaml")
    (service,) = [part for part in yaml.safe_load_all((FILES / "train.yaml").read_text()) if part["kind"] == "Service"]
    spec, name = found["spec"], found["metadata"]["name"]
    assert spec["completions"] == spec["parallelism"] == int(flags["num_processes"]), "all at once"
    assert flags["process_id"] == "$(JOB_COMPLETION_INDEX)"
    subdomain = spec["template"]["spec"]["subdomain"]
    assert service["metadata"]["name"] == subdomain and service["spec"]["clusterIP"] == "None"
    assert service["spec"]["selector"] == {"job-name": name}
    assert flags["coordinator"].split(":")[0] == f"{name}-0.{subdomain}", "a pod's name in an indexed job"
    assert (ROOT / flags["config"]).exists()
    assert flags["stopped_code"] != "0", "an interrupted pod has not succeeded"


def test_kubernetes_scores_in_shards():
    found, flags = job("eval.yaml")
    assert flags["shard"] == f"$(JOB_COMPLETION_INDEX)/{found['spec']['completions']}"
