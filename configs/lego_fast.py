"""Lego at 100 x 100 in minutes on one CPU core: feature grids, asked only where there is something.

Sizes follow from cameras, masks and images; the rest was chosen on views held out of the training set.
"""

from configs import default


def get_config():
    """Returns the configuration."""
    config = default.get_config()
    config.data.format, config.data.dir, config.data.factor = "blender", "lego", 8
    config.field, config.space.skip_empty = "grid", True
    config.features.view_width = 64
    train = config.train
    train.batch_size, train.max_steps, train.lr_steps = 512, 0, 0
    train.lr_init, train.lr_final, train.warmup_steps = 5e-3, 1.5e-4, 50
    train.muon = 0.6
    train.beta2, train.epsilon = 0.99, 1e-15  # a feature that is rarely seen moves as far as any other
    train.average_power = 10.0
    train.log_every, train.save_every = 200, 4000
    config.space.hide_from = 300
    config.eval.samples = 1.5  # no jitter averages over a step there, so steps are finer
    config.eval.chunk = 8192  # enough rays to fill pools, not many more than see something in a small picture
    return config
