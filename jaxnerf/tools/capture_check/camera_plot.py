"""Plots the cameras of a dataset and what its images show, from above and from a side."""

import glob
import os
import pathlib

import jax
import numpy as np
from jaxtyping import Float, Int

from jaxnerf.core.types import Camera
from jaxnerf.data.images.image_files import open_image
from jaxnerf.runtime.atomic_files import partial_file
from jaxnerf.runtime.printed_text import printable
from jaxnerf.tools.capture_check.report import Report
from jaxnerf.tools.curve.plotting import Figure, LineCollection

CAMERA, FLAGGED, POINT, PATH, NEXT = "#2060c0", "#e02020", "#9a9a9a", "#20a040", "#d06000"
_SOFTWARE = "jaxnerf-check"
_ON_AXIS = np.cos(np.radians(5.0))  # of the angle between a direction and a world axis that stands for it


def plot_cameras(report: Report) -> Figure:
    """Returns a figure of the cameras, those of findings in red, of the points, and of the path.

    If the images agree on no points, those of the dataset's own model are drawn.
    """
    capture, poses, points = report.capture, report.poses, report.points
    if not len(points) and capture.points is not None:
        points = capture.points
    flagged = {index for finding in report.findings for index in finding.frames}
    eyes = poses[:, :, 3]
    length = 0.1 * max(np.linalg.norm(eyes - eyes.mean(axis=0), axis=1).max(), 1e-9)
    frusta = np.stack([_frustum(frame.camera, pose, length) for frame, pose in zip(capture.frames, poses, strict=True)])
    # Outliers among the points do not shrink the rest.
    inner = np.percentile(points, [5, 95], axis=0) if len(points) else np.zeros((0, 3))
    path = np.zeros((0, 3)) if report.path is None else report.path[:, :, 3]
    shown = np.concatenate([frusta.reshape(-1, 3), inner, path])
    points = points[:: max(1, len(points) // 6000)]
    colors = [FLAGGED if index in flagged else CAMERA for index in range(len(poses))]
    figure, plots = _plots(report.up, shown)
    for plot, view in plots:
        plot.scatter(*(points @ view).T, s=2, color=POINT, linewidths=0)
        plot.add_collection(LineCollection(frusta @ view, colors=colors, linewidths=0.8))
        plot.plot(*(path @ view).T, color=PATH, linewidth=1.5)
    text = f"{len(poses)} cameras (blue, open in viewing direction), {len(report.points)} points (grey)"
    text += f", {len(flagged)} cameras with findings (red)" if flagged else ""
    text += ", the path of jaxnerf-render (green)" if len(path) else ""
    figure.suptitle(printable(f"{capture.source}: {text}"), fontsize="medium", parse_math=False)
    return figure


def plot_coverage(
    cameras: Camera,
    next_cameras: Camera,
    up: Float[np.ndarray, "3"],
    positions: Float[np.ndarray, "M 3"],
    num_directions: Int[np.ndarray, " M"],
    title: str,
) -> Figure:
    """Returns a figure of cells, coloured by the number of directions from which they were seen, and of cameras.

    Args:
        cameras: those of the images, stacked.
        next_cameras: those of proposed images, stacked; they are numbered.
        up: unit vector.
        positions: of cells.
        num_directions: of the cells.
        title: of the figure.
    """
    eyes = np.concatenate([cameras.to_world[:, :, 3], next_cameras.to_world[:, :, 3]])
    length = 0.1 * max(np.linalg.norm(eyes - eyes.mean(axis=0), axis=1).max(), 1e-9)
    frusta, proposed = (_frusta(each, length) for each in (cameras, next_cameras))
    inner = np.percentile(positions, [5, 95], axis=0) if len(positions) else np.zeros((0, 3))
    figure, plots = _plots(up, np.concatenate([frusta.reshape(-1, 3), proposed.reshape(-1, 3), inner]))
    options = {"s": 4, "cmap": "viridis", "vmin": 1, "vmax": max(num_directions, default=1), "linewidths": 0}
    for plot, view in plots:
        order = np.argsort(positions @ np.cross(*view.T), kind="stable")  # near cells hide those behind
        cells = plot.scatter(*(positions[order] @ view).T, c=num_directions[order], **options)
        for each, color, width in ((frusta, CAMERA, 0.6), (proposed, NEXT, 1.6)):
            plot.add_collection(LineCollection(each @ view, colors=color, linewidths=width))
        for number, eye in enumerate(next_cameras.to_world[:, :, 3], 1):
            plot.annotate(str(number), eye @ view, color=NEXT, weight="bold", fontsize="large")
    if len(positions):
        figure.colorbar(cells, ax=[plot for plot, _ in plots], label="directions from which a cell was seen, of 64")
    figure.suptitle(printable(title), fontsize="medium", parse_math=False)
    return figure


def _plots(up, shown):
    """Returns a figure, and its plots from above and from a side, each with the matrix [3, 2] of its axes.

    The plots hold the positions shown [N, 3].
    """
    figure = Figure(figsize=(13, 6.7), dpi=100, layout="constrained")
    right, deep, up = _axes(up)
    made = []
    for plot, vertical, title in zip(figure.subplots(1, 2), (deep, up), ("from above", "from a side"), strict=True):
        view = np.stack([right, vertical], axis=-1)
        low, high = (shown @ view).min(axis=0), (shown @ view).max(axis=0)
        middle, reach = (low + high) / 2, 0.55 * max((high - low).max(), 1e-9)
        plot.set(xlim=middle[0] + [-reach, reach], ylim=middle[1] + [-reach, reach], aspect="equal", title=title)
        plot.set(xlabel=_name(right), ylabel=_name(vertical))
        made.append((plot, view))
    return figure, made


def _frusta(cameras, length):
    """Returns the frusta [V, 13, 3] of stacked cameras."""
    stack = [jax.tree.map(lambda leaf, index=index: leaf[index], cameras) for index in range(len(cameras.to_world))]
    return np.stack([_frustum(camera, camera.to_world, length) for camera in stack])


def new_path(out: str | None, folder: pathlib.Path, *, is_run: bool, overwrite: bool) -> pathlib.Path:
    """Returns the path of a plot to be written.

    Args:
        out: given by the user; None: check-FOLDER.png or, of a run, next-images-FOLDER.png, here. If that is another
            plot, as of a folder of the same name elsewhere, the parent folder's name is added.
        folder: of the dataset or the run.
        is_run: whether it is that of a run, which may hold the plot.
        overwrite: whether a file that is no plot of the folder is replaced.

    Raises:
        ValueError: if the plot would lie in the folder of a dataset, or replace another file.
    """
    place, kind = folder.resolve(), "next-images" if is_run else "check"
    path = pathlib.Path(out or f"{kind}-{place.name}.png")
    if not out and path.exists() and not is_plot_of(path, folder):
        path = pathlib.Path(f"{kind}-{place.parent.name}-{place.name}.png")
    if path.suffix.lower() != ".png":
        raise ValueError(f"--out is {str(path)!r}, expected a name that ends in .png; correct it")
    if not path.parent.is_dir():
        raise ValueError(f"--out is {str(path)!r}, but {path.parent} is not a folder; create it first")
    if not is_run and folder.resolve() in path.resolve().parents:
        raise ValueError(f"the plot {path} would be written into the dataset's folder; choose another path with --out")
    if path.exists() and not overwrite and not is_plot_of(path, folder):
        raise ValueError(f"{path} exists and is not a plot of {folder}; add --overwrite or choose another --out")
    return path


def save(figure: Figure, path: str | os.PathLike, folder: str | os.PathLike) -> None:
    """Writes a PNG that names the dataset's folder; see `is_plot_of`."""
    metadata = {"Software": _SOFTWARE, "Source": printable(pathlib.Path(folder).resolve())}
    path = pathlib.Path(path)
    for left in path.parent.glob(f"{glob.escape(path.name)}.*.tmp"):  # by a process that was killed
        left.unlink(missing_ok=True)
    with partial_file(path) as partial:
        figure.savefig(partial, format="png", metadata=metadata)


def is_plot_of(path: str | os.PathLike, folder: str | os.PathLike) -> bool:
    """Returns whether a file was written by `save` for the dataset in a folder."""
    try:
        with open_image(path) as image:
            found = image.info.get("Software"), image.info.get("Source")
    except (OSError, ValueError, SyntaxError):
        return False
    return found == (_SOFTWARE, printable(pathlib.Path(folder).resolve()))


def _axes(mean: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3 3"]:
    """Returns unit vectors that point right, away and up in the plots, as rows.

    They are signed world axes if an up direction is close to one, otherwise level directions close to these and up.
    """
    up = int(np.abs(mean).argmax())
    right, deep, up = np.roll(np.eye(3), -1 - up, axis=0)
    sign = -1.0 if mean @ up < 0 else 1.0
    right, deep, up = sign * right, deep, sign * up
    if mean @ up < _ON_AXIS * np.linalg.norm(mean):
        up = mean / np.linalg.norm(mean)
        right = right - (right @ up) * up
        right /= np.linalg.norm(right)
        deep = np.cross(up, right)
    return np.stack([right, deep, up])


def _frustum(camera: Camera, pose: Float[np.ndarray, "3 4"], length: float) -> Float[np.ndarray, "13 3"]:
    """Returns a line through the eye and the image's corners; a triangle on its top edge shows up."""
    width, height = camera.width or 2 * camera.center[0], camera.height or 2 * camera.center[1]
    pixels = np.array([[0, 0], [width, 0], [width, height], [0, height], [width / 2, -height / 5]])
    x, y = ((pixels - camera.center) / camera.focal).T
    corners = pose[:, 3] + length * np.stack([x, -y, -np.ones_like(x)], axis=-1) @ pose[:, :3].T
    return np.stack([pose[:, 3], *corners])[[0, 1, 2, 0, 3, 4, 0, 1, 5, 2, 3, 4, 1]]


def _name(axis: Float[np.ndarray, "3"]) -> str:
    if np.abs(axis).max() < _ON_AXIS:
        return f"along ({', '.join(f'{value:.2f}' for value in axis)}) (world units)"
    return f"{'-' if axis.sum() < 0 else '+'}{'xyz'[int(np.abs(axis).argmax())]} (world units)"
