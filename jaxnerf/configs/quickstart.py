"""The demo: the embedded scene at 200 x 200, trained for half a minute on one CPU core."""

from jaxnerf.configs import lego_fast


def get_config():
    """Returns the config of lego_fast on the embedded scene."""
    config = lego_fast.get_config()
    data, train = config.data, config.train
    data.format, data.dir, data.factor, data.size = "synthetic", "", 1, 200
    # 1,500 steps reach 42 dB. The limit of time is for machines on which they take longer.
    train.max_steps, train.max_seconds, train.preview_every = 1500, 120.0, 8.0
    train.lr_decay_power, train.table_momentum = 4.0, True
    return config
