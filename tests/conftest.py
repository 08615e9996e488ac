"""Set-up of all tests: shapes and types are checked at run time, one thread, no deadlines."""

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")

from jaxtyping import install_import_hook

install_import_hook("sl_nerfstudio", "beartype.beartype")

import hypothesis  # noqa: E402
import torch  # noqa: E402

torch.set_num_threads(1)
hypothesis.settings.register_profile("project", deadline=None, derandomize=True, max_examples=50, print_blob=True)
hypothesis.settings.load_profile("project")
