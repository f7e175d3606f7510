"""What an estimator of the error of renderings is; see docs/guides/uncertainty.md."""

import pathlib
from collections.abc import Callable
from typing import Any, NamedTuple

from jaxtyping import Array, Float

from jaxnerf.core.types import Rays
from jaxnerf.core.views import Views
from jaxnerf.evaluation.restore import TrainedRun

Score = Callable[[Rays], Float[Array, "*batch"]]


class UncertaintySource(NamedTuple):
    """A restored run, as an estimator receives it.

    Attributes:
        run: any.
        variables: of the checkpoint, for `run.render_image`.
        views: of the split "train", with the cameras that the run has refined.
        members: workdirs of other runs of the same config, which differ in seed.
        folder: of files that belong to this checkpoint, where an estimator may keep what takes long to compute.
        fingerprint: text that is equal for the same field and parameters.
        say: called with a line of text for the user.
    """

    run: TrainedRun
    variables: Any
    views: Views
    members: tuple[str, ...]
    folder: pathlib.Path
    fingerprint: str
    say: Callable[[str], None]


class Estimate(NamedTuple):
    """An estimator's result.

    Attributes:
        score: Rays [...] -> [...], larger where the colour is less certain, in units of colour: the RMS over the
            channels of an estimated standard deviation. It is computed in chunks that fit into memory.
        identity: text that is equal for estimates that give the same scores to the same checkpoint.
    """

    score: Score
    identity: str
