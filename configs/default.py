"""Every field of a run's config, with its unit and meaning. The other files here change fields of this one.

A field that is "auto" is inferred from the dataset or the device when a run starts, logged with its reason and
saved to the workdir.
"""

from ml_collections import ConfigDict

from jaxnerf.runtime.config_fields import auto, schedule


def mlp():
    """Returns the options of the paper's network (Fig. 7): 595,844 parameters."""
    return ConfigDict(
        {
            "depth": 8,  # layers before the density
            "width": 256,  # features of a layer
            "skip_layer": 4,  # the encoded position joins again after the layer of this index
            "view_width": 128,  # features of the layer that takes the direction
            "num_freqs": auto(int, 10),  # octaves of the position's encoding
            "num_view_freqs": 4,  # octaves of the direction's encoding
            "encode": True,  # False: position and direction enter without positional encoding
            "use_viewdirs": True,  # False: colour does not depend on the direction
            "density_activation": "relu",  # "relu" or "softplus"
            "density_bias": 0.0,  # added before the activation
            "compute_dtype": "float32",  # or "bfloat16", or "float64" under JAX_ENABLE_X64=1
        }
    )


def get_config():
    """Returns the config of the paper's method on the embedded scene."""
    return ConfigDict(
        {
            "seed": 0,
            "data": {
                # "synthetic" (embedded, rendered once and cached), "blender", "transforms", "colmap", "llff", the
                # name of a registered reader, or "auto"
                "format": "synthetic",
                "dir": "",  # the dataset's folder: a path, or a name below $JAXNERF_SCENES
                # identifies the images and cameras that a run is trained on; empty for formats whose splits have
                # files of their own
                "fingerprint": "auto",
                "factor": auto(int, 1),  # images are area-averaged down by this; auto: to about data.width
                "width": 800,  # px
                "size": 100,  # px, side of the embedded scene's images
                "finish": "usual",  # of the embedded scene's surfaces: "usual", "matt" (no view dependence), "shiny"
                # Along the camera's axis in the file's units; 0: each image's own, as the dataset states or shows.
                "near": 0.0,
                "far": 0.0,
                # behind alpha and behind the scene: "white", "black", "none" or "auto"
                "background": "white",
                "hold_out": 0,  # every n-th training view is in the split "held_out" instead; 0: none
                "num_views": 0,  # training views that are used, evenly spread; 0: all
                "pixel_offset": 0.5,  # px; rays go through 0.5: pixel centres, 0: pixel corners
                # "file": cameras as they are; "forward": recentred for NDC; "around": normalised to what they look
                # at; "auto"
                "world": "auto",
                "ndc": auto(bool, False),  # normalised device coordinates, for the world "forward"
            },
            "field": "mlp",  # of the network that counts: "mlp" (section fine), "hash_grid", or a registered one
            "sampler": "hierarchical",  # or "occupancy" (section occupancy), or a registered one
            "coarse": mlp(),  # the network that guides the samples of "fine"; hierarchical only
            "fine": mlp(),  # the network that counts
            "sampling": {  # of the sampler "hierarchical"
                "num_coarse": 64,  # samples of a ray for the coarse network
                "num_fine": 128,  # additional samples for the fine network; 0: no coarse network
                "rule": "segments",  # quadrature: "segments", "gauss" (pairs, fourth order) or "points" (the paper)
                "in_disparity": False,  # coarse samples in equal steps of 1 / t
                "stratified": True,  # False: training samples are at fixed places
                "importance_padding": 0.0,  # added to the coarse weights before they guide samples
                "density_noise": 0.0,  # 1 / world unit, standard deviation of noise on the density in training
            },
            "hash_grid": {  # of the field "hash_grid"
                "resolutions": auto(tuple),  # vertices along the longest side, for each level
                "features_per_level": 4,
                "table_size": 2**17,  # rows of a level; vertices beyond share rows by a hash
                "width": 64,  # features of the density network's hidden layer
                "geometry_features": 15,  # passed from the density network to the colour network
                "view_depth": 2,  # hidden layers of the colour network
                "view_width": 128,  # features of such a layer
                "use_viewdirs": True,  # False: colour does not depend on the direction
                "feature_scale": 4.0,  # features over table entries; it multiplies the table's learning rate
            },
            "occupancy": {  # of the sampler "occupancy", and of the scene's box
                "use_alpha": True,  # cells that every view shows with alpha 0 are empty from the start
                "contracted": auto(bool),  # the box holds all of space, contracted outside its inner half
                "lower": auto(tuple),  # world units, the box
                "upper": auto(tuple),
                "step_size": auto(float),  # world units between samples
                "resolution": auto(int),  # cells along the longest side
                "threshold": 0.01,  # opacity of one step below which a cell is empty
                "update_every": 64,  # training steps between updates of the grid
                "cells_per_update": 2**18,
                # Size of training's sample buffer over the number of rays; rays that do not fit are dropped and
                # counted.
                "pool_samples_per_ray": 10.0,
                "long_steps_until": 300,  # training step before which samples are three times as long
                "max_optical_depth": 6.0,  # estimated by the grid, beyond which training evaluates nothing; 0: off
                "occlusion_start_step": 400,  # training step from which max_optical_depth applies
            },
            # Weights by name; 0: absent. A weight may be a schedule ((step, weight), ...), linear between points.
            "losses": {
                "mse": schedule(1.0),
                "distortion": schedule(0.0),  # arXiv:2111.12077, Eq. 15
            },
            "train": {
                "batch_size": 1024,  # rays of a step, over all devices
                "microbatch_size": auto(int),  # rays whose gradient is computed at once
                "batching": "all_images",  # "all_images", or "single_image": each step takes one view
                "parallel": "auto",  # "jit", "sharded", "pmap"; "auto": jit on one device, otherwise sharded
                "max_steps": auto(int, 200_000),
                "max_seconds": 0.0,  # s of training without compilation; 0: no limit
                "lr_init": 5e-4,  # Adam
                "lr_final": 5e-5,  # reached exponentially at lr_steps
                "lr_steps": auto(int, 200_000),  # the run may end before or after; auto: max_steps
                "warmup_steps": 0,  # linear from 0
                "beta1": 0.9,
                "beta2": 0.999,
                "epsilon": 1e-8,
                # Above 0: the matrices of layers are updated by Muon in place of Adam, with updates of this root
                # mean square times the learning rate; Adam's are about 0.2.
                "muon": 0.0,
                # Above 0: images show parameters averaged over about the last 1 / power of all steps.
                "averaging_power": 0.0,
                "log_every": 100,  # steps
                "save_every": 5000,  # steps
                "max_to_keep": 3,  # checkpoints
                "max_nonfinite": 20,  # steps in a row without a finite gradient before the run stops
                "max_reinits": 10,  # reinitializations of dead networks before the run stops; 0: never
            },
            "eval": {
                "split": "test",
                "chunk": auto(int, 4096),  # rays rendered at once
                "sample_multiplier": 1.0,  # samples along a ray over those of training
                "bake_occupancy": False,  # render a hierarchical model through a grid of its visible matter
                "early_stop_eps": 1e-3,  # with a grid: transmittance below which a ray ends
                "max_samples": auto(int),  # with a grid: samples evaluated at once
                "at_end": False,  # score the split when training ends
            },
        }
    )
