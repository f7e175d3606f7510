"""The embedded scene at 100 x 100 with the small networks of lego_small, for studies."""

from jaxnerf.configs import lego_small


def get_config():
    """Returns the config of lego_small on the embedded scene."""
    config = lego_small.get_config()
    config.data.format, config.data.dir, config.data.factor = "synthetic", "", 1
    train = config.train
    train.max_steps, train.lr_steps, train.max_seconds, train.save_every = 3600, 3600, 0.0, 1200
    return config
