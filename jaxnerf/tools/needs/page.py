"""Writes what a study found: a table, a page, images, a curve and the lean config."""

import base64
import csv
import html
import io
import json
import math
import pathlib
import pprint
import shlex
import statistics
from collections.abc import Sequence
from typing import Any

import imageio.v3 as iio
import numpy as np
from jaxtyping import UInt8

from jaxnerf.core.views import Views
from jaxnerf.evaluation.output_images import to_8_bits
from jaxnerf.runtime.atomic_files import write_text
from jaxnerf.tools.curve import drawing
from jaxnerf.tools.needs.study import LEAN, Outcome, Row, Settings
from jaxnerf.tools.needs.trial import stride
from jaxnerf.tools.needs.variants import COMPLETE
from jaxnerf.training.config import RunConfig

HEADS = (
    "part",
    "change",
    "contributes, dB",
    "interval",
    "seeds",
    "ms a step",
    "parameters",
    "memory, MB",
    "frame, s",
    "verdict",
)
_TITLE = "PSNR of held-out views after a run of so many seconds"  # of the curves
_SIDE = 320  # px of an image on the page, at most


def write(
    folder: pathlib.Path,
    outcome: Outcome,
    settings: Settings,
    asked: RunConfig,
    lean: RunConfig,
    held_out: Views,
) -> None:
    """Writes page.html, lean.py, curve.csv, curve.png and results.json into a folder, and prints the table.

    Args:
        folder: that holds the trials.
        outcome: of the study.
        settings: of the study.
        asked: the config of the complete model, as it was given.
        lean: the same without what is not needed.
        held_out: the views that were scored.
    """
    print()
    print("\n".join(text_table(outcome)))
    print()
    print("\n".join(drawing.lines(outcome.curve, _TITLE)))
    write_text(folder / "lean.py", config_file(asked, lean, outcome))
    write_text(folder / "curve.csv", curve_csv(outcome))
    plot = drawing.save(outcome.curve, folder / "curve.png", ylabel="PSNR of held-out views, dB")
    images = _images(folder, outcome, held_out)
    write_text(folder / "page.html", _page(outcome, settings, asked, plot, images))
    write_text(folder / "results.json", json.dumps(results(outcome, settings), indent=1) + "\n")
    print()
    print("\n".join(_lean_lines(outcome)))
    print(f"page          {folder / 'page.html'}")
    where = f" --data_dir={shlex.quote(asked.data.dir)}" if asked.data.dir else ""
    print(f"next          jaxnerf-train --config={folder / 'lean.py'}{where} --workdir=...  trains the lean model")


def cells(row: Row, complete: Row | None = None) -> tuple[str, ...]:
    """Returns the cells of a row of the table, see HEADS."""
    variant, effect = row.variant, row.effect
    name = variant.part, f"{variant.change}: {variant.words()}" if variant.change else ""
    if effect is None or not row.results:
        return (*name, *[""] * 7, row.note or row.verdict)
    found = list(row.results.values())
    numbers = measured(found)
    interval = f"{effect.lower:+.2f} to {effect.upper:+.2f}" if math.isfinite(effect.lower) else "unknown"
    return (
        *name,
        f"{effect.mean:+.2f}",
        interval,
        str(effect.seeds),
        f"{numbers['ms_per_step']:.1f}",
        f"{numbers['parameters']:,}",
        f"{numbers['memory'] / 1e6:,.0f}",
        f"{numbers['frame_seconds']:.3f}",
        words(row),
    )


def words(row: Row) -> str:
    """Returns the verdict, and for what is added that it is off."""
    if row.variant.adds:
        return {"needed": "needed, and not there", "not needed": "would not pay"}.get(row.verdict, row.verdict)
    return row.verdict


def measured(results: Sequence[Any]) -> dict[str, float]:
    """Returns what several trials of a model measured beside its scores."""
    steps = [1000 * each.seconds / max(each.steps, 1) for each in results]
    return {
        "ms_per_step": statistics.median(steps),
        "parameters": results[0].parameters,
        "memory": results[0].memory,
        "frame_seconds": min(each.frame_seconds for each in results),
        "compile_seconds": max(each.compile_seconds for each in results),
        "psnr": statistics.fmean(statistics.fmean(each.psnr) for each in results),
    }


def _all_rows(outcome):
    """Yields the cells of all rows, the complete model first."""
    numbers = measured(list(outcome.complete.values()))
    yield _model_cells(COMPLETE, f"{numbers['psnr']:.2f} dB", outcome.complete, "")
    for row in outcome.rows:
        yield cells(row)
    if outcome.lean:
        for name, result in outcome.longest.items():
            scored = f"after {result.seconds:.0f} s, images not shrunk: {outcome.curve[name][-1][1]:.2f} dB"
            yield _model_cells(name, scored, {0: result}, "")


def _model_cells(name, change, results, interval):
    numbers = measured(list(results.values()))
    return (
        name,
        change,
        "",
        interval,
        str(len(results)),
        f"{numbers['ms_per_step']:.1f}",
        f"{numbers['parameters']:,}",
        f"{numbers['memory'] / 1e6:,.0f}",
        f"{numbers['frame_seconds']:.3f}",
        "",
    )


def text_table(outcome: Outcome) -> list[str]:
    """Returns the lines of the table in a terminal."""
    rows = [HEADS, *_all_rows(outcome)]
    rows = [[cell if len(cell) <= 60 else cell[:57] + "..." for cell in row] for row in rows]
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return ["  ".join(f"{cell:{width}}" for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows]


def curve_csv(outcome: Outcome) -> str:
    """Returns the curves as CSV."""
    file = io.StringIO()
    writer = csv.writer(file, lineterminator="\n")
    writer.writerow(("model", "seconds", "psnr", "knee"))
    for name, points in outcome.curve.items():
        marked = drawing.knee(points)
        for index, (seconds, score) in enumerate(points):
            writer.writerow((name, f"{seconds:.3f}", f"{score:.4f}", int(index == marked)))
    return file.getvalue()


def results(outcome: Outcome, settings: Settings) -> dict[str, Any]:
    """Returns all that was found, for other programs."""
    rows = []
    for row in outcome.rows:
        effect = None if row.effect is None else _finite(row.effect._asdict())
        numbers = measured(list(row.results.values())) if row.results else {}
        rows.append(
            {
                "part": row.variant.part,
                "change": row.variant.change,
                "values": dict(row.variant.values),
                "verdict": row.verdict,
                "note": row.note,
                "effect": effect,
                **numbers,
            }
        )
    lean_effect = None if outcome.lean_effect is None else _finite(outcome.lean_effect._asdict())
    return {
        "settings": settings._asdict(),
        "plan": outcome.plan._asdict(),
        "complete": measured(list(outcome.complete.values())),
        "parts": rows,
        "lean": {
            "parts": [each.name for each in outcome.lean],
            "effect": lean_effect,
            **(measured([outcome.longest[LEAN]]) if outcome.lean else {}),
        },
        "refused": [
            {"parts": [each.name for each in parts], "effect": _finite(effect._asdict()), "why": why}
            for parts, effect, why in outcome.refused
        ],
        "complete_in_longest": measured([outcome.longest[COMPLETE]]),
        "curve": outcome.curve,
        "aligned_colors": outcome.aligned,
        "spent": outcome.spent,
    }


def _finite(values):
    return {key: value if math.isfinite(value) else None for key, value in values.items()}


def config_file(asked: RunConfig, lean: RunConfig, outcome: Outcome) -> str:
    """Returns the text of a config file: the given config's without what is not needed."""
    named = ", ".join(each.name for each in outcome.lean) or "nothing"
    fields = pprint.pformat(lean.to_dict(), indent=4, width=110, sort_dicts=False)
    before, after = asked.to_dict(), lean.to_dict()
    changes = [
        f"#   {section}.{name}: {before[section].get(name)!r} -> {value!r}"
        for section, part in after.items()
        if isinstance(part, dict)
        for name, value in part.items()
        if before.get(section, {}).get(name) != value
    ]
    return (
        f'"""What the scene needs, by jaxnerf-needs. Changed: {named}."""\n\n'
        "from jaxnerf.training.config import read_config, to_config_dict\n\n"
        + "".join(f"{line}\n" for line in changes)
        + f"FIELDS = {fields}\n\n\ndef get_config():\n"
        '    """Returns the config, of the original length."""\n'
        "    return to_config_dict(read_config(FIELDS))\n"
    )


def _lean_lines(outcome):
    """Returns lines about the lean model."""
    seconds = outcome.longest[COMPLETE].seconds
    lines = [f"refused       {'; '.join(each.name for each in parts)}: {why}" for parts, _, why in outcome.refused]
    if not outcome.lean:
        return [*lines, "lean          the complete model: nothing was shown to be dispensable, or to pay"]
    complete, lean = (measured([outcome.longest[name]]) for name in (COMPLETE, LEAN))
    titles = {
        "ms_per_step": "time of a step",
        "parameters": "parameters",
        "memory": "memory",
        "frame_seconds": "time of a frame",
    }
    saved = [f"{title} {100 * (lean[name] / complete[name] - 1):+.0f} %" for name, title in titles.items()]
    names = "; ".join(each.name for each in outcome.lean)
    return [
        *lines,
        f"lean          {names}: {-outcome.lean_effect.mean:+.2f} dB beside the complete model after {seconds:.0f} s, "
        f"{', '.join(saved)}",
    ]


def _images(folder, outcome, held_out):
    """Returns for each variant that was tried the view where it differs most: (name, PNG bytes of three images)."""
    base, found = _kept(folder, COMPLETE, outcome), []
    for row in outcome.rows:
        other = _kept(folder, row.variant.slug, outcome)
        if not base or not other or row.effect is None:
            continue
        errors = [float(np.mean((np.float32(a) - np.float32(b)) ** 2)) for a, b in zip(base, other, strict=True)]
        index = int(np.argmax(errors))
        every = stride(held_out, index)
        truth = to_8_bits(held_out.image(index))[::every, ::every]
        strip = np.concatenate([truth, base[index], other[index]], axis=1)
        name = held_out.names[index] if held_out.names else str(index)
        found.append((row, name, _png(strip)))
    return found


def _kept(folder, slug, outcome):
    """Returns the images of a trial; () if it kept none."""
    path = folder / "trials" / f"{slug}-0-{outcome.plan.length:.4g}.npz"
    if not path.exists():
        return ()
    with np.load(path) as file:
        return [file[f"arr_{index}"] for index in range(len(file.files))]


def _png(image: UInt8[np.ndarray, "H W 3"]) -> bytes:
    scale = max(_SIDE * 2 // max(image.shape[0], 1) // 2, 1)
    scale = min(scale, max(3 * _SIDE // image.shape[1], 1))
    return iio.imwrite("<bytes>", image.repeat(scale, 0).repeat(scale, 1), extension=".png")


_STYLE = (
    "body{font:15px/1.5 sans-serif;max-width:1100px;margin:2em auto;padding:0 1em}"
    "table{border-collapse:collapse;font-size:13px}td,th{border:1px solid #ccc;padding:3px 8px;text-align:left}"
    "img{max-width:100%;image-rendering:pixelated}.needed{background:#fde8e8}.not{background:#e8f7e8}"
)


def _page(outcome, settings, asked, plot, images):
    """Returns the page as HTML, with its images inside."""
    dataset = html.escape(asked.data.dir or asked.data.format)
    kinds = {"needed": "needed", "not needed": "not"}
    classes = ["", *(kinds.get(row.verdict, "") for row in outcome.rows), ""]
    body = "".join(
        f"<tr class='{kind}'>" + "".join(f"<td>{html.escape(cell)}</td>" for cell in row) + "</tr>"
        for kind, row in zip(classes, _all_rows(outcome), strict=False)
    )
    heads = "".join(f"<th>{html.escape(head)}</th>" for head in HEADS)
    parts = [
        f"<title>What {dataset} needs</title><style>{_STYLE}</style>",
        f"<h1>What {dataset} needs</h1>",
        f"<p>{html.escape(explanation(outcome, settings))}</p>",
        f"<table><tr>{heads}</tr>{body}</table>",
        f"<h2>The lean model</h2><p>{html.escape('. '.join(_lean_lines(outcome)))}. <code>lean.py</code> beside "
        "this page is its config, of the original length.</p>",
        "<h2>What each second buys</h2>",
        _embedded(plot.read_bytes()) if plot else "",
        f"<pre>{html.escape(chr(10).join(drawing.lines(outcome.curve, _TITLE)))}</pre>",
        "<h2>Where each part shows</h2><p>The held-out view where the models differ most: the image, the complete "
        "model, and the model with the change.</p>",
        *(
            f"<h3>{html.escape(row.variant.name)}: {html.escape(words(row))}</h3><p>{html.escape(name)}, "
            f"{row.effect.mean:+.2f} dB over all views</p>{_embedded(png)}"
            for row, name, png in images
        ),
    ]
    return "<!doctype html><meta charset='utf-8'>" + "\n".join(parts) + "\n"


def _embedded(png):
    return f"<img alt='' src='data:image/png;base64,{base64.b64encode(png).decode()}'>"


def explanation(outcome: Outcome, settings: Settings) -> str:
    """Returns how the figures were measured."""
    plan = outcome.plan
    same = f"{plan.steps:,} steps" if plan.steps else f"{plan.length:.1f} s of training"
    colors = " Colours are fitted to each image first, as exposures differ." if outcome.aligned else ""
    return (
        f"Each model is trained for {same} with the same seeds and scored on the same held-out views. A part is needed "
        f"if it contributes at least {settings.margin:g} dB: the whole interval lies above. It is not needed if the "
        "interval lies below. The interval is Student's over seeds and views, 95 % at each end over all looks."
        f"{colors} Trials took {outcome.spent:.0f} s. Verdicts hold for runs of this length."
    )
