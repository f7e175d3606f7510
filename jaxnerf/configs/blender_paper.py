"""The paper's run on the synthetic scenes at 800 x 800 (Section 5.3 and the released code)."""

from jaxnerf.configs import default


def get_config():
    """Returns the config; --data_dir selects the dataset."""
    config = default.get_config()
    config.data.near, config.data.far = 2.0, 6.0
    config.data.format = "blender"
    config.data.dir = "lego"
    config.data.pixel_offset = 0.0  # the code traces rays through pixel corners; the paper does not say
    config.sampling.rule = "points"
    config.sampling.importance_padding = 1e-5  # the code's padding; the paper has none
    train = config.train
    train.batch_size = 1024  # the code; the paper says 4096 rays
    train.batching = "single_image"  # the code; the paper draws from all pixels of all images
    train.max_steps = 500_000  # the code; the paper says 100k to 300k until convergence
    train.lr_init, train.lr_final, train.lr_steps = 5e-4, 5e-5, 500_000
    train.epsilon = 1e-7  # Keras' default; the paper says 1e-7, too
    return config
