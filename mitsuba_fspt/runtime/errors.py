"""The package's errors: each message names the thing, the value, the rule and the mend, in one line."""


class FsptError(ValueError):
    """Base of everything this package raises on purpose; the command line turns it into one line and exit code 2."""


class OpticsError(FsptError):
    """A lens that cannot exist or cannot form a real image."""


class ExitanceError(FsptError):
    """A surface flux density J_n that is missing, not finite, negative or zero everywhere."""


class SceneError(FsptError):
    """A scene file, mesh or parameter that cannot be used."""


class ImageError(FsptError):
    """An image that cannot be read, written or compared."""


class FluxError(FsptError):
    """Tissue data (a mesh, values on it, a phantom description) that gives no surface flux density."""


class BackendError(FsptError, ImportError):
    """No usable LLVM or CUDA, or a missing system library or optional package."""


class DetectorError(FsptError):
    """A detector that cannot exist, or an exposure it cannot make."""
