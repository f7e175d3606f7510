"""Lego at 100 x 100: a coarse and a fine network of the paper's kind, small enough for two CPU cores.

Samples are evaluated in empty space, too, and alpha does not guide them. The sizes were chosen on views held
out of the training set.
"""

from jaxnerf.configs import default


def get_config():
    """Returns the config; it trains for ten minutes on two cores."""
    config = default.get_config()
    config.data.format, config.data.dir, config.data.factor = "blender", "lego", 8
    coarse, fine = config.coarse, config.fine
    # The coarse network only guides samples, so it needs no view dependence and few octaves.
    coarse.depth, coarse.width, coarse.num_freqs, coarse.use_viewdirs = 2, 32, 6, False
    fine.depth, fine.width, fine.view_width, fine.num_freqs = 4, 80, 64, 7
    for network in (coarse, fine):
        # A dead ReLU has no gradient and cannot recover, and this learning rate is high.
        network.density_activation, network.density_bias = "softplus", -1.0
    config.sampling.num_coarse, config.sampling.num_fine = 24, 16
    # With a coarse network, Gauss points need the least time for a given error (experiments/quadrature).
    config.sampling.rule = "gauss"
    train = config.train
    train.batch_size = 256
    train.max_steps, train.lr_steps, train.max_seconds = 40_000, 12_000, 600.0
    train.lr_init, train.lr_final, train.warmup_steps, train.beta2 = 8e-3, 3e-4, 50, 0.99
    train.lr_decay_power = 4.0
    train.muon = 0.4
    train.log_every, train.save_every = 200, 2000
    return config
