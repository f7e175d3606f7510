"""What others report, and other programs that were run by hand; no script of this project measured it.

Each entry names its source; "hardware" repeats that source and adds nothing. "seconds" is None where the source gives
no time. "what" names the images: figures of the same "what" compare with each other.
"""


def _entry(name, psnr, seconds, hardware, what, source, kind="published"):
    names = ("name", "psnr", "seconds", "hardware", "what", "source", "kind")
    return dict(zip(names, (name, psnr, seconds, hardware, what, source, kind), strict=True))


_LEGO, _MEAN = "lego, 800x800", "mean of 8 scenes, 800x800"
_RERUN = "nerfbaselines README, reruns by one protocol"
_BY_HAND = "one run of each, by hand"

TRAINING = [
    _entry("NeRF paper", 32.54, 3 * 86400, "not said", _LEGO, "nerf_spec.py; '3 days' by the JaxNeRF README"),
    _entry("JaxNeRF, 1M steps", 33.28, 2.5 * 3600, "128 TPUv2 cores", _LEGO, "JaxNeRF README"),
    _entry("nerfacc MLP, 50k", 33.69, 3600, "TITAN RTX", _LEGO, "nerfacc nerf.rst"),
    _entry("NGP official, 35k", 35.87, 263, "TITAN RTX", _LEGO, "nerfacc ngp.rst"),
    _entry("nerfacc NGP occ, 20k", 35.67, 269, "not said", _LEGO, "nerfacc ngp.rst"),
    _entry("NGP paper", 36.39, 300, "not said", _LEGO, "jaxngp README; '~5 min'"),
    _entry("mip-NeRF 360 (256)", 36.30, 2.80 * 3600, "not said", _LEGO, "multinerf generate_tables.ipynb"),
    _entry("TensoRF", 32.73, 617, "2080 Ti", _MEAN, "nerfacc tensorf.rst"),
    _entry("TensoRF + nerfacc", 32.52, 425, "2080 Ti", _MEAN, "nerfacc tensorf.rst"),
    _entry("NeRF official, rerun", 28.72, 23 * 3600 + 26 * 60, "not said", _MEAN, _RERUN),
    _entry("NGP, rerun", 32.20, 143, "not said", _MEAN, _RERUN),
    _entry("TensoRF, rerun", 33.17, 647, "not said", _MEAN, _RERUN),
    _entry("3DGS, rerun", 33.31, 366, "not said", _MEAN, _RERUN),
    _entry("Zip-NeRF, rerun", 33.67, 5 * 3600 + 22 * 60, "not said", _MEAN, _RERUN),
]
RENDERING = [  # seconds of an 800x800 frame, but where another size is said
    _entry("NeRF, TensorFlow", None, 27.74, "not said", "800x800", "JaxNeRF README"),
    _entry("JaxNeRF", None, 20.77, "1 V100", "800x800", "JaxNeRF README"),
    _entry("JaxNeRF", None, 2.65, "8 V100", "800x800", "JaxNeRF README"),
    _entry("JaxNeRF", None, 0.35, "128 TPUv2", "800x800", "JaxNeRF README"),
    _entry("ngp_pl", None, 1 / 32.4, "2080 Ti", "mean of the scenes' frames a second", "ngp_pl README"),
    _entry("torch-ngp", None, 1 / 7.8, "2080 Ti", "lego", "ngp_pl README"),
    _entry("jaxngp", None, 3.75, "GTX 1080 Ti", "1080p, of 288 frames", "jaxngp README"),
    _entry("TensoRF", None, 6.8, "one core, AVX2", "lego, 800x800, trained at 100x100", _BY_HAND, "measured by hand"),
    _entry("OpenSplat", None, 0.6, "one core, AVX2", "lego, 800x800, trained at 100x100", _BY_HAND, "measured by hand"),
]

# Whole test splits, and the 25 of the 200 test views (every 8th) that the benchmark scores.
_LEGO_25, _MIC, _MIC_25 = "lego, 800x800, 25 test views", "mic, 800x800", "mic, 800x800, 25 test views"
_PER_IMAGE = "nerfbaselines, results of each image"
_TABLE = "nerfbaselines, table of November 2025"
_AVX2, _TWO_CORES = "one core, AVX2, CPU s", "two busy cores, AVX-512, CPU s"

_DNERF, _RTX = "dnerf_lego, 400x400", "an RTX GPU; time: mean of 8 scenes"
# Beside the benchmark, with the entries of TRAINING for the same images.
BENCHMARK = [
    _entry("3DGS", 35.94, 359, "A100", _LEGO_25, _PER_IMAGE),
    _entry("Zip-NeRF", 35.88, 5.3 * 3600, "A100", _LEGO_25, _PER_IMAGE),
    _entry("instant-ngp", 35.78, 160, "A100", _LEGO_25, _PER_IMAGE),
    _entry("mip-NeRF 360", 33.21, 2.7 * 3600, "A100", _LEGO_25, _PER_IMAGE),
    _entry("nerfacto", 31.21, 584, "A100", _LEGO_25, _PER_IMAGE),
    _entry("TensoRF", 36.49, 600, "A100", _LEGO, _TABLE),
    _entry("3DGUT", 36.12, None, "A100", _LEGO, _TABLE),
    _entry("Zip-NeRF", 35.81, 5.3 * 3600, "A100", _LEGO, _PER_IMAGE),
    _entry("K-Planes", 35.73, None, "A100", _LEGO, _TABLE),
    _entry("3DGS", 35.70, 359, "A100", _LEGO, _PER_IMAGE),
    _entry("instant-ngp", 35.64, 160, "A100", _LEGO, _PER_IMAGE),
    _entry("mip-NeRF 360", 33.20, 2.7 * 3600, "A100", _LEGO, _PER_IMAGE),
    _entry("nerfacto", 31.37, 584, "A100", _LEGO, _PER_IMAGE),
    _entry("Zip-NeRF", 35.78, None, "A100", _MIC_25, _PER_IMAGE),
    _entry("3DGS", 35.39, None, "A100", _MIC_25, _PER_IMAGE),
    _entry("instant-ngp", 35.33, 145, "A100", _MIC_25, _PER_IMAGE),
    _entry("Tetra-NeRF", 34.51, None, "A100", _MIC_25, _PER_IMAGE),
    _entry("nerfacto", 33.67, None, "A100", _MIC_25, _PER_IMAGE),
    _entry("mip-NeRF 360", 31.48, None, "A100", _MIC_25, _PER_IMAGE),
    _entry("3DGS-MCMC", 37.28, None, "not said", _MIC, _TABLE),
    _entry("Zip-NeRF", 35.90, None, "A100", _MIC, _PER_IMAGE),
    _entry("3DGS", 35.49, None, "A100", _MIC, _PER_IMAGE),
    _entry("instant-ngp", 35.40, 145, "A100", _MIC, _PER_IMAGE),
    _entry("nerfacto", 33.74, None, "A100", _MIC, _PER_IMAGE),
    _entry("mip-NeRF 360", 31.50, None, "A100", _MIC, _PER_IMAGE),
    _entry("TensoRF", 25.08, 32 * 60, "not said", "fern, 1008x756", _TABLE),
    _entry("D-NeRF", 21.64, None, "not said; days", _DNERF, "arXiv:2011.13961"),
    _entry("T-NeRF, occupancy grid", 24.32, 58 * 60, _RTX, _DNERF, "nerfacc t-nerf.rst"),
    _entry("TiNeuVox", 24.32, 11.8 * 60, _RTX, _DNERF, "nerfacc tineuvox.rst"),
    _entry("TiNeuVox + nerfacc", 25.17, 4.2 * 60, _RTX, _DNERF, "nerfacc tineuvox.rst"),
    _entry("K-Planes", 25.18, 64 * 60, _RTX, _DNERF, "nerfacc kplanes.rst"),
    _entry("K-Planes + nerfacc", 25.25, 39 * 60, _RTX, _DNERF, "nerfacc kplanes.rst"),
]

# Run by hand, once each: TensoRF (VM decomposition, grid 32^3 to 100^3) in PyTorch, and OpenSplat's build for CPUs from
# 10,000 points on the visual hull of lego, or from COLMAP's points of can. Seconds are CPU seconds of the process.
_SIDE_BY_SIDE = (
    ("TensoRF", "lego, 100x100, 25 test views, without alpha", _AVX2, {15: 28.7, 30: 30.3, 60: 31.9, 120: 32.9}),
    ("OpenSplat", "lego, 100x100, 25 test views", _AVX2, {25: 26.1, 52: 28.4, 109: 30.2}),
    ("OpenSplat", "can with new poses, undistorted, 177x316", _TWO_CORES, {60: 20.1, 120: 22.0, 300: 24.6}),
)
BENCHMARK += [
    _entry(name, psnr, seconds, hardware, what, _BY_HAND, "side by side")
    for name, what, hardware, scores in _SIDE_BY_SIDE
    for seconds, psnr in scores.items()
]
