"""Photographs of one's own, by --data_dir alone: format, world and sizes follow from the capture."""

from ml_collections import config_dict

from configs import lego_fast


def get_config():
    """Returns the configuration; ten minutes on a CPU core."""
    config = lego_fast.get_config()
    data = config.data
    data.format, data.dir, data.factor, data.width = "auto", "", 0, 200
    data.background, data.ndc = "", config_dict.placeholder(bool)
    space = config.space
    # Nothing is known to be empty at first, and what is faint in photographs is fog that no view needs.
    space.outside, space.threshold, space.samples_per_ray = "", 0.03, 27
    train = config.train
    # What of lego_fast.py was tried on lego alone stays as the README's captures were trained.
    config.features.view_width, config.eval.samples, train.average_power = 128, 1.0, 0.0
    train.batch_size, train.max_steps, train.lr_steps, train.max_seconds = 384, 12_000, 12_000, 600.0
    return config
