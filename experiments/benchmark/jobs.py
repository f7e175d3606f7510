"""The jobs of the benchmark: which dataset is trained how, for how long, and by which protocol it is scored."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import common

from jaxnerf.training.config import read_config

_WHOLE = {"data.hold_out": 0, "data.num_views": 0, "eval.split": "test"}


class Protocol(NamedTuple):
    """How images are read and scored.

    Attributes:
        options: of the config that the protocol fixes.
        text: what it says, for the page.
        dataset: the name of the datasets in nerfbaselines; None: it has none.
        evaluation: the name of the evaluation protocol in nerfbaselines.
    """

    options: Mapping[str, Any]
    text: str
    dataset: str | None
    evaluation: str


PROTOCOLS = {
    "blender": Protocol(
        {**_WHOLE, "data.format": "blender", "data.background": "white"},
        "alpha over white; the test views of the dataset's own list",
        "blender",
        "nerf",
    ),
    "dnerf": Protocol(
        {**_WHOLE, "data.format": "blender", "data.background": "white"},
        "alpha over white; the test views of the dataset's own list, each at its own time",
        None,
        "default",
    ),
    "llff": Protocol(
        {**_WHOLE, "data.format": "llff"}, "every 8th view is a test view, the first one included", "llff", "nerf"
    ),
    "capture": Protocol(_WHOLE, "every 8th view is a test view, the first one included", None, "default"),
}


class Job(NamedTuple):
    """A dataset that is trained for each of several times, each in a run of its own.

    Attributes:
        dataset: its folder, a path or a name below $JAXNERF_SCENES.
        config: the name of the config.
        overrides: {"section.option": value} of the config.
        seconds: of training; the learning rate of a run reaches its end when its time does.
        protocol: a name in PROTOCOLS.
        work: what is trained, in words.
        beside: the "what" of the entries of `speed/published.py` that compare with it.
        origin: how the dataset is made where it is missing; "" if it is downloaded.
        cores: of a CPU that the process may use.
    """

    dataset: str
    config: str
    overrides: Mapping[str, Any]
    seconds: Sequence[float]
    protocol: str
    work: str
    beside: Sequence[str] = ()
    origin: str = ""
    cores: int = 1


def _blender(dataset, side, seconds, *, work, beside=(), **overrides):
    fixed = {"data.format": "blender", "data.dir": dataset, "data.factor": 800 // side}
    return Job(dataset, "lego_fast", fixed | overrides, seconds, "blender", f"{dataset}, {work}", beside)


def _dnerf(dataset, side, seconds, *, beside=()):
    fixed = {"data.format": "blender", "data.dir": dataset, "data.factor": 800 // side}
    return Job(dataset, "moving", fixed, seconds, "dnerf", f"{dataset}, a scene that moves, {side} px", beside)


def _llff(dataset, factor, seconds, *, work, beside=()):
    fixed = {"data.format": "llff", "data.dir": dataset, "data.factor": factor}
    return Job(dataset, "capture", fixed, seconds, "llff", f"{dataset}, {work}", beside)


def _capture(dataset, seconds, *, work, beside=(), origin=""):
    return Job(dataset, "capture", {"data.dir": dataset}, seconds, "capture", work, beside, origin)


_OF_LEGO = ("lego, 800x800, 25 test views", "lego, 800x800")
_OF_MIC = ("mic, 800x800, 25 test views", "mic, 800x800")
_NO_ALPHA = {"scene.use_alpha": False}
_WITHOUT_ALPHA = "lego, 100x100, 25 test views, without alpha"
_REPOSE = "jaxnerf-cameras --images=can/images --out=can_reposed"
_FOLDERS = "'can_undistorted', 'can_reposed/sparse/0', 'can_reposed/images'"
_UNDISTORT = f'python -c "import pycolmap; pycolmap.undistort_images({_FOLDERS})"'
JOBS = {
    "lego_100": _blender("lego", 100, (10, 60), work="100 px", beside=("lego, 100x100, 25 test views",)),
    "lego_100_no_alpha": _blender(
        "lego", 100, (60,), work="100 px, alpha not used", beside=(_WITHOUT_ALPHA,), **_NO_ALPHA
    ),
    "lego_400": _blender("lego", 400, (180,), work="400 px"),
    "lego_800": _blender("lego", 800, (600,), work="800 px, its full size", beside=_OF_LEGO),
    "mic_800": _blender("mic", 800, (600,), work="800 px, its full size", beside=_OF_MIC),
    "dnerf_lego_100": _dnerf("dnerf_lego", 100, (120,)),
    "dnerf_lego_400": _dnerf("dnerf_lego", 400, (1800,), beside=("dnerf_lego, 400x400",)),
    "fern_4": _llff("fern", 4, (600,), work="forward-facing, 1008 px wide", beside=("fern, 1008x756",)),
    "trex_8": _llff("trex", 8, (300,), work="forward-facing, 504 px wide"),
    "fox_200": _capture("fox", (120, 300), work="fox, phone images, 216 px wide"),
    "can_undistorted": _capture(
        "can_undistorted",
        (120, 300),
        work="can, phone images, 177 px wide, cameras of `jaxnerf-cameras`",
        beside=("can with new poses, undistorted, 177x316",),
        origin=f"{_REPOSE} && {_UNDISTORT}",
    ),
}


def configuration(job: Job, overrides: Mapping[str, Any] | Sequence = ()):
    """Returns the config of a job, read and checked, with other overrides on top.

    Raises:
        ValueError: if it has no such option, a value is wrong, or the job's protocol says otherwise.
    """
    quiet = {"train.preview_every": 0.0, "eval.summary_seconds": 0.0}
    config = read_config(common.configuration(job.config, {**quiet, **job.overrides}))
    config = common.changed(config, dict(overrides))
    check_protocol(config, job.protocol)
    return config


def check_protocol(config, name: str) -> None:
    """Raises ValueError if a config reads or scores other images than a protocol does."""
    for option, expected in PROTOCOLS[name].options.items():
        section, _, field = option.partition(".")
        found = getattr(getattr(config, section), field)
        if found != expected:
            raise ValueError(f"{option} is {found!r}, expected {expected!r} by the protocol {name!r}; correct --set")
