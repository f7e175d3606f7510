"""Every knob of a run, with its unit. The other files here change fields of this one."""

from ml_collections import ConfigDict


def mlp():
    """The paper's network (Fig. 7): 595,844 parameters."""
    return ConfigDict(
        {
            "depth": 8,  # layers before density
            "width": 256,  # features a layer
            "skip_layer": 4,  # the encoded position joins again after the layer of this index
            "view_width": 128,  # features of the layer that sees the direction
            "num_freqs": 10,  # octaves of the position; 0, with space.skip_empty, fits the images
            "num_view_freqs": 4,  # octaves of the direction
            "encode": True,  # False: no octaves at all, the network gets both as they are
            "use_viewdirs": True,  # False: colour does not depend on the direction
            "density_activation": "relu",  # "relu" or "softplus"
            "density_bias": 0.0,  # added before the activation
            "compute_dtype": "float32",  # or "bfloat16", or "float64" under JAX_ENABLE_X64=1
        }
    )


def get_config():
    """Returns the configuration of the paper's method on the embedded scene."""
    return ConfigDict(
        {
            "seed": 0,
            "data": {
                # "synthetic" (embedded, rendered once and cached), "blender", "transforms" (transforms.json),
                # "colmap", "llff", or "auto": what is in the folder
                "format": "synthetic",
                "dir": "",  # the scene's folder, here or under $JAXNERF_SCENES
                # which photographs and cameras "dir" holds, written when training begins; not of "blender",
                # whose splits have files of their own
                "capture": "",
                "factor": 1,  # images are area-averaged down this many times; 0: to data.width
                "width": 800,  # px, about
                "size": 100,  # px, side of the embedded scene's images
                "finish": "usual",  # of the embedded scene; "matt": the same from everywhere; "shiny"
                "near": 0.0,  # along the camera's axis, in the file's units; 0: by the capture, 2 for Blender
                "far": 0.0,  # the same; 0: by the capture, 6 for Blender
                # behind alpha and behind the scene: "white", "black", "none"; "": white where there is alpha
                "background": "white",
                "hold_out": 0,  # every n-th training view is in the split "held_out" instead
                "num_views": 0,  # of what is left, to train on, evenly spread; 0: all
                "pixel_offset": 0.5,  # px; 0.5 looks through pixel centres, 0 is what the 2020 code did
                # "file": as cameras stand there; "forward": recentred for NDC; "around": what they look at in
                # the middle; "auto": by the cameras
                "world": "auto",
                "ndc": False,  # normalised device coordinates, for a world that is "forward"; None: then
            },
            "field": "mlp",  # what "fine" is: "mlp", or "grid": the features below, with space.skip_empty
            "coarse": mlp(),  # guides the fine samples
            "fine": mlp(),  # is what counts; absent when sampling.num_fine is 0
            "sampling": {
                "num_coarse": 64,  # samples a ray of the coarse network
                "num_fine": 128,  # points more for the fine network
                "rule": "segments",  # "segments", "gauss" (pairs, fourth order) or "points" (the paper)
                "in_disparity": False,  # coarse samples in equal steps of 1 / t
                "stratified": True,  # False: training too has its samples in the same places every time
                "importance_floor": 0.0,  # added to the weights before they guide samples
                "density_noise": 0.0,  # 1 / world unit, deviation of noise on the density in training
            },
            "features": {  # the fast field
                "resolutions": (),  # vertices along the longest side, a level each; () fits the images
                "features": 4,  # of a vertex
                "table_size": 2**17,  # vertices of a level that have their own features
                "width": 64,  # of the density's hidden layer
                "geometry": 15,  # what colour learns of a place, beside the direction
                "view_depth": 2,  # hidden layers of colour
                "view_width": 128,
                "use_viewdirs": True,
                "scale": 4.0,  # of the features over their table, whose learning rate it multiplies
            },
            "space": {  # where the scene is asked; what is 0 or () fits cameras, masks and images
                "skip_empty": False,  # one field on equal steps where something is; no coarse network
                "masks": True,  # alpha 0 shows that nothing is there
                "outside": "nothing",  # of the box; "contracted": all of space is in it; "": by the capture
                "lower": (),  # world units, the box
                "upper": (),
                "step": 0.0,  # world units between samples
                "resolution": 0,  # cells along the longest side
                "threshold": 0.01,  # share of light that a step absorbs, below which a cell is empty
                "update_every": 64,  # steps between looks at the cells
                "look_at_once": 2**18,  # cells
                "samples_per_ray": 10,  # room in training's pool; rays without room are left out and counted
                "fog_until": 300,  # step before which samples are three steps long
                "hide_beyond": 6.0,  # optical depth by the grid's guess behind which training asks no more
                "hide_from": 400,  # step
            },
            "train": {
                "batch_size": 1024,  # rays a step, over all devices
                "block_size": 0,  # rays whose gradient is taken at once; 0: what is fastest and fits
                "batching": "all_images",  # "all_images", or "single_image": a view a step
                "parallel": "auto",  # "jit", "sharded", "pmap"; auto: jit on one device, else sharded
                "max_steps": 200_000,  # 0, with space.skip_empty, fits the images
                "max_seconds": 0.0,  # s of training without compilation; 0: no limit
                "lr_init": 5e-4,  # Adam
                "lr_final": 5e-5,  # reached exponentially at lr_steps
                "lr_steps": 200_000,  # the run may end before or after; 0, with space.skip_empty: max_steps
                "warmup_steps": 0,  # linear from 0
                "beta1": 0.9,
                "beta2": 0.999,
                "epsilon": 1e-8,
                # > 0: matrices of layers move by Muon in place of Adam, in a step by this times the learning
                # rate (root mean square); 0.2 is about what Adam moves them by
                "muon": 0.0,
                # > 0: what is rendered are parameters averaged over about the last power-th of all steps
                "average_power": 0.0,
                "log_every": 100,  # steps
                "save_every": 5000,  # steps
                "keep": 3,  # checkpoints
                "max_nonfinite": 20,  # steps in a row without a finite gradient before the run stops
                # times that a network is begun anew which no gradient reaches, before the run stops; 0: never
                "revive": 10,
            },
            "eval": {
                "split": "test",
                "chunk": 4096,  # rays rendered at once; 0: what suits the device and fits
                "samples": 1.0,  # along a ray, times those of training
                "skip_empty": False,  # of a network trained along whole rays: leave out what is not seen
                "stop": 1e-3,  # where empty space is skipped: a ray ends where no more than this passes
                "samples_at_once": 0,  # where empty space is skipped; 0: what the device is fastest with
                "at_end": False,  # score the split when training ends
            },
        }
    )
