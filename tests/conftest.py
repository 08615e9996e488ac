"""Set-up of all tests: one thread, no deadlines, signals as in a terminal; types checked if SL_TYPE_CHECKS is set."""

import importlib
import itertools
import os
import signal
import threading
from collections.abc import Iterator
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ["TRITON_INTERPRET"] = "1"  # kernels for GPUs run on the CPU
os.environ["SL_CACHE"] = os.devnull  # for fixtures of several tests: nothing is found there, or written

if os.environ.get("SL_TYPE_CHECKS"):  # every call's shapes, dtypes and types: about a third slower
    import jaxtyping

    _ROOT = Path(__file__).parents[1]
    _MODULES = [".".join(f.relative_to(_ROOT).with_suffix("").parts) for f in _ROOT.glob("sl_nerfstudio/**/*.py")]
    # Triton compiles what is in its modules; its types are not those of Python.
    _CHECKED = [m for m in _MODULES if "triton" not in m and not m.endswith("__init__")]
    jaxtyping.install_import_hook(_CHECKED, "beartype.beartype")

import hypothesis
import pytest

hypothesis.settings.register_profile("project", deadline=None, derandomize=True, max_examples=50, print_blob=True)
hypothesis.settings.load_profile("project")


def pytest_configure(config: pytest.Config) -> None:
    """What takes long to import; not in the process that only hands out the tests to others."""
    if config.getoption("numprocesses", None) and not hasattr(config, "workerinput"):
        return
    from sl_nerfstudio.parallel import only_one_library_thread

    only_one_library_thread()  # numpy was imported by a plugin, before OMP_NUM_THREADS was set
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


_TESTS = itertools.count()


@pytest.fixture(autouse=True)
def earlier_runs_of_this_test_alone(monkeypatch: pytest.MonkeyPatch, tmp_path_factory: pytest.TempPathFactory) -> None:
    """No test finds what others have processed of the same captures, or what the user of this machine has."""
    monkeypatch.setenv("SL_CACHE", str(tmp_path_factory.getbasetemp() / "caches" / str(next(_TESTS))))


@pytest.fixture(autouse=True)
def threads_of_this_test_alone() -> Iterator[None]:
    """What opens a run for `ns-export` keeps torch on one thread, and our loops on as many as they had, for good.

    It may be a fixture of a whole file, which comes before this one: so each test begins anew, and leaves nothing to
    the fixtures that come before the next.
    """
    from sl_nerfstudio import parallel

    parallel._ours = None
    yield
    parallel._ours = None
