"""The command line `fspt`: thin verbs over the Python API."""

from .app import main as main
from .app import run as run
