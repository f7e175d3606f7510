"""What experiments/ablation.py leaves out: the rows of the paper's Table 2, and stratification."""

COMPLETE = "complete"
_BOTH = ("coarse", "fine")


def variants(config, num_views):
    """Returns {name: {"section.field": value}}, what each variant changes of the complete model.

    As in the paper, without hierarchy one network is asked as often as both are with it; and octaves of the
    direction change in proportion to those of the position.

    Args:
        config: of the complete model.
        num_views: training views that the scene has.
    """
    counts = config.sampling.num_coarse, config.sampling.num_fine
    no_encoding = _networks(encode=False)
    no_viewdirs = _networks(use_viewdirs=False)
    no_hierarchy = {"sampling.num_coarse": 2 * counts[0] + counts[1], "sampling.num_fine": 0}
    return {
        COMPLETE: {},
        "no positional encoding": no_encoding,
        "no view dependence": no_viewdirs,
        "no hierarchy": no_hierarchy,
        "none of the three": no_encoding | no_viewdirs | no_hierarchy,
        "no stratification": {"sampling.stratified": False},
        "a quarter of the images": {"data.num_views": num_views // 4},
        "half of the images": {"data.num_views": num_views // 2},
        "5 octaves": _networks(num_freqs=5, num_view_freqs=2),
        "15 octaves": _networks(num_freqs=15, num_view_freqs=6),
    }


def workdir_name(scene, name, seed):
    """Returns where in --out a run lies."""
    return f"{scene}/{name.replace(' ', '_')}-{seed}"


def _networks(**fields):
    return {f"{network}.{field}": value for network in _BOTH for field, value in fields.items()}
