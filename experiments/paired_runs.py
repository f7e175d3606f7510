"""Short runs that differ in a few fields of one configuration: trained, scored, and never done twice."""

import functools
import importlib
import json
import math
import pathlib
import statistics
import sys

sys.path.insert(0, str(pathlib.Path(__file__).resolve().parent.parent))  # configurations import configs

_FILE = "scored.json"  # in a workdir, once its run was trained to the end and scored


def configuration(base, overrides=(), *, seed=0):
    """Returns the configuration configs/<base>.py with some fields changed.

    Args:
        base: its name.
        overrides: {"section.field": value}.
        seed: of the run.
    """
    config = importlib.import_module(f"configs.{base}").get_config()
    config.update_from_flattened_dict({**dict(overrides), "seed": seed})
    return config


def run(config, folder, *, split=None):
    """Trains a run to its end and scores it there; goes on where one was stopped, repeats no finished one.

    Args:
        config: ConfigDict.
        folder: its workdir.
        split: that is scored; the configuration's eval.split when None.

    Returns:
        What results.json holds, or None where Ctrl-C stopped the training, which was saved.

    Raises:
        ValueError: as train_and_evaluate, and if the folder holds a finished run of another configuration.
    """
    done = finished(config, folder, split=split)
    if done is not None:
        return done
    import jax

    from jaxnerf.evaluation.evaluate import score_run, train_and_evaluate
    from jaxnerf.evaluation.restore import restore_run
    from jaxnerf.training.workdir import write_text

    if not train_and_evaluate(config, folder, views=read_views(config, "train")):
        return None
    views = read_views(config, split or config.eval.split)
    results = score_run(restore_run(folder), folder, split=split, overwrite=True, views=views)
    asked = {"config": _plain(config), "split": split}
    write_text(pathlib.Path(folder) / _FILE, json.dumps({"asked": asked, "results": results}) + "\n")
    jax.clear_caches()  # of a step and a renderer that no other run has
    return results


def finished(config, folder, *, split=None):
    """Returns the results of a run that was finished earlier, or None; ValueError if it was another run."""
    path = pathlib.Path(folder) / _FILE
    if not path.exists():
        return None
    kept = json.loads(path.read_text())
    asked = {"config": _plain(config), "split": split}
    if kept["asked"] != asked:
        old, new = _flat(kept["asked"]), _flat(asked)
        key = next(key for key in sorted(old.keys() | new.keys()) if old.get(key) != new.get(key))
        raise ValueError(
            f"{folder}: holds a finished run with {key} {old.get(key)!r}, wanted {new.get(key)!r}; "
            "give another folder, or the old settings"
        )
    return kept["results"]


def read_views(config, split):
    """Returns the Views of a split, read once for all runs on them."""
    return _read_views(json.dumps(config.data.to_dict(), sort_keys=True), split)


@functools.lru_cache(maxsize=6)
def _read_views(data, split):
    from ml_collections import ConfigDict

    from jaxnerf.training import build

    return build.load_views(ConfigDict(json.loads(data)), split)


def spread(values):
    """Returns (mean, standard deviation over seeds) of figures; NaN for the deviation of one."""
    return statistics.fmean(values), statistics.stdev(values) if len(values) > 1 else math.nan


def differences(scores, others):
    """Returns the differences [a - b] of scores {seed: figure} at the seeds that both have, by seed."""
    return [scores[seed] - others[seed] for seed in sorted(scores.keys() & others.keys())]


def _plain(config):
    """Returns a configuration as JSON knows it, without where the data lies."""
    plain = json.loads(config.to_json_best_effort())
    return plain | {"data": {key: value for key, value in plain["data"].items() if key != "dir"}}


def _flat(tree, prefix=""):
    if not isinstance(tree, dict):
        return {prefix[:-1]: tree}
    flat = {}
    for name, part in tree.items():
        flat.update(_flat(part, f"{prefix}{name}."))
    return flat
