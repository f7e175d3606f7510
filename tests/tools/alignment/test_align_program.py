"""Refined cameras through the programs: trained, resumed, scored after alignment, exported, and read again."""

import json
import os

import numpy as np
import pytest

import captures
from jaxnerf.data.readers.base import read_capture
from jaxnerf.evaluation.restore import newest_step, refined_views, restore_run
from runs import SMOKE_FLAGS, as_flags, run_forked

pytest_plugins = ["run_fixtures"]

OPTIONS = {"data.format": "transforms", "eval.split": "test", "sampling.num_fine": 0, "train.lr_steps": 10}
OPTIONS |= {"cameras.exposure": True, "cameras.refine": True, "cameras.refine_start_step": 0, "cameras.refine_lr": 1e-2}


def ran(program, *flags):
    """Returns what a program prints."""
    code, out, err = run_forked(program, *flags)
    assert code == 0, out + err
    return out + err


@pytest.mark.extra
def test_refined_cameras_pass_through_all_programs(unoptimized, tmp_path):
    data, run = tmp_path / "data", tmp_path / "run"
    captures.write_transforms(data, captures.shoot(captures.orbit(9, height=12, width=16)))
    for steps in (5, 10):
        flags = as_flags({**OPTIONS, "train.max_steps": steps})
        log = ran("train", *SMOKE_FLAGS, f"--data_dir={data}", f"--workdir={run}", *flags)
        assert "cameras       refined by " in log and " times the mean exposure" in log
    log = ran("eval", f"--workdir={run}")
    results = json.loads((run / "eval" / "10" / "results.json").read_text())
    assert "pose and exposure aligned: PSNR " in log and results["aligned"] == "pose_exposure"
    assert results["psnr_pose_exposure_aligned"] > results["psnr"]
    code, _, err = run_forked("eval", f"--workdir={run}", "--align=poses")
    assert code != 0 and "--align is 'poses'" in err and "Traceback" not in err
    ran("export", f"--workdir={run}", "--kind=cameras", "--name=refined")
    out = next(run.rglob("refined"))
    os.symlink(data / "images", out / "images")
    given = {frame.name: frame.camera.to_world for frame in read_capture(data, "transforms").frames}
    found = {frame.name: frame.camera.to_world for frame in read_capture(out, "transforms").frames}
    restored = restore_run(run)
    views = restored.experiment.load_split("train")
    refined = refined_views(restored, views, "train", restored.variables(newest_step(restored, run, None))[0])
    turns = np.asarray(refined.cameras.to_world)[:, :, :3] - np.asarray(views.cameras.to_world)[:, :, :3]
    assert np.abs(turns).max() > 1e-3
    for index, name in enumerate(views.names):
        np.testing.assert_allclose(found[name][:, :3] - given[name][:, :3], turns[index], atol=1e-5)
    others = found.keys() - set(views.names)
    assert others and all(np.allclose(found[name], given[name], atol=1e-6) for name in others)
