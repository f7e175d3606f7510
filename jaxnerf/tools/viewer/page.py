"""What one browser shows: the rendering, and the controls beside it."""

import math
import threading
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np

from jaxnerf.data.geometry import path_poses
from jaxnerf.data.geometry.poses import axis_of, gaze_center, travel
from jaxnerf.data.geometry.world import direction_in_run
from jaxnerf.evaluation.paths.render_path import Frames, Output, render_path
from jaxnerf.evaluation.restore import newest_step, restore_run
from jaxnerf.tools.uncertainty.cleaning import MAX_UNCERTAINTY, cleaned
from jaxnerf.tools.viewer.frame_renderer import MAX_SIDE, MODES, UNCERTAINTY, FrameCamera, frame_image, view_image
from jaxnerf.tools.viewer.keyframes import MAX_KEYFRAMES, cameras_through, load_keyframes, save_path
from jaxnerf.tools.viewer.occupied_cells import surface_cells
from jaxnerf.tools.viewer.render_loop import Delivery, Request

RESOLUTIONS = ("100", "200", "400", "800", "1600")  # px of the longer side
_AXES = {"+x": (1, 0, 0), "+y": (0, 1, 0), "+z": (0, 0, 1), "-x": (-1, 0, 0), "-y": (0, -1, 0), "-z": (0, 0, -1)}
_MAX_FRUSTUMS, _THUMBNAIL, _BESIDE = 120, 64, 400  # views, px, px
_NARROW = 0.75  # width over height of a window, below which the controls are folded at first: a phone's
_AHEAD = 0.05  # of the scene's size, from a camera to the nearest point about which its view turns
_MAX_WAITING = 32  # uses of controls that wait for their turn; later ones are dropped
_PLAY_EVERY = 0.1  # s between times while time runs
_STATUS_EVERY = 0.25  # s between changes of the status while the camera moves
_TO_OPENCV = np.diag([1.0, -1.0, -1.0])  # viser's cameras look along +z with y down


class Page:
    """One browser, with a camera and settings of its own. Nothing that it sends is trusted."""

    def __init__(self, viewer: Any, client: Any):
        """Prepares the page; `open` fills it.

        Args:
            viewer: the Viewer.
            client: viser's ClientHandle.
        """
        self._viewer, self._client = viewer, client
        self._poses = np.asarray(viewer.views.cameras.to_world, np.float64)
        self._target = gaze_center(self._poses)
        distance = np.median(np.linalg.norm(self._poses[:, :, 3] - self._target, axis=1))
        self._size = float(distance) if 0 < distance < np.inf else 1.0  # of the scene, world units
        self._keyframes, self._frustums, self._cells = [], None, None
        self._closed, self._playing = threading.Event(), threading.Event()
        self._delivery, self._reported, self._kind = None, 0.0, None
        self._lock = threading.RLock()  # of what callbacks change
        self._worker, self._room = ThreadPoolExecutor(1), threading.Semaphore(_MAX_WAITING)
        self._status = client.gui.add_markdown("waiting for the first image")  # other threads may report at once

    # The page as a whole

    def open(self) -> None:
        """Adds the controls, sets the first view and requests the first frame."""
        gui, wide = self._client.gui, self._width_over_height(1.0) >= _NARROW
        with gui.add_folder("Rendering", expand_by_default=wide):
            self._mode = self._add(gui.add_dropdown("Show", self._modes()), self._change_mode)
            self._resolution = self._add(gui.add_dropdown("Resolution (px)", RESOLUTIONS, initial_value="800"))
            moves = "time" in self._viewer.run.experiment.model.needs
            self._time = self._add(gui.add_slider("Time", 0.0, 1.0, 0.005, 0.0, visible=moves))
            self._play = self._add(gui.add_checkbox("Play", False, visible=moves), self._run_time)
            self._crop = self._add(gui.add_checkbox("Crop", False))
            if not self._viewer.client_rendering.refused:
                gui.add_markdown("[Render in this browser](/?here)")
            lower, upper = self._crop_range()
            self._sliders = [
                self._add(gui.add_multi_slider(axis, low, high, (high - low) / 200, (low, high)))
                for axis, low, high in zip("xyz", lower, upper, strict=True)
            ]
        with gui.add_folder("Scene", expand_by_default=wide):
            self._show_grid = self._add(gui.add_checkbox("Occupancy grid", False), self._draw_cells)
            self._show_cameras = self._add(gui.add_checkbox("Training cameras", False), self._draw_frustums)
            self._up = self._add(gui.add_dropdown("Up", ("dataset", *_AXES)), self._set_up)
            self._add(gui.add_button("Reset view"), self._reset)
            self._beside = gui.add_image(np.full((8, 8, 3), 255, np.uint8), label="Training image", visible=False)
        with gui.add_folder("Camera path", expand_by_default=False):
            self._add(gui.add_button("Add keyframe"), self._add_keyframe)
            self._add(gui.add_button("Remove last keyframe"), self._remove_keyframe)
            self._path_seconds = gui.add_number("Seconds", 4.0, min=0.1, max=600.0, step=0.1)
            self._path_fps = gui.add_number("Frames per second", 24, min=1, max=120, step=1)
            self._path_height = gui.add_number("Height (px)", 400, min=16, max=2160, step=2)
            self._path_closed = gui.add_checkbox("Return to the first keyframe", False)
            self._add(gui.add_button("Preview"), self._preview)
            self._path_name = gui.add_text("Name", "path")
            self._overwrite = gui.add_checkbox("Replace earlier frames of this name", False)
            self._add(gui.add_button("Save"), self._save)
            self._add(gui.add_button("Open as keyframes"), self._open)
            self._add(gui.add_button("Save and render video"), self._render_video)
            self._progress = gui.add_progress_bar(0.0, visible=False)
            self._path_status = gui.add_markdown("no keyframes")
        self._guarded(self._reset)()

        async def moved(_):  # asynchronous callbacks run in the order of the messages
            self._request()

        self._client.camera.on_update(moved)
        self._request()
        if self._viewer.state is None:
            self.report("waiting for the scene")

    def close(self) -> None:
        """Ends what runs for the page."""
        self._closed.set()
        self._playing.set()
        self._worker.shutdown(wait=False, cancel_futures=True)

    def show(self, delivery: Delivery) -> None:
        """Shows a frame; called by the thread that renders."""
        self._delivery = delivery
        self._redraw()
        camera, now = delivery.frame.camera, time.monotonic()
        if delivery.final:
            kind = pace = "full quality"
        elif delivery.frames_per_second is None:
            kind = pace = "refining"
        else:
            kind, pace = "in motion", f"{delivery.frames_per_second:.0f} frames/s"
        if kind != "in motion" or kind != self._kind or now - self._reported > _STATUS_EVERY:
            self._kind = kind
            score = f" · {self._viewer.score}" if self._viewer.score else ""
            self.report(f"**step {delivery.step:,}**{score}\n\n{pace} · {camera.width} × {camera.height} px")

    def report(self, text: str) -> None:
        """Shows a text above the controls."""
        self._reported = time.monotonic()
        self._status.content = text

    def scene_changed(self) -> None:
        """Draws again what depends on the parameters."""
        if self._cells is not None:
            self._guarded(self._draw_cells)()

    # Input

    def _add(self, handle, call=None):
        """Makes a control call a function when it is used, by default to request a frame; returns the control."""
        self._when(handle.on_click if hasattr(handle, "on_click") else handle.on_update, call or self._request)
        return handle

    def _when(self, on_event, call):
        """Calls a function at an event of the browser, in the page's own thread."""
        guarded = self._guarded(call)

        def run():
            self._room.release()
            if not self._closed.is_set():
                guarded()

        async def used(_):  # in the order of the messages, which viser's threads would not keep
            if not self._closed.is_set() and self._room.acquire(blocking=False):
                self._worker.submit(run)

        on_event(used)

    def _guarded(self, call: Callable[[], Any]) -> Callable[[], None]:
        """Returns a function that shows an error on the page."""

        def guarded():
            try:
                with self._lock:
                    call()
            except Exception as error:
                self._notify("Not done", error)

        return guarded

    def _notify(self, title, body):
        self._client.add_notification(title, " ".join(str(body).split())[:500], auto_close_seconds=15)

    def _camera(self) -> FrameCamera | None:
        """Returns the browser's camera in the size that is to be rendered; None if what it sent is no camera."""
        sent, longest = self._client.camera, _number(self._resolution.value, "the resolution", 1, MAX_SIDE)
        try:
            width, height = float(sent.image_width), float(sent.image_height)
            numbers = np.array([*sent.wxyz, *sent.position, sent.fov, width, height], np.float64)
        except (TypeError, ValueError):
            return None
        length = np.linalg.norm(numbers[:4])
        sizes_fit = 1 <= min(width, height) and max(width, height) <= 16 * MAX_SIDE
        if numbers.shape != (10,) or not (np.abs(numbers) < 1e9).all() or not (0.01 < numbers[7] < 3.1 and sizes_fit):
            return None
        if length < 1e-6:
            return None
        rotation = _rotation(numbers[:4] / length) @ _TO_OPENCV
        scale = min(longest / max(width, height), 1.0)
        sides = (max(round(side * scale), 1) for side in (width, height))
        time = _number(self._time.value, "the time", 0, 1)
        return FrameCamera(np.column_stack([rotation, numbers[4:7]]), float(numbers[7]), *sides, time)

    def _request(self):
        """Requests the frame of the camera and the settings, unless what the browser sent makes no sense."""
        try:
            camera, crop = self._camera(), self._crop_box()
        except (TypeError, ValueError):
            return
        if camera is not None and not self._closed.is_set():
            uncertain = self._mode.value == UNCERTAINTY
            self._viewer.loop.submit(self._client.client_id, Request(camera, crop, uncertain))

    def _run_time(self):
        """Lets the time run, as often as the seconds of the path say, until the control is off."""

        def play():
            while self._play.value is True and not self._closed.wait(_PLAY_EVERY):
                passed = _PLAY_EVERY / _number(self._path_seconds.value, "the duration", 0.01, 1e5)
                self._time.value = (_number(self._time.value, "the time", 0, 1) + passed) % 1.0
                self._request()

        threading.Thread(target=self._guarded_without_lock(play), daemon=True).start()

    def _crop_box(self):
        if self._crop.value is not True:
            return None
        ends = [[_number(end, "a crop", -1e9, 1e9) for end in slider.value] for slider in self._sliders]
        if any(len(pair) != 2 for pair in ends):
            raise ValueError("a crop has not two ends")
        return np.float32(ends).T

    def _modes(self):
        """Returns what the page can show: uncertainty where the run has the estimate."""
        state = self._viewer.state
        return MODES if state is not None and state.uncertainty_at is not None else MODES[: MODES.index(UNCERTAINTY)]

    def _change_mode(self):
        """Shows the last frame in the new mode, or requests another where it does not hold what the mode shows."""
        delivery, mode = self._delivery, self._mode.value
        shown = None if delivery is None else UNCERTAINTY if delivery.frame.uncertain else "colour"
        if mode in ("colour", UNCERTAINTY) and mode != shown:
            self._request()
        else:
            self._redraw()

    def _redraw(self):
        """Sends the last frame as the selected picture."""
        delivery, mode = self._delivery, self._mode.value
        if delivery is None or self._closed.is_set():
            return
        image = frame_image(delivery.frame, mode if mode in MODES else MODES[0])
        quality = 95 if delivery.final else 80
        self._client.scene.set_background_image(image, format="jpeg", jpeg_quality=quality)
        self._client.flush()

    # The scene

    def _crop_range(self):
        """Returns the corners [3] between which the crop box lies."""
        schedule, box = self._viewer.run.experiment.model.grid_schedule, None
        if self._viewer.state is not None:
            box = self._viewer.state.box
        elif schedule is not None and not schedule.contracted:  # a training has made no state yet
            box = np.array([schedule.lower, schedule.upper])
        if box is None or not np.isfinite(box).all() or self._viewer.run.experiment.config.data.ndc:
            reach = 2 * self._size
            middle = self._target
            if self._viewer.run.experiment.config.data.ndc:
                middle = self._look_at(self._poses[0])
            box = np.stack([middle - reach, middle + reach])
        step = 10.0 ** math.floor(math.log10(np.ptp(box, axis=0).max() / 100))  # round numbers, outwards
        ends = np.floor(box[0] / step) * step, np.ceil(box[1] / step) * step
        return [[float(f"{value:.6g}") for value in end] for end in ends]

    def _look_at(self, pose):
        """Returns the point about which a view turns, nearest to what all look at; just ahead where cameras travel."""
        along = _AHEAD * self._size if travel(self._poses) else float((pose[:, 3] - self._target) @ pose[:, 2])
        return pose[:, 3] - pose[:, 2] * (along if along >= _AHEAD * self._size else self._size)

    def _go_to(self, pose, fov, up):
        camera = self._client.camera
        with self._client.atomic():
            camera.up_direction = up
            camera.position = pose[:, 3]
            camera.look_at = self._look_at(pose)
            camera.fov = fov

    def _view_fov(self, index, aspect=math.inf):
        """Returns the vertical angle of a training view, or that which shows all its width at an aspect ratio."""
        focal = np.asarray(self._viewer.views.cameras.focal, np.float64)[index]
        height, width = np.float64(self._viewer.views.size[index]) / focal[::-1]  # at distance 1
        return 2 * math.atan(0.5 * max(height, width / aspect))

    def _show_view(self, index, up):
        """Goes to a training view; the page shows all its height and all its width."""
        self._go_to(self._poses[index], self._view_fov(index, self._width_over_height(math.inf)), up)

    def _width_over_height(self, unknown):
        """Returns the aspect ratio of the page's window, at least a tenth, or a value where the page sent none."""
        sent = self._client.camera
        try:
            ratio = float(sent.image_width) / float(sent.image_height)
        except (TypeError, ValueError, ZeroDivisionError):
            return unknown
        return max(ratio, 0.1) if ratio < np.inf else unknown

    def _dataset_up(self):
        views, up = self._viewer.views, self._viewer.run.experiment.config.data.up
        return path_poses.up_of(self._poses) if not up else direction_in_run(axis_of(up), views.to_file)

    def _reset(self):
        """Goes to the first training view, with the dataset's up."""
        self._up.value = "dataset"
        self._beside.visible = False
        self._client.camera.near, self._client.camera.far = 1e-3 * self._size, 1e3 * self._size
        self._show_view(0, self._dataset_up())

    def _set_up(self):
        up = _AXES.get(self._up.value)
        self._client.camera.up_direction = self._dataset_up() if up is None else np.float64(up)

    def _draw_cells(self):
        """Draws the occupied cells that have an empty neighbour, or removes them."""
        if self._cells is not None:
            self._cells.remove()
            self._cells = None
        state = self._viewer.state
        if self._show_grid.value is not True or state is None or state.grid is None:
            return
        in_ndc = self._viewer.run.experiment.config.data.ndc
        points, cell = surface_cells(state.grid, self._viewer.views if in_ndc else None)
        if len(points):
            self._cells = self._client.scene.add_point_cloud(
                "/cells", np.float32(points), (90, 140, 220), point_size=cell / 3, precision="float32"
            )

    def _draw_frustums(self):
        """Shows the training cameras, or hides them."""
        if self._frustums is None:
            if self._show_cameras.value is not True:
                return
            count = len(self._poses)
            chosen = np.unique(np.linspace(0, count - 1, min(count, _MAX_FRUSTUMS)).astype(int))
            self._frustums = [self._frustum(int(index)) for index in chosen]
        for frustum in self._frustums:
            frustum.visible = self._show_cameras.value is True

    def _frustum(self, index):
        views, pose = self._viewer.views, self._poses[index]
        height, width = (int(side) for side in views.size[index])
        frustum = self._client.scene.add_camera_frustum(
            f"/cameras/{index}",
            fov=self._view_fov(index),
            aspect=width / height,
            scale=0.05 * self._size,
            thickness=0.001 * self._size,
            image=view_image(views, index, _THUMBNAIL),
            wxyz=_quaternion(pose[:, :3] @ _TO_OPENCV),
            position=pose[:, 3],
        )

        def visit():
            self._show_view(index, pose[:, 1])
            self._beside.image = view_image(views, index, _BESIDE)
            self._beside.label = views.names[index] if views.names else f"view {index}"
            self._beside.visible = True

        self._when(frustum.on_click, visit)
        return frustum

    # The camera path

    def _add_keyframe(self):
        camera = self._camera()
        if len(self._keyframes) >= MAX_KEYFRAMES:
            raise ValueError(f"a path has at most {MAX_KEYFRAMES} keyframes; remove some")
        if camera is not None:
            self._keyframes.append(camera)
            self._report_keyframes()

    def _remove_keyframe(self):
        self._keyframes = self._keyframes[:-1]
        self._report_keyframes()

    def _report_keyframes(self):
        count = len(self._keyframes)
        self._path_status.content = f"{count} keyframe{'s' * (count != 1)}"
        if self._keyframes:
            poses = [camera.to_world for camera in self._keyframes]
            points = np.float32([pose[:, 3] for pose in poses])
            scale = 0.02 * self._size
            self._client.scene.add_point_cloud("/keyframes", points, (230, 120, 30), point_size=scale)
        else:
            self._client.scene.remove_by_name("/keyframes")

    def _path(self):
        """Returns the frames of the path and their number per second."""
        fps = _number(self._path_fps.value, "the number of frames per second", 0.1, 240)
        height = round(_number(self._path_height.value, "the height", 1, MAX_SIDE))
        seconds = _number(self._path_seconds.value, "the duration", 0.01, 1e5)
        frames = cameras_through(self._keyframes, seconds=seconds, fps=fps, closed=self._path_closed.value is True)
        width = round(height * frames[0].width / frames[0].height)
        return [camera.resized(width, height) for camera in frames], fps

    def _preview(self):
        """Moves the browser's camera along the path; another call stops it."""
        self._playing.set()
        frames, fps = self._path()
        ended = self._playing = threading.Event()

        def play():
            started = time.perf_counter()
            while not (ended.is_set() or self._closed.is_set()):
                index = int((time.perf_counter() - started) * fps)
                if index >= len(frames):
                    return
                pose = frames[index].to_world
                self._go_to(pose, frames[index].fov, pose[:, 1])
                ended.wait(max(1 / fps, 0.05))

        threading.Thread(target=self._guarded_without_lock(play), daemon=True).start()

    def _save(self):
        frames, fps = self._path()
        views = self._viewer.views
        path = save_path(self._viewer.workdir, self._path_name.value, frames, fps=fps, views=views)
        self._path_status.content = f"{len(frames)} frames saved to {path}"
        return path, len(frames)

    def _open(self):
        """Replaces the keyframes by the frames of a path in the workdir, and shows the first."""
        self._keyframes = load_keyframes(self._viewer.workdir, self._path_name.value, self._viewer.views)
        self._report_keyframes()
        first = self._keyframes[0]
        self._go_to(first.to_world, first.fov, first.to_world[:, 1])

    def _render_video(self):
        """Saves the path and renders its video with the newest checkpoint, in a thread."""
        if not self._viewer.rendering_video.acquire(blocking=False):
            raise ValueError("a video is being rendered; wait until it is finished")
        try:
            path, count = self._save()
            step = newest_step(self._viewer.run, self._viewer.workdir)
            overwrite = self._overwrite.value is True
        except BaseException:
            self._viewer.rendering_video.release()
            raise
        done = threading.Event()
        folder = self._viewer.workdir / "renders" / f"{path.stem}-{step}" / "color"

        def render():
            try:
                workdir, limit = self._viewer.workdir, self._viewer.run.settings.get(MAX_UNCERTAINTY)
                run = cleaned(restore_run(workdir, data_dir=self._viewer.data_dir), workdir, limit)
                written = render_path(run, workdir, Frames(path=str(path)), Output(overwrite=overwrite), step=step)
                self._path_status.content = f"video: {written[-1]}"
            finally:
                done.set()
                self._viewer.rendering_video.release()

        def follow():
            self._progress.visible = True
            while not (done.wait(0.5) or self._closed.is_set()):
                finished = sum(1 for _ in folder.glob("*.png"))
                self._progress.value = min(100.0 * finished / count, 100.0)
                self._path_status.content = f"frame {finished} of {count}"
            self._progress.visible = False

        for work in (follow, render):
            threading.Thread(target=self._guarded_without_lock(work), daemon=True).start()

    def _guarded_without_lock(self, call):
        """Returns a function for a thread of its own that shows an error on the page."""

        def guarded():
            try:
                call()
            except Exception as error:
                self._path_status.content = "stopped"
                self._notify("Not done", error)

        return guarded


def _number(value, name, least, most):
    """Returns what a browser sent as a number after checking that it is one in the range."""
    try:
        number = float(value)
    except (TypeError, ValueError, OverflowError):
        number = math.nan
    if not least <= number <= most:
        raise ValueError(f"{name} is {str(value)[:40]!r}, expected a number from {least:g} to {most:g}")
    return number


def _rotation(wxyz):
    """Returns the rotation matrix of a unit quaternion."""
    from viser.transforms import SO3

    return np.asarray(SO3(wxyz).as_matrix(), np.float64)


def _quaternion(rotation):
    """Returns the unit quaternion, w first, of a rotation matrix."""
    from viser.transforms import SO3

    return SO3.from_matrix(np.asarray(rotation, np.float64)).wxyz
