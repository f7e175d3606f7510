"""A scene that moves, from images with times: lego_fast.py with a field that is displaced by time."""

from jaxnerf.configs import lego_fast


def get_config():
    """Returns the config."""
    config = lego_fast.get_config()
    config.data.format, config.data.dir, config.data.factor, config.data.width = "auto", "", "auto", 400
    config.field = "moving"
    for name in ("width", "view_width", "table_size", "view_depth"):
        setattr(config.moving, name, "auto")
    config.losses.opacity = "auto"
    return config
