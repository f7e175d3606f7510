"""Estimates cameras from images alone: features, matches and incremental mapping with COLMAP."""

import importlib.util
import json
import os
import shutil
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from jaxnerf.data import dataset
from jaxnerf.data.dataset import DataOptions
from jaxnerf.data.images.image_files import image_size
from jaxnerf.data.readers import colmap
from jaxnerf.options import AUTO
from jaxnerf.registry import READERS
from jaxnerf.runtime.atomic_files import check_tree, partial_file, read_bytes, remove, sweep, write_text
from jaxnerf.runtime.fingerprint import file_sha256
from jaxnerf.runtime.printed_text import printable
from jaxnerf.runtime.stages import Stage
from jaxnerf.tools.structure_from_motion import colmap_process
from jaxnerf.tools.structure_from_motion import images as images_module
from jaxnerf.tools.structure_from_motion.colmap_process import Model

_NOTES = "jaxnerf_notes.txt"  # beside the model, which jaxnerf-check repeats
CAMERA_MODELS = (  # of which the reader's lenses have all parameters
    "SIMPLE_PINHOLE",
    "PINHOLE",
    "SIMPLE_RADIAL",
    "RADIAL",
    "OPENCV",
    "SIMPLE_RADIAL_FISHEYE",
    "RADIAL_FISHEYE",
    "OPENCV_FISHEYE",
)
MATCHING = ("auto", "exhaustive", "sequential")


class Settings(NamedTuple):
    """How cameras are estimated.

    Attributes:
        camera_model: one of CAMERA_MODELS.
        single_camera: whether all images of one size have one camera in common.
        matching: see `image_pairs`; "auto": exhaustive for up to 200 images, otherwise sequential.
        max_size: px, the longer side at which features are extracted. Cameras are those of the full images.
        cameras_of: folder of a dataset, of any format, with the same images, whose cameras are kept: only points are
            found; "": cameras are estimated.
    """

    camera_model: str = "OPENCV"
    single_camera: bool = True
    matching: str = "auto"
    max_size: int = 1600
    cameras_of: str = ""


class Report(NamedTuple):
    """The result of `estimate_cameras`.

    Attributes:
        out: the folder of the dataset.
        images: names of all images.
        cameras: a description of each camera.
        models: COLMAP's models, that with most images first; it is the dataset's.
        seconds: the time that each stage took in this call.
        notes: what else the user should know.
    """

    out: Path
    images: tuple[str, ...]
    cameras: tuple[str, ...]
    models: tuple[Model, ...]
    seconds: dict[str, float]
    notes: tuple[str, ...] = ()

    def text(self) -> str:
        """Returns the report as text, which ends in the next commands."""
        model, *others = self.models
        missing = [name for name in self.images if name not in set(model.images)]
        registered = f"{len(model.images)} of {len(self.images)} images"
        if others:
            sizes = ", ".join(str(len(other.images)) for other in others)
            registered += (
                f", the largest of {len(self.models)} models that COLMAP could not connect; the others have {sizes} "
                f"images and are in {others[0].folder.parent}"
            )
        lines = [("registered", registered)]
        if missing:
            lines.append(("not registered", f"{_listed(missing)}; more images between these and the others help"))
        lines += [("camera", camera) for camera in self.cameras]
        lines += [
            ("error", f"{model.error:.2f} px, mean reprojection error"),
            ("points", f"{model.num_points}, each in {model.track_length:.1f} images on average"),
            *(("note", note) for note in self.notes),
            ("written", f"{self.out / 'sparse' / '0'}"),
            ("time", ", ".join(f"{stage} {seconds:.0f} s" for stage, seconds in self.seconds.items())),
        ]
        name = self.out.resolve().name
        return "\n".join(
            [
                *(f"{name:14}  {printable(value)}" for name, value in lines),
                "next:",
                f"  jaxnerf-check --data_dir={self.out}",
                f"  jaxnerf-train --config=capture --data_dir={self.out} --workdir=runs/{name}",
            ]
        )


def estimate_cameras(
    images: str | os.PathLike,
    out: str | os.PathLike,
    settings: Settings | None = None,
    *,
    num_threads: int | None = None,
    overwrite: bool = False,
    say: Callable[[str], None] = print,
) -> Report:
    """Estimates the cameras of a folder of images and writes a dataset that the COLMAP reader reads.

    `out` receives images/ with copies of the images, sparse/0/ with the model, and cameras/ with COLMAP's
    database and messages. If `images` is out/images, the images are used where they are. The lens's distortion
    stays in the model; images are not undistorted. An interrupted call continues: features, matches and copies
    that exist are not made again. With num_threads=1 the result depends on the images and settings only.

    Args:
        images: the folder of the images of one static scene.
        out: the dataset's folder; it is created.
        settings: of COLMAP; its defaults when None.
        num_threads: None: one for each core.
        overwrite: whether an existing model, database and copies are replaced.
        say: receives lines about the progress.

    Raises:
        ValueError: names the file or setting, what was found, what is expected and what to do.
    """
    images, out, settings = Path(images), Path(out), settings or Settings()
    _check_choice("camera_model", settings.camera_model, CAMERA_MODELS)
    _check_choice("matching", settings.matching, MATCHING)
    paths, others = images_module.find_images(images)
    _check_out(out, overwrite)
    in_place = images.resolve() == (out / "images").resolve()
    for name in ("cameras", "sparse") if in_place else ("cameras", "sparse", "images"):
        check_tree(out / name)
    if in_place:
        _check_names(paths)
    if importlib.util.find_spec("pycolmap") is None:
        raise ValueError(
            "pycolmap is not installed, expected it for structure from motion; pip install 'jaxnerf[cameras]'"
        )
    matching = images_module.resolve_matching(settings.matching, len(paths))
    used = {**settings._asdict(), "matching": matching, "images": {path.name: file_sha256(path) for path in paths}}
    del used["cameras_of"]  # features and matches do not depend on it
    known = known_cameras(settings.cameras_of, paths) if settings.cameras_of else None
    say(f"images: {len(paths)} in {images}" + (f"; its other files are skipped: {others}" if others else ""))
    stages = _Stages(out, used, num_threads or -1, overwrite, say)
    names, notes = stages.prepare_images(paths, in_place)
    stages.extract(names)
    stages.match(names)
    models, more = stages.map_images(names) if known is None else (stages.triangulate(known), [])
    notes += more
    _publish(models[0].folder, out / "sparse", stages.work)
    capture = colmap.read_capture(out)
    cameras = _describe_cameras([frame.camera for frame in capture.frames], settings.camera_model)
    return Report(out, tuple(names), cameras, tuple(models), stages.seconds, tuple(notes))


class _Stages:
    """The stages of `estimate_cameras`, and the files that they leave for a later call."""

    def __init__(self, out, settings, num_threads, overwrite, say):
        self.images, self.work = out / "images", out / "cameras"
        self.settings, self.num_threads, self.overwrite, self.say = settings, num_threads, overwrite, say
        self.database, self.log, self.seconds = self.work / "database.db", self.work / "log.txt", {}
        self.work.mkdir(parents=True, exist_ok=True)
        self._claim()
        colmap_process.check_database(self.database)

    def prepare_images(self, paths, in_place):
        """Copies and checks the images, and creates the database; returns their names, and notes."""
        with _Progress(self.say, "images", "images", len(paths)) as progress:
            notes = [f"images are in {self.images}" + ("" if in_place else ", copied")]
            if in_place:
                if not self.database.exists():
                    images_module.check_images(paths, progress)
                turned = sum(map(images_module.is_rotated_jpeg, paths))
                note = (
                    f"{turned} images are rotated by their EXIF orientation, which is not followed where they are used"
                )
                notes += [f"{note}; with another --out, upright copies are made"] if turned else []
            else:
                self.images.mkdir(exist_ok=True)
                turned = images_module.copy_images(paths, self.images, overwrite=self.overwrite, progress=progress)
                notes += [f"{turned} copies were turned upright, as the EXIF orientation says"] if turned else []
            copies = [self.images / images_module.copy_name(path) for path in paths]
            names = [path.name for path in copies]
            if not self.database.exists():
                self._import(copies)
            self.seconds["images"] = progress.end(len(paths))
        return names, notes

    def extract(self, names):
        """Extracts the features of all images."""
        with _Progress(self.say, "features", "images", len(names)) as progress:

            def count(running=False):
                return colmap_process.count_rows(self.database, "descriptors", running=running)

            if count() < len(names):
                arguments = (self.database, self.images, names, self.settings["max_size"], self.num_threads)
                self._call(
                    colmap_process.extract_features, *arguments, progress=lambda _: progress(count(running=True))
                )
            if count() < len(names):
                raise ValueError(
                    f"{self.log}: COLMAP found features in {count()} of {len(names)} images; see its messages"
                )
            self.seconds["features"] = progress.end(len(names))

    def match(self, names):
        """Matches the features of pairs of images."""
        pairs = images_module.image_pairs(names, self.settings["matching"])
        with _Progress(self.say, f"{self.settings['matching']} matching", "pairs", len(pairs)) as progress:

            def count(running=False):
                return colmap_process.count_rows(self.database, "two_view_geometries", running=running)

            if count() < len(pairs):
                listed = self.work / "pairs.txt"
                write_text(listed, "".join(f"{first} {second}\n" for first, second in pairs))
                arguments = (self.database, listed, self.num_threads)
                self._call(colmap_process.match_features, *arguments, progress=lambda _: progress(count(running=True)))
            self.seconds["matching"] = progress.end(count())

    def map_images(self, names):
        """Returns the models that COLMAP estimates, that with most images first, and notes.

        A model that contradicts consecutive images is estimated again from the matches of images that are close in
        the order of their names.
        """
        models = self._map(self.database, names, "models")
        wrong = models[0].contradictions
        if not wrong:
            return models, []
        example = (
            f"{len(wrong)} pair{'s' * (len(wrong) != 1)} of consecutive images, such as {wrong[0][0]} and {wrong[0][1]}"
        )
        self.say(f"the model contradicts the matches of {example}; mapping again without the matches of distant images")
        close = self.work / "close_pairs.db"
        colmap_process.select_pairs(self.database, close, images_module.image_pairs(names, "neighbours"))
        again = self._map(close, names, "models_of_close_pairs")
        close.unlink()
        better = again and len(again[0].contradictions) < len(wrong) and len(again[0].images) >= len(models[0].images)
        shutil.rmtree(self.work / ("models" if better else "models_of_close_pairs"))
        if better:
            note = (
                f"the scene repeats itself: a first model contradicted {example}; only the matches of images at most "
            )
            return again, [f"{note}{images_module.OVERLAP} places apart in the order of their names were used"]
        note = f"the cameras may be wrong, as they contradict {example}: does the scene repeat itself?"
        write_text(models[0].folder / _NOTES, note + "\n")
        return models, [note]

    def triangulate(self, known):
        """Returns COLMAP's model of known cameras; known: see `colmap_process.triangulate`."""
        models = self._new_models("models")
        with _Progress(self.say, "triangulation", "images", len(known)) as progress:
            arguments = (self.database, self.images, known, models, self.num_threads)
            found = self._call(colmap_process.triangulate, *arguments, progress=progress)
            self.seconds["triangulation"] = progress.end(len(known))
        return found

    def _new_models(self, folder):
        models = self.work / folder
        remove(models)
        models.mkdir()
        return models

    def _map(self, database, names, folder):
        models = self._new_models(folder)
        with _Progress(self.say, "mapping", "images", len(names)) as progress:
            arguments = (database, self.images, names, models, self.num_threads)
            found = self._call(colmap_process.map_images, *arguments, progress=progress)
            if not found and database == self.database:
                verified = colmap_process.count_rows(self.database, "two_view_geometries", "rows > 0")
                raise ValueError(
                    f"{self.images}: COLMAP registered none of {len(names)} images; {verified} pairs of them have "
                    "matches, expected sharp images of one static, textured scene, each overlapping several others "
                    "by more than half; take more of them"
                )
            seconds = progress.end(len(found[0].images) if found else 0)
        self.seconds["mapping"] = self.seconds.get("mapping", 0) + seconds
        return found

    def _claim(self):
        """Writes the settings; if they differ from an earlier call's, its database is deleted or refused."""
        file, text = self.work / "settings.json", json.dumps(self.settings, indent=2) + "\n"
        if self.database.exists() and (not file.exists() or read_bytes(file) != text.encode()):
            if not self.overwrite:
                raise ValueError(
                    f"{self.database}: was made of other images or with other settings, listed in {file.name} beside "
                    "it; add --overwrite to begin again, or choose another --out"
                )
            for path in self.work.glob(f"{self.database.name}*"):  # with SQLite's journals
                path.unlink()
        write_text(file, text)

    def _import(self, paths):
        groups = images_module.group_by_size(paths)
        if not self.settings["single_camera"]:
            groups = [[path.name] for path in paths]
        with partial_file(self.database) as partial:
            arguments = (partial, self.images, groups, self.settings["camera_model"])
            known = self._call(colmap_process.import_images, *arguments, progress=lambda _: None)
            unknown = [path.name for path in paths if path.name not in set(known)]
            if unknown:
                raise ValueError(
                    f"{self.images}: pycolmap cannot read {_listed(unknown)}, expected JPEG or PNG files; convert them"
                )
        sweep(self.work, "database.db.*.tmp*")

    def _call(self, stage, *arguments, progress):
        return colmap_process.call(stage, *arguments, log=self.log, progress=progress)


class _Progress(Stage):
    """A stage that counts images or pairs, and says its final count in a line that stays."""

    def __init__(self, say, step, what, total):
        super().__init__(f"structure from motion, {step}")
        self.say, self.step, self.what, self.total = say, step, what, total

    def __call__(self, count):
        if count is not None:
            self.update(min(count, self.total), self.total)  # COLMAP counts images again that another model has

    def end(self, count):
        """Says the final count; returns the stage's seconds."""
        seconds = time.monotonic() - self.started
        self.say(f"{self.step}: {count} of {self.total} {self.what}, {seconds:.0f} s")
        return seconds


def known_cameras(folder: str | os.PathLike, paths: Sequence[Path]) -> dict[str, tuple[str, list[float], np.ndarray]]:
    """Returns the cameras of a dataset for images of the same names, as `colmap_process.triangulate` takes them.

    Raises:
        ValueError: if the dataset has no camera for an image, or a lens that COLMAP's OPENCV models do not have.
    """
    data = DataOptions(format=AUTO, dir=os.fspath(folder), world="file", background="none")  # type: ignore[arg-type]
    capture, found = dataset.resolve(data)[2], {}
    frames = {} if capture is None else {frame.image.name: frame.camera for frame in capture.frames}
    for path in paths:
        name = path.name if path.name in frames else images_module.copy_name(path)
        if name not in frames:
            raise ValueError(
                f"{folder}: has no camera of {path.name}, expected one of each of the {len(paths)} images; remove "
                "the image, or estimate all cameras without --cameras_of"
            )
        camera = frames[name]
        lens = [] if camera.distortion is None else [*map(float, camera.distortion)]
        if camera.lens not in ("pinhole", "opencv") or len(lens) > 4:
            raise ValueError(
                f"{folder}: the camera of {path.name} has the lens {camera.lens} of {len(lens)} coefficients, expected "
                "pinhole, or opencv of at most 4; estimate all cameras without --cameras_of"
            )
        # The dataset may state cameras of images of another size.
        width, height = (int(side) for side in image_size(path))
        scale = [width / (camera.width or width), height / (camera.height or height)]
        parameters = [*np.multiply(camera.focal, scale).tolist(), *np.multiply(camera.center, scale).tolist(), *lens]
        parameters += [0.0] * (8 - len(parameters)) * bool(lens)
        to_world = np.asarray(camera.to_world, np.float64) * [1, -1, -1, 1]
        turn = to_world[:, :3].T
        pose = np.column_stack([turn, -turn @ to_world[:, 3]])
        found[images_module.copy_name(path)] = ("OPENCV" if lens else "PINHOLE", parameters, pose)
    return found


def _check_choice(name, value, choices):
    if value not in choices:
        raise ValueError(f"--{name} is {value!r}, expected one of {', '.join(choices)}; correct it")


def _check_out(out, overwrite):
    """Raises a ValueError if a dataset in the folder would hide the new one, or be replaced without being asked."""
    formats = [name for name in READERS.names() if READERS.get(name).detect(out)]
    if formats and READERS.get(formats[0]) is not colmap.READER:
        raise ValueError(
            f"{out}: holds a dataset of the format {formats[0]}, which would be read instead of the new cameras; "
            "choose another --out"
        )
    if (formats or (out / "sparse").exists()) and not overwrite:
        existing = (colmap.models_in(out) or [out / "sparse"])[0]
        raise ValueError(f"{existing}: exists; add --overwrite to replace {out / 'sparse'}, or choose another --out")


def _check_names(paths):
    wrong = [path.name for path in paths if path.name != images_module.copy_name(path)]
    if wrong:
        raise ValueError(
            f"{wrong[0]!r}: the name has characters that COLMAP's list of pairs cannot hold, expected "
            f"{images_module.copy_name(Path(wrong[0]))!r} of an image that is used where it is; rename it, or choose "
            "another --out, where copies are made"
        )


def _publish(model: Path, sparse: Path, work: Path) -> None:
    """Moves a complete model to sparse/0; what was in sparse before is deleted at the end."""
    new, old = work / "sparse.tmp", work / "replaced.tmp"
    for path in (new, old):
        remove(path)
    new.mkdir()
    os.replace(model, new / "0")
    if sparse.exists():
        os.replace(sparse, old)
    os.replace(new, sparse)
    remove(old)
    if not any(model.parent.iterdir()):
        model.parent.rmdir()


def _describe_cameras(cameras, model) -> tuple[str, ...]:
    """Returns a line for each of the first different cameras."""
    counts = {}
    for camera in cameras:
        numbers = [*camera.focal, *([] if camera.distortion is None else camera.distortion)]
        focal, distortion = (", ".join(f"{number:.4g}" for number in part) for part in (numbers[:2], numbers[2:]))
        line = f"{model}, {camera.width} x {camera.height} px, focal length {focal} px"
        line += f", distortion {distortion}" if distortion else ""
        counts[line] = counts.get(line, 0) + 1
    lines = [f"{line}; {count} image{'s' * (count != 1)}" for line, count in counts.items()]
    return (*lines[:3], *([f"{len(lines) - 3} more cameras"] if len(lines) > 3 else []))


def _listed(names: Sequence[str]) -> str:
    return ", ".join(names[:10]) + (f" and {len(names) - 10} more" if len(names) > 10 else "")
