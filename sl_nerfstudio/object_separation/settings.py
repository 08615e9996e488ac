"""All settings of the separation of object and surroundings."""

from dataclasses import dataclass


@dataclass(frozen=True)
class SeparationSettings:
    """Limits are in standard deviations of the measured noise, or shares; none is a length."""

    pixels_per_frame: int = 40_000
    """Decoded pixels of each frame that the search looks at, at most."""
    points: int = 30_000
    """Points of all frames together from which planes are found, at most."""
    neighbours: int = 12
    """Points of the same frame from which the normal of a point is found."""
    hypotheses: int = 300
    """Planes that are tried in each round of the search."""
    planes: int = 8
    """Planes that are looked for, at most."""
    least_support: float = 0.03
    """Smallest share of the points that a plane must hold."""
    normal_cosine: float = 0.9
    """Smallest cosine between the normal of a point and that of its plane."""
    search_sigmas: float = 4.0
    """Distance from a plane within which a point counts as part of it, while planes are searched for."""
    clear_sigmas: float = 8.0
    """Distance from a plane above which a point certainly does not belong to it."""
    plane_sigmas: float = 3.0
    """Height up to which a pixel is part of the plane wherever the object may be near, at least. Decoders err more
    beside edges than elsewhere, so the height is measured: nothing is below the plane, what seems to be is error."""
    error_share: float = 0.98
    """Share of the errors below the plane that the measured height covers."""
    most_sigmas: float = 30.0
    """What is farther below the plane is no error of this kind; the measured height is at most this."""
    bare_sigmas: float = 8.0
    """Height up to which a pixel is part of the plane where the plane is bare, at least."""
    bare_factor: float = 3.0
    """The same in measured heights."""
    bare_share: float = 0.7
    """Share of the points near the plane that must lie on it for a place to count as bare."""
    cameras_in_front: float = 0.95
    """Share of the cameras that must be in front of a plane that is left out."""
    most_behind: float = 0.05
    """Largest share of the points in the viewed region that may lie behind such a plane."""
    least_above: float = 0.005
    """Smallest share of the points in the viewed region that must lie in front of it: there must be an object."""
    directions: int = 36
    """Directions in which the edge of a plane is looked for."""
    view_margin: float = 0.1
    """Strip along the borders of image and pattern in which an edge is not told from the end of the view: a share."""
    edge_frames: float = 0.15
    """Share of the frames that must look past the edge of a plane, for the edge to count as seen."""
    continues: float = 0.5
    """Share of the directions in which a plane must leave the views, for it to be more than the object."""
    support_area: float = 3.0
    """A plane whose edges are seen counts as support only if its bare area is at least so many times the area of what
    stands on it."""
    support_height: float = 0.25
    """and if what stands on it rises at least so high, as a share of the root of its area."""
    voxels: int = 40
    """Voxels along the radius of the viewed region; parts of the object farther apart than two voxels are separate."""
    least_frames: int = 2
    """Frames that must have seen a voxel, or"""
    least_points: int = 4
    """points in it, for it to count."""
    least_voxels: int = 5
    """Voxels of the smallest part that is kept beside the main part."""
    gap: float = 0.15
    """Distance from the main part within which other parts are kept, as a share of its size."""
    silhouette_points: int = 200_000
    """Points of the object that are looked for in every frame, to tell which pixels that were not decoded show it."""
    least_object: float = 0.01
    """Smallest share of the points that the object must hold; with less, nothing is left out."""


SEPARATION_DEFAULTS = SeparationSettings()
