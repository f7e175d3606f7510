"""Tests of jaxnerf-needs: verdicts, the race with invented trials, resuming, files, and a plug-in's part."""

import dataclasses
import json
import math

import jax.numpy as jnp
import numpy as np
import pytest

import captures
import jaxnerf
from jaxnerf.configs import capture, lego_fast, smoke
from jaxnerf.extend import Ablation, Field, Options, option
from jaxnerf.options import Facts
from jaxnerf.registry import FIELDS, LOSSES
from jaxnerf.tools.needs import pacing, page, racing, study
from jaxnerf.tools.needs.study import Settings, Study
from jaxnerf.tools.needs.trial import Result
from jaxnerf.tools.needs.variants import Variant, find_variants
from jaxnerf.training.config import changed, read_config

VIEWS = 8
RNG_OF_VIEWS = np.random.default_rng(1).normal(size=VIEWS)
FACTS = Facts(num_views=20, side=100.0, footprint=0.01)


def variant(part, change="without", **values):
    return Variant(part, change, values or {part: change})


class Trials:
    """Invents trials: each variant has a true effect on the score, dB, and the seeds some noise."""

    def __init__(self, effects, noise=0.03, compiling=10.0, stop_after=math.inf):
        self.effects, self.noise, self.compiling, self.stop_after = effects, noise, compiling, stop_after
        self.calls, self.compiled = [], set()

    def forget(self, values):
        pass

    def run(self, values, seed, length, *, steps=0, pose=False):
        if len(self.calls) >= self.stop_after:
            raise KeyboardInterrupt
        self.calls.append((tuple(sorted(values)), seed, length))
        if "broken" in values:
            raise ValueError("it cannot be built")
        compiling = self.compiling * (tuple(values) not in self.compiled)
        self.compiled.add(tuple(values))
        rng = np.random.default_rng([seed, round(10 * length), *map(len, sorted(values))])
        effects = [self.effects.get(key, 0.0) for key in values]
        gained = sum(each(length) if callable(each) else each for each in effects)
        score = 25 + 2 * math.log2(length) + gained + RNG_OF_VIEWS
        score = score + self.noise * rng.normal() + self.noise * rng.normal(size=VIEWS)
        result = Result(
            psnr=list(score),
            psnr_colors=list(score),
            psnr_pose=list(score) if pose else None,
            steps=steps or round(50 * length),
            seconds=length,
            spent=length + compiling + 0.5,
            compile_seconds=compiling,
            frame_seconds=0.1,
            parameters=1000,
            memory=1e6,
        )
        return result, [np.full((4, 6, 3), 10 * len(values) + seed, np.uint8)] * VIEWS


EFFECTS = {"views": -1.5, "hull": -0.3, "encoding": 0.2, "poses": 0.9, "exposure": -0.6, "levels": -0.11}
VARIANTS = [
    variant("views"),
    variant("hull"),
    variant("encoding"),
    variant("poses", "more"),
    variant("exposure", "more"),
    variant("levels", "less"),
]


def run_study(folder, trials, *, budget=2000.0, variants=VARIANTS, **settings):
    folder.mkdir(exist_ok=True)
    lines = []
    found = Study(folder, Settings(budget, 0.1, **settings), variants, trials, say=lines.append)
    return found.search(), lines


def verdicts(outcome):
    return {row.variant.part: row.verdict for row in outcome.rows}


def test_verdicts_are_those_of_the_true_effects(tmp_path):
    outcome, lines = run_study(tmp_path / "a", Trials(EFFECTS), length=20.0)
    assert verdicts(outcome) == {
        "views": "needed",
        "hull": "needed",
        "encoding": "not needed",
        "poses": "needed",
        "exposure": "not needed",
        "levels": "cannot tell",  # its effect is the margin
    }
    seeds = {row.variant.part: len(row.results) for row in outcome.rows}
    assert seeds["levels"] == racing.LOOKS[-1] > seeds["hull"], "the budget goes where the verdict is open"
    assert outcome.spent <= 2000 and len(lines) > 12
    assert {each.part for each in outcome.lean} == {"encoding", "poses"}
    assert outcome.lean_effect.mean == pytest.approx(-1.1, abs=0.1) and not outcome.refused


@pytest.mark.parametrize("change, kept", [("less", False), ("without", True)])
def test_a_smaller_model_whose_gain_shrinks_with_time_is_refused(tmp_path, change, kept):
    """It takes more steps in the same time, which helps at first."""
    trials = Trials({"rows": lambda length: 8 - math.log2(length)})
    outcome, _ = run_study(tmp_path / "a", trials, budget=100.0, variants=[variant("rows", change)], length=1.0)
    assert verdicts(outcome) == {"rows": "not needed"} and bool(outcome.lean) == kept
    assert ["a longer run may lose" in why for *_, why in outcome.refused] == [True] * (not kept)


def test_the_budget_is_kept_and_what_is_not_tried_is_named(tmp_path):
    trials = Trials(EFFECTS)
    outcome, _ = run_study(tmp_path / "a", trials, budget=120.0)
    tried = [row for row in outcome.rows if row.results]
    assert 1 <= len(tried) < len(VARIANTS) and outcome.spent <= 120
    assert all("budget" in row.note and row.verdict == "cannot tell" for row in outcome.rows if not row.results)
    with pytest.raises(ValueError, match="--budget is 30 s, expected at least [0-9]+ s for one pair"):
        run_study(tmp_path / "b", Trials(EFFECTS), budget=30.0)


def test_a_study_that_is_stopped_continues_with_the_same_verdicts(tmp_path):
    whole, _ = run_study(tmp_path / "whole", Trials(EFFECTS), budget=700.0)
    for stop_after in (3, 5, 2, 6):
        with pytest.raises(KeyboardInterrupt):
            run_study(tmp_path / "parts", Trials(EFFECTS, stop_after=stop_after), budget=700.0)
    last = Trials(EFFECTS)
    again, _ = run_study(tmp_path / "parts", last, budget=700.0)
    assert verdicts(again) == verdicts(whole)
    assert len(set(last.calls)) == len(last.calls)
    finished = Trials(EFFECTS)
    run_study(tmp_path / "parts", finished, budget=700.0)
    assert not finished.calls, "a finished study runs nothing"


def test_equal_steps(tmp_path):
    outcome, _ = run_study(tmp_path / "a", Trials(EFFECTS), equal="steps", length=10.0)
    found = {result.steps for row in outcome.rows for result in row.results.values()}
    assert found == {500} and outcome.plan.steps == 500


def test_a_variant_that_cannot_be_built_is_named(tmp_path):
    broken = Variant("rays", "without", {"broken": 1})
    outcome, _ = run_study(tmp_path / "a", Trials(EFFECTS), variants=[*VARIANTS, broken])
    assert outcome.rows[-1].note == "it cannot be built" and outcome.rows[-1].verdict == "cannot tell"
    assert verdicts(outcome)["views"] == "needed"


def test_intervals_hold_their_level():
    """Parts that contribute exactly the margin are wrongly judged at most as often as the level says."""
    rng, wrong, count = np.random.default_rng(0), 0, 300
    for _ in range(count):
        seeds, views = rng.normal(scale=0.08, size=(8, 2, 1)), rng.normal(scale=0.2, size=(8, 1, 8))
        noise = rng.normal(scale=0.05, size=(8, 2, 8))
        found = racing.effects(dict(zip("abcdefgh", 0.1 + seeds + views + noise, strict=True)))
        wrong += sum(each.verdict(0.1) != "cannot tell" for each in found.values())
    assert wrong / (8 * count) < 0.05
    assert wrong > 0, "an interval that is never wrong is too wide"


def test_one_seed_alone_says_nothing():
    (only,) = racing.effects({"a": np.full((1, 8), 3.0)}).values()
    assert only.verdict(0.1) == "cannot tell" and only.lower == -math.inf
    # The seeds of others give it an interval, but training may have failed with this one.
    found = racing.effects({"a": np.full((1, 8), 3.0), "b": np.array([[0.1] * 8, [0.2] * 8])})
    assert 0.5 < found["a"].lower < 3 and found["a"].verdict(0.1) == "cannot tell"
    found = racing.effects({"a": np.full((2, 8), 3.0), "b": np.array([[0.1] * 8, [0.2] * 8])})
    assert found["a"].verdict(0.1) == "needed"


def test_parts_come_from_declarations():
    config = changed(
        read_config(lego_fast.get_config()),
        {
            "hash_grid.resolutions": (16, 32, 64),
            "hash_grid.table_size": 2**14,
            "hash_grid.width": 64,
            "hash_grid.view_width": 64,
            "hash_grid.view_depth": 2,
            "hash_grid.prefilter": False,
            "occupancy.step_size": 0.1,
            "train.rays_per_side": 2,
            "scene.contracted": False,
            "scene.lower": (-1.0, -1.0, -1.0),
            "scene.upper": (1.0, 1.0, 1.0),
            "scene.background": (),
        },
    )
    found = {each.name: each.values for each in find_variants(config, FACTS._replace(has_alpha=True))}
    assert found["view dependence, without"] == {"hash_grid.use_viewdirs": False}
    assert found["width of the networks, less"] == {"hash_grid.width": 32, "hash_grid.view_width": 32}
    assert found["levels, less"] == {"hash_grid.resolutions": (16, 32)}
    assert found["samples a ray, less"] == {"occupancy.step_size": 0.2}
    assert found["visual hull, without"] == {"scene.use_alpha": False}
    assert found["several rays a pixel, without"] == {"train.rays_per_side": 1}
    assert found["loss distortion, more"] == {"losses.distortion": 0.01}
    assert "contraction of space, more" not in found, "alpha bounds the scene"
    assert not any(name.startswith("loss mse") for name in found), "nothing else compares colours"
    for each in find_variants(config, FACTS):
        assert changed(config, each.values) != config, each.name
    open_scene = {each.name for each in find_variants(config, FACTS)}
    assert "contraction of space, more" in open_scene and "visual hull, without" not in open_scene
    order = [each.change for each in find_variants(config, FACTS)]
    assert order == sorted(order, key=["without", "more", "less"].index) or order[-1] == "more"


def test_the_paper_s_network_has_parts_in_both_networks():
    found = {each.name: each.values for each in find_variants(read_config(smoke.get_config()), FACTS)}
    assert found["coarse network, without"] == {"sampling.num_coarse": 16, "sampling.num_fine": 0}
    assert found["positional encoding, without"] == {"coarse.encode": False, "fine.encode": False}
    assert not any("space" in name for name in found), "a run without a box has no contraction"


@dataclasses.dataclass(frozen=True)
class BlobOptions(Options):
    sharp: bool = option(True, "whether it is sharp", ablations=(Ablation("sharpness", without=False),))
    size: int = option(4, "its size", ablations=(Ablation("blobs", less=lambda size, *_: size // 2),))


def blob_field(options, box):
    return Field(lambda key: {"a": jnp.zeros(3)}, lambda params, x, viewdirs: (x[..., 0] * 0, x * 0 + params["a"]))


def test_a_plug_in_s_part_appears(tmp_path, monkeypatch):
    monkeypatch.setattr(FIELDS, "_parts", dict(FIELDS._parts))
    monkeypatch.setattr(LOSSES, "_parts", dict(LOSSES._parts))
    jaxnerf.register_field("blobs", blob_field, options=BlobOptions)
    jaxnerf.register_loss("pale", lambda outputs, batch: 0.0, weight=0.1)
    config = capture.get_config()
    config.field = "blobs"
    config = changed(read_config(config), {"losses.pale": 0.1, "scene.lower": (0, 0, 0), "scene.upper": (1, 1, 1)})
    config = changed(config, {"occupancy.step_size": 0.1, "scene.contracted": False, "scene.background": ()})
    found = {each.name: each for each in find_variants(config, FACTS)}
    assert found["sharpness, without"].values == {"blobs.sharp": False}
    assert found["blobs, less"].values == {"blobs.size": 2}
    assert found["loss pale, without"].values == {"losses.pale": 0.0}
    assert not any("hash_grid" in key for each in found.values() for key in each.values)
    chosen = [found["sharpness, without"], found["blobs, less"]]
    outcome, _ = run_study(tmp_path / "a", Trials({"blobs.sharp": -1.0, "blobs.size": 0.3}), variants=chosen)
    table = "\n".join(page.text_table(outcome))
    assert "sharpness" in table and "needed" in table and "blobs.size 4 -> 2" in table


def test_files_of_the_result(tmp_path):
    outcome, _ = run_study(tmp_path / "a", Trials(EFFECTS))
    results = json.loads(json.dumps(page.results(outcome, Settings(2000.0, 0.1))))
    assert {row["part"]: row["verdict"] for row in results["parts"]} == verdicts(outcome)
    assert results["lean"]["effect"]["mean"] < 0
    rows = page.curve_csv(outcome).splitlines()
    assert rows[0] == "model,seconds,psnr,knee" and len(rows) == 1 + 2 * len(study.CURVE)
    assert sum(row.endswith(",1") for row in rows) == 2
    asked = read_config(lego_fast.get_config())
    lean = changed(asked, {"hash_grid.use_viewdirs": False})
    namespace = {}
    exec(page.config_file(asked, lean, outcome), namespace)
    config = namespace["get_config"]()
    assert read_config(config).to_dict() == lean.to_dict()
    config.hash_grid.width = 32  # a field that was "auto" keeps its type


class FakeMachine:
    """A clock, and a machine that becomes slower after some time."""

    def __init__(self, slower_from, factor):
        self.now, self.slower_from, self.factor = 0.0, slower_from, factor

    def clock(self):
        return self.now

    def take(self, count, cost=0.01):
        self.now += count * cost * (self.factor if self.now > self.slower_from else 1.0)


def test_a_slower_machine_does_not_change_the_steps_of_a_trial(tmp_path):
    machine = FakeMachine(slower_from=8.0, factor=1.7)
    pacer = pacing.Pacer(machine.take, machine.clock, tmp_path / "pace.json")
    assert pacer.nominal == pytest.approx(0.01)

    def steps_in(length):
        clock, done = pacing.PacedClock(machine.clock, pacer), 0
        while clock.seconds() < length:
            machine.take(1, cost=0.02)
            clock.probe()
            done += 1
        return done

    assert steps_in(5.0) == pytest.approx(250, rel=0.02)
    assert steps_in(5.0) == pytest.approx(250, rel=0.04)
    again = pacing.Pacer(machine.take, machine.clock, tmp_path / "pace.json")
    assert again.nominal == pacer.nominal, "a resumed study keeps the nominal speed"


def test_seconds_do_not_jump_when_the_speed_is_measured(tmp_path):
    machine = FakeMachine(slower_from=4.0, factor=1.7)
    pacer = pacing.Pacer(machine.take, machine.clock, tmp_path / "pace.json")
    clock = pacing.PacedClock(machine.clock, pacer)
    for _ in range(300):
        machine.take(1, cost=0.02)
        before = clock.seconds()
        clock.probe()
        assert clock.seconds() == pytest.approx(before), "the learning rate of a trial has to reach its end"


def test_the_page_holds_everything(tmp_path, capsys):
    folder = tmp_path / "a"
    outcome, _ = run_study(folder, Trials(EFFECTS))
    held_out = captures.black_views(captures.orbit(VIEWS, height=4, width=6))
    asked = read_config(lego_fast.get_config())
    page.write(folder, outcome, Settings(2000.0, 0.1), asked, asked, held_out)
    text = (folder / "page.html").read_text()
    assert text.count("data:image/png") == 1 + len(VARIANTS), "the curve, and each part"
    assert all(part in text for part in EFFECTS) and "http" not in text
    names = {path.name for path in folder.iterdir()}
    assert {"page.html", "lean.py", "curve.csv", "curve.png", "results.json"} <= names
    printed = capsys.readouterr().out
    assert "needed, and not there" in printed and "lean " in printed and "*" in printed
