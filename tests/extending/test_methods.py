"""Examples of methods that need more than a field, samples and a loss: each is one file, and trains above a PSNR."""

import coarse_to_fine
import jax
import numpy as np
import proposal_sampler  # noqa: F401
import pytest

import jaxnerf
from jaxnerf.evaluation.restore import restore_run
from jaxnerf.training.metric_log import read_rows
from runs import evaluate, smoke_config

pytest_plugins = ["run_fixtures"]


def trained(folder, steps, **fields):
    """Trains configs/smoke.py with some fields changed; returns its rows of metrics and the PSNR of test views."""
    rates = {"lr_init": 1e-2, "lr_final": 1e-3, "lr_steps": steps, "batch_size": 256}
    config = smoke_config(max_steps=steps, log_every=50, save_every=steps // 2, **rates)
    config.update_from_flattened_dict({"sampling.num_fine": 0, "sampling.num_coarse": 24, **fields})
    assert jaxnerf.train_and_evaluate(config, folder)
    return read_rows(folder), evaluate(folder)["psnr"]


@pytest.mark.extra
def test_a_proposal_network_with_a_loss_of_its_own(compiled_once, tmp_path):
    network = {
        "depth": 3,
        "width": 48,
        "view_width": 24,
        "skip_layer": 1,
        "num_freqs": 6,
        "density_activation": "softplus",
    }
    changes = {f"fine.{name}": value for name, value in network.items()}
    rows, psnr = trained(tmp_path / "run", 300, **changes, sampler="proposal", **{"losses.proposal": 1.0})
    assert psnr > 19.5  # 20.7 dB
    assert rows[-1]["loss_proposal"] < 0.2 * rows[0]["loss_proposal"]
    # The proposal network renders no image, so it has no PSNR and no error by which it could be dead.
    assert {name for name in rows[-1] if name.startswith(("psnr_", "dead_"))} == {"psnr_fine", "dead_fine"}
    params, _ = restore_run(tmp_path / "run").variables(300)
    assert set(params) == {"proposal", "fine"}


@pytest.mark.slow
def test_a_curriculum_follows_the_progress_of_training(compiled_once, tmp_path):
    rows, psnr = trained(tmp_path / "run", 300, field="coarse_to_fine", **{"train.lr_init": 5e-3})
    assert psnr > 17  # 19.0 dB
    run = restore_run(tmp_path / "run")
    x = np.random.default_rng(0).uniform(-1, 1, (1, 64, 3)).astype(np.float32)
    scenes = [run.experiment.model.scene(*run.variables(step)) for step in (150, 300)]
    for (step, expected), scene in zip(((150, 0.5), (300, 1.0)), scenes, strict=True):
        variables = run.variables(step)
        assert float(variables[0]["progress"]) == expected  # a checkpoint has its own
        density, _ = jax.jit(scene)(x, x[:, :1])
        assert np.isfinite(density).all()


def test_octaves_are_added_one_after_another():
    weights = coarse_to_fine.octave_weights(0.25, 7, 0.5)
    assert weights[0] == 1 and 0 < weights[3] <= 1 and weights[-1] == 0
