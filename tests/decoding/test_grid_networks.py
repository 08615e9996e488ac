"""The networks in a process of their own, as on a GPU, and what is said where one fails."""

import os
import pickle
import signal
import subprocess
import sys
import time
import warnings
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context

import numpy as np
import pytest
import torch

from sl_nerfstudio.decoding.grid import NetworkDecoder
from sl_nerfstudio.decoding.grid_networks import ImageNetworks, LoadedNetworks, networks_for_all_processes
from sl_nerfstudio.decoding.grid_phases import CHANNELS
from sl_nerfstudio.errors import UserError
from sl_nerfstudio.parallel import gpu_fault, gpu_found, usable_device
from sl_nerfstudio.pattern.grid import GridPattern

CHANNELS_OF_AN_IMAGE = np.random.default_rng(0).random((CHANNELS, 64, 96), dtype=np.float32)


def _begin(networks):
    torch.set_num_threads(1)
    globals()["_networks"] = networks


def _read(_):
    return globals()["_networks"].unet(CHANNELS_OF_AN_IMAGE)


def test_decoders_load_networks_late_and_are_sent_to_other_processes_without_them(monkeypatch):
    there, here = NetworkDecoder(GridPattern()), NetworkDecoder(GridPattern())
    there.networks = LoadedNetworks()
    assert there.key != here.key and there.key.startswith(here.key)  # the last digits of a GPU differ
    assert there.images is there.images and there.images._networks is there.networks
    assert here.images is not None
    found = pickle.loads(pickle.dumps(here))
    assert found.key == here.key and "images" not in vars(found)
    monkeypatch.setattr("sl_nerfstudio.decoding.grid.GridImageDecoder", None)
    assert NetworkDecoder(GridPattern()).key == here.key


@pytest.mark.slow
def test_one_process_computes_for_all_others_what_each_would():
    shared = networks_for_all_processes("cpu")
    assert isinstance(shared, ImageNetworks) and isinstance(LoadedNetworks(), ImageNetworks)
    wanted = LoadedNetworks().unet(CHANNELS_OF_AN_IMAGE)
    np.testing.assert_allclose(shared.unet(CHANNELS_OF_AN_IMAGE), wanted, rtol=0, atol=1e-6)
    with ProcessPoolExecutor(2, get_context("spawn"), _begin, (shared,)) as pool:
        for found in pool.map(_read, range(3)):
            np.testing.assert_allclose(found, wanted, rtol=0, atol=1e-6)


def test_a_gpu_that_fails_while_it_reads_is_said(monkeypatch):
    networks = LoadedNetworks()

    def full(_):
        raise RuntimeError("CUDA out of memory. Tried to allocate 2 GiB\nmore lines")

    monkeypatch.setattr(networks, "_unet", full)
    with pytest.raises(RuntimeError, match="Tried"):  # on the CPU it is no fault of a GPU
        networks.unet(CHANNELS_OF_AN_IMAGE)
    monkeypatch.setattr(networks, "_device", "cuda")
    with pytest.raises(UserError, match=r"fail on the GPU: CUDA out of memory.*2 GiB") as caught:
        networks.unet(CHANNELS_OF_AN_IMAGE)
    assert "remedy: give --device cpu" in str(caught.value)


@pytest.fixture(autouse=True)
def _looked_for_again():
    for found in (gpu_found, gpu_fault):
        found.cache_clear()
    yield
    for found in (gpu_found, gpu_fault):
        found.cache_clear()


@pytest.mark.skipif(torch.cuda.is_available(), reason="needs a machine without a GPU")
def test_without_a_gpu_nothing_is_said():
    assert usable_device(None) == usable_device("cpu") == ("cpu", "")
    with pytest.raises(UserError, match=r"--device cuda: the GPU cannot be used: torch .* finds none"):
        usable_device("cuda")
    with pytest.raises(UserError, match="fail on the GPU"):
        networks_for_all_processes("cuda")


def test_why_a_gpu_is_not_used_is_one_sentence(monkeypatch):
    def too_old():
        warnings.warn("CUDA initialization: The NVIDIA driver on your system is too old\nUpdate it", stacklevel=1)
        return False

    def unknown(*_, **__):
        raise RuntimeError("CUDA error: no kernel image is available for execution on the device\nCompile with")

    monkeypatch.setattr(torch.cuda, "is_available", too_old)
    said = "The GPU is not used: CUDA initialization: The NVIDIA driver on your system is too old."
    assert usable_device(None) == ("cpu", said) and usable_device("cpu") == ("cpu", "")
    with pytest.raises(UserError, match=r"driver on your system is too old\n(.|\n)*leave --device out"):
        usable_device("cuda")
    for found in (gpu_found, gpu_fault):
        found.cache_clear()
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch, "ones", unknown)
    device, said = usable_device(None)
    assert device == "cpu" and said.endswith("no kernel image is available for execution on the device.")


_PARENT = """
import multiprocessing, time
from sl_nerfstudio.decoding.grid_networks import networks_for_all_processes

if __name__ == "__main__":
    networks = networks_for_all_processes("cpu")
    print(multiprocessing.active_children()[0].pid, flush=True)
    time.sleep(120)
"""


@pytest.mark.slow
def test_the_process_with_the_networks_ends_with_its_parent(tmp_path):
    script = tmp_path / "parent.py"
    script.write_text(_PARENT)
    with subprocess.Popen([sys.executable, script], stdout=subprocess.PIPE, text=True) as parent:
        assert parent.stdout is not None
        server = int(parent.stdout.readline())
        os.kill(parent.pid, signal.SIGKILL)
    for _ in range(200):
        try:
            os.kill(server, 0)
        except ProcessLookupError:
            return
        time.sleep(0.05)
    os.kill(server, signal.SIGKILL)
    pytest.fail("it is still there")
