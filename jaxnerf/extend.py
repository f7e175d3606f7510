"""What code that registers a field, a sampler, a loss, a dataset reader, an exporter or an estimator builds on.

`jaxnerf.register_field` and its siblings say what each needs; docs/extending has an example of each. What exporters and
estimators build on is imported when it is first used.
"""

import importlib
import typing

from jaxnerf.core.sampling import split_key
from jaxnerf.core.types import without_samples
from jaxnerf.data.readers.base import CameraFiles, Capture, Frame
from jaxnerf.fields.base import Field, field_scene, needs_of_fields
from jaxnerf.models.base import Model, SamplerContext
from jaxnerf.models.grid_schedule import GridSchedule, make_grid_schedule
from jaxnerf.options import (
    BELOW_ONE,
    FRACTION,
    POSITIVE,
    Ablation,
    Changes,
    Device,
    Facts,
    Options,
    at_least,
    between,
    infer,
    option,
)

if typing.TYPE_CHECKING:
    from jaxnerf.tools.exporters.base import ExportSource
    from jaxnerf.tools.exporters.options import ExportOptions
    from jaxnerf.tools.uncertainty.base import Estimate, UncertaintySource

_ON_DEMAND = {
    "ExportSource": "jaxnerf.tools.exporters.base",
    "ExportOptions": "jaxnerf.tools.exporters.options",
    "Estimate": "jaxnerf.tools.uncertainty.base",
    "UncertaintySource": "jaxnerf.tools.uncertainty.base",
}

if not typing.TYPE_CHECKING:  # a type checker would accept every name

    def __getattr__(name):
        if name not in _ON_DEMAND:
            raise AttributeError(f"module 'jaxnerf.extend' has no attribute {name!r}")
        return getattr(importlib.import_module(_ON_DEMAND[name]), name)


__all__ = [
    # fields and samplers
    "Field", "Model", "SamplerContext", "field_scene", "needs_of_fields", "split_key", "without_samples",
    "GridSchedule", "make_grid_schedule",
    # readers and exporters
    "Capture", "Frame", "CameraFiles", "ExportSource", "ExportOptions",
    # estimators of uncertainty
    "Estimate", "UncertaintySource",
    # options
    "Options", "option", "Ablation", "Changes", "at_least", "between", "POSITIVE", "FRACTION", "BELOW_ONE", "infer",
    "Facts", "Device",
]  # fmt: skip
