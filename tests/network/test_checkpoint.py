"""Checkpoints of MinkowskiEngine networks: prefixes, wrappers, and a clear word where they do not fit."""

import argparse
import os
import pickle

import numpy as np
import pytest
import torch

from sgwarp.errors import InputError
from sgwarp.network.checkpoint import difference, load_into, net_for, read_weights, without_prefixes
from sgwarp.network.layers.mink_unet import ARCHITECTURES, MinkUNet


@pytest.fixture(scope="module")
def net() -> MinkUNet:
    torch.manual_seed(0)
    return MinkUNet(3, 8, "14A")


def same(state, net) -> bool:
    mine = net.state_dict()
    return state.keys() == mine.keys() and all(torch.equal(state[name], mine[name]) for name in mine)


@pytest.mark.slow
@pytest.mark.parametrize("prefix", ["", "module.", "net3d.", "module.net3d."])
@pytest.mark.parametrize("wrapper", [None, "state_dict"])
def test_weights_of_torch_save(net, prefix, wrapper, tmp_path):
    state = {prefix + name: tensor for name, tensor in net.state_dict().items()}
    torch.save({wrapper: state, "epoch": 3} if wrapper else state, tmp_path / "net.pth")
    loaded = read_weights(tmp_path / "net.pth")
    assert same(loaded, net)
    assert same(net_for(loaded).state_dict(), net)


def test_what_training_scripts_store_beside_the_weights(net, tmp_path):
    """OpenScene keeps the optimizer and the best IoU, a NumPy number; others their arguments."""
    content = {
        "epoch": 3,
        "state_dict": {"net3d." + name: tensor for name, tensor in net.state_dict().items()},
        "optimizer": {"state": {}, "param_groups": [{"lr": np.float32(1e-4)}]},
        "best_iou": np.float64(0.5),
        "args": argparse.Namespace(voxel=0.02),
        "step": np.int64(1),
        "history": np.zeros(3),
    }
    torch.save(content, tmp_path / "net.pth")
    assert same(read_weights(tmp_path / "net.pth"), net)


def test_code_in_a_file_does_not_run(tmp_path):
    torch.save({"state_dict": {}, "trap": os.system}, tmp_path / "net.pth")
    with pytest.raises(InputError, match="holds no tensors by name") as error:
        read_weights(tmp_path / "net.pth")
    assert "\x1b" not in str(error.value)


def test_weights_of_safetensors(net, tmp_path):
    from safetensors.torch import save_file

    save_file({"net3d." + name: tensor for name, tensor in net.state_dict().items()}, tmp_path / "net.safetensors")
    assert same(read_weights(tmp_path / "net.safetensors"), net)


def test_a_prefix_that_not_all_share_stays():
    state = {"module.a": torch.zeros(1), "b": torch.zeros(1)}
    assert without_prefixes(state) == state


def test_the_architecture_is_told_by_the_weights():
    for arch in ("14A", "18A"):
        with torch.device("meta"):
            state = MinkUNet(10, 5, arch).state_dict()
        state = {name: torch.zeros(tensor.shape, dtype=tensor.dtype) for name, tensor in state.items()}
        found = net_for(state)
        assert (found.arch, found.in_channels, found.out_channels) == (arch, 10, 5)


def test_what_does_not_fit_is_listed(net):
    state = net.state_dict()
    del state["bn0.bn.weight"]
    state["bn0.weight"] = torch.zeros(32)
    state["final.kernel"] = torch.zeros(96, 9)
    text = difference(state, net)
    assert text == (
        "1 missing: bn0.bn.weight; 1 unknown: bn0.weight; 1 of another shape: final.kernel [96, 9] instead of [96, 8]"
    )
    with pytest.raises(InputError, match=r"old\.pth: does not fit MinkUNet14A 3 -> 8: 1 missing: bn0"):
        load_into(net, state, "old.pth")
    with pytest.raises(InputError, match=r"fits none of .* against 14A: 1 missing: bn0\.bn\.weight"):
        net_for(state)


def test_a_network_of_another_kind_is_told(net):
    with pytest.raises(InputError, match="is no MinkUNet"):
        net_for({"encoder.weight": torch.zeros(3, 3)})


@pytest.mark.parametrize("content", [b"", b"nonsense", pickle.dumps([1, 2], protocol=2)])
def test_damaged_files_are_refused(content, tmp_path):
    path = tmp_path / "net.pth"
    path.write_bytes(content)
    with pytest.raises(InputError, match=r"net\.pth"):
        read_weights(path)


@pytest.mark.parametrize("content", [[1, 2], {"a": 1}, {}])
def test_files_without_tensors_by_name_are_refused(content, tmp_path):
    torch.save(content, tmp_path / "net.pth")
    with pytest.raises(InputError, match="no tensors by name"):
        read_weights(tmp_path / "net.pth")


def test_code_in_a_file_is_not_run(tmp_path):
    class Evil:
        def __reduce__(self):
            return (open, (str(tmp_path / "touched"), "w"))

    torch.save({"state_dict": Evil()}, tmp_path / "net.pth")
    with pytest.raises(InputError, match="holds no tensors by name"):
        read_weights(tmp_path / "net.pth")
    assert not (tmp_path / "touched").exists()


def test_missing_files_are_named(tmp_path):
    with pytest.raises(InputError, match="no such file"):
        read_weights(tmp_path / "none.pth")


@pytest.mark.parametrize("arch", list(ARCHITECTURES))
def test_what_nearly_fits_is_compared_with_the_nearest(arch):
    """Nine names are missing: the fewest differences count, not how they are spelled."""
    with torch.device("meta"):
        state = MinkUNet(3, 8, arch).state_dict()
    for name in [name for name in state if ".bn." in name][:9]:
        del state[name]
    with pytest.raises(InputError) as refused:
        net_for(state, "old.pth")
    assert f"; against {arch}: 9 missing: bn0.bn.weight, bn0.bn.bias, " in str(refused.value)


def test_prefixes_come_off_as_long_as_all_share_one():
    assert without_prefixes({}) == {}
    state = {"module.net3d.a": torch.zeros(1), "module.net3d.b": torch.zeros(2)}
    assert list(without_prefixes(state)) == ["a", "b"]
