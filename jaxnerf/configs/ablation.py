"""Lego at 100 x 100: the paper's model scaled down in proportion, for experiments/ablation.

The two networks have equal sizes: half the paper's depth and a fifth of its width. Pixels are eight times as
large, so the model has an eighth of the samples (their distance in pixels stays the same) and three octaves less.
Softplus and the learning rate are those of `lego_small`. Adam updates all parameters, as in the paper.
"""

from jaxnerf.configs import lego_small


def get_config():
    """Returns the config; the experiment's --steps sets the number of steps."""
    config = lego_small.get_config()
    for network in (config.coarse, config.fine):
        network.depth, network.width, network.skip_layer, network.view_width = 4, 48, 2, 24
        network.num_freqs, network.num_view_freqs, network.use_viewdirs = 7, 4, True
    config.sampling.num_coarse, config.sampling.num_fine = 8, 16
    config.sampling.rule = "segments"
    train = config.train
    train.max_steps, train.lr_steps, train.max_seconds = 1000, 1000, 0.0
    train.save_every, train.muon = 250, 0.0
    return config
