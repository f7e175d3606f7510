"""Lego at 100 x 100: a small network of the paper's kind with the occupancy sampler, without a hash grid."""

from jaxnerf.configs import lego_fast


def get_config():
    """Returns the config; it trains for eight minutes on one CPU core."""
    config = lego_fast.get_config()
    config.field = "mlp"
    network = config.fine
    network.depth, network.width, network.view_width, network.num_freqs = 4, 64, 32, "auto"
    network.prefilter = "auto"
    # A dead ReLU has no gradient and cannot recover, and this learning rate is high.
    network.density_activation, network.density_bias = "softplus", -1.0
    config.occupancy.cpu_pool_samples_per_ray = 10.0
    train = config.train
    train.cpu_batch_size, train.max_steps, train.lr_steps = 320, 30_000, 30_000
    train.lr_init, train.lr_final, train.muon, train.epsilon = 16e-3, 6e-4, 0.2, 1e-8
    train.lr_decay_power = 1.0
    train.rays_per_side = 1  # more are not measured
    return config
