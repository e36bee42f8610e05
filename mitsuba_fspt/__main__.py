"""`python -m mitsuba_fspt` is the command line `fspt`."""

from .cli import main

main()
