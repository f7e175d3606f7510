"""The study of scaling: bytes that a compiled step sums, and the model on paper."""

import jax.numpy as jnp
import optax
import pytest

from helpers import random_rays
from jaxnerf.runtime import devices
from jaxnerf.training.state import create_state
from jaxnerf.training.step import make_train_step
from studies import study
from toys import LOSSES, toy_draw, toy_model

scaling = study("scaling/scaling")
SLOW = scaling.Machine("slow", 100.0, 0.5, 4, 8.0, 2.0, 0.0, "nobody")


def test_the_compiled_step_sums_the_gradient_and_four_numbers():
    model = toy_model()
    data = random_rays(0, (16,)), jnp.array([-1])
    step = make_train_step(model, optax.sgd(0.1), toy_draw, LOSSES)
    state = create_state(model, optax.sgd(0.1), 0)
    run, _, _ = devices.compile_step(step, state, data, batch_size=16)
    size, count = scaling.collective_bytes(run.compiled.as_text())
    assert size == scaling.gradient_bytes(2 * 9) and count >= 1


def test_bytes_of_a_compiled_program():
    text = """
  %all-reduce = (f32[16,8]{1,0}, s32[], f64[3]) all-reduce(%a, %b, %c), channel_id=1
  %add = f32[7]{0} add(%x, %y)
  ROOT %start = bf16[5]{0} all-reduce-start(%z), to_apply=%sum
  %done = bf16[5]{0} all-reduce-done(%start)
"""
    assert scaling.collective_bytes(text) == (4 * 128 + 4 + 24 + 10, 2)


def test_the_model_on_paper():
    assert scaling.step_flops((10, 20), (3, 4), 5) == 6 * 5 * (30 + 80)
    assert scaling.all_reduce_seconds(SLOW, 1, 100) == 0
    assert scaling.all_reduce_seconds(SLOW, 4, 100) == pytest.approx(2 * 3 / 4 * 100 / 8)
    between = 2 * 1 / 2 * (100 / 4) / 2
    assert scaling.all_reduce_seconds(SLOW, 8, 100) == pytest.approx(18.75 + between)
    compute, summing, efficiency = scaling.predict(SLOW, 8, flops=400.0, size=100)
    assert (compute, efficiency) == pytest.approx((1.0, 1 / (1 + summing)))
    assert scaling.predict(SLOW, 8, flops=400.0, size=100, grow=True)[0] == 8.0
    late = SLOW._replace(latency=0.5)
    assert scaling.all_reduce_seconds(late, 8, 0) == pytest.approx(0.5 * (2 * 3 + 2 * 1))


def test_the_tables_state_their_conditions():
    row = {"processes": 1, "devices": 1, "rays": 8, "parameters": 10, "rays_per_second": 5.0}
    row |= {"device_bytes": 2e6, "collective_bytes": 0, "collectives": 0, "compile_seconds": 1.0}
    other = {**row, "devices": 2, "rays_per_second": 4.0, "collective_bytes": 56, "collectives": 1}
    lines = scaling.measured_table({"config": "c", "cores": 2, "rows": [row, other]})
    assert lines[-1] == "| 1 x 2 | 4 | 0.80 | 2.0 | 56 in 1 | 56 | 1.0 |"
    paper = scaling.paper_table((1, 64))
    assert "not measured" in paper[0] and len(paper) == 2 + 2 + 2 * len(scaling.MACHINES)
    assert all("| 1 |" not in line or "| 100% | 100% |" in line for line in paper[4:])
