"""The stages of structure from motion that pycolmap computes, each in a process of its own.

COLMAP logs to stderr, cannot be interrupted from Python, and may end its process when it meets an error. Its wheel
carries copies of image libraries that corrupt the memory of a process that also uses Pillow. In a process of its
own it can be ended at any time: COLMAP commits finished work to its database, and repeats none of it.
"""

import contextlib
import itertools
import math
import multiprocessing
import os
import re
import shutil
import signal
import sqlite3
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jaxnerf.runtime.atomic_files import open_regular

SEED = 0
_MIN_INLIERS, _MAX_DEGREES = 50, 60.0  # of a pair that can contradict a model, and the angle at which it does
_QUERY_SECONDS = 10.0
_PAIRS_AT_A_TIME = 200  # after which matches are committed; an interruption loses no more


class Model(NamedTuple):
    """A reconstruction that COLMAP has written.

    Attributes:
        folder: of its files.
        images: names of the registered images.
        num_points: points in space.
        track_length: the mean number of images that show a point.
        error: mean reprojection error, px.
        contradictions: the pairs of consecutive images whose matches contradict the model, see `map_images`.
    """

    folder: Path
    images: tuple[str, ...]
    num_points: int
    track_length: float
    error: float
    contradictions: tuple[tuple[str, str], ...] = ()


def call(stage: Callable, *arguments, log: Path, progress: Callable[[int | None], None]) -> Any:
    """Calls a stage in a new process, and ends the process if this one is interrupted.

    Args:
        stage: a function below that takes `report` by keyword.
        *arguments: its other arguments.
        log: the file to which COLMAP's messages are appended.
        progress: called about every second, with the number that the stage has reported last, or None.

    Returns:
        What the stage returns.

    Raises:
        ValueError: if the stage fails.
    """
    context = multiprocessing.get_context("spawn")  # a fork would copy JAX's locked mutexes
    receiver, sender = context.Pipe(duplex=False)
    process = context.Process(target=_run, args=(stage, arguments, sender, log), daemon=True)
    process.start()
    sender.close()
    count, reason = None, None
    try:
        while True:
            if receiver.poll(1.0):
                kind, value = receiver.recv()
                if kind != "count":
                    process.join(timeout=10)  # terminated now, it would leave a stack trace, or no reason, in the log
                if kind == "result":
                    return value
                if kind == "error":
                    reason = value
                    break
                count = value
            progress(count)
    except EOFError:  # the process has ended without a result
        process.join()
        number = process.exitcode
        reason = signal.Signals(-number).name if number < 0 else f"exit code {number}"
    finally:
        process.terminate()
        process.join()
    raise ValueError(
        f"{log}: COLMAP failed ({reason}); its messages are there. The same command continues from what is complete; "
        f"if it fails again, remove {log.parent} to begin again"
    )


def check_database(database: Path) -> None:
    """Checks that a database, if it exists, has nothing but the tables and indices that COLMAP makes.

    A view, a trigger, or a table that is computed, could make any query of a stranger's database run for ever.

    Raises:
        ValueError: names the database and what it has.
    """
    if not database.exists():
        return
    try:
        with _opened(database, "mode=ro") as connection:
            parts = connection.execute("SELECT type, name, coalesce(sql, '') FROM sqlite_master").fetchall()
    except sqlite3.Error as error:
        raise ValueError(f"{database}: is no database of COLMAP ({error}); remove {database.parent}") from None
    computed = re.compile(r"\bVIRTUAL\b|\bAS\s*\(", re.IGNORECASE)
    for kind, name, sql in parts:
        if kind not in ("table", "index") or computed.search(sql):
            raise ValueError(
                f"{database}: has the {kind} {name!r}, expected tables as COLMAP makes them; remove {database.parent}"
            )


@contextlib.contextmanager
def _opened(database, mode):
    """Yields a connection whose queries end with an sqlite3.Error after some seconds."""
    end = time.monotonic() + _QUERY_SECONDS
    with contextlib.closing(sqlite3.connect(f"{database.resolve().as_uri()}?{mode}", uri=True)) as connection:
        connection.set_progress_handler(lambda: time.monotonic() > end, 100_000)
        yield connection


def count_rows(database: Path, table: str, condition: str = "1", *, running: bool = False) -> int:
    """Returns the number of rows of a table of COLMAP's database.

    Args:
        database: the file.
        table, condition: in SQL.
        running: whether COLMAP may be using it. It fails if it opens a database while another process reads it, so
            the file is then read without a lock, and rows that are still in SQLite's log are not counted.
    """
    mode = "immutable=1" if running else "mode=ro"
    try:
        with _opened(database, mode) as connection:
            return connection.execute(f"SELECT COUNT(*) FROM {table} WHERE {condition}").fetchone()[0]
    except sqlite3.Error:  # not created yet, or read while it was changed
        return 0


def select_pairs(database: Path, target: Path, pairs: Sequence[tuple[str, str]]) -> None:
    """Writes a copy of a database that has the matches of the given pairs of images only."""
    target.unlink(missing_ok=True)
    with contextlib.closing(sqlite3.connect(database)) as source, contextlib.closing(sqlite3.connect(target)) as copy:
        source.backup(copy)
        ids = dict(copy.execute("SELECT name, image_id FROM images"))
        chosen = [sorted((ids[first], ids[second])) for first, second in pairs]
        copy.execute("CREATE TEMP TABLE chosen (pair_id INTEGER PRIMARY KEY)")
        copy.executemany("INSERT INTO chosen VALUES (? * 2147483647 + ?)", chosen)  # COLMAP's id of a pair
        copy.execute("DELETE FROM two_view_geometries WHERE pair_id NOT IN chosen")
        copy.commit()


def import_images(
    database: Path, folder: Path, groups: Sequence[Sequence[str]], camera_model: str, *, report: Callable
) -> list[str]:
    """Creates a database with the images of a folder; those of a group have one camera in common.

    Returns:
        The names of the images that COLMAP could read.
    """
    import pycolmap

    pycolmap.Database.open(database).close()
    options = pycolmap.ImageReaderOptions(camera_model=camera_model)
    for group in groups:
        pycolmap.import_images(database, folder, pycolmap.CameraMode.SINGLE, list(group), options)
    with pycolmap.Database.open(database) as opened:
        return [image.name for image in opened.read_all_images()]


def extract_features(
    database: Path, folder: Path, names: Sequence[str], max_size: int, num_threads: int, *, report: Callable
) -> None:
    """Adds the SIFT features of those images to a database that have none."""
    import pycolmap

    options = pycolmap.FeatureExtractionOptions(max_image_size=max_size, num_threads=num_threads)
    pycolmap.extract_features(database, folder, list(names), extraction_options=options, device=pycolmap.Device.cpu)


def match_features(database: Path, pairs: Path, num_threads: int, *, report: Callable) -> None:
    """Adds the geometrically verified matches of pairs of images, one pair a line, to a database."""
    import pycolmap

    pycolmap.set_random_seed(SEED)
    pycolmap.match_image_pairs(
        database,
        pycolmap.FeatureMatchingOptions(num_threads=num_threads),
        pycolmap.ImportedPairingOptions(match_list_path=pairs, block_size=_PAIRS_AT_A_TIME),
        pycolmap.TwoViewGeometryOptions(ransac=pycolmap.RANSACOptions(random_seed=SEED)),
        device=pycolmap.Device.cpu,
    )


def map_images(
    database: Path, folder: Path, names: Sequence[str], models: Path, num_threads: int, *, report: Callable
) -> list[Model]:
    """Estimates cameras and points incrementally, and writes each model to a folder 0, 1, ... below `models`.

    Where a scene repeats itself, as a can with the same label on its front and back, images of different sides
    match, and the model may fold a circle of cameras into a half. It then contradicts consecutive images of `names`:
    they match well with a small rotation between them, but the model has them far apart.

    Returns:
        The models, that with most images first. Of the others, those without images of their own are deleted:
        COLMAP has begun and abandoned them.
    """
    import pycolmap

    num_registered = 0

    def registered(count):
        nonlocal num_registered
        num_registered += count
        report(num_registered)

    pycolmap.set_random_seed(SEED)
    found = pycolmap.incremental_mapping(
        database,
        folder,
        models,
        pycolmap.IncrementalPipelineOptions(num_threads=num_threads, random_seed=SEED, min_model_size=3),
        initial_image_pair_callback=lambda: registered(2),
        next_image_callback=lambda: registered(1),
    )
    listed = [
        Model(
            models / str(index),
            tuple(model.image(key).name for key in model.reg_image_ids()),
            model.num_points3D(),
            model.compute_mean_track_length(),
            model.compute_mean_reprojection_error(),
            _contradictions(model, database, names),
        )
        for index, model in found.items()
    ]
    listed.sort(key=lambda model: -len(model.images))
    abandoned = [model for model in listed[1:] if set(model.images) <= set(listed[0].images)]
    for model in abandoned:
        shutil.rmtree(model.folder)
    return [model for model in listed if model not in abandoned]


def triangulate(
    database: Path,
    folder: Path,
    cameras: Mapping[str, tuple[str, Sequence[float], np.ndarray]],
    models: Path,
    num_threads: int,
    *,
    report: Callable,
) -> list[Model]:
    """Triangulates the matches of a database with known cameras, and writes the model to models/0.

    Args:
        database: with matches.
        folder: of the images.
        cameras: by the image's name: COLMAP's camera model, its parameters in px of the image, and the pose [3, 4]
            from the world to the camera, whose y axis points down and whose z axis points ahead.
        models: an existing folder.
        num_threads: see `map_images`.
    """
    import pycolmap

    known, target = pycolmap.Reconstruction(), models / "0"
    with pycolmap.Database.open(database) as opened:
        for image in opened.read_all_images():
            kind, parameters, pose = cameras[image.name]
            stored = opened.read_camera(image.camera_id)
            camera = pycolmap.Camera(model=kind, width=stored.width, height=stored.height, params=list(parameters))
            camera.camera_id = image.camera_id
            if image.camera_id not in known.cameras:
                known.add_camera_with_trivial_rig(camera)
            place = pycolmap.Rigid3d(pycolmap.Rotation3d(pose[:, :3]), pose[:, 3])
            keypoints = opened.read_keypoints(image.image_id)[:, :2].astype(float)
            image = pycolmap.Image(image.name, keypoints, image.camera_id, image.image_id)
            known.add_image_with_trivial_frame(image, place)
    target.mkdir()
    options = pycolmap.IncrementalPipelineOptions(num_threads=num_threads, random_seed=SEED, fix_existing_frames=True)
    model = pycolmap.triangulate_points(known, database, folder, target, options=options)
    report(model.num_reg_images())
    found = model.num_points3D(), model.compute_mean_track_length(), model.compute_mean_reprojection_error()
    return [Model(target, tuple(cameras), *found, ())]


def _contradictions(model, database, names):
    """Returns the consecutive images whose two-view rotation differs much from the model's."""
    import pycolmap

    registered, found = {model.image(key).name: model.image(key) for key in model.reg_image_ids()}, []
    with pycolmap.Database.open(database) as opened:
        for pair in itertools.pairwise(name for name in names if name in registered):
            first, second = (registered[name] for name in pair)
            matches = opened.read_two_view_geometry(first.image_id, second.image_id)
            if len(matches.inlier_matches) < _MIN_INLIERS:
                continue
            points = [opened.read_keypoints(image.image_id)[:, :2].astype(float) for image in (first, second)]
            cameras = [model.camera(image.camera_id) for image in (first, second)]
            if pycolmap.estimate_two_view_geometry_pose(cameras[0], points[0], cameras[1], points[1], matches):
                turn = second.cam_from_world().rotation * first.cam_from_world().rotation.inverse()
                if math.degrees((matches.cam2_from_cam1.rotation * turn.inverse()).angle()) > _MAX_DEGREES:
                    found.append(pair)
    return tuple(found)


def _run(stage, arguments, sender, log):
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches both processes; the other one ends this one
    with open_regular(log, "a") as file:
        os.dup2(file.fileno(), 1)
        os.dup2(file.fileno(), 2)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    try:
        sender.send(("result", stage(*arguments, report=lambda count: sender.send(("count", count)))))
    except Exception as error:
        sender.send(("error", f"{type(error).__name__}: {error}"))
        raise  # with its traceback, to the log


def _end_with_parent():
    multiprocessing.parent_process().join()
    os._exit(1)
