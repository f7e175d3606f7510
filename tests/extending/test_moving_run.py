"""A run of the built-in field that moves, on the moving bodies: from the times of files to a video."""

import dataclasses

import imageio.v3 as iio
import moving_bodies
import numpy as np
import pytest
from test_needs import score

import jaxnerf
from jaxnerf.configs import moving
from jaxnerf.evaluation.paths.render_path import Frames, Output, render_path
from jaxnerf.tools.viewer.frame_renderer import FrameCamera, FrameRenderer

pytest_plugins = ["run_fixtures"]
pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("unoptimized")]
SIZES = {"resolutions": (8, 16), "width": 32, "view_width": 32, "table_size": 2**14, "view_depth": 1}


@pytest.fixture(scope="module")
def workdir(unoptimized, tmp_path_factory):
    folder = tmp_path_factory.mktemp("moving")
    moving_bodies.write_dataset(folder / "data", num_train=32, num_test=2, size=20)
    config = moving.get_config()
    config.data.dir, config.data.factor = str(folder / "data"), 1
    config.moving.update({**SIZES, "motion_width": 32})
    config.occupancy.resolution = 20
    config.train.update({"max_steps": 250, "lr_steps": 250, "preview_every": 0.0, "batch_size": 320})
    config.eval.summary_seconds = 0.0
    assert jaxnerf.train_and_evaluate(config, folder / "run")
    return folder / "run"


def test_other_views_at_other_times_are_learned(workdir):
    run = jaxnerf.restore_run(workdir)
    test = run.experiment.load_split("test")
    value = score(run, test)
    frozen = score(jaxnerf.restore_run(workdir, time=0.5), test)
    print(f"moving {value:.2f}, frozen {frozen:.2f}")
    assert value > 21 and value > frozen + 4
    same = score(run, dataclasses.replace(test, time=np.full(2, 0.5, np.float32)))
    assert frozen == pytest.approx(same, abs=1e-3)
    assert jaxnerf.restore_run(workdir, time=0.5).experiment.model.needs == ()


def test_videos_and_the_viewer_show_the_time_that_is_asked_for(workdir):
    run = jaxnerf.restore_run(workdir)

    def frames(time, **options):
        output = Output(name=f"at{time}", video="gif")
        folder, video = render_path(run, workdir, Frames(path="still", num_frames=3, time=time, **options), output)
        return np.int32([iio.imread(folder / "color" / f"000{index}.png") for index in range(3)]), video

    moving, video = frames((0.0, 1.0), seconds=1.5)
    resting, _ = frames((0.5, 0.5))
    assert (moving[1] == resting[0]).all() and (resting[0] == resting[2]).all()
    assert abs(moving[0] - moving[2]).max() > 50
    assert iio.immeta(video)["duration"] == 500
    views = run.experiment.load_split("train")
    renderer = FrameRenderer(run, views, chunk=256)
    state = renderer.scene_state(run.steps()[-1], run.variables(run.steps()[-1]))
    camera = FrameCamera(np.asarray(views.cameras.to_world[0]), moving_bodies.ANGLE, 20, 20)
    shown = [renderer.render(state, camera._replace(time=time)).rgb for time in (0.0, 0.5)]
    for image, expected in zip(shown, moving, strict=False):
        assert abs(np.rint(255 * image) - expected).max() <= 8
