"""Your own dataset, from --data_dir alone: format, world and sizes are inferred from it."""

from jaxnerf.configs import lego_fast


def get_config():
    """Returns the config; it trains for ten minutes on one CPU core."""
    config = lego_fast.get_config()
    data = config.data
    data.format, data.dir, data.factor, data.width = "auto", "", "auto", 200
    data.background, data.ndc = "auto", "auto"
    config.cameras.refine, config.cameras.exposure = "auto", "auto"
    # Without alpha no cell is known to be empty at first. In real scenes thin density is mostly spurious fog.
    config.occupancy.threshold, config.occupancy.cpu_pool_samples_per_ray = 0.03, 9.0
    train = config.train
    # lego_fast.py has other values here, chosen on lego alone.
    train.averaging_power, train.rays_per_side = 0.0, 1
    train.cpu_batch_size, train.max_seconds = 768, 600.0
    config.hash_grid.table_size = 2**19  # with 2**17, fox has 0.8 dB less, and fern at 400 px 0.5 dB
    config.losses.distortion = 0.001  # more accurate depths, but more weight in free space
    config.eval.early_stop_eps = 0.02
    return config
