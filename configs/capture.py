"""Photographs of one's own, by --data_dir alone: format, world and sizes follow from the capture."""

from ml_collections import config_dict

from configs import lego_fast


def get_config():
    """Returns the configuration; ten minutes on two CPU cores."""
    config = lego_fast.get_config()
    data = config.data
    data.format, data.dir, data.factor, data.width = "auto", "", 0, 200
    data.background, data.ndc = "none", config_dict.placeholder(bool)
    config.space.outside = ""
    train = config.train
    train.batch_size, train.max_steps, train.max_seconds = 1024, 20_000, 600.0
    train.lr_steps = 20_000
    return config
