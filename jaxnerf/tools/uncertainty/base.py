"""What an estimator of the error of renderings is; see docs/guides/uncertainty.md."""

import os
import pathlib
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

from jaxtyping import Array, Float

from jaxnerf.core.types import Rays
from jaxnerf.core.views import Views
from jaxnerf.evaluation.restore import TrainedRun
from jaxnerf.models.base import FINAL_NETWORK
from jaxnerf.runtime.fingerprint import fingerprint

Score = Callable[[Rays], Float[Array, "*batch"]]


class UncertaintySource(NamedTuple):
    """A restored run, as an estimator receives it.

    Attributes:
        run: any.
        variables: (params, grid) of the checkpoint, for `run.render_image`.
        views: of the split "train", with the cameras that the run has refined; without pixels if the dataset is not
            there.
        members: workdirs of other runs of the same config, which differ in seed.
        folder: of files that belong to this checkpoint, where an estimator may keep what takes long to compute.
        fingerprint: text that is equal for the same field and parameters, whatever grid they are rendered with.
        say: called with a line of text for the user.
    """

    run: TrainedRun
    variables: Any
    views: Views
    members: tuple[str, ...]
    folder: pathlib.Path
    fingerprint: str
    say: Callable[[str], None]

    @classmethod
    def of(
        cls,
        run: TrainedRun,
        workdir: str | os.PathLike,
        step: int,
        variables: Any,
        *,
        members: Sequence[str] = (),
        say: Callable[[str], None] = print,
    ) -> "UncertaintySource":
        """Makes the source of a checkpoint, which reads the training views; its folder is not made."""
        views, cameras = run.experiment.load_split("train", images=None), run.experiment.cameras
        if cameras is not None:
            views = cameras.refined_views(variables[0], views, "train")
        key = fingerprint_of(run, variables[0])
        return cls(run, variables, views, tuple(members), folder_of(workdir, step), key, say)


def folder_of(workdir: str | os.PathLike, step: int) -> pathlib.Path:
    """Returns the folder of what belongs to the estimates of a checkpoint."""
    return pathlib.Path(workdir) / "uncertainty" / str(step)


def fingerprint_of(run: TrainedRun, params: Any) -> str:
    """Returns the fingerprint of an `UncertaintySource`."""
    return fingerprint(run.identity, params)


class Estimate(NamedTuple):
    """An estimator's result.

    Attributes:
        score: Rays [...] -> [...], larger where the colour is less certain, in units of colour: the RMS over the
            channels of an estimated standard deviation. It is computed in chunks that fit into memory.
        identity: text that is equal for estimates that give the same scores to the same checkpoint.
        uncertainty_at: x [..., 3] -> [...] in [0, 1], how uncertain the scene is at positions in the run's world: 1
            where the training images say nothing. It can be traced. None: the estimate is none of positions.
    """

    score: Score
    identity: str
    uncertainty_at: Callable[[Float[Array, "*batch 3"]], Float[Array, "*batch"]] | None = None


def with_field_input(params: Mapping[str, Any], value: Any) -> dict[str, Any]:
    """Returns the params of a model whose final field has been wrapped to take a pair: its params, and a value."""
    return {**params, FINAL_NETWORK: (params[FINAL_NETWORK], value)}
