"""How far each continuation is off, what a choice costs, and what the network gains on captures that are held out."""

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32
from numpy import ndarray
from torch import Tensor
from torch.nn import functional as F

from sl_nerfstudio.decoding.grid_edges import EdgeNetwork, EdgeOutput, slopes, steps
from sl_nerfstudio.decoding.grid_phases import MULTIPLE
from training.edge_captures import WRONG, EdgeCapture

_FAR = 9.0  # periods: where the pattern is not, or farther off
_SCALE = 0.05  # periods: an error that costs half of the most that one can cost


def continuation_errors(
    fitted: Float[Tensor, "b 2 h w"], slope: Float[Tensor, "b 2 2 h w"], true: Float[Tensor, "b 2 h w"]
) -> Float[Tensor, "b k h w"]:
    """Error of each continuation at each pixel, periods; NaN where nothing can be continued."""
    errors = []
    for dx, dy in steps().tolist():
        coords = _shifted(fitted, dx, dy)
        if dx or dy:
            there = _shifted(slope, dx, dy)
            coords = coords - there[:, :, 0] * dx - there[:, :, 1] * dy
        off = (coords - true).square().sum(1).sqrt().nan_to_num(nan=_FAR)  # `norm` takes eighty times as long
        errors.append(torch.where(torch.isfinite(coords).all(1), off, torch.nan))
    return torch.stack(errors, 1)


def _shifted(values: Float[Tensor, "*b h w"], dx: int, dy: int) -> Float[Tensor, "*b h w"]:
    """The values `dx`, `dy` pixels away; NaN outside."""
    h, w = values.shape[-2:]
    padded = F.pad(values, (max(0, -dx), max(0, dx), max(0, -dy), max(0, dy)), value=float("nan"))
    return padded[..., max(0, dy) : max(0, dy) + h, max(0, dx) : max(0, dx) + w]


def losses(output: EdgeOutput, errors: Float[Tensor, "b k h w"]) -> dict[str, Tensor]:
    """Expected cost of the chosen step's error, and whether what is then chosen is wrong."""
    scores, errors, possible = _possible(output, errors)
    cost = errors / (errors + _SCALE)
    chosen = errors.gather(1, scores.argmax(1, keepdim=True))[:, 0]
    wrong = F.binary_cross_entropy_with_logits(output.wrong, (chosen > WRONG).float(), reduction="none")
    return {
        "risk": ((scores.softmax(1) * cost).sum(1) * possible).sum() / possible.sum(),
        "wrong": (wrong * possible).sum() / possible.sum(),
        "own": (cost[:, 0] * possible).sum() / possible.sum(),
        "least": (cost.amin(1) * possible).sum() / possible.sum(),
    }


def _possible(
    output: EdgeOutput, errors: Float[Tensor, "b k h w"]
) -> tuple[Float[Tensor, "b k h w"], Float[Tensor, "b k h w"], Bool[Tensor, "b h w"]]:
    """Scores of the steps, errors that are all numbers, and pixels to which something can be continued."""
    can = torch.isfinite(errors)
    return output.step.masked_fill(~can, -1e4), torch.where(can, errors, _FAR), can.any(1)


@torch.no_grad()
def held_out(network: EdgeNetwork, captures: Sequence[EdgeCapture]) -> dict[str, float]:
    """Shares of the lit pixels that are right before and after, and that could be; wrong ones among the surest."""
    network.eval()
    before, after, best, odds, lit = [], [], [], [], 0
    for one in captures:
        h, w = (side // MULTIPLE * MULTIPLE for side in one.true.shape[:2])
        view = one.view.part(slice(0, h), slice(0, w))
        parts = view.fitted, slopes(one.view.fitted, 1.0)[:h, :w], one.true[:h, :w]
        errors = continuation_errors(*(torch.from_numpy(_planes(part))[None] for part in parts))
        output = network(torch.from_numpy(view.channels())[None].contiguous(memory_format=torch.channels_last))
        scores, errors, possible = _possible(output, errors)
        lit += int(np.isfinite(parts[2][..., 0]).sum())
        chosen = errors.gather(1, scores.argmax(1, keepdim=True))[:, 0]
        for kept, values in ((before, errors[:, 0]), (after, chosen), (best, errors.amin(1)), (odds, output.wrong)):
            kept.append(values[possible].numpy())
    network.train()
    wrong = np.concatenate(after) > WRONG
    surest = np.argsort(np.concatenate(odds), kind="stable")
    row = {name: float((np.concatenate(part) < WRONG).sum() / lit)
           for name, part in (("before", before), ("after", after), ("possible", best))}  # fmt: skip
    return row | {f"wrong_of_{share}": float(wrong[surest[: int(share * lit)]].mean()) for share in (0.8, 0.85, 0.9)}


def _planes(values: Float32[ndarray, "h w *k"]) -> Float32[ndarray, "*k h w"]:
    return np.ascontiguousarray(np.moveaxis(values, (0, 1), (-2, -1)))
