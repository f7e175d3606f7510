"""A scene of 3 to 12 images: capture.py with regularizers."""

from jaxnerf.configs import capture


def get_config():
    """Returns the config; it trains for five minutes on one CPU core."""
    config = capture.get_config()
    config.cameras.refine, config.cameras.exposure = False, False  # so few images hardly tell
    # So few pixels do not fill larger tables, which train longer. A third layer was not measured with them.
    config.hash_grid.table_size, config.hash_grid.view_depth = 2**17, 2
    config.losses.total_variation, config.losses.distortion = 1.0, "auto"
    config.train.max_seconds, config.train.table_momentum = 300.0, True
    return config
