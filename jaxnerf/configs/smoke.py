"""A run of a few seconds on the embedded scene, for tests."""

from jaxnerf.configs import default


def get_config():
    """Returns the config."""
    config = default.get_config()
    config.data.size = 24
    for name in ("coarse", "fine"):
        network = config[name]
        network.depth, network.width, network.skip_layer, network.view_width = 2, 16, 0, 8
        network.num_freqs, network.num_view_freqs = 4, 2
    config.sampling.num_coarse, config.sampling.num_fine = 8, 8
    train = config.train
    train.batch_size, train.max_steps, train.lr_steps = 64, 20, 20
    train.log_every, train.save_every, train.preview_every = 5, 10, 0.0
    config.eval.chunk, config.eval.summary_seconds = 250, 0.0
    return config
