"""Tests jaxnerf-convert: converted networks have the same outputs; other files give an error of one line."""

import functools
import importlib.util
import json
import os
import pathlib
import pickle
import sys
import tracemalloc

import jax.numpy as jnp
import numpy as np
import pytest
from flax.serialization import msgpack_serialize
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import published
from jaxnerf import load_scene
from jaxnerf.configs import blender_paper, llff_paper
from jaxnerf.evaluation.evaluate import train_and_evaluate
from jaxnerf.evaluation.restore import restore_run
from jaxnerf.fields.mlp import mlp_field
from jaxnerf.tools.interop.convert import convert
from jaxnerf.tools.interop.published_weights import read_weights
from jaxnerf.training import build
from jaxnerf.training.checkpoint import Checkpoints
from jaxnerf.training.state import create_state
from published import as_flax, as_state_dict, random_layers
from runs import evaluate, run_forked, smoke_config

pytest_plugins = ["run_fixtures"]
pytestmark = pytest.mark.usefixtures("unoptimized")

SMALL = {"depth": 2, "width": 16, "skip": 0, "view_width": 8, "freqs": (4, 2)}  # configs/smoke.py


def paper_config(**fields):
    config = blender_paper.get_config()
    config.data.dir = "not here"
    for name in ("coarse", "fine"):
        config[name].update(fields)
    return config


def inputs(seed):
    """Returns 60 positions and directions in float32."""
    rng = np.random.default_rng(seed)
    viewdirs = rng.normal(size=(60, 1, 3))
    viewdirs /= np.linalg.norm(viewdirs, axis=-1, keepdims=True)
    return rng.uniform(-4, 4, (60, 1, 3)).astype(np.float32), viewdirs.astype(np.float32)


def write(kind, path, networks, step=1234):
    """Writes lists of layers in Keras' order as the files of a code; returns their paths and the forward passes."""
    path.mkdir(exist_ok=True)
    if kind == "original":
        names = [path / f"model_{step:06d}.npy", path / f"model_fine_{step:06d}.npy"][: len(networks)]
        for name, layers in zip(names, networks, strict=True):
            published.write_npy(name, [array for layer in layers for array in layer])
        return names, [functools.partial(published.original, layers) for layers in networks]
    if kind == "nerf-pytorch":
        states = [as_state_dict(layers) for layers in networks]
        write_tar(path / f"{step:06d}.tar", states, step)
        return [path / f"{step:06d}.tar"], [functools.partial(published.nerf_pytorch, x) for x in states]
    trees = [as_flax(layers) for layers in networks]
    name = path / f"checkpoint_{step}"
    name.write_bytes(msgpack_serialize(published.flax_content(trees, step)))
    encode = published.octaves if kind == "JaxNeRF, legacy" else published.sines_then_cosines
    return [name], [functools.partial(published.jaxnerf_2020, tree, encode=encode) for tree in trees]


def write_tar(path, states, step):
    """Writes a checkpoint of nerf-pytorch; without a fine network its entry is None."""
    torch = pytest.importorskip("torch", reason="torch is not installed")
    dicts = [{key: torch.from_numpy(np.array(value)) for key, value in state.items()} for state in states]
    optimizer = {"state": {0: {"step": 1, "exp_avg": torch.zeros(2)}}, "param_groups": [{"lr": 5e-4}]}
    fn, fine = (*dicts, None)[:2]
    content = {"global_step": step, "network_fn_state_dict": fn, "network_fine_state_dict": fine}
    torch.save({**content, "optimizer_state_dict": optimizer}, path)


KINDS = ("original", "nerf-pytorch", "JaxNeRF", "JaxNeRF, legacy")


def assert_same_outputs(folder, forwards, names, *, seed=0, views=True):
    """Asserts that the networks in a workdir have the densities and colours of the forward passes."""
    trained = restore_run(folder)
    (step,) = trained.steps()
    params, grid = trained.variables(step)
    assert grid is None and list(params) == list(names)
    config = json.loads((folder / "config.json").read_text())
    x, viewdirs = inputs(seed)
    for name, forward in zip(names, forwards, strict=True):
        field = mlp_field(**{**config[name], "compute_dtype": jnp.float32})
        got = field.apply(params[name], x, viewdirs)
        expected = forward(x.astype(np.float64), viewdirs.astype(np.float64) if views else None)
        assert np.mean(expected[0] > 0) > 0.3 and np.ptp(expected[1], axis=0).min() > 0.1
        for ours, theirs in zip(got, expected, strict=True):
            np.testing.assert_allclose(ours, theirs, rtol=1e-5, atol=1e-5)
    if "coarse" in names:  # the networks differ
        assert np.abs(np.asarray(got[1]) - forwards[0](x, viewdirs if views else None)[1]).max() > 0.1
    np.testing.assert_array_equal(trained.experiment.model.scene(params, grid)(x, viewdirs)[1], got[1])
    return step


@pytest.mark.parametrize("kind", KINDS)
def test_converted_networks_have_the_outputs_of_their_own_code(kind, tmp_path):
    networks = [random_layers(seed) for seed in (1, 2)]
    files, forwards = write(kind, tmp_path / "theirs", networks)
    line = convert(files, paper_config(), tmp_path / "run", legacy_posenc_order=kind == "JaxNeRF, legacy")
    assert line.startswith(
        f"{'the original code' if kind == 'original' else kind.partition(',')[0]}, step 1234: coarse and fine"
    )
    assert assert_same_outputs(tmp_path / "run", forwards, ("coarse", "fine")) == 1234
    origin = json.loads((tmp_path / "run" / "converted.json").read_text())
    assert origin["step"] == 1234 and list(origin["sha256"]) == [str(path) for path in files]


@pytest.mark.parametrize("kind", KINDS)
def test_without_view_directions_and_without_a_second_network(kind, tmp_path):
    """The files hold five outputs, of which four are used; nerf-pytorch's also hold an unused view layer."""
    options = {"depth": 6, "width": 32, "freqs": (6, 0), "views": False}
    files, forwards = write(kind, tmp_path / "theirs", [random_layers(3, **options)], step=7)
    config = paper_config(depth=6, width=32, num_freqs=6, use_viewdirs=False)
    config.sampling.num_fine = 0
    convert(files, config, tmp_path / "run", legacy_posenc_order=kind == "JaxNeRF, legacy")
    forwards = [functools.partial(forward, num_freqs=6) for forward in forwards]
    assert assert_same_outputs(tmp_path / "run", forwards, ("fine",), views="JaxNeRF" not in kind) == 7


@pytest.mark.parametrize("protocol, numpy_1", [(2, True), (2, False), (3, True), (3, False), (4, False)])
def test_lists_of_arrays_of_every_numpy_version_are_read(protocol, numpy_1, tmp_path):
    layers = random_layers(0, **SMALL)
    arrays = [array for layer in layers for array in layer]
    arrays[0] = np.asfortranarray(arrays[0])
    arrays[2] = arrays[2].astype(">f8")
    path = published.write_npy(tmp_path / "model_000010.npy", arrays, protocol=protocol, numpy_1=numpy_1)
    weights = read_weights([path])
    assert weights.step == 10
    for name, (kernel, bias) in zip(("trunk_0", "trunk_1"), layers[:2], strict=True):
        np.testing.assert_array_equal(weights.networks[0][name][0], kernel)
        np.testing.assert_array_equal(weights.networks[0][name][1], bias)


@pytest.mark.extra
def test_a_converted_run_is_scored_loaded_and_trained_further(compiled_once, tmp_path):
    networks = [random_layers(seed, **SMALL) for seed in (1, 2)]
    files, (_, fine) = write("original", tmp_path / "theirs", networks, step=10)
    flags = (f"--weights={files[0]},{files[1]}", "--config=configs/smoke.py", f"--workdir={tmp_path / 'run'}")
    code, out, err = run_forked("convert", *flags)
    assert (code, err) == (0, "") and out.startswith("the original code, step 10: coarse and fine network")
    assert evaluate(tmp_path / "run")["step"] == 10
    scene, _ = load_scene(tmp_path / "run")
    expected = fine(*inputs(0), num_freqs=4, num_view_freqs=2, skip=0)
    np.testing.assert_allclose(scene(*inputs(0))[1], expected[1], rtol=1e-5, atol=1e-5)
    config = smoke_config(max_steps=11, log_every=1)
    assert train_and_evaluate(config, tmp_path / "run")
    assert restore_run(tmp_path / "run").steps() == [10, 11]
    experiment = build.build(config)
    like = create_state(experiment.model, experiment.optimizer, 0)
    adam, schedule = Checkpoints(tmp_path / "run").load(11, like).opt_state
    assert (adam.count, schedule.count) == (1, 11)  # new moments, but the learning rate of the step


def test_a_mismatch_names_the_field_to_change(tmp_path):
    networks = [random_layers(seed, depth=3, width=32, skip=1, view_width=16, freqs=(5, 3)) for seed in (1, 2)]
    files, _ = write("JaxNeRF", tmp_path / "theirs", networks)
    fields = {"depth": 3, "width": 32, "skip_layer": 1, "view_width": 16, "num_freqs": 5, "num_view_freqs": 3}

    def message(**changes):
        sampling = changes.pop("sampling", {})
        config = paper_config(**{**fields, **changes})
        config.sampling.update(sampling)
        with pytest.raises(ValueError) as caught:
            convert(files, config, tmp_path / "run")
        assert not (tmp_path / "run").exists()
        return str(caught.value).removeprefix(f"{files[0]}: ")

    head = "of the coarse network is"
    assert message(width=64) == f"trunk_0 {head} [33, 32], expected [33, 64]; change coarse.width"
    assert message(num_freqs=10) == f"trunk_0 {head} [33, 32], expected [63, 32]; change coarse.num_freqs"
    assert message(skip_layer=0) == f"trunk_1 {head} [32, 32], expected [65, 32]; change coarse.skip_layer"
    assert message(num_view_freqs=4) == f"view {head} [53, 16], expected [59, 16]; change coarse.num_view_freqs"
    assert message(view_width=8) == f"view {head} [53, 16], expected [53, 8]; change coarse.view_width"
    assert "has 3 layers before density, expected 4; change coarse.depth" in message(depth=4)
    assert "uses view directions; change coarse.use_viewdirs" in message(use_viewdirs=False)
    assert "2 network(s), expected fine; give as many, or change sampling.num_fine" in message(sampling={"num_fine": 0})
    assert message(density_bias=1.0) == "coarse.density_bias is 1.0, expected 0 as in JaxNeRF"
    assert message(encode=False) == "coarse.encode is False, expected True as in JaxNeRF"
    assert message(density_activation="elu").startswith("--config.coarse.density_activation is 'elu', expected one of")


def test_an_extra_layer_a_used_folder_and_a_wrong_flag_are_refused(tmp_path):
    layers = random_layers(1)
    tree = as_flax(layers)
    tree["Dense_12"] = tree["Dense_11"]
    path = tmp_path / "checkpoint_5"
    path.write_bytes(msgpack_serialize(published.flax_content([tree, tree], 5)))
    with pytest.raises(ValueError, match="has layers .*Dense_12.*no field of the config changes"):
        convert([path], paper_config(), tmp_path / "run")
    with pytest.raises(ValueError, match="is not an empty folder; give a new --workdir"):
        convert([path], paper_config(), tmp_path)
    with pytest.raises(ValueError, match="is not a checkpoint of JaxNeRF"):
        published.write_npy(tmp_path / "model.npy", [])
        convert([tmp_path / "model.npy"], paper_config(), tmp_path / "run", legacy_posenc_order=True)


class Payload:
    """Creates a file when it is unpickled."""

    def __init__(self, mark):
        self.mark = str(mark)

    def __reduce__(self):
        return os.system, (f"touch {self.mark}",)


def test_a_pickle_that_runs_code_is_refused_and_not_run(tmp_path):
    mark = tmp_path / "ran"
    arrays = [np.ones((3, 4), np.float32), np.ones(4, np.float32)]
    contents = {
        "alone": Payload(mark),
        "in the list": [*arrays, Payload(mark)],
        "class": pathlib.PurePath("x"),
    }
    for name, content in contents.items():
        array = np.empty(3, object)
        for i in range(3):
            array[i] = content[i] if isinstance(content, list) else content
        for protocol in range(5):
            path = published.write_pickle(tmp_path / f"{name}.npy", pickle.dumps(array, protocol=protocol), 3)
            with pytest.raises(ValueError, match="never called|in place of an array|more than list") as caught:
                read_weights([path])
            assert "\n" not in str(caught.value)
    pickle.loads(pickle.dumps(Payload(mark)))
    assert mark.exists()  # the payload works elsewhere
    mark.unlink()
    np.load(tmp_path / "in the list.npy", allow_pickle=True)
    assert mark.exists()


def test_a_torch_file_that_runs_code_is_refused_and_not_run(tmp_path):
    torch = pytest.importorskip("torch", reason="torch is not installed")
    mark, path = tmp_path / "ran", tmp_path / "000001.tar"
    for zipped in (True, False):
        torch.save({"network_fn_state_dict": Payload(mark)}, path, _use_new_zipfile_serialization=zipped)
        with pytest.raises(ValueError, match="unreadable") as caught:
            read_weights([path])
        assert "\n" not in str(caught.value) and not mark.exists()


def test_sizes_are_checked_before_allocation(tmp_path):
    """A small pickle declares terabytes, gives a dtype the state of an object, or uses a huge memo index."""
    array = np.empty(2, object)
    array[0], array[1] = np.ones((3, 4), np.float32), np.ones(4, np.float32)
    good = pickle.dumps(array, protocol=2)
    assert read_weights([published.write_pickle(tmp_path / "good.npy", good, 2)]).networks
    shape = pickle.dumps((3, 4), protocol=2)[2:6]
    assert good.count(shape) == 1
    for wrong in (good.replace(shape, b"J\xff\xff\xff\x7fK\x04"), good.replace(b"f4", b"O8"), good + b"x"):
        with pytest.raises(ValueError, match="unreadable"):
            read_weights([published.write_pickle(tmp_path / "bad.npy", wrong, 2)])
    # Python's own unpickler would allocate a memo of 2**31 entries.
    start = good.index(b"]q")
    far = good[:start] + b"]r\xff\xff\xff\x7f" + good[start + 3 :]
    assert len(far) == len(good) + 3
    read_weights([published.write_pickle(tmp_path / "far.npy", far, 2)])
    with pytest.raises(ValueError, match="its header states"):
        read_weights([published.write_pickle(tmp_path / "bad.npy", good, 3)])


@pytest.mark.parametrize("protocol", [2, 4])
def test_an_array_that_a_list_holds_often_is_made_once(tmp_path, protocol):
    """The list of a small file holds one array 500 times."""
    array, size = np.empty(500, object), 40_000
    array.fill(np.ones((size // 4,), np.float32))
    path = published.write_pickle(tmp_path / "many.npy", pickle.dumps(array, protocol=protocol), 500)
    assert path.stat().st_size < 3 * size
    tracemalloc.start()
    with pytest.raises(ValueError, match="unreadable .an array more than once"):
        read_weights([path])
    assert tracemalloc.get_traced_memory()[1] < 30 * size
    tracemalloc.stop()


def test_without_torch_the_message_names_the_package(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "torch", None)
    (tmp_path / "1.tar").write_bytes(b"PK\x03\x04")
    with pytest.raises(ValueError, match="needs torch, which is not installed; install it with `pip install torch`"):
        read_weights([tmp_path / "1.tar"])


@pytest.fixture(scope="module")
def intact(tmp_path_factory):
    """A small file of each kind that can be written without missing packages."""
    folder = tmp_path_factory.mktemp("intact")
    layers = random_layers(0, **SMALL)
    kinds = ["original", "JaxNeRF"] + ["nerf-pytorch"] * (importlib.util.find_spec("torch") is not None)
    return [write(kind, folder, [layers])[0][0] for kind in kinds]


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_truncated_files_are_refused_and_damaged_ones_never_crash(intact, tmp_path, data):
    path = data.draw(st.sampled_from(intact))
    content = bytearray(path.read_bytes())
    cut = data.draw(st.booleans())
    if cut:
        content = content[: data.draw(st.integers(0, len(content) - 1))]
    else:
        for _ in range(data.draw(st.integers(1, 4))):
            # Most bytes are array contents; half of the damage goes to the structure at the start.
            where = data.draw(st.one_of(st.integers(0, 400), st.integers(0, len(content) - 1)))
            content[where] = data.draw(st.integers(0, 255))
    bad = tmp_path / path.name
    bad.write_bytes(content)
    try:
        weights = read_weights([bad])
    except ValueError as error:
        assert str(bad) in str(error) and "\n" not in str(error)
    else:
        assert not cut and weights.networks


def test_the_forward_facing_config_is_supported(tmp_path):
    files, _ = write("original", tmp_path / "theirs", [random_layers(seed) for seed in (1, 2)], step=200_000)
    config = llff_paper.get_config()
    config.data.dir = "not here"
    convert([str(path) for path in files], config, tmp_path / "run")
    assert restore_run(tmp_path / "run").steps() == [200_000]
