from .images.comparison import Comparison as Comparison
from .images.comparison import compare as compare
from .images.detector import Detector as Detector
from .images.detector import Exposure as Exposure
from .images.image import Image as Image
from .images.image import read as read
from .inverse.calibrate import Calibration as Calibration
from .inverse.calibrate import calibrate as calibrate
from .inverse.derivatives import derivatives as derivatives
from .inverse.inversion import Inversion as Inversion
from .inverse.invert import invert as invert
from .inverse.transport import transport as transport
from .inverse.transport_file import read_transport as read_transport
from .inverse.transport_matrix import TransportMatrix as TransportMatrix
from .optics.opencv_camera import camera_from_opencv as camera_from_opencv
from .phantom.flux_import import import_flux as import_flux
from .phantom.framed_scene import scene_xml as scene_xml
from .phantom.phantom import Phantom as Phantom
from .rendering.render import render as render
from .rendering.scene import load as load
from .runtime.errors import FsptError as FsptError
from .studies.converge import converge as converge
from .studies.convergence import Convergence as Convergence
from .studies.explain import explain as explain
from .studies.sweep import sweep as sweep
from .viewer.view import view as view

__version__: str
