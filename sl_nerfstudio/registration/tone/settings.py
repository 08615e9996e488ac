"""Settings of tones: what of a frame's brightness belongs to its surface, and when it holds two frames."""

from dataclasses import dataclass


@dataclass(frozen=True)
class ToneSettings:
    """What of a frame's brightness belongs to its surface."""

    window: float = 0.06
    """standard deviation of the window in which brightness is compared, as a share of the map's longer side: what
    changes more slowly is light, not surface"""
    least_cosine: float = 0.35
    """cosine of the normal with the ray of either device, below which the surface is seen or lit too obliquely"""
    knots_deg: tuple[float, ...] = (
        *(0.0, 4.0, 8.0, 12.0, 16.0, 20.0, 25.0, 30.0),
        *(37.0, 45.0, 54.0, 63.0, 72.0, 81.0, 90.0),
    )
    """angles of the normal to light, camera and the middle of both, in degrees, between which brightness is linear:
    highlights are narrow"""
    ridge: float = 1e-4
    """weight of the squares of those functions, relative to one pixel's"""
    border: int = 2
    """map pixels along the border of what is known that have no tone"""
    fewest_pixels: int = 60
    """map pixels of a connected part of the surface that has a tone"""
    largest: float = 3.0
    """tone, in robust standard deviations of the frame's, beyond which it is cut off: a highlight"""


@dataclass(frozen=True)
class ToneMatchSettings:
    """Frames that slip along each other, held by the tone of their surface."""

    step_deg: float = 3.0
    """rotation between places that are compared, degrees"""
    follow_steps: int = 2
    """steps by which the rest of the motion follows each of them"""
    followed_points: int = 300
    """points of each frame by which it follows"""
    points: int = 5000
    """points of a frame that are compared at most"""
    least_share: float = 0.15
    """share of a frame's toned points that the other must see, for a correlation to count"""
    least_correlation: float = 0.3
    """correlation of the tones at the place that is taken"""
    largest_correlation: float = 0.999
    """correlation that counts at most: Fisher's transform of 1 is infinite"""
    least_lead: float = 2.0
    """lead of that place over all others, Fisher's transforms, in standard deviations of what chance gives"""
    fewest_others: int = 12
    """other places that it must be compared with"""
    least_sigma_deg: float = 0.3
    """smallest standard deviation, in degrees, of a rotation found so"""
    largest_sigma_deg: float = 1.5
    """largest such standard deviation: broad shades are as likely light as surface"""
    largest_loss: float = 0.05
    """share of the points that may agree less there than where the surfaces agree best"""
