"""Points of curves: what a program reached after how many seconds of training, and their CSV."""

import csv
import dataclasses
import io
import math
import pathlib
from collections.abc import Mapping, Sequence
from typing import Any

from jaxnerf.runtime.printed_text import printable

_FORMULA = ("=", "+", "-", "@", "\\t", "\\r", "\uff1d", "\uff0b", "\uff0d", "\uff20")


@dataclasses.dataclass(frozen=True)
class Point:
    """A model after some training. None is not known.

    Attributes:
        program: that trained it, or the name of a curve.
        seconds: of training, without compilation and set-up.
        psnr: dB, the mean over the scored views.
        ssim: the mean over the scored views.
        lpips: the mean over the scored views.
        steps: of training.
        setup_seconds: until training began, without compilation.
        compile_seconds: of training.
        frame_seconds: of rendering one frame.
        memory_mb: the peak of the process, or of the accelerator.
        note: for example what the seconds include, or the machine.
    """

    program: str
    seconds: float
    psnr: float
    ssim: float | None = None
    lpips: float | None = None
    steps: float | None = None
    setup_seconds: float | None = None
    compile_seconds: float | None = None
    frame_seconds: float | None = None
    memory_mb: float | None = None
    note: str = ""


COLUMNS = tuple(field.name for field in dataclasses.fields(Point))
_TEXTS = ("program", "note")
_REQUIRED = ("program", "seconds", "psnr")
_SHOWN = {
    "program": ("program", "{}"),
    "seconds": ("seconds", "{:,.4g}"),
    "psnr": ("PSNR", "{:.2f} dB"),
    "ssim": ("SSIM", "{:.4f}"),
    "lpips": ("LPIPS", "{:.4f}"),
    "steps": ("steps", "{:,.0f}"),
    "setup_seconds": ("set-up s", "{:.1f}"),
    "compile_seconds": ("compiling s", "{:.1f}"),
    "frame_seconds": ("s a frame", "{:.3f}"),
    "memory_mb": ("peak MB", "{:,.0f}"),
    "note": ("note", "{}"),
}


def of_score(program: str, score: Mapping[str, Any]) -> Point:
    """Returns the point of a run from its score.json or results.json."""
    memory = score.get("peak_memory_mb") if score.get("backend") == "cpu" else score.get("peak_device_memory_mb")
    return Point(
        program=program,
        seconds=score["seconds"] if "seconds" in score else score["training_seconds"],
        psnr=score["psnr"],
        ssim=score["ssim"],
        lpips=score.get("lpips"),
        steps=score["step"],
        setup_seconds=score.get("setup_seconds"),
        compile_seconds=score.get("compile_seconds"),
        frame_seconds=score.get("seconds_per_frame"),
        memory_mb=memory,
        note=score.get("machine", ""),
    )


def curves(points: Sequence[Point]) -> dict[str, list[Point]]:
    """Returns the points of each program by ascending seconds, the programs in the order of their first points."""
    found: dict[str, list[Point]] = {}
    for point in points:
        found.setdefault(point.program, []).append(point)
    return {name: sorted(each, key=lambda point: point.seconds) for name, each in found.items()}


def table(points: Sequence[Point]) -> list[str]:
    """Returns the lines of a table, without columns of which nothing is known."""
    known = [name for name in COLUMNS if any(getattr(point, name) not in (None, "") for point in points)]
    rows = [[_SHOWN[name][0] for name in known]]
    for each in curves(points).values():
        rows += [[_cell(name, getattr(point, name)) for name in known] for point in each]
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return ["  ".join(f"{cell:{width}}" for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows]


def _cell(name, value):
    return "-" if value in (None, "") else printable(_SHOWN[name][1].format(value))


def to_csv(points: Sequence[Point]) -> str:
    """Returns the points as CSV; what is not known is empty."""
    file = io.StringIO()
    writer = csv.writer(file, lineterminator="\n")
    writer.writerow(COLUMNS)
    for point in points:
        writer.writerow(["" if x is None else spreadsheet_cell(x) for x in dataclasses.astuple(point)])
    return file.getvalue()


def spreadsheet_cell(value: object) -> object:
    """Returns a value for a cell of a CSV file: a text that a spreadsheet would compute begins with an apostrophe."""
    if not isinstance(value, str):
        return value
    text = printable(value)
    try:
        float(text)
    except ValueError:
        return f"'{text}" if text.lstrip(" ").startswith(_FORMULA) else text
    return text


def read_csv(path: str | pathlib.Path) -> list[Point]:
    """Reads points from a CSV file, such as figures of other programs.

    Args:
        path: of a file with the columns program, seconds and psnr, and any others of COLUMNS; empty cells are not
            known.

    Raises:
        ValueError: names the file, the line and the column.
    """
    path = pathlib.Path(path)
    if not path.is_file():
        raise ValueError(f"{path}: no such file, expected a CSV with the columns {', '.join(COLUMNS)}")
    try:
        lines = list(csv.reader(path.read_text(encoding="utf-8-sig").splitlines(), strict=True))
    except (csv.Error, UnicodeDecodeError) as error:
        raise ValueError(f"{path}: is no CSV in UTF-8 ({error}); correct it") from None
    heads, *rows = lines or [[]]
    wrong = [head for head in heads if head not in COLUMNS] or [name for name in _REQUIRED if name not in heads]
    if wrong or len(set(heads)) < len(heads):
        what = f"has the column {wrong[0]!r}" if wrong and wrong[0] in heads else f"lacks {(wrong or _REQUIRED)[0]}"
        raise ValueError(
            f"{path}: {printable(what)}, expected {', '.join(_REQUIRED)} and, where known, "
            f"{', '.join(COLUMNS[3:])}, each once; correct the first line"
        )
    return [_point(path, number, heads, row) for number, row in enumerate(rows, 2) if any(row)]


def _point(path, number, heads, row):
    if len(row) != len(heads):
        raise ValueError(f"{path}: line {number} has {len(row)} cells, expected {len(heads)}; correct it")
    values: dict[str, Any] = {}
    for name, text in zip(heads, row, strict=True):
        if name in _TEXTS:
            values[name] = text.strip().removeprefix("'")
            continue
        if not text.strip() and name not in _REQUIRED:
            continue
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        if not math.isfinite(value) or (value < 0 and name != "psnr" and name != "ssim"):
            raise ValueError(
                f"{path}: line {number} has {printable(name)} {printable(text)!r}, expected a finite number; correct it"
            )
        values[name] = value
    if not values["program"]:
        raise ValueError(f"{path}: line {number} names no program; name it")
    return Point(**values)
