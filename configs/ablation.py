"""The complete model of experiments/ablation.py: the paper's, smaller in proportion, on lego at 100 x 100.

Two networks alike, half as deep and a fifth as wide. As pixels are eight times as large, an eighth of the
samples, which are then as many pixels apart, and three octaves less. Softplus and the learning rate are
those of lego_small.py; the paper's Adam moves all of it.
"""

from configs import lego_small


def get_config():
    """Returns the configuration; --steps of the experiment says how long."""
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
