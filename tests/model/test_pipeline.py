import json
import math
from pathlib import Path

from sl_nerfstudio.model.pipeline import mean_over_frames, what_next


def test_means_and_deviations_over_the_frames_that_have_a_value() -> None:
    frames = [{"a": 1.0, "b": 5.0}, {"a": 3.0}, {}, {"a": math.nan, "c": math.nan}, {"a": 8.0, "b": math.inf}]
    found = mean_over_frames(frames, with_std=True)
    assert found == {"a": 4.0, "a_std": math.sqrt((9 + 1 + 16) / 2), "b": 5.0, "b_std": 0.0}
    assert json.loads(json.dumps(found, allow_nan=False)) == found
    assert mean_over_frames(frames, with_std=False) == {"a": 4.0, "b": 5.0}


def test_commands_to_continue_with_are_quoted_for_a_shell() -> None:
    text = what_next(Path("/a b/it's/config.yml"), Path("/scan"), 0.9)
    assert """ns-viewer --load-config '/a b/it'"'"'s/config.yml'""" in text
    assert text.startswith("result      /a b/it's\n") and max(map(len, text.splitlines())) <= 80
    assert "sl-redecode" not in text


def test_a_scan_with_much_missing_is_to_be_decoded_again() -> None:
    text = what_next(Path("/run/config.yml"), Path("/scans/a vase"), 0.404)
    assert "40% of the pixels" in text and "--output '/scans/a vase-again'" in text
    assert max(map(len, text.splitlines())) <= 80


def test_a_scan_that_was_decoded_again_is_not_sent_in_a_circle(tmp_path: Path) -> None:
    assert "sl-redecode" in what_next(Path("/run/config.yml"), tmp_path, 0.404)
    (tmp_path / "redecoding.json").touch()
    assert "sl-redecode" not in what_next(Path("/run/config.yml"), tmp_path, 0.404)
