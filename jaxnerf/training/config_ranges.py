"""The ranges of a config's numbers, checked before anything is read or written."""

from ml_collections import ConfigDict

# By range: (its text, whether a number is in it, the fields). What depends on the dataset is checked with it.
_RANGES = (
    (
        "at least 1",
        lambda value: value >= 1,
        (
            "data.factor data.width data.size sampling.num_coarse hash_grid.features_per_level hash_grid.table_size "
            "hash_grid.width hash_grid.view_width occupancy.resolution occupancy.update_every "
            "occupancy.cells_per_update occupancy.update_chunk train.cpu_batch_size train.microbatch_size "
            "train.steps_per_dispatch train.max_steps train.lr_steps train.log_every train.save_every "
            "train.max_to_keep train.max_nonfinite eval.chunk eval.max_samples"
        ),
    ),
    (
        "at least 0",
        lambda value: value >= 0,
        (
            "data.near data.far data.hold_out data.num_views sampling.num_fine sampling.importance_padding "
            "sampling.density_noise hash_grid.geometry_features hash_grid.view_depth occupancy.threshold "
            "occupancy.near_gradient_distance occupancy.min_views "
            "occupancy.max_optical_depth occupancy.occlusion_start_step train.max_seconds train.warmup_steps "
            "train.muon train.averaging_power train.max_reinits train.preview_every "
            "cameras.refine_start_step eval.summary_seconds"
        ),
    ),
    (
        "more than 0",
        lambda value: value > 0,
        (
            "hash_grid.feature_scale occupancy.step_size occupancy.pool_samples_per_ray train.lr_init train.lr_final "
            "train.epsilon cameras.exposure_lr cameras.refine_lr eval.sample_multiplier"
        ),
    ),
    ("more than 0 and at most 1", lambda value: 0 < value <= 1, "occupancy.uniform_fraction"),
    ("at least 0 and below 1", lambda value: 0 <= value < 1, "train.beta1 train.beta2 eval.early_stop_eps"),
)


def check_ranges(config: ConfigDict) -> None:
    """Raises a ValueError if a number of a config is outside its range; names the flag and the range.

    Fields that are "auto", and fields that the config lacks, are skipped.
    """
    for expected, holds, names in _RANGES:
        for name in names.split():
            section, field = name.split(".")
            value = config.get(section, {}).get(field)
            if isinstance(value, int | float) and not holds(value):
                raise ValueError(f"--config.{name} is {value}, expected {expected}; correct it")
