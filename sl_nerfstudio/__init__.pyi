# The public names of the package, by topic; `X as X` says that X is meant for others.
# ruff: noqa: I001

__version__: str

# Faults: a UserError says what is wrong, its likely cause and the remedy.
from .errors import UserError as UserError

# Scans: a folder of frames with devices, poses and coordinates.
from .scan import Scan as Scan
from .scan import Frame as Frame
from .scan import Scale as Scale
from .scan import PoseSigma as PoseSigma
from .scan import ScanWriter as ScanWriter
from .scan import ScanError as ScanError
from .scan import read_scan as read_scan
from .scan import check_scan as check_scan
from .scan import read_poses as read_poses
from .scan import write_transforms as write_transforms

# Patterns, devices and poses.
from .pattern.files import make_grid as make_grid
from .pattern.files import make_gray_code as make_gray_code
from .pattern.files import read_layout as read_layout
from .geometry.devices import Device as Device
from .geometry.lie import DevicePoses as DevicePoses
from .geometry.lie import Similarity as Similarity
from .calibration.formats import read_device_file as read_device_file
from .api import write_devices as write_devices

# From a photograph to points.
from .api import decode_image as decode_image
from .api import triangulate_pixels as triangulate_pixels
from .decoding.decoder import Decoded as Decoded
from .decoding.decoder import DecodingError as DecodingError
from .relative_pose.epipolar import correspondences_of as correspondences_of
from .relative_pose.estimation import RelativePose as RelativePose
from .relative_pose.estimation import RelativePoseError as RelativePoseError
from .relative_pose.estimation import estimate_relative_pose as estimate_relative_pose

# From frames to a scan.
from .registration.surfaces import FrameCloud as FrameCloud
from .registration.surfaces import frame_cloud as frame_cloud
from .registration.register import register as register
from .registration.result import Registration as Registration
from .bundle_adjustment.registered_frames import AdjustedFrames as AdjustedFrames
from .bundle_adjustment.registered_frames import adjust_registered as adjust_registered
from .api import process_folder as process_folder

# From a scan to a surface.
from .methods import train as train
from .runs.run import TrainedRun as TrainedRun
from .runs.run import load_run as load_run
from .api import RunSurface as RunSurface
from .api import surface_of as surface_of
from .runs.export import export_run as export_run
from .runs.export_settings import ExportSettings as ExportSettings
from .meshing.mesh import Mesh as Mesh
from .meshing.mesh import VertexQuality as VertexQuality
from .meshing.files import read_mesh as read_mesh
from .meshing.files import read_quality as read_quality
from .meshing.files import write_mesh as write_mesh

# Measuring, and comparing with what is known.
from .evaluation.evaluate import Evaluation as Evaluation
from .evaluation.evaluate import Length as Length
from .evaluation.evaluate import PointPair as PointPair
from .evaluation.evaluate import evaluate as evaluate
from .evaluation.evaluate import measure_lengths as measure_lengths
from .evaluation.evaluate import read_inputs as read_inputs
from .evaluation.judgement import judge as judge
from .evaluation.part_alignment import PartAlignment as PartAlignment
from .evaluation.part_alignment import place_on_part as place_on_part
from .evaluation.inspection import Inspection as Inspection
from .evaluation.inspection import inspect as inspect
from .evaluation.shape_fits import FittedShape as FittedShape
from .evaluation.shape_fits import PickedRegion as PickedRegion
from .evaluation.shape_fits import fit_shape as fit_shape
