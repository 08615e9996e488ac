"""Settings of what looks the same, or nearly, from several sides. Lengths are in radii, see `registration.settings`."""

from dataclasses import dataclass


@dataclass(frozen=True)
class SymmetrySettings:
    """When a surface looks the same after a turn."""

    same_rotation_deg: float = 8.0
    """rotation between two turns, in degrees, below which they are one"""
    largest_log_scale: float = 0.05
    """logarithm of the scale of a turn, which is 0 but for the errors of the pairs"""
    least_agreeing: float = 0.25
    """points that must agree after the turn, as a share of those that agree before it: what was seen from one side only
    covers little of its place upside down"""
    neighbours: int = 6
    """frames with which each one is compared after the turn"""
    most_compared: int = 12
    """turns that are tried"""
    exact_widths: tuple[float, ...] = (0.06, 0.04, 0.03, 0.02, 0.01, 0.0, 0.0)
    """kernel width, in radii, of each step that makes a turn exact; never below `kernel_sigmas` of pairs"""
    exact_rcond: float = 1e-6
    """singular values, relative to the largest, along which a turn is not moved: what is round slips"""
    least_excess: float = 8.0
    """how many times as much must contradict after a part of a turn as after all of it; less: it is round, or long"""


@dataclass(frozen=True)
class TurnedBlockSettings:
    """Which blocks of frames are at the wrong one of several sides that look nearly the same."""

    fewest_frames: int = 3
    """frames of a component in which blocks are looked for"""
    neighbours: int = 16
    """frames with which each one is compared"""
    most_compared: int = 12
    """turns that are tried"""
    least_judged: float = 0.1
    """points that a pair can judge, in frames, if it says how much usually contradicts"""
    better_quantile: float = 0.25
    """quantile of the shares that contradict in pairs: those inside a block, even if blocks contradict each other"""
    least_misfit: float = 0.003
    """share that may contradict in such pairs: points at edges do in every pair"""
    usual_factor: float = 1.5
    """times as much may contradict before it counts against a block"""
    least_contradicting: float = 0.5
    """points that must contradict beyond the usual, in frames, if a block is looked for"""
    starts: int = 24
    """frames from which a block is grown"""
    least_agreeing: float = 1.0
    """points of a block that must agree with the other frames after the turn, in frames: 1 is all points of one"""
    least_overlap: float = 0.1
    """the same, relative to those that agreed before it"""
    largest_remainder: float = 0.5
    """share that contradicts across a block after the turn, relative to that before it"""
    least_improvement: float = 0.8
    """share that contradicts among all frames after the turn, relative to that before it"""
    most_tried: int = 2
    """turned blocks of a component that are tried, those that contradict most"""
    most_turned: int = 4
    """times that blocks are turned, one after the other"""
