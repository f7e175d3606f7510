"""Scores a run on held-out views: jaxnerf-eval --workdir=DIR, or images: jaxnerf-eval --predictions=DIR.

`python -m jaxnerf.eval` is the same program. It writes DIR/eval/STEP/results.json, or DIR/results.json.
"""

import functools

from absl import flags

from jaxnerf.evaluation import run_flags
from jaxnerf.runtime import cli

_CONFIG = run_flags.define_config(
    "A config that replaces the workdir's: a name, or the path of a file. When it is not given, flags such as "
    "--config.eval.chunk=4096 change the workdir's.",
)
_RUN = run_flags.RunFlags("scored", "uncertainty/NNN.tiff and compares it with the true errors")
_SPLIT = flags.DEFINE_string("split", None, "The split of the dataset. It overrides config.eval.split.")
_WATCH = flags.DEFINE_bool("watch", False, "Whether to score each new checkpoint until training ends.")
_POLL = flags.DEFINE_float(
    "poll_seconds", 10.0, "The time between two searches for a checkpoint with --watch.", lower_bound=0.01
)
_OVERWRITE = flags.DEFINE_bool("overwrite", False, "Whether to replace an earlier result.")
_ERROR_BUDGET = flags.DEFINE_float(
    "error_budget",
    None,
    "The largest RMS colour error, against the model's own exact rendering. The program searches the fastest "
    "settings that stay within it, and scores with them.",
    lower_bound=0.0,
    upper_bound=1.0,
)
_PREDICTIONS = flags.DEFINE_string(
    "predictions", None, "A folder of images, or of color/ with images, that are scored in place of a run."
)
_ALIGN = flags.DEFINE_string(
    "align",
    None,
    "pose, exposure, or pose,exposure: each view's pose, or gains per colour channel, are fitted to its image with the "
    "scene fixed, and scores after that stand beside those before. When it is not given, what the run has trained of "
    "its own images is aligned; none: nothing.",
)
_SHARD = flags.DEFINE_string(
    "shard",
    None,
    "K/N scores each N-th view from view K on, where K counts from 0; auto takes K and N from srun or mpirun. "
    "Any number of processes may run at once; the last one to finish writes results.json.",
)


def main(argv):
    del argv
    # Imported after the flags are parsed, so that a wrong flag is reported at once.
    from jaxnerf.evaluation import evaluate
    from jaxnerf.runtime import shards
    from jaxnerf.tools.alignment import align_views
    from jaxnerf.tools.uncertainty import predict

    shard = shards.parse(_SHARD.value)
    _check_flags(is_sharded=shard != shards.WHOLE)
    predictor, make_aligner = _RUN.predictor(), align_views.requested(_ALIGN.value)
    workdir, split, overwrite = _RUN.workdir.value, _SPLIT.value, _OVERWRITE.value
    restore = functools.partial(_RUN.restore, _CONFIG.value)
    if _PREDICTIONS.value:
        from jaxnerf.tools.predictions.score_folder import reference_config, score_folder

        config = reference_config(_CONFIG.value, workdir, _RUN.data_dir.value)
        results = score_folder(_PREDICTIONS.value, config=config, split=split, overwrite=overwrite)
    elif _WATCH.value:
        evaluate.watch(workdir, restore, poll_seconds=_POLL.value, split=split)
        return
    else:
        target = {"split": split, "step": _RUN.step.value, "overwrite": overwrite}
        budget, found = _ERROR_BUDGET.value, {}
        if budget is not None:
            from jaxnerf.tools.quality_search.search import choose

            found = choose(workdir, restore, budget, **target)
        run = restore(found)
        tools = {"predictor": predictor and predictor(run), "aligner": make_aligner(run)}
        results = evaluate.score_run(run, workdir, shard=shard, **tools, **target)
    if results is None:
        print(f"shard {_SHARD.value} is done; views of other shards are missing")
        return
    print(evaluate.summary(results))
    for line in filter(None, (align_views.line(results), predict.line(results))):
        print(line)


def _check_flags(is_sharded):
    if not (_RUN.workdir.value or _PREDICTIONS.value):
        raise ValueError("there is nothing to score; give --workdir=DIR of a run, or --predictions=DIR of images")
    for name, value in (("predictions", _PREDICTIONS.value), ("watch", _WATCH.value)):
        if is_sharded and value:
            raise ValueError(f"--shard splits the views of one checkpoint, not --{name}; drop one of them")
    # What --predictions and --watch cannot use.
    of_one_checkpoint = {
        "step": _RUN.step.value,
        "error_budget": _ERROR_BUDGET.value,
        "uncertainty": _RUN.uncertainty.value,
        "align": _ALIGN.value,
    }
    of_a_run = of_one_checkpoint | {
        "chunk": _RUN.chunk.value,
        "bake_occupancy": _RUN.bake_occupancy.value,
        "max_uncertainty": _RUN.max_uncertainty.value,
    }
    unused = {
        "predictions": (_PREDICTIONS.value, of_a_run | {"watch": _WATCH.value or None}),
        "watch": (_WATCH.value, of_one_checkpoint | {"overwrite": _OVERWRITE.value or None}),
    }
    for name, (given, others) in unused.items():
        for other, value in others.items():
            if given and value is not None:
                raise ValueError(f"--{name} does not use --{other}; drop one of them")
    if is_sharded and _ERROR_BUDGET.value is not None:
        raise ValueError("--error_budget measures times, so shards would choose different settings; drop --shard")


def run():
    """Runs the program."""
    prepare = functools.partial(cli.with_saved_config, only_for_fields=True)
    cli.run(main, prepare=prepare, stopped=_stopped)


def _stopped():
    continues = not (_PREDICTIONS.value or _OVERWRITE.value)
    return f"between two views; the same command {'continues from there' if continues else 'begins again'}"


if __name__ == "__main__":
    run()
