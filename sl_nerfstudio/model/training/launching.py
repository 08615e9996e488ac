"""Several processes for one training: nerfstudio's launcher, on CPUs as well, and ended by a signal without loss."""

import logging
import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from multiprocessing.process import BaseProcess
from typing import Any

import torch
import torch.distributed as dist
import torch.multiprocessing as mp
from nerfstudio.utils import comms
from torch.multiprocessing.spawn import ProcessExitedException

from sl_nerfstudio.cores import cores
from sl_nerfstudio.model.training.quiet import quiet_nerfstudio

_TRAIN = "nerfstudio.scripts.train"


def launch_well() -> None:
    """Let `ns-train` start the processes of a training with `launch`."""
    if _TRAIN in sys.modules:
        sys.modules[_TRAIN].launch = launch  # type: ignore[attr-defined]


def launch(
    main_func: Callable[..., Any],
    num_devices_per_machine: int,
    num_machines: int,
    machine_rank: int,
    dist_url: str,
    config: Any,
    device_type: str,
) -> None:
    """nerfstudio's launcher with three differences.

    - `device_type` may be `cpu`: the processes then share the cores, and speak through gloo.
    - SIGINT and SIGTERM reach the first process, which ends the run together with the others (see training/loop.py);
      the status is 130 or 143.
    - The message of a process that failed stands alone, without this one's traceback.
    """
    from nerfstudio.scripts.train import _find_free_port

    logging.getLogger("torch.multiprocessing.spawn").setLevel(logging.ERROR)  # it warns when it ends the others
    url = f"tcp://127.0.0.1:{_find_free_port()}" if dist_url == "auto" else dist_url
    ranks = (num_devices_per_machine, num_machines, machine_rank)
    context = mp.spawn(_work, (main_func, *ranks, url, config, device_type), nprocs=num_devices_per_machine, join=False)
    assert context is not None
    first = context.processes[0]
    assert first is not None
    with _signals_forwarded_to(first) as received:
        try:
            while not context.join():
                pass
        except ProcessExitedException as error:
            raise SystemExit(128 + received[0] if received else error.exit_code) from None
        finally:
            config.leave_folder()


@contextmanager
def _signals_forwarded_to(process: BaseProcess) -> Iterator[list[int]]:
    """Send SIGTERM to a process for each SIGINT or SIGTERM; holds their numbers."""
    received: list[int] = []

    def forward(number: int, frame: Any) -> None:
        received.append(number)
        process.terminate()

    before = {number: signal.signal(number, forward) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield received
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _work(
    local_rank: int,
    main_func: Callable[..., Any],
    devices: int,
    machines: int,
    machine_rank: int,
    url: str,
    config: Any,
    device_type: str,
) -> None:
    """One process, until its training ends."""
    signal.signal(
        signal.SIGINT, signal.SIG_IGN
    )  # a terminal sends it to all processes; the one that started them forwards it
    quiet_nerfstudio(not config.verbose)
    if device_type == "cuda":
        torch.cuda.set_device(local_rank)
    else:
        torch.set_num_threads(max(cores() // devices, 1))
    rank = machine_rank * devices + local_rank
    backend = "nccl" if device_type == "cuda" else "gloo"
    dist.init_process_group(backend, init_method=url, world_size=machines * devices, rank=rank)
    for machine in range(machines):  # every process takes part in making every group
        group = dist.new_group(list(range(machine * devices, (machine + 1) * devices)))
        if machine == machine_rank:
            comms.LOCAL_PROCESS_GROUP = group  # type: ignore[assignment]
    main_func(local_rank, machines * devices, config, rank)
    comms.synchronize()
    dist.destroy_process_group()
