"""What others report, gathered before the project began; no script of this project measured it.

Each entry names its source; "hardware" repeats that source and adds nothing.
"""


def _entry(name, psnr, seconds, hardware, what, source, kind="published"):
    names = ("name", "psnr", "seconds", "hardware", "what", "source", "kind")
    return dict(zip(names, (name, psnr, seconds, hardware, what, source, kind), strict=True))


_LEGO, _MEAN = "lego, 800x800", "mean of 8 scenes, 800x800"
_RERUN = "nerfbaselines README, reruns by one protocol"
_CORE, _PART_E, _BEFORE = (
    "one core, 2.5 GHz AVX-512 Xeon",
    "one run of each, by hand",
    "measured before the start",
)
_LEGO_100 = "lego, 100x100, 13 held-out training views"

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
TRAINING += [
    _entry(f"{name}, {minutes:g} min", psnr, 60 * minutes, _CORE, _LEGO_100, _PART_E, _BEFORE)
    for name, points in {
        "nerf-pytorch, 64+64, 512 rays": {5: 10.8, 12: 16.5},
        "JaxNeRF, 64+64, 512 rays": {5: 15.3, 12: 18.2},
        "JaxNeRF, 32+32, 256 rays": {2.5: 17.3, 5: 18.9, 12: 20.6, 25: 21.4, 40: 22.2},
    }.items()
    for minutes, psnr in points.items()
]
RENDERING = [  # seconds of an 800x800 frame, but where another size is said
    _entry("NeRF, TensorFlow", None, 27.74, "not said", "800x800", "JaxNeRF README"),
    _entry("JaxNeRF", None, 20.77, "1 V100", "800x800", "JaxNeRF README"),
    _entry("JaxNeRF", None, 2.65, "8 V100", "800x800", "JaxNeRF README"),
    _entry("JaxNeRF", None, 0.35, "128 TPUv2", "800x800", "JaxNeRF README"),
    _entry("ngp_pl", None, 1 / 32.4, "2080 Ti", "mean of the scenes' frames a second", "ngp_pl README"),
    _entry("torch-ngp", None, 1 / 7.8, "2080 Ti", "lego", "ngp_pl README"),
    _entry("jaxngp", None, 3.75, "GTX 1080 Ti", "1080p, of 288 frames", "jaxngp README"),
    _entry("nerf-pytorch", None, 4870, _CORE, "800x800, extrapolated", _PART_E, _BEFORE),
    _entry("JaxNeRF", None, 3840, _CORE, "800x800, extrapolated", _PART_E, _BEFORE),
    _entry("TensoRF", None, 6.8, "one core, AVX2", "lego, 800x800, trained at 100x100", _PART_E, "measured by hand"),
    _entry("OpenSplat", None, 0.6, "one core, AVX2", "lego, 800x800, trained at 100x100", _PART_E, "measured by hand"),
]

# Peers on one core of a machine with AVX2, process CPU seconds, one run each, by hand: TensoRF (VM decomposition, grid
# 32^3 to 100^3) in PyTorch, and OpenSplat's CPU build from 10,000 points on the visual hull of lego and from COLMAP's
# points of can. Curve of this project beside them: {peer: {seconds: PSNR}}.
PEERS = {
    "grid without alpha": {"TensoRF": {15: 28.7, 30: 30.3, 60: 31.9, 120: 32.9}},
    "grid": {"OpenSplat": {25: 26.1, 52: 28.4, 109: 30.2}},
    "capture can": {"OpenSplat": {60: 22.6, 120: 23.7, 300: 24.5}},
}
