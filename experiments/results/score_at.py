"""Scores a run on the images of another run, which was trained on the same dataset at another resolution.

    python experiments/results/score_at.py --workdir=RUN --like=OTHER --out=DIR

DIR becomes a copy of RUN with its scores on the images of OTHER; table.py prints them.
"""

import pathlib
import shutil

from absl import flags

from jaxnerf.evaluation.evaluate import score_run, summary
from jaxnerf.evaluation.restore import restore_run
from jaxnerf.options import replaced, values_of
from jaxnerf.runtime import cli
from jaxnerf.training import workdir

_WORKDIR = flags.DEFINE_string("workdir", None, "Folder of the run to score.", required=True)
_LIKE = flags.DEFINE_string("like", None, "Folder of the run whose images are the reference.", required=True)
_OUT = flags.DEFINE_string("out", None, "Folder of the scored copy, missing.", required=True)

_MAY_DIFFER = ("dir", "factor", "width")


def main(argv: list[str]) -> None:
    """Copies and scores the run."""
    del argv
    out, config = pathlib.Path(_OUT.value), workdir.load_config(_WORKDIR.value)
    if out.exists():
        raise ValueError(f"{out}: exists, expected a missing folder; remove it, or give another --out")
    like = workdir.load_config(_LIKE.value)
    own = values_of(config.data)
    # Another split of the images could put training images of RUN among those that are scored.
    for name, value in values_of(like.data).items():
        if name not in _MAY_DIFFER and value != own[name]:
            raise ValueError(
                f"{_LIKE.value}: data.{name} is {value!r}, in {_WORKDIR.value} it is {own[name]!r}; "
                f"expected runs that differ in {', '.join(_MAY_DIFFER)} only"
            )
    config = replaced(config, data=like.data, fingerprint=like.fingerprint)
    shutil.copytree(_WORKDIR.value, out, ignore=shutil.ignore_patterns("eval", "renders"))
    print(summary(score_run(restore_run(out, config), out)))


if __name__ == "__main__":
    cli.run(main)
