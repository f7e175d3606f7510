"""Finds what a scene needs: trials of the complete model and of its variants, until the budget is spent."""

import contextlib
import json
import math
import pathlib
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from jaxnerf.runtime.atomic_files import partial_file, read_json, write_text
from jaxnerf.tools.needs import racing
from jaxnerf.tools.needs.racing import NEEDED, NOT_NEEDED, OPEN, Effect
from jaxnerf.tools.needs.trial import Result
from jaxnerf.tools.needs.variants import COMPLETE, LESS, MORE, WITHOUT, Variant, complete

LEAN = "lean"
CURVE = (1 / 27, 1 / 9, 1 / 3, 1.0)  # lengths of the runs of the curve, over the longest one
_TWO_SEEDS = 0.6  # of the budget, that two seeds of each variant are planned to fill
# What they and further seeds fill at most, as a machine that becomes slower needs more; the rest is the lean model's.
_MOST, _MOST_OF_TWO = 0.75, 0.85
_LEAST_SECONDS, _TRIALS_OF_BUDGET = 1.0, 100  # a trial is at least a hundredth of the budget
_ALIGNED_GAIN = 0.5  # dB that fitted colours gain, from which on all scores have them
_PACED = 1.2  # seconds of a trial that measures the machine's speed, over its own
_FULL = "full_"  # before the names of trials whose images are not shrunk
_REMEDY = "remove the folder, or give another --out"


class Settings(NamedTuple):
    """What a study is asked for.

    Attributes:
        budget: seconds of everything.
        margin: dB that a needed part contributes at least.
        equal: "seconds" or "steps", what paired runs have in common.
        length: seconds of a trial; 0: as the budget allows.
        lean: whether the lean model is sought, too; otherwise the curve is that of the complete model, as long as a
            trial.
    """

    budget: float
    margin: float
    equal: str = "seconds"
    length: float = 0.0
    lean: bool = True


class Plan(NamedTuple):
    """What is tried.

    Attributes:
        length: seconds of training of a trial.
        steps: of a trial where steps are equal; 0: seconds are.
        compiling: seconds until a variant can be trained and rendered.
        scoring: seconds of a trial that are neither that nor training.
        tried: the slugs of the variants, those tried first in front.
        spent: seconds before the first trial.
    """

    length: float
    steps: int
    compiling: float
    scoring: float
    tried: list[str]
    spent: float


class Row(NamedTuple):
    """A variant in the table.

    Attributes:
        variant: that was tried.
        effect: of its part; None: it was not tried, or could not be built.
        verdict: "needed", "not needed" or "cannot tell".
        note: why it was not tried; "" otherwise.
        results: of its trials, by seed.
    """

    variant: Variant
    effect: Effect | None
    verdict: str
    note: str
    results: dict[int, Result]


class Outcome(NamedTuple):
    """What a study found.

    Attributes:
        plan: Plan.
        rows: of all variants, in the order in which they were tried.
        complete: the trials of the complete model, by seed.
        lean: the variants that the lean model combines.
        lean_effect: what it loses in the longest run of the curve; None: it is the complete model.
        refused: combinations that the lean model does not make, with their effect there and the reason.
        longest: the results of the longest run, of "complete" and "lean".
        curve: {"complete" or "lean": [(seconds, dB)]}, of images that are not shrunk.
        aligned: whether all scores have fitted colours.
        spent: seconds.
    """

    plan: Plan
    rows: list[Row]
    complete: dict[int, Result]
    lean: list[Variant]
    lean_effect: Effect | None
    refused: list[tuple[list[Variant], Effect, str]]
    longest: dict[str, Result]
    curve: dict[str, list[tuple[float, float]]]
    aligned: bool
    spent: float


class Study:
    """A study in a folder, which holds a file for each trial that is done, so that it resumes."""

    def __init__(
        self,
        folder: pathlib.Path,
        settings: Settings,
        variants: Sequence[Variant],
        trainer: Any,
        *,
        full: tuple[Any, Mapping[str, Variant]] | None = None,
        check: Callable[[Result], None] = lambda result: None,
        say: Callable[[str], None] = print,
        started: float = 0.0,
    ):
        """Begins or continues a study.

        Args:
            folder: exists; what it holds of an earlier start is used.
            settings: of the study.
            variants: those to be tried first in front.
            trainer: with the functions `run` and `forget` of a `Trainer`.
            full: a trainer with images that are not shrunk, and the variants there, by slug; None: as the others.
            check: called with the first result of the complete model; raises a ValueError if it does not suffice.
            say: prints a line.
            started: seconds that the program has taken so far.
        """
        self.folder, self.settings, self.say = folder, settings, say
        self._trainer, self._check = trainer, check
        self._full_trainer, self._full = full or (trainer, {each.slug: each for each in variants})
        self._all, self._started = list(variants), started
        self.by_slug = {each.slug: each for each in [complete(), *variants]}
        self._done: dict[tuple[str, int, float], Result] = {}
        self.failed: dict[str, str] = {}
        self._pose, self._full_pose = any(each.aligned == "pose" for each in variants), False
        (folder / "trials").mkdir(exist_ok=True)

    def search(self) -> Outcome:
        """Runs all trials that are not done; returns what they say."""
        self.plan = self._read_plan() or self._make_plan()
        self._race()
        return self._outcome(*self._find_lean())

    @property
    def spent(self) -> float:
        """Seconds that all trials so far have taken, in this start and in earlier ones.

        What a later start compiles again is not counted, so that a study that was stopped decides as one that was not.
        """
        total, compiled = self.plan.spent, {COMPLETE}
        for (name, _, _), each in self._done.items():
            total += each.spent - (each.compile_seconds if name in compiled else 0)
            compiled.add(name)
        return total

    def _make_plan(self):
        settings = self.settings
        result, _ = self._trainer.run({}, 0, _LEAST_SECONDS)
        compiling, scoring = result.compile_seconds, max(result.spent - result.compile_seconds - result.seconds, 0)
        count, length = planned(settings, len(self._all), compiling, scoring)
        steps = max(round(result.steps * length / result.seconds), 1) if settings.equal == "steps" else 0
        tried = [each.slug for each in self._all[:count]]
        plan = Plan(length, steps, compiling, scoring, tried, self._started + result.spent)
        write_text(self.folder / "plan.json", json.dumps(plan._asdict(), indent=1) + "\n")
        return plan

    def _read_plan(self):
        path = self.folder / "plan.json"
        if not path.exists():
            return None
        plan = Plan(**read_json(path, _REMEDY))
        # A larger budget than before tries more.
        settings = self.settings._replace(length=plan.length)
        count = len(plan.tried)
        with contextlib.suppress(ValueError):
            count = max(count, planned(settings, len(self._all), plan.compiling, plan.scoring)[0])
        return plan._replace(tried=[each.slug for each in self._all[:count]])

    def trial(self, variant: Variant, seed: int, length: float, *, full: bool = False) -> Result | None:
        """Returns the result of a trial, which is run unless it is done; None if the variant fails.

        Args:
            variant: that is trained.
            seed: of the run.
            length: seconds of training.
            full: whether images are not shrunk, and time is what runs have in common.
        """
        if variant.slug in self.failed:
            return None
        key = f"{_FULL}{variant.slug}" if full else variant.slug, seed, length
        if key in self._done:
            return self._done[key]
        name = f"{key[0]}-{seed}-{length:.4g}"
        path = self.folder / "trials" / f"{name}.json"
        if not path.exists():
            self._run_trial(variant, seed, length, path, full)
        content = read_json(path, _REMEDY)
        if "failed" in content:
            self.failed[variant.slug] = content["failed"]
            self._trainer.forget(variant.values)
            return None
        self._done[key] = Result(**content)
        if variant.slug == COMPLETE and not full:
            self._check(self._done[key])
        return self._done[key]

    def _run_trial(self, variant, seed, length, path, full):
        steps = 0 if full else round(self.plan.steps * length / self.plan.length)
        pose = variant.aligned == "pose" or (variant.slug == COMPLETE and self._pose)
        pose = self._full_pose if full else pose  # it takes seconds, and longer in fog
        try:
            trainer = self._full_trainer if full else self._trainer
            result, images = trainer.run(variant.values, seed, length, steps=steps, pose=pose)
        except ValueError as error:
            if variant.slug == COMPLETE:
                raise
            self.say(f"{variant.name:32} cannot be tried: {error}")
            write_text(path, json.dumps({"failed": str(error)}) + "\n")
            return
        if seed == 0 and length == self.plan.length and not full:
            with partial_file(path.with_suffix(".npz"), ".tmp.npz") as partial:
                np.savez_compressed(partial, *images)
        write_text(path, json.dumps(result._asdict()) + "\n")
        self._say_trial(variant, (f"{_FULL}{COMPLETE}" if full else COMPLETE, seed, length), result)

    def _say_trial(self, variant, key, result):
        base, seed = self._done.get(key), key[1]
        beside = ""
        if base is not None and variant.slug != COMPLETE:
            beside = f" {float(np.mean(self._contribution(variant, base, result))):+6.2f} dB"
        self.say(
            f"{self.spent + result.spent:6.0f} s  {variant.name:32} seed {seed}  {np.mean(result.psnr):6.2f} dB"
            f"{beside or ' ' * 10}  {result.steps:,} steps in {result.seconds:.1f} s, compiled in "
            f"{result.compile_seconds:.1f} s"
        )

    def results(self, variant: Variant) -> dict[int, Result]:
        """Returns the trials of a variant of the usual length, by seed."""
        found = {key[1]: each for key, each in self._done.items() if key[::2] == (variant.slug, self.plan.length)}
        return dict(sorted(found.items()))

    @property
    def aligned(self) -> bool:
        """Whether the images' exposures differ so much that all scores need fitted colours."""
        found = self.results(complete()).values()
        gains = [np.mean(each.psnr_colors) - np.mean(each.psnr) for each in found]
        return bool(gains) and float(np.mean(gains)) > _ALIGNED_GAIN

    def _contribution(self, variant, base, other):
        """Returns what a variant's part contributes to each view, dB."""
        gained = np.subtract(*(self._scores(each, variant.aligned) for each in (other, base)))
        return gained if variant.adds else -gained

    def differences(self, variant: Variant) -> Float[np.ndarray, "S V"]:
        """Returns what the part of a variant contributes, dB [seeds, views]."""
        base, found = self.results(complete()), self.results(variant)
        return np.stack([self._contribution(variant, base[seed], found[seed]) for seed in found if seed in base])

    def effects(self) -> dict[str, Effect]:
        """Returns the effects of the variants that have been tried, by slug."""
        tried = [self.by_slug[slug] for slug in self.plan.tried if self.results(self.by_slug[slug])]
        return racing.effects({each.slug: self.differences(each) for each in tried})

    def _race(self):
        """Runs trials while a verdict is open and the budget lasts."""
        while True:
            done = {slug: len(self.results(each)) for slug, each in self.by_slug.items()}
            following = racing.next_trial(done, self._open(done), COMPLETE)
            if following is None:
                return
            slug, seed = following
            compiles = 0.0 if done.get(slug) else self.plan.compiling
            cost = (_PACED * self.plan.length + self.plan.scoring) * (2 if slug == COMPLETE else 1) + compiles
            most = _MOST_OF_TWO if seed < racing.LOOKS[0] else _MOST
            if self.spent + cost > most * self.settings.budget:
                return
            self.trial(self.by_slug[slug], seed, self.plan.length)

    def _open(self, done):
        """Returns the slugs of variants whose verdict is open, those nearest to a verdict first."""
        known, found = self.effects(), []
        for slug in self.plan.tried:
            if slug in self.failed:
                continue
            looked = slug in known and done[slug] in racing.LOOKS
            if looked and known[slug].verdict(self.settings.margin) != OPEN:
                self._trainer.forget(self.by_slug[slug].values)
            else:
                found.append(slug)
        if any(slug not in known for slug in found):
            return found  # in the order of the plan
        return sorted(found, key=lambda slug: -abs(known[slug].mean - self.settings.margin))

    def _find_lean(self):
        """Returns the variants that the lean model combines, its effect, what was refused, and the longest length.

        Images are as large as the run's own here, and the longest runs take what is left of the budget, as what short
        runs of small images do without may be missed later.
        """
        if not self.settings.lean:
            return [], None, [], self.plan.length
        known, margin = self.effects(), self.settings.margin
        wanted = [slug for slug, each in known.items() if _improves(self.by_slug[slug], each.verdict(margin))]
        chosen = _one_each([self._full[slug] for slug in wanted if slug in self._full])
        smaller = [each for each in chosen if each.change != LESS]
        self._full_pose = any(each.aligned == "pose" for each in chosen)
        length, refused = self._longest(), []
        base = self.trial(complete(), 0, length, full=True)
        for each in [chosen, smaller] if len(smaller) < len(chosen) else [chosen]:
            lean = combined(each)
            if not each or (refused and self.spent + self.plan.compiling + length > self.settings.budget):
                break
            other = self.trial(lean, 0, length, full=True)
            if other is None:
                continue
            found = self._contribution(lean, base, other)[None]
            others = {slug: self.differences(self.by_slug[slug]) for slug in known}
            effect = racing.effects({**others, LEAN: found})[LEAN]
            why = self._objection(each, effect, length)
            if not why:
                return each, effect, refused, length
            refused.append((each, effect, why))
        return [], None, refused, length

    def _objection(self, chosen, effect, length):
        """Returns why the lean model does not combine some variants, from runs of this length; "" if it does."""
        margin, images = self.settings.margin, "with images that are not shrunk"
        if effect.mean > margin:
            return f"together they lose {effect.mean:.2f} dB after {length:.0f} s {images}"
        if all(each.change != LESS for each in chosen):
            return ""
        # A smaller model takes more steps in the same time, and learns faster at first.
        lean, shorter = combined(chosen), CURVE[-2] * length
        base, other = (self.trial(each, 0, shorter, full=True) for each in (complete(), lean))
        before = float(np.mean(self._contribution(lean, base, other)))
        if effect.mean - before <= margin:
            return ""
        return (
            f"together they gain {-before:.2f} dB after {shorter:.0f} s and {-effect.mean:.2f} dB after {length:.0f} s "
            f"{images}, so that a longer run may lose"
        )

    def _longest(self):
        """Returns the seconds of the longest runs of the curve, which take what is left of the budget."""
        path = self.folder / "curve.json"
        if not path.exists():
            left = self.settings.budget - self.spent - 3 * self.plan.compiling
            length = max(left / _PACED / (3 + 2 * (sum(CURVE) - 1)), self.plan.length, _LEAST_SECONDS)
            write_text(path, json.dumps({"length": length}) + "\n")
        return float(read_json(path, _REMEDY)["length"])

    def _curve(self, chosen, longest):
        models = {COMPLETE: complete(), **({LEAN: combined(chosen)} if chosen else {})}
        curve, last, aligned = {}, {}, combined(chosen).aligned
        for name, variant in models.items():
            points = [self.trial(variant, 0, fraction * longest, full=True) for fraction in CURVE]
            curve[name] = [(each.seconds, float(np.mean(self._scores(each, aligned)))) for each in points]
            last[name] = points[-1]
        return curve, last

    def _scores(self, result, aligned):
        """Returns the scores of the views, dB; aligned: see `Ablation`."""
        return getattr(result, "_".join(["psnr", *([aligned or "colors"] if aligned or self.aligned else [])]))

    def _outcome(self, lean, effect, refused, longest):
        known, rows = self.effects(), []
        curve, last = self._curve(lean, longest)
        for variant in self._all:
            found = known.get(variant.slug)
            note = self.failed.get(variant.slug, "" if found else "not tried within this budget")
            verdict = found.verdict(self.settings.margin) if found and not note else OPEN
            rows.append(Row(variant, found, verdict, note, self.results(variant)))
        aligned = self.aligned
        return Outcome(
            self.plan, rows, self.results(complete()), lean, effect, refused, last, curve, aligned, self.spent
        )


def planned(settings: Settings, count: int, compiling: float, scoring: float) -> tuple[int, float]:
    """Returns how many variants are tried, and the seconds of a trial.

    Two seeds of each fit into a good part of the budget. With more variants than fit, the last ones are not tried.

    Args:
        settings: with the budget.
        count: of all variants.
        compiling: seconds of a variant's first trial that are not training.
        scoring: of every trial.

    Raises:
        ValueError: if the budget does not suffice for one pair.
    """
    most = _TWO_SEEDS * settings.budget
    least = settings.length or max(_LEAST_SECONDS, settings.budget / _TRIALS_OF_BUDGET)

    def fixed(number):
        return (number + 1) * compiling + 2 * (number + 1) * scoring

    def trials(number):
        return _PACED * 2 * (number + 1)

    fitting = [number for number in range(1, count + 1) if fixed(number) + trials(number) * least <= most]
    if not fitting:
        needed = (fixed(1) + trials(1) * (settings.length or _LEAST_SECONDS)) / _TWO_SEEDS
        raise ValueError(
            f"--budget is {settings.budget:.0f} s, expected at least {math.ceil(needed)} s for one pair of trials, as "
            f"compiling takes {compiling:.0f} s a model"
        )
    number = fitting[-1]
    return number, settings.length or (most - fixed(number)) / trials(number)


def combined(variants: Sequence[Variant]) -> Variant:
    """Returns the variant that makes all changes of some."""
    values = {key: value for each in variants for key, value in each.values.items()}
    before = {key: value for each in variants for key, value in each.before.items()}
    names = "_".join(sorted(each.slug for each in variants))
    aligned = max((each.aligned for each in variants), default="")  # a fitted pose also needs the other's
    return Variant(
        f"{LEAN}: {names}" if len(names) < 100 else f"{LEAN}: {len(variants)} changes", "", values, before, aligned
    )


def _improves(variant, verdict):
    """Returns whether the lean model makes a variant's change."""
    return verdict == (NEEDED if variant.adds else NOT_NEEDED)


def _one_each(variants):
    """Returns the variants without second changes of a part; removing it wins."""
    best = {}
    for each in variants:
        other = best.get(each.part)
        if other is None or (each.change == WITHOUT and other.change == LESS):
            best[each.part] = each
    return [each for each in variants if best[each.part] is each and each.change in (WITHOUT, LESS, MORE)]
