"""Measures jaxnerf on this machine's accelerator, piece by piece; called again, it continues.

    JAXNERF_SCENES=... python experiments/gpu/run.py --minutes=9 [--out=runs/gpu] [--markdown=FILE.md]

Each piece is saved to <out>/results.json when it is done, and finished pieces are not repeated. A piece that would not
fit into the rest of --minutes waits for the next call. docs/guides/accelerators.md describes the pieces, and how to run
them on a lent machine. docs/results/reproducibility.md is put together from the pages of several calls.
"""

import functools
import pathlib
import sys
import time
from typing import Any, NamedTuple

import jax
from absl import flags

sys.path.append(str(pathlib.Path(__file__).resolve().parents[1]))
sys.path.append(str(pathlib.Path(__file__).resolve().parent))
import common
import pieces

from jaxnerf.runtime import cli
from jaxnerf.runtime.atomic_files import write_text


class Piece(NamedTuple):
    """A measurement.

    Attributes:
        measure: Context -> numbers, texts, and "rows" of these.
        minutes: that it takes at most, as expected.
        title: of its section.
    """

    measure: Any
    minutes: float
    title: str


PIECES = {
    "hard_cases": Piece(pieces.hard_cases, 2, "Hard cases on the device"),
    "agreement": Piece(pieces.agreement, 4, "Device against CPU: relative errors of the first step"),
    "determinism": Piece(pieces.determinism, 2, "The same steps twice"),
    "ceilings": Piece(pieces.ceilings, 0.5, "What the device reaches"),
    "step": Piece(pieces.step_parts, 2, "The training step and its parts, lego 800 x 800"),
    "kernels": Piece(pieces.kernels, 1, "The kernels of a training step, lego 800 x 800"),
    **{
        f"{name}_{seconds}": Piece(
            functools.partial(pieces.blender, name=name, seconds=seconds),
            seconds / 60 + 1.5,
            f"{name.capitalize()} 800 x 800 after {seconds} s",
        )
        for name in ("lego", "mic")
        for seconds in (15, 30, 60, 120, 300)
    },
    "frame": Piece(pieces.frame, 2, "A frame of 800 x 800"),
    "sizes": Piece(pieces.sizes, 6, "Sizes: views held out of training, lego 800 x 800"),
    "paper_mlp": Piece(pieces.paper_mlp, 3, "The paper's network with an occupancy grid, lego 800 x 800"),
    "paper": Piece(pieces.paper, 4, "The paper's own configuration, lego 800 x 800"),
    "fern": Piece(functools.partial(pieces.scene, name="fern"), 3.5, "Fern at full size, 120 s"),
    "can": Piece(functools.partial(pieces.scene, name="can"), 3.5, "Can at full size, 120 s"),
    "memory": Piece(pieces.memory_use, 2, "Memory against batch and chunk"),
    "cpu_cores": Piece(pieces.cpu_cores, 3, "More cores: fox on the CPU of the machine, 10 s"),
}

_MINUTES = flags.DEFINE_float("minutes", 9.0, "The time of this call; what does not fit waits for the next one.")
_OUT = flags.DEFINE_string("out", "runs/gpu", "The folder of results.json and the workdirs.")
_PAGE = flags.DEFINE_string("markdown", "", "The Markdown page to write from results.json.")
_TINY = flags.DEFINE_bool("tiny", False, "Run everything at tiny sizes on any device, as a test.")
_ALLOW_CPU = flags.DEFINE_bool("allow_cpu", False, "Run at full size without an accelerator, too.")
_PIECES = flags.DEFINE_list("pieces", list(PIECES), "The pieces to run, in this order.")


def main(argv: list[str]) -> None:
    """Runs the pieces that are missing and fit, and writes the page."""
    del argv
    started = time.perf_counter()
    names = common.chosen("--pieces", _PIECES.value, list(PIECES))
    if jax.default_backend() == "cpu" and not (_TINY.value or _ALLOW_CPU.value):
        raise ValueError(
            "found no accelerator, only a CPU; install jax[cuda12] or jax[cuda13] on a machine with a GPU, or give "
            "--tiny or --allow_cpu"
        )
    out = pathlib.Path(_OUT.value)
    path = out / "results.json"
    kept = common.read_json(path)
    about = {"device": common.describe_machine(), "jax": jax.__version__, "tiny": _TINY.value}
    if kept.setdefault("about", about) != about:
        raise ValueError(f"{path}: holds results of {kept['about']}, expected {about}; give another --out")
    results = kept.setdefault("pieces", {})
    left = lambda: 60 * _MINUTES.value - (time.perf_counter() - started)  # noqa: E731
    context = pieces.Context(out, _TINY.value, left)
    waiting = []
    for name in names:
        piece = PIECES[name]
        if name in results:
            continue
        if not _TINY.value and 60 * piece.minutes > left():
            waiting.append(name)
            continue
        begun = time.perf_counter()
        try:
            found = piece.measure(context)
        except Exception as error:  # the other pieces do not depend on it; main reports it at its end
            found = {"error": f"{type(error).__name__}: {error}".splitlines()[0][:500]}
        seconds = time.perf_counter() - begun
        origin = {"commit": common.commit(), "date": time.strftime("%F"), "command": " ".join(sys.argv)}
        results[name] = {"seconds": seconds, **origin, **found}
        common.write_json(path, kept)
        print(f"{name}: {seconds:.0f} s" + (f", failed: {found['error']}" if "error" in found else ""), flush=True)
        jax.clear_caches()
    if _PAGE.value:
        write_text(pathlib.Path(_PAGE.value), "\n".join(page(kept)) + "\n")
    if waiting:
        print(f"waiting for more time: {', '.join(waiting)}; the same command continues")
    failed = [name for name in names if "error" in results.get(name, ())]
    if failed:
        raise ValueError(f"{path}: failed in {', '.join(failed)}; remove these entries to run them again")


def page(kept: dict[str, Any]) -> list[str]:
    """Returns the lines of the page of results.json's content."""
    about = kept["about"]
    lines = [
        "# Measured on an accelerator",
        "",
        f"JAX {about['jax']}. [The guide](../guides/accelerators.md) discusses the figures.",
    ]
    for name, piece in PIECES.items():
        result = kept["pieces"].get(name)
        if result is None:
            continue
        plain = {key: value for key, value in result.items() if not isinstance(value, list)}
        seconds, commit, date, command = (plain.pop(key) for key in ("seconds", "commit", "date", "command"))
        origin = (f"`{command}`, {seconds:.0f} s", f"{commit}, {date}", about["device"])
        lines += ["", f"## {piece.title}", "", *common.markdown(("command", "commit", "machine"), [origin]), ""]
        if plain:
            lines += [*common.markdown(list(plain), [[_text(value) for value in plain.values()]]), ""]
        rows = result.get("rows", [])
        heads = list(dict.fromkeys(key for row in rows for key in row))
        if rows:
            lines += common.markdown(heads, [[_text(row.get(key, "")) for key in heads] for row in rows])
        lines += [f"- {failure}" for failure in result.get("failures", [])]
    return lines


def _text(value):
    if isinstance(value, float):
        return f"{value:.4g}"
    return f"{value:,}" if isinstance(value, int) and not isinstance(value, bool) else str(value)


if __name__ == "__main__":
    cli.run(main, stopped="within a piece; finished ones are saved, and the same command continues")
