"""python -m jaxnerf.eval --workdir=DIR: scores a run's checkpoint on held-out views."""

from absl import flags
from ml_collections import config_flags

from jaxnerf.runtime import cli

_CONFIG = config_flags.DEFINE_config_file("config", None, "In place of the workdir's own.", lock_config=True)
_WORKDIR = flags.DEFINE_string("workdir", None, "Folder of the run.")
_DATA_DIR = flags.DEFINE_string("data_dir", None, "The scene's folder, in place of config.data.dir.")
_SPLIT = flags.DEFINE_string("split", None, "Of the scene; config.eval.split when not given.")
_STEP = flags.DEFINE_integer("step", None, "Of the checkpoint; the newest when not given.")
_CHUNK = cli.define_count("chunk", "Rays at once, or auto: what fits; config.eval.chunk when not given.")
_WATCH = flags.DEFINE_bool("watch", False, "Score new checkpoints as they come, until training's last step.")
_POLL = flags.DEFINE_float("poll_seconds", 10.0, "How often --watch looks.", lower_bound=0.01)
_OVERWRITE = flags.DEFINE_bool("overwrite", False, "Replace an earlier result.")
_BAKE_OCCUPANCY = flags.DEFINE_bool("bake_occupancy", None, "Leave out what is not seen of a dense model.")
_ERROR_BUDGET = flags.DEFINE_float(
    "error_budget",
    None,
    "Render as cheaply as the RMS colour error against the model's own exact rendering stays within this.",
    lower_bound=0.0,
)
_PREDICTIONS = flags.DEFINE_string(
    "predictions", None, "Score the images in this folder (or its color/) in place of a run's renderings."
)
_SHARD = flags.DEFINE_string(
    "shard",
    None,
    "K/N: only each N-th view, from K on, where K counts from 0; auto: as srun or mpirun has started. Any "
    "number of calls may run at once; the one that finishes last writes results.json.",
)


def main(argv):
    del argv
    from jaxnerf.evaluation import evaluate, external, quality_search, watch
    from jaxnerf.runtime import shards
    from jaxnerf.training import workdir

    if not (_WORKDIR.value or _PREDICTIONS.value):
        raise ValueError("nothing to score: give --workdir=DIR of a run, or --predictions=DIR of images")
    shard = shards.parse(_SHARD.value)
    for name, value in (("predictions", _PREDICTIONS.value), ("watch", _WATCH.value)):
        if shard != shards.WHOLE and value:
            raise ValueError(f"--shard splits the views of one checkpoint, not --{name}; drop one of them")
    if shard != shards.WHOLE and _ERROR_BUDGET.value is not None:
        raise ValueError("--error_budget chooses by the clock, so shards would differ; drop --shard")
    config = _CONFIG.value
    if config is None and _WORKDIR.value and not _WATCH.value:
        config = workdir.read_config(_WORKDIR.value)
    if config is not None:
        cli.use_data(config, _DATA_DIR.value)
    if _PREDICTIONS.value:
        results = external.score_folder(
            _PREDICTIONS.value, config=config, split=_SPLIT.value, overwrite=_OVERWRITE.value
        )
    elif _WATCH.value:
        watch.watch(
            _WORKDIR.value,
            config=config,
            data_dir=_DATA_DIR.value,
            split=_SPLIT.value,
            chunk=_CHUNK.value,
            poll_seconds=_POLL.value,
        )
        return
    else:
        settings = {} if _BAKE_OCCUPANCY.value is None else {"bake_occupancy": _BAKE_OCCUPANCY.value}
        if _ERROR_BUDGET.value is not None:
            settings = quality_search.choose(
                _WORKDIR.value,
                _ERROR_BUDGET.value,
                config=config,
                split=_SPLIT.value,
                step=_STEP.value,
                chunk=_CHUNK.value,
                overwrite=_OVERWRITE.value,
            )
        results = evaluate.evaluate(
            _WORKDIR.value,
            config=config,
            split=_SPLIT.value,
            step=_STEP.value,
            chunk=_CHUNK.value,
            settings=settings,
            overwrite=_OVERWRITE.value,
            shard=shard,
        )
    if results is None:
        print(f"shard {_SHARD.value} is done; views of other shards are missing still")
        return
    print(evaluate.summary(results))


if __name__ == "__main__":
    cli.run(main, stopped="between two views; the same command goes on from there")
