"""The tables of what ablation.py has run."""

import paired_runs
import table
from ablation_variants import COMPLETE

HEADS = ("variant", "PSNR", "by seed, to complete", "", "SSIM", "parameters", "kFLOP a ray", "step's time")


def report(kept):
    """Returns the lines of the tables, one a scene."""
    lines = []
    for scene, about in kept["scenes"].items():
        seeds = sorted({int(seed) for runs in about["runs"].values() for seed in runs})
        views = next(iter(next(iter(about["runs"].values())).values()))["views"]
        lines += [
            f"{scene}: {about['views']} training views, {views} test views, {kept['steps']:,} steps of every "
            f"run, seeds {', '.join(map(str, seeds))}. Figures are means +- standard deviation over seeds. "
            f"Times: {kept.get('machine', 'not measured')}.",
            "",
            *table.markdown(HEADS, [row(name, about, kept.get("cost", {}).get(name)) for name in about["runs"]]),
            "",
            agreement(about),
            "",
        ]
    return lines[:-1]


def agreement(about):
    """Returns a line: what of the paper's Table 2, where every variant is worse, is so here."""
    found = {}
    for name in about["runs"]:
        if name != COMPLETE:
            found.setdefault(verdict(to_complete(name, about)), []).append(name)
    parts = [f"{what}: {', '.join(names)}" for what, names in found.items() if what != "-"]
    return f"In the paper's Table 2, which has no row on stratification, all are worse. Here {'; '.join(parts)}."


def row(name, about, cost):
    """Returns the cells of a variant; cost is None where it was not measured."""
    runs = about["runs"][name]
    differences = to_complete(name, about)
    return (
        name,
        _figure([run["psnr"] for run in runs.values()], 2),
        ", ".join(f"{value:+.2f}" for value in differences) or "-",
        verdict(differences) if name != COMPLETE else "",
        _figure([run["ssim"] for run in runs.values()], 3),
        f"{next(iter(runs.values()))['parameters']:,}",
        f"{cost['flops'] / 1e3:,.0f}" if cost else "-",
        f"{cost['time']:.2f}" if cost else "-",
    )


def to_complete(name, about):
    """Returns a variant's PSNR less the complete model's of the same seed, by ascending seed."""
    if name == COMPLETE:
        return []
    scores = [
        {int(seed): run["psnr"] for seed, run in about["runs"].get(which, {}).items()} for which in (name, COMPLETE)
    ]
    return paired_runs.differences(*scores)


def verdict(differences):
    """Returns what all seeds agree on."""
    if not differences:
        return "-"
    if min(differences) < 0 < max(differences) or not any(differences):
        return "undecided"
    return ("worse" if min(differences) < 0 else "better") + (" (one seed)" if len(differences) == 1 else "")


def _figure(values, digits):
    mean, deviation = paired_runs.spread(values)
    return f"{mean:.{digits}f}" + (f" +- {deviation:.{digits}f}" if len(values) > 1 else "")
