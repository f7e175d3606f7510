"""Tests that names use the vocabulary of the NeRF literature, one word per idea.

Names are identifiers that the code defines, keys of configs, dictionaries and metrics, and flags.
"""

import ast
import importlib
import re

import pytest

from runs import ROOT

FOLDERS = ("examples", "experiments", "jaxnerf", "tests")

# Parts of a name that are not used, alone or in sequence, and what is used instead.
PARTS = {
    "alpha_masks": "use_alpha",
    "anew": "again",
    "ask": "evaluate",
    "asked": "evaluated",
    "asks": "evaluates",
    "assumed": "initial_density",
    "at_once": "microbatch, chunk or max_samples",
    "average_power": "averaging_power",
    "begin_again": "reinitialize",
    "block": "microbatch or chunk",
    "blocks": "microbatches or chunks",
    "capacity": "max_samples",
    "ema": "averaged",
    "hide": "max_optical_depth or occlusion_start_step",
    "lane": "slot",
    "lanes": "slots",
    "left_out": "dropped, skipped or excluded",
    "look_at_once": "cells_per_update",
    "made_whole": "fill",
    "make_look": "make_update",
    "may_meet": "may_hit",
    "num_looks": "num_updates",
    "passing": "transmittance",
    "photo": "image",
    "photograph": "image",
    "photographs": "images",
    "photos": "images",
    "picture": "image",
    "pictures": "images",
    "possible": "valid",
    "revival": "reinitialization",
    "revive": "reinitialize or max_reinits",
    "revived": "num_reinits",
    "room": "max_samples or free",
    "scene_dir": "dataset folder",
    "scene_folder": "dataset folder",
    "settle": "infer or resolve",
    "settled": "inferred or resolved",
    "settles": "infers or resolves",
    "share": "fraction",
    "shares": "fractions",
    "skip_empty": "sampler or bake_occupancy",
    "tell": "report",
    "tells": "reports",
    "that_meet": "active",
    "told": "reported",
    "unseen": "culled",
}

# Whole names that have been replaced.
NAMES = {
    "Grid": "OccupancyGrid",
    "Space": "GridSchedule",
    "block_size": "microbatch_size",
    "check_answer": "check_scene_output",
    "cut_to_box": "clip_rays_to_box",
    "entrances": "input_layers",
    "grid_field": "hash_grid_field",
    "grid_of_scene": "grid_from_scene",
    "importance_floor": "importance_padding",
    "live_pixels": "unmasked_pixels",
    "look": "update",
    "looks": "updates",
    "make_space": "make_grid_schedule",
    "needed_samples": "visible_samples",
    "occupied_at": "is_occupied",
    "open_run": "restore_run",
    "packed_model": "occupancy_model",
    "render_chosen": "render_selected",
    "render_nothing": "render_background",
    "rendered_params": "averaged_params",
    "restrict_scene": "mask_scene",
    "samples_in_box": "march_rays",
    "space": "occupancy",
    "stop": "early_stop_eps",
    "sum_until_stopped": "march_until_terminated",
    "view_packed": "render_with_grid",
    "without_fog": "drop_thin_density",
    "world_length": "segment_lengths",
}

# Keys of a config that have been replaced; elsewhere these names may have another meaning.
CONFIG_KEYS = {
    "features": "hash_grid",
    "keep": "max_to_keep",
    "masks": "use_alpha",
    "samples": "sample_multiplier",
    "samples_per_ray": "pool_samples_per_ray",
    "step": "step_size",
}

# Names that contain a word of the lists above with another meaning.
EXCEPTIONS = {
    "ask_for": "a scene asks by name for what it needs",
    "asks_for": "a scene asks by name for what it needs",
    "asked_for": "a scene asks by name for what it needs",
    "grad_ema": "a key in checkpoints of other projects",
    "macro_block_size": "an option of ffmpeg",
    "make_room": "the scene experiments/test_scenes/room.py",
    "request_share_url": "a method of viser",
    "score_room": "the scene experiments/test_scenes/room.py",
    "test_room": "the scene experiments/test_scenes/room.py",
}

# Whole names that are allowed, whatever the lists above hold.
WHOLE_EXCEPTIONS = {"room": "the scene experiments/test_scenes/room.py"}

NAME = re.compile(r"[A-Za-z_][A-Za-z0-9_]*")


def parts_of(name):
    """Returns the words of a name in lower case: those of "RayBatch" and "ray_batch" are ["ray", "batch"]."""
    return re.sub(r"([a-z0-9])([A-Z])", r"\1_\2", name).lower().strip("_").split("_")


def defined_names(tree):
    """Yields (line, name) of identifiers that are defined, of keys of dictionaries, and of flags."""
    for node in ast.walk(tree):
        line = getattr(node, "lineno", 0)
        match node:
            case ast.FunctionDef() | ast.ClassDef() | ast.AsyncFunctionDef():
                yield line, node.name
            case ast.arg():
                yield line, node.arg
            case ast.Name(ctx=ast.Store()):
                yield line, node.id
            case ast.Attribute(ctx=ast.Store()):
                yield line, node.attr
            case ast.alias(asname=str()):
                yield line, node.asname
            case ast.Dict():
                yield from ((line, key.value) for key in node.keys if _is_text(key))
            case ast.Subscript() if _is_text(node.slice):
                yield line, node.slice.value
            case ast.Call(func=ast.Attribute(attr=function)) if re.match("DEFINE|define_|add_argument", function):
                yield from ((line, first.value.lstrip("-")) for first in node.args[:1] if _is_text(first))


def _is_text(node):
    return isinstance(node, ast.Constant) and isinstance(node.value, str) and NAME.fullmatch(node.value.lstrip("-"))


def complaint(name):
    """Returns what a name should use instead, or None where it uses the vocabulary."""
    if name in WHOLE_EXCEPTIONS:
        return None
    parts = f"_{'_'.join(parts_of(name))}_"
    for known in EXCEPTIONS:
        parts = parts.replace(f"_{known}_", "_")
    found = [f"{part} -> {better}" for part, better in PARTS.items() if f"_{part}_" in parts]
    if parts != "_" and name in NAMES:
        found.append(f"{name} -> {NAMES[name]}")
    return "; ".join(found) or None


def sources():
    paths = (path for folder in FOLDERS for path in (ROOT / folder).rglob("*.py"))
    return sorted(paths)


@pytest.mark.parametrize("path", sources(), ids=lambda path: str(path.relative_to(ROOT)))
def test_names_use_the_vocabulary(path):
    if path.name == "test_vocabulary.py":
        return
    names = [(0, part) for part in path.relative_to(ROOT).with_suffix("").parts]
    names += defined_names(ast.parse(path.read_text()))
    wrong = {f"{path.name}:{line}: {name}: {complaint(name)}" for line, name in names if complaint(name)}
    assert not wrong, "\n".join(sorted(wrong))


def test_config_keys_use_the_vocabulary():
    def keys(section):
        for key, value in section.items():
            yield key
            yield from keys(value) if hasattr(value, "items") else ()

    config = importlib.import_module("jaxnerf.configs.default").get_config()
    assert [(key, complaint(key)) for key in keys(config) if complaint(key) or key in CONFIG_KEYS] == []


@pytest.mark.parametrize(
    "name, right",
    [
        ("max_samples", True),
        ("look_at", True),
        ("look_at_once", False),
        ("left_out", False),
        ("rays_left_out", False),
        ("left", True),
        ("Unseen", False),
        ("shared", True),
        ("RoomOf", False),
        ("stop_gradient", True),
        ("looks_forward", True),
        ("stop", False),
    ],
)
def test_this_test(name, right):
    assert (complaint(name) is None) == right
