"""The scene: the box that bounds it, whether the box holds all of space, and the colour behind it."""

import dataclasses
import math

import numpy as np

from jaxnerf.core.views import Views
from jaxnerf.data.facts import LookAt, mean_color
from jaxnerf.data.geometry import visual_hull
from jaxnerf.data.ray_batches import view_rays
from jaxnerf.options import AUTO, Ablation, Box, Options, infer, is_auto, numbers, option, replaced

BACKGROUNDS = {"white": (1.0, 1.0, 1.0), "black": (0.0, 0.0, 0.0), "none": None}
# Space is not contracted as far as the cameras, so that cells near them are small: large ones fill with fog. But the
# cube is at most this many times as large as that which most images show: what they look at gets fewer cells then.
_MAX_INNER_BOX = 3.0
# Times twice the side of the cube that most images show; a stated box that is larger is no better than contraction.
_MAX_STATED_BOX = 3.0
# How much the colour around an object may differ within an image and between images, and the least fraction of the
# border's pixels that have it. Of what some image shows, at least the last fraction has this colour in the mean image:
# the border of a fish-eye image is as black, but at the same pixels everywhere.
_PLAIN, _PLAIN_BORDER, _PLAIN_FRACTION = 0.1, 0.9, 0.1
_PLAIN_VIEWS, _PLAIN_PIXELS = 32, 64  # that are looked at: views, and pixels along a side


def _wrong_color(color):
    right = len(color) in (0, 3) and all(isinstance(each, int | float) and 0 <= each <= 1 for each in color)
    return None if right else "red, green and blue in [0, 1], or () for black"


def _contraction(value, options, facts):
    """Returns True where contracted space could hold more than the box; see `Ablation`."""
    return None if facts.ndc or facts.has_alpha else True


@dataclasses.dataclass(frozen=True)
class SceneOptions(Options):
    """The options of the scene: where it is, and what is behind it."""

    use_alpha: bool = option(
        True,
        "whether alpha bounds the scene: its box, and the cells of an occupancy grid, of which those outside the "
        "visual hull of the alpha channels are empty from the start",
        ablations=(
            Ablation(
                "visual hull", without=lambda value, options, facts: False if facts.has_alpha else None, more=True
            ),
        ),
    )
    contracted: bool = option(
        AUTO,
        "whether the box holds all of space; positions outside its inner half are then contracted",
        auto=True,
        ablations=(Ablation("contraction of space", without=False, more=_contraction),),
    )
    lower: tuple[float, ...] = option(AUTO, "a corner of the box", unit="world units", auto=True, check=numbers(3))
    upper: tuple[float, ...] = option(
        AUTO, "the opposite corner of the box", unit="world units", auto=True, check=numbers(3)
    )
    background: tuple[float, ...] = option(
        AUTO,
        "The colour behind the scene where `data.background` is `none`: red, green, blue in [0, 1], or () for black. "
        "auto: the colour around the object where all images have the same one there; the mean of the training images "
        "where space is contracted and empty cells are skipped; otherwise black.",
        auto=True,
        check=_wrong_color,
        ablations=(Ablation("colour behind the scene", without=()),),
    )

    @property
    def box(self) -> Box | None:
        """The corners of the box; None where one is "auto"."""
        return None if is_auto(self.lower) or is_auto(self.upper) else (self.lower, self.upper)

    def color_behind(self, behind_alpha: str) -> tuple[float, ...] | None:
        """Returns the colour behind the scene, of resolved options; None: black.

        Args:
            behind_alpha: `data.background`.

        Raises:
            ValueError: if the colour is "auto".
        """
        if behind_alpha != "none" or len(self.background) == 0:
            return BACKGROUNDS[behind_alpha]
        if is_auto(self.background):
            raise ValueError(
                "scene.background is 'auto'; resolve the config against a dataset, or set red, green and blue, or () "
                "for black"
            )
        return tuple(self.background)


def outlined_by_alpha(scene: SceneOptions, views: Views, *, ndc: bool) -> bool:
    """Returns whether alpha shows that nothing surrounds a scene."""
    return scene.use_alpha and views.pixels.shape[-1] == 4 and not ndc


def bounded_by_alpha(scene: SceneOptions, views: Views, *, ndc: bool, refined: bool) -> bool:
    """Returns whether alpha bounds a scene.

    It does not if the scene moves: no image then shows where all of it ever is. Nor does it where poses are refined:
    the outlines of wrong poses cut matter away.
    """
    return outlined_by_alpha(scene, views, ndc=ndc) and views.time is None and not refined


def resolve_scene(
    scene: SceneOptions, views: Views, *, ndc: bool, world: str, outlined: bool, has_alpha: bool
) -> tuple[SceneOptions, list[str]]:
    """Infers the box and whether it holds all of space, from what the cameras look at and what alpha leaves.

    Args:
        scene: the options; `background` stays, see `resolve_background`.
        views: of the split "train".
        ndc: whether rays are in normalised device coordinates.
        world: see `DataOptions`.
        outlined: whether alpha shows that nothing surrounds the scene.
        has_alpha: whether alpha bounds the box.

    Returns:
        The options, and one line per inferred value with its reason.

    Raises:
        ValueError: if the box is empty.
    """
    contracted, why = _contracted(views, outlined, ndc=ndc, world=world)
    line = f"contraction   {'on' if contracted else 'off'}: {why}"
    scene, lines = infer(scene, contracted=(contracted, line))
    if scene.box is None:
        *corners, why = _box(views, has_alpha, ndc=ndc, contracted=scene.contracted)
        digits = 4 - math.floor(math.log10(max(corners[1] - corners[0])))
        lower, upper = (tuple(round(float(x), digits) for x in corner) for corner in corners)
        scene, _ = infer(scene, lower=(lower, ""), upper=(upper, ""))
        lines.append(f"box           {_point(scene.lower)} to {_point(scene.upper)}, {why}")
    if not max(high - low for low, high in zip(*scene.box, strict=True)) > 0:
        raise ValueError(f"scene.lower is {scene.lower} and scene.upper {scene.upper}, expected lower < upper")
    return scene, lines


def resolve_background(
    scene: SceneOptions, views: Views, *, behind_alpha: str, fills_space: bool
) -> tuple[SceneOptions, list[str]]:
    """Infers the colour behind the scene.

    Distant walls and sky have little texture, so training leaves them partly transparent. With black behind them they
    are too dark, and bright fog in front of single cameras takes their place.

    Args:
        scene: the options, otherwise resolved.
        views: of the split "train".
        behind_alpha: `data.background`.
        fills_space: see `Facts`.

    Returns:
        The options, and one line per inferred value.
    """
    color = scene.background
    if is_auto(color):
        around = None if behind_alpha != "none" or scene.contracted else plain_border(views)
        if around is not None:
            return replaced(scene, background=around), [
                f"behind        {around}, which surrounds the object in all images"
            ]
        if behind_alpha != "none" or not fills_space:
            return replaced(scene, background=()), []
        color = tuple(round(value, 3) for value in mean_color(views))
        return replaced(scene, background=color), [f"behind        {color}, the mean colour of the training images"]
    if len(color) and behind_alpha != "none":
        raise ValueError(
            f"scene.background is {tuple(color)} and data.background {behind_alpha!r}, which is behind the scene, too; "
            "set data.background to 'none', or scene.background to ()"
        )
    return scene, []


def _contracted(views, outlined, *, ndc, world):
    """Returns whether the box holds all of space, and why."""
    if ndc:
        return False, "normalised device coordinates hold everything in view"
    if world != "around":
        return False, f"the world is {world!r}"
    if views.box is not None:
        side = float(np.max(np.asarray(views.box[1]) - np.asarray(views.box[0])))
        if side <= _MAX_STATED_BOX * 4 * LookAt(views).inner_half_side:
            return False, "the dataset states the scene's bounds"
    if outlined:
        return False, "alpha bounds the object"
    if plain_border(views) is not None:
        return False, "one colour surrounds the object in all images"
    return True, "nothing bounds the surroundings"


def plain_border(views: Views) -> tuple[float, ...] | None:
    """Returns the colour around an object in images without alpha, as renderings and cut-out images have it.

    Args:
        views: of the split "train".

    Returns:
        Red, green and blue in [0, 1]; None where images have alpha or a mask, where their borders have no single
        colour, or where the pixels of this colour are the same in all images.
    """
    if views.pixels.shape[-1] == 4 or views.mask is not None:
        return None
    found, color, largest = [], None, np.iinfo(views.pixels.dtype).max
    for index in np.unique(np.linspace(0, len(views.size) - 1, _PLAIN_VIEWS).astype(int)):
        (height, width), first = views.size[index], views.offset[index]
        image = np.asarray(views.pixels[first : first + height * width]).reshape(height, width, 3)
        border = np.concatenate([image[0], image[-1], image[:, 0], image[:, -1]]) / largest
        color = np.median(border, axis=0) if color is None else color
        if (np.abs(border - color) < _PLAIN).all(axis=-1).mean() < _PLAIN_BORDER:
            return None
        rows, columns = (np.linspace(0, side - 1, _PLAIN_PIXELS).astype(int) for side in (height, width))
        found.append((np.abs(image[np.ix_(rows, columns)] / largest - color) < _PLAIN).all(axis=-1))
    somewhere = ~np.all(found, axis=0)
    if not somewhere.any() or np.mean(found, axis=0)[somewhere].mean() < _PLAIN_FRACTION:
        return None
    return tuple(round(float(value), 3) for value in color)


def _box(views, has_alpha, *, ndc, contracted):
    """Returns lower [3], upper [3], and how they were found."""
    if ndc:
        return *_ends_of_rays(views), "the bounds of all rays"
    if views.box is not None and not contracted:
        return *np.asarray(views.box, np.float64), "as the dataset states"
    look_at = LookAt(views)
    if contracted:
        seen = look_at.inner_half_side
        half, why = max((seen, "as far as most images show"), (look_at.reach, "where the cameras are"))
        if half > _MAX_INNER_BOX * seen:
            half, why = _MAX_INNER_BOX * seen, f"{_MAX_INNER_BOX:g} times as far as most images show"
        why = f"not contracted within {half:.2g} of its centre, {why}"
        return look_at.center - 2 * half, look_at.center + 2 * half, why
    half = look_at.half_size.max()
    lower, upper = look_at.center - half, look_at.center + half
    if not has_alpha:
        return lower, upper, "as large as the images at the point that all cameras look at"
    return *visual_hull.hull_bounds(views, lower, upper), "the bounds of the visual hull"


def _ends_of_rays(views):
    """Returns lower [3] and upper [3] of all rays: NDC rays are straight, so the corners' rays bound all."""
    ends = []
    for index, (height, width) in enumerate(np.asarray(views.size)):
        corners = np.float32([[0, 0], [width, 0], [0, height], [width, height]])
        rays = view_rays(views, index, corners, ndc=True)
        for t in (rays.near, rays.far):
            ends.append(np.asarray(rays.origins + t[:, None] * rays.directions))
    ends = np.concatenate(ends)
    return ends.min(axis=0), ends.max(axis=0)


def _point(point):
    return "(" + ", ".join(f"{value:.2f}" for value in point) + ")"
