"""The paper's method on the embedded scene. The other files here change fields of this config."""

from jaxnerf.training.config import RunConfig, to_config_dict


def get_config():
    """Returns the config with the default of every option: `--config=help:options` lists them."""
    return to_config_dict(RunConfig())
