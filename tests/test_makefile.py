"""`make demo` goes on after what is complete; the commands are replaced by some that only note how they were called."""

import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
STEPS = {"demo": ("sl-synth", "ns-train", "sl-export", "sl-eval"), "demo-images": ("sl-synth", "sl-scan", "sl-eval")}
COMMANDS = sorted({name for steps in STEPS.values() for name in steps})

# Writes the files of the real command, the last of them last; fails in the middle if it is named in the file `fail`.
FAKE = r"""#!/bin/bash
set -eu
name=$(basename "$0") here=$(dirname "$0")/../..
echo "$name $*" >>"$here/calls"
declare -A flag
while [ $# -gt 0 ]; do case "$1" in --*) flag[${1#--}]=${2:-} ;; esac; shift; done
put() { mkdir -p "$(dirname "$1")"; echo x >"$1"; }
fail() { if [ "$(cat "$here/fail")" = "$name" ]; then exit 1; fi; }
case $name in
sl-synth) put "${flag[output]}/ground_truth/mesh.ply"; fail
  if [ -v flag[images-only] ]; then last=intrinsics.json; else last=transforms.json; fi
  put "${flag[output]}/$last" ;;
sl-scan) put "${flag[output]}/mesh.ply"; fail; put "${flag[output]}/report.html" ;;
ns-train)
  if [ -v flag[load-config] ]; then run=$(dirname "${flag[load-config]}")
  else run=${flag[output-dir]}/${flag[experiment-name]}/sl-neus/demo; put "$run/config.yml"; fi
  fail; put "$run/nerfstudio_models/step-000000999.ckpt" ;;
sl-export) put "${flag[output]}"; fail; put "${flag[poses]}/transforms.json"; put "${flag[poses]}/training.json" ;;
sl-eval) put "${flag[json]}"; fail; put "${flag[report]}" ;;
esac
"""


@pytest.fixture
def make(tmp_path):
    """Runs make in a folder with its own outputs; returns exit status and the commands called."""
    venv = tmp_path / "venv"
    (venv / "bin").mkdir(parents=True)
    for name in COMMANDS:
        (venv / "bin" / name).write_text(FAKE)
        (venv / "bin" / name).chmod(0o755)
    (venv / "bin" / "python").write_text("")
    (venv / ".installed").touch()

    def run(target, failing=""):
        (tmp_path / "fail").write_text(failing)
        (tmp_path / "calls").write_text("")
        places = (f"VENV={venv}", f"DEMO={tmp_path / 'demo'}", f"IMAGES={tmp_path / 'images'}")
        done = subprocess.run(["make", "-s", target, *places], cwd=ROOT, capture_output=True, text=True, check=False)
        return done.returncode, (tmp_path / "calls").read_text().splitlines()

    return run


@pytest.mark.parametrize("target", STEPS)
def test_a_demo_goes_on_after_what_is_complete(make, target):
    steps = STEPS[target]
    for k, name in enumerate(steps):
        status, calls = make(target, failing=name)
        assert status != 0
        assert [call.split()[0] for call in calls] == ([name] if k == 0 else list(steps[k - 1 : k + 1]))
        if k and steps[k - 1] == "ns-train":
            assert "--load-config" in calls[0]  # it had begun
    status, calls = make(target)
    assert status == 0 and [call.split()[0] for call in calls] == [steps[-1]]
    assert make(target) == (0, [])


def test_without_an_interruption_every_command_is_called_once(make):
    status, calls = make("demo")
    assert status == 0 and [call.split()[0] for call in calls] == list(STEPS["demo"])
    assert "--load-config" not in calls[1] and "--overwrite" in calls[2]
