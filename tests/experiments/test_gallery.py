"""The gallery shows of each run the view in the middle and the newest frames, and names runs that lack either."""

import json

import imageio.v3 as iio
import numpy as np
import pytest

from jaxnerf.configs import smoke
from jaxnerf.training.config import read_config
from jaxnerf.training.workdir import save_config
from runs import ROOT, run_forked

SIDE = 16


@pytest.fixture
def run(tmp_path):
    """A workdir that was scored on three views, and rendered in six frames."""
    folder = tmp_path / "mine"
    scored, frames = folder / "eval" / "20", folder / "renders" / "arc-20" / "color"
    for kind in (scored / "color", scored / "gt-color", scored / "depth", frames):
        kind.mkdir(parents=True)
    save_config(folder, read_config(smoke.get_config()))
    results = {"training_seconds": 12.0, "psnr": 31.416, "ssim": 0.9, "views": 3, "seconds_per_frame": 0.25}
    (scored / "results.json").write_text(json.dumps(results))
    for view in range(3):
        for kind, level in (("gt-color", 200), ("color", 100)):
            iio.imwrite(scored / kind / f"{view:03d}.png", np.full((SIDE, SIDE, 3), level + view, np.uint8))
        iio.imwrite(
            scored / "depth" / f"{view:03d}.tiff", np.linspace(1, 2, SIDE**2, dtype=np.float32).reshape(SIDE, -1)
        )
    for frame in range(6):
        iio.imwrite(frames / f"{frame:04d}.png", np.full((SIDE, 2 * SIDE, 3), 40 * frame, np.uint8))
    return folder


def make_gallery(*arguments):
    """Returns (exit code, stderr) of the program."""
    code, _, errors = run_forked(ROOT / "experiments" / "results" / "gallery.py", *arguments)
    return code, errors


def test_the_page_shows_the_middle_view_and_some_frames(run, tmp_path):
    out = tmp_path / "gallery"
    code, errors = make_gallery(run, f"--out={out}", "--frames=3", f"--width={SIDE}")
    assert code == 0, errors
    page = (out / "index.md").read_text()
    assert "12 s of training, PSNR 31.42 dB and SSIM 0.900 on 3 views, 0.25 s a frame" in page and "arc-20" in page
    strip = iio.imread(out / "mine.jpg").astype(int)
    assert strip.shape == (SIDE, 3 * SIDE, 3)
    assert abs(strip[:, : SIDE - 2] - 201).max() <= 4 and abs(strip[:, SIDE + 2 : 2 * SIDE - 2] - 101).max() <= 4
    assert strip[0, 2 * SIDE + 2 :].mean() > strip[-1, 2 * SIDE + 2 :].mean() + 100  # near is bright
    video = np.stack(list(iio.imiter(out / "mine.webp", plugin="pillow")))
    assert video.shape == (3, SIDE // 2, SIDE, 3)
    np.testing.assert_allclose(video.mean(axis=(1, 2, 3)), [0, 80, 160], atol=4)


def test_what_else_a_page_says_stays(run, tmp_path):
    text = "# Gallery\n\nMine.\n\n<!-- runs -->\nold\n<!-- end of runs -->\n\nBelow.\n"
    (tmp_path / "index.md").write_text(text)
    assert make_gallery(run, f"--out={tmp_path}")[0] == 0
    page = (tmp_path / "index.md").read_text()
    assert "Mine." in page and page.endswith("Below.\n") and "## mine" in page and "old" not in page


def test_a_run_that_was_not_rendered_is_named(run, tmp_path):
    (run / "renders").rename(tmp_path / "elsewhere")
    code, errors = make_gallery(run, f"--out={tmp_path / 'gallery'}")
    assert code and "lacks scores or frames" in errors and "mine" in errors and "Traceback" not in errors
    assert make_gallery(f"--out={tmp_path / 'gallery'}")[0]
