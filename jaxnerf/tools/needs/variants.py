"""The variants of a run: one part of the method removed, reduced or added, as the options' declarations say."""

from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

from jaxnerf.core.views import Views
from jaxnerf.data.facts import dataset_facts
from jaxnerf.data.scene import bounded_by_alpha
from jaxnerf.options import AUTO, Ablation, Facts, Options
from jaxnerf.registry import LOSSES, SAMPLERS
from jaxnerf.training.config import RunConfig, declared, used_sections

WITHOUT, LESS, MORE = CHANGES = ("without", "less", "more")
COMPLETE = "complete"


class Variant(NamedTuple):
    """A model that differs from the complete one in a part.

    Attributes:
        part: in words; "complete" of the complete model.
        change: "without", "less" or "more"; "" of the complete model.
        values: {"section.option": value} that differ.
        before: {"section.option": value} of the complete model.
        aligned: see `Ablation`.
    """

    part: str
    change: str
    values: Mapping[str, Any]
    before: Mapping[str, Any] = {}
    aligned: str = ""

    @property
    def name(self) -> str:
        """Returns the part and the change, in words."""
        return f"{self.part}, {self.change}" if self.change else self.part

    @property
    def slug(self) -> str:
        """Returns the name for files."""
        return "_".join(self.name.replace(",", "").replace("/", " ").split())

    @property
    def adds(self) -> bool:
        """Returns whether the variant has more than the complete model."""
        return self.change == MORE

    def words(self) -> str:
        """Returns what changes: options, with their values before and after."""
        return ", ".join(f"{key} {_short(self.before.get(key))} -> {_short(self.values[key])}" for key in self.values)


def complete() -> Variant:
    """Returns the complete model."""
    return Variant(COMPLETE, "", {})


def find_variants(config: RunConfig, facts: Facts) -> list[Variant]:
    """Returns the variants of a run, in the order in which they are tried.

    First what a scene may do without, then what is off and may pay, then what may be smaller, and last what may be
    larger.

    Args:
        config: resolved.
        facts: about its dataset.
    """
    found: dict[tuple[str, str], Variant] = {}
    for key, value, options, ablation in _ablations(config):
        for change in CHANGES:
            new = getattr(ablation, change)
            new = new(value, options, facts) if callable(new) else new
            if new is None or new == value:
                continue
            before = found.get((ablation.part, change), Variant(ablation.part, change, {}, {}, ablation.aligned))
            values, old = {**before.values, key: new}, {**before.before, key: value}
            found[ablation.part, change] = before._replace(values=values, before=old)
    return sorted(found.values(), key=_order)


def _order(variant):
    is_switch = any(isinstance(value, bool) for value in variant.values.values()) or any(
        key.startswith("losses.") for key in variant.values
    )
    return {WITHOUT: 0, LESS: 2, MORE: 1 if is_switch else 3}[variant.change]


def _ablations(config) -> Iterator[tuple[str, Any, Options, Ablation]]:
    """Yields the name of an option, its value, the options of its part, and a declaration of what its part means."""
    sections, used = {"": config, **config.sections()}, used_sections(config)
    for key, option, _, value in declared(config):
        section = key.rpartition(".")[0]
        if section and section not in used or section == "scene" and not config.has_box:
            continue
        for ablation in option.ablations:
            yield key, value, sections[section], ablation
    for name, weight in config.losses.items():
        loss = LOSSES.get(name)
        # What compares colours stays: a loss of the renderings that is on by default.
        others = [LOSSES.get(other) for other, each in config.losses.items() if _is_on(each) and other != name]
        needed = not any(each.on == "renderings" and _is_on(each.weight) for each in others if each.infer is None)
        yield (
            f"losses.{name}",
            weight,
            config,
            Ablation(
                f"loss {name}",
                without=None if needed or not _is_on(weight) else 0.0,
                more=None
                if _is_on(weight) or loss.infer is None
                else lambda value, options, facts, loss=loss: loss.infer(facts)[0],
            ),
        )


def _is_on(weight):
    return not (isinstance(weight, int | float) and weight == 0)


def facts_of(config: RunConfig, views: Views) -> Facts:
    """Returns the facts about a dataset, as a resolved config has them.

    Args:
        config: resolved.
        views: of the split "train".
    """
    refined = config.cameras.refine
    has_alpha = bounded_by_alpha(config.scene, views, ndc=config.data.ndc, refined=refined) and config.has_box
    return dataset_facts(
        views,
        lower=config.scene.box[0],
        upper=config.scene.box[1],
        ndc=config.data.ndc,
        contracted=config.scene.contracted,
        has_alpha=has_alpha,
        factor=config.data.factor,
        skips_empty_cells=config.declared_by(SAMPLERS).skips_empty_cells,
        trains_cameras=config.cameras.any,
    )


def _short(value):
    if isinstance(value, float):
        return f"{value:.4g}"
    return str(value) if value != "" else AUTO
