from . import losses as losses
from . import motion as motion
from . import strategy as strategy
from .core.metadata import SceneMetadata as SceneMetadata
from .core.protocols import Appearance as Appearance
from .core.protocols import CameraOptimizer as CameraOptimizer
from .core.protocols import GaussianAppearance as GaussianAppearance
from .core.splats import Gaussians as Gaussians
from .core.splats import Params as Params
from .core.splats import Splats as Splats
from .core.splats import from_points as from_points
from .io.files import load as load
from .io.files import save as save
from .scene.presets import PRESETS as PRESETS
from .scene.presets import with_steps as with_steps
from .scene.scene import build as build
from .scene.scene import metadata_of as metadata_of
from .scene.spec import Scene as Scene
from .scene.track_fitting import TrackFit as TrackFit
from .scene.track_fitting import fit_tracks as fit_tracks
from .splatting.projection import project as project
from .splatting.raster import rasterize as rasterize
from .splatting.raster_spec import RasterSpec as RasterSpec
from .splatting.rasterization import RasterizationInfo as RasterizationInfo
from .splatting.rasterization import rasterization as rasterization
from .splatting.rendering import render as render

__version__: str
