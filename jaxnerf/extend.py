"""What code that registers a field, a sampler, a loss, a dataset reader, an exporter or an estimator builds on.

`jaxnerf.register_field` and its siblings say what each needs; docs/extending has an example of each.
"""

from jaxnerf.core.sampling import split_key
from jaxnerf.core.types import without_samples
from jaxnerf.data.readers.base import Capture, Frame
from jaxnerf.fields.base import Field, field_scene, needs_of_fields
from jaxnerf.models.base import Model, SamplerContext
from jaxnerf.options import (
    BELOW_ONE,
    FRACTION,
    POSITIVE,
    Changes,
    Device,
    Facts,
    Options,
    at_least,
    between,
    infer,
    option,
)
from jaxnerf.tools.exporters.base import ExportSource
from jaxnerf.tools.uncertainty.base import Estimate, UncertaintySource

__all__ = [
    # fields and samplers
    "Field", "Model", "SamplerContext", "field_scene", "needs_of_fields", "split_key", "without_samples",
    # readers and exporters
    "Capture", "Frame", "ExportSource",
    # estimators of uncertainty
    "Estimate", "UncertaintySource",
    # options
    "Options", "option", "Changes", "at_least", "between", "POSITIVE", "FRACTION", "BELOW_ONE", "infer", "Facts",
    "Device",
]  # fmt: skip
