"""Trains on cameras that are wrong by a known amount, and measures how far the refined ones are from the truth.

    JAXNERF_SCENES=... python experiments/benchmark/poses.py [--dataset=lego] [--side=100] [--noise=0.15] \
        [--seeds=0,1] [--steps=4000] [--set=cameras.refine_lr=2e-3] [--out=runs/poses] [--align] [--without] \
        [--one_pose] [--page=docs/results/cameras.md]

The poses of the training views are perturbed as BARF (arXiv:2104.06405) does for synthetic scenes: by motions of the
world before the true cameras, exp(twist) with twists from a normal distribution of the standard deviation --noise. With
--degrees=0.1,0.3,1,3 each camera is turned about itself instead, by a normal angle about each axis, and moved by the
same fraction of its distance from the origin, in a capture from what the cameras look at. With --one_pose all begin at
the pose of the camera in the middle, as BARF's of forward-facing scenes do. "still_life" is the embedded
scene in closed form. Cameras of a capture are refined as by default, those of other scenes and those that
begin at one pose, which are far off, from step 50 on at a rate of 4e-3.

Errors are those after the similarity that maps the refined cameras' positions onto the true ones best (Umeyama 1991);
the test views are mapped by its inverse and scored. BARF then also optimises their poses on their images, as --align
does in a further column. --without trains each run also without refinement. A finished run is not repeated.
"""

import pathlib
import sys
from typing import Any

import numpy as np
from absl import flags

sys.path.append(str(pathlib.Path(__file__).resolve().parents[1]))
import common
from benchmark import settings
from benchmark.changed_views import perturbed, turned, with_poses
from pose_estimation.pose_errors import errors, similarity

from jaxnerf.data.facts import LookAt
from jaxnerf.runtime import cli
from jaxnerf.tools.curve.measure import SCORE

HEADS = ("run", "noise", "seed", "steps", "rotation before, degrees", "after", "position before, units", "after")
HEADS += ("focal length", "PSNR, dB")
ALIGNED, _POSE_ALIGNED = "pose aligned, dB", "psnr_pose_aligned"
# Of lego at 400 px, by the documentation of nerfacc 0.5, in which its sampler is used in BARF's own code.
PUBLISHED = [
    ("BARF, lego at 400 px, 9.5 h on a 2080 Ti", "0.15", "-", "-", "-", "0.105", "-", "0.0043", "-", "31.16"),
    ("BARF with nerfacc, the same, 1.5 h", "0.15", "-", "-", "-", "0.081", "-", "0.0038", "-", "32.25"),
]
_FULL_SIDE = 800
_BLENDER = ("lego", "mic")
_FAR_OFF = {"cameras.refine_lr": 4e-3, "cameras.refine_start_step": 50}

_DATASET = flags.DEFINE_string("dataset", "lego", "lego, mic, still_life, or the folder of a capture.")
_SIDE = flags.DEFINE_integer("side", 100, "px of an image's side, of a capture of its width.", lower_bound=8)
_NOISE = flags.DEFINE_list("noise", ["0.15"], "Standard deviations of the twists, as BARF perturbs.")
_DEGREES = flags.DEFINE_list("degrees", [], "Standard deviations of turns about the cameras, in place of --noise.")
_ONE_POSE = flags.DEFINE_bool("one_pose", False, "Whether all cameras begin at one pose, in place of noise.")
_SEEDS = flags.DEFINE_list("seeds", ["0"], "Seeds of the noise and of training.")
_STEPS = flags.DEFINE_integer("steps", 4000, "Steps of training.", lower_bound=1)
_ALIGN = flags.DEFINE_bool("align", False, "Whether test views are also scored after their poses are fitted to them.")
_WITHOUT = flags.DEFINE_bool("without", False, "Whether to train without refined cameras, too.")
_SET = settings.define_set()
_OUT = flags.DEFINE_string("out", "runs/poses", "Folder of the runs.")
_TABLE = flags.DEFINE_string("table", "poses", "Name of the table in the marks of --page.")


def main(argv: list[str]) -> None:
    """Trains what is missing, and prints the table."""
    del argv
    rows, name = [], _DATASET.value
    kinds = [("degrees", float(value)) for value in _DEGREES.value] or [("twist", float(v)) for v in _NOISE.value]
    kinds = [("one_pose", 0.0)] if _ONE_POSE.value else kinds
    for kind, amount in kinds:
        for seed in common.seeds_of("--seeds", _SEEDS.value):
            for refine in (False, True)[not _WITHOUT.value :]:
                folder = f"{name}_{_SIDE.value}_{kind}_{amount:g}_seed{seed}_{_STEPS.value}" + "_given" * (not refine)
                found = measured(pathlib.Path(_OUT.value) / folder, kind, amount, seed, refine)
                label = f"{name}, {_SIDE.value} px" + ", not refined" * (not refine)
                rows.append(row(label, found, kind, amount, seed, _STEPS.value, align=_ALIGN.value))
                print(f"{folder}: {found}", flush=True)
    published = PUBLISHED if (name, kinds) == ("lego", [("twist", 0.15)]) else []
    if _ALIGN.value:  # as the published scores are
        published = [(*cells[:-1], "-", cells[-1]) for cells in published]
    heads = (*HEADS, *[ALIGNED] * _ALIGN.value)
    common.publish([*common.markdown(heads, [*rows, *published]), "", *common.provenance()], _TABLE.value)


def row(
    name: str, found: dict[str, float], kind: str, amount: float, seed: int, steps: int, *, align: bool = False
) -> tuple[str, ...]:
    """Returns the cells of a row of the table; align: with that of aligned scores."""
    turns = (f"{found['turn_before']:.2f}", f"{found['turn']:.3f}")
    moves = (f"{found['move_before']:.3f}", f"{found['move']:.4f}")
    noise = {"degrees": f"{amount:g} degrees", "one_pose": "one pose"}.get(kind, f"{amount:g}")
    keys = ("psnr", *[_POSE_ALIGNED] * align)
    scores = (f"{found[key]:.2f}" if key in found else "-" for key in keys)  # "-": scored without --align before
    return (name, noise, str(seed), f"{steps:,}", *turns, *moves, f"{found['focal']:.4f}", *scores)


def measured(folder: pathlib.Path, kind: str, amount: float, seed: int, refine: bool) -> dict[str, Any]:
    """Trains a run on perturbed cameras if it is not there yet; returns errors of its cameras and its PSNR."""
    from jaxnerf.evaluation.evaluate import score_run
    from jaxnerf.evaluation.restore import newest_step, refined_views, restore_run
    from jaxnerf.tools.alignment.align_views import Aligner
    from jaxnerf.training.loop import train

    done = common.read_json(folder / SCORE)
    if done:
        return done
    config = configuration(seed, refine)
    views = common.load_split(config, "train")
    truth = np.asarray(views.cameras.to_world, np.float64)
    noisy = _changed(views, truth, kind, amount, seed)
    given = with_poses(views, noisy)
    if not train(config, folder, views=given):
        raise ValueError(f"{folder}: training was stopped; the same command continues it")
    run = restore_run(folder)
    refined = refined_views(run, given, "train", run.variables(newest_step(run, folder, None))[0])
    poses = np.asarray(refined.cameras.to_world, np.float64)
    test = common.load_split(config, "test")
    to_refined = similarity(truth[:, :, 3], poses[:, :, 3])
    test = with_poses(test, to_refined(np.asarray(test.cameras.to_world, np.float64)))
    before, after = (errors(each, truth) for each in (noisy, poses))
    focal = float(np.mean(np.asarray(refined.cameras.focal) / np.asarray(views.cameras.focal)))
    aligner = Aligner(("pose",)) if _ALIGN.value else None
    scored = score_run(run, folder, split="test", overwrite=True, views=test, aligner=aligner)
    found = {
        "turn_before": before[0],
        "move_before": before[1],
        "turn": after[0],
        "move": after[1],
        "focal": focal,
        **{key: scored[key] for key in ("psnr", _POSE_ALIGNED) if key in scored},
    }
    common.write_json(folder / SCORE, found)
    return found


def _changed(views, truth, kind, amount, seed):
    if kind == "one_pose":
        off = np.linalg.norm(truth[:, :, 3] - truth[:, :, 3].mean(axis=0), axis=1)
        return np.repeat(truth[off.argmin()][None], len(truth), axis=0)
    if kind == "twist":
        return perturbed(truth, amount, seed)
    return turned(truth, amount, seed, LookAt(views).center if _is_capture() else None)


def configuration(seed: int, refine: bool):
    """Returns the config of a run of the chosen dataset."""
    far_off = _ONE_POSE.value or not _is_capture()
    options = {"cameras.refine": refine, "train.preview_every": 0.0, **(_FAR_OFF if far_off else {})}
    options |= {"train.max_seconds": 0.0, "train.max_steps": _STEPS.value, "train.lr_steps": _STEPS.value}
    if _DATASET.value == "still_life":
        data = {"data.format": "synthetic", "data.dir": "", "data.factor": 1, "data.size": _SIDE.value}
    elif _is_capture():
        data = {"data.dir": _DATASET.value, "data.width": _SIDE.value}
    else:
        data = {"data.format": "blender", "data.dir": _DATASET.value, "data.factor": _FULL_SIDE // _SIDE.value}
    fields = {**data, **options, **dict(settings.parse(_SET.value))}
    return common.configuration("capture" if _is_capture() else "lego_fast", fields, seed=seed)


def _is_capture():
    return _DATASET.value not in (*_BLENDER, "still_life")


if __name__ == "__main__":
    cli.run(main, stopped="within a run, which is saved; the same command continues")
