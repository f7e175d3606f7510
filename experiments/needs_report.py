"""What scene_needs.py has found, as JSON, as a table and as a configuration."""

import json
import pathlib
import pprint

import scene_parts
import table

from jaxnerf.training.workdir import write_text

HEADS = ("left off", "loss, dB", "up to, dB", "training time saved", "parameters saved", "verdict")


def write(out, config, found, settings, *, readme=None, table_name="needs"):
    """Writes needs.json, needs.md and needed.py, prints the table, and puts it into a README if there is one.

    Args:
        out: the folder.
        config: ConfigDict, the complete model's, of its own length.
        found: scene_needs.Found.
        settings: {"loss": dB, "steps": of each run, "seeds": [...]}.
        readme, table_name: a file, and the word between whose marks the table goes.
    """
    out = pathlib.Path(out)
    lines = page(found, settings)
    plain = {"settings": settings, "complete": found.complete._asdict(), "overrides": found.overrides}
    plain["parts"] = {name: trial._asdict() | cost._asdict() for name, (trial, cost) in found.parts.items()}
    plain["tried"] = [{"left_off": names, **cost._asdict(), "kept": kept} for names, cost, kept in found.tried]
    write_text(out / "needs.json", json.dumps(plain, indent=2) + "\n")
    write_text(out / "needs.md", "\n".join(lines) + "\n")
    write_text(out / "needed.py", configuration(config, found, settings))
    print("\n".join(lines), f"\nwritten: {out / 'needed.py'}", sep="\n")
    if readme:
        marks = f"<!-- {table_name} -->", f"<!-- end of {table_name} -->"
        table.replace(pathlib.Path(readme), lines, marks)


def page(found, settings):
    """Returns the lines of the tables."""
    complete, loss = found.complete, settings["loss"]
    scores = [f"{score:.2f}" for score in complete.psnr.values()]
    seconds = sum(complete.seconds.values()) / len(complete.seconds)
    rows = []
    for name, (_, cost) in found.parts.items():
        does = " ".join(scene_parts.PARTS[name].__doc__.split())
        rows.append((f"{name}: {does}", *_cells(cost), verdict(cost, loss)))
    for names, cost, kept in found.tried:
        rows.append((" + ".join(names), *_cells(cost), "left off" if kept else "too much together"))
    left = ", ".join(f"{key}={value}" for key, value in found.overrides.items()) or "nothing"
    return [
        f"{settings['steps']} steps, {len(settings['seeds'])} seeds, held-out views; the complete model: "
        f"{', '.join(scores)} dB, {complete.parameters:,} parameters, {seconds:.1f} s for 1,000 steps.",
        "",
        *table.markdown(HEADS, rows),
        "",
        f"Left off for at most {loss} dB: {left}.",
    ]


def verdict(cost, loss):
    """Returns in a word whether a part whose absence costs that is needed."""
    if cost.mean + cost.margin <= loss:
        return "not needed"
    return "needed" if cost.mean - cost.margin > loss else "kept: more seeds would tell"


def configuration(config, found, settings):
    """Returns the text of a configuration file: the complete model's without what is not needed."""
    needed = scene_parts.changed(config, found.overrides)
    cost = found.tried and next((cost for _, cost, kept in reversed(found.tried) if kept), None)
    price = f"{cost.mean:+.2f} dB" if cost else "nothing"
    about = f"What the scene needs, by scene_needs.py: costs {price} after {settings['steps']} steps."
    body = pprint.pformat(needed.to_dict(), indent=4, width=100, sort_dicts=False)
    return (
        f'"""{about}"""\n\nfrom ml_collections import ConfigDict\n\nFIELDS = {body}\n\n\n'
        "def get_config():\n    return ConfigDict(FIELDS)\n"
    )


def _cells(cost):
    return (
        f"{cost.mean:+.3f}",
        f"{cost.mean + cost.margin:+.3f}",
        f"{cost.saved:.0%}",
        f"{cost.parameters:,}",
    )
