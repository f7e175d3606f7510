"""Where the scene of the viewer comes from: checkpoints in a workdir, or a training in this process."""

import contextlib
import os
import pathlib
import sys
import threading
import time

import jax
import numpy as np

from jaxnerf.core.views import Views
from jaxnerf.evaluation.restore import newest_step, refined_views, restore_with_grid
from jaxnerf.runtime import atomic_files
from jaxnerf.tools.uncertainty.cleaning import cleaned
from jaxnerf.tools.uncertainty.laplace import stored_uncertainty
from jaxnerf.tools.viewer.server import HOST, PORT, Viewer, check_port, import_viser
from jaxnerf.training import metric_log
from jaxnerf.training.config import identity
from jaxnerf.training.optimizer import image_params
from jaxnerf.training.state import TrainState
from jaxnerf.training.workdir import load_config

_POLL_SECONDS = 1.0  # between searches for a new checkpoint
_REFRESH_SECONDS = 2.0  # between copies of the parameters of a training, at least
_REFRESH_FACTOR = 5.0  # the same over the time that it takes to prepare them
_FRACTION = 0.4  # of the time in which a training's viewer renders, while a browser is connected


def view_run(
    workdir: str | os.PathLike,
    *,
    data_dir: str | None = None,
    step: int | None = None,
    max_uncertainty: float | str | None = None,
    host: str = HOST,
    port: int = PORT,
    ended: threading.Event | None = None,
) -> None:
    """Serves the checkpoints of a run until the process is stopped; new ones replace those that are shown.

    Args:
        workdir: the folder that training wrote or writes.
        data_dir: see `restore_run`.
        step: of the only checkpoint to show; None: always the newest.
        max_uncertainty: of the cells of the grid, see `cleaned`.
        host, port: see `Viewer.listen`.
        ended: set by another thread to stop.

    Raises:
        ValueError: if there is no such run or checkpoint, the port is taken, or viser is not installed.
    """
    import_viser()
    check_port(host, port)
    trained = identity(load_config(workdir))
    run = cleaned(restore_with_grid(workdir, data_dir=data_dir), workdir, max_uncertainty)
    first = newest_step(run, workdir, step)
    variables = run.variables(first)
    views = refined_views(run, run.experiment.load_split("train", images=None), "train", variables[0])
    viewer = Viewer(workdir, run, views, data_dir=data_dir)

    def show(step, variables):
        uncertainty_at = stored_uncertainty(run, workdir, step, variables[0])
        viewer.show(step, variables, score_of(workdir, step), uncertainty_at=uncertainty_at)

    def show_newest(steps):
        if identity(load_config(workdir)) != trained:
            raise ValueError(f"{workdir}: holds another run than that which is shown; start again to show it")
        show(steps[-1], run.variables(steps[-1]))

    try:
        show(first, variables)  # compiles before anyone can connect
        port = viewer.listen(host, port)
        print(f"viewer        {address(host, port)} shows {workdir}, step {first}; Ctrl-C ends it", file=sys.stderr)
        _follow(run, viewer, show_newest if step is None else None, threading.Event() if ended is None else ended)
    finally:
        viewer.close()


def _follow(run, viewer, show_newest, ended):
    """Shows each new checkpoint until an event; what cannot be shown is reported in a line, and the last one stays."""
    failed, reported = None, ""
    while not ended.wait(_POLL_SECONDS):
        if show_newest is None or not viewer.num_browsers:
            continue
        steps = []
        try:
            steps = run.steps()
            if not steps:
                raise ValueError(f"{viewer.workdir}: has no checkpoint any more; step {viewer.state.step} stays")
            if steps[-1] not in (viewer.state.step, failed):
                show_newest(steps)
                reported = ""
        except Exception as error:  # the run may have been removed, replaced or damaged in any way
            with contextlib.suppress(OSError):
                if steps and steps[-1] not in run.steps():  # training has deleted it as too old
                    continue
            failed = steps[-1] if steps else None
            kind = "" if isinstance(error, ValueError | OSError) else f"{type(error).__name__}: "
            line = kind + " ".join(str(error).split())[:500]
            if line != reported:
                print(f"viewer: {line}", file=sys.stderr)
            reported = line


class LiveViewer:
    """Serves the scene of a training in this process.

    Without a browser it costs a test of one flag per step. With one, the parameters are copied every few seconds, and
    a thread renders for at most a fixed fraction of the time.
    """

    def __init__(self, workdir: str | os.PathLike, *, host: str = HOST, port: int = PORT):
        """Checks that it will be able to listen; the port is opened at the first step.

        Args:
            workdir: of the run.
            host, port: see `Viewer.listen`.

        Raises:
            ValueError: if the port is taken, or viser is not installed.
        """
        import_viser()
        check_port(host, port)
        self._workdir, self._host, self._port = pathlib.Path(workdir), host, port
        self.port = None  # once it is open
        self._wanted, self._copied = False, None
        self._changed, self._closed = threading.Condition(), False
        self._views, self._thread = None, None

    def observe(self, state: TrainState, views: Views) -> None:
        """Copies the parameters if the viewer wants them; see `loop.train`."""
        if self._thread is None:
            self._views = views
            self._thread = threading.Thread(target=self._run, name="viewer scene", daemon=True)
            self._thread.start()
        if self._wanted:
            self._wanted = False
            copied = jax.tree.map(np.array, (image_params(state), state.grid))
            with self._changed:
                self._copied = int(state.step), *copied
                self._changed.notify_all()

    def close(self) -> None:
        """Disconnects all browsers and ends the threads."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()
        if self._thread is not None:
            self._thread.join()

    def _run(self):
        try:
            run = restore_with_grid(self._workdir)
            viewer = Viewer(self._workdir, run, self._views, fraction=_FRACTION, changed=self._wake)
            try:
                self.port = viewer.listen(self._host, self._port)
                where = address(self._host, self.port)
                print(f"viewer        {where} shows the training", file=sys.stderr, flush=True)
                self._serve(run, viewer)
            finally:
                viewer.close()
        except Exception as error:  # training does not depend on its viewer
            print(f"viewer        none: {type(error).__name__}: {' '.join(str(error).split())}", file=sys.stderr)

    def _serve(self, run, viewer):
        pause = 0.0
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._closed, pause)
                self._changed.wait_for(lambda: self._closed or viewer.num_browsers)
                self._wanted = not self._closed
                self._changed.wait_for(lambda: self._closed or self._copied)
                if self._closed:
                    return
                (step, params, grid), self._copied = self._copied, None
            started = time.perf_counter()
            copied = jax.device_put((params, grid), jax.local_devices()[0])
            variables = jax.block_until_ready(run.variables_of(*copied))
            pause = max(_REFRESH_SECONDS, _REFRESH_FACTOR * (time.perf_counter() - started))
            viewer.show(step, variables, self._score())

    def _score(self):
        rows = metric_log.read_rows(self._workdir)
        return f"{rows[-1]['psnr_fine']:.2f} dB in training" if rows else ""

    def _wake(self):
        with self._changed:
            self._changed.notify_all()


def score_of(workdir: str | os.PathLike, step: int) -> str:
    """Returns the evaluation of a checkpoint as text, or else its training loss; "" without either."""
    workdir = pathlib.Path(workdir)
    with contextlib.suppress(OSError, ValueError, KeyError, TypeError, OverflowError):
        found = atomic_files.read_json(workdir / "eval" / str(step) / "results.json", "score it again")
        return f"PSNR {float(found['psnr']):.2f} dB over {int(found['views'])} views"
    with contextlib.suppress(OSError, ValueError, KeyError, TypeError):
        rows = [row for row in metric_log.read_rows(workdir) if row["step"] <= step and "psnr_fine" in row]
        return f"{rows[-1]['psnr_fine']:.2f} dB in training" if rows else ""
    return ""


def address(host: str, port: int) -> str:
    """Returns the address to open in a browser."""
    return f"http://{f'[{host}]' if ':' in host else host}:{port}"
