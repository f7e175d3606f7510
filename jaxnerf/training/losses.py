"""The built-in losses of renderings by name: their functions are in `core.losses`."""

from jaxnerf.core.losses import depth_loss, distortion_loss, mse_loss, opacity_loss
from jaxnerf.registry import Loss

_MIN_OBSERVATIONS = 100  # of sparse points, for a depth loss
_DEPTH_WEIGHT = ((0, 0.1), (1000, 0.0))  # of the depth loss: between points the depth is a guess, so it ends


def _weight_of_depth(facts):
    if facts.num_observations < _MIN_OBSERVATIONS:
        return 0.0, ""
    line = f"depth         {facts.num_observations:,} observations of sparse points guide the start of training"
    return _DEPTH_WEIGHT, line


def _weight_of_distortion(facts):
    bounded = not (facts.ndc or facts.contracted)
    weight = 0.01 if bounded else 0.001
    where = "a box bounds the scene" if bounded else "the scene is seen as far as it reaches"
    return weight, f"distortion    weight {weight:g}, as {where}"


def _weight_of_opacity(facts):
    if not (facts.outlined and facts.has_times):
        return 0.0, ""
    return 0.1, "opacity       is compared with alpha, which outlines the scene at each time"


MSE = Loss(mse_loss, weight=1.0, help="squared error of the colours, summed over all renderings")
OPACITY = Loss(
    opacity_loss,
    needs=("alpha",),
    infer=_weight_of_opacity,
    help="squared difference of opacity and alpha; auto, for scenes that move, where no visual hull empties space: 0.1 "
    "where images have times and alpha, else 0",
)
DISTORTION = Loss(
    distortion_loss,
    infer=_weight_of_distortion,
    help="distortion of the weights (arXiv:2111.12077, Eq. 15); auto, for few views: 0.01 where a box bounds the "
    "scene, otherwise 0.001",
)
DEPTH = Loss(
    depth_loss,
    needs=("depth", "depth_weight"),
    weight="auto",
    infer=_weight_of_depth,
    fixed_order=False,  # it depends on sums over rays of its own
    help="distance of the weights from the dataset's sparse points, and from depths interpolated between them (after "
    "arXiv:2107.02791); auto: at the start of training where space is contracted and there are such points",
)
