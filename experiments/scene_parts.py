"""What can be left off a model, or made smaller: each part as changes of fields of a configuration."""


def view_dependence(config, alpha):
    """Colour does not depend on the view direction."""
    del alpha
    names = _sections(config)
    return {f"{name}.use_viewdirs": False for name in names if config[name].use_viewdirs}


def coarse_network(config, alpha):
    """One network along equal steps, which takes the other's samples, too."""
    del alpha
    sampling = config.sampling
    if config.sampler == "occupancy" or not sampling.num_fine:
        return {}
    return {"sampling.num_coarse": sampling.num_coarse + sampling.num_fine, "sampling.num_fine": 0}


def frequencies(config, alpha):
    """Two octaves less of the position; the finest level less of feature grids."""
    del alpha
    if _has_features(config):
        levels = tuple(config.hash_grid.resolutions)
        return {"hash_grid.resolutions": levels[:-1]} if len(levels) > 1 else {}
    names = [name for name in _sections(config) if config[name].num_freqs > 2]
    return {f"{name}.num_freqs": config[name].num_freqs - 2 for name in names}


def width(config, alpha):
    """Layers of half the features."""
    del alpha
    name = _counting(config)
    section = config[name]
    if min(section.width, section.view_width) < 16:
        return {}
    return {f"{name}.width": section.width // 2, f"{name}.view_width": section.view_width // 2}


def depth(config, alpha):
    """Half the layers; of feature grids, those of colour."""
    del alpha
    key = "hash_grid.view_depth" if _has_features(config) else "fine.depth"
    section, field = key.split(".")
    layers = config[section][field]
    return {key: layers // 2} if layers > 1 else {}


def features(config, alpha):
    """Half the features of a vertex."""
    del alpha
    count = config.hash_grid.features
    return {"hash_grid.features": count // 2} if _has_features(config) and count > 1 else {}


def samples(config, alpha):
    """Half the samples; where empty space is skipped, steps of twice the length."""
    del alpha
    if config.sampler == "occupancy":
        return {"occupancy.step_size": 2 * config.occupancy.step_size}
    names = [name for name in ("num_coarse", "num_fine") if config.sampling[name] >= 4]
    # Gauss points come in pairs.
    return {f"sampling.{name}": config.sampling[name] // 4 * 2 for name in names}


def precision(config, alpha):
    """Layers in bfloat16."""
    del alpha
    names = [] if _has_features(config) else _sections(config)
    return {f"{name}.compute_dtype": "bfloat16" for name in names if config[name].compute_dtype != "bfloat16"}


def background(config, alpha):
    """Nothing behind the scene or around its box. (Behind alpha there must be a colour.)"""
    if config.sampler == "occupancy" and config.occupancy.contracted:
        return {"occupancy.contracted": False}
    return {} if alpha or config.data.background == "none" else {"data.background": "none"}


PARTS = {
    part.__name__: part
    for part in (
        view_dependence,
        coarse_network,
        frequencies,
        width,
        depth,
        features,
        samples,
        precision,
        background,
    )
}


def without(name, config, *, alpha):
    """Returns {"section.field": value} that leaves a part off, or makes it smaller; {}: it cannot be.

    Args:
        name: of PARTS.
        config: ConfigDict without open sizes.
        alpha: whether the photographs have alpha.
    """
    return PARTS[name](config, alpha)


def changed(config, overrides):
    """Returns a copy of a configuration with {"section.field": value}."""
    config = config.copy_and_resolve_references()
    config.update_from_flattened_dict(overrides)
    return config


def _sections(config):
    if _has_features(config):
        return ("features",)
    both = config.sampling.num_fine and config.sampler != "occupancy"
    return ("coarse", "fine") if both else ("fine",)


def _counting(config):
    """Returns the section of the network whose colour counts."""
    return _sections(config)[-1]


def _has_features(config):
    return config.sampler == "occupancy" and config.field == "hash_grid"
