"""`python -m mitsuba_fspt` is the command line `fspt`."""

from .cli.app import main

main()
