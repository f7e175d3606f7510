"""The images that evaluation writes: contact sheets, depths, straight alpha."""

import imageio.v3 as iio
import numpy as np
import pytest

from jaxnerf import Rendering
from jaxnerf.evaluation import output_images


def write_sheet(folder, image):
    row = output_images.contact_sheet_row(np.ones((2, 2, 3)), image)
    output_images.write_contact_sheet(folder / "sheet.png", [row])


@pytest.mark.parametrize("far", [6.0, np.inf])
def test_a_contact_sheet_shows_near_depths_bright_and_infinity_black(tmp_path, far):
    depth = np.array([[2.0, 4.0], [5.0, far]], np.float32)
    image = Rendering(
        rgb=np.zeros((2, 2, 3)),
        opacity=np.ones((2, 2)),
        depth=depth,
        disparity=np.full((2, 2), np.inf),  # as where a sample lies at t = 0
        weights=None,
        num_dropped=np.zeros((2, 2), np.int32),
    )
    with np.errstate(all="raise"):
        write_sheet(tmp_path, image)
    sheet = iio.imread(tmp_path / "sheet.png")
    assert sheet.shape == (2, 10, 3)
    shades = sheet[:, 8:, 0].ravel()
    assert shades[0] == 255 and shades[3] == 0 and shades[0] > shades[1] > shades[2]


def test_a_contact_sheet_of_infinite_depths_is_black(tmp_path):
    flat = np.zeros((2, 2))
    image = Rendering(
        rgb=np.zeros((2, 2, 3)),
        opacity=flat,
        depth=flat + np.inf,
        disparity=flat,
        weights=None,
        num_dropped=flat,
    )
    write_sheet(tmp_path, image)
    assert iio.imread(tmp_path / "sheet.png")[:, 8:].max() == 0


def test_images_of_another_size_or_kind_are_damaged(tmp_path, capsys):
    """They would be shown as frames, or end the evaluation each time without a name."""
    good = {"color": np.zeros((4, 6, 3), np.uint8), "depth": np.zeros((4, 6), np.float32)}
    good["uncertainty"] = good["depth"]
    good |= {"rgba": np.zeros((4, 6, 4), np.uint8), "contact_sheet": np.zeros((3, 9, 3), np.uint8)}
    wrong = {name: [pixels[:3], pixels[..., 0], np.zeros((4, 6), np.uint8)] for name, pixels in good.items()}
    wrong["depth"] = wrong["uncertainty"] = [good["depth"][:3], good["color"]]
    wrong["contact_sheet"] = [good["rgba"], good["depth"]]
    for kind, pixels in good.items():
        suffix = "tiff" if kind in ("depth", "uncertainty") else "png"
        files = [tmp_path / kind / f"{index}.{suffix}" for index in range(len(wrong[kind]) + 1)]
        (tmp_path / kind).mkdir()
        for file, content in zip(files, [pixels, *wrong[kind]], strict=True):
            iio.imwrite(file, content, extension=".tiff" if content.dtype == np.float32 else ".png")
        found = output_images.readable([[file] for file in files], [(4, 6)] * len(files))
        assert found == [True] + [False] * len(wrong[kind])
        said = capsys.readouterr().err.splitlines()
        assert sorted(said) == sorted(f"{file}: is damaged; its view is rendered again" for file in files[1:])


def test_straight_alpha_recovers_a_known_color_over_any_background():
    opacity = np.array([[0.0, 0.5, 1.0, 1e-4]])
    own = np.array([0.2, 0.4, 0.6])
    for background in (None, (1.0, 0.5, 0.0)):
        behind = np.zeros(3) if background is None else np.array(background)
        rgb = opacity[..., None] * own + (1 - opacity[..., None]) * behind
        found = output_images.straight_alpha(rgb, opacity, background)[0]
        np.testing.assert_array_equal(found[[0, 3]], 0)
        np.testing.assert_allclose(found[1], [51, 102, 153, 128], atol=1.01)
        np.testing.assert_array_equal(found[2], [51, 102, 153, 255])


def test_depth_images_show_infinity_black_and_a_range_of_98_percent():
    depth = np.array([[1.0, 2.0, np.inf], [4.0, 0.0, 1e30]])
    assert output_images.depth_image(depth, 1.0, 4.0).tolist() == [[255, 85, 0], [0, 255, 0]]
    assert output_images.depth_range([np.full((9, 9), np.inf)]) == (1.0, 2.0)
    near, far = output_images.depth_range([np.repeat(np.linspace(2, 4, 1001), 17)] * 2)
    assert (near, far) == pytest.approx((2.02, 3.98), abs=1e-3)
    assert output_images.depth_image(np.full((2, 2), 3.0), 3.0, 3.0).tolist() == [[0, 0], [0, 0]]
