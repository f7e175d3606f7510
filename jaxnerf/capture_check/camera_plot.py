"""A picture of where the cameras stand, what they look at and what they see, from above and from a side."""

import numpy as np
from PIL import Image, ImageDraw, ImageFont

_SIZE = 640  # px, each of the two panels
_RIM = 46
_INK, _CAMERA, _FLAGGED, _POINT, _PALE = "#202020", "#2060c0", "#e02020", "#9a9a9a", "#d8d8d8"


def plot_cameras(capture, poses, places, *, flagged=()):
    """Returns a Pillow image of a capture's cameras and points.

    Args:
        capture: Capture of V frames.
        poses: [V, 3, 4], where they are drawn.
        places: [N, 3] world units, points; where there are none, and the capture has some, its own.
        flagged: indices of frames to draw in red.
    """
    if not len(places) and capture.points is not None:
        places = capture.points
    right, deep, up = _axes(poses)
    frusta = [_frustum(frame.camera, pose) for frame, pose in zip(capture.frames, poses, strict=True)]
    frusta = _scaled(np.stack(frusta), poses)
    sheet = Image.new("RGB", (2 * _SIZE, _SIZE + 30), "white")
    draw = ImageDraw.Draw(sheet)
    text = ImageFont.load_default(13)
    for panel, along in enumerate((deep, up)):
        view = np.stack([right, along])
        place = _view(np.concatenate([frusta.reshape(-1, 3), _middle_of(places)]), view, panel)
        _draw_scale(draw, place, view, panel, text)
        for x, y in place(places[:: max(1, len(places) // 6000)]):
            if panel * _SIZE < x < (panel + 1) * _SIZE and 0 < y < _SIZE:
                draw.rectangle((x, y, x + 1, y + 1), fill=_POINT)
        for index, corners in enumerate(frusta):
            _draw_frustum(draw, place(corners), _FLAGGED if index in flagged else _CAMERA)
    draw.line([(_SIZE, 0), (_SIZE, _SIZE)], fill=_PALE)
    legend = f"{len(frusta)} cameras (blue, open towards what they see), {len(places)} places (grey)"
    legend += f", {len(flagged)} cameras with findings (red)" if len(flagged) else ""
    draw.text((10, _SIZE + 8), f"{capture.source}: {legend}", fill=_INK, font=text)
    return sheet


def _axes(poses):
    """Returns the world's axes, or their opposites, that go right, away and up in the picture, [3, 3]."""
    mean = poses[:, :, 1].sum(axis=0)
    up = int(np.abs(mean).argmax())
    right, deep, up = np.roll(np.eye(3), -1 - up, axis=0)
    sign = -1.0 if mean @ up < 0 else 1.0
    return np.stack([sign * right, deep, sign * up])


def _frustum(camera, pose):
    """Returns the eye, the image's four corners at distance 1 along the axis, and its top, [6, 3]."""
    width, height = camera.width or 2 * camera.center[0], camera.height or 2 * camera.center[1]
    pixels = np.array([[0, 0], [width, 0], [width, height], [0, height], [width / 2, -height / 5]])
    x, y = ((pixels - camera.center) / camera.focal).T
    local = np.stack([x, -y, -np.ones_like(x)], axis=-1)
    return np.concatenate([pose[None, :, 3], pose[:, 3] + local @ pose[:, :3].T])


def _scaled(frusta, poses):
    """Returns the frusta, as long as a tenth of how far apart the cameras stand."""
    eyes = poses[:, :, 3]
    length = 0.1 * max(np.linalg.norm(eyes - eyes.mean(axis=0), axis=1).max(), 1e-9)
    return frusta[:, :1] + length * (frusta - frusta[:, :1])


def _middle_of(places):
    """Returns the places but for strays far out, so that these do not shrink the picture."""
    if not len(places):
        return np.zeros((0, 3))
    low, high = np.percentile(places, [5, 95], axis=0)
    return np.stack([low, high])


def _view(points, view, panel):
    """Returns the function from points [N, 3] to px [N, 2] of a panel that holds all of the given ones."""
    flat = points @ view.T
    low, high = flat.min(axis=0), flat.max(axis=0)
    scale = (_SIZE - 2 * _RIM) / max((high - low).max(), 1e-12)
    middle = (low + high) / 2

    def place(points):
        moved = (points @ view.T - middle) * scale * [1, -1]
        return moved + [panel * _SIZE + _SIZE / 2, _SIZE / 2]

    place.scale = scale
    return place


def _draw_frustum(draw, corners, colour):
    eye, *rim, top = (tuple(corner) for corner in corners)
    for corner in rim:
        draw.line([eye, corner], fill=colour)
    draw.line([*rim, rim[0]], fill=colour)
    draw.line([rim[0], top, rim[1]], fill=colour)  # the roof shows what the camera takes for up


def _draw_scale(draw, place, view, panel, text):
    unit = 10.0 ** np.floor(np.log10((_SIZE - 2 * _RIM) / place.scale / 2))
    left, bottom = panel * _SIZE + 16, _SIZE - 16
    end = left + unit * place.scale
    draw.line([(left, bottom), (end, bottom)], fill=_INK, width=2)
    draw.text((left, bottom - 18), f"length {unit:g}", fill=_INK, font=text)
    corner = panel * _SIZE + 16
    draw.line([(corner, 60), (corner + 30, 60)], fill=_INK)
    draw.line([(corner, 60), (corner, 30)], fill=_INK)
    draw.text((corner + 34, 52), _name(view[0]), fill=_INK, font=text)
    draw.text((corner - 6, 12), _name(view[1]), fill=_INK, font=text)
    draw.text((corner + 70, 12), ("from above", "from a side")[panel], fill=_INK, font=text)


def _name(axis):
    return f"{'-' if axis.sum() < 0 else '+'}{'xyz'[int(np.abs(axis).argmax())]}"
