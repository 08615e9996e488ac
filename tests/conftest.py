"""Set-up of all tests: shapes and types are checked at run time, one thread, no deadlines, signals as in a terminal."""

import importlib
import os
import signal
import threading
from collections.abc import Iterator

os.environ.setdefault("OMP_NUM_THREADS", "1")

from tests import type_checks

type_checks.install()

import hypothesis  # noqa: E402
import pytest  # noqa: E402

hypothesis.settings.register_profile("project", deadline=None, derandomize=True, max_examples=50, print_blob=True)
hypothesis.settings.load_profile("project")


def pytest_configure(config: pytest.Config) -> None:
    """What takes long to import; not in the process that only hands out the tests to others."""
    if config.getoption("numprocesses", None) and not hasattr(config, "workerinput"):
        return
    import torch

    torch.set_num_threads(1)
    # While it is imported, nerfstudio looks through the whole call stack 26 times. Under pytest's deep stack that takes
    # half a minute; a new thread has a short one.
    importing = threading.Thread(target=importlib.import_module, args=("nerfstudio.configs.method_configs",))
    importing.start()
    importing.join()


@pytest.fixture(autouse=True)
def signals_as_in_a_terminal() -> Iterator[None]:
    """Commands that a test starts inherit ignored signals: from the shell (jobs in the background), or from a test
    that called `cli.run.run` in this process, which ignores them once a command was interrupted."""
    signal.signal(signal.SIGINT, signal.default_int_handler)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    yield


@pytest.fixture(autouse=True)
def threads_of_this_test_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    """What opens a run for `ns-export` keeps torch on one thread, and our loops on as many as they had, for good.

    It may be a fixture of a whole file, which comes before this one: so each test begins anew.
    """
    from sl_nerfstudio import parallel

    monkeypatch.setattr(parallel, "_ours", None)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Files marked as long come first."""
    items.sort(key=lambda item: item.get_closest_marker("long") is None)
