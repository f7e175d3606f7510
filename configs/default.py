"""Every field of a run's config, with its unit and meaning. The other files here change fields of this one.

A field that is "auto" is inferred when a run starts and logged with its reason. What depends on the dataset is saved to
the workdir; what depends on the device (microbatch_size, steps_per_dispatch, update_chunk, compute_dtype, chunk,
max_samples) is inferred again at every start.
"""

from ml_collections import ConfigDict

from jaxnerf.runtime.config_fields import auto, schedule


def mlp():
    """Returns the options of the paper's network (Fig. 7): 595,844 parameters."""
    return ConfigDict(
        {
            "depth": 8,  # layers before the density
            "width": 256,  # outputs of a layer
            "skip_layer": 4,  # index of the layer after which the encoded position is concatenated again
            "view_width": 128,  # outputs of the layer that takes the direction
            "num_freqs": auto(int, 10),  # octaves of the position's encoding
            "num_view_freqs": 4,  # octaves of the direction's encoding
            "encode": True,  # False: no positional encoding
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
                # "synthetic" (the embedded scene, rendered once and cached), "blender", "transforms", "colmap",
                # "llff", the name of a registered reader, or "auto"
                "format": "synthetic",
                "dir": "",  # the dataset's folder: a path, or a name below $JAXNERF_SCENES
                # Identifies the images and cameras that a run is trained on. It is empty for formats that store
                # each split in files of its own.
                "fingerprint": "auto",
                "factor": auto(int, 1),  # images are shrunk by this factor (area average); auto: to about data.width
                "width": 800,  # px
                "size": 100,  # px, side of the embedded scene's images
                "finish": "usual",  # surfaces of the embedded scene: "usual", "matt" (no view dependence), "shiny"
                # Distances along the camera's axis in the file's units. 0: each image has its own, from the dataset.
                # near "auto": one small distance where the occupancy sampler contracts space; otherwise 0.
                "near": auto(float),
                "far": 0.0,
                # The colour behind alpha and behind the scene: "white", "black", "none" (alpha is dropped, and
                # background_color is behind the scene) or "auto": "white" for images with alpha, otherwise "none".
                "background": "white",
                # Behind the scene where background is "none": red, green, blue in [0, 1], or () for black. auto: the
                # mean of the training images where the occupancy sampler contracts space, otherwise black.
                "background_color": auto(tuple),
                "hold_out": 0,  # every n-th training view belongs to the split "held_out" instead; 0: none
                "num_views": 0,  # number of training views to use, spread evenly over all of them; 0: all
                "pixel_offset": 0.5,  # px; rays pass through pixel centres (0.5) or pixel corners (0)
                # The world's coordinates: "file" (as in the dataset), "forward" (recentred for NDC), "around"
                # (centred on and scaled to the region that the cameras see) or "auto".
                "world": "auto",
                "ndc": auto(bool, False),  # rays in normalised device coordinates; requires the world "forward"
            },
            "field": "mlp",  # of the final rendering: "mlp" (section fine), "hash_grid", or a registered one
            "sampler": "hierarchical",  # or "occupancy" (section occupancy), or a registered one
            "coarse": mlp(),  # the network that guides the fine samples; sampler "hierarchical" only
            "fine": mlp(),  # the network of the final rendering
            "sampling": {  # of the sampler "hierarchical"
                "num_coarse": 64,  # samples per ray for the coarse network
                "num_fine": 128,  # additional samples per ray for the fine network; 0: no coarse network
                "rule": "segments",  # quadrature: "segments", "gauss" (pairs, fourth order) or "points" (the paper)
                "in_disparity": False,  # coarse samples in equal steps of 1 / t
                "stratified": True,  # False: training samples have fixed positions
                "importance_padding": 0.0,  # added to the coarse weights before importance sampling
                "density_noise": 0.0,  # 1 / world unit; standard deviation of the noise on the density in training
            },
            "hash_grid": {  # of the field "hash_grid"
                "resolutions": auto(tuple),  # vertices along the longest side, one number per level
                "features_per_level": 4,
                # Maximal rows per level; a level with more vertices is hashed. auto: 2^17 to 2^20, in proportion to an
                # image's side; four times as many on an accelerator.
                "table_size": auto(int, 2**17),
                # Outputs of a hidden layer of the density network; auto: 64 on a CPU, 128 on an accelerator.
                "width": auto(int, 64),
                "geometry_features": 15,  # outputs of the density network that the colour network reads
                "view_depth": 2,  # hidden layers of the colour network
                "view_width": auto(int, 128),  # outputs of such a layer; auto: as width
                "use_viewdirs": True,  # False: colour does not depend on the direction
                "feature_scale": 4.0,  # features are table entries times this; it scales the table's learning rate
                "compute_dtype": "auto",  # of the networks' layers: "float32" or "bfloat16"; all else is float32
            },
            "occupancy": {  # of the sampler "occupancy"; the box also bounds the hash grid
                "use_alpha": True,  # cells outside the visual hull of the alpha channels are empty from the start
                "contracted": auto(bool),  # the box holds all of space; positions outside its inner half are contracted
                "lower": auto(tuple),  # world units; the corners of the box
                "upper": auto(tuple),
                "step_size": auto(float),  # world units between samples
                "resolution": auto(int),  # cells along the longest side
                "threshold": 0.01,  # opacity over one step below which a cell is empty
                "update_every": 64,  # training steps between updates of the grid
                "cells_per_update": 2**18,  # cells whose density an update evaluates
                "update_chunk": auto(int),  # cells of these evaluated at once
                # Size of the sample buffer in training, divided by the number of rays. auto: on a CPU
                # cpu_pool_samples_per_ray; on an accelerator, which a larger buffer keeps busy, up to twice as much.
                "pool_samples_per_ray": auto(float, 10.0),
                "cpu_pool_samples_per_ray": 10.0,
                # If the samples of all rays do not fit into the buffer, the rays with most samples get fewer: this
                # fraction of them evenly, the others where the grid expects the rays to end.
                "uniform_fraction": 0.4,
                "max_optical_depth": 6.0,  # training skips samples behind it, as estimated by the grid; 0: off
                "occlusion_start_step": 400,  # training step from which max_optical_depth applies
                "min_views": auto(int),  # training views that must see a cell; other cells are empty; 0: no limit
            },
            # Weight of each loss; 0: off. A weight may be a schedule ((step, weight), ...), linear between its points.
            "losses": {
                "mse": schedule(1.0),
                "distortion": schedule(0.0),  # arXiv:2111.12077, Eq. 15
                # Depth of the dataset's sparse points, and interpolated between them (after arXiv:2107.02791); "auto":
                # at the start of training where space is contracted and there are such points.
                "depth": schedule("auto"),
                "opaque": schedule(0.0),  # squared transmittance of rays where the image is opaque
                # Regularizers of the hash grid: mean square of each level's entries (arXiv:2304.06706), and mean
                # squared difference of neighbouring vertices in the levels that are not hashed.
                "hash_decay": schedule(0.0),
                "total_variation": schedule(0.0),
            },
            "cameras": {  # parameters of the training images, trained with the networks
                "exposure": False,  # a gain per image and colour channel; renderings show the scene without it
                "exposure_lr": 1e-2,  # initial learning rate; it decays as that of the networks
                "refine": False,  # corrections of each pose and, common to all images, of the focal length
                "refine_lr": 5e-4,  # as exposure_lr; radians, fractions of the cameras' spread and of the focal length
                "refine_start_step": 300,  # training step before which cameras do not move
                "num_images": auto(int),  # of the split "train"
            },
            "train": {
                # Rays per step, over all devices. auto: cpu_batch_size on a CPU, twice as many for a large hash grid,
                # and cpu_batch_size with the sampler "hierarchical"; on an accelerator with the sampler "occupancy" as
                # many as keep it busy, in the same number of steps.
                "batch_size": auto(int, 1024),
                "cpu_batch_size": 1024,
                "microbatch_size": auto(int),  # rays per gradient accumulation
                "steps_per_dispatch": auto(int),  # training steps between which the host does nothing
                "batching": "all_images",  # "all_images", or "single_image": each step draws its rays from one view
                "parallel": "auto",  # "jit", "sharded", "pmap"; "auto": jit on one device, otherwise sharded
                # auto: by the size of the images and batch_size; without limit if time is limited
                "max_steps": auto(int, 200_000),
                # s of training, without compilation; 0: no limit. The learning rate then reaches its end when the time
                # does, so that the run depends on the clock.
                "max_seconds": 0.0,
                "lr_init": 5e-4,  # Adam
                "lr_final": 5e-5,  # reached at lr_steps
                # The rate is lr_init (lr_final / lr_init)^((step / lr_steps)^lr_decay_power). 1: exponential decay, as
                # in the paper; larger: the rate stays high for most of the run and then decreases quickly.
                "lr_decay_power": 1.0,
                "lr_steps": auto(int, 200_000),  # the run may end earlier or later; auto: max_steps
                "warmup_steps": 0,  # the learning rate rises linearly from 0
                "beta1": 0.9,
                "beta2": 0.999,
                "epsilon": 1e-8,
                # Above 0: Muon (arXiv:2502.16982) updates the matrices of the layers instead of Adam. Its updates
                # have this root mean square times the learning rate; those of Adam have about 0.2.
                "muon": 0.0,
                # Above 0: evaluation uses parameters averaged over about the last 1 / power of all steps
                # (arXiv:1212.1824).
                "averaging_power": 0.0,
                "log_every": 100,  # steps
                "save_every": 5000,  # steps
                # s of training between previews, images of a held-out view in previews/; 0: none. It increases to a
                # tenth of the time that has passed, and to ten times that which a preview takes.
                "preview_every": 60.0,
                "max_to_keep": 3,  # checkpoints
                "max_nonfinite": 20,  # consecutive steps without a finite gradient, after which the run fails
                "max_reinits": 10,  # reinitializations of dead networks before the run fails; 0: no check
            },
            "eval": {
                "split": "test",
                "chunk": auto(int),  # rays per rendered chunk
                # Samples per ray, divided by those of training. auto: 1.5, or 2.25 for images from 600 px a side on.
                "sample_multiplier": auto(float, 1.0),
                "bake_occupancy": False,  # render a hierarchical model with an occupancy grid of its visible density
                "early_stop_eps": 1e-3,  # with a grid: transmittance below which a ray is terminated
                "max_samples": auto(int),  # with a grid: size of the sample buffer
                "at_end": False,  # evaluate the split when training ends
                # s for scoring some training and some held-out views each when training ends; 0: none
                "summary_seconds": 5.0,
            },
        }
    )
