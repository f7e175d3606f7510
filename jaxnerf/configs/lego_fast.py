"""Lego at 100 x 100 in minutes on one CPU core: a hash grid with the occupancy sampler.

Sizes are inferred from cameras, alpha and images. The other values were chosen on views held out of the
training set.
"""

from jaxnerf.configs import default


def get_config():
    """Returns the config."""
    config = default.get_config()
    config.data.format, config.data.dir, config.data.factor = "blender", "lego", 8
    config.field, config.sampler = "hash_grid", "occupancy"
    config.hash_grid.width = config.hash_grid.view_width = config.hash_grid.table_size = "auto"
    config.hash_grid.view_depth = "auto"
    train = config.train
    train.batch_size, train.cpu_batch_size, train.max_steps, train.lr_steps = "auto", 1024, "auto", "auto"
    train.lr_init, train.lr_final, train.lr_decay_power, train.warmup_steps = 5e-3, 1.5e-4, 8.0, 50
    train.muon, train.table_momentum = 0.6, False
    train.beta2, train.epsilon = 0.99, 1e-15  # entries that few samples reach get updates of full size, too
    train.averaging_power = 10.0
    train.rays_per_side = "auto"
    train.log_every, train.save_every = 200, 4000
    # More rays with fewer samples, most of them near surfaces, learn faster than fewer rays with all samples.
    occupancy = config.occupancy
    occupancy.pool_samples_per_ray, occupancy.cpu_pool_samples_per_ray = "auto", 5.0
    occupancy.occlusion_start_step = 300
    config.eval.sample_multiplier = "auto"
    config.eval.early_stop_eps = 0.003  # within 0.01 dB of the PSNR at 0.001, and faster for large images
    return config
