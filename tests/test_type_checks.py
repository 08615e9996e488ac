"""With SL_TYPE_CHECKS, calls with wrong shapes or types are refused while tests run."""

import os
import subprocess
import sys
from pathlib import Path

_CALLS = """
import tests.conftest
import torch
from sl_nerfstudio.geometry.lie import inverse
inverse(torch.eye(4).expand(3, 4, 4))
try:
    inverse(torch.eye(3))
except Exception as error:
    print(type(error).__module__.split(".")[0])
"""


def test_a_wrong_shape_is_refused_only_where_types_are_checked():
    def error_of(**environment: str) -> str:
        result = subprocess.run(
            [sys.executable, "-c", _CALLS],
            cwd=Path(__file__).parents[1],
            env=os.environ | environment,
            capture_output=True,
            text=True,
            check=False,
        )
        return result.stdout.strip()

    assert error_of(SL_TYPE_CHECKS="1") == "jaxtyping"
    assert error_of(SL_TYPE_CHECKS="") != "jaxtyping"
